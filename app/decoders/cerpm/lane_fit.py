"""The lane along a first line: sides, least squares, and markers that stray from their neighbours' line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from app.decoders.cerpm.lane_input import Stock
from app.decoders.cerpm.lane_line import Line, lengths_along
from app.decoders.cerpm.lane_pairs import Pairs, abreast
from app.decoders.cerpm.lane_sides import Sides, assign_sides
from app.decoders.cerpm.lane_solve import VEHICLES, Evidence, Problem, Solution, Strengths, choose_strengths
from app.decoders.cerpm.lane_spacing import NONE, Stretches, even_stretches
from app.decoders.cerpm.lane_track import Drive
from app.decoders.cerpm.lane_types import LEFT, RIGHT, UNKNOWN, Bools, Floats, Ints, LaneRules, LeftOutReason, Notes

_ROUNDS = 8
_CLOSE_M = 0.1  # a line so close to the centre is as good as the centre
_REJECTIONS = 12
_ONE_EACH_M = 60.0  # of markers that stray, one a stretch is left out at a time: the rest may be its doing
_AGAINST = 0.2
_SURE_TRACK_M, _UNTOLD_M = 0.5, 3.0


@dataclass(slots=True, eq=False)
class Fit:
    """A lane on the way to its path.

    Attributes
    ----------
    line : Line
        Near the centre.
    problem, solution
        Beside that line.
    strengths : Strengths
    used : ndarray of bool, shape (M,)
        Markers of the stock that take part.
    side : ndarray of int, shape (M,)
    residual_m : ndarray, shape (M,)
    station_m : ndarray, shape (M,)
        Of the markers along the line.
    left_out : dict
        Row of the stock to reason and distance.
    """

    line: Line
    problem: Problem
    solution: Solution
    strengths: Strengths
    used: Bools
    side: Ints
    residual_m: Floats
    station_m: Floats
    left_out: dict[int, tuple[LeftOutReason, float]]


def fit_along(
    line: Line, stock: Stock, taken: Bools, drive: Drive | None, rules: LaneRules, notes: Notes
) -> Fit | None:
    """Fit the lane beside a first line; None where fewer than two markers are left.

    Parameters
    ----------
    line : Line
        Nearly along the lane, in the direction of travel.
    stock : Stock
    taken : ndarray of bool, shape (M,)
        Markers that may take part.
    drive : Drive or None
    """
    station, left = line.find(stock.point_m, stock.side, rules.usual_width_m / 2)
    named = _named_sides(left, stock, taken, drive, notes)
    if named is not stock.side:
        station, left = line.find(stock.point_m, named, rules.usual_width_m / 2)
    sides = _sides(station, left, named, taken, drive)
    left_out = {
        int(k): (LeftOutReason.WRONG_SIDE if sides.against[k] else LeftOutReason.OFF_THE_LINE, float(sides.off_m[k]))
        for k in np.flatnonzero(taken & (sides.side == UNKNOWN))
    }
    used = taken & (sides.side != UNKNOWN)
    if used.sum() < 2:
        return None
    start = _start_strengths(sides, used, drive, rules)
    fixes = _fixes_beside(line, drive)
    fit: Fit | None = None
    for turn in range(_ROUNDS):
        strengths = start if fit is None else fit.strengths
        fit = _solve(line, stock, used, sides.side, station, left, fixes, drive, strengths, left_out, rules, turn)
        used = fit.used
        if used.sum() < 2 or turn == _ROUNDS - 1 or (turn and np.abs(fit.solution.centre_m).max() < _CLOSE_M):
            break
        points = line.offset(fit.problem.station_m, fit.solution.centre_m)
        before = lengths_along(points)
        scale = fit.problem.station_m
        line = Line(points)
        guess = np.interp(station, scale, before) + (station - np.clip(station, scale[0], scale[-1]))
        station, left = line.follow(stock.point_m, guess)
        if fixes is not None:
            guess = np.interp(fixes[0], scale, before) + (fixes[0] - np.clip(fixes[0], scale[0], scale[-1]))
            fixes = (*line.follow(fixes[2], guess), fixes[2], fixes[3])
    return fit if fit is not None and fit.used.sum() >= 2 else None


Fixes = tuple[Floats, Floats, Floats, Floats]
"""Station, left offset, place and standard deviation of fixes."""


def _named_sides(left: Floats, stock: Stock, taken: Bools, drive: Drive | None, notes: Notes) -> Ints:
    """The sides that markers name, as seen in the direction of the line."""
    named = stock.side
    told = taken & (named != UNKNOWN) & (np.abs(left) > 0.5) & (np.abs(left) < 4)
    if drive is None or told.sum() < 4:
        return named
    agree = np.mean((left[told] > 0) == (named[told] == LEFT))
    if agree >= _AGAINST:
        return named
    notes.doubt(
        "the sides that the markers name are those of the other direction of travel: the path follows the track"
    )
    return np.where(named == LEFT, RIGHT, np.where(named == RIGHT, LEFT, UNKNOWN))


def _sides(station: Floats, left: Floats, named: Ints, taken: Bools, drive: Drive | None) -> Sides:
    precise = drive is not None and drive.sigma_m < 0.06
    wander = 0.06 if precise else 0.2
    found = assign_sides(station[taken], left[taken], named[taken], wander=wander, near_track=drive is not None)
    side, off, against = np.zeros(len(station), np.int64), np.full(len(station), np.nan), np.zeros(len(station), bool)
    side[taken], off[taken], against[taken] = found.side, found.off_m, found.against
    return Sides(side, off, against, found.width_m)


def _start_strengths(sides: Sides, used: Bools, drive: Drive | None, rules: LaneRules) -> Strengths:
    both = (sides.side[used] == LEFT).any() and (sides.side[used] == RIGHT).any()
    if both:
        return Strengths(width_m=sides.width_m)
    return Strengths(width_m=rules.usual_width_m, width_sd_m=0.4, width_length_m=400.0)


def _vehicles(side: Ints, drive: Drive | None) -> tuple[dict[str, float], ...]:
    """What may be true of the vehicle's offset: a driver's wander, or a receiver's slow error."""
    if drive is None:
        return ()
    one_sided = (side == LEFT).all() or (side == RIGHT).all()
    told = drive.accuracy_m
    if one_sided and not told < _SURE_TRACK_M:  # nothing would show that the whole track lies aside
        slow = told if np.isfinite(told) else _UNTOLD_M
        return tuple({"drift": value, "slow_m": slow} for value in (0.05, 0.15, 0.4))
    return VEHICLES


