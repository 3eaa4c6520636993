"""Surveys as delimited text: with a header somewhere in the first lines, or with columns by position."""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, islice
from typing import NamedTuple

from app.errors import InvalidParameter, UnreadableUpload
from app.formats.surveys.coordinates import share_inside
from app.formats.surveys.declaration import FEET, FIXED_LAYOUTS, ImportDeclaration
from app.formats.surveys.roles import is_unit, names_coordinates
from app.formats.surveys.table import (
    MAX_COLUMNS,
    MAX_ROWS,
    Detected,
    Fault,
    Faults,
    NumberForm,
    SourceTable,
    Texts,
    detect_number_form,
    read_numbers,
)
from app.formats.text import SPACES, as_utf8, detect_delimiter, repeated_names, split_rows
from app.geodesy import reference_system
from app.geodesy.systems import HeightSystem

# === Where the rows of delimited text begin, and what their columns are: by a header, or by position.


_NUMERIC = re.compile(r"[+-]?[0-9][0-9.,' \u00a0\u2009\u202f]*")
_MAX_NUMBER = 40  # [character] longest cell that is a number; a float64 needs 24
_MIN_SHARE = 0.9  # [1] of the first rows that must be numbers, or lie in the area of use
_MIN_ROWS = 2  # columns cannot be identified by the position of one row alone
_COORDINATES = ("lon_deg", "lat_deg", "easting", "northing")


@dataclass(slots=True)
class Header:
    """Names of the columns, and where the rows begin."""

    names: tuple[str, ...]
    start: int  # index of the first row of data
    last_takes_rest: bool = False  # whether further cells of a row belong to the last column, a description
    min_width: int = 0  # cells that a row of such a table must have
    units: tuple[str, ...] = ()  # of a row of units, one a name
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
    below = rows[header.start] if header.start < len(rows) else ()
    if sum(map(is_unit, below)) >= 2 and not any(map(_is_number, below)):
        header.start += 1
        header.units = tuple(cell.strip() for cell in rows[header.start - 1])
        cells = " ".join(filter(None, header.units))
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
    return share_inside(east, north, declaration) >= _MIN_SHARE


def _form(rows: Sequence[Sequence[str]], places: tuple[int, int], declaration: ImportDeclaration) -> NumberForm:
    cells: Iterator[str] = (row[place] for row in rows for place in places if len(row) > place)
    return detect_number_form(cells, declaration.decimal)[0]


def _no_header(why: str) -> UnreadableUpload:
    return UnreadableUpload(
        "the first row holds numbers where the columns' names belong" + (f"; {why}" if why else ""),
        field="file",
        limit="a header",
        cure=f"add a header, or declare layout: {', '.join(FIXED_LAYOUTS)}",
    )


# === Surveys as delimited text.


_DELIMITERS = (";", "\t", "|", ",")
_DELIMITER_NAMES = {"\t": "tab", SPACES: "blanks"}
_COMMENTS = ("#", "//")
_COMMENT_LINE = re.compile(rb"^[ \t]*(?:#|//)", re.MULTILINE)
_SAMPLE_LINES = 50  # lines by which the delimiter and the header are detected
_BATCH = 10_000  # rows at a time
_DECIMAL_COMMA = re.compile(r"[+-]?[0-9]['\u20190-9]*,[0-9]+")  # also with apostrophes between groups of digits


class _Lines:
    """Lines of a file without its comments; counts the lines that were read."""

    def __init__(self, data: bytes, *, keep_ends: bool) -> None:
        self._text = io.TextIOWrapper(io.BytesIO(data), encoding="utf-8", newline="" if keep_ends else None)
        self._has_comments = _COMMENT_LINE.search(data) is not None
        self.number = 0
        self.comments = 0
        self.first_comments: list[str] = []

    def __iter__(self) -> Iterator[str]:
        quoted = False
        for number, line in enumerate(self._text, 1):
            self.number = number
            if self._has_comments and not quoted and line.lstrip().startswith(_COMMENTS):
                self.comments += 1
                if self.comments <= _SAMPLE_LINES:
                    self.first_comments.append(line.strip())
                continue
            quoted ^= self._has_comments and line.count('"') % 2 == 1
            yield line


