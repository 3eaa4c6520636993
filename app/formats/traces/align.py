"""The offset between a CAN log's clock and the trace's, by the wheels that the reference sensors hear.

A magnetised wheel turns with the frequency v / circumference: where the speed changes, the lines in the spectrogram of
the reference sensors follow it at one offset only. Without wheels or changes of speed there is nothing to align by.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter
from app.formats.traces.report import TraceReport
from app.formats.traces.series import Series

Floats = npt.NDArray[np.float64]

_RATE_HZ = 100.0  # [Hz] of the spectrogram's signal; source: by hand, a wheel's second harmonic is slower
_WINDOW, _PADDED = 128, 512  # samples of a window and of its transform; source: by hand, 1.3 s, bins of 0.2 Hz
_FRAMES = 1200  # windows at most; source: by hand, bounds the time
_COARSE_S, _FINE_S = 0.2, 0.02  # [s] steps of the offset; source: by hand, below the length of a window
_CIRCUMFERENCE_M = np.linspace(1.5, 2.6, 56)  # [m] trial lengths of a turn; source: tyres from small cars to vans
_MIN_SPEED_M_S = 2.0  # [m/s] slower windows are left out; source: by hand, the lines are below 1 Hz there
_MIN_DEVIATIONS = 6.0  # by which the best offset must exceed the mean of the others; source: by hand
_MIN_LEAD = 1.15  # of the best offset over the next one; source: by hand
_APART_S = 1.5  # [s] offsets further apart than this are others; source: by hand, longer than a window
_MAX_WORK = 3e8  # offsets times windows times circumferences; source: by hand, bounds the time


def align_speed(
    t: Floats,
    field_ut: npt.NDArray[np.floating],
    references: tuple[int, ...],
    speed: Series | None,
    part: str,
    report: TraceReport,
) -> float:
    """Trace time of the CAN log's first frame. [s]

    Parameters
    ----------
    t : ndarray, shape (T,)
    field_ut : ndarray, shape (T, S, 3)
    references : tuple of int
        Indices of the sensors near the wheels.
    speed : Series or None
        Over times after the log's first frame.

    Raises
    ------
    InvalidParameter
        There is nothing to align by, or no offset stands out.
    """
    near = [i for i in references if i < field_ut.shape[1]]
    if speed is None or speed.t_s.size < 10 or not near:
        raise _undecided(part, "it holds no speed" if near else "no reference sensor near a wheel is declared")
    at, lines = _spectrogram(t, field_ut[:, near])
    if not at.size:
        raise _undecided(part, "the trace is too short")
    duration, log = t[-1] - t[0], speed.t_s[-1] - speed.t_s[0]
    shared = 0.6 * min(duration, log)
    lags = np.arange(t[0] - log + shared, t[-1] - shared + _COARSE_S, _COARSE_S) - speed.t_s[0]
    if lags.size * at.size * _CIRCUMFERENCE_M.size > _MAX_WORK:
        raise _undecided(part, "trace and log are too long to search all offsets")
    coarse = np.array([_follow(at, lines, speed, lag, _CIRCUMFERENCE_M) for lag in lags])
    best = int(np.argmax(coarse.max(1)))
    score = coarse.max(1)
    others = score[np.abs(lags - lags[best]) > _APART_S]
    if others.size < 5:
        raise _undecided(part, "trace and log are too short")
    deviations = (score[best] - others.mean()) / max(float(others.std()), 1e-9)
    if deviations < _MIN_DEVIATIONS or score[best] < _MIN_LEAD * others.max():
        lead = score[best] / max(float(others.max()), 1e-9)
        raise _undecided(part, f"no offset stands out ({deviations:.1f} deviations, {lead:.2f} times the next)")
    around = _CIRCUMFERENCE_M[int(np.argmax(coarse[best]))] * np.linspace(0.98, 1.02, 17)
    fine = np.arange(lags[best] - 2 * _COARSE_S, lags[best] + 2 * _COARSE_S, _FINE_S)
    curve = np.array([_follow(at, lines, speed, lag, around).max() for lag in fine])
    top = curve > curve.max() - 0.25 * (curve.max() - curve.min())
    offset = float(np.average(fine[top], weights=curve[top] - curve[top].min() + 1e-9))
    report.warn(f"{part} was aligned by the wheels' noise: its first frame is at {offset:.2f} s of the trace")
    return offset


def _spectrogram(t: Floats, field_ut: npt.NDArray[np.floating]) -> tuple[Floats, Floats]:
    """Middle times of windows (W,) and how far each frequency stands out in them (W, F), clipped."""
    grid = np.arange(t[0], t[-1], 1 / _RATE_HZ)
    last = grid.size - _WINDOW
    if last < 10:
        return np.empty(0), np.empty((0, 0))
    starts = np.arange(0, last, max(25, last // _FRAMES))
    window = np.hanning(_WINDOW)
    power = np.zeros((starts.size, _PADDED // 2 + 1))
    ramp = np.linspace(-1, 1, _WINDOW)
    for channel in field_ut.reshape(len(field_ut), -1).T:
        ok = np.isfinite(channel)
        if ok.sum() < 2:
            continue
        even = np.interp(grid, t[ok], channel[ok].astype(float))
        pieces = even[starts[:, None] + np.arange(_WINDOW)]
        pieces = pieces - pieces.mean(1, keepdims=True)
        pieces -= (pieces @ ramp)[:, None] / (ramp @ ramp) * ramp
        power += np.abs(np.fft.rfft(pieces * window, _PADDED, axis=1)) ** 2
    level = np.log(power + 1e-9)
    level -= np.median(level, axis=1, keepdims=True)
    return grid[starts] + _WINDOW / 2 / _RATE_HZ, np.clip(level, 0, 5)


def _follow(at: Floats, lines: Floats, speed: Series, lag: float, circumference_m: Floats) -> Floats:
    """How much stands out at the wheel's frequency and twice it, mean over the windows, for each circumference."""
    v = np.abs(np.interp(at - lag, speed.t_s, speed.value, left=np.nan, right=np.nan))
    moving = np.flatnonzero(v > _MIN_SPEED_M_S)
    if moving.size < 0.3 * at.size:
        return np.zeros(circumference_m.size)
    bin_hz = _RATE_HZ / _PADDED
    index = v[moving, None] / (circumference_m * bin_hz)
    limit = lines.shape[1] - 1
    first = np.minimum(np.round(index).astype(np.intp), limit)
    second = np.minimum(np.round(2 * index).astype(np.intp), limit)
    rows = moving[:, None]
    standing: Floats = (lines[rows, first] + lines[rows, second]).mean(0)
    return standing - float(lines[moving].mean())


def _undecided(part: str, why: str) -> InvalidParameter:
    return InvalidParameter(
        f"the clock of {part} cannot be aligned with the trace: {why}",
        field="can.offset_s",
        limit="changes of speed and wheels that the reference sensors hear, or a declared offset",
        cure="declare the trace time of the log's first frame",
    )
