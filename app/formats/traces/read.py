"""The files of one recording and what is declared of them, to one trace and a report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter
from app.formats.traces.can_log import align_speed
from app.formats.traces.declaration import (
    M_S_PER_UNIT,
    UT_PER_UNIT,
    AngleUnit,
    AxisConvention,
    FieldUnit,
    SpeedUnit,
    TraceDeclaration,
    TraceFile,
    TraceFormat,
    TraceLimits,
    TraceReport,
)
from app.formats.traces.formats import TraceContents, TraceReading, find_trace_format
from app.formats.traces.parts import (
    Series,
    check_sampling,
    clean_heading,
    clean_speed,
    coverage,
    open_parts,
    rising_rows,
)
from app.sensors.magnetometer_bar import MAX_FIELD_UT, MagnetTrace
from app.values import Floats, Floats32

# === From recorded numbers to microtesla in vehicle axes, and whether the declared unit is plausible.


EARTH_UT = (15.0, 75.0)
"""Plausible magnitudes of the field at calibrated sensors. [uT] Source: the earth's field at the surface is 22 to 67 uT
(World Magnetic Model); margin for the iron of a car by hand."""
_RAW_UT = (8.0, 2000.0)  # [uT] plausible median magnitudes at raw sensors; offsets of hundreds of uT
_AGREE = 0.2  # share by which the means of calibrated sensors differ at most
_CHECKED = 20_000  # samples by which the unit is checked; speed only
_BLOCK = 1 << 16  # samples that are converted at a time; bounds the memory
_VEHICLE_FROM: dict[AxisConvention, tuple[int, int, int]] = {"ISO8855": (1, 1, 1), "FLU": (1, 1, 1), "FRD": (1, -1, -1)}


def convert_field(
    field: Floats32, part: str, declaration: TraceDeclaration, metro: bool, report: TraceReport,
    known_unit: FieldUnit | None = None,
) -> Floats32:  # fmt: skip
    """Recorded values as microtesla in ISO 8855; what is damaged becomes NaN. Changes its input.

    Raises
    ------
    InvalidParameter
        Unit or axes are not declared where the format does not fix them, or the unit is implausible.
    """
    unit = declaration.unit or known_unit or ("uT" if metro else None)
    axes = declaration.axes or ("FRD" if metro else None)
    if unit is None:
        raise InvalidParameter(
            f"the unit of the field in {part} is not declared",
            field="unit",
            limit=", ".join(UT_PER_UNIT),
            cure="declare it",
        )
    turns = declaration.sensors.vehicle_from_sensor if declaration.bar and declaration.bar.is_turned else None
    if axes is None and turns is None:
        raise InvalidParameter(
            f"the axes of the field in {part} are not declared",
            field="axes",
            limit=", ".join(_VEHICLE_FROM),
            cure="declare them, or the rotation of each sensor",
        )
    scale = np.float32(UT_PER_UNIT[unit])
    some = field[:: max(len(field) // _CHECKED, 1)] * scale
    _check_unit(some, part, unit, declaration)
    signs = np.array(_VEHICLE_FROM[axes] if axes else (1, 1, 1), np.float32)
    empty = wild = 0
    for at in range(0, len(field), _BLOCK):  # an hour's trace is not copied
        piece = field[at : at + _BLOCK]
        piece *= scale
        missing = ~np.isfinite(piece).all(2)
        with np.errstate(invalid="ignore"):
            beyond = ~missing & ~(np.abs(piece) <= MAX_FIELD_UT).all(2)
        empty, wild = empty + int(missing.sum()), wild + int(beyond.sum())
        piece[missing | beyond] = np.nan
        piece[:] = piece * signs if turns is None else np.einsum("sij,tsj->tsi", turns.astype(np.float32), piece)
    report.leave_out(part, "values-missing", empty, "samples of a sensor, empty or not finite")
    report.leave_out(part, "values-damaged", wild, f"samples of a sensor beyond {MAX_FIELD_UT:g} uT")
    _warn_dead_sensors(field, part, report)
    return field


def _check_unit(field: Floats32, part: str, unit: FieldUnit, declaration: TraceDeclaration) -> None:
    """Refuse a unit in which the earth's field, which every magnetometer sees, would be impossible."""
    if declaration.background_removed:
        return
    some = field.astype(float)
    some[~np.isfinite(some)] = np.nan
    some = some[:, np.isfinite(some).any((0, 2))]
    some = some[np.isfinite(some).all((1, 2))]
    if not len(some):
        return
    means = np.median(some, axis=0)
    size = float(np.median(np.linalg.norm(means, axis=1)))
    middle = np.median(means, axis=0)
    apart = float(np.median(np.linalg.norm(means - middle, axis=1)))
    agree = declaration.calibrated or (len(means) >= 4 and apart < _AGREE * max(float(np.linalg.norm(middle)), 1e-12))
    low, high = EARTH_UT if agree else _RAW_UT
    if low <= size <= high:
        return
    fitting = [u for u in UT_PER_UNIT if u != unit and low <= size * UT_PER_UNIT[u] / UT_PER_UNIT[unit] <= high]
    raise InvalidParameter(
        f"with {unit}, {part} has a field of {size:.4g} uT at a sensor"
        + (" after calibration" if declaration.calibrated else ", the same at all of them" if agree else ""),
        field="unit",
        limit=f"{low:g} to {high:g} uT: the earth's field" + ("" if agree else " and the sensors' offsets"),
        cure=f"the values look like {' or '.join(fitting)}: declare that unit"
        if fitting
        else "check the unit and the offsets, or declare that the background was removed",
    )


