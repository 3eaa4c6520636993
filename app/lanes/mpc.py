"""Model predictive steering: the wheel angles of the next second that follow a path best, within the wheels' limits.

At each step, a small quadratic program (QP) is solved for a sequence of steering commands, of which the first is sent.
Its model is the kinematic bicycle, linearised about the drive whose front axle runs exactly on the path, and steered
through a lag with limits of angle and rate. `daqp` solves the program.

Sources: Falcone et al., "Predictive Active Steering Control for Autonomous Vehicle Systems", IEEE TCST 15(3), 2007 (the
linearised programs); Arnstrom, Bemporad and Axehill, "A Dual Active-Set Solver for Embedded Quadratic Programming Using
Recursive LDL^T Updates", IEEE TAC 67(8), 2022 (`daqp`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from app.compiled import ieee_kernel
from app.lanes.control import FollowedPath, SteeringSettings, nearest_on_path, predict_pose, stanley_rad
from app.values import Floats

STEPS = 20  # of the horizon
INTEGRATED_M = 0.15  # [m] only smaller errors change the estimate of the misalignment
_MAX_MISALIGNMENT_RAD = 0.05  # [rad] 2.9 degrees
_INTEGRAL_TO_M_S = 10.0  # [m/s] above, the integral's lateral acceleration stays the same: it is as v^2 x angle
_SLOWEST_M_S = 2.0  # [m/s] slower is planned as at this speed, at which the model can still be steered
_LONGEST_WHEEL_SINE = 0.9  # of the reference's first wheel angle
_SOLVED = 1  # daqp's exit flag of an optimal solution


class Reference(NamedTuple):
    """The drive whose front axle runs exactly on the path, on the path's grid of N points."""

    points: Floats  # shape (N, 2): [m] east, north
    headings: Floats  # shape (N,): [rad] of the path
    yaw: Floats  # shape (N,): [rad] of the vehicle
    wheel: Floats  # shape (N,): [rad] of the front wheels, left positive
    step_m: float


class Model(NamedTuple):
    """Vehicle, horizon and weights of the program."""

    wheelbase_m: float
    lag_s: float
    max_steer_rad: float
    max_rate_rad_s: float
    step_s: float  # [s] of the horizon
    velocity_s: float  # [s] weight of lateral velocity beside cross-track error
    jerk_s3: float  # [s3] weight of lateral jerk beside cross-track error


class MpcSteering:
    """Model predictive controller of one drive along a path; it estimates the wheels' misalignment on the way.

    Parameters
    ----------
    path : FollowedPath
    settings : SteeringSettings
        The vehicle as the controller assumes it, the horizon, and the weights.
    """

    def __init__(self, path: FollowedPath, settings: SteeringSettings) -> None:
        import daqp  # only drives with this controller need it

        self._solve = daqp.solve
        self._settings = settings
        self._reference = reference_drive(path, settings.wheelbase_m)
        self._model = Model(
            settings.wheelbase_m,
            settings.lag_s,
            math.radians(settings.max_steer_deg),
            math.radians(settings.max_steer_rate_deg_s),
            settings.horizon_s / STEPS,
            settings.velocity_weight_s,
            settings.jerk_weight_s3,
        )
        self._near: int | None = None  # the piece of the path that was nearest; the whole path is searched at first
        self._misalignment_rad = 0.0  # of the wheels, left positive: estimated by an integral of the error
        self.unsolved_steps = 0  # steps in which the program had no solution, steered by equation 4

    def steer(
        self, x: float, y: float, yaw: float, speed: float, wheel: float, pending: Floats, step_s: float
    ) -> tuple[float, float]:
        """Steering command at a pose.

        Parameters
        ----------
        x, y, yaw, speed, wheel : float
            Rear axle, heading, speed, and angle of the front wheels now. [m, m, rad, m/s, rad]
        pending : ndarray, shape (P,)
            Commands that the actuator has not received, oldest first. [rad]
        step_s : float
            Time between commands. [s]

        Returns
        -------
        command : float
            Left positive. [rad]
        left : float
            Cross-track error of the front axle when the command takes effect. [m]
        """
        if self._near is None:
            away_m = np.hypot(*(self._reference.points - (x, y)).T)
            self._near = min(int(away_m.argmin()), len(away_m) - 2)
        misalignment = self._misalignment_rad
        *program, left, command, self._near = _write_program(
            self._reference, self._model, x, y, yaw, speed, wheel + misalignment, pending + misalignment, step_s,
            self._settings.gain_per_s, self._near,
        )  # fmt: skip
        hessian, gradient, rows, low, high = program
        commands, _cost, flag, _info = self._solve(hessian, gradient, rows, high, low)
        if flag == _SOLVED and math.isfinite(commands[0]):
            command = float(commands[0])
        else:  # the command stays that of equation 4
            self.unsolved_steps += 1
        if abs(left) < INTEGRATED_M:
            gain = self._settings.integral_per_m_s * min(1.0, (_INTEGRAL_TO_M_S / max(speed, _SLOWEST_M_S)) ** 2)
            misalignment += gain * left * step_s
            self._misalignment_rad = min(max(misalignment, -_MAX_MISALIGNMENT_RAD), _MAX_MISALIGNMENT_RAD)
        return command - self._misalignment_rad, left


