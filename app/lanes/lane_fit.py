"""The lane along an initial line: sides of markers, least squares, and outliers."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from app.compiled import ieee_kernel
from app.lanes.initial_line import TRUSTED_TRACK_M, DrivenLine
from app.lanes.least_squares import (
    BENDS,
    OFFSET_MODELS,
    WIDTH_MODELS,
    Hyperparameters,
    LaneProblem,
    LaneSolution,
    Measurements,
    OffsetModel,
    choose_hyperparameters,
)
from app.lanes.observations import (
    NO_KNOWN_LENGTHS,
    LaneObservations,
    Pairs,
    find_known_lengths,
    find_pairs,
    nearest_sorted,
)
from app.lanes.smooth_line import SmoothLine, lengths_along
from app.lanes.types import LEFT, RIGHT, UNKNOWN, LaneRules, LeftOutReason, Notes
from app.sensors.pose_track import UNKNOWN_ACCURACY_M
from app.values import Bools, Floats, Ints, JsonObject

# === Which boundary of the lane each marker stands on: the most likely course of the lane beside an initial line.


_GRID_STEP_M = 0.2  # [m] between candidate offsets of the centre; sensitivity 1.00, 1.00
_GRID_HALF_M = 7.0  # [m] largest candidate offset; sensitivity 1.39, 1.00
_MARKER_SIGMA_M = 0.25  # [m] of a marker about a lane of constant width; sensitivity 1.00, 1.00
_OUTLIER_COST = 12.0  # squared sigmas, for a marker on no boundary; sensitivity 1.00, 1.00
_WRONG_SIDE_COST = 8.0  # squared sigmas, on the other side than sent; sensitivity 1.00, 1.00
_TRACK_COST = 0.02  # [1/m^2] per marker: drivers stay in the lane; sensitivity 1.00, 1.00
_CLEAR_BAND_M = 0.8  # [m] half width of a band of markers with an obvious side; sensitivity 1.00, 1.00
_WIDTHS_M = (2.5, 2.8, 3.1, 3.4, 3.8, 4.3, 4.8, 5.3, 5.8, 6.3, 6.8, 7.3)  # [m] 8 ft to two lanes
_USUAL_WIDTHS_M = (2.5, 4.3)  # [m] 8 to 14 ft; about the 9 to 12 ft of AASHTO Green Book, 4.3
_OPENING_COST = 5.0  # [1/m] of a width that changes, in squared sigmas


@dataclass(frozen=True, slots=True, eq=False)
class SideAssignment:
    """The boundary that each marker was assigned to."""

    side: Ints  # shape (K,): `LaneSide`; UNKNOWN for a marker on no boundary
    off_m: Floats  # shape (K,): [m] distance left of its boundary; of a marker on no boundary, left of the nearer one
    contradicts: Bools  # shape (K,): the marker is on the boundary that its message does not name
    width_m: float  # [m] of the lane


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


# === The lane along an initial line.


_MAX_ROUNDS = 8  # of solving beside a line and moving the line; sensitivity 1.23, 0.93
_CONVERGED_M = 0.1  # [m] a line that moves less is the centre; sensitivity 1.00, 1.18
_NEARLY_CONVERGED_M = 0.5  # [m] a line that moved less shows no new outliers; sensitivity 1.00, 1.00
_MAX_REJECTIONS = 12  # of outliers beside one line; sensitivity 1.00, 1.00
_MAX_GROWTH = 2.0  # of the length of the initial line; more is a line that winds between outliers
_REJECTION_STRETCH_M = 60.0  # [m] within it one outlier at a time; sensitivity 1.00, 1.00
_PAIR_SIGMAS = (
    5.0  # from which on a pair does not agree with the lane; source: decision 0016, 3 loses pairs of tight bends
)
_MIN_SLOPE_SHARE = 0.05  # of a pair's variance that others explain; keeps the division by it finite
_SCATTERS = (1.6, 2.5, 4.0)  # of markers, in their stated accuracy; 3.5, 5.5, 9 cm for the usual 2.2
_MIN_GAIN = 1.5  # of the log likelihood by a larger scatter; on scenes of `benchmarks.hunt cerpm`
_STIFFER = 3  # bends that are tried with a scatter: the one found and stiffer ones
_CONSTANT_WIDTH: JsonObject = WIDTH_MODELS[0]
_OPPOSITE_SHARE = 0.2  # of sides that agree with the track, below which they are of the other direction
_MIN_SIDED_MARKERS = 4  # to compare sides with the track
_SIDE_OFFSETS_M = (0.5, 4.0)  # [m] nearest and farthest offset at which a side is clear
_PRECISE_TRACK_M = 0.06  # [m] noise of an RTK track; source: three times `initial_line._MIN_SIGMA_M`
_PRECISE_WANDER, _COARSE_WANDER = 0.06, 0.2  # [m/sqrt(m)] of the centre; sensitivity 1.00, 1.00
_SINGLE_SIDE_DRIFTS = (0.05, 0.15, 0.4)  # [m/sqrt(m)] source: the receivers of `least_squares.OFFSET_MODELS`
_FIX_SIGMAS, _MIN_FIX_REACH_M = (
    8.0,
    6.0,
)  # [1, m] fixes further from the track's median offset are not used
_UNKNOWN_WIDTH = Hyperparameters(width_sd_m=0.4, width_length_m=400.0)  # of a lane with one known side


class FixOffsets(NamedTuple):
    """Fixes beside a line, each shape (F,) or (F, 2); empty without a track. [m]"""

    station_m: Floats
    left_m: Floats
    position_m: Floats
    sigma_m: Floats


NO_FIXES = FixOffsets(np.empty(0), np.empty(0), np.empty((0, 2)), np.empty(0))


class LaneFit:
    """A lane while it is fitted: a line, the measurements beside it, and the solution beside it.

    Parameters
    ----------
    line : SmoothLine
        Near the lane's centre, in the direction of travel.
    taken : ndarray of bool, shape (M,)
        Markers that may be used.

    Attributes
    ----------
    used : ndarray of bool, shape (M,)
        Markers that are used.
    side : ndarray of int, shape (M,)
    residual_m, station_m : ndarray, shape (M,)
        Distance of each marker from its boundary, and its station. [m]
    left_out : dict
        Row of the observations to reason and distance.
    """

    problem: LaneProblem
    solution: LaneSolution
    _pairs: Pairs

    def __init__(
        self,
        line: SmoothLine,
        observations: LaneObservations,
        taken: Bools,
        drive: DrivenLine | None,
        rules: LaneRules,
        notes: Notes,
    ) -> None:
        self.line, self._observations, self._drive, self._rules = line, observations, drive, rules
        half = rules.usual_width_m / 2
        self.station_m, self._left_m = line.project_markers(observations.point_m, observations.side, half)
        named = _sides_along_track(self.station_m, self._left_m, observations, taken, drive, notes)
        if named is not observations.side:
            self.station_m, self._left_m = line.project_markers(observations.point_m, named, half)
        sides = _assign_taken_sides(self.station_m, self._left_m, named, taken, drive)
        self.side = sides.side
        self.used = taken & (sides.side != UNKNOWN)
        self.left_out = {
            int(k): (
                LeftOutReason.WRONG_SIDE if sides.contradicts[k] else LeftOutReason.OFF_THE_LINE,
                float(sides.off_m[k]),
            )
            for k in np.flatnonzero(taken & ~self.used)
        }
        self.residual_m = np.full(len(taken), np.nan)
        self._hyperparameters = _initial_hyperparameters(sides, self.used, rules)
        self._fixes = _fixes_beside(line, drive)

    def run(self) -> bool:
        """Solve beside the line, move the line to the solution, and repeat. Returns whether a lane was found."""
        longest_m = _MAX_GROWTH * (self.line.length_m + 2 * self._rules.reach_m) + 2 * self._rules.bridge_m
        moved = np.inf
        for turn in range(_MAX_ROUNDS):
            reach = np.ptp(self.station_m[self.used]) if self.used.any() else 0.0
            if self.used.sum() < 2 or self.outlier_ratio > self._rules.max_outlier_ratio or not reach < longest_m:
                return False
            self._solve(turn, nearly_converged=moved < _NEARLY_CONVERGED_M)
            moved = float(np.abs(self.solution.centre_m).max())
            if turn and moved < _CONVERGED_M:
                break
            if turn < _MAX_ROUNDS - 1:
                self._move_line()
        return self.outlier_ratio <= self._rules.max_outlier_ratio

    @property
    def has_both_sides(self) -> bool:
        """Whether markers of both sides are used."""
        return len(np.unique(self.side[self.used])) == 2

    @property
    def outlier_ratio(self) -> float:
        """Share of the markers that lie off the line."""
        return len(self.left_out) / max(len(self.left_out) + int(self.used.sum()), 1)

    def scatter(self) -> float:
        """Factor on the markers' standard deviations that is the most likely one: 1 unless another is far likelier."""
        best, most = 1.0, self._log_likelihood(1.0)
        for factor in _SCATTERS:
            value = self._log_likelihood(factor)
            if value < most + _MIN_GAIN:
                break
            best, most = factor, value
        return best

    def _log_likelihood(self, scatter: float) -> float:
        """Log likelihood where markers scatter so many times as much: of the lane as found, or of a simpler one."""
        now, found = self.problem, self._hyperparameters
        problem, sigma_m = now, scatter * now.measured.sigma_m
        if scatter != 1:  # how far pairs are out of square was measured
            measured = replace(now.measured, sigma_m=sigma_m)
            problem = LaneProblem(self.line, measured, float(now.station_m[0]), float(now.station_m[-1]))
        bends = [bend for bend in BENDS if bend <= found.bend][-_STIFFER:]
        widths = (found, replace(found, **_CONSTANT_WIDTH)) if scatter != 1 and self.has_both_sides else (found,)
        likeliest = max(problem.log_likelihood(replace(width, bend=bend)) for width in widths for bend in bends)
        return likeliest - float(np.log(sigma_m).sum())

    def _solve(self, turn: int, *, nearly_converged: bool) -> None:
        """Solve beside one line, leaving out outliers until there are none; not beside a nearly converged line."""
        side = self.side[self.used]
        offset_models = _offset_models(side, self._drive)
        width_models = WIDTH_MODELS if self.has_both_sides else ()
        choosing = turn < (1 if self._drive is not None else 2)
        for left in range(_MAX_REJECTIONS, -1, -1):
            self.problem = self._problem(turn)
            if choosing:
                self._hyperparameters = choose_hyperparameters(
                    self.problem, self._hyperparameters, offset_models, width_models
                )
            self.solution = self.problem.solve(self._hyperparameters)
            self._trust_pairs()
            residual = self.solution.residuals()
            if nearly_converged or not left:
                break
            if not self._drop_outliers(residual, self.solution.residual_variance_shares()):
                break
            choosing = True
        self.residual_m[:] = np.nan
        self.residual_m[self.used] = residual
        if self.has_both_sides and not self._hyperparameters.opens:
            self._hyperparameters = replace(self._hyperparameters, width_m=float(np.mean(self.solution.width_m)))

    def _problem(self, turn: int) -> LaneProblem:
        """The problem of all used markers and of the fixes beside them."""
        start, end = float(self.station_m[self.used].min()), float(self.station_m[self.used].max())
        fixes = self._fixes
        if len(fixes.station_m):
            start = min(start, max(start - self._rules.reach_m, float(fixes.station_m.min())))
            end = max(end, min(end + self._rules.reach_m, float(fixes.station_m.max())))
        inside = (fixes.station_m >= start) & (fixes.station_m <= end)
        known_lengths = NO_KNOWN_LENGTHS
        if self._drive is None and turn:  # lengths along an initial line are too inaccurate
            known_lengths = find_known_lengths(self.line, self.station_m, self.used, self._hyperparameters.width_m)
        used_side = np.where(self.used, self.side, UNKNOWN)
        self._pairs = find_pairs(self.station_m, self._left_m, used_side, self._observations.sigma_m)
        measured = Measurements(
            station_m=self.station_m[self.used],
            left_m=self._left_m[self.used],
            sigma_m=self._observations.sigma_m[self.used],
            sign=np.where(self.side == LEFT, 1.0, -1.0)[self.used],
            fix_station_m=fixes.station_m[inside],
            fix_left_m=fixes.left_m[inside],
            fix_sigma_m=fixes.sigma_m[inside],
            pair_station_m=self._pairs.station_m,
            pair_slope=self._pairs.slope,
            pair_sigma=self._pairs.cautious_sigma,
            known_lengths=known_lengths,
        )
        return LaneProblem(self.line, measured, start, end)

    def _trust_pairs(self) -> None:
        """Solve again, where pairs differ from those beside them, with those that agree with the lane and no others.

        A pair that differs but agrees is of a bend; one that does not differ and disagrees is oblique as others beside
        it are.
        """
        pairs, now = self._pairs, self.problem
        differs = pairs.cautious_sigma > pairs.sigma
        if not differs.any():
            return
        slope, slope_sigma = self.solution.slopes(pairs.station_m)
        off = np.abs(pairs.slope - slope)
        share = np.maximum(1 - (slope_sigma / pairs.sigma) ** 2, _MIN_SLOPE_SHARE)
        agrees = off < _PAIR_SIGMAS * np.where(
            differs, np.hypot(pairs.sigma, slope_sigma), pairs.sigma * np.sqrt(share)
        )
        if (agrees == ~differs).all():
            return
        cautious = np.where(differs, pairs.cautious_sigma, np.hypot(pairs.sigma, off / share))
        measured = replace(now.measured, pair_sigma=np.where(agrees, pairs.sigma, cautious))
        self.problem = LaneProblem(self.line, measured, float(now.station_m[0]), float(now.station_m[-1]))
        self.solution = self.problem.solve(self._hyperparameters)

    def _drop_outliers(self, residual_m: Floats, share: Floats) -> bool:
        """Leave out the worst of the markers that are far from where the others predict them; whether any was."""
        rows = np.flatnonzero(self.used)
        z = np.abs(residual_m) / (self._observations.sigma_m[rows] * np.sqrt(share))
        off = residual_m / share
        outlier = (z > self._rules.off_the_line_z) & (np.abs(off) > self._rules.off_the_line_m)
        if len(rows) <= 2 or not outlier.any():
            return False
        for k in _worst_apart(z * outlier, self.station_m[rows])[: len(rows) - 2]:
            self.used[rows[k]] = False
            self.left_out[int(rows[k])] = (LeftOutReason.OFF_THE_LINE, float(off[k]))
        return True

    def _move_line(self) -> None:
        """Replace the line by the solution, and measure beside it."""
        knots = self.problem.station_m
        points = self.line.offset_points(knots, self.solution.centre_m)
        along = lengths_along(points)

        def moved(station_m: Floats) -> Floats:
            return np.interp(station_m, knots, along) + station_m - np.clip(station_m, knots[0], knots[-1])

        self.line = SmoothLine(points)
        self.station_m, self._left_m = self.line.refine_stations(self._observations.point_m, moved(self.station_m))
        position = self._fixes.position_m
        station, left = self.line.refine_stations(position, moved(self._fixes.station_m))
        self._fixes = FixOffsets(station, left, position, self._fixes.sigma_m)


