"""Centre, width and the vehicle's offset along a line, all in one least-squares problem.

At knots along a line that is nearly the lane's centre three things are unknown: how far the centre lies to the left of
the line (c), the lane's width (w), and how far the vehicle's track lies to the left of the centre (v). A marker of the
left boundary measures c + w / 2, one of the right c - w / 2, a fix of the vehicle c + v. Between the measurements

- the curvature of the centre changes as little as it can: third differences of the curve are small;
- the width is an Ornstein-Uhlenbeck process about its mean: lanes step by decimetres where a line is painted anew;
- the vehicle's offset is Matern 3/2 noise for the driver, or a random walk for a receiver's slow error.

How strong each of these is, is chosen by the likelihood of the measurements under it (`choose_strengths`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from app.decoders.cerpm.lane_banded import apply, covariances, factor, gather, gram, log_determinant, solve
from app.decoders.cerpm.lane_line import Line
from app.decoders.cerpm.lane_spacing import NONE as NO_STRETCHES
from app.decoders.cerpm.lane_spacing import Stretches
from app.decoders.cerpm.lane_types import Floats, Ints

KNOT_M = 3.0
_PROBE_KNOTS = 2
_FEEL_M = 256.0  # measurements further away than this do not change what is known of a place
_BAND = 9
_EXACT_M = 1e-3


@dataclass(frozen=True, slots=True)
class Strengths:
    """Hyperparameters.

    Attributes
    ----------
    bend : float
        Standard deviation of the change of curvature over a metre. [1/m^2 sqrt(m)]
    wander_m, wander_length_m : float
        Of the vehicle's offset, and the length over which it is forgotten. [m]
    drift, slow_m : float
        Growth of the receiver's slow error, which replaces the wander where it is not 0 [m/sqrt(m)], and its size. [m]
    width_m, width_sd_m, width_length_m : float
        Of the lane's width. [m]
    """

    bend: float = 0.003
    wander_m: float = 0.2
    wander_length_m: float = 30.0
    drift: float = 0.0
    slow_m: float = 3.0
    width_m: float = 3.3
    width_sd_m: float = 0.25
    width_length_m: float = 60.0


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What was measured, at stations of a line.

    `sign` is 1 for markers on the left, -1 on the right; `pair_slope` is the slope of the centre against the line that
    pairs of markers across from each other tell.
    """

    station_m: Floats
    left_m: Floats
    sigma_m: Floats
    sign: Floats
    fix_station_m: Floats
    fix_left_m: Floats
    fix_sigma_m: Floats
    pair_station_m: Floats
    pair_slope: Floats
    pair_sigma: Floats
    stretches: Stretches = NO_STRETCHES


