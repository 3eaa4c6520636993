"""The error-state Kalman filter along a drive, and the Rauch-Tung-Striebel smoother behind it.

Between nodes the vehicle turns with constant yaw rate at constant speed. The model is linearised at `around`, the
trajectory of the pass before, or, where that is NaN, at the filter's own prediction (first pass).

Source: Sarkka, Bayesian Filtering and Smoothing (2013), algorithms 5.4 and 9.1.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from app.compiled import ieee_kernel
from app.tracks.types import BIAS, CLOCKS, EAST, HEADING, NORTH, SCALE, SPEED, WANDER, YAW_RATE
from app.values import Floats, Ints

# === How the state of a drive moves on from node to node, and how its errors grow.
#
# The nominal state is longitude, latitude [rad], heading [rad], speed [m/s], yaw rate [rad/s], scale error of the speed
# [1], bias of the heading [rad], offset from the middle of the lane [m], and the offsets of the clocks [s]. Its error
# has the same order, with metres east and north in place of longitude and latitude: positions are exact at any distance
# from the start, across the antimeridian and at high latitudes.
#
# Between nodes the vehicle keeps its speed and its yaw rate; the yaw rate goes back to nothing within seconds, and is
# the larger the slower the vehicle drives, as lateral acceleration limits it; at a standstill it does not turn.
#
# Source: Sola, Quaternion kinematics for the error-state Kalman filter (arXiv:1711.02508), sections 5 and 6, with the
# heading as the only angle.


_TURN_S = 3.0  # [s] in which a yaw rate fades; half a bend
_SLOW_M_S = 3.0  # [m/s] below, the steering limits the yaw rate and not the comfort; a radius of 6 m
_LEAST_RAD_S = 0.005  # [rad/s] lane keeping
_A, _E2 = 6378137.0, 0.0066943799901413165  # WGS 84; source: app/geodesy/frames.py


class Motion(NamedTuple):
    """Spectral densities of what the model does not know, and the lane keeping.

    position_m2_s, speed_m2_s3, heading_rad2_s, turning_m_s2, scale_1_s, bias_rad2_s, clock_s; wander_m and
    wander_length_m as in `TrackRules`.
    """

    position_m2_s: float
    speed_m2_s3: float
    heading_rad2_s: float
    turning_m_s2: float
    scale_1_s: float
    bias_rad2_s: float
    clock_s: float
    wander_m: float
    wander_length_m: float


@ieee_kernel
def lengths(lat):  # type: ignore[no-untyped-def]
    """East and north metres of a radian at a latitude."""
    curve = 1.0 - _E2 * math.sin(lat) ** 2
    return math.cos(lat) * _A / math.sqrt(curve), _A * (1.0 - _E2) / curve**1.5


@ieee_kernel
def wrap(angle):  # type: ignore[no-untyped-def]
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@ieee_kernel
def minus(a, b, out):  # type: ignore[no-untyped-def]
    """Error of state a from state b."""
    east, north = lengths(b[NORTH])
    for i in range(a.shape[0]):
        out[i] = a[i] - b[i]
    out[EAST] = wrap(out[EAST]) * east
    out[NORTH] *= north


@ieee_kernel
def plus(a, error, out):  # type: ignore[no-untyped-def]
    """State a with an error added."""
    east, north = lengths(a[NORTH])
    for i in range(a.shape[0]):
        out[i] = a[i] + error[i]
    out[EAST] = a[EAST] + error[EAST] / east
    out[NORTH] = min(max(a[NORTH] + error[NORTH] / north, -1.5697), 1.5697)


@ieee_kernel
def _move(state, dt, wander_length, out):  # type: ignore[no-untyped-def]
    """State after a time at constant speed and yaw rate."""
    for i in range(state.shape[0]):
        out[i] = state[i]
    turn = state[HEADING] + state[YAW_RATE] * dt / 2
    east, north = lengths(state[NORTH])
    out[EAST] += state[SPEED] * math.sin(turn) * dt / east
    out[NORTH] += state[SPEED] * math.cos(turn) * dt / north
    # on the ellipsoid a straight line turns against the meridians
    out[HEADING] += state[YAW_RATE] * dt + state[SPEED] * math.sin(turn) * dt * math.tan(state[NORTH]) / _A
    out[YAW_RATE] *= math.exp(-dt / _TURN_S)
    out[WANDER] *= math.exp(-abs(state[SPEED]) * dt / wander_length)


@ieee_kernel
def move_rows(state, dt, wander_length, matrix):  # type: ignore[no-untyped-def]
    """Multiply a matrix from the left with the derivative of `_move`, in place."""
    turn = state[HEADING] + state[YAW_RATE] * dt / 2
    along_e, along_n = math.sin(turn) * dt, math.cos(turn) * dt
    ve, vn = state[SPEED] * along_e, state[SPEED] * along_n
    phi = math.exp(-abs(state[SPEED]) * dt / wander_length)
    fade = math.exp(-dt / _TURN_S)
    for j in range(matrix.shape[1]):
        psi, speed, rate = matrix[HEADING, j], matrix[SPEED, j], matrix[YAW_RATE, j]
        matrix[EAST, j] += vn * psi + along_e * speed + vn * dt / 2 * rate
        matrix[NORTH, j] += -ve * psi + along_n * speed - ve * dt / 2 * rate
        matrix[HEADING, j] += dt * rate
        matrix[YAW_RATE, j] *= fade
        matrix[WANDER, j] *= phi


@ieee_kernel
def _add_noise(state, dt, motion, cov):  # type: ignore[no-untyped-def]
    turn = state[HEADING]
    s, c = math.sin(turn), math.cos(turn)
    q = motion.speed_m2_s3
    along = q * dt**3 / 3
    cov[EAST, EAST] += motion.position_m2_s * dt + along * s * s
    cov[NORTH, NORTH] += motion.position_m2_s * dt + along * c * c
    cov[EAST, NORTH] += along * s * c
    cov[NORTH, EAST] += along * s * c
    cross = q * dt * dt / 2
    cov[EAST, SPEED] += cross * s
    cov[SPEED, EAST] += cross * s
    cov[NORTH, SPEED] += cross * c
    cov[SPEED, NORTH] += cross * c
    cov[SPEED, SPEED] += q * dt
    speed = abs(state[SPEED])
    turning = motion.turning_m_s2 * speed / (speed * speed + _SLOW_M_S * _SLOW_M_S) + _LEAST_RAD_S
    r = 2.0 * turning * turning / _TURN_S
    cov[HEADING, HEADING] += motion.heading_rad2_s * dt + r * dt**3 / 3
    cov[HEADING, YAW_RATE] += r * dt * dt / 2
    cov[YAW_RATE, HEADING] += r * dt * dt / 2
    cov[YAW_RATE, YAW_RATE] += r * dt
    cov[SCALE, SCALE] += motion.scale_1_s * dt
    cov[BIAS, BIAS] += motion.bias_rad2_s * dt
    for k in range(CLOCKS, state.shape[0]):
        cov[k, k] += motion.clock_s * dt
    phi = math.exp(-abs(state[SPEED]) * dt / motion.wander_length_m)
    cov[WANDER, WANDER] += (1 - phi * phi) * motion.wander_m**2 + 1e-12


@ieee_kernel
def _transposed(matrix):  # type: ignore[no-untyped-def]
    n = matrix.shape[0]
    for i in range(n):
        for j in range(i):
            matrix[i, j], matrix[j, i] = matrix[j, i], matrix[i, j]


@ieee_kernel
def predict(state, cov, around, dt, motion, out, out_cov, scratch):  # type: ignore[no-untyped-def]
    """State and covariance one node on, linearised at `around`."""
    _move(around, dt, motion.wander_length_m, out)
    minus(state, around, scratch[0])
    column = scratch[0].reshape(-1, 1)
    move_rows(around, dt, motion.wander_length_m, column)
    plus(out, scratch[0], scratch[1])
    for i in range(state.shape[0]):
        out[i] = scratch[1, i]
        for j in range(state.shape[0]):
            out_cov[i, j] = cov[i, j]
    move_rows(around, dt, motion.wander_length_m, out_cov)
    _transposed(out_cov)
    move_rows(around, dt, motion.wander_length_m, out_cov)
    _add_noise(around, dt, motion, out_cov)


# === The error-state Kalman filter along a drive, and the Rauch-Tung-Striebel smoother behind it.


FIX, SPEED_SAMPLE, HEADING_SAMPLE, PATH = range(4)
"""Kinds of measurements."""
_HUBER = 4.0  # sigmas from which a sample of speed or heading counts less; wheel slip, steel bridges


class Measurements(NamedTuple):
    """Measurements in the order of their nodes, M of them."""

    node: Ints  # nearest node in time
    kind: Ints
    clock: Ints  # place of its clock's offset in the state; -1: the clock has none
    after_s: Floats  # [s] from the node's time, with `assumed_s` as the offset of the clock
    assumed_s: Floats
    # shape (M, 3): [m] FIX: longitude, latitude, heading [rad]; SPEED_SAMPLE [m/s]; HEADING_SAMPLE [rad]; PATH: left of
    # the path, at the place that `value[1:]` has (longitude, latitude of the path's point [rad])
    value: Floats
    # shape (M, 6): [rad] FIX: covariance, upper triangle by rows [m, m, rad]; else the variance, and for PATH the
    # path's heading
    noise: Floats
    # shape (M, 3): what a measurement changes by with time: FIX: velocity east and north and yaw rate, SPEED_SAMPLE:
    # acceleration [m/s2], HEADING_SAMPLE: yaw rate; of the pass before, averaged over seconds: noise of the speed must
    # not look like changes of it, by which the offset of a clock is observed. NaN in the first pass.
    rate: Floats
    used: npt.NDArray[np.bool_]


# --- measurements ---------------------------------------------------------------------------------------------------


@ieee_kernel
def _after_s(m, i, state):  # type: ignore[no-untyped-def]
    """Time from the node to a measurement, by the clock's offset in the state."""
    k = m.clock[i]
    return m.after_s[i] + (state[k] - m.assumed_s[i] if k >= 0 else 0.0)


