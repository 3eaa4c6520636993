"""One entry point: the files of a recording and what is declared of them -> a trace and a report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from app.decoders.traces.align import align_speed
from app.decoders.traces.can_log import CanSeries, read_can_log
from app.decoders.traces.declaration import AngleUnit, SpeedUnit, TraceDeclaration, TraceFormat, TraceLimits
from app.decoders.traces.field import convert_field
from app.decoders.traces.parts import Part, detect_format, open_parts
from app.decoders.traces.recorder import read_raw_data, read_raw_series
from app.decoders.traces.report import TraceFile, TraceReport
from app.decoders.traces.series import Series, check_sampling, clean_heading, clean_speed, coverage, rising_rows
from app.decoders.traces.table import read_csv, read_parquet
from app.decoders.traces.wire import StreamReader
from app.errors import InvalidParameter, UnreadableUpload
from app.sensors.magnetometer_bar import MagnetTrace

Floats = npt.NDArray[np.float64]

_EPOCH_S = 1e6
"""First times above this are counted from some epoch: the trace's start at 0. [s]"""
_MISSING_SPEED_CURE = "send the recorder's RawSpeed file, a CAN log or a speed column, or declare a constant speed"
_SPEED_ALIASES = {"kph": "km/h", "kmh": "km/h", "kmph": "km/h", "mps": "m/s", "mi/h": "mph", "knots": "kn", "kt": "kn"}


@dataclass(slots=True)
class _Found:
    """What the files hold, before it is put together."""

    t_s: Floats | None = None
    field_ut: npt.NDArray[np.float32] | None = None
    field_part: str = ""
    metro: bool = False
    speeds: list[tuple[Series, SpeedUnit]] = field(default_factory=list)
    headings: list[tuple[Series, AngleUnit]] = field(default_factory=list)
    can: list[tuple[str, dict[str, CanSeries]]] = field(default_factory=list)


def read_trace(
    parts: Mapping[str, bytes | BinaryIO],
    declaration: TraceDeclaration | None = None,
    limits: TraceLimits | None = None,
) -> TraceFile:
    """Read the files of one recording.

    Parameters
    ----------
    parts : mapping of str to bytes or binary stream
        Files by name; ZIP archives stand for the files within.
    declaration : TraceDeclaration, optional
        Needed for plain CSV, Parquet and CAN logs.
    limits : TraceLimits, optional

    Returns
    -------
    TraceFile
        The trace in ISO 8855 axes and microtesla, and a report of gaps, clock offsets and what was left out.

    Raises
    ------
    InvalidParameter
        What is declared and what the files hold do not fit: columns, units, axes, times, a missing speed.
    UnreadableUpload, UnsupportedUpload, UploadTooLarge
        A file is damaged, empty, of no kind that is read here, or beyond a limit.
    Unavailable
        An optional library is not installed.
    """
    declaration, limits = declaration or TraceDeclaration(), limits or TraceLimits()
    report = TraceReport()
    opened = open_parts(parts, limits)
    for part in opened:
        kind = declaration.formats.get(part.name)
        report.formats[part.name] = TraceFormat(kind) if kind else detect_format(part)
    found = _Found()
    dbc = [part for part in opened if report.formats[part.name] is TraceFormat.DBC]
    for part in opened:
        _read_part(part, dbc, declaration, limits, report, found)
    return _assemble(found, declaration, limits, report)


