"""Markers at even distances: the length between two markers shows how a bend runs between them.

Crews place markers at even distances along the lane's centre or one of its boundaries. Whether they did is found from
the markers' positions, mainly on stretches that hardly turn; in a bend, the length between two markers then shows how
far the lane swings out. A pair of markers that was set a metre too early or too late makes one stretch too short
and the next one too long by as much: their lengths are not used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from app.lanes.smooth_line import SmoothLine
from app.lanes.types import Bools, Floats

_SAME_STATION_M = 1.5  # [m] markers closer along the lane count once; source: by hand, sensitivity 1.00, 1.00
_MIN_SPACING_M = 20.0  # [m] closer markers show the bend by their positions; source: by hand, sensitivity 1.00, 1.02
_TURN_SIGMA_M = 0.5  # [m/rad^2] error of a bend's length; source: by hand, sensitivity 1.02, 0.97
_MIN_LENGTHS = 3  # source: by hand, sensitivity 1.00, 1.00
_MIN_EVEN_SHARE = 0.8  # of the lengths; source: by hand, sensitivity 1.29, 1.29
_EVEN_M = 0.2  # [m] a length this close to a multiple is even; source: by hand, sensitivity 0.98, 1.02
_LENGTH_SIGMA_M = 0.03  # [m] of a known length; source: survey of 0.02 m and placing of 0.01 m at both ends
_MAX_SPACINGS = 4  # between two markers: three missing in between; source: by hand, sensitivity 1.00, 1.00
_MAX_EXCESS_SHARE = 0.1  # of the distance; source: by hand, sensitivity 1.00, 1.00
_MOVED_M = (
    0.1  # [m] opposite errors of neighbouring lengths above this show a moved pair; source: 3 x `_LENGTH_SIGMA_M`
)
_SHORT_M = 40.0  # [m] on longer stretches bends make opposite errors too; source: decision 0016, rows of ten a side
_CANCEL_SHARE = 0.3  # of the errors, which their sum must be below on longer stretches; source: as above
_CLEARLY_BETTER = 0.5  # of the squared misfit along the second best line; source: by hand, sensitivity 0.93, 1.28


@dataclass(frozen=True, slots=True, eq=False)
class KnownLengths:
    """Stretches between markers, each shape (T,), and how much longer the lane's centre is there than the line. [m]"""

    start_m: Floats
    end_m: Floats
    excess_m: Floats
    sigma_m: Floats


NO_KNOWN_LENGTHS = KnownLengths(np.empty(0), np.empty(0), np.empty(0), np.empty(0))


def find_known_lengths(line: SmoothLine, station_m: Floats, used: Bools, width_m: float) -> KnownLengths:
    """Stretches whose length is known because markers stand at even distances; none where they do not.

    Parameters
    ----------
    line : SmoothLine
        Current estimate of the lane's centre.
    station_m : ndarray, shape (M,)
        Of the markers. [m]
    used : ndarray of bool, shape (M,)
    width_m : float
        Of the lane. [m]
    """
    place = np.sort(station_m[used])
    if len(place) < 2 * _MIN_LENGTHS:
        return NO_KNOWN_LENGTHS
    group = np.concatenate([[0], np.cumsum(np.diff(place) > _SAME_STATION_M)])
    place = np.bincount(group, place) / np.bincount(group)
    length = np.diff(place)
    if len(length) < _MIN_LENGTHS + 1 or np.median(length) < _MIN_SPACING_M:
        return NO_KNOWN_LENGTHS
    _, tangent = line.points_at(place)
    turn = np.diff(np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0])))
    even = _even_distance(length, turn)
    if even is None:
        return NO_KNOWN_LENGTHS
    times = np.maximum(np.round(length / even), 1)
    excess = times * even - length
    good = (np.abs(excess) < _MAX_EXCESS_SHARE * even) & (times <= _MAX_SPACINGS)
    found = _placed_along(excess, turn, good, width_m)
    if found is None:
        return NO_KNOWN_LENGTHS
    good &= ~_beside_moved_pairs(found, good, length)
    return KnownLengths(place[:-1][good], place[1:][good], found[good], np.full(int(good.sum()), _LENGTH_SIGMA_M))


def _beside_moved_pairs(excess_m: Floats, good: Bools, length_m: Floats) -> Bools:
    """Stretches that begin or end where markers stand before or behind their even place."""
    first, second = excess_m[:-1], excess_m[1:]
    size = np.minimum(np.abs(first), np.abs(second))
    cancel = np.abs(first + second) < np.maximum(_MOVED_M, _CANCEL_SHARE * np.maximum(np.abs(first), np.abs(second)))
    short = np.maximum(length_m[:-1], length_m[1:]) < _SHORT_M
    moved = good[:-1] & good[1:] & (first * second < 0) & (size > _MOVED_M) & (short | cancel)
    return np.asarray(np.append(moved, False) | np.append(False, moved), bool)


def _placed_along(excess_m: Floats, turn_rad: Floats, good: Bools, width_m: float) -> Floats | None:
    """Excess lengths of the centre, if it is clear along which of centre, left or right boundary distances are even.

    In a left bend the centre is longer than the left boundary by half the width times the turn.
    """
    if not good.any():
        return None
    candidates = [excess_m + k * turn_rad * width_m / 2 for k in (0.0, 1.0, -1.0)]
    misfit = [float(np.sum(value[good] ** 2)) for value in candidates]
    best = int(np.argmin(misfit))
    differs = max(misfit) > 4 * good.sum() * _LENGTH_SIGMA_M**2
    if differs and misfit[best] > _CLEARLY_BETTER * sorted(misfit)[1]:
        return None
    return candidates[best]


def _even_distance(length_m: Floats, turn_rad: Floats) -> float | None:
    """The greatest distance of which nearly all lengths are multiples; lengths of bends have less weight. [m]"""
    sigma = _LENGTH_SIGMA_M + _TURN_SIGMA_M * turn_rad**2
    for tried in np.sort(length_m)[::-1]:
        times = np.round(length_m / tried)
        near = (times >= 1) & (np.abs(length_m - times * tried) < _EVEN_M * np.maximum(times, 1) + 2 * sigma)
        if near.sum() >= max(_MIN_LENGTHS, _MIN_EVEN_SHARE * len(length_m)):
            weight = sigma[near] ** -2.0
            return float(np.sum(weight * length_m[near] * times[near]) / np.sum(weight * times[near] ** 2))
    return None
