"""Surveys as DXF: POINT entities, and INSERTs of blocks with their attributes."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from itertools import islice
from typing import Any

import numpy as np

from app.errors import UnreadableUpload, WaymarkError
from app.formats.surveys.declaration import FEET
from app.formats.surveys.table import MAX_COLUMNS, MAX_ROWS, Detected, Fault, Faults, SourceTable, warn

_UNITS = {
    1: (FEET, 1 / 12), 2: (FEET, 1.0), 3: (FEET, 5280.0), 4: ("m", 0.001), 5: ("m", 0.01), 6: ("m", 1.0),
    7: ("m", 1000.0), 8: (FEET, 1e-6 / 12), 9: (FEET, 0.001 / 12), 10: (FEET, 3.0), 11: ("m", 1e-10), 12: ("m", 1e-9),
    13: ("m", 1e-6), 14: ("m", 0.1), 15: ("m", 10.0), 16: ("m", 100.0), 17: ("m", 1e9), 18: ("m", 149_597_870_700.0),
    19: ("m", 9.4607304725808e15), 20: ("m", 3.0856775814913673e16), 21: ("ft-us", 1.0), 22: ("ft-us", 1 / 12),
    23: ("ft-us", 3.0), 24: ("ft-us", 5280.0),
}  # fmt: skip
"""Unit of length of each code of $INSUNITS, and how many of it one unit of the drawing is. Source: Autodesk DXF
reference, "HEADER section group codes"."""
_NO_SURVEY = (8, 9, 11, 12, 13, 17, 18, 19, 20)  # microinches to parsecs, which are a mistake of the drawing
_UNITLESS = 0
_MAX_IN_BLOCKS = 200_000  # entities of block references, with those that are nested; bounds the time of a file
_MAX_NESTED = 20  # levels of block references
_HEADER_BYTES = 1 << 16  # [byte] in which $DWGCODEPAGE stands
_CODE_PAGE = re.compile(rb"\$DWGCODEPAGE\s+3\s+(\w+)", re.ASCII)
_UNICODE = re.compile(r"\\U\+(00[2-9a-f][0-9a-f]|0[1-9a-f][0-9a-f]{2}|[1-9a-ce-f][0-9a-f]{3})", re.IGNORECASE)
"""Characters that the code page lacks, but for control characters and surrogates. Source: DXF reference, text."""
_SHOWN = 10  # names of layers in a message
_HEAD_BYTES = 4096  # [byte] in which a binary file shows itself


def read_dxf(data: bytes, layer: str | None, unit: str | None = None) -> SourceTable:
    """Points and block references of the model space; their layer, block and attributes are columns.

    A block without attributes that holds several points is a part of the drawing, whose points are read instead.
    What CAD does not draw, on frozen or switched-off layers, is left out.

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
    hidden: set[str] = set()
    with reading_dxf():
        document, found = open_dxf(data, is_declared=unit is not None)
        entities = [
            (entity, on)
            for entity, on in drawn_entities(document, frozenset({"POINT", "INSERT"}), _is_part, hidden)
            if entity.dxftype() == "POINT" or not _is_part(entity, on)
        ]
    rows: list[dict[str, object]] = []
    points: list[tuple[float, float, float]] = []
    faults: list[Fault] = []
    for entity, on in entities:
        if layer is not None and on != layer:
            continue
        place = insertion_point(entity)
        if place is None:
            faults.append(Fault(len(rows) + 1, "geometry", "no_point", "the entity has no place"))
            place = (np.nan, np.nan, np.nan)
        rows.append(_values(entity, on))
        points.append(place)
        if len(rows) > MAX_ROWS:
            raise _damaged("it has too many entities")
    if layer is not None:
        hidden = {name for name in hidden if name.lower() == layer.lower()}
    if hidden:
        message, cure = hidden_layers(hidden), "thaw or switch on layers whose points are wanted, and export again"
        if not rows:
            raise UnreadableUpload(
                f"the DXF has no points that are drawn. {message}",
                field="file",
                limit="points that are drawn",
                cure=cure,
            )
        faults.append(warn(None, "geometry", "hidden_layers", message, cure))
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


