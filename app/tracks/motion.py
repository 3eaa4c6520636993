"""How the state of a drive moves on from node to node, and how its errors grow.

The nominal state is longitude, latitude [rad], heading [rad], speed [m/s], yaw rate [rad/s], scale error of the speed
[1], bias of the heading [rad], offset from the middle of the lane [m], and the offsets of the clocks [s]. Its error has
the same order, with metres east and north in place of longitude and latitude: positions are exact at any distance from
the start, across the antimeridian and at high latitudes.

Between nodes the vehicle keeps its speed and its yaw rate; the yaw rate goes back to nothing within seconds, and is the
larger the slower the vehicle drives, as lateral acceleration limits it; at a standstill it does not turn.

Source: Sola, Quaternion kinematics for the error-state Kalman filter (arXiv:1711.02508), sections 5 and 6, with the
heading as the only angle.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from app.compiled import ieee_kernel
from app.tracks.types import BIAS, CLOCKS, EAST, HEADING, NORTH, SCALE, SPEED, WANDER, YAW_RATE

_TURN_S = 3.0  # [s] in which a yaw rate fades; source: by hand, half a bend
_SLOW_M_S = 3.0  # [m/s] below, the steering limits the yaw rate and not the comfort; source: by hand, a radius of 6 m
_LEAST_RAD_S = 0.005  # [rad/s] source: by hand, lane keeping
_A, _E2 = 6378137.0, 0.0066943799901413165  # WGS 84; source: app/geodesy/ellipsoid.py


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