class Problem:
    """The least-squares problem of some evidence beside a line.

    Parameters
    ----------
    line : Line
    evidence : Evidence
    start_m, end_m : float
        Stations between which the lane is wanted. [m]
    """

    def __init__(self, line: Line, evidence: Evidence, start_m: float, end_m: float) -> None:
        self.tracked = len(evidence.fix_left_m) > 0
        self.fields = 3 if self.tracked or len(evidence.stretches.start_m) else 2
        self.count = max(int(np.ceil((end_m - start_m) / KNOT_M)) + 1, 5)
        self.knot_m = (end_m - start_m) / (self.count - 1)
        self.start_m = start_m
        self.size = self.fields * self.count
        self.station_m: Floats = start_m + self.knot_m * np.arange(self.count, dtype=np.float64)
        self.evidence = evidence
        self.marker_index, self.marker_value = self.rows(evidence.station_m, [1.0, None], evidence.sign / 2)
        self._measure()
        self._priors(line)
        if self.fields == 3 and not self.tracked:
            self._lengths(line)

    def rows(self, station_m: Floats, parts: list[float | None], varying: Floats | None = None) -> tuple[Ints, Floats]:
        """Sparse rows that read a mix of the fields at stations: one coefficient a field, None for a varying one."""
        place = np.clip((station_m - self.start_m) / self.knot_m, 0, self.count - 1 - 1e-9)
        knot = place.astype(np.int64)
        share = place - knot
        index, value = [], []
        for k, part in enumerate(parts):
            scale = varying if part is None and varying is not None else np.full(len(place), part or 0.0)
            index += [self.fields * knot + k, self.fields * (knot + 1) + k]
            value += [scale * (1 - share), scale * share]
        return np.stack(index, 1), np.stack(value, 1)

    def _measure(self) -> None:
        e = self.evidence
        weight = e.sigma_m**-2.0
        self.data = gram(self.marker_index, self.marker_value, weight, self.size, _BAND)
        self.right = gather(self.marker_index, self.marker_value, weight * e.left_m, self.size)
        self.energy = float(np.sum(weight * e.left_m**2))
        if self.tracked:
            index, value = self.rows(e.fix_station_m, [1.0, 0.0, 1.0])
            index, value = index[:, [0, 1, 4, 5]], value[:, [0, 1, 4, 5]]
            weight = e.fix_sigma_m**-2.0
            self.data += gram(index, value, weight, self.size, _BAND)
            self.right += gather(index, value, weight * e.fix_left_m, self.size)
            self.energy += float(np.sum(weight * e.fix_left_m**2))

        knot = np.clip(((e.pair_station_m - self.start_m) / self.knot_m).astype(np.int64), 0, self.count - 2)
        self.pair_index = self.fields * np.stack([knot, knot + 1], 1)
        self.pair_value = np.broadcast_to(np.array([-1.0, 1.0]) / self.knot_m, (len(knot), 2))
        weight = e.pair_sigma**-2.0
        self.data += gram(self.pair_index, self.pair_value, weight, self.size, _BAND)
        self.right += gather(self.pair_index, self.pair_value, weight * e.pair_slope, self.size)
        self.energy += float(np.sum(weight * e.pair_slope**2))

    def _priors(self, line: Line) -> None:
        n, h = self.count, self.knot_m
        point, tangent = line.at(self.station_m)
        normal = np.stack([-tangent[:, 1], tangent[:, 0]], 1)
        third = np.array([-1.0, 3.0, -3.0, 1.0])
        across = normal[1:-2] + normal[2:-1]
        across /= np.maximum(np.hypot(*across.T), 1e-9)[:, None]
        k = np.arange(n - 3)[:, None] + np.arange(4)
        self.bend_index = self.fields * k
        self.bend_value = third * np.einsum("rjx,rx->rj", normal[k], across)
        self.bend_target = -np.einsum("j,rjx,rx->r", third, point[k], across)
        self.bend = gram(self.bend_index, self.bend_value, np.ones(n - 3), self.size, _BAND) / h**5
        self.bend_right = gather(self.bend_index, self.bend_value, self.bend_target, self.size) / h**5
        self.bend_energy = float(np.sum(self.bend_target**2)) / h**5
        self.smooth = [[self._differences(order, k) for order in range(3)] for k in range(1, self.fields)]

    def _lengths(self, line: Line) -> None:
        """Length of the centre beyond the line's on stretches where it is known: it shrinks by c times the curvature.

        The third field adds it up from the start of each stretch, so that the matrix stays banded.
        """
        e, h, n = self.evidence.stretches, self.knot_m, self.count
        first = np.clip(np.ceil((e.start_m - self.start_m) / h).astype(np.int64), 0, n - 1)
        last = np.clip(np.floor((e.end_m - self.start_m) / h).astype(np.int64), 0, n - 1)
        apart = last > first
        first, last = first[apart], last[apart]
        inside = np.zeros(n + 1, np.int64)
        np.add.at(inside, first, 1)
        np.add.at(inside, last, -1)
        k = np.flatnonzero(np.cumsum(inside)[:-1] > 0)
        bend = np.interp(self.station_m, line.station_m, line.curvature_1pm)
        index = np.stack([3 * k, 3 * k + 2, 3 * k + 3, 3 * k + 5], 1)
        ones = np.ones(len(k))
        value = np.stack([h * bend[k] / 2, -ones, h * bend[k + 1] / 2, ones], 1)
        # A stretch ends where the next begins: its last knot is the next one's first, so it ends one knot before.
        closing = np.isin(k + 1, first)
        self.data += gram(
            index[~closing], value[~closing], np.full(int((~closing).sum()), _EXACT_M**-2.0), self.size, _BAND
        )
        self.data[0, 2::3] += 1e-6
        self.data[0, 3 * first + 2] += _EXACT_M**-2.0
        ends = np.where(np.isin(last, first), last - 1, last)
        weight = e.sigma_m[apart] ** -2.0
        self.data[0, 3 * ends + 2] += weight
        self.right[3 * ends + 2] += weight * e.excess_m[apart]
        self.energy += float(np.sum(weight * e.excess_m[apart] ** 2))

    def _differences(self, order: int, which: int) -> Floats:
        """Integral of a field's squared derivative."""
        value = np.array([[1.0], [-1.0, 1.0], [1.0, -2.0, 1.0]][order])
        k = np.arange(self.count - order)[:, None] + np.arange(order + 1)
        rows = np.broadcast_to(value, k.shape)
        h = self.knot_m
        return gram(self.fields * k + which, rows, np.ones(len(k)), self.size, _BAND) * h ** (1 - 2 * order)

    def matrix(self, s: Strengths) -> tuple[Floats, Floats, float]:
        """Normal matrix, right side, and the energy that no solution takes away."""
        width = _ornstein(s.width_sd_m, s.width_length_m)
        total = self.data + self.bend / s.bend**2
        total += width[0] * self.smooth[0][0] + width[1] * self.smooth[0][1]
        right = self.right + self.bend_right / s.bend**2
        ones = width[0] * self.smooth[0][0][0] * s.width_m
        right = right + ones
        energy = self.energy + self.bend_energy / s.bend**2 + float(np.sum(ones)) * s.width_m
        if self.tracked:
            for order, a in enumerate(_vehicle(s)):
                if a:
                    total += a * self.smooth[1][order]
        return total, right, energy

    def log_likelihood(self, s: Strengths) -> float:
        """Of the measurements under some strengths, but for what does not depend on bend and vehicle."""
        total, right, energy = self.matrix(s)
        cholesky = factor(total)
        x = solve(cholesky, right)
        fit = energy - float(right @ x)
        value = -0.5 * (fit + log_determinant(cholesky)) - (self.count - 3) * float(np.log(s.bend))
        return value + (0.5 * self._log_prior(_vehicle(s)) if self.tracked else 0.0)

    def _log_prior(self, weights: list[float]) -> float:
        """Log determinant of the prior precision of the vehicle's offset."""
        own = sum(a * self.smooth[1][order][:7:3, 2::3] for order, a in enumerate(weights))
        return log_determinant(factor(np.asarray(own)))

    def solve(self, s: Strengths) -> Solution:
        """Centre, width and offset under some strengths, and what is not sure of them."""
        total, right, _ = self.matrix(s)
        cholesky = factor(total)
        return Solution(self, cholesky, solve(cholesky, right))


