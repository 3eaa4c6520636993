"""Least-squares fit of dipoles to the blocks of a trace, neighbours whose fields overlap fitted together.

Levenberg-Marquardt on whitened samples with Huber's weights and a Gaussian prior (Madsen, Nielsen and Tingleff, Methods
for Non-Linear Least Squares Problems, 2004). One function for each step; arrays that the steps share are in `_Work`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from app.compiled import ieee_kernel, ieee_routine, kernel, routine
from app.decoders.magnet.matched_filter import BIN_M
from app.markers.magnet import FIELD_UT_M3
from app.values import Floats, Floats32, Ints

# === The field of dipoles in the samples of a bar, whitened, and the background that is projected out of data and
# model.
#
# The background of a channel is its unknown offset, slope and curvature over the stretch. The common mode, what all
# sensors of the array read alike, is the earth's field as the car pitches; the share of it that is noise is tracked
# while the trace is resampled.
#
# Shapes: S array sensors, K blocks, Q background functions, axes x, y, z of the vehicle.


PARAMETERS = 6
"""Parameters of a dipole: s, y, h [m] and the moment's x, y, z [A m2]. Source: definition of a point dipole."""

MIN_BLOCK_M, MAX_BLOCK_M = 0.001, 1.0
"""Lengths of a block that its noise counts for. [m] Source: gaps are longer; a vehicle that stands still."""


class FitData(NamedTuple):
    """Whitened samples of a stretch of road."""

    s_m: Floats  # shape (K,): [m] odometer of the blocks
    # shape (S, 3, K): field times weight, background and common mode removed. [noise standard deviations]
    field: Floats
    weight: Floats  # shape (S, 3, K): [1/uT] 1 / noise, 0 where a sample is missing
    delay_m: Floats  # shape (3, K): [m] distance driven between a block's time and the time at which each axis is read
    positions_m: Floats  # shape (S, 3): [m] sensors: x and z relative to the bar's middle, y from the vehicle's middle
    basis: Floats  # shape (Q, K): Orthonormal background functions
    common_share: Floats  # shape (3,): share of the common mode that is taken out of each axis


class Samples(NamedTuple):
    """Blocks about a region of road, N of them, and their noise."""

    s_m: Floats  # shape (N,): [m] odometer
    field_ut: Floats  # shape (S, 3, N) [uT]
    good: Floats  # shape (S, N): share of good samples
    quiet: Floats  # shape (S, 3): 1 over the noise of each channel in that of its axis
    common_share: Floats  # shape (3,): share of the common mode that is taken out of each axis


@kernel
def whiten(
    samples: Samples, low: int, high: int, noise_ut: Floats, known: Floats32, degree: int
) -> tuple[Floats, Floats, Floats]:
    """Field and weight (S, 3, K) and basis of a `FitData`, of the blocks low to high less a known field (K, S, 3).

    The noise (3,) is that of bins of road; blocks are shorter.
    """
    sensors, blocks = samples.field_ut.shape[0], high - low
    s = samples.s_m[low:high]
    scale = np.empty(blocks)
    for k in range(blocks):
        before, after = max(k - 1, 0), min(k + 1, blocks - 1)
        length = (s[after] - s[before]) / (after - before)
        scale[k] = math.sqrt(min(max(length, MIN_BLOCK_M), MAX_BLOCK_M) / BIN_M)
    field, weight = np.empty((sensors, 3, blocks)), np.empty((sensors, 3, blocks))
    for j in range(sensors):
        for axis in range(3):
            share = samples.quiet[j, axis] / noise_ut[axis]
            for k in range(blocks):
                w = scale[k] * share * samples.good[j, low + k]
                weight[j, axis, k] = w
                field[j, axis, k] = w * (samples.field_ut[j, axis, low + k] + known[k, j, axis])
    basis = background_basis(s, scale, degree)
    remove_background(field, basis, samples.common_share)
    return field, weight, basis


