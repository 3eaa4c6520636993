"""Where the rows of delimited text begin, and what their columns are: by a header, or by position."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from app.errors import InvalidParameter, UnreadableUpload
from app.formats.surveys.cells import NumberForm, detect_number_form, read_numbers
from app.formats.surveys.declaration import FIXED_LAYOUTS, ImportDeclaration
from app.formats.surveys.grids import unit_factor, without_zone
from app.formats.surveys.roles import names_coordinates
from app.formats.surveys.table import Detected, Faults, Floats
from app.geodesy import normalize_crs, reference_system
from app.geodesy.systems import best_effort, covers

_NUMERIC = re.compile(r"[+-]?[0-9][0-9.,' \u00a0\u2009\u202f]*")
_MAX_NUMBER = 40  # [character] longest cell that is a number; a float64 needs 24. Chosen by hand
_UNIT = re.compile(r"\s*[\[(]?(?:m|metres?|meters?|ft|us-?ft|usft|sft|feet|deg|degrees|°)[\])]?\s*", re.IGNORECASE)
_MIN_SHARE = 0.9  # [1] of the first rows that must be numbers, or lie in the area of use; chosen by hand
_MIN_ROWS = 2  # columns cannot be identified by the position of one row alone
_COORDINATES = ("lon_deg", "lat_deg", "easting", "northing")


@dataclass(slots=True)
class Header:
    """Names of the columns, and where the rows begin.

    Attributes
    ----------
    names : tuple of str
    start : int
        Index of the first row of data.
    last_takes_rest : bool
        Whether further cells of a row belong to the last column, a description.
    min_width : int
        Cells that a row of such a table must have.
    """

    names: tuple[str, ...]
    start: int
    last_takes_rest: bool = False
    min_width: int = 0
    detected: list[Detected] = field(default_factory=list)
    faults: Faults = field(default_factory=Faults)


def find_header(
    rows: Sequence[Sequence[str]], comments: Sequence[Sequence[str]], declaration: ImportDeclaration
) -> Header:
    """The header among the first rows of a file, or the columns by position.

    Parameters
    ----------
    rows : sequence of sequences of str
        Cells of the first rows, at least one.
    comments : sequence of sequences of str
        Cells of the first comments, which may hold the header.
    declaration : ImportDeclaration

    Raises
    ------
    UnreadableUpload
        The file has no header, and no order of its columns lies in the area of use of the CRS.
    InvalidParameter
        Several orders do.
    """
    if declaration.layout in FIXED_LAYOUTS:
        names = FIXED_LAYOUTS[declaration.layout]
        return _fixed(
            _renamed(names, declaration), _first_numeric(rows, min(names.index("easting"), names.index("northing")))
        )
    for index, row in enumerate(rows):
        if _is_header(row, declaration):
            return _named(rows, row, index)
    if declaration.layout == "named" or not _first_is_data(rows):
        first = rows[0]
        if any(_is_number(name) for name in first):
            raise _no_header("")
        return _named(rows, first, 0)
    start = _first_data(rows)
    if start and len(rows[start - 1]) == len(rows[start]) and not any(map(_is_number, rows[start - 1])):
        return _named(rows, rows[start - 1], start - 1)  # a header with other names, which the error will list
    for cells in comments:
        if _is_header(cells, declaration) and len(cells) == len(rows[start]):
            header = _named(rows, cells, start - 1)
            header.detected.append(Detected("header", "in a comment", "it names the coordinates"))
            return header
    return _by_position(rows, declaration)


def _is_number(cell: str) -> bool:
    text = cell.strip()
    return len(text) <= _MAX_NUMBER and _NUMERIC.fullmatch(text) is not None


def _is_header(row: Sequence[str], declaration: ImportDeclaration) -> bool:
    names = [name.strip() for name in row]
    wanted = [name for role, name in declaration.columns.items() if name and role in _COORDINATES]
    if len(wanted) == 2:
        return all(name in names for name in wanted)
    return names_coordinates(names) and not any(_is_number(name) for name in names)


def _named(rows: Sequence[Sequence[str]], names: Sequence[str], index: int) -> Header:
    header = Header(tuple(name.strip() for name in names), index + 1)
    widths = {len(row) for row in rows[header.start :]}
    width = max(widths, default=len(names))
    if width < len(names) and names_coordinates(header.names[:width]):
        header.detected.append(
            Detected(
                "header", f"{width} names", f"the rows have {width} cells; {header.names[width][:40]!r} is no column"
            )
        )
        header.names = header.names[:width]
    if header.start < len(rows) and sum(1 for cell in rows[header.start] if _UNIT.fullmatch(cell)) >= 2:
        header.start += 1
        cells = " ".join(cell.strip() for cell in rows[header.start - 1] if cell.strip())
        header.detected.append(Detected("row of units", cells[:60], "it follows the header and is not a row of data"))
    return header


def _renamed(names: tuple[str, ...], declaration: ImportDeclaration) -> tuple[str, ...]:
    """The columns of a layout; longitude and latitude where the declared CRS is geographic."""
    if declaration.crs is None or reference_system(declaration.crs).is_projected:
        return names
    degrees = {"easting": "lon_deg", "northing": "lat_deg"}
    return tuple(degrees.get(name, name) for name in names)


def _fixed(names: tuple[str, ...], start: int) -> Header:
    """Columns by position; heights and descriptions may be left out."""
    return Header(names, start, last_takes_rest=True, min_width=2 + ("point" in names))


def _first_numeric(rows: Sequence[Sequence[str]], column: int) -> int:
    """Index of the first row with numbers in this column and the next; 0 if there is none."""
    for index, row in enumerate(rows):
        pair = row[column : column + 2]
        if len(pair) == 2 and all(map(_is_number, pair)):
            return index
    return 0


def _first_data(rows: Sequence[Sequence[str]]) -> int:
    """Index of the first row with two numbers; there is one."""
    return next(k for k, row in enumerate(rows) if sum(1 for cell in row if _is_number(cell)) >= 2)


def _first_is_data(rows: Sequence[Sequence[str]]) -> bool:
    """Whether the first lines are rows of numbers, after lines that are not."""
    numeric = [sum(1 for cell in row if _is_number(cell)) >= 2 for row in rows]
    return any(numeric) and sum(numeric) >= _MIN_SHARE * len(numeric[numeric.index(True) :])


# --- by position ----------------------------------------------------------------------------------------------------


def _by_position(rows: Sequence[Sequence[str]], declaration: ImportDeclaration) -> Header:
    """The one order of the columns with which the rows lie in the declared area and the area of use of the CRS."""
    if declaration.crs is None:
        raise _no_header("no CRS is declared by which the columns could be identified")
    start = _first_data(rows)
    body = rows[start:]
    found = [name for name in FIXED_LAYOUTS if _fits(body, FIXED_LAYOUTS[name], declaration)]
    area = "the declared area" if declaration.area_deg is not None else f"the area of use of {declaration.crs}"
    if not found:
        raise _no_header(f"with no order of the columns do the rows lie in {area}")
    if len(found) > 1 or len(body) < _MIN_ROWS:
        raise InvalidParameter(
            f"the file has no header, and its rows lie in {area} as {' and as '.join(found)}",
            field="layout",
            limit=", ".join(FIXED_LAYOUTS),
            cure="declare layout, or area_deg if the order of the axes is the question",
        )
    names = FIXED_LAYOUTS[found[0]]
    at = names.index("height")
    has_height = any(len(row) > at and row[at].strip() for row in body)
    if has_height and not _is_numeric(body, at):
        names = tuple(name for name in names if name != "height")
    header = _fixed(_renamed(names, declaration), start)
    evidence = f"no header; only with this order of the columns do the rows lie in {area}"
    header.detected.append(Detected("layout", found[0], evidence))
    return header


def _is_numeric(rows: Sequence[Sequence[str]], column: int) -> bool:
    filled = [row[column] for row in rows if len(row) > column and row[column].strip()]
    return sum(1 for cell in filled if _is_number(cell)) >= _MIN_SHARE * len(rows) > 0


def _fits(rows: Sequence[Sequence[str]], names: tuple[str, ...], declaration: ImportDeclaration) -> bool:
    """Whether most rows lie in the declared area, or the CRS's area of use, with these columns."""
    places = names.index("easting"), names.index("northing")
    if not all(_is_numeric(rows, place) for place in places):
        return False
    form = _form(rows, places, declaration)
    cells = [[row[place] if len(row) > place else "" for row in rows] for place in places]
    east, north = (read_numbers(column, "layout", form=form, required=True)[0] for column in cells)
    return _inside(east, north, declaration) >= _MIN_SHARE


