"""Centre, width and the vehicle's offset along a line, in one least-squares problem.

At knots along a line near the lane's centre there are three unknown fields: how far the centre is left of the line (c),
the lane's width (w), and how far the vehicle's track is left of the centre (v). A marker of the left boundary measures
c + w / 2, one of the right boundary c - w / 2, a fix of the vehicle c + v. Between the measurements

- the curvature of the centre changes as little as possible: third differences of the curve are small;
- the width is an Ornstein-Uhlenbeck process about its mean: lanes change by decimetres where a line is painted again;
- the vehicle's offset is Matern 3/2 noise for a driver, or a random walk for a receiver's slow error.

The strength of each of these is chosen by the likelihood of the measurements (`choose_hyperparameters`).

Without a track the third field sums up the length of the centre on stretches of known length (`observations`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy

from app.compiled import ieee_kernel
from app.lanes.observations import NO_KNOWN_LENGTHS, KnownLengths
from app.lanes.smooth_line import SmoothLine, left_normals
from app.values import Floats, Ints, JsonObject

# === Least squares with unknowns along a line: the matrices are banded, so the cost is linear in the line's length.
#
# LAPACK is called directly: the checks of scipy.linalg cost more than matrices of this size.


_DIFFERENCES = ([1.0], [-1.0, 1.0], [1.0, -2.0, 1.0], [-1.0, 3.0, -3.0, 1.0])
_LIFT, _LIFT_OF_LARGEST = 1e-9, 1e-12  # diagonal shares added against rounding; source: above float64, 2.2e-16


def gram(index: Ints, value: Floats, weight: Floats, size: int, band: int) -> Floats:
    """Weighted sum of the outer products of sparse rows, in LAPACK's lower banded form, shape (band + 1, size).

    Parameters
    ----------
    index : ndarray of int, shape (R, M)
        Unknowns of each row, no two further apart than `band`.
    value : ndarray, shape (R, M)
        Their coefficients.
    weight : ndarray, shape (R,)
    """
    total = np.zeros((band + 1) * size)
    for a in range(index.shape[1]):
        for b in range(a + 1):
            low, high = np.minimum(index[:, a], index[:, b]), np.maximum(index[:, a], index[:, b])
            total += np.bincount((high - low) * size + low, weight * value[:, a] * value[:, b], (band + 1) * size)
    return total.reshape(band + 1, size)


def gather(index: Ints, value: Floats, target: Floats, size: int) -> Floats:
    """Sum of sparse rows times their (weighted) targets, shape (size,)."""
    return np.asarray(np.bincount(index.ravel(), (value * target[:, None]).ravel(), size), float)


def difference_gram(order: int, count: int, band: int) -> Floats:
    """Sum of the squared differences of an order of `count` unknowns, as a banded matrix, shape (band + 1, count)."""
    value = np.array(_DIFFERENCES[order])
    k = np.arange(count - order)[:, None] + np.arange(order + 1)
    return gram(k, np.broadcast_to(value, k.shape), np.ones(len(k)), count, band)


def apply(index: Ints, value: Floats, x: Floats) -> Floats:
    """Sparse rows times x, shape (R,)."""
    return np.asarray(np.sum(value * x[index], 1))


def log_determinant(cholesky: Floats) -> float:
    """Log determinant of the matrix with this banded Cholesky factor."""
    return 2.0 * float(np.sum(np.log(cholesky[0])))


def factor(matrix: Floats) -> Floats:
    """Banded Cholesky factor, lower form, of a matrix that is positive definite except for rounding."""
    found, info = scipy.linalg.lapack.dpbtrf(matrix, lower=1)
    if info:
        lifted = matrix.copy()
        lifted[0] *= 1 + _LIFT
        lifted[0] += _LIFT_OF_LARGEST * matrix[0].max()
        found, info = scipy.linalg.lapack.dpbtrf(lifted, lower=1)
    if info:
        raise np.linalg.LinAlgError("normal matrix is not positive definite")
    return np.asarray(found)


def solve(cholesky: Floats, right: Floats) -> Floats:
    """Solution for one right-hand side (N,) or many (N, G)."""
    solved, _ = scipy.linalg.lapack.dpbtrs(cholesky, right, lower=1)
    return np.asarray(solved)


@ieee_kernel
def inverse_band(cholesky: Floats) -> Floats:
    """The elements of inv(A) within the band of A, in the same form as its Cholesky factor, shape (band + 1, N).

    Source: Takahashi, Fagan and Chen (1973), Formation of a sparse bus impedance matrix; with A = L L' and l = the part
    of a column of L below its diagonal over its diagonal d, the inverse Z has the column -Z l below the diagonal and
    1 / d^2 + l' Z l on it.
    """
    band, size = cholesky.shape[0] - 1, cholesky.shape[1]
    inverse = np.zeros((band + 1, size))
    share = np.zeros(band + 1)
    for j in range(size - 1, -1, -1):
        below = min(band, size - 1 - j)
        for q in range(1, below + 1):
            share[q] = cholesky[q, j] / cholesky[0, j]
        total = 1.0 / cholesky[0, j] ** 2
        for p in range(1, below + 1):
            column = 0.0
            for q in range(1, below + 1):
                column += inverse[abs(p - q), j + min(p, q)] * share[q]
            inverse[p, j] = -column
            total += share[p] * column
        inverse[0, j] = total
    return inverse


def variances(inverse: Floats, index: Ints, value: Floats) -> Floats:
    """a' inv(A) a for sparse rows a, by the band of inv(A) that they are within, shape (R,)."""
    low = np.minimum(index[:, :, None], index[:, None, :])
    high = np.maximum(index[:, :, None], index[:, None, :])
    return np.asarray(np.einsum("ra,rb,rab->r", value, value, inverse[high - low, low]))