@routine
def background_basis(s_m: Floats, scale: Floats, degree: int) -> Floats:
    """Orthonormal scale, scale s, scale s2 .. up to the degree (Gram-Schmidt), shape (degree + 1, K)."""
    mid = (s_m[0] + s_m[-1]) / 2
    half = max((s_m[-1] - s_m[0]) / 2, 1e-6)
    basis = np.empty((degree + 1, s_m.size))
    for q in range(degree + 1):
        for k in range(s_m.size):
            basis[q, k] = scale[k] * ((s_m[k] - mid) / half) ** q
        for other in range(q):
            _project_out(basis[q], basis[other])
        norm = 0.0
        for k in range(s_m.size):
            norm += basis[q, k] ** 2
        norm = 1 / math.sqrt(max(norm, 1e-30))
        for k in range(s_m.size):
            basis[q, k] *= norm
    return basis


@routine
def _project_out(row: Floats, unit: Floats) -> None:
    """Take a unit vector's share out of a row, in place."""
    dot = 0.0
    for k in range(row.size):
        dot += unit[k] * row[k]
    for k in range(row.size):
        row[k] -= dot * unit[k]


@routine
def remove_background(field: Floats, basis: Floats, common_share: Floats) -> None:
    """Take the share of the common mode, then the background, out of a field (S, 3, K), in place."""
    sensors, blocks = field.shape[0], field.shape[2]
    mean = np.empty(blocks)
    for axis in range(3):
        if common_share[axis] > 0:
            share = common_share[axis] / sensors
            mean[:] = 0.0
            for j in range(sensors):
                for k in range(blocks):
                    mean[k] += field[j, axis, k]
            for j in range(sensors):
                for k in range(blocks):
                    field[j, axis, k] -= share * mean[k]
        for j in range(sensors):
            for q in range(basis.shape[0]):
                _project_out(field[j, axis], basis[q])


@routine
def dipole_field(dipole: Floats, data: FitData, out: Floats) -> None:
    """Whitened field of a dipole (6,) into out (S, 3, K).

    The component along the unit vector e at the place r from the dipole with moment m (Jackson, Classical
    Electrodynamics, equation 5.56)::

        B_e = mu0 / (4 pi) (3 (e r) (m r) - (e m) r2) / |r|^5
    """
    for j in range(out.shape[0]):
        ahead = data.positions_m[j, 0] - dipole[0]
        y, z = data.positions_m[j, 1] - dipole[1], data.positions_m[j, 2] + dipole[2]
        for axis in range(3):
            # 1 for the axis, 0 for the others: no branches in the loop
            ex, ey, ez = 1.0 * (axis == 0), 1.0 * (axis == 1), 1.0 * (axis == 2)
            em = ex * dipole[3] + ey * dipole[4] + ez * dipole[5]
            weight, delay, field = data.weight[j, axis], data.delay_m[axis], out[j, axis]
            for k in range(field.size):
                x = data.s_m[k] + delay[k] + ahead
                r2 = x * x + y * y + z * z
                f = FIELD_UT_M3 * weight[k] / (r2 * r2 * math.sqrt(r2))
                mr = dipole[3] * x + dipole[4] * y + dipole[5] * z
                field[k] = f * (3 * (ex * x + ey * y + ez * z) * mr - em * r2)


@routine
def dipole_derivatives(dipole: Floats, data: FitData, out: Floats) -> None:
    """Derivatives of `dipole_field` by the six parameters into out (6, S, 3, K)."""
    for j in range(out.shape[1]):
        ahead = data.positions_m[j, 0] - dipole[0]
        y, z = data.positions_m[j, 1] - dipole[1], data.positions_m[j, 2] + dipole[2]
        mx, my, mz = dipole[3], dipole[4], dipole[5]
        for axis in range(3):
            ex, ey, ez = 1.0 * (axis == 0), 1.0 * (axis == 1), 1.0 * (axis == 2)
            em = ex * mx + ey * my + ez * mz
            weight, delay = data.weight[j, axis], data.delay_m[axis]
            by_s, by_y, by_h = out[0, j, axis], out[1, j, axis], out[2, j, axis]
            by_mx, by_my, by_mz = out[3, j, axis], out[4, j, axis], out[5, j, axis]
            for k in range(by_s.size):
                x = data.s_m[k] + delay[k] + ahead
                r2 = x * x + y * y + z * z
                f = FIELD_UT_M3 * weight[k] / (r2 * r2 * math.sqrt(r2))
                mr, er = mx * x + my * y + mz * z, ex * x + ey * y + ez * z
                c = 15 * er * mr / r2 - 3 * em
                by_s[k] = -f * (3 * (er * mx + mr * ex) - c * x)
                by_y[k] = -f * (3 * (er * my + mr * ey) - c * y)
                by_h[k] = f * (3 * (er * mz + mr * ez) - c * z)
                by_mx[k] = f * (3 * er * x - r2 * ex)
                by_my[k] = f * (3 * er * y - r2 * ey)
                by_mz[k] = f * (3 * er * z - r2 * ez)


