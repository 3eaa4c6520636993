"""Formats of the files of a recording: how each is detected and read."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter, UnreadableUpload, UnsupportedUpload
from app.formats.bags.messages import SIGNATURES
from app.formats.format import Confidence, Format, Sample, Use, detect_format, detect_signature, list_accepted
from app.formats.traces.can_log import CANDUMP_CONSOLE, SAVVYCAN_HEADER, CanSeries, read_can_log
from app.formats.traces.declaration import (
    AngleUnit,
    FieldUnit,
    SpeedUnit,
    TraceDeclaration,
    TraceFormat,
    TraceLimits,
    TraceReport,
)
from app.formats.traces.parts import Part, Series
from app.formats.traces.tables import Table, read_csv, read_parquet, read_raw_data, read_raw_series
from app.formats.traces.wire import StreamReader
from app.values import Floats

_CAN_SUFFIXES = (".asc", ".blf", ".trc", ".log")
_TEXT_SUFFIXES = (".csv", ".txt", ".dbc", ".asc", ".trc", ".log", ".json", ".xlsx", ".mf4", ".mat")
"""Of files that are never a binary stream of samples."""
_BINARY_SIGNATURES = (b"PAR1", b"LOGG")
_BINARY = (TraceFormat.PARQUET, TraceFormat.CAN, TraceFormat.STREAM, TraceFormat.BAG)
_UT_PER_TESLA = 1e6
_CANDUMP = re.compile(r"\(\d+\.\d+\) \S+ [0-9A-F]{3,8}#|" + CANDUMP_CONSOLE.pattern)
"""A frame of candump's log file, or as it shows it on a console: then the file is refused by name."""
_TRACE_COLUMN = re.compile(r"(s\d+_[xyz]|sensor .*|arbitration_id|time stamp)\Z", re.IGNORECASE)


@dataclass(slots=True)
class TraceContents:
    """What the files of a recording hold, before it is assembled."""

    # `t_s`, `field_ut`, `field_part`: times [s], fields [uT], and the file they are from
    t_s: Floats | None = None
    field_ut: npt.NDArray[np.float32] | None = None
    field_part: str = ""
    metro: bool = False  # the fields are METRO's: axes and unit are known
    unit: FieldUnit | None = None  # of the fields, where the format fixes it
    speeds: list[tuple[Series, SpeedUnit]] = field(default_factory=list)
    headings: list[tuple[Series, AngleUnit]] = field(default_factory=list)
    # series `speed` and `heading` of each CAN log
    can: list[tuple[str, dict[str, CanSeries]]] = field(default_factory=list)

    def set_field(self, part: str, t_s: Floats, field_ut: npt.NDArray[np.float32], *, metro: bool) -> None:
        """Take the magnetic fields of the recording.

        Raises
        ------
        InvalidParameter
            Another file has fields already.
        """
        if self.t_s is not None:
            raise InvalidParameter(
                f"{self.field_part} and {part} both hold magnetic fields",
                field="parts",
                limit="one recording",
                cure="send recordings one by one",
            )
        self.t_s, self.field_ut, self.field_part, self.metro = t_s, field_ut, part, metro


@dataclass(frozen=True, slots=True)
class TraceReading:
    """A recording while its files are read."""

    declaration: TraceDeclaration
    limits: TraceLimits
    report: TraceReport  # filled while files are read
    dbc: Sequence[Part] = ()  # descriptions of CAN signals among the files
    contents: TraceContents = field(default_factory=TraceContents)  # filled while files are read

    def shift_s(self, part: Part) -> float:
        """What is added to the times of a file. [s]"""
        return (self.declaration.clock_offsets_s or {}).get(part.name, 0.0)


TraceReader = Callable[[Part, TraceReading], None]

# --- reading ------------------------------------------------------------------------------------------------------


def _read_stream(part: Part, reading: TraceReading) -> None:
    declaration, report = reading.declaration, reading.report
    reader = StreamReader(
        part.content(), part.name, declaration.sensors.sensor_count, declaration.rate_hz, reading.limits, report
    )
    t, values = reader.read(declaration.interval_extra_us or 0.0)
    if not declaration.interval_extra_us:
        report.warn(
            f"the intervals in {part.name} leave out the time of the serial write: its clock may run slow; "
            "declare that time, or ratios of distances are right and distances too short"
        )
    reading.contents.set_field(part.name, t + reading.shift_s(part), values, metro=True)


