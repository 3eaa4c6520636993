"""The times of a drive: nodes on one clock over the data of all sensors, and what cannot be one drive."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from app.errors import InvalidParameter
from app.tracks.types import CLOCKS, MAX_CLOCK_SIGMA_S, Clock, PositionFix, Samples, TrackInput
from app.values import Floats, Ints

if TYPE_CHECKING:
    from app.tracks.estimate import Segment


# === Clocks that were set while a sensor recorded.


_MIN_STEP_S = 0.1  # [s] smaller steps are the drift of a clock
_MIN_FIXES = 3  # on both sides; two could be outliers
_SIGMAS = 5.0  # of a step over its standard error
_BACK_S = 0.5  # [s] a step back in the order of the frames that is no late frame
_MAX_BACK = 3  # steps back of a clock; more of them are no steps of a clock
_BACK_SIGMA_S = 5.0  # [s] error of a clock after a step back, at least
_MAD_TO_SIGMA = 1.4826  # source: normal distribution, 1 / 0.6745


@dataclass(frozen=True, slots=True, eq=False)
class Jump:
    """A step of a sensor's clock: time of the first fix after it, on that clock, and offsets on both sides. [s]"""

    first_s: float
    before_s: float
    after_s: float


def split_where_time_falls(
    fixes: tuple[PositionFix, ...], segment_of: Ints, segments: list[Segment]
) -> tuple[Ints, int]:
    """Give each part of a source whose times run backwards an offset of its own.

    Parameters
    ----------
    segment_of : ndarray of int, shape (K,)
    segments : list of Segment
        Those of new parts are appended.

    Returns
    -------
    segment_of : ndarray of int, shape (K,)
    count : int
        Steps back that were found.
    """
    found, segment_of = 0, segment_of.copy()
    by_source: dict[tuple[str, str], list[int]] = {}
    for k, fix in enumerate(fixes):
        by_source.setdefault((fix.clock, fix.decode_id), []).append(k)
    for members in by_source.values():
        rows = np.array(sorted(members, key=lambda k: (fixes[k].place, fixes[k].time_s)))
        place = np.array([fixes[k].place for k in rows])
        fallen = np.diff([fixes[k].time_s for k in rows]) < -_BACK_S
        starts = np.flatnonzero(fallen & (np.diff(place) > 0)) + 1
        if starts.size > _MAX_BACK or (np.diff(np.r_[0, starts, rows.size]) < _MIN_FIXES).any():
            continue  # the pictures are in another order than that of their times
        for start in starts:
            old = segments[segment_of[rows[start]]]
            clock = replace(old.clock, sigma_s=max(old.clock.sigma_s, _BACK_SIGMA_S))
            segments.append(replace(old, jumped=True, is_reference=False, clock=clock))
            segment_of[rows[start:]] = len(segments) - 1
            found += 1
    return segment_of, found


def find_jump(time_s: Floats, offset_s: Floats) -> Jump | None:
    """The step of a clock whose offset was estimated at each fix.

    A clock that was set divides the offsets into two groups; a wrong marker stands alone.

    Parameters
    ----------
    time_s, offset_s : ndarray, shape (K,)
        Times of a clock's fixes, rising, and its offset at each, by a smoother that lets it change. [s]
    """
    if time_s.size < 2 * _MIN_FIXES:
        return None
    splits = range(_MIN_FIXES, time_s.size - _MIN_FIXES + 1)
    i = min(splits, key=lambda i: _spread(offset_s[:i]) + _spread(offset_s[i:]))
    left, right = offset_s[:i], offset_s[i:]
    before, after = float(np.median(left)), float(np.median(right))
    noise = _MAD_TO_SIGMA * float(np.median(np.abs(np.r_[left - before, right - after])))
    if abs(after - before) < max(_MIN_STEP_S, _SIGMAS * noise / np.sqrt(min(i, time_s.size - i))):
        return None
    return Jump(float(time_s[i]), before, after)


def _spread(values: Floats) -> float:
    return float(np.abs(values - np.median(values)).sum())


# === Clocks of sensors that both know the speed: the offset at which their speeds agree.