@kernel
def add_dipole_field(
    dipole: Floats, s_m: Floats, positions_m: Floats, sign: float, common_share: Floats, out: Floats32
) -> None:
    """Add sign times the field of a dipole (6,), less its common mode, to samples out (N, S, 3) at s_m (N,). [uT]"""
    sensors = positions_m.shape[0]
    mean, field = np.empty(3), np.empty((sensors, 3))
    for k in range(s_m.size):
        mean[:] = 0.0
        for j in range(sensors):
            x = s_m[k] + positions_m[j, 0] - dipole[0]
            y, z = positions_m[j, 1] - dipole[1], positions_m[j, 2] + dipole[2]
            r2 = x * x + y * y + z * z
            f = sign * FIELD_UT_M3 / (r2 * math.sqrt(r2))
            along = 3 * (x * dipole[3] + y * dipole[4] + z * dipole[5]) / r2
            field[j, 0] = f * (along * x - dipole[3])
            field[j, 1] = f * (along * y - dipole[4])
            field[j, 2] = f * (along * z - dipole[5])
            for axis in range(3):
                mean[axis] += field[j, axis]
        for j in range(sensors):
            for axis in range(3):
                out[k, j, axis] += field[j, axis] - common_share[axis] * mean[axis] / sensors


# === Least-squares fit of dipoles to the blocks of a trace, neighbours whose fields overlap fitted together.


UPRIGHT, FORWARD = 2, 0
"""Kind of a magnet: the axis of the vehicle along which its moment points."""
MODEL_ERROR = 0.05
"""Share of the field by which the model errs: gain (2 %), misalignment (1.5 degrees) and axes that are read one after
the other. Source: data sheet of the MLX90393."""
HUBER = 3.0
"""Residual from which on Huber's loss is linear. [noise standard deviations]"""
MAX_ITERATIONS = 9
"""Steps of a fit. For speed (`python -m benchmarks.magnets speed`)."""
FIRST_DAMPING, MIN_DAMPING, LESS_DAMPING, MORE_DAMPING = 1e-3, 1e-4, 0.2, 8.0
"""Damping at first, at least after a refused step, and its factors after an accepted and a refused step. Source:
Levenberg-Marquardt as usual (Marquardt 1963 has factors of 10)."""
MAX_TRIALS = 6
"""Damped steps that are tried before a fit ends."""
RIDGE = 1e-9
"""Added to the diagonal of the normal equations against singular ones. Far below any prior."""
MAX_STEP_M = 0.08
"""Most by which a place changes in a step, half of METRO's sensor spacing. [m] Source: METRO section 5.1."""
MIN_HEIGHT_M, MAX_HEIGHT_M = 0.04, 0.9
"""Clearances between which a fit stays. [m] Around 0.15 to 0.35 m, METRO section 7.3."""
MIN_GAIN_SHARE, MIN_GAIN = 1e-3, 0.01
"""A step that lowers the cost by less ends the fit: a share of the cost, and chi-squared."""
FREE_MOMENT_PRECISION = 1e-3
"""1 / variance of a moment along its own axis when moments are first solved for: nearly flat. [1/(A m2)2]"""
MIN_FIRST_MOMENT, MAX_FIRST_MOMENT = 0.5, 2.0
"""Limits of the first solution, in expected moments."""
LOCAL_HEIGHTS, LOCAL_M = 1.2, 0.1
"""Reach about a magnet in which its misfit is counted: heights, and metres more."""