def reference_drive(path: FollowedPath, wheelbase_m: float) -> Reference:
    """The drive whose front axle runs exactly on the path.

    Notes
    -----
    The front axle moves along the wheels: wheel = path heading - yaw, and d yaw / ds = sin(wheel) / wheelbase. At the
    start, it is on a steady bend of the path's first curvature.
    """
    sine = wheelbase_m * float(path.curvature_per_m[0])
    first = math.asin(min(max(sine, -_LONGEST_WHEEL_SINE), _LONGEST_WHEEL_SINE))
    yaw = _reference_yaw(path.heading_rad, path.step_m, wheelbase_m, path.heading_rad[0] - first)
    return Reference(path.position_enu_m, path.heading_rad, yaw, path.heading_rad - yaw, path.step_m)


@ieee_kernel
def _reference_yaw(headings: Floats, step: float, wheelbase: float, first: float) -> Floats:
    """Heading of the reference drive by the midpoint rule. [rad]"""
    yaw = np.empty_like(headings)
    yaw[0] = first
    for k in range(headings.shape[0] - 1):
        half = yaw[k] + step / 2 * math.sin(headings[k] - yaw[k]) / wheelbase
        yaw[k + 1] = yaw[k] + step * math.sin((headings[k] + headings[k + 1]) / 2 - half) / wheelbase
    return yaw


