"""Which boundary of the lane each marker stands on: the most likely course of the lane beside an initial line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

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

    def cost(marker: int) -> Floats:
        errors = _errors_of(offset[marker] - grid, label[marker], widths[:, None])
        return np.minimum(np.minimum(errors.left_cost, errors.right_cost), _OUTLIER_COST) + base

    state, width = _cheapest_course(cost, grid, widths, np.diff(station_m[order]), wander)
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


def _cheapest_course(
    cost: Callable[[int], Floats], grid: Floats, widths_m: Floats, ahead_m: Floats, wander: float
) -> tuple[Ints, Ints]:
    """Cheapest course through the grid (Viterbi algorithm): indices of the offset and of the width at each marker.

    Parameters
    ----------
    cost : callable
        Cost of a marker by width and offset, shape (W, G).
    grid, widths_m : ndarray, shape (G,) and (W,)
        [m]
    ahead_m : ndarray, shape (K - 1,)
        From each marker to the next. [m]
    wander : float
        As in `assign_sides`.
    """
    count, kinds, size = len(ahead_m) + 1, len(widths_m), len(grid)
    square = (grid[:, None] - grid) ** 2 / 2
    opening = _OPENING_COST * np.abs(widths_m[:, None] - widths_m)
    came_offset = np.empty((count, kinds, size), np.int8)
    came_width = np.empty((count, kinds, size), np.int8)
    total = cost(0)
    for i in range(1, count):
        move = np.minimum(square / (wander**2 * max(ahead_m[i - 1], 1.0)), 2 * _OUTLIER_COST)
        sums = total[:, None, :] + move
        came_offset[i] = sums.argmin(2)
        moved = np.take_along_axis(sums, came_offset[i][:, :, None].astype(np.int64), 2)[:, :, 0]
        opened = moved[None] + opening[:, :, None]
        came_width[i] = opened.argmin(1)
        total = np.take_along_axis(opened, came_width[i][:, None].astype(np.int64), 1)[:, 0] + cost(i)
    width, state = np.empty(count, np.int64), np.empty(count, np.int64)
    width[-1], state[-1] = np.unravel_index(int(total.argmin()), total.shape)
    for i in range(count - 1, 0, -1):
        width[i - 1] = came_width[i, width[i], state[i]]
        state[i - 1] = came_offset[i, width[i - 1], state[i]]
    return state, width