def open_dxf(data: bytes, *, is_declared: bool) -> tuple[Any, tuple[str, float] | None]:
    """Document of ezdxf, and the unit of length with how many of it a drawing unit is; None if it states none.

    Parameters
    ----------
    is_declared : bool
        Whether the unit is declared, so that one that no survey has is no error.

    Raises
    ------
    UnreadableUpload
        It is no ASCII DXF, or has units that no survey has.
    """
    from ezdxf.filemanagement import read
    from ezdxf.tools.codepage import toencoding

    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError:
        if b"\x00" in data[:_HEAD_BYTES]:
            raise _damaged("it is no ASCII DXF") from None
        page = _CODE_PAGE.search(data[:_HEADER_BYTES])  # before R2007 texts are in the code page of the system
        text = data.decode(toencoding(page[1].decode()) if page else "cp1252", "replace")
    document = read(io.StringIO(_UNICODE.sub(lambda found: chr(int(found[1], 16)), text), newline=None))
    code = document.header.get("$INSUNITS", _UNITLESS)
    if code == _UNITLESS:
        return document, None
    if code not in _UNITS or (code in _NO_SURVEY and not is_declared):
        raise _damaged(f"its $INSUNITS is {str(code)[:10]}")
    return document, _UNITS[code]


def drawn_entities(
    document: Any, kinds: frozenset[str], is_opened: Callable[[Any, str], bool], hidden: set[str]
) -> Iterator[tuple[Any, str]]:
    """Entities of the model space that CAD draws, each with its layer; those in blocks where their references put them.

    Parameters
    ----------
    kinds : frozenset of str
        Their types; ``INSERT`` gives the block references themselves.
    is_opened : function
        Of a block reference and its layer: whether the entities in its block are wanted, too.
    hidden : set of str
        The names of layers with such entities that are frozen or switched off are added.
    """
    layers = [(str(layer.dxf.name).lower(), layer) for layer in document.layers]
    frozen = {name for name, layer in layers if layer.is_frozen()}
    off = {name for name, layer in layers if layer.is_off()}
    in_blocks = 0

    def count_in_blocks(level: int) -> None:
        nonlocal in_blocks
        in_blocks += 1
        if in_blocks > _MAX_IN_BLOCKS or level > _MAX_NESTED:
            raise _damaged(f"its blocks hold over {_MAX_IN_BLOCKS} entities, or {_MAX_NESTED} levels of blocks")

    def walk(entities: Iterable[Any], layer_of_block: str | None, level: int) -> Iterator[tuple[Any, str]]:
        for entity in entities:
            if level > 0:
                count_in_blocks(level)
            kind, layer = entity.dxftype(), str(entity.dxf.layer)
            if kind not in kinds and kind != "INSERT":
                continue
            if layer == "0" and layer_of_block is not None:
                layer = layer_of_block  # entities on layer 0 of a block are on the layer of its reference
            if layer.lower() in frozen or (layer.lower() in off and kind != "INSERT"):
                hidden.add(layer)
                continue
            if entity.dxf.get("invisible", 0):
                continue
            is_part = kind == "INSERT" and entity.block() is not None and is_opened(entity, layer)
            is_array = kind == "INSERT" and entity.mcount > 1
            for reference in entity.multi_insert() if is_array else (entity,):
                if is_part or is_array:
                    count_in_blocks(level)
                if kind in kinds and layer.lower() not in off:
                    yield reference, layer
                if is_part:
                    _check_scales(reference)
                    yield from walk(reference.virtual_entities(), layer, level + 1)

    for block in document.blocks:
        if not block.is_any_layout:
            _separate_arrays(block, count_in_blocks)
    return walk(document.modelspace(), None, 0)