# === Centre, width and the vehicle's offset along a line, in one least-squares problem.


KNOT_M = 3.0  # [m] between knots; sensitivity 0.95, 1.02
_MIN_KNOTS = 5  # source: third differences need four
_BAND = 9  # source: a third difference spans four knots of three fields: 3 x 3
_LENGTH_SUM_SIGMA_M = 1e-3  # [m] of one step of the summed length; source: a 30th of `observations._LENGTH_SIGMA_M`
_MIN_VARIANCE_SHARE = 1e-9  # source: keeps the division by 1 - h finite


@dataclass(frozen=True, slots=True)
class Hyperparameters:
    """Strengths of the priors."""

    # standard deviation of the change of curvature over a metre. [1/(m^2 sqrt(m))]
    bend: float = 0.003  # source: middle of `BENDS`
    # `wander_m`, `wander_length_m`: [m] of the vehicle's offset: standard deviation, and correlation length
    wander_m: float = 0.2  # source: drivers keep 0.18 m RMS (`simulation.radio.driving.Driver`)
    wander_length_m: float = 30.0  # source: 2.5 s (`Driver.wander_time_s`) at 45 km/h
    # `drift`, `slow_m`: of the receiver's slow error, which replaces the wander if not 0: growth [m/sqrt(m)], and
    # size [m]
    drift: float = 0.0
    slow_m: float = 3.0  # sensitivity 1.00, 1.00
    # `width_m`, `width_sd_m`, `width_length_m`: [m] of the lane's width: mean, standard deviation, correlation length
    width_m: float = 3.3  # source: `LaneRules.usual_width_m`
    width_sd_m: float = 0.25  # sensitivity 1.42, 0.96
    width_length_m: float = 60.0  # sensitivity 1.03, 1.00
    opens: bool = False  # the width is Matern 3/2 noise, as of a lane that opens or merges over tapers


