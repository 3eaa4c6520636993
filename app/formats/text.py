"""Text and tables of uploaded files: encoding and lines, delimited text, spreadsheets, and columns by name."""

from __future__ import annotations

import codecs
import csv
import difflib
import io
import math
import re
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TextIO

import numpy as np

from app.errors import InvalidParameter, UnreadableUpload
from app.values import Floats

MAX_LINE = 1 << 18
"""Longest line that is read; longer ones are left out. [character]"""
MAX_NAME = 120
"""Longest name of a file or a column that is shown. [character]"""
_SAMPLE_BYTES = 4096  # [byte] by which text is recognized
_DECODED_BYTES = 1 << 20  # [byte] checked at a time, to bound memory
_MAX_CONTROL_SHARE = 0.02  # [1] of the sample: a damaged line or two, far below random bytes (0.11)
BOMS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
"""Byte order marks, and the encodings that they show."""
_C1_CONTROL = re.compile(rb"[\x80-\x9f]")  # printable in Windows-1252, never in ISO 8859-1
_CONTROL = re.compile(rb"[\x00-\x08\x0b\x0c\x0e-\x1f]")
_BLANK = "\r \t\ufeff"
_BLANK_BESIDE_TABS = "\r \ufeff"  # a tab at either end of a row is an empty cell


def count_of(number: int, what: str) -> str:
    """A number with its noun, in the plural where it has to be."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def is_text(data: bytes) -> bool:
    """Whether bytes look like text: a byte order mark, or hardly any control characters at the beginning."""
    if data.startswith(tuple(bom for bom, _name in BOMS)):
        return True
    sample = data[:_SAMPLE_BYTES]
    return len(_CONTROL.findall(sample)) <= len(sample) * _MAX_CONTROL_SHARE


def is_clean_text(data: bytes) -> bool:
    """Whether bytes look like text in ASCII or UTF-8: no control character at all at the beginning."""
    sample = data[:_SAMPLE_BYTES]
    return _CONTROL.search(sample) is None and b"\x7f" not in sample


def decode_text(name: str, data: bytes) -> tuple[str, str | None]:
    """Text of a file, and a warning about its encoding or None.

    Raises
    ------
    UnreadableUpload
        The file begins with a byte order mark and continues in another encoding.
    """
    for bom, encoding in BOMS:
        if data.startswith(bom):
            try:
                return data.decode(encoding), None
            except UnicodeDecodeError as error:
                raise UnreadableUpload(
                    f"{name} begins as {encoding} and continues in another encoding",
                    field="file",
                    limit="UTF-8",
                    cure="save the file as UTF-8",
                ) from error
    try:
        return data.decode("utf-8"), None
    except UnicodeDecodeError as error:
        warning = f"{name} is not UTF-8 from byte {error.start} on; characters that cannot be read stand as '?'"
    if not _C1_CONTROL.search(data):
        return data.decode("latin-1"), f"{name} is not UTF-8; it was read as ISO 8859-1"
    return data.decode("utf-8", "replace"), warning


def as_utf8(data: bytes, encoding: str | None = None) -> tuple[bytes, str]:
    """Text of a file as UTF-8 without a byte order mark, and the encoding it was in.

    Parameters
    ----------
    encoding : str, optional
        Where it is declared: a byte order mark counts more. Without it text that is not UTF-8 is UTF-16 if every
        other byte of its beginning is NUL, or else Windows-1252.

    Raises
    ------
    UnreadableUpload
        The file is not text in this encoding, or holds NUL.
    """
    mark, of_mark = next(((bom, name) for bom, name in BOMS if data.startswith(bom)), (b"", None))
    name = of_mark or encoding or guess_encoding(data)
    name = "utf-8" if name == "utf-8-sig" else name
    try:
        if name == "utf-8":
            data = data[len(mark) :]
            _check_utf8(data)
        else:
            data = data.decode(name).encode()
    except UnicodeDecodeError as error:
        raise UnreadableUpload(
            f"the file is not text in {name}: {error.reason}",
            field="file",
            limit="UTF-8, UTF-16 or Windows-1252, or the declared encoding",
            cure="save the file as UTF-8, or declare its encoding",
        ) from error
    if b"\x00" in data:
        raise UnreadableUpload("the file holds NUL", field="file", limit="text", cure="save the file as UTF-8 text")
    return data, name


def guess_encoding(data: bytes) -> str:
    """Encoding of text by its byte order mark, or by which bytes occur."""
    for bom, name in BOMS:
        if data.startswith(bom):
            return name
    sample = data[:_SAMPLE_BYTES]
    for name, first in (("utf-16-le", 1), ("utf-16-be", 0)):
        nul, text = sample[first::2], sample[1 - first :: 2]
        if nul and nul.count(0) > 0.9 * len(nul) and not text.count(0):
            return name
    try:
        _check_utf8(data)
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"


def _check_utf8(data: bytes) -> None:
    """Decode without keeping the result; raises UnicodeDecodeError."""
    decoder = codecs.getincrementaldecoder("utf-8")()
    for start in range(0, len(data), _DECODED_BYTES):
        decoder.decode(data[start : start + _DECODED_BYTES])
    decoder.decode(b"", final=True)


def clean_text(value: object, length: int = MAX_NAME) -> str | None:
    """A text that can be stored and shown; None where there is none."""
    if not isinstance(value, str | int) or isinstance(value, bool):
        return None
    text = value[:length].strip() if isinstance(value, str) else str(value) if abs(value) < 10**20 else ""
    if not text.isprintable():  # lone surrogates and NUL are not
        text = "".join(c if c.isprintable() else "?" for c in text)
    return text or None


def numbered_lines(text: str, blank: str = _BLANK) -> Iterator[tuple[int, str]]:
    """Lines that are not empty, with their numbers from 0, without blanks around them."""
    for number, line in enumerate(text.split("\n")):
        stripped = line.strip(blank)
        if stripped and not stripped.isspace():
            yield number, stripped


# === Columns of a table by name: which column holds which quantity.


_MAX_SHOWN = 24  # names listed in a message


def normal_name(name: str) -> str:
    """A column's name as names are compared: `Latitude [deg]` is `latitude_deg`."""
    return re.sub(r"[^a-z0-9]+", "_", name.strip().lower()).strip("_")


