"""Which boundary of the lane each marker stands on: the most likely course of the lane beside an initial line."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from app.compiled import ieee_kernel
from app.lanes.types import LEFT, RIGHT, UNKNOWN, Bools, Floats, Ints

_GRID_STEP_M = 0.2  # [m] between candidate offsets of the centre; source: by hand, sensitivity 1.00, 1.00
_GRID_HALF_M = 7.0  # [m] largest candidate offset; source: by hand, sensitivity 1.39, 1.00
_MARKER_SIGMA_M = 0.25  # [m] of a marker about a lane of constant width; source: by hand, sensitivity 1.00, 1.00
_OUTLIER_COST = 12.0  # squared sigmas, for a marker on no boundary; source: by hand, sensitivity 1.00, 1.00
_WRONG_SIDE_COST = 8.0  # squared sigmas, on the other side than sent; source: by hand, sensitivity 1.00, 1.00
_TRACK_COST = 0.02  # [1/m^2] per marker: drivers stay in the lane; source: by hand, sensitivity 1.00, 1.00
_CLEAR_BAND_M = 0.8  # [m] half width of a band of markers with an obvious side; source: by hand, sensitivity 1.00, 1.00
_WIDTHS_M = (2.5, 2.8, 3.1, 3.4, 3.8, 4.3, 4.8, 5.3, 5.8, 6.3, 6.8, 7.3)  # [m] source: by hand: 8 ft to two lanes
_USUAL_WIDTHS_M = (2.5, 4.3)  # [m] 8 to 14 ft; source: by hand about the 9 to 12 ft of AASHTO Green Book, 4.3
_OPENING_COST = 5.0  # [1/m] of a width that changes, in squared sigmas; source: by hand


@dataclass(frozen=True, slots=True, eq=False)
class SideAssignment:
    """The boundary that each marker was assigned to.

    Attributes
    ----------
    side : ndarray of int, shape (K,)
        `LaneSide`; UNKNOWN for a marker on no boundary.
    off_m : ndarray, shape (K,)
        Distance left of its boundary; of a marker on no boundary, left of the nearer one. [m]
    contradicts : ndarray of bool, shape (K,)
        The marker is on the boundary that its message does not name.
    width_m : float
        Of the lane. [m]
    """

    side: Ints
    off_m: Floats
    contradicts: Bools
    width_m: float


class _BoundaryErrors(NamedTuple):
    """Distance left of each boundary [m] and cost of assigning a marker to it, each with the same shape."""

    left_m: Floats
    right_m: Floats
    left_cost: Floats
    right_cost: Floats


def assign_sides(station_m: Floats, left_m: Floats, named: Ints, *, wander: float, near_track: bool) -> SideAssignment:
    """Follow the lane's centre beside a line by dynamic programming.

    Parameters
    ----------
    station_m, left_m : ndarray, shape (K,)
        Of the markers, along and left of the line. [m]
    named : ndarray of int, shape (K,)
        `LaneSide` in each marker's message.
    wander : float
        How fast the centre may leave the line: standard deviation over one metre, growing with the square root of
        length. [m/sqrt(m)]
    near_track : bool
        The line is a vehicle's track, so the centre is probably near it.

    Notes
    -----
    The states are offsets of the centre from the line, on a grid. A marker costs the squared distance from the
    boundary that fits it best, in standard deviations and up to a limit, so that an outlier bends nothing. All widths
    are followed at the same time.
    """
    obvious = _obvious_sides(left_m, named) if near_track or (named != UNKNOWN).all() else None
    if obvious is not None:
        return obvious
    order = np.argsort(station_m, kind="stable")
    widths = np.array(_WIDTHS_M)
    grid = np.arange(-_GRID_HALF_M, _GRID_HALF_M + _GRID_STEP_M / 2, _GRID_STEP_M)
    offset, label = left_m[order], named[order]
    base = _TRACK_COST * grid**2 if near_track else np.zeros(len(grid))

    errors = _errors_of((offset[:, None] - grid)[:, None], label[:, None, None], widths[:, None])
    cost = np.minimum(np.minimum(errors.left_cost, errors.right_cost), _OUTLIER_COST) + base
    reach = wander**2 * np.maximum(np.diff(station_m[order]), 1.0)
    state, width = _cheapest_course(cost, grid, _OPENING_COST * np.abs(widths[:, None] - widths), reach)
    found = _assign_beside(offset - grid[state], label, widths[width])
    back = np.empty(len(order), np.int64)
    back[order] = np.arange(len(order))
    return SideAssignment(found.side[back], found.off_m[back], found.contradicts[back], found.width_m)


def _errors_of(from_centre_m: Floats, label: Ints | np.int64, width_m: Floats | float) -> _BoundaryErrors:
    """Distances of markers from both boundaries of a lane, and the cost of each assignment."""
    left, right = from_centre_m - width_m / 2, from_centre_m + width_m / 2
    left_cost = (left / _MARKER_SIGMA_M) ** 2 + np.where(label == RIGHT, _WRONG_SIDE_COST, 0)
    right_cost = (right / _MARKER_SIGMA_M) ** 2 + np.where(label == LEFT, _WRONG_SIDE_COST, 0)
    return _BoundaryErrors(left, right, left_cost, right_cost)


def _assign_beside(from_centre_m: Floats, label: Ints, width_m: Floats) -> SideAssignment:
    """Sides of markers whose offset from the lane's centre is known."""
    errors = _errors_of(from_centre_m, label, width_m)
    side = np.where(errors.left_cost <= errors.right_cost, LEFT, RIGHT)
    nearer = np.where(np.abs(errors.left_m) <= np.abs(errors.right_m), LEFT, RIGHT)
    off = np.where(nearer == LEFT, errors.left_m, errors.right_m)
    outlier = np.minimum(errors.left_cost, errors.right_cost) > _OUTLIER_COST + _WRONG_SIDE_COST
    contradicts = (label != UNKNOWN) & (label != nearer) & (np.abs(off) < 4 * _MARKER_SIGMA_M)
    named_off = np.where(label == LEFT, np.abs(errors.left_m), np.abs(errors.right_m))
    contradicts &= named_off > 4 * _MARKER_SIGMA_M
    return SideAssignment(np.where(outlier | contradicts, UNKNOWN, side), off, contradicts, float(np.median(width_m)))