@ieee_kernel
def fix_model(m, i, state, rows, residual):  # type: ignore[no-untyped-def]
    """Residual of a fix at a state [m, m, rad], and the derivatives of its prediction, rows (3, n)."""
    after = _after_s(m, i, state)
    turn = state[HEADING] + state[YAW_RATE] * after / 2
    s, c, v = math.sin(turn), math.cos(turn), state[SPEED]
    east, north = lengths(state[NORTH])
    residual[0] = wrap(m.value[i, 0] - state[EAST]) * east - v * after * s
    residual[1] = (m.value[i, 1] - state[NORTH]) * north - v * after * c
    has_heading = not math.isnan(m.value[i, 2])
    residual[2] = wrap(m.value[i, 2] - state[HEADING] - state[YAW_RATE] * after) if has_heading else 0.0
    rows[:] = 0.0
    rows[0, EAST], rows[1, NORTH] = 1.0, 1.0
    rows[0, HEADING], rows[1, HEADING] = v * after * c, -v * after * s
    rows[0, SPEED], rows[1, SPEED] = after * s, after * c
    if has_heading:
        rows[2, HEADING], rows[2, YAW_RATE] = 1.0, after
    k = m.clock[i]
    if k >= 0:
        is_known = not math.isnan(m.rate[i, 0])
        rows[0, k] = m.rate[i, 0] if is_known else v * s
        rows[1, k] = m.rate[i, 1] if is_known else v * c
        if has_heading:
            rows[2, k] = m.rate[i, 2] if is_known else state[YAW_RATE]


