"""Surveys as delimited text: a header with names, or the fixed columns of PNEZD and PENZD."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import chain, islice

from app.errors import UnreadableUpload
from app.formats.columns import repeated_names
from app.formats.delimited import detect_delimiter, split_rows
from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.table import MAX_COLUMNS, MAX_ROWS, Fault, Faults, SourceTable, Texts
from app.formats.text import open_utf8, refuse_other_encodings

PNEZD = ("point", "northing", "easting", "height", "description")
PENZD = ("point", "easting", "northing", "height", "description")
_DELIMITERS = (";", "\t", ",")
_NUMERIC = re.compile(r"\s*[+-]?[0-9][0-9.,]*\s*")
_SAMPLE_LINES = 50  # lines that the delimiter is detected by; chosen by hand
_BATCH = 10_000  # rows at a time; chosen by hand


def read_csv(data: bytes, declaration: ImportDeclaration) -> SourceTable:
    """Rows of delimited text.

    Raises
    ------
    UnreadableUpload
        It is not UTF-8, holds NUL or fields without end, names no columns or one twice, or has too many.
    """
    with refuse_other_encodings(data):
        return _read(data, declaration)


def _read(data: bytes, declaration: ImportDeclaration) -> SourceTable:
    rows = split_rows(open_utf8(data), _delimiter(data, declaration))
    first = next(rows, None)
    if first is None:
        raise UnreadableUpload("the file has no rows", field="file", limit="at least one row", cure="send the survey")
    fixed = {"pnezd": PNEZD, "penzd": PENZD}.get(declaration.layout)
    if fixed is not None:
        has_header = len(first) > 1 and not any(_NUMERIC.fullmatch(cell) for cell in first[1:4])
        body = rows if has_header else chain([first], rows)
        return _columns(fixed, body, last_takes_rest=True)
    names = tuple(name.strip() for name in first)
    _check_names(names)
    return _columns(names, rows, last_takes_rest=False)


def _delimiter(data: bytes, declaration: ImportDeclaration) -> str:
    """The declared delimiter, or the one that the first lines show."""
    if declaration.delimiter is not None:
        return declaration.delimiter
    candidates = [mark for mark in _DELIMITERS if not (mark == "," and declaration.decimal == ",")]
    return detect_delimiter(islice(open_utf8(data), _SAMPLE_LINES), candidates)


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
