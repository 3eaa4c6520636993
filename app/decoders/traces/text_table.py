"""Columns of numbers from CSV files, block by block."""

from __future__ import annotations

import csv
import difflib
import io
import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.decoders.traces.declaration import TraceLimits
from app.decoders.traces.parts import Part
from app.decoders.traces.report import TraceReport
from app.errors import InvalidParameter, UnreadableUpload, UploadTooLarge

Floats = npt.NDArray[np.float64]

_NUMERIC = b"0123456789+-.eEnaNifI \r\n"
_MAX_LINE = 1 << 20
_MAX_COLUMNS = 4096


@dataclass(frozen=True, slots=True)
class Dialect:
    """How cells are written.

    Attributes
    ----------
    delimiter, decimal : str
    drop : bytes
        Characters that are taken out before the cells are split: the recorder's brackets and quotes.
    """

    delimiter: str = ","
    decimal: str = "."
    drop: bytes = b'"'


def read_header(part: Part, delimiter: str) -> list[str]:
    """Names of the columns, from the first line.

    Raises
    ------
    UnreadableUpload
        No header, or not text in UTF-8.
    """
    line = part.head.split(b"\n", 1)[0]
    try:
        text = line.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise UnreadableUpload(
            f"the header of {part.name} is not UTF-8", field=part.name, limit="UTF-8", cure="save the file as UTF-8"
        ) from error
    if len(text) >= len(part.head) and len(text) > 4096:
        raise UnreadableUpload(f"{part.name} has no lines", field=part.name, cure="export it as CSV")
    names = [name.strip() for name in next(csv.reader([text.strip("\r")], delimiter=delimiter), [])]
    if len(names) > _MAX_COLUMNS:
        raise UploadTooLarge(f"{part.name} has too many columns", field=part.name, limit=f"{_MAX_COLUMNS} columns")
    repeated = {n for n in names if n and names.count(n) > 1}
    if repeated:
        raise UnreadableUpload(
            f"{part.name} has several columns named {min(repeated)!r}",
            field=part.name,
            limit="each name once",
            cure="rename the columns",
        )
    return names


def require_columns(part_name: str, found: Sequence[str], wanted: Iterable[str], *, cure: str) -> None:
    """Refuse a file whose columns are missing, naming those found and those near.

    Raises
    ------
    InvalidParameter
    """
    missing = [name for name in wanted if name not in found]
    if not missing:
        return
    near = difflib.get_close_matches(missing[0], [n for n in found if n], n=3, cutoff=0.5)
    lower = [n for n in found if n.lower() == missing[0].lower()]
    hint = lower or near
    raise InvalidParameter(
        f"{part_name} has no column {', '.join(map(repr, missing[:4]))}{' and more' if len(missing) > 4 else ''}"
        f"; its columns are {', '.join(map(repr, found[:24]))}{' ...' if len(found) > 24 else ''}"
        + (f"; near: {', '.join(map(repr, hint))}" if hint else ""),
        field=part_name,
        limit=", ".join(missing[:4]),
        cure=cure,
    )


def read_rows(
    part: Part,
    columns: Sequence[int],
    width: int,
    dialect: Dialect,
    limits: TraceLimits,
    report: TraceReport,
    *,
    convert_first: Callable[[str], float] | None = None,
) -> Iterator[Floats]:
    """Numbers of some columns, in blocks of shape (rows, len(columns)); malformed rows are left out and reported.

    Parameters
    ----------
    columns : sequence of int
        Wanted ones, after the dialect's brackets are taken out.
    width : int
        Cells of a row.
    convert_first : callable, optional
        Reads the first wanted column from text that is no number.

    Raises
    ------
    UploadTooLarge
        More rows than the limit.
    """
    line, rows = 2, 0
    for block in _lines(part, report):
        count = block.count(b"\n")
        values = None if convert_first else _parse_fast(block, width, dialect)
        if values is None:
            values = _parse_slow(part.name, line, block, columns, width, dialect, report, convert_first)
        else:
            values = values[:, list(columns)]
        line += count
        rows += len(values)
        if rows > limits.rows:
            raise UploadTooLarge(
                f"{part.name} has more rows than the limit",
                field=part.name,
                limit=f"{limits.rows} rows",
                cure="cut the recording into shorter ones",
            )
        yield values