def _obvious_sides(left_m: Floats, named: Ints) -> SideAssignment | None:
    """The sides where they are obvious: two bands beside the track, and no message contradicts them."""
    side = np.where(left_m > 0, LEFT, RIGHT)
    if len(left_m) < 4 or (side == LEFT).all() or (side == RIGHT).all() or ((named != UNKNOWN) & (named != side)).any():
        return None
    middle = np.array([np.median(left_m[side == which]) for which in (LEFT, RIGHT)])
    width = float(middle[0] - middle[1])
    off = left_m - np.where(side == LEFT, middle[0], middle[1])
    if not _USUAL_WIDTHS_M[0] < width < _USUAL_WIDTHS_M[1] or np.abs(off).max() > _CLEAR_BAND_M:
        return None
    return SideAssignment(side, off, np.zeros(len(side), bool), width)


@ieee_kernel
def _cheapest_course(cost: Floats, grid: Floats, opening: Floats, reach_m2: Floats) -> tuple[Ints, Ints]:
    """Cheapest course through the grid (Viterbi algorithm): indices of the offset and of the width at each marker.

    Parameters
    ----------
    cost : ndarray, shape (K, W, G)
        Of each marker by width and offset.
    grid : ndarray, shape (G,)
        Offsets, evenly spaced. [m]
    opening : ndarray, shape (W, W)
        Cost of a change of width.
    reach_m2 : ndarray, shape (K - 1,)
        Variance of what the centre moves sideways from each marker to the next. [m2]

    Notes
    -----
    A move costs half of its square over the variance, and at most that of two outliers: beyond there, every offset
    costs the same.
    """
    count, kinds, size = cost.shape
    most, step = 2 * _OUTLIER_COST, grid[1] - grid[0]
    came_offset = np.empty((count, kinds, size), np.int16)
    came_width = np.empty((count, kinds, size), np.int16)
    total, moved = cost[0].copy(), np.empty((kinds, size))
    for i in range(1, count):
        price = step * step / 2 / reach_m2[i - 1]
        window = min(int(math.sqrt(most / price)), size)
        for w in range(kinds):
            lowest = int(np.argmin(total[w]))
            for g in range(size):
                best, at = total[w, lowest] + most, lowest
                for h in range(max(g - window, 0), min(g + window + 1, size)):
                    value = total[w, h] + price * (g - h) * (g - h)
                    if value < best:
                        best, at = value, h
                moved[w, g], came_offset[i, w, g] = best, at
        for w in range(kinds):
            for g in range(size):
                best, at = moved[w, g], w
                for v in range(kinds):
                    value = moved[v, g] + opening[w, v]
                    if value < best:
                        best, at = value, v
                total[w, g], came_width[i, w, g] = best + cost[i, w, g], at
    width, state = np.empty(count, np.int64), np.empty(count, np.int64)
    last = int(np.argmin(total))
    width[-1], state[-1] = last // size, last % size
    for i in range(count - 1, 0, -1):
        width[i - 1] = came_width[i, width[i], state[i]]
        state[i - 1] = came_offset[i, width[i - 1], state[i]]
    return state, width