def _form(rows: Sequence[Sequence[str]], places: tuple[int, int], declaration: ImportDeclaration) -> NumberForm:
    cells: Iterator[str] = (row[place] for row in rows for place in places if len(row) > place)
    return detect_number_form(cells, declaration.decimal)[0]


def _inside(east: Floats, north: Floats, declaration: ImportDeclaration) -> float:
    """Share of the positions that lie in the declared area, or the area of use of the CRS."""
    name = normalize_crs(declaration.crs)
    system = reference_system(name)
    factor = unit_factor(declaration.unit, system)
    east, _zone = without_zone(east * factor, system)
    lon, lat = (np.asarray(v) for v in best_effort(name).transform(east, north * factor))
    with np.errstate(invalid="ignore"):
        inside = np.isfinite(lon) & np.isfinite(lat) & (np.abs(lat) <= 90) & covers(system.area_of_use, lon, lat)
        if declaration.area_deg is not None:
            west, south, east_deg, north_deg = declaration.area_deg
            inside &= (lon >= west) & (lon <= east_deg) & (lat >= south) & (lat <= north_deg)
    return float(inside.mean())


def _no_header(why: str) -> UnreadableUpload:
    return UnreadableUpload(
        "the first row holds numbers where the columns' names belong" + (f"; {why}" if why else ""),
        field="file",
        limit="a header",
        cure=f"add a header, or declare layout: {', '.join(FIXED_LAYOUTS)}",
    )