class Solution:
    """A solved problem."""

    def __init__(self, problem: Problem, cholesky: Floats, x: Floats) -> None:
        self.problem, self._cholesky, self._x = problem, cholesky, x
        self.centre_m = x[:: problem.fields]
        self.width_m = x[1 :: problem.fields]

    def residuals(self) -> Floats:
        """How far each marker lies left of its boundary. [m]"""
        p = self.problem
        return p.evidence.left_m - apply(p.marker_index, p.marker_value, self._x)

    def shares(self) -> Floats:
        """1 - h for each marker, where h is the share of its own place in what is said of it.

        Against its neighbours alone its residual is r / (1 - h), with a standard deviation of sigma / sqrt(1 - h).
        """
        p = self.problem
        e = p.evidence
        group, groups = _grouped(e.station_m)
        variance = covariances(self._cholesky, p.marker_index, p.marker_value, p.marker_value, group, p.size, groups)
        return np.maximum(1 - variance / e.sigma_m**2, 1e-9)

    def sigmas(self) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """Some stations, and standard deviations there of the centre, left boundary, right boundary and width. [m]"""
        p = self.problem
        knots = np.unique(np.append(np.arange(0, p.count, _PROBE_KNOTS), p.count - 1))
        groups = min(len(knots), max(int(_FEEL_M / (p.knot_m * _PROBE_KNOTS)), 1))
        group = np.arange(len(knots)) % groups
        right = np.zeros((p.size, 2 * groups))
        right[p.fields * knots, group] = 1
        right[p.fields * knots + 1, group + groups] = 1
        solved = solve(self._cholesky, right)
        cc = solved[p.fields * knots, group]
        cw = solved[p.fields * knots + 1, group]
        ww = solved[p.fields * knots + 1, group + groups]
        left, right_side = (np.sqrt(np.maximum(cc + k * cw + ww / 4, 0)) for k in (1, -1))
        return p.station_m[knots], np.sqrt(np.maximum(cc, 0)), left, right_side, np.sqrt(np.maximum(ww, 0))