def _lines(part: Part, report: TraceReport) -> Iterator[bytes]:
    """Blocks of whole lines after the header; a last line that does not end may be cut within a number."""
    rest, first = b"", True
    for block in part.blocks():
        rest += block
        if first:
            if b"\n" not in rest:
                if len(rest) > _MAX_LINE:
                    break
                continue
            rest, first = rest.split(b"\n", 1)[1], False
        end = rest.rfind(b"\n") + 1
        if not end and len(rest) > _MAX_LINE:
            raise UnreadableUpload(f"a line of {part.name} does not end", field=part.name, limit=f"{_MAX_LINE} bytes")
        if end:
            yield rest[:end]
            rest = rest[end:]
    if not first and rest.strip():
        report.leave_out(part.name, "row-cut-short", 1, "the last line does not end: it may be cut within a number")


def _parse_fast(block: bytes, width: int, dialect: Dialect) -> Floats | None:
    """All cells of a block, or None if any row is not what it should be."""
    if b"np.float" in block:
        block = block.replace(b"np.float64(", b"").replace(b"np.float32(", b"")
    block = block.translate(None, dialect.drop)
    delimiter = dialect.delimiter.encode()
    count = block.count(b"\n")
    if block.count(delimiter) != count * (width - 1) or block.translate(None, _NUMERIC + b"," + delimiter):
        return None
    if dialect.decimal == ",":
        block = block.replace(b",", b".")
    if any(
        empty in b"\n" + block for empty in (delimiter * 2, delimiter + b"\n", delimiter + b"\r", b"\n" + delimiter)
    ):
        return None
    marks = np.frombuffer(block, np.uint8)
    ends = np.flatnonzero(marks == 10)
    cuts = np.searchsorted(np.flatnonzero(marks == delimiter[0]), ends)
    if (np.diff(cuts, prepend=0) != width - 1).any():
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            values = np.fromstring(block.replace(delimiter, b" ").decode("ascii"), sep=" ")
        except ValueError:
            return None
    return values.reshape(count, width) if values.size == count * width else None


def _parse_slow(
    name: str,
    line: int,
    block: bytes,
    columns: Sequence[int],
    width: int,
    dialect: Dialect,
    report: TraceReport,
    convert_first: Callable[[str], float] | None,
) -> Floats:
    """Cell by cell: empty cells are NaN, rows of another width or with other text in them are left out."""
    keep: list[list[float]] = []
    block = block.replace(b"np.float64(", b"").replace(b"np.float32(", b"").replace(b"\0", b"?")
    text = io.StringIO(block.translate(None, dialect.drop).decode("utf-8", "replace"))
    reader = csv.reader(text, delimiter=dialect.delimiter, quoting=csv.QUOTE_NONE)
    try:
        for number, cells in enumerate(reader, line):
            if not cells or not any(c.strip() for c in cells):
                continue
            if len(cells) != width:
                report.leave_out(
                    name, "rows-malformed", 1, f"line {number} has {len(cells)} values, {width} are expected"
                )
                continue
            try:
                row = [_number(cells[c], dialect.decimal) for c in columns[1:]]
                first = cells[columns[0]]
                keep.append([convert_first(first) if convert_first else _number(first, dialect.decimal), *row])
            except ValueError:
                report.leave_out(name, "rows-malformed", 1, f"line {number} holds text where numbers are expected")
    except csv.Error as error:
        raise UnreadableUpload(
            f"{name} cannot be read as CSV near line {line}", field=name, cure="export it again"
        ) from error
    return np.array(keep, float).reshape(-1, len(columns))


def _number(text: str, decimal: str) -> float:
    text = text.strip()
    if not text:
        return math.nan
    if "_" in text or (decimal == "," and "." in text):
        raise ValueError(text)
    return float(text.replace(",", ".") if decimal == "," else text)