@ieee_kernel
def _write_program(
    reference: Reference,
    model: Model,
    x: float,
    y: float,
    yaw: float,
    speed: float,
    wheel: float,
    pending: Floats,
    step_s: float,
    gain: float,
    near: int,
) -> tuple[Floats, Floats, Floats, Floats, Floats, float, float, int]:
    """The program at the pose where the next command takes effect.

    Also returns the cross-track error there [m], the command of equation 4 [rad], and the nearest piece of the path.
    """
    x, y, yaw, wheel = predict_pose(x, y, yaw, wheel, speed, model.wheelbase_m, model.lag_s, pending, 0, step_s)
    x, y = x + model.wheelbase_m * math.cos(yaw), y + model.wheelbase_m * math.sin(yaw)
    fallback, left, near, _ = stanley_rad(reference.points, reference.headings, x, y, yaw, speed, gain, 0.0, near, near)
    _, share, _ = nearest_on_path(reference.points, x, y, near)
    at = near + min(max(share, 0.0), 1.0)
    speed = max(speed, _SLOWEST_M_S)
    front_speed = speed / math.cos(_between(reference.wheel, at))
    turned = (yaw - _between(reference.yaw, at) + math.pi) % (2 * math.pi) - math.pi
    wheel = min(max(wheel, -model.max_steer_rad), model.max_steer_rad)
    ahead = front_speed * model.step_s / reference.step_m  # pieces of the path per step

    # responses to an impulse of the command and to none: errors, course errors and wheel angles after each step
    impulse, free = np.zeros((3, STEPS)), np.zeros((3, STEPS))
    before_impulse, before_free = np.zeros(STEPS), np.zeros(STEPS)  # wheel angles before each step
    left_i, turned_i, wheel_i, left_f, turned_f, wheel_f = 0.0, 0.0, 0.0, left, turned, wheel
    for k in range(STEPS):
        before_impulse[k], before_free[k] = wheel_i, wheel_f
        left_i, turned_i, wheel_i = _model_step(
            left_i, turned_i, wheel_i, 1.0 if k == 0 else 0.0, 0.0, speed, front_speed, model
        )
        middle = _between(reference.wheel, at + (k + 0.5) * ahead)
        left_f, turned_f, wheel_f = _model_step(left_f, turned_f, wheel_f, 0.0, middle, speed, front_speed, model)
        impulse[0, k], impulse[1, k], impulse[2, k] = left_i, turned_i + wheel_i, wheel_i
        end = _between(reference.wheel, at + (k + 1) * ahead)
        free[0, k], free[1, k], free[2, k] = left_f, turned_f + wheel_f - end, wheel_f

    # sum of squares: cross-track error [m], lateral velocity x weight [m], lateral jerk x weight [m]
    velocity = model.velocity_s * front_speed
    span_s = max(model.lag_s, model.step_s)
    jerk = model.jerk_s3 * speed * speed / model.wheelbase_m / span_s
    hessian, gradient = np.zeros((STEPS, STEPS)), np.zeros(STEPS)
    rows, low, high = np.zeros((STEPS, STEPS)), np.empty(2 * STEPS), np.empty(2 * STEPS)
    for k in range(STEPS):
        for j in range(k + 1):  # a command of step j acts k - j steps later
            rows[k, j] = (1.0 if j == k else 0.0) - before_impulse[k - j]
        for i in range(k + 1):
            left_i, course_i, change_i = impulse[0, k - i], velocity * impulse[1, k - i], jerk * rows[k, i]
            gradient[i] += left_i * free[0, k] + course_i * velocity * free[1, k] - change_i * jerk * before_free[k]
            for j in range(i + 1):
                hessian[i, j] += (
                    left_i * impulse[0, k - j] + course_i * velocity * impulse[1, k - j] + change_i * jerk * rows[k, j]
                )
        high[k], low[k] = model.max_steer_rad, -model.max_steer_rad
        reach = model.max_rate_rad_s * span_s  # the wheels' rate is (command - wheel) / lag
        high[STEPS + k], low[STEPS + k] = before_free[k] + reach, before_free[k] - reach
    for i in range(STEPS):
        for j in range(i):
            hessian[j, i] = hessian[i, j]
    return hessian, gradient, rows, low, high, left, fallback, near


@ieee_kernel
def _model_step(
    left: float,
    turned: float,
    wheel: float,
    command: float,
    middle: float,
    speed: float,
    front_speed: float,
    model: Model,
) -> tuple[float, float, float]:
    """The linear model one step of the horizon later.

    Parameters
    ----------
    left, turned : float
        Cross-track error of the front axle [m]; heading of the vehicle against the reference [rad].
    wheel, command : float
        Angle of the front wheels, and the command that is held. [rad]
    middle : float
        Wheel angle of the reference in the middle of the step. [rad]
    """
    dt = model.step_s
    kept = math.exp(-dt / model.lag_s) if model.lag_s > 0 else 0.0
    mean_kept = model.lag_s / dt * (1 - kept)
    mean = mean_kept * wheel + (1 - mean_kept) * command - middle  # of the wheels against the reference
    after = turned + speed / model.wheelbase_m * dt * mean
    left = left + front_speed * dt * ((turned + after) / 2 + mean)
    return left, after, kept * wheel + (1 - kept) * command


@ieee_kernel
def _between(values: Floats, at: float) -> float:
    """Value between two grid points; of the ends beyond them."""
    last = values.shape[0] - 1
    low = min(max(int(at), 0), last - 1)
    share = min(max(at - low, 0.0), 1.0)
    return float(values[low] * (1 - share) + values[low + 1] * share)