def _sides_along_track(
    station: Floats, left: Floats, observations: LaneObservations, taken: Bools, drive: DrivenLine | None, notes: Notes
) -> Ints:
    """Sides sent by the markers, exchanged where the track runs in the other direction of travel."""
    named = observations.side
    if drive is None or _share_agreeing(station[taken], left[taken], named[taken]) >= _OPPOSITE_SHARE:
        return named
    notes.warn("the sides sent by the markers are those of the other direction of travel: the path follows the track")
    return np.where(named == LEFT, RIGHT, np.where(named == RIGHT, LEFT, UNKNOWN))


def _share_agreeing(station: Floats, left: Floats, named: Ints) -> float:
    """Share of markers whose side agrees with the track; 1 where too few show it.

    Where both sides are named, a left marker must be left of the right one next to it, whatever the track's error.
    """
    on_left, on_right = np.flatnonzero(named == LEFT), np.flatnonzero(named == RIGHT)
    if min(len(on_left), len(on_right)) >= _MIN_SIDED_MARKERS:
        on_right = on_right[np.argsort(station[on_right])]
        beside = on_right[nearest_sorted(station[on_right], station[on_left])]
        return float(np.mean(left[on_left] > left[beside]))
    nearest, farthest = _SIDE_OFFSETS_M
    clear = (named != UNKNOWN) & (np.abs(left) > nearest) & (np.abs(left) < farthest)
    if clear.sum() < _MIN_SIDED_MARKERS:
        return 1.0
    return float(np.mean((left[clear] > 0) == (named[clear] == LEFT)))