def _fixes_beside(line: Line, drive: Drive | None) -> Fixes | None:
    if drive is None:
        return None
    station, left = line.nearest(drive.fix_m)
    good = np.abs(left - np.median(left)) < max(8 * drive.sigma_m, 6.0)
    return station[good], left[good], drive.fix_m[good], np.full(int(good.sum()), drive.sigma_m)


def _solve(
    line: Line, stock: Stock, used: Bools, side: Ints, station: Floats, left: Floats, fixes: Fixes | None,
    drive: Drive | None, strengths: Strengths, left_out: dict[int, tuple[LeftOutReason, float]], rules: LaneRules,
    turn: int,
) -> Fit:  # fmt: skip
    """Solve beside one line, leaving out markers that stray until none does."""
    used = used.copy()
    later = turn > 0  # a first line does not tell lengths
    start, end = float(station[used].min()), float(station[used].max())
    if fixes is not None and len(fixes[0]):
        start = min(start, max(start - rules.reach_m, float(fixes[0].min())))
        end = max(end, min(end + rules.reach_m, float(fixes[0].max())))
    sign = np.where(side == LEFT, 1.0, -1.0)
    vehicles = _vehicles(side[used], drive)
    chosen = False
    for _ in range(_REJECTIONS):
        pairs = abreast(station, left, np.where(used, side, UNKNOWN), stock.sigma_m)
        stretches = even_stretches(line, station, used, strengths.width_m) if drive is None and later else NONE
        problem = Problem(
            line, _evidence(stock, used, station, left, sign, fixes, start, end, pairs, stretches), start, end
        )
        if not chosen and turn < (1 if drive is not None else 3):
            strengths = choose_strengths(problem, strengths, vehicles)
            chosen = True
        solution = problem.solve(strengths)
        residual, share = solution.residuals()
        rows = np.flatnonzero(used)
        z = np.abs(residual) / (stock.sigma_m[rows] * np.sqrt(share))
        off = residual / share
        stray = (z > rules.off_the_line_z) & (np.abs(off) > rules.off_the_line_m)
        if not stray.any() or used.sum() <= 2:
            break
        for k in _worst(z * stray, station[rows]):
            used[rows[k]] = False
            left_out[int(rows[k])] = (LeftOutReason.OFF_THE_LINE, float(off[k]))
        chosen, turn = False, 0
    full = np.full(len(used), np.nan)
    full[rows] = residual
    return Fit(line, problem, solution, strengths, used, side, full, station, left_out)


def _evidence(
    stock: Stock,
    used: Bools,
    station: Floats,
    left: Floats,
    sign: Floats,
    fixes: Fixes | None,
    start: float,
    end: float,
    pairs: Pairs,
    stretches: Stretches,
) -> Evidence:
    fix_station, fix_left, fix_sigma = np.empty(0), np.empty(0), np.empty(0)
    if fixes is not None:
        inside = (fixes[0] >= start) & (fixes[0] <= end)
        fix_station, fix_left, fix_sigma = fixes[0][inside], fixes[1][inside], fixes[3][inside]
    return Evidence(
        station[used], left[used], stock.sigma_m[used], sign[used],
        fix_station, fix_left, fix_sigma, *pairs, stretches,
    )  # fmt: skip


def _worst(z: Floats, station: Floats) -> list[int]:
    """The strangest markers, no two of them near each other."""
    chosen: list[int] = []
    for k in np.argsort(-z):
        if z[k] <= 0:
            break
        if all(abs(station[k] - station[other]) > _ONE_EACH_M for other in chosen):
            chosen.append(int(k))
    return chosen
