"""Columns of numbers from the CSV files of a recording."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from app.errors import UnreadableUpload, UploadTooLarge
from app.formats.columns import repeated_names
from app.formats.delimited import NumberColumns, read_numbers_by_block, split_header
from app.formats.traces.declaration import TraceLimits
from app.formats.traces.parts import Part
from app.formats.traces.report import TraceReport

Floats = npt.NDArray[np.float64]

_MAX_COLUMNS = 4096  # chosen by hand
_MAX_LINE_WITHOUT_END = 4096  # [character] a longer beginning without a line end is no header; chosen by hand


def read_header(part: Part, delimiter: str) -> list[str]:
    """Names of the columns, from the first line.

    Raises
    ------
    UnreadableUpload
        No header, not text in UTF-8, or a name of several columns.
    UploadTooLarge
        Too many columns.
    """
    line = part.head.split(b"\n", 1)[0]
    try:
        text = line.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise UnreadableUpload(
            f"the header of {part.name} is not UTF-8", field=part.name, limit="UTF-8", cure="save the file as UTF-8"
        ) from error
    if len(text) >= len(part.head) and len(text) > _MAX_LINE_WITHOUT_END:
        raise UnreadableUpload(f"{part.name} has no lines", field=part.name, cure="export it as CSV")
    names = split_header(text.strip("\r"), delimiter)
    if not names and text.strip():
        raise UnreadableUpload(f"the header of {part.name} cannot be read", field=part.name, cure="export it as CSV")
    if len(names) > _MAX_COLUMNS:
        raise UploadTooLarge(f"{part.name} has too many columns", field=part.name, limit=f"{_MAX_COLUMNS} columns")
    repeated = repeated_names(names, str)
    if repeated:
        raise UnreadableUpload(
            f"{part.name} has several columns named {repeated[0]!r}",
            field=part.name,
            limit="each name once",
            cure="rename the columns",
        )
    return names


def read_rows(part: Part, columns: NumberColumns, limits: TraceLimits, report: TraceReport) -> Iterator[Floats]:
    """Numbers of some columns, in blocks of shape (rows, columns); malformed rows are left out and reported.

    Raises
    ------
    UploadTooLarge
        More rows than the limit.
    UnreadableUpload
        A line does not end, or the file cannot be read as CSV.
    """
    rows = 0
    for values in read_numbers_by_block(
        part.blocks(), columns, lambda kind, reason: report.leave_out(part.name, kind, 1, reason)
    ):
        rows += len(values)
        if rows > limits.rows:
            raise UploadTooLarge(
                f"{part.name} has more rows than the limit",
                field=part.name,
                limit=f"{limits.rows} rows",
                cure="cut the recording into shorter ones",
            )
        yield values
