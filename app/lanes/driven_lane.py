"""The driven lane among several marked lanes.

A vehicle hears the markers of all lanes within radio range. Along its track the centre and the width of a lane are
followed by dynamic programming. At a station a lane costs little where there are markers on both of its boundaries,
none within, and its centre is as near to the track as the receiver's error and the driver's habits explain. How many
markers a line has is no evidence, and the sides that markers send decide only which lanes are oncoming ones: a line
that two lanes share is left of one and right of the other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from app.lanes.initial_line import TRUSTED_TRACK_M, DrivenLine
from app.lanes.types import LEFT, RIGHT, UNKNOWN
from app.values import Bools, Floats, Ints

_STEP_M = 12.5  # [m] between stations; about the paper's spacing of 12.2 m
_GRID_M, _HALF_GRID_M = 0.2, 8.0  # [m] step and largest offset of a centre from the track
_WIDTHS_M: Floats = np.arange(2.6, 5.5, 0.2)  # [m] 8.5 ft to the 18 ft of a ramp
_USUAL_WIDTHS_M = (2.7, 4.3)  # [m] others cost something
_LINE_SIGMA_M, _SPREAD = 0.25, 0.015  # [m, m/m] of a marker about a boundary, and how it grows with distance along it
_LINE_REACH_M = 40.0  # [m] along the track within which a marker shows a line; three spacings
_NO_LINE_COST = 4.0  # squared sigmas, where no marker is on a boundary
_WITHIN_COST, _WITHIN_MARGIN_M, _WITHIN_REACH_M = 6.0, 0.7, 10.0  # [1, m, m] of a marker between the boundaries
_MAX_WITHIN = 2  # such markers that count at a station: one or two may be spoofed
_DRIVER_M = 0.4  # [m] of a vehicle from its lane's centre: wander, habit, and bends that are cut
_MAX_PRIOR = 25.0  # squared sigmas; a vehicle that changes lane is far from each of them for a while
_PRECISE_LENGTH_M, _SLOW_TIME_S = 30.0, 30.0  # [m, s] after which an offset is another one: a driver's, a receiver's
_MOVE_M, _SLOW_MOVE_M = 0.25, 0.4  # [m] of the centre, beside the track, from station to station
_MAX_MOVE = 5  # grid steps from station to station
_WIDTH_COST = 2.0  # of a width that changes by a step of 0.2 m
_UNKNOWN_ACCURACY_M = 3.0  # [m] of a receiver that reports none
_ANOTHER_M = 1.3  # [m] centres further apart are of two lanes; half of the narrowest
_TIE = 14.0  # squared sigmas; odds of 1 to 1,100
_ONCOMING_COST = 30.0  # squared sigmas for a lane whose both boundaries send the other side
_ONCOMING_SHARE = 0.7  # of the markers on each boundary that send the other side
_FORBIDDEN = 1e6  # cost of a state that a course may not have; above every course
_ON_BOUNDARY_M = 0.9  # [m] of a marker from a boundary of its lane


class LaneCourse(NamedTuple):
    """A lane beside the track."""

    station_m: Floats  # shape (B,)
    centre_m: Floats  # shape (B,): [m] left of the track
    width_m: Floats  # shape (B,)


@dataclass(frozen=True, slots=True, eq=False)
class DrivenLane:
    """The driven lane, and lanes that are equally likely."""

    side: Ints  # shape (K,): boundary that each marker is on; UNKNOWN for those of other lanes
    course: LaneCourse
    others: tuple[LaneCourse, ...]  # equally likely lanes; none where the driven one is certain


def choose_driven_lane(station_m: Floats, left_m: Floats, named: Ints, drive: DrivenLine) -> DrivenLane | None:
    """Find the driven lane among all markers beside a track; None where no lane contains the track.

    Parameters
    ----------
    station_m, left_m : ndarray, shape (K,)
        Of the markers, along and left of the track. [m]
    named : ndarray of int, shape (K,)
        `LaneSide` that each marker sends.
    """
    beside = np.abs(left_m) < _HALF_GRID_M + _WIDTHS_M[-1]
    if beside.sum() < 2:
        return None
    stage = _stages(station_m[beside])
    grid: Floats = np.arange(-_HALF_GRID_M, _HALF_GRID_M + _GRID_M / 2, _GRID_M)
    accuracy = max(drive.accuracy_m if np.isfinite(drive.accuracy_m) else _UNKNOWN_ACCURACY_M, drive.jump_m)
    precise = accuracy < TRUSTED_TRACK_M
    length_m = _PRECISE_LENGTH_M if precise else max(_SLOW_TIME_S * drive.speed_m_s, _PRECISE_LENGTH_M)
    prior = np.minimum((grid / math.hypot(accuracy, _DRIVER_M)) ** 2, _MAX_PRIOR) * _STEP_M / length_m
    cost = _line_costs(stage, station_m[beside], left_m[beside], grid) + prior
    move_m = _MOVE_M if precise else _SLOW_MOVE_M
    found = [_cheapest(stage, grid, cost, move_m)]
    course = found[0][1]
    for allowed in (_apart_everywhere(course, grid), _apart_where_unsure(course, grid, cost, move_m)):
        found.append(_cheapest(stage, grid, cost + np.where(allowed, 0.0, _FORBIDDEN)[:, None], move_m))
    lanes = sorted(
        (
            (total + _ONCOMING_COST * _is_oncoming(course, station_m, left_m, named), course)
            for total, course in found
            if total < _FORBIDDEN and _has_lines(course, station_m, left_m)
        ),
        key=lambda lane: lane[0],
    )
    if not lanes:
        return None
    (least, course), *rivals = lanes
    others = [rival for total, rival in rivals if total < least + _TIE and _farthest(course, rival)[1] >= _ANOTHER_M]
    return DrivenLane(_sides_of(course, station_m, left_m), course, tuple(others))


def describe_tie(chosen: DrivenLane, drive: DrivenLine) -> str:
    """Why the driven lane is unknown, for people."""
    at, _ = _farthest(chosen.course, chosen.others[0])
    centres = sorted({float(course.centre_m[at]) for course in (chosen.course, *chosen.others)})
    places = " and ".join(f"{abs(centre):.1f} m {'left' if centre > 0 else 'right'}" for centre in centres)
    good = f"is accurate to {drive.accuracy_m:.1f} m" if np.isfinite(drive.accuracy_m) else "is of unknown accuracy"
    if drive.jump_m > drive.accuracy_m:
        good = f"jumps by {drive.jump_m:.1f} m"
    return (
        f"several lanes are equally likely: their centres are {places} of the vehicle's track, which {good}; send the "
        "track of a receiver with RTK corrections"
    )


def _farthest(course: LaneCourse, other: LaneCourse) -> tuple[int, float]:
    """The station where two lanes are farthest apart, and how far. [m]"""
    apart = np.abs(course.centre_m - other.centre_m)
    return int(np.argmax(apart)), float(apart.max())


def _stages(station_m: Floats) -> Floats:
    first, last = float(station_m.min()), float(station_m.max())
    return np.linspace(first, last, max(math.ceil((last - first) / _STEP_M), 1) + 1)


def _line_costs(stage_m: Floats, station_m: Floats, left_m: Floats, grid: Floats) -> Floats:
    """Cost of a lane at each station by width and offset, shape (B, W, G): lines at its boundaries, none within."""
    along = np.abs(stage_m[:, None] - station_m)
    sigma = _LINE_SIGMA_M + _SPREAD * along
    fine: Floats = np.arange(grid[0] - _WIDTHS_M[-1], grid[-1] + _WIDTHS_M[-1], _GRID_M / 2)
    line = np.full((len(stage_m), len(fine)), _NO_LINE_COST)
    within = np.zeros((len(stage_m), len(fine)))
    for b in range(len(stage_m)):
        near = np.flatnonzero(along[b] < _LINE_REACH_M)
        if len(near):
            off = (left_m[near, None] - fine) / sigma[b, near, None]
            line[b] = np.minimum((off**2 + (along[b, near, None] / _LINE_REACH_M) ** 2).min(0), _NO_LINE_COST)
        here = left_m[along[b] < _WITHIN_REACH_M]
        within[b] = np.searchsorted(np.sort(here), fine)
    out = np.empty((len(stage_m), len(_WIDTHS_M), len(grid)))
    for w, width in enumerate(_WIDTHS_M):
        left, right = (np.rint((grid + sign * width / 2 - fine[0]) / (_GRID_M / 2)).astype(int) for sign in (1, -1))
        margin = round(_WITHIN_MARGIN_M / (_GRID_M / 2))
        inside = np.minimum(within[:, left - margin] - within[:, right + margin], _MAX_WITHIN)
        unusual = (width - min(max(width, _USUAL_WIDTHS_M[0]), _USUAL_WIDTHS_M[1])) / 0.4
        out[:, w] = line[:, left] + line[:, right] + _WITHIN_COST * inside + 0.5 * unusual**2
    return out


def _cheapest(stage_m: Floats, grid: Floats, cost: Floats, move_m: float) -> tuple[float, LaneCourse]:
    """The cheapest course (Viterbi algorithm), after what it costs."""
    total, came = _forward(cost, move_m)
    states = [int(np.argmin(total[-1]))]
    for b in range(len(stage_m) - 1, 0, -1):
        states.append(int(came[b].flat[states[-1]]))
    width, offset = np.unravel_index(states[::-1], total.shape[1:])
    return float(total[-1].min()), LaneCourse(stage_m, grid[offset], _WIDTHS_M[width])


def _forward(cost: Floats, move_m: float) -> tuple[Floats, Ints]:
    """Least cost up to each station and state, and the state before, shape (B, W, G) each."""
    count, widths, size = cost.shape
    total, came = cost.copy(), np.zeros(cost.shape, np.int64)
    index = np.arange(widths * size).reshape(widths, size)
    for b in range(1, count):
        best, source = total[b - 1].copy(), index.copy()
        for step in range(1, _MAX_MOVE + 1):
            price = (step * _GRID_M / move_m) ** 2
            for to, of in ((np.s_[:, step:], np.s_[:, :-step]), (np.s_[:, :-step], np.s_[:, step:])):
                tried = total[b - 1][of] + price
                better = tried < best[to]
                best[to] = np.where(better, tried, best[to])
                source[to] = np.where(better, index[of], source[to])
        moved, moved_from = best.copy(), source.copy()
        for to_width, of_width in ((np.s_[1:], np.s_[:-1]), (np.s_[:-1], np.s_[1:])):
            tried = best[of_width] + _WIDTH_COST
            better = tried < moved[to_width]
            moved[to_width] = np.where(better, tried, moved[to_width])
            moved_from[to_width] = np.where(better, source[of_width], moved_from[to_width])
        total[b] += moved
        came[b] = moved_from
    return total, came


def _apart_everywhere(course: LaneCourse, grid: Floats) -> Bools:
    """States of other lanes, shape (B, G)."""
    return np.asarray(np.abs(grid - course.centre_m[:, None]) >= _ANOTHER_M)


def _apart_where_unsure(course: LaneCourse, grid: Floats, cost: Floats, move_m: float) -> Bools:
    """States of courses that are in another lane at the station where that costs least, shape (B, G)."""
    before, _ = _forward(cost, move_m)
    after, _ = _forward(cost[::-1], move_m)
    through = (before + after[::-1] - cost).min(1)
    apart = _apart_everywhere(course, grid)
    unsure = int(np.argmin(np.where(apart, through, np.inf).min(1)))
    return np.asarray(apart | (np.arange(len(apart)) != unsure)[:, None])


def _off_boundaries(course: LaneCourse, station_m: Floats, left_m: Floats) -> tuple[Floats, Floats]:
    """Distance left of the left and of the right boundary. [m]"""
    centre = np.interp(station_m, course.station_m, course.centre_m)
    half = np.interp(station_m, course.station_m, course.width_m) / 2
    return left_m - centre - half, left_m - centre + half


def _sides_of(course: LaneCourse, station_m: Floats, left_m: Floats) -> Ints:
    """The boundary that each marker is on; UNKNOWN for other markers."""
    left, right = (np.abs(off) for off in _off_boundaries(course, station_m, left_m))
    side = np.where(left < right, LEFT, RIGHT)
    return np.where(np.minimum(left, right) < _ON_BOUNDARY_M, side, UNKNOWN)


def _is_oncoming(course: LaneCourse, station_m: Floats, left_m: Floats, named: Ints) -> bool:
    """Whether the markers on both boundaries send the other side."""
    side = _sides_of(course, station_m, left_m)
    for which in (LEFT, RIGHT):
        sent = named[(side == which) & (named != UNKNOWN)]
        if not len(sent) or np.mean(sent != which) < _ONCOMING_SHARE:
            return False
    return True


def _has_lines(course: LaneCourse, station_m: Floats, left_m: Floats) -> bool:
    """Whether there are markers on both boundaries."""
    side = _sides_of(course, station_m, left_m)
    return bool((side == LEFT).sum() >= 2 and (side == RIGHT).sum() >= 2)
