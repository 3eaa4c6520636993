"""Surveys as DXF: POINT entities, and INSERTs of blocks with their attributes."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from app.errors import UnreadableUpload, WaymarkError
from app.formats.surveys.declaration import FEET
from app.formats.surveys.table import MAX_COLUMNS, MAX_ROWS, Detected, Fault, Faults, SourceTable

_UNITS = {
    1: (FEET, 1 / 12),
    2: (FEET, 1.0),
    4: ("m", 0.001),
    5: ("m", 0.01),
    6: ("m", 1.0),
    7: ("m", 1000.0),
    14: ("m", 0.1),
    21: ("ft-us", 1.0),
}
"""Unit of length of each code of $INSUNITS, and how many of it one unit of the drawing is: inches, feet, mm, cm, m, km,
dm, US survey feet. Source: Autodesk DXF reference, "HEADER section group codes"."""
_UNITLESS = 0
_HEAD_BYTES = 4096  # [byte] in which a binary file shows itself


def read_dxf(data: bytes, layer: str | None, unit: str | None = None) -> SourceTable:
    """Points and block references of the model space; their layer, block and attributes are columns.

    Parameters
    ----------
    layer : str, optional
        Only entities on it.
    unit : str, optional
        That of the coordinates where it is declared: many drawings have the $INSUNITS of a template.

    Raises
    ------
    UnreadableUpload
        It is no ASCII DXF, has units that no survey has, or too many entities.
    """
    with reading_dxf():
        document, found = open_dxf(data)
        entities = list(document.modelspace().query("POINT INSERT"))
    rows: list[dict[str, object]] = []
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
    detected: tuple[Detected, ...] = ()
    if found is not None and unit is None:
        unit, count = found
        xyz *= count
        value = unit if count == 1 else f"{count:g} {unit}"
        detected = (Detected("unit of the drawing", value, f"$INSUNITS {document.header['$INSUNITS']}"),)
    columns = tuple([row.get(name) for row in rows] for name in names)
    return SourceTable(
        "dxf", names, columns, (xyz[:, 0], xyz[:, 1], xyz[:, 2]), unit=unit, faults=Faults(faults), detected=detected
    )


@contextmanager
def reading_dxf() -> Iterator[None]:
    """Raises UnreadableUpload for what ezdxf raises while it reads a damaged file."""
    from ezdxf.lldxf.const import DXFError

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


def open_dxf(data: bytes) -> tuple[Any, tuple[str, float] | None]:
    """Document of ezdxf, and the unit of length with how many of it a drawing unit is; None if it states none.

    Raises
    ------
    UnreadableUpload
        It is no ASCII DXF, or has units that no survey has.
    """
    from ezdxf.filemanagement import read

    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError:
        if b"\x00" in data[:_HEAD_BYTES]:
            raise _damaged("it is no ASCII DXF") from None
        text = data.decode("cp1252", "replace")  # before R2007 in the code page of the system; numbers are ASCII
    document = read(io.StringIO(text, newline=None))
    code = document.header.get("$INSUNITS", _UNITLESS)
    if code == _UNITLESS:
        return document, None
    if code not in _UNITS:
        raise _damaged(f"its $INSUNITS is {str(code)[:10]}")
    return document, _UNITS[code]


def _values(entity: Any) -> dict[str, object]:
    values: dict[str, object] = {"layer": entity.dxf.layer}
    if entity.dxftype() == "INSERT":
        values["block"] = entity.dxf.name
        values |= {str(attribute.dxf.tag).lower(): attribute.dxf.text for attribute in entity.attribs}
    return values


def _damaged(message: str) -> UnreadableUpload:
    return UnreadableUpload(
        f"the DXF cannot be used: {message}",
        field="file",
        limit=f"ASCII DXF in metres, millimetres or feet, at most {MAX_ROWS} points",
        cure="export the points as DXF R2010",
    )