@dataclass(frozen=True, slots=True, eq=False)
class Measurements:
    """Measurements at stations of a line."""

    # `station_m`, `left_m`, `sigma_m`, `sign`: shape (M,): markers: station, left offset, standard deviation [m]; 1 on
    # the left boundary, -1 on the right
    station_m: Floats
    left_m: Floats
    sigma_m: Floats
    sign: Floats
    # `fix_station_m`, `fix_left_m`, `fix_sigma_m`: shape (F,): [m] fixes of the vehicle
    fix_station_m: Floats
    fix_left_m: Floats
    fix_sigma_m: Floats
    # `pair_station_m`, `pair_slope`, `pair_sigma`: shape (P,): slope of the centre against the line, from pairs of
    # markers
    pair_station_m: Floats
    pair_slope: Floats
    pair_sigma: Floats
    known_lengths: KnownLengths = NO_KNOWN_LENGTHS


class LaneProblem:
    """The least-squares problem of measurements beside a line.

    Parameters
    ----------
    start_m, end_m : float
        Stations between which the lane is estimated. [m]
    """

    def __init__(self, line: SmoothLine, measured: Measurements, start_m: float, end_m: float) -> None:
        self.tracked = len(measured.fix_left_m) > 0
        self.fields = 3 if self.tracked or len(measured.known_lengths.start_m) else 2
        self.count = max(int(np.ceil((end_m - start_m) / KNOT_M)) + 1, _MIN_KNOTS)
        self.knot_m = (end_m - start_m) / (self.count - 1)
        self.start_m = start_m
        self.size = self.fields * self.count
        self.station_m: Floats = start_m + self.knot_m * np.arange(self.count, dtype=np.float64)
        self.measured = measured
        self.data: Floats = np.zeros((_BAND + 1, self.size))
        self.right: Floats = np.zeros(self.size)
        self.energy = 0.0
        self.marker_index, self.marker_value = self._rows(measured.station_m, [1.0, None], measured.sign / 2)
        self._add(self.marker_index, self.marker_value, measured.sigma_m, measured.left_m)
        if self.tracked:
            self._add_fixes()
        self._add_pairs()
        self._set_priors(line)
        if self.fields == 3 and not self.tracked:
            self._add_known_lengths(line)

    def _rows(self, station_m: Floats, parts: list[float | None], varying: Floats | None = None) -> tuple[Ints, Floats]:
        """Sparse rows for a linear combination of the fields at stations.

        Parameters
        ----------
        station_m : ndarray, shape (R,)
        parts : list of float or None
            One coefficient a field; None for `varying`.
        varying : ndarray, shape (R,), optional
        """
        place = np.clip((station_m - self.start_m) / self.knot_m, 0, self.count - 1 - 1e-9)
        knot = place.astype(np.int64)
        share = place - knot
        index, value = [], []
        for k, part in enumerate(parts):
            scale = varying if part is None and varying is not None else np.full(len(place), part or 0.0)
            index += [self.fields * knot + k, self.fields * (knot + 1) + k]
            value += [scale * (1 - share), scale * share]
        return np.stack(index, 1), np.stack(value, 1)

    def _add(self, index: Ints, value: Floats, sigma: Floats, target: Floats) -> None:
        """Add measurements to the normal equations."""
        weight = sigma**-2.0
        self.data += gram(index, value, weight, self.size, _BAND)
        self.right += gather(index, value, weight * target, self.size)
        self.energy += float(np.sum(weight * target**2))

    def _add_fixes(self) -> None:
        """A fix of the vehicle measures c + v."""
        index, value = self._rows(self.measured.fix_station_m, [1.0, 0.0, 1.0])
        index, value = index[:, [0, 1, 4, 5]], value[:, [0, 1, 4, 5]]
        self._add(index, value, self.measured.fix_sigma_m, self.measured.fix_left_m)

    def _add_pairs(self) -> None:
        """A pair of markers measures the slope of c."""
        index, value = self.slope_rows(self.measured.pair_station_m)
        self._add(index, value, self.measured.pair_sigma, self.measured.pair_slope)

    def slope_rows(self, station_m: Floats) -> tuple[Ints, Floats]:
        """Sparse rows for the slope of c at stations."""
        place = (station_m - self.start_m) / self.knot_m
        knot = np.clip(place.astype(np.int64), 0, self.count - 2)
        value = np.broadcast_to(np.array([-1.0, 1.0]) / self.knot_m, (len(knot), 2))
        return self.fields * np.stack([knot, knot + 1], 1), value

    def _set_priors(self, line: SmoothLine) -> None:
        """Third differences of the centre as a curve in the plane, and squared derivatives of the other fields."""
        n, h = self.count, self.knot_m
        point, tangent = line.points_at(self.station_m)
        normal = left_normals(tangent)
        third = np.array([-1.0, 3.0, -3.0, 1.0])
        across = normal[1:-2] + normal[2:-1]
        across /= np.maximum(np.hypot(*across.T), 1e-9)[:, None]
        k = np.arange(n - 3)[:, None] + np.arange(4)
        index = self.fields * k
        value = third * np.einsum("rjx,rx->rj", normal[k], across)
        target = -np.einsum("j,rjx,rx->r", third, point[k], across)
        self.bend = gram(index, value, np.ones(n - 3), self.size, _BAND) / h**5
        self.bend_right = gather(index, value, target, self.size) / h**5
        self.bend_energy = float(np.sum(target**2)) / h**5
        self.smooth = [[self._squared_derivative(order, k) for order in range(3)] for k in range(1, self.fields)]

    def _add_known_lengths(self, line: SmoothLine) -> None:
        """Stretches of known length: beside a line of curvature k the centre is shorter by the sum of c k ds.

        The third field sums this up from the start of each stretch, so that the matrix stays banded.
        """
        e, h, n = self.measured.known_lengths, self.knot_m, self.count
        first = np.clip(np.ceil((e.start_m - self.start_m) / h).astype(np.int64), 0, n - 1)
        last = np.clip(np.floor((e.end_m - self.start_m) / h).astype(np.int64), 0, n - 1)
        apart = last > first
        first, last = first[apart], last[apart]
        inside = np.zeros(n + 1, np.int64)
        np.add.at(inside, first, 1)
        np.add.at(inside, last, -1)
        k = np.flatnonzero(np.cumsum(inside)[:-1] > 0)
        bend = np.interp(self.station_m, line.station_m, line.curvature_per_m)
        index = np.stack([3 * k, 3 * k + 2, 3 * k + 3, 3 * k + 5], 1)
        ones = np.ones(len(k))
        value = np.stack([h * bend[k] / 2, -ones, h * bend[k + 1] / 2, ones], 1)
        # A stretch ends where the next begins: its last knot is the next one's first, so it ends one knot before.
        closing = np.isin(k + 1, first)
        exact = np.full(int((~closing).sum()), _LENGTH_SUM_SIGMA_M**-2.0)
        self.data += gram(index[~closing], value[~closing], exact, self.size, _BAND)
        self.data[0, 2::3] += 1e-6  # outside of all stretches the third field is 0
        self.data[0, 3 * first + 2] += _LENGTH_SUM_SIGMA_M**-2.0
        ends = np.where(np.isin(last, first), last - 1, last)
        weight = e.sigma_m[apart] ** -2.0
        self.data[0, 3 * ends + 2] += weight
        self.right[3 * ends + 2] += weight * e.excess_m[apart]
        self.energy += float(np.sum(weight * e.excess_m[apart] ** 2))

    def _squared_derivative(self, order: int, field: int) -> Floats:
        """Integral of the squared derivative of a field."""
        own = difference_gram(order, self.count, order)
        spread = np.zeros((_BAND + 1, self.size))
        spread[: self.fields * order + 1 : self.fields, field :: self.fields] = own
        return spread * self.knot_m ** (1 - 2 * order)

    def matrix(self, s: Hyperparameters) -> tuple[Floats, Floats, float]:
        """Normal matrix, right-hand side, and the sum of squares at zero."""
        width = _width_weights(s)
        total = self.data + self.bend / s.bend**2
        for order, weight in enumerate(width):
            total += weight * self.smooth[0][order]
        right = self.right + self.bend_right / s.bend**2
        mean_width = width[0] * self.smooth[0][0][0] * s.width_m
        right = right + mean_width
        energy = self.energy + self.bend_energy / s.bend**2 + float(np.sum(mean_width)) * s.width_m
        if self.tracked:
            for order, weight in enumerate(_offset_weights(s)):
                if weight:
                    total += weight * self.smooth[1][order]
        return total, right, energy

    def log_likelihood(self, s: Hyperparameters) -> float:
        """Log likelihood of the measurements, without terms that do not depend on the hyperparameters."""
        total, right, energy = self.matrix(s)
        cholesky = factor(total)
        x = solve(cholesky, right)
        fit = energy - float(right @ x)
        value = -0.5 * (fit + log_determinant(cholesky)) - (self.count - 3) * float(np.log(s.bend))
        value += 0.5 * self._log_prior(1, _width_weights(s))
        return value + (0.5 * self._log_prior(2, _offset_weights(s)) if self.tracked else 0.0)

    def _log_prior(self, field: int, weights: list[float]) -> float:
        """Log determinant of the prior precision of the width (field 1) or of the vehicle's offset (field 2)."""
        step = self.fields
        own = sum(w * self.smooth[field - 1][k][: 2 * step + 1 : step, field::step] for k, w in enumerate(weights))
        return log_determinant(factor(np.asarray(own)))

    def solve(self, s: Hyperparameters) -> LaneSolution:
        """Centre, width and offset, with their covariance."""
        total, right, _ = self.matrix(s)
        cholesky = factor(total)
        return LaneSolution(self, cholesky, solve(cholesky, right))