class MagnetPrior(NamedTuple):
    """What magnets are expected to be like."""

    # `moment_am2`, `moment_std_am2`: [A m2] moment and its standard deviation
    moment_am2: float
    moment_std_am2: float
    # `clearance_m`, `clearance_std_m`: [m] of the bar above the magnet
    clearance_m: float
    clearance_std_m: float
    # `tilt_std_am2`, `yaw_std_am2`: [A m2] standard deviation of the moment's components across the magnet's axis, and
    # of a forward one's y
    tilt_std_am2: float
    yaw_std_am2: float


class FittedDipoles(NamedTuple):
    """Result of `fit_dipoles` for n dipoles."""

    dipoles: Floats  # shape (n, 6): [A m2] s, y, h [m], moment
    covariance: Floats  # shape (n, 6, 6)
    explained: Floats  # shape (n,): energy that the residual gains without the dipole. [noise variances]
    # `local_energy`, `local_rows`: shape (n,): weighted residual energy near the dipole and the number of samples there
    local_energy: Floats
    local_rows: Floats
    prior_cost: Floats  # shape (n,)


# --- priors ---------------------------------------------------------------------------------------------------------


@ieee_routine
def _axis_std(kind: int, axis: int, prior: MagnetPrior) -> float:
    """Standard deviation of a moment's component across the magnet's own axis. [A m2]"""
    return prior.yaw_std_am2 if kind == 0 and axis == 1 else prior.tilt_std_am2


@ieee_kernel
def prior_cost(dipole: Floats, kind: int, prior: MagnetPrior) -> float:
    """-2 log likelihood of a dipole's moment, clearance and axis under the prior, but for a constant."""
    moment = math.sqrt(dipole[3] ** 2 + dipole[4] ** 2 + dipole[5] ** 2) + 1e-12
    cost = ((moment - prior.moment_am2) / prior.moment_std_am2) ** 2
    cost += ((dipole[2] - prior.clearance_m) / prior.clearance_std_m) ** 2
    for axis in range(3):
        if axis != kind:
            cost += (dipole[3 + axis] / _axis_std(kind, axis, prior)) ** 2
    return float(cost)


@ieee_routine
def _add_prior_slope(
    dipole: Floats, kind: int, prior: MagnetPrior, gradient: Floats, hessian: Floats, first: int
) -> None:
    """Add the descent and the curvature (Gauss-Newton) of half of `prior_cost` from the place `first` on."""
    moment = math.sqrt(dipole[3] ** 2 + dipole[4] ** 2 + dipole[5] ** 2) + 1e-12
    off = (moment - prior.moment_am2) / prior.moment_std_am2
    for q in range(3):
        a = first + 3 + q
        gradient[a] -= dipole[3 + q] / moment * off / prior.moment_std_am2
        for r in range(3):
            hessian[a, first + 3 + r] += dipole[3 + q] * dipole[3 + r] / (moment * prior.moment_std_am2) ** 2
        if q != kind:
            std = _axis_std(kind, q, prior)
            gradient[a] -= dipole[3 + q] / std**2
            hessian[a, a] += 1 / std**2
    gradient[first + 2] -= (dipole[2] - prior.clearance_m) / prior.clearance_std_m**2
    hessian[first + 2, first + 2] += 1 / prior.clearance_std_m**2


# --- one step of the fit --------------------------------------------------------------------------------------------


class _Work(NamedTuple):
    """Arrays that the steps of a fit of n dipoles share; R = 3 S K rows."""

    derivatives: Floats  # (6, S, 3, K) of one dipole
    jacobian: Floats  # (6 n, R)
    field: Floats  # (S, 3, K) of one dipole
    total: Floats  # (S, 3, K) of all dipoles
    strength: Floats  # (S, K) squared whitened field of all dipoles, summed over the axes
    residual: Floats  # (S, 3, K)
    row_weight: Floats  # (S, 3, K)
    gradient: Floats  # (6 n,)
    hessian: Floats  # (6 n, 6 n)
    step: Floats  # (6 n,)
    trial: Floats  # (n, 6)