def read_csv(data: bytes, declaration: ImportDeclaration) -> SourceTable:
    """Rows of delimited text.

    Raises
    ------
    UnreadableUpload
        It is no text, holds NUL or fields without end, names one column twice, or has too many.
    InvalidParameter
        It has no header, and its columns cannot be identified by position.
    """
    utf8, encoding = as_utf8(data, declaration.encoding)
    detected: list[Detected] = []
    if declaration.encoding is None:
        detected.append(Detected("encoding", encoding, "byte order mark, or which bytes occur"))
    delimiter = declaration.delimiter or _detect_delimiter(utf8, declaration)
    if declaration.delimiter is None:
        evidence = f"splits most of the first {_SAMPLE_LINES} lines into equally many cells"
        detected.append(Detected("delimiter", _DELIMITER_NAMES.get(delimiter, delimiter), evidence))
    lines = _Lines(utf8, keep_ends=delimiter != SPACES)
    rows = split_rows(lines, delimiter)
    head: list[list[str]] = []
    numbers: list[int] = []
    for row in islice(rows, _SAMPLE_LINES):
        head.append(row)
        numbers.append(lines.number)
    comments = [next(split_rows([line.lstrip("#/ \t")], delimiter), []) for line in lines.first_comments]
    if not head:
        raise UnreadableUpload("the file has no rows", field="file", limit="at least one row", cure="send the survey")
    header = find_header(head, comments, declaration)
    _check_names(header.names)
    detected += header.detected
    if header.start < len(numbers) and numbers[header.start] > 2:
        detected.append(Detected("first row", f"line {numbers[header.start]}", "the lines before it are not rows"))
    table = _columns(header, chain(head[header.start :], rows), delimiter)
    if lines.comments:
        value = f"{lines.comments} lines left out"
        detected.append(Detected("comments", value, f"they begin with {' or '.join(_COMMENTS)}"))
    source = SourceTable(
        "csv", header.names, table, faults=header.faults, detected=tuple(detected),
        has_names=not header.last_takes_rest, units=header.units,
    )  # fmt: skip
    return _with_own_points(source, declaration)


_OWN_POINTS = ("x", "y", "z_m")
_OWN_SYSTEM = ("geometry_crs", "geometry_vertical_datum")


def _with_own_points(source: SourceTable, declaration: ImportDeclaration) -> SourceTable:
    """The points of a CSV that was exported with `crs` (`app.formats.exports.write_csv`): x is the easting or the
    longitude, and the columns state the system; `lon_deg`, `lat_deg` and `height_m` are those of the registry.
    """
    is_declared = any(role in declaration.columns for role in (*_COORDINATES, "height")) or declaration.decimal == ","
    if is_declared or not set(source.names).issuperset((*_OWN_POINTS, *_OWN_SYSTEM)):
        return source
    columns = dict(zip(source.names, source.columns, strict=True))
    stated = [{cell for cell in columns[name] if cell} for name in _OWN_SYSTEM]
    if any(len(values) > 1 for values in stated):
        raise InvalidParameter(
            f"the rows are in several systems: {', '.join(sorted(stated[0] | stated[1])[:4])}"[:200],
            field="file",
            limit="one CRS and one vertical datum a file",
            cure="export with crs and vertical_datum",
        )
    read = [read_numbers(columns[name], name, required=name != "z_m") for name in _OWN_POINTS]
    source.faults.add(fault for _values, faults in read for fault in faults)
    crs, datum = (next(iter(values), None) for values in stated)
    detected = Detected("coordinates", "the columns x, y and z_m", "the columns geometry_* state their system")
    return replace(
        source,
        points=(read[0][0], read[1][0], read[2][0]),
        crs=crs,
        heights=HeightSystem(datum, datum, 1.0) if datum else None,
        detected=(*source.detected, detected),
    )


