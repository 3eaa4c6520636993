"""Markers at even distances: where they are, the length between them tells how a bend runs that nobody saw.

A crew lays markers at even distances along the lane's centre or one of its boundaries. Whether these were is found from
where they lie, above all on the stretches that hardly turn; in a bend the length between two of them then says how far
the lane swings out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from app.decoders.cerpm.lane_line import Line
from app.decoders.cerpm.lane_types import Bools, Floats

_ONE_PLACE_M = 1.5
_SHORTEST_M = 20.0  # closer markers tell the bend themselves
_PER_TURN_M = 0.5  # error of a bend's length before it is held, over the square of its turn
_FEWEST = 3
_SHARE = 0.8
_EVEN_M = 0.2
_SIGMA_M = 0.03
_MOST_MISSING = 4
_WORST = 0.1  # of the distance
_CLEARLY = 0.5  # of the squared misfit of the other lines that it could have been laid along


@dataclass(frozen=True, slots=True, eq=False)
class Stretches:
    """Stretches of a line between markers, each shape (T,), and how much longer the lane's centre is there. [m]"""

    start_m: Floats
    end_m: Floats
    excess_m: Floats
    sigma_m: Floats


NONE = Stretches(np.empty(0), np.empty(0), np.empty(0), np.empty(0))


def even_stretches(line: Line, station_m: Floats, used: Bools, width_m: float) -> Stretches:
    """Stretches whose length is known because markers stand at even distances; none where they do not.

    Parameters
    ----------
    line : Line
        Along the lane's centre, as it is known so far.
    station_m : ndarray, shape (M,)
        Of the markers. [m]
    used : ndarray of bool, shape (M,)
    width_m : float
        Of the lane. [m]
    """
    place = np.sort(station_m[used])
    if len(place) < 2 * _FEWEST:
        return NONE
    group = np.concatenate([[0], np.cumsum(np.diff(place) > _ONE_PLACE_M)])
    place = np.bincount(group, place) / np.bincount(group)
    length = np.diff(place)
    if len(length) < _FEWEST + 1 or np.median(length) < _SHORTEST_M:
        return NONE
    _, tangent = line.at(place)
    turn = np.diff(np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0])))
    even = _even_distance(length, turn)
    if even is None:
        return NONE
    times = np.maximum(np.round(length / even), 1)
    excess = times * even - length
    good = (np.abs(excess) < _WORST * even) & (times <= _MOST_MISSING)
    # laid along the left boundary the centre is longer in a left bend by half the width times the turn
    laid = [excess + k * turn * width_m / 2 for k in (0.0, 1.0, -1.0)]
    misfit = [float(np.sum(value[good] ** 2)) for value in laid]
    best = int(np.argmin(misfit))
    matters = max(misfit) > 4 * good.sum() * _SIGMA_M**2
    if not good.any() or (matters and misfit[best] > _CLEARLY * sorted(misfit)[1]):
        return NONE
    count = int(good.sum())
    return Stretches(place[:-1][good], place[1:][good], laid[best][good], np.full(count, _SIGMA_M))


def _even_distance(length_m: Floats, turn_rad: Floats) -> float | None:
    """The greatest distance of which nearly all lengths are multiples; one that turns is less sure."""
    doubt = _SIGMA_M + _PER_TURN_M * turn_rad**2
    for tried in np.sort(length_m)[::-1]:
        times = np.round(length_m / tried)
        near = (times >= 1) & (np.abs(length_m - times * tried) < _EVEN_M * np.maximum(times, 1) + 2 * doubt)
        if near.sum() >= max(_FEWEST, _SHARE * len(length_m)):
            weight = doubt[near] ** -2.0
            return float(np.sum(weight * length_m[near] * times[near]) / np.sum(weight * times[near] ** 2))
    return None