class LaneSolution:
    """A solved problem."""

    def __init__(self, problem: LaneProblem, cholesky: Floats, x: Floats) -> None:
        self.problem, self._cholesky, self._x = problem, cholesky, x
        self.centre_m = x[:: problem.fields]
        self.width_m = x[1 :: problem.fields]

    @cached_property
    def _inverse(self) -> Floats:
        """Covariance of unknowns that are near each other."""
        return np.asarray(inverse_band(self._cholesky))

    def residuals(self) -> Floats:
        """Distance of each marker left of its boundary. [m]"""
        p = self.problem
        return p.measured.left_m - apply(p.marker_index, p.marker_value, self._x)

    def residual_variance_shares(self) -> Floats:
        """1 - h of each marker, where its leverage h is the share of its own measurement in the prediction.

        Against the prediction of the other markers alone its residual is r / (1 - h), with the standard deviation
        sigma / sqrt(1 - h).
        """
        p = self.problem
        variance = variances(self._inverse, p.marker_index, p.marker_value)
        return np.maximum(1 - variance / p.measured.sigma_m**2, _MIN_VARIANCE_SHARE)

    def slopes(self, station_m: Floats) -> tuple[Floats, Floats]:
        """Slope of the centre against the line at stations, and its standard deviation."""
        index, value = self.problem.slope_rows(station_m)
        variance = variances(self._inverse, index, value)
        return apply(index, value, self._x), np.sqrt(np.maximum(variance, 0.0))

    def sigmas(self) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """The knots, and standard deviations there of the centre, left boundary, right boundary and width. [m]"""
        p, inverse = self.problem, self._inverse
        cc, cw, ww = inverse[0, :: p.fields], inverse[1, :: p.fields], inverse[0, 1 :: p.fields]
        left, right_side = (np.sqrt(np.maximum(cc + k * cw + ww / 4, 0)) for k in (1, -1))
        return p.station_m, np.sqrt(np.maximum(cc, 0)), left, right_side, np.sqrt(np.maximum(ww, 0))