@ieee_routine
def _make_work(shape: tuple[int, int, int], n: int) -> _Work:
    sensors, _, blocks = shape
    size = PARAMETERS * n
    return _Work(
        np.empty((PARAMETERS, sensors, 3, blocks)),
        np.empty((size, sensors * 3 * blocks)),
        np.empty(shape),
        np.empty(shape),
        np.empty((sensors, blocks)),
        np.empty(shape),
        np.ones(shape),
        np.empty(size),
        np.empty((size, size)),
        np.empty(size),
        np.empty((n, PARAMETERS)),
    )


@routine
def _set_residual(dipoles: Floats, data: FitData, work: _Work) -> None:
    """What the dipoles (n, 6) leave of the data, and the strength of their field."""
    work.total[:] = 0.0
    work.strength[:] = 0.0
    for i in range(dipoles.shape[0]):
        dipole_field(dipoles[i], data, work.field)
        for j in range(work.total.shape[0]):
            for axis in range(3):
                for k in range(work.total.shape[2]):
                    value = work.field[j, axis, k]
                    work.total[j, axis, k] += value
                    work.strength[j, k] += value * value
    remove_background(work.total, data.basis, data.common_share)
    for j in range(work.total.shape[0]):
        for axis in range(3):
            for k in range(work.total.shape[2]):
                work.residual[j, axis, k] = data.field[j, axis, k] - work.total[j, axis, k]


@routine
def _set_jacobian(dipoles: Floats, data: FitData, work: _Work) -> None:
    """Derivatives of the model by all parameters, background removed as in the data."""
    rows = work.jacobian.shape[1]
    for i in range(dipoles.shape[0]):
        dipole_derivatives(dipoles[i], data, work.derivatives)
        for q in range(PARAMETERS):
            remove_background(work.derivatives[q], data.basis, data.common_share)
            source, target = work.derivatives[q].reshape(rows), work.jacobian[PARAMETERS * i + q]
            for r in range(rows):
                target[r] = source[r]


@routine
def _set_row_weights(data: FitData, work: _Work) -> None:
    """1 for noise alone; less where the field is strong, as the model errs, or a sample is far off (Huber)."""
    for j in range(work.residual.shape[0]):
        for k in range(work.residual.shape[2]):
            g = 1 / (1 + MODEL_ERROR * MODEL_ERROR * work.strength[j, k])
            for axis in range(3):
                r = abs(work.residual[j, axis, k]) * math.sqrt(g)
                weight = g * min(1.0, HUBER / r) if r > HUBER else g
                work.row_weight[j, axis, k] = weight if data.weight[j, axis, k] != 0 else 0.0


@routine
def _weighted_squares(work: _Work) -> float:
    """Cost of the residual under the row weights as they are."""
    cost = 0.0
    for j in range(work.residual.shape[0]):
        for axis in range(3):
            for k in range(work.residual.shape[2]):
                cost += work.row_weight[j, axis, k] * work.residual[j, axis, k] ** 2
    return cost


@routine
def _set_normal_equations(work: _Work) -> None:
    """Gradient J W r and Hessian J W J'. Written out: a library's sums depend on its number of threads."""
    rows = work.jacobian.shape[1]
    weight, residual = work.row_weight.reshape(rows), work.residual.reshape(rows)
    weighted = np.empty(rows)
    for a in range(work.jacobian.shape[0]):
        ja, g = work.jacobian[a], 0.0
        for r in range(rows):
            weighted[r] = ja[r] * weight[r]
            g += weighted[r] * residual[r]
        work.gradient[a] = g
        for b in range(a, work.jacobian.shape[0]):
            jb, h = work.jacobian[b], 0.0
            for r in range(rows):
                h += weighted[r] * jb[r]
            work.hessian[a, b] = work.hessian[b, a] = h


