"""The simulated drive of `steering`, step by step: control law, actuators, vehicle."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from app.compiled import ieee_kernel
from app.lanes.control import Controller, SteeringSettings, nearest_on_path, predict_pose, stanley_rad
from app.simulation.vehicle import STEP_S, Vehicle, move_vehicle, turn_wheels

Floats = npt.NDArray[np.float64]

OFF_PATH_M = 3.0  # [m] of the front axle from its path, at which a drive ends; source: by hand, a lane's width
_INTEGRATED_M = 0.15  # [m] only smaller errors are integrated; source: by hand, no measurement kept
_MAX_INTEGRAL_RAD = 0.05  # [rad] of steering by the integral; source: by hand, 2.9 degrees of misalignment
_SPEED_P, _SPEED_I, _SPEED_D = 1.5, 0.15, 0.05  # of the speed's PID; source: by hand, no measurement kept
_SPEED_AHEAD_S = 0.5  # [s] the target speed is that of the path this far ahead; source: lag of engine and brakes
_MAX_START_SINE = 0.5  # of the wheels' angle at the start; source: by hand, 30 degrees
ENDINGS = ("reached the end", "left the path", "took too long")
REACHED_END, _LEFT_PATH, _TOOK_TOO_LONG = range(3)


class Course(NamedTuple):
    """Path on an even grid: points (N, 2) [m], headings [rad] and planned speeds [m/s] (N,), step [m]."""

    points: Floats
    headings: Floats
    speeds: Floats
    step_m: float


class Law(NamedTuple):
    """Gains of a control law, and the delays that it compensates."""

    gain_per_s: float
    lookahead_m: float
    latency_s: float
    lag_s: float
    wheelbase_m: float
    integral_per_m_s: float
    predictive: bool


class Car(NamedTuple):
    """Parameters of the simulated car, in radians and steps."""

    wheelbase_m: float
    max_steer_rad: float
    max_rate_rad_s: float
    lag_s: float
    latency_steps: int
    misalignment_rad: float
    max_acceleration_m_s2: float
    max_braking_m_s2: float
    drive_lag_s: float


class State(NamedTuple):
    """Rear axle's centre [m], heading [rad], speed [m/s], acceleration [m/s2], angle of the front wheels [rad]."""

    x: float
    y: float
    yaw: float
    speed: float
    acceleration: float
    wheel: float


class SpeedControl(NamedTuple):
    """Sum [m] and last value [m/s] of the speed's error."""

    summed: float
    before: float


def law_values(law: Controller, s: SteeringSettings) -> Law:
    """Gains of a controller; only the predictive one compensates delays."""
    predictive = law is Controller.PREDICTIVE
    return Law(
        gain_per_s=s.gain_per_s,
        lookahead_m=s.lookahead_m if law is Controller.STANLEY_LOOKAHEAD else 0.0,
        latency_s=s.latency_s if predictive else 0.0,
        lag_s=s.lag_s if predictive else 0.0,
        wheelbase_m=s.wheelbase_m,
        integral_per_m_s=s.integral_per_m_s if predictive else 0.0,
        predictive=predictive,
    )


def car_values(v: Vehicle) -> Car:
    """A vehicle's parameters in radians and steps."""
    return Car(
        wheelbase_m=v.wheelbase_m,
        max_steer_rad=math.radians(v.max_steer_deg),
        max_rate_rad_s=math.radians(v.max_steer_rate_deg_s),
        lag_s=v.steer_lag_s,
        latency_steps=round(v.latency_s / STEP_S),
        misalignment_rad=math.radians(v.steer_offset_deg),
        max_acceleration_m_s2=v.max_acceleration_m_s2,
        max_braking_m_s2=v.max_braking_m_s2,
        drive_lag_s=v.drive_lag_s,
    )


def start_on_bend(course: Course, curvature_per_m: float, offset_m: float, wheelbase_m: float) -> State:
    """State on a steady bend: the front axle follows the path, the wheels are at sin(angle) = wheelbase x curvature."""
    sine = min(max(wheelbase_m * curvature_per_m, -_MAX_START_SINE), _MAX_START_SINE)
    wheel, heading = math.asin(sine), float(course.headings[0])
    yaw = heading - wheel
    x = float(course.points[0, 0]) - offset_m * math.sin(heading) - wheelbase_m * math.cos(yaw)
    y = float(course.points[0, 1]) + offset_m * math.cos(heading) - wheelbase_m * math.sin(yaw)
    return State(x, y, yaw, float(course.speeds[0]), 0.0, wheel)