def match_columns(
    names: Sequence[str], aliases: Mapping[str, Sequence[str]], declared: Mapping[str, str]
) -> dict[str, int]:
    """Index of each quantity's column: the declared one, or else the first of its aliases that is present."""
    places: dict[str, int] = {}
    normal = [normal_name(name) for name in names]
    for quantity, wanted in aliases.items():
        if quantity in declared:
            name = declared[quantity]
            if name in names:
                places[quantity] = list(names).index(name)
            continue
        for alias in wanted:
            if alias in normal:
                places[quantity] = normal.index(alias)
                break
    return places


def repeated_names(names: Iterable[str], same: Callable[[str], str] = normal_name) -> list[str]:
    """Names of more than one column, sorted; `same` gives the form in which names are compared."""
    counts = Counter(map(same, names))
    return sorted(name for name, count in counts.items() if name and count > 1)


def require_columns(file_name: str, found: Sequence[str], wanted: Iterable[str], *, cure: str) -> None:
    """Refuse a file whose columns are missing; the message names the columns found and similar ones.

    Raises
    ------
    InvalidParameter
    """
    missing = [name for name in wanted if name not in found]
    if not missing:
        return
    similar = [n for n in found if n.lower() == missing[0].lower()] or difflib.get_close_matches(
        missing[0], [n for n in found if n], n=3, cutoff=0.5
    )
    raise InvalidParameter(
        f"{file_name} has no column {', '.join(map(repr, missing[:4]))}{' and more' if len(missing) > 4 else ''}"
        f"; its columns are {', '.join(map(repr, found[:_MAX_SHOWN]))}{' ...' if len(found) > _MAX_SHOWN else ''}"
        + (f"; near: {', '.join(map(repr, similar))}" if similar else ""),
        field=file_name,
        limit=", ".join(missing[:4]),
        cure=cure,
    )


# === Delimited text (CSV and its kin): delimiter, quotes, decimal sign, header, rows, numbers.
#
# Rows are read in one of three ways, by what a kind of file needs:
#
# - `DelimitedLog`: line by line; a line that cannot be split costs only itself (packet logs, tracks).
# - `split_rows`: as RFC 4180 has it, where a quoted cell may span lines (surveys).
# - `read_numbers_by_block`: columns of numbers, megabytes at a time (traces).


SPACES = "space"
"""The delimiter of rows whose cells are separated by any number of spaces and tabs."""
MAX_CELL = 10_000
"""Longest cell of `split_rows`. [character]"""
_LOG_DELIMITERS = (",", ";", "\t", "|")
_MAX_LOG_COLUMNS = 256
_MAX_HEADER = 1 << 16  # [character] of a log
_MAX_NUMBER = 40  # [character] a float64 needs at most 24
_MAX_BLOCK_LINE = 1 << 20  # [byte] longest line of `read_numbers_by_block`
_MAX_JSON_NUMBER = 1e300  # [1] an integer of JSON may be too large for a float
_MISSING = frozenset(("", "nan", "null", "none", "-", "n/a", "na"))
_NUMERIC = b"0123456789+-.eEnaNifI \r\n"
_NUMPY_CALL = b"np.float"  # numpy 2 writes its scalars as np.float64(1.5); the closing bracket is in `removed`