def _ornstein_weights(sd: float, length: float) -> list[float]:
    """Weights of the squared value and slope of an Ornstein-Uhlenbeck process: precision (k^2 + w^2) / (2 sd^2 k)."""
    k = 1 / length
    return [k / (2 * sd**2), 1 / (2 * sd**2 * k)]


def _matern_weights(sd: float, length: float) -> list[float]:
    """Weights of the squared value, slope and second derivative of Matern 3/2 noise.

    It has the precision (k^2 + w^2)^2 / (4 sd^2 k^3), k = 1 / length.
    """
    k = 1 / length
    return [k / (4 * sd**2), 1 / (2 * k * sd**2), 1 / (4 * k**3 * sd**2)]


def _width_weights(s: Hyperparameters) -> list[float]:
    return (_matern_weights if s.opens else _ornstein_weights)(s.width_sd_m, s.width_length_m)


def _offset_weights(s: Hyperparameters) -> list[float]:
    """Weights of the squared value, slope and second derivative of the vehicle's offset."""
    if s.drift:
        return [s.drift**2 / (4 * s.slow_m**4), s.drift**-2.0, 0.0]
    return _matern_weights(s.wander_m, s.wander_length_m)


OffsetModel = dict[str, float]
OFFSET_MODELS: tuple[OffsetModel, ...] = (
    {"wander_m": 0.2, "wander_length_m": 30.0}, {"wander_m": 0.2, "wander_length_m": 15.0},
    {"wander_m": 0.5, "wander_length_m": 30.0}, {"drift": 0.05}, {"drift": 0.15}, {"drift": 0.4},
)  # fmt: skip
"""Candidates for the vehicle's offset: calm and lively drivers, receivers of 0.05 to 0.4 m/sqrt(m). Source: chosen by
hand to span a driver's 0.18 m RMS and receivers of 0.5 to 4 m over 100 m; the likelihood decides for each drive."""
WidthModel = dict[str, float | bool]
WIDTH_MODELS: tuple[WidthModel, ...] = (
    {"width_sd_m": 0.06, "width_length_m": 60.0, "opens": False},
    {"width_sd_m": 0.25, "width_length_m": 60.0, "opens": False},
    {"width_sd_m": 1.0, "width_length_m": 40.0, "opens": True},
    {"width_sd_m": 2.5, "width_length_m": 40.0, "opens": True},
)
"""Candidates for the width of a lane with two known sides: as painted, or with lanes that open and merge. Source: by
hand, the roads of decision record 0016."""
BENDS = (0.0005, 0.0015, 0.003, 0.006, 0.015)
"""Candidates for `Hyperparameters.bend`. Factors of two to three apart; the likelihood decides for each drive. [1/(m^2
sqrt(m))]"""


def choose_hyperparameters(
    problem: LaneProblem,
    start: Hyperparameters,
    offset_models: tuple[OffsetModel, ...],
    width_models: tuple[WidthModel, ...],
) -> Hyperparameters:
    """The most likely of the candidates: for the width, then for the vehicle's offset, then for the lane's bends."""
    best = start
    if width_models:
        best = _most_likely(problem, [best] * len(width_models), width_models)
    if problem.tracked and offset_models:
        bases = [replace(best, drift=0.0) if "drift" not in model else best for model in offset_models]
        best = _most_likely(problem, bases, offset_models)
    return _most_likely(problem, [best] * len(BENDS), tuple({"bend": value} for value in BENDS))


def _most_likely(
    problem: LaneProblem, bases: list[Hyperparameters], changes: tuple[JsonObject, ...]
) -> Hyperparameters:
    candidates = [replace(base, **change) for base, change in zip(bases, changes, strict=True)]
    return max(candidates, key=problem.log_likelihood)