@routine
def _solve(matrix: Floats, damping: float, rhs: Floats, out: Floats) -> None:
    """Solve (matrix + damping diag(matrix) + 1e-9) out = rhs for a positive definite matrix, by Cholesky factors."""
    n = rhs.size
    factor = np.empty((n, n))
    for i in range(n):
        for j in range(i + 1):
            value = matrix[i, j] + (damping * matrix[i, i] + RIDGE if i == j else 0.0)
            for k in range(j):
                value -= factor[i, k] * factor[j, k]
            factor[i, j] = math.sqrt(value) if i == j else value / factor[j, j]
    for i in range(n):
        value = rhs[i]
        for k in range(i):
            value -= factor[i, k] * out[k]
        out[i] = value / factor[i, i]
    for i in range(n - 1, -1, -1):
        value = out[i]
        for k in range(i + 1, n):
            value -= factor[k, i] * out[k]
        out[i] = value / factor[i, i]


@routine
def _linearize(dipoles: Floats, kinds: Ints, prior: MagnetPrior, data: FitData, work: _Work) -> float:
    """Normal equations at the dipoles with the prior; returns the cost there."""
    _set_residual(dipoles, data, work)
    _set_row_weights(data, work)
    _set_jacobian(dipoles, data, work)
    _set_normal_equations(work)
    cost = _weighted_squares(work)
    for i in range(dipoles.shape[0]):
        cost += prior_cost(dipoles[i], kinds[i], prior)
        _add_prior_slope(dipoles[i], kinds[i], prior, work.gradient, work.hessian, PARAMETERS * i)
    return cost


@routine
def _solve_moments(dipoles: Floats, kinds: Ints, prior: MagnetPrior, data: FitData, work: _Work) -> None:
    """Moments by linear least squares, the places as they are; in place."""
    _set_residual(dipoles, data, work)
    _set_jacobian(dipoles, data, work)
    _set_normal_equations(work)
    gradient, hessian = work.gradient, work.hessian
    for i in range(dipoles.shape[0]):
        for q in range(3):
            place, a = PARAMETERS * i + q, PARAMETERS * i + 3 + q
            for b in range(gradient.size):
                hessian[place, b] = hessian[b, place] = 0.0
            hessian[place, place], gradient[place] = 1.0, 0.0
            precision = FREE_MOMENT_PRECISION if q == kinds[i] else 1 / prior.tilt_std_am2**2
            hessian[a, a] += precision
            if q != kinds[i]:
                gradient[a] -= dipoles[i, 3 + q] * precision
    _solve(hessian, 0.0, gradient, work.step)
    low, high = MIN_FIRST_MOMENT * prior.moment_am2, MAX_FIRST_MOMENT * prior.moment_am2
    for i in range(dipoles.shape[0]):
        for q in range(3, PARAMETERS):
            dipoles[i, q] += work.step[PARAMETERS * i + q]
        moment = math.sqrt(dipoles[i, 3] ** 2 + dipoles[i, 4] ** 2 + dipoles[i, 5] ** 2)
        for q in range(3, PARAMETERS):
            dipoles[i, q] *= min(max(moment, low), high) / max(moment, 1e-9)


@routine
def _take_step(
    dipoles: Floats, kinds: Ints, prior: MagnetPrior, data: FitData, work: _Work, cost: float, damping: float
) -> tuple[float, float]:
    """Move the dipoles by the first damped step that lowers the cost; returns the next damping and the gain."""
    n = dipoles.shape[0]
    for _ in range(MAX_TRIALS):
        _solve(work.hessian, damping, work.gradient, work.step)
        for i in range(n):
            for q in range(PARAMETERS):
                step = work.step[PARAMETERS * i + q]
                if q < 3:
                    step = min(max(step, -MAX_STEP_M), MAX_STEP_M)
                work.trial[i, q] = dipoles[i, q] + step
            work.trial[i, 2] = min(max(work.trial[i, 2], MIN_HEIGHT_M), MAX_HEIGHT_M)
        _set_residual(work.trial, data, work)
        trial_cost = _weighted_squares(work)
        for i in range(n):
            trial_cost += prior_cost(work.trial[i], kinds[i], prior)
        if trial_cost < cost:
            for i in range(n):
                for q in range(PARAMETERS):
                    dipoles[i, q] = work.trial[i, q]
            return damping * LESS_DAMPING, cost - trial_cost
        damping = max(damping * MORE_DAMPING, MIN_DAMPING)
    return damping, 0.0