@ieee_kernel
def fix_noise(m, i, noise):  # type: ignore[no-untyped-def]
    """Covariance of a fix, (3, 3)."""
    noise[0, 0], noise[0, 1], noise[0, 2] = m.noise[i, 0], m.noise[i, 1], m.noise[i, 2]
    noise[1, 1], noise[1, 2], noise[2, 2] = m.noise[i, 3], m.noise[i, 4], m.noise[i, 5]
    noise[1, 0], noise[2, 0], noise[2, 1] = noise[0, 1], noise[0, 2], noise[1, 2]


@ieee_kernel
def _sample_model(m, i, state, row):  # type: ignore[no-untyped-def]
    """Residual of a sample of speed or heading, or of a path, and the derivatives of its prediction (n,)."""
    row[:] = 0.0
    k, after = m.clock[i], _after_s(m, i, state)
    if m.kind[i] == SPEED_SAMPLE:
        row[SPEED], row[SCALE] = 1.0 + state[SCALE], state[SPEED]
        if k >= 0:
            row[k] = m.rate[i, 0]
        return m.value[i, 0] - state[SPEED] * (1.0 + state[SCALE]) - m.rate[i, 0] * after
    if m.kind[i] == HEADING_SAMPLE:
        row[HEADING], row[BIAS], row[YAW_RATE] = 1.0, 1.0, after
        if k >= 0:
            row[k] = m.rate[i, 0]
        return wrap(m.value[i, 0] - state[HEADING] - state[BIAS] - state[YAW_RATE] * after)
    east, north = lengths(state[NORTH])
    left_e, left_n = -math.cos(m.noise[i, 1]), math.sin(m.noise[i, 1])
    row[EAST], row[NORTH], row[WANDER] = left_e, left_n, -1.0
    off_e, off_n = wrap(state[EAST] - m.value[i, 1]) * east, (state[NORTH] - m.value[i, 2]) * north
    return state[WANDER] - (off_e * left_e + off_n * left_n)