def _warn_dead_sensors(field: Floats32, part: str, report: TraceReport) -> None:
    some = field[:: max(len(field) // _CHECKED, 1)]
    for i in range(field.shape[1]):
        values = some[:, i]
        ok = np.isfinite(values).all(1)
        if not ok.any():
            report.warn(f"sensor {i + 1} of {part} has no values")
        elif ok.sum() > 10 and not np.ptp(values[ok], axis=0).any():
            report.warn(f"sensor {i + 1} of {part} always shows the same value")


# === The files of one recording and what is declared of them, to one trace and a report.


_EPOCH_S = 1e6  # [s] a first time above this counts from some epoch, so the trace starts at 0; 11 days
_MISSING_SPEED_CURE = "send the recorder's RawSpeed file, a CAN log or a speed column, or declare a constant speed"
_SPEED_ALIASES = {"kph": "km/h", "kmh": "km/h", "kmph": "km/h", "mps": "m/s", "mi/h": "mph", "knots": "kn", "kt": "kn"}


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
    declaration.check()
    report = TraceReport()
    opened = open_parts(parts, limits)
    formats = {part.name: find_trace_format(part, (declaration.formats or {}).get(part.name)) for part in opened}
    report.formats |= {name: TraceFormat(found.name) for name, found in formats.items()}
    dbc = [part for part in opened if report.formats[part.name] is TraceFormat.DBC]
    reading = TraceReading(declaration, limits, report, dbc)
    for part in opened:
        formats[part.name].read(part, reading)
        if shift_s := reading.shift_s(part):
            report.clock_offsets_s[part.name] = shift_s
    return _assemble(reading.contents, declaration, limits, report)


def _assemble(
    found: TraceContents, declaration: TraceDeclaration, limits: TraceLimits, report: TraceReport
) -> TraceFile:
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
            report.clock_offsets_s[name] = (declaration.clock_offsets_s or {}).get(name, 0.0) - origin
    check_sampling(t, found.field_part, limits, report)
    values = convert_field(values, found.field_part, declaration, found.metro, report, found.unit)

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
    found: TraceContents,
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
            offset = align_speed(t, values, declaration.sensors.references, cleaned.get("speed"), part, report)
        report.clock_offsets_s[part] = offset
        if "speed" in cleaned:
            speeds.insert(0, Series(part, cleaned["speed"].t_s + offset, cleaned["speed"].value))
        if "heading" in cleaned:
            headings.insert(0, Series(part, cleaned["heading"].t_s + offset, cleaned["heading"].value))


def _speed_unit(unit: str | None, part: str) -> SpeedUnit:
    text = (unit or "").strip().lower()
    text = _SPEED_ALIASES.get(text, text)
    if found := next((known for known in M_S_PER_UNIT if known == text), None):
        return found
    raise InvalidParameter(
        f"the unit of speed in {part} is {unit!r}" if unit else f"the unit of speed in {part} is not declared",
        field="can.speed.unit",
        limit=", ".join(M_S_PER_UNIT),
        cure="declare the unit of the signal",
    )


def _angle_unit(unit: str | None, part: str) -> AngleUnit:
    text = (unit or "").strip().lower()
    if text in ("deg", "degree", "degrees", "°"):
        return "deg"
    if text in ("rad", "radian", "radians"):
        return "rad"
    raise InvalidParameter(
        f"the unit of heading in {part} is {unit!r}" if unit else f"the unit of heading in {part} is not declared",
        field="can.heading.unit",
        limit="deg, rad",
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