def _detect_delimiter(utf8: bytes, declaration: ImportDeclaration) -> str:
    """The delimiter that the first lines show."""
    sample = list(islice(_Lines(utf8, keep_ends=False), _SAMPLE_LINES))
    found = detect_delimiter(sample, _DELIMITERS)
    if found == "," and declaration.decimal != ".":
        filled = [line for line in sample if line.strip()]
        if 2 * sum(map(_has_decimal_commas, filled)) > len(filled):
            return SPACES
    return found


def _has_decimal_commas(line: str) -> bool:
    """Whether a line has two numbers with decimal commas between blanks, and no other commas before the last one."""
    words = line.split()
    numbers = [_DECIMAL_COMMA.fullmatch(word) is not None for word in words]
    last = max((k for k, is_number in enumerate(numbers) if is_number), default=0)
    return sum(numbers) >= 2 and all(numbers[k] or "," not in word for k, word in enumerate(words[:last]))


def _check_names(names: tuple[str, ...]) -> None:
    repeated = repeated_names(names, str.lower)
    if repeated:
        raise UnreadableUpload(
            f"two columns are named {repeated[0][:40]!r}",
            field="file",
            limit="each name once",
            cure="rename one of them",
        )
    if len(names) > MAX_COLUMNS:
        raise UnreadableUpload(
            f"the file has {len(names)} columns", field="file", limit=f"{MAX_COLUMNS} columns", cure="leave some out"
        )


def _columns(header: Header, rows: Iterable[list[str]], delimiter: str) -> tuple[Texts, ...]:
    columns = tuple(Texts() for _ in header.names)
    width, glue = len(header.names), " " if delimiter == SPACES else delimiter
    for start, batch in _batches(iter(rows)):
        for k, row in enumerate(batch):
            if len(row) == width:
                continue
            if len(row) > width and not any(row[width:]):
                batch[k] = row[:width]  # delimiters at the end of the line
            elif header.last_takes_rest and len(row) > width:
                batch[k] = [*row[: width - 1], glue.join(row[width - 1 :])]
            elif header.last_takes_rest and len(row) >= header.min_width:
                batch[k] = row + [""] * (width - len(row))
            else:
                header.faults.add([_ragged(start + k + 1, len(row), width)])
                batch[k] = [""] * width
        for column, cells in zip(columns, zip(*batch, strict=True), strict=True):
            column.extend(cells)
    return columns


def _batches(rows: Iterator[list[str]]) -> Iterator[tuple[int, list[list[str]]]]:
    start = 0
    while batch := list(islice(rows, _BATCH)):
        if start + len(batch) > MAX_ROWS:
            raise UnreadableUpload(
                f"the file has more than {MAX_ROWS} rows", field="file", limit=f"{MAX_ROWS} rows", cure="cut it"
            )
        yield start, batch
        start += len(batch)


def _ragged(number: int, count: int, width: int) -> Fault:
    cure = "quote texts that hold the delimiter; numbers with decimal commas need another delimiter"
    return Fault(number, "row", "ragged_row", f"the row has {count} fields, the header {width}", cure)


# === Surveys as Leica GSI: lines of words with 8 or 16 characters of data.
#
# Source: Leica Geosystems, GSI Online for TPS and DNA, "GSI data format".


_WORD = re.compile(r"([0-9]{2})([0-9.]{4}|[0-9.]{2,3}[^+\-]{1,2})([+-])(\S{16}|\S{8})(?=\s|$)")
_POINT, _REMARK = "11", "71"
_TARGET = {"81": "easting", "82": "northing", "83": "height"}
_STATION = {"84": "easting", "85": "northing", "86": "height"}
_UNITS = {"0": ("m", 3), "1": (FEET, 3), "6": ("m", 4), "7": (FEET, 4), "8": ("m", 5)}
"""Unit of a length and its decimals, by the sixth character of a word."""
_NAMES = ("point", "easting", "northing", "height", "description")
_CURE = "export the points with their coordinates (word indices 11, 81, 82, 83)"


