"""Plain CSV and Parquet with declared columns."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter, UnreadableUpload, UnsupportedUpload, UploadTooLarge
from app.formats.columns import require_columns
from app.formats.delimited import Dialect, NumberColumns
from app.formats.traces.declaration import S_PER_UNIT, TimeUnit, TraceColumns, TraceDeclaration, TraceLimits
from app.formats.traces.parts import Part
from app.formats.traces.report import TraceReport
from app.formats.traces.text_table import read_header, read_rows

Floats = npt.NDArray[np.float64]

_BATCH_ROWS = 1 << 16
_CURE = "declare the names of the columns"


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Columns of a file, in the units of the file but for time.

    Attributes
    ----------
    t_s : ndarray, shape (T,)
    field : ndarray of float32, shape (T, S, 3), or None
    speed, heading : ndarray, shape (T,), or None
    """

    t_s: Floats
    field: npt.NDArray[np.float32] | None
    speed: Floats | None
    heading: Floats | None


def read_csv(part: Part, declaration: TraceDeclaration, limits: TraceLimits, report: TraceReport) -> Table:
    """Columns of a CSV file.

    Raises
    ------
    InvalidParameter
        Columns are missing, or the delimiter is another one.
    UploadTooLarge, UnreadableUpload
    """
    columns = declaration.columns
    names = read_header(part, columns.delimiter)
    _check_delimiter(part, names, columns)
    wanted, sensors = _wanted(part.name, names, declaration)
    iso = _text_to_seconds if columns.time_unit is TimeUnit.ISO else None
    places = tuple(names.index(name) for name in wanted)
    numbers = NumberColumns(part.name, places, len(names), Dialect(columns.delimiter, columns.decimal), iso)
    return _table(read_rows(part, numbers, limits, report), wanted, sensors, columns)


def read_parquet(part: Part, declaration: TraceDeclaration, limits: TraceLimits, report: TraceReport) -> Table:
    """Columns of a Parquet file; needs the extra `parquet`.

    Raises
    ------
    UnsupportedUpload
        pyarrow is not installed.
    InvalidParameter
        Columns are missing or hold no numbers.
    UploadTooLarge, UnreadableUpload
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise UnsupportedUpload(
            "this server reads no Parquet: pyarrow is not installed",
            field=part.name,
            cure="send CSV, or install waymark-roads[parquet]",
        ) from error
    defects = (pyarrow.ArrowException, OSError, ValueError, KeyError, MemoryError, OverflowError)
    content = part.content()
    try:
        file = pyarrow.parquet.ParquetFile(pyarrow.BufferReader(content))
        names, claimed = [str(name) for name in file.schema_arrow.names], int(file.metadata.num_rows)
    except defects as error:
        raise _damaged(part) from error
    if claimed > limits.rows:
        raise _too_long(part, limits)
    wanted, sensors = _wanted(part.name, names, declaration)

    def blocks() -> Iterator[Floats]:
        rows = 0
        try:
            for batch in file.iter_batches(batch_size=_BATCH_ROWS, columns=wanted, use_threads=False):
                rows += batch.num_rows
                if rows > limits.rows:
                    raise _too_long(part, limits)
                yield np.stack([_column(batch.column(batch.schema.get_field_index(n)), n) for n in wanted], 1)
        except defects as error:
            if isinstance(error, InvalidParameter):
                raise
            raise _damaged(part) from error

    return _table(blocks(), wanted, sensors, declaration.columns)


def _column(array: Any, name: str) -> Floats:
    """A column of numbers or times as float64, missing values as NaN; times in seconds."""
    import pyarrow as pa

    kind = array.type
    if pa.types.is_timestamp(kind):
        missing = np.asarray(array.is_null())
        seconds: Floats = array.cast(pa.timestamp("ns")).cast(pa.int64()).fill_null(0).to_numpy(False) / 1e9
        return np.where(missing, np.nan, seconds)
    if not (pa.types.is_floating(kind) or pa.types.is_integer(kind)):
        raise InvalidParameter(
            f"column {name!r} holds {kind}", field=name, limit="numbers or timestamps", cure="convert the column"
        )
    return np.asarray(array.cast(pa.float64()).to_numpy(False), float)


def _wanted(part: str, names: Sequence[str], declaration: TraceDeclaration) -> tuple[list[str], int]:
    """Columns to read: time, then fields, speed and heading as far as they are there; and the number of sensors."""
    columns = declaration.columns
    fields = [name for triple in columns.field_names(declaration.sensors) for name in triple]
    series = [n for n in (columns.speed, columns.heading) if n is not None and n in names]
    require_columns(part, names, [columns.time], cure=_CURE)
    if any(name in names for name in fields) or not series:
        require_columns(part, names, fields, cure=_CURE)
        return [columns.time, *fields, *series], declaration.sensors
    return [columns.time, *series], 0


def _table(blocks: Iterator[Floats], wanted: list[str], sensors: int, columns: TraceColumns) -> Table:
    t: list[Floats] = []
    field: list[npt.NDArray[np.float32]] = []
    rest: list[Floats] = []
    for rows in blocks:
        t.append(rows[:, 0])
        with np.errstate(over="ignore"):
            field.append(rows[:, 1 : 1 + 3 * sensors].astype(np.float32).reshape(len(rows), sensors, 3))
        rest.append(rows[:, 1 + 3 * sensors :].copy())
    times = np.concatenate(t) if t else np.empty(0)
    others = np.concatenate(rest) if rest else np.empty((0, len(wanted) - 1 - 3 * sensors))
    series = {name: others[:, i] for i, name in enumerate(wanted[1 + 3 * sensors :])}
    fields = np.concatenate(field) if field else np.empty((0, sensors, 3), np.float32)
    return Table(
        times * S_PER_UNIT.get(columns.time_unit, 1.0),
        fields if sensors else None,
        None if columns.speed is None else series.get(columns.speed),
        None if columns.heading is None else series.get(columns.heading),
    )


def _check_delimiter(part: Part, names: Sequence[str], columns: TraceColumns) -> None:
    """Refuse a file that is split by another character than declared, before its columns are called missing."""
    other = next((d for d in (";", "\t", ",") if d != columns.delimiter and any(d in n for n in names)), None)
    if other and columns.time not in names:
        shown = {"\t": "tabs", ";": "semicolons", ",": "commas"}
        raise InvalidParameter(
            f"the columns of {part.name} are parted by {shown[other]}",
            field="columns.delimiter",
            limit=shown[columns.delimiter],
            cure=f"declare the delimiter {other!r}"
            + (", and the decimal sign ',' if numbers are written so" if other == ";" else ""),
        )


def _text_to_seconds(text: str) -> float:
    if not text.strip():
        return math.nan
    moment = datetime.fromisoformat(text.strip())
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def _damaged(part: Part) -> UnreadableUpload:
    return UnreadableUpload(
        f"{part.name} is a damaged Parquet file or cut short", field=part.name, cure="write it again and send it whole"
    )


def _too_long(part: Part, limits: TraceLimits) -> UploadTooLarge:
    return UploadTooLarge(
        f"{part.name} has more rows than the limit",
        field=part.name,
        limit=f"{limits.rows} rows",
        cure="cut the recording into shorter ones",
    )