def _read_part(
    part: Part,
    dbc: list[Part],
    declaration: TraceDeclaration,
    limits: TraceLimits,
    report: TraceReport,
    found: _Found,
) -> None:
    kind = report.formats[part.name]
    shift = declaration.clock_offsets_s.get(part.name, 0.0)
    columns = declaration.columns
    if kind is TraceFormat.STREAM:
        reader = StreamReader(part.content(), part.name, declaration.sensors, declaration.rate_hz, limits, report)
        t, values = reader.read(declaration.interval_extra_us)
        if not declaration.interval_extra_us:
            report.warn(
                f"the intervals in {part.name} leave out the time of the serial write: its clock may run slow; "
                "declare that time, or ratios of distances are right and distances too short"
            )
        _set_field(found, part.name, t + shift, values, metro=True)
    elif kind is TraceFormat.RECORDER_FIELD:
        t, values = read_raw_data(part, declaration.sensors, limits, report)
        _check_left_out(part.name, t.size, limits, report)
        _set_field(found, part.name, t + shift, values, metro=True)
    elif kind is TraceFormat.RECORDER_SPEED:
        t, speed = read_raw_series(part, "Speed", limits, report)
        _check_left_out(part.name, t.size, limits, report)
        found.speeds.append((Series(part.name, t + shift, speed), SpeedUnit.KM_H))
    elif kind is TraceFormat.RECORDER_STEERING:
        t, _ = read_raw_series(part, "SWA", limits, report)
        reason = "the steering wheel's angle is not the heading, and is not used"
        report.leave_out(part.name, "steering-wheel-angle", t.size, reason)
        report.warn(f"{part.name}: {reason}")
    elif kind in (TraceFormat.CSV, TraceFormat.PARQUET):
        table = (read_csv if kind is TraceFormat.CSV else read_parquet)(part, declaration, limits, report)
        _check_left_out(part.name, table.t_s.size, limits, report)
        if table.field is not None:
            _set_field(found, part.name, table.t_s + shift, table.field, metro=False)
        if table.speed is not None:
            found.speeds.append((Series(part.name, table.t_s + shift, table.speed), columns.speed_unit))
        if table.heading is not None:
            found.headings.append((Series(part.name, table.t_s + shift, table.heading), columns.heading_unit))
    elif kind is TraceFormat.CAN:
        if declaration.can is None:
            raise InvalidParameter(
                f"{part.name} is a CAN log, and it is not declared where its speed is",
                field="can",
                limit="signals of speed or heading",
                cure="name signals of a DBC, or declare identifier, bits and scaling",
            )
        found.can.append((part.name, read_can_log(part, dbc, declaration.can, limits, report)))
    if shift:
        report.clock_offsets_s[part.name] = shift


def _set_field(found: _Found, part: str, t: Floats, values: npt.NDArray[np.float32], *, metro: bool) -> None:
    if found.t_s is not None:
        raise InvalidParameter(
            f"{found.field_part} and {part} both hold magnetic fields",
            field="parts",
            limit="one recording",
            cure="send recordings one by one",
        )
    found.t_s, found.field_ut, found.field_part, found.metro = t, values, part, metro


def _check_left_out(part: str, read: int, limits: TraceLimits, report: TraceReport) -> None:
    """Refuse a file of which too much could not be read; stairs are thinned, so any series that was read counts."""
    lost = [entry for entry in report.left_out if entry.part == part and entry.what == "rows-malformed"]
    if not read or (lost and lost[0].count > max(limits.left_out * (read + lost[0].count), 1)):
        reason = f"{lost[0].count} rows cannot be read, first: {lost[0].reason}" if lost else "it has no rows"
        raise UnreadableUpload(
            f"{part}: {reason}",
            field=part,
            limit=f"{100 * limits.left_out:g} % of the rows" if lost else "one row or more",
            cure="export it again; decimal commas, delimiters and units of time must be declared"
            if lost
            else "send the file again, whole",
        )


def _assemble(found: _Found, declaration: TraceDeclaration, limits: TraceLimits, report: TraceReport) -> TraceFile:
    if found.t_s is None or found.field_ut is None:
        raise InvalidParameter(
            "no file holds magnetic fields",
            field="parts",
            limit="a stream, RawData, CSV or Parquet with the sensors' columns",
            cure="send the magnetometers' recording",
        )
    rows = rising_rows(found.t_s, found.field_part, limits, report)
    t = found.t_s[rows]
    values = found.field_ut[rows] if rows.size < len(found.field_ut) else found.field_ut
    origin = float(t[0]) if abs(t[0]) > _EPOCH_S else 0.0
    if origin:
        t = t - origin
        others = [s.part for s, _ in found.speeds] + [s.part for s, _ in found.headings]
        for name in {found.field_part, *others}:
            report.clock_offsets_s[name] = declaration.clock_offsets_s.get(name, 0.0) - origin
    check_sampling(t, found.field_part, limits, report)
    values = convert_field(values, found.field_part, declaration, found.metro, report)

    def placed(series: Series) -> Series:
        kept = rows if series.part == found.field_part else slice(None)
        return Series(series.part, series.t_s[kept] - origin, series.value[kept])

    speeds = [clean_speed(placed(s), u, limits, report) for s, u in found.speeds]
    headings = [clean_heading(placed(s), u, limits, report) for s, u in found.headings]
    _add_can(found, t, values, declaration, limits, report, speeds, headings)
    speed = _choose_speed(t, speeds, declaration, report)
    heading = _choose(headings, "heading", report)
    heading_t = heading.t_s if heading else None
    report.samples, report.rate_hz = int(t.size), float(1 / np.median(np.diff(t)))
    report.duration_s = float(t[-1] - t[0])
    report.speed_coverage = coverage(t, speed.t_s) if declaration.speed_m_s is None or speeds else 1.0
    report.heading_coverage = coverage(t, heading_t) if heading_t is not None else 0.0
    _check_coverage(t, speed, speeds, report)
    trace = MagnetTrace(t, values, speed.t_s, speed.value, heading_t, heading.value if heading else None)
    return TraceFile(trace, report)


