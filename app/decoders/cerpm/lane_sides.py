"""Which boundary each marker stands on: the likeliest course of the lane beside a first line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from app.decoders.cerpm.lane_types import LEFT, RIGHT, UNKNOWN, Bools, Floats, Ints

_GRID_M = 0.2
_REACH_M = 7.0
_SPREAD_M = 0.25  # of a marker about a lane of even width
_CAP = 12.0  # cost of a marker that is on no boundary
_LABEL_COST = 8.0  # of a marker on the boundary that it does not name
_TRACK_COST = 0.02  # per marker and square metre: a driver keeps within the lane
_BAND_M = 0.8  # about the middle of a band, where there is nothing to find out
_WIDTHS_M = (2.5, 2.8, 3.1, 3.4, 3.8, 4.3)


@dataclass(frozen=True, slots=True, eq=False)
class Sides:
    """What each marker was found to be.

    Attributes
    ----------
    side : ndarray of int, shape (K,)
        `LaneSide`; UNKNOWN for one that is on no boundary.
    off_m : ndarray, shape (K,)
        How far left of its boundary it lies, for those on none: of the boundary that is nearer. [m]
    against : ndarray of bool, shape (K,)
        It lies on the boundary that it does not name.
    width_m : float
        [m]
    """

    side: Ints
    off_m: Floats
    against: Bools
    width_m: float


def assign_sides(station_m: Floats, left_m: Floats, named: Ints, *, wander: float, near_track: bool) -> Sides:
    """Follow the lane's centre beside a line by dynamic programming.

    Parameters
    ----------
    station_m, left_m : ndarray, shape (K,)
        Of the markers along and beside the line. [m]
    named : ndarray of int, shape (K,)
        `LaneSide` that each marker names.
    wander : float
        How fast the centre may leave the line: standard deviation over a metre, growing with the root of length. [m]
    near_track : bool
        The line is a vehicle's track, so the centre is rather near it.

    Notes
    -----
    States are places of the centre beside the line on a grid; a marker costs the square of its distance from the
    boundary that it fits best, up to a cap, so that a wild one bends nothing. All widths run side by side.
    """
    plain = _plain_sides(left_m, named) if near_track or (named != UNKNOWN).all() else None
    if plain is not None:
        return plain
    order = np.argsort(station_m, kind="stable")
    widths = np.array(_WIDTHS_M)
    grid = np.arange(-_REACH_M, _REACH_M + _GRID_M / 2, _GRID_M)
    y, label = left_m[order], named[order]
    off = y[:, None, None] - grid
    half = widths[:, None] / 2
    cost_left, cost_right = (((off - sign * half) / _SPREAD_M) ** 2 for sign in (1, -1))
    cost_left = cost_left + np.where(label == RIGHT, _LABEL_COST, 0)[:, None, None]
    cost_right = cost_right + np.where(label == LEFT, _LABEL_COST, 0)[:, None, None]
    unary = np.minimum(np.minimum(cost_left, cost_right), _CAP)
    if near_track:
        unary = unary + _TRACK_COST * grid**2
    state, width = _walk(unary, grid, np.diff(station_m[order]), wander)
    centre = grid[state]
    off_left, off_right = y - centre - widths[width] / 2, y - centre + widths[width] / 2
    to_left = (off_left / _SPREAD_M) ** 2 + np.where(label == RIGHT, _LABEL_COST, 0)
    to_right = (off_right / _SPREAD_M) ** 2 + np.where(label == LEFT, _LABEL_COST, 0)
    side = np.where(to_left <= to_right, LEFT, RIGHT)
    nearer = np.where(np.abs(off_left) <= np.abs(off_right), LEFT, RIGHT)
    off_m = np.where(nearer == LEFT, off_left, off_right)
    lost = np.minimum(to_left, to_right) > _CAP + _LABEL_COST
    against = (label != UNKNOWN) & (label != nearer) & (np.abs(off_m) < 4 * _SPREAD_M)
    against &= np.where(label == LEFT, np.abs(off_left), np.abs(off_right)) > 4 * _SPREAD_M
    back = np.empty(len(order), np.int64)
    back[order] = np.arange(len(order))
    side = np.where(lost | against, UNKNOWN, side)
    return Sides(side[back], off_m[back], against[back], float(widths[width]))


def _plain_sides(left_m: Floats, named: Ints) -> Sides | None:
    """The sides where nothing is to be found out: two bands beside the track, and all names agree."""
    side = np.where(left_m > 0, LEFT, RIGHT)
    if len(left_m) < 4 or (side == LEFT).all() or (side == RIGHT).all() or ((named != UNKNOWN) & (named != side)).any():
        return None
    middle = np.array([np.median(left_m[side == which]) for which in (LEFT, RIGHT)])
    width = float(middle[0] - middle[1])
    off = left_m - np.where(side == LEFT, middle[0], middle[1])
    if not _WIDTHS_M[0] < width < _WIDTHS_M[-1] or np.abs(off).max() > _BAND_M:
        return None
    return Sides(side, off, np.zeros(len(side), bool), width)


def _walk(unary: Floats, grid: Floats, ahead_m: Floats, wander: float) -> tuple[Ints, int]:
    """Cheapest course through the grid for each width (Viterbi), and the width of the cheapest of all."""
    count, kinds, size = unary.shape
    square = (grid[:, None] - grid) ** 2 / 2
    came = np.empty((count, kinds, size), np.int16)
    total = unary[0]
    for i in range(1, count):
        move = square / (wander**2 * max(ahead_m[i - 1], 1.0))
        sums = total[:, None, :] + np.minimum(move, 2 * _CAP)
        came[i] = sums.argmin(2)
        total = np.take_along_axis(sums, came[i][:, :, None].astype(np.int64), 2)[:, :, 0] + unary[i]
    best = int(total.min(1).argmin())
    state = np.empty(count, np.int64)
    state[-1] = int(total[best].argmin())
    for i in range(count - 1, 0, -1):
        state[i - 1] = came[i, best, state[i]]
    return state, best
