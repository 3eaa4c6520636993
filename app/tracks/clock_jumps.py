"""Clocks that were set while a sensor recorded."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from app.tracks.types import Floats, Ints, PositionFix

if TYPE_CHECKING:
    from app.tracks.estimate import Segment

_MIN_STEP_S = 0.1  # [s] smaller steps are the drift of a clock; source: by hand
_MIN_FIXES = 3  # on both sides; source: by hand, two could be outliers
_SIGMAS = 5.0  # of a step over its standard error; source: by hand
_BACK_S = 0.5  # [s] a step back in the order of the frames that is no late frame; source: by hand
_MAX_BACK = 3  # steps back of a clock; more of them are no steps of a clock; source: by hand
_BACK_SIGMA_S = 5.0  # [s] error of a clock after a step back, at least; source: by hand
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
    fixes : tuple of PositionFix
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
        by_source.setdefault((fix.clock, fix.source), []).append(k)
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
