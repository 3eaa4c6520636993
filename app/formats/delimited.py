"""Delimited text (CSV and its kin): delimiter, quotes, decimal sign, header, rows, numbers.

Rows are read in one of three ways, by what a kind of file needs:

- `DelimitedLog`: line by line; a line that cannot be split costs only itself (packet logs, tracks).
- `split_rows`: as RFC 4180 has it, where a quoted cell may span lines (surveys).
- `read_numbers_by_block`: columns of numbers, megabytes at a time (traces).
"""

from __future__ import annotations

import csv
import io
import math
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.errors import UnreadableUpload
from app.formats.columns import match_columns
from app.formats.text import MAX_LINE, MAX_NAME, numbered_lines

Floats = npt.NDArray[np.float64]

SPACES = "space"
"""The delimiter of rows whose cells are separated by any number of spaces and tabs."""
MAX_CELL = 10_000
"""Longest cell of `split_rows`. [character] Chosen by hand; no measurement kept."""
_LOG_DELIMITERS = (",", ";", "\t", "|")
_MAX_LOG_COLUMNS = 256  # chosen by hand
_MAX_HEADER = 1 << 16  # [character] of a log; chosen by hand
_MAX_NUMBER = 40  # [character] a float64 needs at most 24; chosen by hand
_MAX_BLOCK_LINE = 1 << 20  # [byte] longest line of `read_numbers_by_block`; chosen by hand
_MAX_JSON_NUMBER = 1e300  # [1] an integer of JSON may be too large for a float; chosen by hand
_MISSING = frozenset(("", "nan", "null", "none", "-", "n/a", "na"))
_NUMERIC = b"0123456789+-.eEnaNifI \r\n"
_NUMPY_CALL = b"np.float"  # numpy 2 writes its scalars as np.float64(1.5); the closing bracket is in `removed`


@dataclass(frozen=True, slots=True)
class Dialect:
    """How the cells of a row are written.

    Attributes
    ----------
    delimiter : str
        One character, or `SPACES`.
    decimal : str
        ``.`` or ``,``.
    removed : bytes
        Characters that columns of numbers are read without: quotes, brackets.
    """

    delimiter: str = ","
    decimal: str = "."
    removed: bytes = b'"'


# --- delimiter and header -----------------------------------------------------------------------------------------


def detect_dialect(header: str) -> Dialect:
    """Dialect by the header alone: the delimiter that is most frequent, decimal commas unless it is a comma."""
    delimiter = max(_LOG_DELIMITERS, key=header.count)
    return Dialect(delimiter, "." if delimiter == "," else ",")


def detect_delimiter(lines: Iterable[str], candidates: Sequence[str]) -> str:
    """The candidate that splits most of the lines into the same number of cells; `SPACES` if none occurs."""
    filled = [line for line in lines if line.strip()]
    best, score = SPACES, 0
    for mark in candidates:
        ((count, agreeing),) = Counter(line.count(mark) for line in filled).most_common(1) or [(0, 0)]
        if count and agreeing > score:
            best, score = mark, agreeing
    return best


def split_header(line: str, delimiter: str) -> list[str]:
    """Names of the columns; none if quotes do not match."""
    try:
        return [name.strip() for name in next(csv.reader([line], delimiter=delimiter), [])]
    except csv.Error:
        return []


def parse_number(text: str, decimal: str = ".") -> float:
    """A number as it is written, also an infinite one; NaN where the cell is empty.

    Raises
    ------
    ValueError
        The text is no number.
    """
    text = text.strip()
    if not text:
        return math.nan
    if "_" in text:
        raise ValueError("not a number")
    return float(text.replace(",", ".") if decimal == "," else text)


def read_number(value: object, decimal: str = ".") -> float:
    """A finite number from a cell or a JSON value; NaN where it is empty or a word for a missing value.

    Raises
    ------
    ValueError
        Text that is no number, or a number that is not finite.
    """
    if value is None or value == "":
        return math.nan
    if isinstance(value, str):
        if value.strip().lower() in _MISSING:
            return math.nan
        if len(value.strip()) > _MAX_NUMBER:
            raise ValueError("not a number")
        number = parse_number(value, decimal)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        number = float(value) if abs(value) < _MAX_JSON_NUMBER else math.inf
    else:
        raise ValueError("not a number")
    if not math.isfinite(number):
        raise ValueError("not a finite number")
    return number


