"""Surveys as DXF: POINT entities, and INSERTs of blocks with their attributes."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from ezdxf.filemanagement import read
from ezdxf.lldxf.const import DXFError

from app.errors import UnreadableUpload, WaymarkError
from app.formats.surveys.table import MAX_COLUMNS, MAX_ROWS, Fault, Faults, SourceTable

_UNITS = {2: "ft-intl", 6: "m", 21: "ft-us"}
_UNITLESS = 0  # codes of $INSUNITS; Autodesk DXF reference, "HEADER section group codes"


def read_dxf(data: bytes, layer: str | None) -> SourceTable:
    """Points and block references of the model space; their layer, block and attributes are columns.

    Raises
    ------
    UnreadableUpload
        It is no ASCII DXF, has units that no survey has, or too many entities.
    """
    with reading_dxf():
        document, unit = open_dxf(data)
        entities = list(document.modelspace().query("POINT INSERT"))
    rows: list[dict[str, Any]] = []
    points: list[tuple[float, float, float]] = []
    faults: list[Fault] = []
    for entity in entities:
        if layer is not None and entity.dxf.layer != layer:
            continue
        place = entity.dxf.get("location" if entity.dxftype() == "POINT" else "insert")
        if place is None:
            faults.append(Fault(len(rows) + 1, "geometry", "no_point", "the entity has no place"))
            place = (np.nan, np.nan, np.nan)
        rows.append(_values(entity))
        points.append((float(place[0]), float(place[1]), float(place[2])))
        if len(rows) > MAX_ROWS:
            raise _damaged("it has too many entities")
    names = tuple(dict.fromkeys(name for row in rows for name in row))[:MAX_COLUMNS]
    xyz = np.array(points, dtype=np.float64).reshape(-1, 3)
    columns = tuple([row.get(name) for row in rows] for name in names)
    return SourceTable("dxf", names, columns, (xyz[:, 0], xyz[:, 1], xyz[:, 2]), unit=unit, faults=Faults(faults))


@contextmanager
def reading_dxf() -> Iterator[None]:
    """Raises UnreadableUpload for what ezdxf raises while it reads a damaged file."""
    try:
        yield
    except (
        DXFError,
        ValueError,
        KeyError,
        IndexError,
        TypeError,
        AttributeError,
        ArithmeticError,
        RecursionError,
    ) as error:
        if isinstance(error, WaymarkError):
            raise
        raise _damaged(f"it cannot be read: {str(error)[:200]}") from error


def open_dxf(data: bytes) -> tuple[Any, str | None]:
    """Document of ezdxf, and its unit; None if it states none.

    Raises
    ------
    UnreadableUpload
        It is no ASCII DXF in UTF-8, or has units that no survey has.
    """
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise _damaged("it is no ASCII DXF in UTF-8") from error
    document = read(io.StringIO(text, newline=None))
    return document, _unit(document.header.get("$INSUNITS", _UNITLESS))


def _unit(code: Any) -> str | None:
    if code == _UNITLESS:
        return None
    if code not in _UNITS:
        raise _damaged(f"its $INSUNITS is {str(code)[:10]}")
    return _UNITS[code]


def _values(entity: Any) -> dict[str, Any]:
    values: dict[str, Any] = {"layer": entity.dxf.layer}
    if entity.dxftype() == "INSERT":
        values["block"] = entity.dxf.name
        values |= {str(attribute.dxf.tag).lower(): attribute.dxf.text for attribute in entity.attribs}
    return values


def _damaged(message: str) -> UnreadableUpload:
    return UnreadableUpload(
        f"the DXF cannot be used: {message}",
        field="file",
        limit=f"ASCII DXF in m or ft, at most {MAX_ROWS} points",
        cure="export the points as DXF R2010",
    )