class _Line(NamedTuple):
    number: int
    words: dict[str, tuple[str, str, str]]  # index to unit, sign and data


def read_gsi(data: bytes, declaration: ImportDeclaration) -> SourceTable:
    """Points with coordinates; the stations only in a file without any other points.

    Raises
    ------
    UnreadableUpload
        It is no GSI, has no coordinates, or lengths in metres and feet.
    """
    utf8, _encoding = as_utf8(data, declaration.encoding)
    lines = list(_lines(utf8.decode()))
    targets = [line for line in lines if _TARGET.keys() & line.words.keys() >= {"81", "82"}]
    stations = [line for line in lines if _STATION.keys() & line.words.keys() >= {"84", "85"}]
    chosen, indices = (targets, _TARGET) if targets else (stations, _STATION)
    if not chosen:
        raise UnreadableUpload("the GSI has no coordinates", field="file", limit="words 81 and 82", cure=_CURE)
    units = {
        _UNITS.get(line.words[index][0], ("", 0))[0] for line in chosen for index in indices if index in line.words
    }
    if len(units) != 1 or "" in units:
        raise UnreadableUpload(
            "the coordinates of the GSI are in several units, or in one that lengths do not have",
            field="file",
            limit="metres or feet",
            cure=_CURE,
        )
    columns: dict[str, list[str | float | None]] = {name: [] for name in _NAMES}
    faults = Faults()
    for row, line in enumerate(chosen, 1):
        columns["point"].append(_text(line, _POINT))
        columns["description"].append(_text(line, _REMARK))
        for index, name in indices.items():
            value = _length(line, index)
            if value is None and not _is_missing(line, index):
                message = f"line {line.number}: word {index} holds no number"
                faults.add([Fault(row, name, "not_a_number", message, "export the points again")])
            columns[name].append(value)
    detected = [Detected("words", "GSI-16" if b"*" in utf8[:2] else "GSI-8", "the length of the words")]
    if targets and stations:
        left_out = f"{len(stations)} lines left out"
        detected.append(Detected("stations", left_out, "they have the words 84 and 85 of an instrument's place"))
    if left := len(lines) - len(targets) - len(stations):
        detected.append(Detected("other lines", f"{left} left out", "codes and measurements without coordinates"))
    table = tuple(columns[name] for name in _NAMES)
    return SourceTable("gsi", _NAMES, table, unit=units.pop(), faults=faults, detected=tuple(detected))


def _lines(text: str) -> Iterator[_Line]:
    for number, line in enumerate(text.splitlines(), 1):
        words = {index: (info[-1], sign, body) for index, info, sign, body in _WORD.findall(line.lstrip("*"))}
        if number > MAX_ROWS:
            raise UnreadableUpload("too many lines", field="file", limit=f"{MAX_ROWS} lines", cure="cut the file")
        if line.strip() and not words:
            raise UnreadableUpload(
                f"line {number} is no line of GSI", field="file", limit="words of 8 or 16 characters", cure=_CURE
            )
        if words:
            yield _Line(number, words)


def _text(line: _Line, index: str) -> str:
    """Data of a word without the zeros that fill it."""
    return line.words[index][2].lstrip("0") or "0" if index in line.words else ""


def _is_missing(line: _Line, index: str) -> bool:
    """Whether there is no such word, or one without a value, which instruments write as dashes."""
    return index not in line.words or (line.words[index][2].strip("0-") == "" and "-" in line.words[index][2])


def _length(line: _Line, index: str) -> float | None:
    if index not in line.words:
        return None
    unit, sign, body = line.words[index]
    if not (body.isascii() and body.isdigit()):
        return None
    return float(int(sign + body) / 10 ** _UNITS[unit][1])