@ieee_kernel
def _use_sample(m, i, at, state, cov, scratch):  # type: ignore[no-untyped-def]
    n = state.shape[0]
    row, gain, error = scratch[0], scratch[1], scratch[2]
    residual = _sample_model(m, i, at, row)
    minus(state, at, error)
    for j in range(n):
        residual -= row[j] * error[j]
    variance = m.noise[i, 0]
    spread = 0.0
    for j in range(n):
        total = 0.0
        for k in range(n):
            total += cov[j, k] * row[k]
        gain[j] = total
        spread += row[j] * total
    size = residual * residual
    if size > _HUBER**2 * (spread + variance):
        variance = size / _HUBER**2 - spread
    spread += variance
    for j in range(n):
        error[j] = gain[j] / spread * residual
    plus(state, error, scratch[3])
    for j in range(n):
        state[j] = scratch[3, j]
        for k in range(n):
            cov[j, k] -= gain[j] * gain[k] / spread


@ieee_kernel
def _factor(matrix):  # type: ignore[no-untyped-def]
    """Cholesky factor in place, in the lower triangle."""
    n = matrix.shape[0]
    for j in range(n):
        for k in range(j):
            matrix[j, j] -= matrix[j, k] ** 2
        matrix[j, j] = math.sqrt(max(matrix[j, j], 1e-300))
        for i in range(j + 1, n):
            for k in range(j):
                matrix[i, j] -= matrix[i, k] * matrix[j, k]
            matrix[i, j] /= matrix[j, j]


@ieee_kernel
def _solve(factor, columns):  # type: ignore[no-untyped-def]
    """Solve for each column, in place, by the factor of `_factor`."""
    n = factor.shape[0]
    for j in range(columns.shape[1]):
        for a in range(n):
            for b in range(a):
                columns[a, j] -= factor[a, b] * columns[b, j]
            columns[a, j] /= factor[a, a]
        for a in range(n - 1, -1, -1):
            for b in range(a + 1, n):
                columns[a, j] -= factor[b, a] * columns[b, j]
            columns[a, j] /= factor[a, a]


@ieee_kernel
def _spread(rows, cov, crossed, spread):  # type: ignore[no-untyped-def]
    """H P (3, n) and H P H' (3, 3) of a fix."""
    n = cov.shape[0]
    for a in range(3):
        for j in range(n):
            total = 0.0
            for k in range(n):
                total += rows[a, k] * cov[k, j]
            crossed[a, j] = total
    for a in range(3):
        for b in range(3):
            total = 0.0
            for k in range(n):
                total += crossed[a, k] * rows[b, k]
            spread[a, b] = total


@ieee_kernel
def _use_fix(m, i, at, state, cov, scratch, fix):  # type: ignore[no-untyped-def]
    """Update with a fix; `fix` is working memory, (4, 3, n) with n >= 6."""
    n = state.shape[0]
    rows, crossed, gain = fix[0], fix[1], fix[2]
    noise, spread, residual = fix[3, :, :3], np.empty((3, 3)), scratch[2]
    fix_model(m, i, at, rows, residual)
    fix_noise(m, i, noise)
    minus(state, at, scratch[0])
    for a in range(3):
        for j in range(n):
            residual[a] -= rows[a, j] * scratch[0, j]
    _spread(rows, cov, crossed, spread)
    for a in range(3):
        for b in range(3):
            spread[a, b] += noise[a, b]
        for j in range(n):
            gain[a, j] = crossed[a, j]
    _factor(spread)
    _solve(spread, gain)
    for j in range(n):
        scratch[0, j] = gain[0, j] * residual[0] + gain[1, j] * residual[1] + gain[2, j] * residual[2]
    plus(state, scratch[0], scratch[1])
    for j in range(n):
        state[j] = scratch[1, j]
        for k in range(j, n):
            drop = 0.0
            for a in range(3):
                drop += (crossed[a, j] * gain[a, k] + gain[a, j] * crossed[a, k]) / 2
            cov[j, k] -= drop
            if k > j:
                cov[k, j] -= drop


# --- passes ---------------------------------------------------------------------------------------------------------