def _check_scales(reference: Any) -> None:
    """Unequal scales shear the turned blocks in a block; ezdxf would turn and scale them as if they were not turned.

    Raises
    ------
    UnreadableUpload
        A block with unequal scales in x and y holds a reference that is turned.
    """
    scales = [abs(reference.dxf.get(name, 1.0)) for name in ("xscale", "yscale")]
    if max(scales) - min(scales) <= 1e-9 * max(scales):
        return
    turns = [entity.dxf.get("rotation", 0.0) % 180.0 for entity in reference.block() if entity.dxftype() == "INSERT"]
    if any(min(turn, 180.0 - turn) > 1e-9 for turn in turns):
        raise UnreadableUpload(
            f"the block {str(reference.dxf.name)[:80]} is scaled by {scales[0]:g} in x and {scales[1]:g} in y, and "
            "holds blocks that are turned",
            field="file",
            limit="equal scales of blocks that hold turned blocks",
            cure="explode this block reference, and export the drawing again",
        )


def _separate_arrays(block: Any, count: Callable[[int], None]) -> None:
    """Replaces references in rows and columns by one for each of them.

    ezdxf moves, turns and scales the references in a block, but leaves the spacing of their rows and columns as it is.
    """
    for insert in [entity for entity in block if entity.dxftype() == "INSERT" and entity.mcount > 1]:
        for single in insert.multi_insert():
            count(1)
            block.add_entity(single)
        block.delete_entity(insert)


def insertion_point(entity: Any) -> tuple[float, float, float] | None:
    """Where a point, block reference or text is, in world coordinates; None if it has no place.

    Block references and texts in a plane that is seen from below, as mirrored ones are, have coordinates of this plane.
    A text that is not aligned left has its place in its second point; not all programs compute the first one.
    """
    if entity.dxftype() == "POINT":
        place = entity.dxf.get("location")
    else:
        place = entity.dxf.get("insert")
        if entity.dxftype() == "TEXT" and (entity.dxf.get("halign", 0) or entity.dxf.get("valign", 0)):
            place = entity.dxf.get("align_point", place)
        if place is not None and entity.dxftype() != "MTEXT":
            place = entity.ocs().to_wcs(place)
    return None if place is None else (float(place[0]), float(place[1]), float(place[2]))


def hidden_layers(hidden: set[str]) -> str:
    """The warning about layers that are not drawn."""
    names = sorted({name.lower(): name for name in sorted(hidden, reverse=True)}.values())
    shown = ", ".join(names[:_SHOWN]) + (f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else "")
    one = len(names) == 1
    return (
        f"{'The layer' if one else 'The layers'} {shown[:400]} {'is' if one else 'are'} frozen or switched off in the "
        "drawing; what is on "
        f"{'it' if one else 'them'} is left out."
    )


def _is_part(insert: Any, _layer: str) -> bool:
    """Whether a block reference is a part of the drawing, such as a bound external reference, not a surveyed point."""
    return not insert.attribs and _holds_points(insert.block(), 0)


def _holds_points(block: Any, level: int) -> bool:
    """Whether a block holds several points or references, or a reference to one that does."""
    if block is None or level > _MAX_NESTED:
        return False
    first = list(islice((entity for entity in block if entity.dxftype() in ("POINT", "INSERT")), 2))
    if len(first) == 1 and first[0].dxftype() == "INSERT":
        return first[0].mcount > 1 or _holds_points(first[0].block(), level + 1)
    return len(first) > 1


def _values(entity: Any, layer: str) -> dict[str, object]:
    values: dict[str, object] = {"layer": layer}
    if entity.dxftype() == "INSERT":
        values["block"] = entity.dxf.name
        values |= {str(attribute.dxf.tag).lower(): attribute.dxf.text for attribute in entity.attribs}
    return values


def _damaged(message: str) -> UnreadableUpload:
    return UnreadableUpload(
        f"the DXF cannot be used: {message}",
        field="file",
        limit=f"ASCII DXF in metres, feet or their multiples, at most {MAX_ROWS} points",
        cure="export the points as DXF R2010",
    )
