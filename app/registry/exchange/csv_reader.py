"""Surveys as delimited text: a header with names, or the fixed places of PNEZD and PENZD."""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice

from app.errors import UnreadableUpload
from app.registry.exchange.declaration import ImportDeclaration
from app.registry.exchange.table import MAX_COLUMNS, MAX_ROWS, Fault, Faults, SourceTable, Texts

PNEZD = ("point", "northing", "easting", "height", "description")
PENZD = ("point", "easting", "northing", "height", "description")
_DELIMITERS = (";", "\t", ",")
_MAX_FIELD = 10_000
_NUMERIC = re.compile(r"\s*[+-]?[0-9][0-9.,]*\s*")
_SAMPLE_LINES = 50
_BATCH = 10_000


def read_csv(data: bytes, declaration: ImportDeclaration) -> SourceTable:
    """Rows of delimited text.

    Raises
    ------
    UnreadableUpload
        It is not UTF-8, holds NUL or fields without end, names no columns or one twice, or has too many.
    """
    with _utf8(data):
        return _read(data, declaration)


def _read(data: bytes, declaration: ImportDeclaration) -> SourceTable:
    rows = _rows(data, declaration)
    first = next(rows, None)
    if first is None:
        raise UnreadableUpload("the file has no rows", field="file", limit="one row at least", cure="send the survey")
    fixed = {"pnezd": PNEZD, "penzd": PENZD}.get(declaration.layout)
    if fixed is not None:
        has_header = len(first) > 1 and not any(_NUMERIC.fullmatch(cell) for cell in first[1:4])
        body = rows if has_header else _chained(first, rows)
        return _columns(fixed, body, last_takes_rest=True)
    names = tuple(name.strip() for name in first)
    _check_names(names)
    return _columns(names, rows, last_takes_rest=False)


def _text(data: bytes) -> io.TextIOWrapper:
    if b"\x00" in data:
        raise UnreadableUpload("the file holds NUL", field="file", limit="text", cure="save the file as UTF-8 text")
    return io.TextIOWrapper(io.BytesIO(data), encoding="utf-8-sig", newline="")


@contextmanager
def _utf8(data: bytes) -> Iterator[None]:
    try:
        yield
    except UnicodeDecodeError as error:
        start = 0
        try:
            data.decode("utf-8-sig")
        except UnicodeDecodeError as whole:  # says where in the file, not where in what was read last
            start = whole.start
        raise UnreadableUpload(
            f"byte {start} of the file is not UTF-8", field="file", limit="UTF-8", cure="save the file as UTF-8"
        ) from error


def _rows(data: bytes, declaration: ImportDeclaration) -> Iterator[list[str]]:
    delimiter = declaration.delimiter or _delimiter(data, declaration.decimal)
    text = _text(data)
    if delimiter == "space":
        text.reconfigure(newline=None)
        yield from (line.split() for line in text if line.strip())
        return
    csv.field_size_limit(_MAX_FIELD)
    reader = csv.reader(text, delimiter=delimiter, strict=True)
    try:
        for row in reader:
            if row and any(row):
                yield row
    except csv.Error as error:
        raise UnreadableUpload(
            f"line {reader.line_num} is no row of delimited text: {error}",
            field="file",
            limit=f"fields of at most {_MAX_FIELD} characters, quotes closed",
            cure="write it as CSV (RFC 4180)",
        ) from error


def _delimiter(data: bytes, decimal: str) -> str:
    """The delimiter that splits most of the first lines into the same number of fields."""
    lines = [line for line in islice(_text(data), _SAMPLE_LINES) if line.strip()]
    candidates = [mark for mark in _DELIMITERS if not (mark == "," and decimal == ",")]
    best, score = "space", 0
    for mark in candidates:
        ((count, agreeing),) = Counter(line.count(mark) for line in lines).most_common(1) or [(0, 0)]
        if count and agreeing > score:
            best, score = mark, agreeing
    return best


def _chained(first: list[str], rows: Iterator[list[str]]) -> Iterator[list[str]]:
    yield first
    yield from rows


def _check_names(names: tuple[str, ...]) -> None:
    doubled = next((name for name, count in Counter(name.lower() for name in names if name).items() if count > 1), None)
    if doubled is not None:
        raise UnreadableUpload(
            f"two columns are named {doubled[:40]!r}", field="file", limit="each name once", cure="rename one of them"
        )
    if len(names) > MAX_COLUMNS:
        raise UnreadableUpload(
            f"the file has {len(names)} columns", field="file", limit=f"{MAX_COLUMNS} columns", cure="leave some out"
        )
    if any(_NUMERIC.fullmatch(name) for name in names):
        raise UnreadableUpload(
            "the first row holds numbers where the columns' names belong",
            field="file",
            limit="a header",
            cure="add a header, or declare the layout pnezd or penzd",
        )


def _columns(names: tuple[str, ...], rows: Iterator[list[str]], *, last_takes_rest: bool) -> SourceTable:
    columns = tuple(Texts() for _ in names)
    faults = Faults()
    width = len(names)
    for start, batch in _batches(rows):
        for k, row in enumerate(batch):
            if len(row) != width:
                if last_takes_rest and len(row) > width:
                    batch[k] = [*row[: width - 1], ",".join(row[width - 1 :])]
                elif last_takes_rest and len(row) >= width - 2:
                    batch[k] = row + [""] * (width - len(row))
                else:
                    faults.add([_ragged(start + k + 1, len(row), width)])
                    batch[k] = [""] * width
        for column, cells in zip(columns, zip(*batch, strict=True), strict=True):
            column.extend(cells)
    return SourceTable("csv", names, columns, faults=faults)


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