def _read_recorder_field(part: Part, reading: TraceReading) -> None:
    t, values = read_raw_data(part, reading.declaration.sensors.sensor_count, reading.limits, reading.report)
    _check_left_out(part.name, t.size, reading)
    reading.contents.set_field(part.name, t + reading.shift_s(part), values, metro=True)


def _read_recorder_speed(part: Part, reading: TraceReading) -> None:
    t, speed = read_raw_series(part, "Speed", reading.limits, reading.report)
    _check_left_out(part.name, t.size, reading)
    reading.contents.speeds.append((Series(part.name, t + reading.shift_s(part), speed), "km/h"))


def _read_recorder_steering(part: Part, reading: TraceReading) -> None:
    t, _angle = read_raw_series(part, "SWA", reading.limits, reading.report)
    reason = "the steering wheel's angle is not the heading, and is not used"
    reading.report.leave_out(part.name, "steering-wheel-angle", t.size, reason)
    reading.report.warn(f"{part.name}: {reason}")


def _read_bag(part: Part, reading: TraceReading) -> None:
    from app.formats.bags.drive import read_fields  # only here: the libraries are an extra

    found = read_fields(part.as_file(), reading.declaration.sensors.sensor_count, reading.limits.rows)
    shift_s = reading.shift_s(part)
    reading.contents.set_field(part.name, found.t_s + shift_s, found.field_t, metro=False)
    if reading.declaration.unit is None:
        np.multiply(found.field_t, np.float32(_UT_PER_TESLA), out=found.field_t)
        reading.contents.unit = "uT"
    if found.unused_speeds:
        shown = ", ".join(name[:80] for name in found.unused_speeds[:8])
        reading.report.warn(f"{part.name} has several topics of speeds; the first by name is used, not {shown}")
    if found.speed is not None:
        reading.contents.speeds.append(
            (Series(f"the speed in {part.name}", found.speed[0] + shift_s, found.speed[1]), "m/s")
        )


def _read_csv(part: Part, reading: TraceReading) -> None:
    _take_table(part, read_csv(part, reading.declaration, reading.limits, reading.report), reading)


def _read_parquet(part: Part, reading: TraceReading) -> None:
    _take_table(part, read_parquet(part, reading.declaration, reading.limits, reading.report), reading)


def _take_table(part: Part, table: Table, reading: TraceReading) -> None:
    contents, columns = reading.contents, reading.declaration.table
    _check_left_out(part.name, table.t_s.size, reading)
    t_s = table.t_s + reading.shift_s(part)
    if table.field is not None:
        contents.set_field(part.name, t_s, table.field, metro=False)
    if table.speed is not None:
        contents.speeds.append((Series(part.name, t_s, table.speed), columns.speed_unit))
    if table.heading is not None:
        contents.headings.append((Series(part.name, t_s, table.heading), columns.heading_unit))


def _read_can(part: Part, reading: TraceReading) -> None:
    declared = reading.declaration.can
    if declared is None:
        raise InvalidParameter(
            f"{part.name} is a CAN log, and it is not declared where its speed is",
            field="can",
            limit="signals of speed or heading",
            cure="name signals of a DBC, or declare identifier, bits and scaling",
        )
    series = read_can_log(part, reading.dbc, declared, reading.limits, reading.report)
    reading.contents.can.append((part.name, series))


def _read_dbc(_part: Part, _reading: TraceReading) -> None:
    """Nothing: CAN logs are read with it."""


def _check_left_out(part: str, read: int, reading: TraceReading) -> None:
    """Refuse a file with too many malformed rows; held values are thinned, so any series that was read counts."""
    max_share = reading.limits.left_out
    lost = [entry for entry in reading.report.left_out if entry.part == part and entry.what == "rows-malformed"]
    if not read or (lost and lost[0].count > max(max_share * (read + lost[0].count), 1)):
        reason = f"{lost[0].count} rows cannot be read, first: {lost[0].reason}" if lost else "it has no rows"
        raise UnreadableUpload(
            f"{part}: {reason}",
            field=part,
            limit=f"{100 * max_share:g} % of the rows" if lost else "one row or more",
            cure="export it again; decimal commas, delimiters and units of time must be declared"
            if lost
            else "send the file again, whole",
        )


# --- detection ----------------------------------------------------------------------------------------------------