_STEP_S = 0.1  # [s] the smoother finds the rest
_MIN_OVERLAP_S = 20.0  # [s] one junction
_MIN_CHANGE_M_S = 0.5  # [m/s] standard deviation of a speed that has a shape
_MIN_CORRELATION = 0.9  # the same car
_MIN_LEAD = 0.02  # over offsets that are more than `_APART_S` away
_APART_S = 2.0  # [s]
_SEARCH_SIGMAS, _MIN_SEARCH_S = 4.0, 2.0
_FOUND_SIGMA_S = 0.3  # [s] of an offset that was found so; three steps


def align_clocks(given: TrackInput, clocks: dict[str, Clock]) -> TrackInput:
    """Set the offsets of clocks by the speeds, compared with those of the clock that has most of them."""
    longest: dict[str, Samples] = {}
    for series in given.speeds:
        if series.clock not in longest or series.time_s.size > longest[series.clock].time_s.size:
            longest[series.clock] = series
    if len(longest) < 2:
        return given
    reference = min(longest, key=lambda name: (-longest[name].time_s.size, name))
    found = dict(clocks)
    for name, series in longest.items():
        clock = clocks[name]
        if name == reference or clock.sigma_s == 0:
            continue
        lag = _best_lag(longest[reference], clocks[reference], series, clock)
        if lag is not None:
            sigma = min(max(clock.sigma_s, 1e-3), _FOUND_SIGMA_S, MAX_CLOCK_SIGMA_S)
            found[name] = replace(clock, offset_s=clock.offset_s + lag, sigma_s=sigma)
    return replace(given, clocks=tuple(found.values()))


def _best_lag(reference: Samples, reference_clock: Clock, series: Samples, clock: Clock) -> float | None:
    """What is to be added to the offset; None where no offset stands out."""
    reach = max(_SEARCH_SIGMAS * clock.sigma_s, _MIN_SEARCH_S)
    t, own = reference.time_s + reference_clock.offset_s, series.time_s + clock.offset_s
    start, end = max(t[0], own[0]) + reach, min(t[-1], own[-1]) - reach
    if end - start < _MIN_OVERLAP_S:
        return None
    at = np.arange(start, end, _STEP_S)
    first = np.interp(at, t, reference.value)
    if first.std() < _MIN_CHANGE_M_S:
        return None
    lags = np.arange(-reach, reach + _STEP_S / 2, _STEP_S)
    score = np.array([_correlation(first, np.interp(at - lag, own, series.value)) for lag in lags])
    best = int(np.argmax(score))
    others = score[np.abs(lags - lags[best]) > _APART_S]
    if score[best] < _MIN_CORRELATION or (others.size and score[best] < others.max() + _MIN_LEAD):
        return None
    return float(lags[best])


def _correlation(a: Floats, b: Floats) -> float:
    a, b = a - a.mean(), b - b.mean()
    return float(a @ b) / max(float(np.sqrt((a @ a) * (b @ b))), 1e-9)


# === The times of a drive.


STEP_S = 0.1
"""Time between nodes. [s] A car turns by less than 3 deg and brakes by less than 1 m/s in it."""
MAX_NUMBERS = 36_500_000
"""Numbers in the covariances of all nodes at most, 0.3 GB. Source: `python -m benchmarks.track --hours 10`, which stays
below the memory and the time of a decoder process: 89 s and 1.2 GB, the simulation with it, for 34,500,000."""
MAX_PAUSE_S = 600.0
"""Longest time without any data that a track leads across. [s] A constant speed is no forecast for ten minutes, but a
wait at a ferry is one drive."""
_NEAR_S = 1.0  # [s] a node has a speed or a heading if a sample is so near; source: app/formats/traces/parts.py