@ieee_kernel
def drive_course(course, start, errors, law, car):  # type: ignore[no-untyped-def]
    """Simulate a drive.

    Parameters
    ----------
    course : Course
    start : State
    errors : ndarray, shape (T, 3)
        Of the controller's poses: east [m], north [m], heading [rad].
    law : Law
    car : Car

    Returns
    -------
    rows : ndarray, shape (K, 8)
        Rear x, y, heading, speed, planned speed, wheel angle, station, path error, at each step.
    ending : int
        Index of `ENDINGS`.
    """
    last = course.points.shape[0] - 1
    waiting, held = round(law.latency_s / STEP_S), round(law.lag_s / STEP_S)
    depth = max(car.latency_steps, waiting) + 1
    sent = np.full(depth, start.wheel - car.misalignment_rad)  # commands, newest last
    rows = np.empty((errors.shape[0], 8))
    state, control, integral = start, SpeedControl(0.0, 0.0), 0.0
    near, seen, far = 0, 0, min(int(law.lookahead_m / course.step_m), last - 1)
    for k in range(errors.shape[0]):
        front_x = state.x + car.wheelbase_m * math.cos(state.yaw)
        front_y = state.y + car.wheelbase_m * math.sin(state.yaw)
        near, share, left = nearest_on_path(course.points, front_x, front_y, near)
        station = (near + share) * course.step_m
        planned = _speed_at(course, station)
        rows[k] = (state.x, state.y, state.yaw, state.speed, planned, state.wheel, station, left)
        if near == last - 1 and share >= 1.0:
            return rows[: k + 1], REACHED_END
        if not abs(left) <= OFF_PATH_M:
            return rows[: k + 1], _LEFT_PATH
        steer, error, seen, far = _steer(course, state, errors[k], law, car, sent[depth - waiting :], held, seen, far)
        if abs(error) < _INTEGRATED_M:
            integral -= law.integral_per_m_s * error * STEP_S
            integral = min(max(integral, -_MAX_INTEGRAL_RAD), _MAX_INTEGRAL_RAD)
        sent[:-1] = sent[1:]
        sent[-1] = min(max(steer + integral, -car.max_steer_rad), car.max_steer_rad)
        target = _speed_at(course, station + _SPEED_AHEAD_S * state.speed)
        state, control = _step(state, sent[depth - 1 - car.latency_steps], target, control, car, k == 0)
    return rows, _TOOK_TOO_LONG


@ieee_kernel
def _speed_at(course, station):  # type: ignore[no-untyped-def]
    """Planned speed at a station, of the ends beyond them. [m/s]"""
    return course.speeds[min(max(int(station / course.step_m), 0), course.speeds.shape[0] - 1)]


@ieee_kernel
def _steer(course, state, error, law, car, pending, held, seen, far):  # type: ignore[no-untyped-def]
    """Steering command at a pose with errors; predictive laws first predict the pose at which it takes effect.

    Returns the command [rad], the cross-track error [m], and the pieces of the path for the next call.
    """
    x, y, yaw = state.x + error[0], state.y + error[1], state.yaw + error[2]
    if law.predictive:
        x, y, yaw, _ = predict_pose(
            x,
            y,
            yaw,
            state.wheel - car.misalignment_rad,
            state.speed,
            law.wheelbase_m,
            law.lag_s,
            pending,
            held,
            STEP_S,
        )
    x, y = x + law.wheelbase_m * math.cos(yaw), y + law.wheelbase_m * math.sin(yaw)
    return stanley_rad(
        course.points, course.headings, x, y, yaw, state.speed, law.gain_per_s, law.lookahead_m, seen, far
    )


@ieee_kernel
def _step(state, command, target, control, car, first):  # type: ignore[no-untyped-def]
    """State and speed control one step later.

    The wheels follow the command, the speed follows its target by a PID whose sum is held at the limits.
    """
    wheel = turn_wheels(
        state.wheel, command + car.misalignment_rad, car.lag_s, car.max_rate_rad_s, car.max_steer_rad, STEP_S
    )
    behind = target - state.speed
    wanted = _SPEED_P * behind + _SPEED_I * control.summed
    wanted += 0.0 if first else _SPEED_D * (behind - control.before) / STEP_S
    summed = control.summed
    if -car.max_braking_m_s2 < wanted < car.max_acceleration_m_s2:
        summed += behind * STEP_S
    limited = min(max(wanted, -car.max_braking_m_s2), car.max_acceleration_m_s2)
    acceleration = state.acceleration + STEP_S / max(car.drive_lag_s, STEP_S) * (limited - state.acceleration)
    x, y, yaw = move_vehicle(state.x, state.y, state.yaw, state.speed, wheel, car.wheelbase_m, STEP_S)
    speed = max(state.speed + acceleration * STEP_S, 0.0)
    return State(x, y, yaw, speed, acceleration, wheel), SpeedControl(summed, behind)