# --- line by line -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class DelimitedLog:
    """A log with a header, read line by line.

    Attributes
    ----------
    columns : tuple of str
        Names as written; empty if the header cannot be split.
    dialect : Dialect
    text : str
        All of the file, or its beginning where only the header is wanted.
    """

    columns: tuple[str, ...]
    dialect: Dialect
    text: str

    @classmethod
    def open(cls, text: str) -> DelimitedLog:
        """A log whose first line that is not empty is the header."""
        _number, header = next(numbered_lines(text), (0, ""))
        header = header[:_MAX_HEADER]
        dialect = detect_dialect(header)
        names = split_header(header.lstrip("#").strip(), dialect.delimiter)
        return cls(tuple(name[:MAX_NAME] for name in names[:_MAX_LOG_COLUMNS]), dialect, text)

    def places(self, aliases: Mapping[str, Sequence[str]], declared: Mapping[str, str]) -> dict[str, int]:
        """Index of each quantity's column: see `match_columns`."""
        return match_columns(self.columns, aliases, declared)

    def rows(self) -> Iterator[list[str] | None]:
        """Cells of each row after the header; None where a row has another number of cells or cannot be split."""
        lines = numbered_lines(self.text)
        next(lines, None)
        for _number, line in lines:
            yield self._cells(line) if len(line) <= MAX_LINE else None

    def _cells(self, line: str) -> list[str] | None:
        delimiter = self.dialect.delimiter
        if '"' not in line:
            cells = line.split(delimiter)
        elif "\0" in line:
            return None
        else:
            try:
                cells = next(csv.reader([line], delimiter=delimiter, strict=True), [])
            except csv.Error:
                return None
        return cells if len(cells) == len(self.columns) else None

    def bad_row(self) -> str:
        """Why `rows` returns None."""
        return f"the row does not have {len(self.columns)} cells that can be read"


# --- RFC 4180 -----------------------------------------------------------------------------------------------------


def split_rows(lines: Iterable[str], delimiter: str) -> Iterator[list[str]]:
    """Cells of each row that is not empty; quoted cells may span lines.

    Parameters
    ----------
    lines : iterable of str
        With their line ends.
    delimiter : str

    Raises
    ------
    UnreadableUpload
        A quote is not closed, or a cell is too long.
    """
    if delimiter == SPACES:
        yield from (cells for line in lines if (cells := line.split()))
        return
    csv.field_size_limit(MAX_CELL)
    reader = csv.reader(lines, delimiter=delimiter, strict=True)
    try:
        for row in reader:
            if row and any(row):
                yield row
    except csv.Error as error:
        raise UnreadableUpload(
            f"line {reader.line_num} is no row of delimited text: {error}",
            field="file",
            limit=f"fields of at most {MAX_CELL} characters, quotes closed",
            cure="write it as CSV (RFC 4180)",
        ) from error


# --- columns of numbers -------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class NumberColumns:
    """Columns of numbers that are read from a file.

    Attributes
    ----------
    name : str
        Of the file, for messages.
    places : tuple of int
        Indices of the wanted cells, in the order of the result.
    width : int
        Cells of a row.
    dialect : Dialect
    convert_first : callable, optional
        Reads the first wanted cell from text that is no number.
    """

    name: str
    places: tuple[int, ...]
    width: int
    dialect: Dialect = Dialect()
    convert_first: Callable[[str], float] | None = None


LeaveOut = Callable[[str, str], None]
"""Takes the kind and the reason of a row that is left out: `rows-malformed` or `row-cut-short`."""


def read_numbers_by_block(blocks: Iterable[bytes], columns: NumberColumns, leave_out: LeaveOut) -> Iterator[Floats]:
    """Numbers of the rows after the header, in blocks of shape (rows, len(columns.places)).

    A block whose cells are all numbers is parsed by numpy; only a block with anything else in it is read cell by cell.

    Parameters
    ----------
    blocks : iterable of bytes
        The file in pieces of any size.
    columns : NumberColumns
    leave_out : callable
        Called for each malformed row.

    Raises
    ------
    UnreadableUpload
        A line does not end, or cannot be read as CSV at all.
    """
    line = 2
    for block in _whole_lines(columns.name, blocks, leave_out):
        values = None if columns.convert_first else _parse_block(block, columns.width, columns.dialect)
        yield _parse_cells(line, block, columns, leave_out) if values is None else values[:, list(columns.places)]
        line += block.count(b"\n")