def _assign_taken_sides(
    station: Floats, left: Floats, named: Ints, taken: Bools, drive: DrivenLine | None
) -> SideAssignment:
    """Sides of the markers that may be used; UNKNOWN for the others."""
    precise = drive is not None and drive.sigma_m < _PRECISE_TRACK_M
    wander = _PRECISE_WANDER if precise else _COARSE_WANDER
    found = assign_sides(station[taken], left[taken], named[taken], wander=wander, near_track=drive is not None)
    side, off = np.zeros(len(station), np.int64), np.full(len(station), np.nan)
    contradicts = np.zeros(len(station), bool)
    side[taken], off[taken], contradicts[taken] = found.side, found.off_m, found.contradicts
    return SideAssignment(side, off, contradicts, found.width_m)


def _initial_hyperparameters(sides: SideAssignment, used: Bools, rules: LaneRules) -> Hyperparameters:
    """Width of the lane as far as the sides show it."""
    both = (sides.side[used] == LEFT).any() and (sides.side[used] == RIGHT).any()
    if both:
        return Hyperparameters(width_m=sides.width_m)
    return replace(_UNKNOWN_WIDTH, width_m=rules.usual_width_m)


def _offset_models(side: Ints, drive: DrivenLine | None) -> tuple[OffsetModel, ...]:
    """Candidates for the vehicle's offset: a driver's wander, or a receiver's slow error."""
    if drive is None:
        return ()
    single_side = (side == LEFT).all() or (side == RIGHT).all()
    if single_side and not drive.accuracy_m < TRUSTED_TRACK_M:  # a common offset of the track would not show
        slow = drive.accuracy_m if np.isfinite(drive.accuracy_m) else UNKNOWN_ACCURACY_M
        return tuple({"drift": value, "slow_m": slow} for value in _SINGLE_SIDE_DRIFTS)
    return OFFSET_MODELS


def _fixes_beside(line: SmoothLine, drive: DrivenLine | None) -> FixOffsets:
    """Fixes beside a line, without those far from the others."""
    if drive is None:
        return NO_FIXES
    station, left = line.project(drive.fix_m)
    good = np.abs(left - np.median(left)) < max(_FIX_SIGMAS * drive.sigma_m, _MIN_FIX_REACH_M)
    return FixOffsets(station[good], left[good], drive.fix_m[good], np.full(int(good.sum()), drive.sigma_m))


def _worst_apart(z: Floats, station: Floats) -> list[int]:
    """The largest outliers, no two of them near each other."""
    chosen: list[int] = []
    for k in np.argsort(-z):
        if z[k] <= 0:
            break
        if all(abs(station[k] - station[other]) > _REJECTION_STRETCH_M for other in chosen):
            chosen.append(int(k))
    return chosen