# --- the fit and its figures --------------------------------------------------------------------------------------


@ieee_kernel
def fit_dipoles(data: FitData, start: Floats, kinds: Ints, prior: MagnetPrior) -> FittedDipoles:
    """Fit n dipoles together.

    Parameters
    ----------
    start : ndarray, shape (n, 6)
        If the last one has no moment, moments are first solved for with the places as they are.
    kinds : ndarray of int, shape (n,)
        `UPRIGHT` or `FORWARD`.
    """
    n = start.shape[0]
    dipoles = start.copy()
    work = _make_work(data.field.shape, n)
    iterations = MAX_ITERATIONS
    if dipoles[n - 1, 3] == 0 and dipoles[n - 1, 5] == 0:
        _solve_moments(dipoles, kinds, prior, data, work)
        iterations -= 1
    damping = FIRST_DAMPING
    for _ in range(iterations):
        cost = _linearize(dipoles, kinds, prior, data, work)
        damping, gain = _take_step(dipoles, kinds, prior, data, work, cost, damping)
        if gain < MIN_GAIN_SHARE * cost + MIN_GAIN:
            break
    _set_residual(dipoles, data, work)
    _set_row_weights(data, work)
    result = FittedDipoles(
        dipoles, np.zeros((n, PARAMETERS, PARAMETERS)), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    )
    for i in range(n):
        _set_covariance(i, work, result.covariance[i])
        _set_residual_figures(i, data, work, result)
        result.prior_cost[i] = prior_cost(dipoles[i], kinds[i], prior)
    return result


@routine
def _set_covariance(i: int, work: _Work, covariance: Floats) -> None:
    """Diagonal block of a dipole in the inverse Hessian of the last step."""
    unit = np.zeros(work.gradient.size)
    for q in range(PARAMETERS):
        unit[PARAMETERS * i + q] = 1.0
        _solve(work.hessian, 0.0, unit, work.step)
        unit[PARAMETERS * i + q] = 0.0
        for r in range(PARAMETERS):
            covariance[r, q] = work.step[PARAMETERS * i + r]


@routine
def _set_residual_figures(i: int, data: FitData, work: _Work, result: FittedDipoles) -> None:
    """Energy that dipole i explains, and the residual about it."""
    dipole = result.dipoles[i]
    dipole_field(dipole, data, work.field)
    remove_background(work.field, data.basis, data.common_share)
    reach = LOCAL_HEIGHTS * dipole[2] + LOCAL_M
    for j in range(work.field.shape[0]):
        near = abs(data.positions_m[j, 1] - dipole[1]) <= reach
        for axis in range(3):
            for k in range(work.field.shape[2]):
                g, left = work.row_weight[j, axis, k], work.residual[j, axis, k]
                result.explained[i] += g * ((left + work.field[j, axis, k]) ** 2 - left**2)
                if near and abs(data.s_m[k] - dipole[0]) < reach and data.weight[j, axis, k] > 0:
                    result.local_energy[i] += g * left**2
                    result.local_rows[i] += 1


@kernel
def residual_cost(data: FitData, dipoles: Floats) -> float:
    """-2 log likelihood of what dipoles (n, 6) leave of the data, by Huber's loss, but for a constant."""
    work = _make_work(data.field.shape, 0)
    _set_residual(dipoles, data, work)
    cost = 0.0
    for j in range(work.residual.shape[0]):
        for k in range(work.residual.shape[2]):
            variance = 1 + MODEL_ERROR * MODEL_ERROR * work.strength[j, k]
            for axis in range(3):
                if data.weight[j, axis, k] > 0:
                    r = abs(work.residual[j, axis, k]) / math.sqrt(variance)
                    cost += (r * r if r < HUBER else 2 * HUBER * r - HUBER * HUBER) + math.log(variance)
    return cost