@dataclass(frozen=True, slots=True)
class Dialect:
    """How the cells of a row are written."""

    delimiter: str = ","  # one character, or `SPACES`
    decimal: str = "."  # ``.`` or ``,``
    removed: bytes = b'"'  # characters that columns of numbers are read without: quotes, brackets


# --- delimiter and header -----------------------------------------------------------------------------------------


def detect_dialect(header: str) -> Dialect:
    """Dialect by the header alone: the delimiter that is most frequent, decimal commas unless it is a comma."""
    delimiter = max(_LOG_DELIMITERS, key=header.count)
    return Dialect(delimiter, "." if delimiter == "," else ",")


def detect_delimiter(lines: Iterable[str], candidates: Sequence[str]) -> str:
    """The candidate that splits most of the lines into the same number of cells; `SPACES` if none occurs.

    Candidates are single characters; those in quoted cells do not count.
    """
    marks = re.escape("".join(candidates))
    quoted = re.compile(rf'(?:^|(?<=[{marks}]))"(?:[^"]|"")*"(?=[{marks}]|[ \r]*$)', re.MULTILINE)
    text = quoted.sub("q", "\n".join(line.rstrip("\r\n") for line in lines))
    filled = [line for line in text.split("\n") if line.strip()]
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
    """A log with a header, read line by line."""

    columns: tuple[str, ...]  # names as written; empty if the header cannot be split
    dialect: Dialect
    text: str  # all of the file, or its beginning where only the header is wanted

    @classmethod
    def open(cls, text: str) -> DelimitedLog:
        """A log whose first line that is not empty is the header."""
        _number, header = next(numbered_lines(text, _BLANK_BESIDE_TABS), (0, ""))
        header = header[:_MAX_HEADER]
        dialect = detect_dialect(header)
        names = split_header(header.lstrip("#").strip(_BLANK_BESIDE_TABS), dialect.delimiter)
        return cls(tuple(name[:MAX_NAME] for name in names[:_MAX_LOG_COLUMNS]), dialect, text)

    def places(self, aliases: Mapping[str, Sequence[str]], declared: Mapping[str, str]) -> dict[str, int]:
        """Index of each quantity's column: see `match_columns`."""
        return match_columns(self.columns, aliases, declared)

    def rows(self) -> Iterator[list[str] | None]:
        """Cells of each row after the header; None where a row has another number of cells or cannot be split."""
        lines = numbered_lines(self.text, _BLANK_BESIDE_TABS if self.dialect.delimiter == "\t" else _BLANK)
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
        columns = self.columns
        if len(cells) == len(columns):
            return cells
        is_padded = not any(map(str.strip, cells[len(columns) :])) and not any(columns[len(cells) :])
        if delimiter == "\t" and is_padded:  # tabs at the end of the header only, or of the rows only
            return [*cells[: len(columns)], *([""] * (len(columns) - len(cells)))]
        return None

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
    """Columns of numbers that are read from a file."""

    name: str  # of the file, for messages
    places: tuple[int, ...]  # indices of the wanted cells, in the order of the result
    width: int  # cells of a row
    dialect: Dialect = Dialect()
    convert_first: Callable[[str], float] | None = None  # reads the first wanted cell from text that is no number


LeaveOut = Callable[[str, str], None]
"""Takes the kind and the reason of a row that is left out: `rows-malformed` or `row-cut-short`."""


def read_numbers_by_block(blocks: Iterable[bytes], columns: NumberColumns, leave_out: LeaveOut) -> Iterator[Floats]:
    """Numbers of the rows after the header, in blocks of shape (rows, len(columns.places)).

    A block whose cells are all numbers is parsed by numpy; only a block with anything else in it is read cell by cell.

    Parameters
    ----------
    blocks : iterable of bytes
        The file in pieces of any size.
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
        if b"." in block:  # perhaps between thousands
            return None
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


# === Tables as CSV that a spreadsheet program opens as text and numbers, and never as formulas.


# source: OWASP, CSV injection; the wide forms are taken for formulas by spreadsheets in East Asian locales
_FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n", "＝", "＋", "－", "＠")
_NUMBER = re.compile(r"[+-]?[0-9]+(\.[0-9]*)?([eE][+-]?[0-9]+)?")


def plain_text(text: str) -> str:
    """Text that no spreadsheet runs as a formula: an apostrophe precedes what it would run. Numbers stay."""
    return f"'{text}" if text.startswith(_FORMULA) and not _NUMBER.fullmatch(text) else text


class TableWriter:
    """Writes rows as CSV (RFC 4180), with `plain_text` for every cell that is a text. All tables are written by it."""

    def __init__(self, stream: TextIO, line_end: str = "\r\n") -> None:
        self._writer = csv.writer(stream, lineterminator=line_end)

    def write_row(self, cells: Iterable[object]) -> None:
        """One row; None is an empty cell."""
        self._writer.writerow([plain_text(cell) if isinstance(cell, str) else cell for cell in cells])