def _grouped(station_m: Floats) -> tuple[Ints, int]:
    """Groups of rows that are at least `_FEEL_M` apart, as few as there can be."""
    order = np.argsort(station_m, kind="stable")
    ordered = station_m[order]
    # as many as ever lie within the length that is felt
    within = np.searchsorted(ordered, ordered + _FEEL_M, side="left") - np.arange(len(ordered))
    groups = int(within.max())
    group = np.empty(len(ordered), np.int64)
    group[order] = np.arange(len(ordered)) % groups
    return group, groups


def _ornstein(sd: float, length: float) -> tuple[float, float]:
    """Weights of the squared value and slope: precision (k^2 + w^2) / (2 sd^2 k)."""
    k = 1 / length
    return k / (2 * sd**2), 1 / (2 * sd**2 * k)


def _vehicle(s: Strengths) -> list[float]:
    """Weights of the squared value, slope and bend of the vehicle's offset."""
    if s.drift:
        return [s.drift**2 / (4 * s.slow_m**4), s.drift**-2.0, 0.0]
    k = 1 / s.wander_length_m
    return [k / (4 * s.wander_m**2), 1 / (2 * k * s.wander_m**2), 1 / (4 * k**3 * s.wander_m**2)]


VEHICLES: tuple[dict[str, float], ...] = (
    {"wander_m": 0.2, "wander_length_m": 30.0}, {"wander_m": 0.2, "wander_length_m": 15.0},
    {"wander_m": 0.5, "wander_length_m": 30.0}, {"drift": 0.05}, {"drift": 0.15}, {"drift": 0.4},
)  # fmt: skip
_BENDS = (0.0005, 0.0015, 0.003, 0.006, 0.015)


def choose_strengths(problem: Problem, start: Strengths, vehicles: tuple[dict[str, float], ...]) -> Strengths:
    """The likeliest strengths: of some for the vehicle's offset, then of some for the lane's bends."""
    best = start
    if problem.tracked and vehicles:
        best = _likeliest(
            problem, [replace(start, drift=0.0) if "drift" not in v else start for v in vehicles], vehicles
        )
    return _likeliest(problem, [best] * len(_BENDS), tuple({"bend": value} for value in _BENDS))


def _likeliest(problem: Problem, bases: list[Strengths], changes: tuple[dict[str, float], ...]) -> Strengths:
    tried = [replace(base, **change) for base, change in zip(bases, changes, strict=True)]
    return max(tried, key=problem.log_likelihood)
