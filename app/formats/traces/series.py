"""Rising times, plausible speeds and headings, gaps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter, UnreadableUpload, UploadTooLarge
from app.formats.traces.declaration import (
    M_S_PER_UNIT,
    AngleUnit,
    SpeedUnit,
    TimeUnit,
    TraceLimits,
)
from app.formats.traces.report import TraceGap, TraceReport

Floats = npt.NDArray[np.float64]

MAX_SPEED_M_S = 100.0
"""Largest plausible speed of a vehicle. [m/s] Source: chosen by hand, 360 km/h."""
NEAR_S = 1.0
"""A sample has a speed or a heading if a value is so near. [s] Source: chosen by hand, as
`app.decoders.magnet.preprocess.MAX_INTERPOLATION_S`."""
_GAP_INTERVALS, _GAP_S = 5.0, 0.02  # a gap is longer than both: in median intervals, [s]; source: by hand
_MAX_RATE_HZ = 20_000.0  # [Hz] largest plausible rate of a bar; source: by hand, METRO's has 350


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """A quantity over time.

    Attributes
    ----------
    part : str
        File that it comes from.
    t_s, value : ndarray, shape (N,)
    """

    part: str
    t_s: Floats
    value: Floats


def rising_rows(t: Floats, part: str, limits: TraceLimits, report: TraceReport) -> npt.NDArray[np.intp]:
    """Rows whose times rise; a few others are left out.

    Raises
    ------
    InvalidParameter
        Time runs backwards for more than a few rows.
    UnreadableUpload
        No row has a time.
    """
    rows = np.flatnonzero(np.isfinite(t))
    report.leave_out(part, "rows-without-time", t.size - rows.size, "the time is empty or not a finite number")
    if not rows.size:
        raise UnreadableUpload(
            f"{part} holds no rows that can be read", field=part, limit="one or more", cure="send the file again, whole"
        )
    at = t[rows]
    if at.size > 2:  # a single time far ahead must not hide all that follow
        ahead = np.flatnonzero((at[1:-1] > at[2:]) & (at[2:] > at[:-2]) & (at[1:-1] > at[:-2])) + 1
        report.leave_out(part, "rows-out-of-time", ahead.size, _where(rows, at, ahead))
        rows, at = np.delete(rows, ahead), np.delete(at, ahead)
    highest = np.maximum.accumulate(at)
    back = np.flatnonzero(at[1:] <= highest[:-1]) + 1
    if back.size > max(limits.left_out * at.size, 1):
        still = np.mean(at[back] == highest[back - 1])
        i = int(back[0])
        raise InvalidParameter(
            f"time {'stands still' if still > 0.5 else 'runs backwards'} in {part} from row {rows[i - 1] + 1} "
            f"({at[i - 1]:.6f} s) to row {rows[i] + 1} ({at[i]:.6f} s), and in {back.size} rows in all",
            field=part,
            limit=f"rising, but for {100 * limits.left_out:g} % of the rows",
            cure="give each row its own time, and cut the recording where the clock was set",
        )
    report.leave_out(part, "rows-out-of-time", back.size, _where(rows, at, back))
    return np.delete(rows, back)


def _where(rows: npt.NDArray[np.intp], at: Floats, which: npt.NDArray[np.intp]) -> str:
    return f"time does not rise at row {rows[which[0]] + 1} ({at[which[0]]:.6f} s)" if which.size else ""


def check_sampling(t: Floats, part: str, limits: TraceLimits, report: TraceReport) -> None:
    """Rate, duration and gaps of the samples.

    Raises
    ------
    InvalidParameter
        A rate that no bar has: most often another unit of time.
    UploadTooLarge
        Longer than the limit.
    """
    if t.size < 2:
        raise UnreadableUpload(
            f"{part} holds {t.size} sample{'s' * (t.size != 1)}", field=part, limit="two or more",
            cure="send the file again, whole",
        )  # fmt: skip
    step = np.diff(t)
    usual = float(np.median(step))
    rate = 1 / usual
    if not max(limits.min_rate_hz * 0.95, 1e-9) <= rate <= _MAX_RATE_HZ:
        units = [
            unit
            for unit, scale in ((TimeUnit.MILLISECOND, 1e3), (TimeUnit.MICROSECOND, 1e6), (TimeUnit.NANOSECOND, 1e9))
            if limits.min_rate_hz <= rate * scale <= 2000
        ]
        cure = f"times look like {units[0].value}: declare the unit of time" if units else "record at a higher rate"
        raise InvalidParameter(
            f"{part} has {rate:.4g} samples a second",
            field="columns.time_unit" if units or rate > _MAX_RATE_HZ else part,
            limit=f"{limits.min_rate_hz:g} to {_MAX_RATE_HZ:g} Hz",
            cure=cure if rate < _MAX_RATE_HZ else "declare the unit of time",
        )
    if t[-1] - t[0] > limits.duration_s:
        raise UploadTooLarge(
            f"{part} lasts {t[-1] - t[0]:.0f} s",
            field=part,
            limit=f"{limits.duration_s:g} s",
            cure="cut the recording into shorter ones",
        )
    for i in np.flatnonzero(step > max(_GAP_INTERVALS * usual, _GAP_S)):
        report.add_gap(TraceGap(part, int(i) + 1, float(t[i]), float(step[i] - usual)))


def clean_speed(series: Series, unit: SpeedUnit, limits: TraceLimits, report: TraceReport) -> Series:
    """Speeds in metres a second, without those that are none.

    Raises
    ------
    InvalidParameter
        Most values are implausible: another unit or scaling.
    """
    value = series.value * M_S_PER_UNIT[unit]
    fast = np.isfinite(value) & (np.abs(value) > MAX_SPEED_M_S)
    if fast.sum() > 0.5 * max(np.isfinite(value).sum(), 1):
        raise InvalidParameter(
            f"most speeds in {series.part} are above {MAX_SPEED_M_S:g} m/s, their median is "
            f"{np.nanmedian(np.abs(value)):.4g} m/s",
            field="speed",
            limit=f"{MAX_SPEED_M_S:g} m/s",
            cure="declare the unit of speed, or the factor of the signal",
        )
    report.leave_out(series.part, "speeds-implausible", int(fast.sum()), f"faster than {MAX_SPEED_M_S:g} m/s")
    cleaned = _finite(Series(series.part, series.t_s, np.where(fast, np.nan, value)), "speed", limits, report)
    if cleaned.value.size and not cleaned.value.any():
        report.warn(f"all speeds in {series.part} are zero")
    return cleaned


def clean_heading(series: Series, unit: AngleUnit, limits: TraceLimits, report: TraceReport) -> Series:
    """Headings in degrees from 0 to 360, without those that are none."""
    value = np.degrees(series.value) if unit is AngleUnit.RADIAN else series.value
    wild = np.isfinite(value) & (np.abs(value) > 720)
    report.leave_out(series.part, "headings-implausible", int(wild.sum()), "beyond two turns")
    with np.errstate(invalid="ignore"):
        value = np.where(wild, np.nan, value) % 360
    return _finite(Series(series.part, series.t_s, value), "heading", limits, report)


def _finite(series: Series, name: str, limits: TraceLimits, report: TraceReport) -> Series:
    ok = np.isfinite(series.value)
    report.leave_out(series.part, f"{name}-missing", int((~ok).sum()), "empty or not a finite number")
    if not ok.any():
        return Series(series.part, np.empty(0), np.empty(0))
    t, value = series.t_s[ok], series.value[ok]
    rows = rising_rows(t, series.part, limits, report)
    return Series(series.part, t[rows], value[rows])


def coverage(t: Floats, series_t: Floats) -> float:
    """Share of the samples with a value of a series near by."""
    if not series_t.size or not t.size:
        return 0.0
    after = np.clip(np.searchsorted(series_t, t), 0, series_t.size - 1)
    before = np.maximum(after - 1, 0)
    near = np.minimum(np.abs(series_t[after] - t), np.abs(series_t[before] - t)) <= NEAR_S
    return float(near.mean())