def _whole_lines(name: str, blocks: Iterable[bytes], leave_out: LeaveOut) -> Iterator[bytes]:
    """Blocks of whole lines after the header; a last line that does not end may be cut within a number."""
    rest, in_header = b"", True
    for block in blocks:
        rest += block
        if in_header:
            if b"\n" not in rest:
                if len(rest) > _MAX_BLOCK_LINE:
                    break
                continue
            rest, in_header = rest.split(b"\n", 1)[1], False
        end = rest.rfind(b"\n") + 1
        if not end and len(rest) > _MAX_BLOCK_LINE:
            raise UnreadableUpload(f"a line of {name} does not end", field=name, limit=f"{_MAX_BLOCK_LINE} bytes")
        if end:
            yield rest[:end]
            rest = rest[end:]
    if not in_header and rest.strip():
        leave_out("row-cut-short", "the last line does not end: it may be cut within a number")


def _parse_block(block: bytes, width: int, dialect: Dialect) -> Floats | None:
    """All cells of a block; None if any cell is empty or no number, or a row has another width."""
    block = _without_calls(block).translate(None, dialect.removed)
    delimiter = dialect.delimiter.encode()
    count = block.count(b"\n")
    if block.count(delimiter) != count * (width - 1) or block.translate(None, _NUMERIC + b"," + delimiter):
        return None
    if dialect.decimal == ",":
        block = block.replace(b",", b".")
    empty_cells = (delimiter * 2, delimiter + b"\n", delimiter + b"\r", b"\n" + delimiter)
    if any(empty in b"\n" + block for empty in empty_cells) or not _rows_have(block, delimiter, width):
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            values = np.fromstring(block.replace(delimiter, b" ").decode("ascii"), sep=" ")
        except ValueError:
            return None
    return values.reshape(count, width) if values.size == count * width else None


def _without_calls(block: bytes) -> bytes:
    if _NUMPY_CALL in block:
        block = block.replace(b"np.float64(", b"").replace(b"np.float32(", b"")
    return block


def _rows_have(block: bytes, delimiter: bytes, width: int) -> bool:
    """Whether every line of a block has `width` cells."""
    marks = np.frombuffer(block, np.uint8)
    line_ends = np.flatnonzero(marks == ord("\n"))
    delimiters_before = np.searchsorted(np.flatnonzero(marks == delimiter[0]), line_ends)
    return bool((np.diff(delimiters_before, prepend=0) == width - 1).all())


def _parse_cells(line: int, block: bytes, columns: NumberColumns, leave_out: LeaveOut) -> Floats:
    """Cell by cell: empty cells are NaN, rows of another width or with other text in them are left out."""
    dialect, width = columns.dialect, columns.width
    text = io.StringIO(
        _without_calls(block).replace(b"\0", b"?").translate(None, dialect.removed).decode("utf-8", "replace")
    )
    reader = csv.reader(text, delimiter=dialect.delimiter, quoting=csv.QUOTE_NONE)
    kept: list[list[float]] = []
    try:
        for number, cells in enumerate(reader, line):
            if not any(cell.strip() for cell in cells):
                continue
            if len(cells) != width:
                leave_out("rows-malformed", f"line {number} has {len(cells)} values, {width} are expected")
                continue
            try:
                kept.append(_numbers_of(cells, columns))
            except ValueError:
                leave_out("rows-malformed", f"line {number} holds text where numbers are expected")
    except csv.Error as error:
        raise UnreadableUpload(
            f"{columns.name} cannot be read as CSV near line {line}", field=columns.name, cure="export it again"
        ) from error
    return np.array(kept, float).reshape(-1, len(columns.places))


def _numbers_of(cells: Sequence[str], columns: NumberColumns) -> list[float]:
    decimal, convert_first = columns.dialect.decimal, columns.convert_first
    wanted = [cells[place] for place in columns.places]
    if decimal == "," and any("." in cell for cell in wanted[convert_first is not None :]):
        raise ValueError("a point in a number with a decimal comma")
    if convert_first is None:
        return [parse_number(cell, decimal) for cell in wanted]
    return [convert_first(wanted[0]), *(parse_number(cell, decimal) for cell in wanted[1:])]