@ieee_kernel
def filter_track(step_s, start, start_cov, around, m, motion):  # type: ignore[no-untyped-def]
    """States (N, n) and covariances (N, n, n) of the nodes, each by the measurements up to it.

    Parameters
    ----------
    step_s : float
        Between nodes. [s]
    start : ndarray, shape (n,)
    start_cov : ndarray, shape (n, n)
    around : ndarray, shape (N, n)
        Where the model is linearised; NaN: at the filter's own state.
    """
    count, n = around.shape
    first_pass = math.isnan(around[0, 0])
    states, covs = np.empty((count, n)), np.empty((count, n, n))
    scratch, fix = np.empty((4, n)), np.empty((4, 3, n))
    state, cov = start.copy(), start_cov.copy()
    i, total = 0, m.node.shape[0]
    for k in range(count):
        if k > 0:
            at = states[k - 1] if first_pass else around[k - 1]
            predict(states[k - 1], covs[k - 1], at, step_s, motion, state, cov, scratch)
        while i < total and m.node[i] == k:
            if m.used[i]:
                at = state.copy() if first_pass else around[k]
                if m.kind[i] == FIX:
                    _use_fix(m, i, at, state, cov, scratch, fix)
                else:
                    _use_sample(m, i, at, state, cov, scratch)
            i += 1
        for a in range(n):
            states[k, a] = state[a]
            for b in range(n):
                covs[k, a, b] = (cov[a, b] + cov[b, a]) / 2
    return states, covs


@ieee_kernel
def smooth_track(step_s, states, covs, around, motion):  # type: ignore[no-untyped-def]
    """Turn the results of `filter_track`, in place, into those by all measurements."""
    count, n = states.shape
    first_pass = math.isnan(around[0, 0])
    scratch = np.empty((4, n))
    ahead, ahead_cov, factor = np.empty(n), np.empty((n, n)), np.empty((n, n))
    gain, error, product = np.empty((n, n)), np.empty(n), np.empty((n, n))
    for k in range(count - 2, -1, -1):
        at = states[k] if first_pass else around[k]
        predict(states[k], covs[k], at, step_s, motion, ahead, ahead_cov, scratch)
        factor[:] = ahead_cov
        _factor(factor)
        gain[:] = covs[k]
        move_rows(at, step_s, motion.wander_length_m, gain)  # F P: column j is solved for row j of the gain
        _solve(factor, gain)
        minus(states[k + 1], ahead, error)
        for j in range(n):
            total = 0.0
            for a in range(n):
                total += gain[a, j] * error[a]
            scratch[2, j] = total
        plus(states[k], scratch[2], scratch[3])
        for a in range(n):
            states[k, a] = scratch[3, a]
            for b in range(n):
                ahead_cov[a, b] = covs[k + 1, a, b] - ahead_cov[a, b]
        for a in range(n):
            for j in range(n):
                total = 0.0
                for b in range(n):
                    total += ahead_cov[a, b] * gain[b, j]
                product[a, j] = total
        for a in range(n):
            for j in range(a, n):
                total = 0.0
                for b in range(n):
                    total += gain[b, a] * product[b, j]
                covs[k, a, j] += total
                covs[k, j, a] = covs[k, a, j]


@ieee_kernel
def fix_distances(m, which, states, covs):  # type: ignore[no-untyped-def]
    """Squared Mahalanobis distance of fixes to the track by all others (K,), and residuals from it (K, 3).

    Behind them residuals from the track (K, 3) and the covariance of the track at each (K, 3, 3).

    Notes
    -----
    For a fix that was used the smoothed residual r has the covariance R - H P H', and r' (R - H P H')^-1 r is the
    squared distance that leaving it out would give; for one that was not used it is R + H P H'.
    """
    n = states.shape[1]
    squares, residuals = np.empty(which.shape[0]), np.empty((which.shape[0], 3))
    smoothed, spreads = np.empty((which.shape[0], 3)), np.empty((which.shape[0], 3, 3))
    rows, crossed = np.zeros((3, n)), np.zeros((3, n))
    own, spread, solved, residual = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 1)), np.zeros(3)
    for j in range(which.shape[0]):
        i = which[j]
        k = m.node[i]
        fix_model(m, i, states[k], rows, residual)
        fix_noise(m, i, own)
        _spread(rows, covs[k], crossed, spread)
        smoothed[j], spreads[j] = residual, spread
        for a in range(3):
            for b in range(3):
                spread[a, b] = own[a, b] - spread[a, b] if m.used[i] else own[a, b] + spread[a, b]
            # a fix that alone determines the track has no spread left: its distance is that of nothing
            spread[a, a] = max(spread[a, a], 1e-6 * own[a, a])
            solved[a, 0] = residual[a]
        _factor(spread)
        _solve(spread, solved)
        squares[j] = 0.0
        for a in range(3):
            squares[j] += residual[a] * solved[a, 0]
            residuals[j, a] = residual[a]
        if m.used[i]:  # residual from the track by the others
            for a in range(3):
                residuals[j, a] = own[a, 0] * solved[0, 0] + own[a, 1] * solved[1, 0] + own[a, 2] * solved[2, 0]
    return squares, residuals, smoothed, spreads
