"""Surveys as delimited text: with a header somewhere in the first lines, or with columns by position."""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Iterator
from itertools import chain, islice

from app.errors import UnreadableUpload
from app.formats.columns import repeated_names
from app.formats.delimited import SPACES, detect_delimiter, split_rows
from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.header import Header, find_header
from app.formats.surveys.table import MAX_COLUMNS, MAX_ROWS, Detected, Fault, SourceTable, Texts
from app.formats.text import as_utf8

_DELIMITERS = (";", "\t", "|", ",")
_DELIMITER_NAMES = {"\t": "tab", SPACES: "blanks"}
_COMMENTS = ("#", "//")
_COMMENT_LINE = re.compile(rb"^[ \t]*(?:#|//)", re.MULTILINE)
_SAMPLE_LINES = 50  # lines by which the delimiter and the header are detected; chosen by hand
_BATCH = 10_000  # rows at a time; chosen by hand
_DECIMAL_COMMAS = re.compile(r"(?:\S+[ \t]+)?[+-]?[0-9]+,[0-9]+[ \t]+[+-]?[0-9]+,[0-9]+(?:[ \t].*)?\s*")


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
    return SourceTable(
        "csv", header.names, table, faults=header.faults, detected=tuple(detected),
        has_names=not header.last_takes_rest,
    )  # fmt: skip


def _detect_delimiter(utf8: bytes, declaration: ImportDeclaration) -> str:
    """The delimiter that the first lines show."""
    sample = list(islice(_Lines(utf8, keep_ends=False), _SAMPLE_LINES))
    found = detect_delimiter(sample, _DELIMITERS)
    if found == "," and declaration.decimal != ".":
        spaced = sum(1 for line in sample if _DECIMAL_COMMAS.fullmatch(line))
        if 2 * spaced > len(sample):
            return SPACES
    return found


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
