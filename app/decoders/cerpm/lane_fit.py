"""The lane along a first line: sides, least squares, and markers that stray from their neighbours' line."""

from __future__ import annotations

import numpy as np

from app.decoders.cerpm.lane_input import Stock
from app.decoders.cerpm.lane_line import Line, lengths_along
from app.decoders.cerpm.lane_pairs import abreast
from app.decoders.cerpm.lane_sides import Sides, assign_sides
from app.decoders.cerpm.lane_solve import VEHICLES, Evidence, Problem, Solution, Strengths, choose_strengths
from app.decoders.cerpm.lane_spacing import NONE, even_stretches
from app.decoders.cerpm.lane_track import Drive
from app.decoders.cerpm.lane_types import LEFT, RIGHT, UNKNOWN, Bools, Floats, Ints, LaneRules, LeftOutReason, Notes

_ROUNDS = 8
_CLOSE_M = 0.1  # a line so close to the centre is as good as the centre
_SETTLED_M = 0.5  # a line that moved less shows no strays that it did not show before
_REJECTIONS = 12
_LONGER = 2.0  # than its first line no lane becomes: it would be winding to and fro between strays
_ONE_EACH_M = 60.0  # of markers that stray, one a stretch is left out at a time: the rest may be its doing
_AGAINST = 0.2
_SURE_TRACK_M, _UNTOLD_M = 0.5, 3.0


Fixes = tuple[Floats, Floats, Floats, Floats]
"""Station, left offset, place and standard deviation of fixes; empty without a track."""
NO_FIXES: Fixes = (np.empty(0), np.empty(0), np.empty((0, 2)), np.empty(0))


