"""Traces as tables: CSV and Parquet with declared columns, and the files of METRO's recorder."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter, UnreadableUpload, UnsupportedUpload, UploadTooLarge
from app.formats.logs import LogClock
from app.formats.text import (
    Dialect,
    NumberColumns,
    read_numbers_by_block,
    repeated_names,
    require_columns,
    split_header,
)
from app.formats.traces.declaration import (
    S_PER_UNIT,
    TraceColumns,
    TraceDeclaration,
    TraceLimits,
    TraceReport,
)
from app.formats.traces.parts import Part
from app.values import Floats

# === Columns of numbers from the CSV files of a recording.


_MAX_COLUMNS = 4096
_MAX_LINE_WITHOUT_END = 4096  # [character] a longer beginning without a line end is no header


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


# === Plain CSV and Parquet with declared columns.


_BATCH_ROWS = 1 << 16
_CURE = "declare the names of the columns"


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Columns of a file, in the units of the file but for time."""

    t_s: Floats  # shape (T,)
    field: npt.NDArray[np.float32] | None  # shape (T, S, 3), or None
    # `speed`, `heading`: shape (T,), or None
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
    columns = declaration.table
    names = read_header(part, columns.delimiter)
    _check_delimiter(part, names, columns)
    wanted, sensors = _wanted(part.name, names, declaration)
    iso = _text_to_seconds if columns.time_unit == "iso" else None
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

    return _table(blocks(), wanted, sensors, declaration.table)


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
    columns = declaration.table
    fields = [name for triple in columns.field_names(declaration.sensors.sensor_count) for name in triple]
    series = [n for n in (columns.speed, columns.heading) if n is not None and n in names]
    require_columns(part, names, [columns.time], cure=_CURE)
    if any(name in names for name in fields) or not series:
        require_columns(part, names, fields, cure=_CURE)
        return [columns.time, *fields, *series], declaration.sensors.sensor_count
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
    seconds = LogClock().from_text(text.strip())
    if math.isnan(seconds):
        raise ValueError("no time")
    return seconds


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


# === Files of METRO's recorder: RawData, RawSpeed and RawSWA, written by pandas with tuples as text.


TIME = "Time Stamp"
_TUPLES = Dialect(removed=b'"()')
_RECORDER_CURE = "send the recorder's files as they were written, or declare the columns of a plain CSV"


def read_raw_data(
    part: Part, sensors: int, limits: TraceLimits, report: TraceReport
) -> tuple[Floats, npt.NDArray[np.float32]]:
    """Times (T,) [s] and fields (T, S, 3) [uT], as recorded.

    Raises
    ------
    InvalidParameter
        Columns are missing.
    UploadTooLarge, UnreadableUpload
    """
    names = read_header(part, ",")
    wanted = [f"Sensor {i}" for i in range(1, sensors + 1)]
    require_columns(part.name, names, [TIME, *wanted], cure=_RECORDER_CURE)
    place: dict[str, int] = {}
    at = 0
    for name in names:  # a tuple takes three cells once its brackets are gone
        place[name] = at
        at += 3 if name.startswith("Sensor ") else 1
    places = (place[TIME], *(place[name] + axis for name in wanted for axis in range(3)))
    t, field = [], []
    for rows in read_rows(part, NumberColumns(part.name, places, at, _TUPLES), limits, report):
        t.append(rows[:, 0])
        with np.errstate(over="ignore"):
            field.append(rows[:, 1:].astype(np.float32).reshape(-1, sensors, 3))
    if not t:
        return np.empty(0), np.empty((0, sensors, 3), np.float32)
    return np.concatenate(t), np.concatenate(field)


def read_raw_series(part: Part, column: str, limits: TraceLimits, report: TraceReport) -> tuple[Floats, Floats]:
    """Times [s] and values of RawSpeed (`Speed`, km/h) or RawSWA (`SWA`, degrees).

    The recorder repeats the last CAN value with each sample; only changes and one value a tenth of a second are kept.

    Raises
    ------
    InvalidParameter
        Columns are missing.
    """
    names = read_header(part, ",")
    require_columns(part.name, names, [TIME, column], cure=_RECORDER_CURE)
    columns = NumberColumns(part.name, (names.index(TIME), names.index(column)), len(names))
    blocks = list(read_rows(part, columns, limits, report))
    rows = np.concatenate(blocks) if blocks else np.empty((0, 2))
    return thin_held(rows[:, 0], rows[:, 1])


def thin_held(t: Floats, value: Floats, hold_s: float = 0.1) -> tuple[Floats, Floats]:
    """Values that were held between updates, at their updates: interpolating stairs would lag by half a step."""
    if len(t) < 3 or np.mean(value[1:] == value[:-1]) < 0.5:
        return t, value
    keep = np.flatnonzero(np.concatenate(([True], value[1:] != value[:-1])))
    ends = np.concatenate((keep[1:], [len(t)]))
    long = np.flatnonzero(t[ends - 1] - t[keep] > 1.5 * hold_s)
    between = [np.searchsorted(t, np.arange(t[keep[i]] + hold_s, t[ends[i] - 1], hold_s)) for i in long]
    at = np.unique(np.concatenate([keep, [len(t) - 1], *between]))
    return t[at], value[at]