@dataclass(frozen=True, slots=True, eq=False)
class TimeBase:
    """Nodes on the reference clock: time of the first [s], step [s], and their number."""

    start_s: float
    step_s: float
    count: int

    @property
    def time_s(self) -> Floats:
        """Of the nodes. [s]"""
        return np.asarray(self.start_s + self.step_s * np.arange(self.count), dtype=np.float64)

    def nearest(self, time_s: Floats) -> tuple[np.ndarray, Floats]:
        """The nearest nodes, and how long after them the times are. [s]"""
        node = np.clip(np.rint((time_s - self.start_s) / self.step_s), 0, self.count - 1).astype(np.int64)
        return node, time_s - (self.start_s + self.step_s * node)


def check_times(given: TrackInput) -> None:
    """Refuse what has no track, without estimating one.

    Raises
    ------
    InvalidParameter
        The drive is too long for the number of its clocks, sensors do not overlap in time, or a clock is not declared.
    """
    time_base(given, checked_clocks(given))


def checked_clocks(given: TrackInput) -> dict[str, Clock]:
    """The clocks of a drive by name; refuses names that appear twice or are not declared."""
    clocks = {clock.name: clock for clock in given.clocks}
    if len(clocks) != len(given.clocks):
        raise InvalidParameter("two clocks have the same name", field="clocks", limit="each name once")
    samples = (*given.speeds, *given.headings)
    used = [*(fix.clock for fix in given.fixes), *(series.clock for series in samples)]
    missing = next((name for name in used if name not in clocks), None)
    if missing is not None:
        raise InvalidParameter(f"the clock {missing} is not declared", field="clocks", limit="all that are used")
    return clocks


def time_base(given: TrackInput, clocks: dict[str, Clock]) -> tuple[TimeBase, list[tuple[float, float]]]:
    """Nodes over all data, and the pauses in which no sensor recorded.

    Raises
    ------
    InvalidParameter
        There are no times, or sensors do not overlap and are too far apart.
    """
    spans: list[tuple[float, float, str]] = []
    for series in (*given.speeds, *given.headings):
        if series.time_s.size:
            offset = clocks[series.clock].offset_s
            breaks = np.flatnonzero(np.diff(series.time_s) > _NEAR_S)
            edges = np.r_[-1, breaks, series.time_s.size - 1]
            for a, b in pairwise(edges.tolist()):
                spans.append((series.time_s[a + 1] + offset, series.time_s[b] + offset, series.clock))
    spans += [(fix.time_s + clocks[fix.clock].offset_s,) * 2 + (fix.clock,) for fix in given.fixes]
    if not spans:
        raise InvalidParameter(
            "no upload has a position, a speed or a heading with a time",
            field="decodes",
            limit="one or more fixes of registered markers with a time",
            cure="send captured_at with each upload, and decode markers that are registered",
        )
    spans.sort()
    pauses, end, last = [], spans[0][1], spans[0][2]
    for first, to, clock in spans:
        if first - end > MAX_PAUSE_S:
            raise InvalidParameter(
                f"the sensors do not overlap in time: {last} ends {first - end:.0f} s before {clock} begins",
                field="decodes",
                limit=f"at most {MAX_PAUSE_S:g} s without data",
                cure="check captured_at of both; declare offset_s of a clock that was set wrong, or make two drives",
            )
        if first > end + _NEAR_S:
            pauses.append((end, first))
        if to >= end:
            end, last = to, clock
    margin = 1.0 + 3.0 * max((clock.sigma_s for clock in clocks.values()), default=0.0)
    start, duration = spans[0][0] - margin, end - spans[0][0] + 2 * margin
    base = TimeBase(float(start), STEP_S, math.ceil(duration / STEP_S) + 1)
    _check_size(base, len(clocks))
    return base, pauses


def _check_size(base: TimeBase, clocks: int) -> None:
    """Refuse a drive that is too long for the number of its clocks."""
    unknown = max(clocks - 1, 0)
    most = MAX_NUMBERS / (CLOCKS + unknown) ** 2
    if base.count > most:
        raise InvalidParameter(
            f"the drive takes {base.count * STEP_S / 3600:.1f} h, and offsets of {unknown} clocks are to be estimated",
            field="decodes",
            limit=f"{most * STEP_S / 3600:.1f} h with so many clocks",
            cure="make several drives of it, or give decodes of one sensor the same clock",
        )