class Fit:
    """A lane on the way to its path: a line, what was measured beside it, and the solution beside it.

    Parameters
    ----------
    line : Line
        Nearly along the lane, in the direction of travel.
    stock : Stock
    taken : ndarray of bool, shape (M,)
        Markers that may take part.
    drive : Drive or None
    rules : LaneRules
    notes : Notes

    Attributes
    ----------
    used : ndarray of bool, shape (M,)
        Markers that take part.
    side : ndarray of int, shape (M,)
    residual_m, station_m : ndarray, shape (M,)
        How far each marker lies off its boundary, and where along the line. [m]
    left_out : dict
        Row of the stock to reason and distance.
    """

    problem: Problem
    solution: Solution

    def __init__(
        self, line: Line, stock: Stock, taken: Bools, drive: Drive | None, rules: LaneRules, notes: Notes
    ) -> None:
        self.line, self._stock, self._drive, self._rules = line, stock, drive, rules
        half = rules.usual_width_m / 2
        self.station_m, self._left_m = line.find(stock.point_m, stock.side, half)
        named = _named_sides(self._left_m, stock, taken, drive, notes)
        if named is not stock.side:
            self.station_m, self._left_m = line.find(stock.point_m, named, half)
        sides = _sides(self.station_m, self._left_m, named, taken, drive)
        self.side = sides.side
        self.used = taken & (sides.side != UNKNOWN)
        self.left_out = {
            int(k): (
                LeftOutReason.WRONG_SIDE if sides.against[k] else LeftOutReason.OFF_THE_LINE,
                float(sides.off_m[k]),
            )
            for k in np.flatnonzero(taken & ~self.used)
        }
        self.residual_m = np.full(len(taken), np.nan)
        self._strengths = _start_strengths(sides, self.used, rules)
        self._fixes = _fixes_beside(line, drive)

    def run(self) -> bool:
        """Solve beside the line, move the line to the solution, and so on; whether a lane came of it."""
        longest_m = _LONGER * (self.line.length_m + 2 * self._rules.reach_m) + 2 * self._rules.bridge_m
        moved = np.inf
        for turn in range(_ROUNDS):
            reach = np.ptp(self.station_m[self.used]) if self.used.any() else 0.0
            if self.used.sum() < 2 or self.strays > self._rules.most_strays or not reach < longest_m:
                return False
            self._solve(turn, settled=moved < _SETTLED_M)
            moved = float(np.abs(self.solution.centre_m).max())
            if turn and moved < _CLOSE_M:
                break
            if turn < _ROUNDS - 1:
                self._move()
        return self.strays <= self._rules.most_strays

    @property
    def strays(self) -> float:
        """Share of the markers that lie off the line."""
        return len(self.left_out) / max(len(self.left_out) + int(self.used.sum()), 1)

    def _solve(self, turn: int, *, settled: bool) -> None:
        """Solve beside one line, leaving out markers that stray until none does; none does beside a settled one."""
        vehicles = _vehicles(self.side[self.used], self._drive)
        choosing = turn < (1 if self._drive is not None else 2)
        for left in range(_REJECTIONS, -1, -1):
            self.problem = self._problem(turn)
            if choosing:
                self._strengths = choose_strengths(self.problem, self._strengths, vehicles)
            self.solution = self.problem.solve(self._strengths)
            residual = self.solution.residuals()
            if settled or not left or not self._leave_out_strays(residual, self.solution.shares()):
                break
            choosing = True
        self.residual_m[:] = np.nan
        self.residual_m[self.used] = residual

    def _problem(self, turn: int) -> Problem:
        start, end = float(self.station_m[self.used].min()), float(self.station_m[self.used].max())
        fixes = self._fixes
        if len(fixes[0]):
            start = min(start, max(start - self._rules.reach_m, float(fixes[0].min())))
            end = max(end, min(end + self._rules.reach_m, float(fixes[0].max())))
        inside = (fixes[0] >= start) & (fixes[0] <= end)
        known = np.where(self.used, self.side, UNKNOWN)
        stretches = NONE
        if self._drive is None and turn:  # a first line does not tell lengths
            stretches = even_stretches(self.line, self.station_m, self.used, self._strengths.width_m)
        sign = np.where(self.side == LEFT, 1.0, -1.0)
        pairs = abreast(self.station_m, self._left_m, known, self._stock.sigma_m)
        station, left, sigma, sign = (
            values[self.used] for values in (self.station_m, self._left_m, self._stock.sigma_m, sign)
        )
        fix_station, fix_left, fix_sigma = (values[inside] for values in (fixes[0], fixes[1], fixes[3]))
        evidence = Evidence(station, left, sigma, sign, fix_station, fix_left, fix_sigma, *pairs, stretches)
        return Problem(self.line, evidence, start, end)

    def _leave_out_strays(self, residual_m: Floats, share: Floats) -> bool:
        """Leave out the worst of the markers that are not where all the others put them; whether there was one."""
        rows = np.flatnonzero(self.used)
        z = np.abs(residual_m) / (self._stock.sigma_m[rows] * np.sqrt(share))
        off = residual_m / share
        stray = (z > self._rules.off_the_line_z) & (np.abs(off) > self._rules.off_the_line_m)
        if len(rows) <= 2 or not stray.any():
            return False
        for k in _worst(z * stray, self.station_m[rows])[: len(rows) - 2]:
            self.used[rows[k]] = False
            self.left_out[int(rows[k])] = (LeftOutReason.OFF_THE_LINE, float(off[k]))
        return True

    def _move(self) -> None:
        """Take the solution as the line, and measure beside it."""
        knots = self.problem.station_m
        points = self.line.offset(knots, self.solution.centre_m)
        along = lengths_along(points)

        def carried(station_m: Floats) -> Floats:
            return np.interp(station_m, knots, along) + station_m - np.clip(station_m, knots[0], knots[-1])

        self.line = Line(points)
        self.station_m, self._left_m = self.line.follow(self._stock.point_m, carried(self.station_m))
        station, _, place, sigma = self._fixes
        self._fixes = (*self.line.follow(place, carried(station)), place, sigma)


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


def _start_strengths(sides: Sides, used: Bools, rules: LaneRules) -> Strengths:
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


def _fixes_beside(line: Line, drive: Drive | None) -> Fixes:
    if drive is None:
        return NO_FIXES
    station, left = line.nearest(drive.fix_m)
    good = np.abs(left - np.median(left)) < max(8 * drive.sigma_m, 6.0)
    return station[good], left[good], drive.fix_m[good], np.full(int(good.sum()), drive.sigma_m)


def _worst(z: Floats, station: Floats) -> list[int]:
    """The strangest markers, no two of them near each other."""
    chosen: list[int] = []
    for k in np.argsort(-z):
        if z[k] <= 0:
            break
        if all(abs(station[k] - station[other]) > _ONE_EACH_M for other in chosen):
            chosen.append(int(k))
    return chosen