def _add_can(
    found: _Found,
    t: Floats,
    values: npt.NDArray[np.float32],
    declaration: TraceDeclaration,
    limits: TraceLimits,
    report: TraceReport,
    speeds: list[Series],
    headings: list[Series],
) -> None:
    """Put the series of CAN logs on the trace's clock."""
    for part, series in found.can:
        cleaned: dict[str, Series] = {}
        if raw := series.get("speed"):
            cleaned["speed"] = clean_speed(
                Series(part, raw.t_s, raw.value), _speed_unit(raw.unit, part), limits, report
            )
        if raw := series.get("heading"):
            cleaned["heading"] = clean_heading(
                Series(part, raw.t_s, raw.value), _angle_unit(raw.unit, part), limits, report
            )
        assert declaration.can is not None
        offset = declaration.can.offset_s
        if offset is None:
            offset = align_speed(t, values, declaration.references, cleaned.get("speed"), part, report)
        report.clock_offsets_s[part] = offset
        if "speed" in cleaned:
            speeds.insert(0, Series(part, cleaned["speed"].t_s + offset, cleaned["speed"].value))
        if "heading" in cleaned:
            headings.insert(0, Series(part, cleaned["heading"].t_s + offset, cleaned["heading"].value))


def _speed_unit(unit: str | None, part: str) -> SpeedUnit:
    text = (unit or "").strip().lower()
    try:
        return SpeedUnit(_SPEED_ALIASES.get(text, text))
    except ValueError as error:
        raise InvalidParameter(
            f"the unit of speed in {part} is {unit!r}" if unit else f"the unit of speed in {part} is not declared",
            field="can.speed.unit",
            limit=", ".join(u.value for u in SpeedUnit),
            cure="declare the unit of the signal",
        ) from error


def _angle_unit(unit: str | None, part: str) -> AngleUnit:
    text = (unit or "").strip().lower()
    if text in ("deg", "degree", "degrees", "°"):
        return AngleUnit.DEGREE
    if text in ("rad", "radian", "radians"):
        return AngleUnit.RADIAN
    raise InvalidParameter(
        f"the unit of heading in {part} is {unit!r}" if unit else f"the unit of heading in {part} is not declared",
        field="can.heading.unit",
        limit=", ".join(u.value for u in AngleUnit),
        cure="declare the unit of the signal",
    )


def _choose_speed(t: Floats, speeds: list[Series], declaration: TraceDeclaration, report: TraceReport) -> Series:
    chosen = _choose(speeds, "speed", report)
    if chosen is not None:
        return chosen
    if declaration.speed_m_s is not None and not speeds:
        return Series("declared", np.array([t[0], t[-1]]), np.full(2, declaration.speed_m_s))
    raise InvalidParameter(
        "the recording has no speed" if not speeds else f"{speeds[0].part} has no usable speed",
        field="speed",
        limit="one value or more",
        cure=_MISSING_SPEED_CURE,
    )


def _choose(series: list[Series], name: str, report: TraceReport) -> Series | None:
    usable = [s for s in series if s.t_s.size]
    if len(usable) > 1:
        report.warn(
            f"several files have a {name}: {usable[0].part} is used, not {', '.join(s.part for s in usable[1:])}"
        )
    return usable[0] if usable else None


def _check_coverage(t: Floats, speed: Series, speeds: list[Series], report: TraceReport) -> None:
    if not speeds:
        report.warn("the speed is declared, not measured: distances are as good as it is")
        return
    if report.speed_coverage == 0.0:
        raise InvalidParameter(
            f"speeds in {speed.part} run from {speed.t_s[0]:.3f} to {speed.t_s[-1]:.3f} s, "
            f"samples from {t[0]:.3f} to {t[-1]:.3f} s",
            field="clock_offsets_s",
            limit="times that overlap",
            cure="declare the offset between the clocks",
        )
    if report.speed_coverage < 0.99:
        report.warn(
            f"{100 * (1 - report.speed_coverage):.1f} % of the samples have no speed within a second; "
            "the last one is held there"
        )