def _detect_stream(sample: Sample) -> Confidence:
    return Confidence.NONE if sample.is_text else Confidence.PLAUSIBLE


def _detect_text(sample: Sample) -> Confidence:
    """Text that may be a table or a log: more plausible if its first line does not begin with a number."""
    if not sample.is_text:
        return Confidence.NONE
    starts_with_name = re.match(r"[^\d\s]", sample.start)
    return Confidence.PLAUSIBLE if starts_with_name else Confidence.POSSIBLE


def _detect_dbc(sample: Sample) -> Confidence:
    if sample.is_text and sample.data.lstrip().startswith((b"VERSION", b"NS_ :")):
        return Confidence.CERTAIN
    return _detect_text(sample) if sample.suffix == ".dbc" else Confidence.NONE


def _detect_can(sample: Sample) -> Confidence:
    if sample.data.startswith(b"LOGG"):
        return Confidence.CERTAIN
    if not sample.is_clean_text:
        return Confidence.NONE
    if "arbitration_id" in _columns(sample) or SAVVYCAN_HEADER.match(sample.start) or _CANDUMP.match(sample.start):
        return Confidence.LIKELY
    return _detect_text(sample) if sample.suffix in _CAN_SUFFIXES else Confidence.NONE


def _detect_recorder(sample: Sample, is_column: Callable[[str], bool]) -> Confidence:
    names = _columns(sample)
    found = "time stamp" in names and any(map(is_column, names))
    return Confidence.LIKELY if found else Confidence.NONE


def _detect_csv(sample: Sample) -> Confidence:
    if any(map(_TRACE_COLUMN.match, _columns(sample))):
        return Confidence.LIKELY
    return _detect_text(sample)


def _columns(sample: Sample) -> list[str]:
    """Names in the first line of a text, in lower case."""
    return [name.strip('"').lower() for name in sample.log.columns] if sample.is_text else []


_STREAM: Format[TraceReader] = Format(TraceFormat.STREAM, Use.TRACE, "METRO stream", _detect_stream, _read_stream)
TRACE_FORMATS: tuple[Format[TraceReader], ...] = (
    Format(TraceFormat.PARQUET, Use.TRACE, "Parquet", detect_signature(b"PAR1"), _read_parquet),
    Format(TraceFormat.BAG, Use.TRACE, "bag (MCAP, .db3, ROS 1)", detect_signature(*SIGNATURES), _read_bag),
    Format(TraceFormat.DBC, Use.TRACE, "DBC", _detect_dbc, _read_dbc),
    Format(TraceFormat.CAN, Use.TRACE, "CAN log (asc, blf, csv, log, trc)", _detect_can, _read_can),
    Format(
        TraceFormat.RECORDER_FIELD,
        Use.TRACE,
        "RawData of the METRO recorder",
        lambda sample: _detect_recorder(sample, lambda name: name.startswith("sensor ")),
        _read_recorder_field,
    ),
    Format(
        TraceFormat.RECORDER_SPEED,
        Use.TRACE,
        "RawSpeed",
        lambda sample: _detect_recorder(sample, lambda name: name == "speed"),
        _read_recorder_speed,
    ),
    Format(
        TraceFormat.RECORDER_STEERING,
        Use.TRACE,
        "RawSWA",
        lambda sample: _detect_recorder(sample, lambda name: name == "swa"),
        _read_recorder_steering,
    ),
    Format(TraceFormat.CSV, Use.TRACE, "CSV", _detect_csv, _read_csv),
    _STREAM,
)


def find_trace_format(part: Part, declared: str | None) -> Format[TraceReader]:
    """The format of a file: the declared one, or the one that its content shows.

    Raises
    ------
    UnsupportedUpload
        The suffix is that of a text file, and the file is not text.
    """
    if declared is not None:
        return next(found for found in TRACE_FORMATS if found.name == TraceFormat(declared))
    sample = Sample(part.name, part.head)
    is_text = sample.is_clean_text
    if not is_text and sample.suffix in _TEXT_SUFFIXES and not sample.data.startswith(_BINARY_SIGNATURES):
        raise UnsupportedUpload(
            f"{part.name} is not text, although its name has the suffix of a text file",
            field=part.name,
            limit=list_accepted(TRACE_FORMATS),
            cure="export it as one of these, text as UTF-8",
        )
    candidates = [found for found in TRACE_FORMATS if is_text or found.name in _BINARY]
    return detect_format(sample, candidates) or _STREAM
