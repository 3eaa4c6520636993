"""A simulated drive along a decoded path: does a car that follows it stay in its lane?"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from app.compiled import ieee_kernel
from app.errors import InvalidParameter
from app.lanes.control import (
    Controller,
    FollowedPath,
    SteeringSettings,
    check_range,
    follow_path,
    nearest_on_path,
    plan_speed,
    predict_pose,
    stanley_rad,
)
from app.lanes.mpc import MpcSteering
from app.values import Floats

# === A car as a kinematic bicycle whose steering has limits, a lag and a delay, and the errors of its poses.


STEP_S = 0.01  # [s] time step of simulation and controller; 100 Hz


@dataclass(frozen=True, slots=True)
class Vehicle:
    """Parameters of the car.

    Notes
    -----
    Tyres do not slip: valid for comfortable driving (2 m/s2 sideways), not for emergencies.
    """

    # [m]
    wheelbase_m: float = 2.70  # [m] source: Kia Niro, the paper's car
    # `max_steer_deg`, `max_steer_rate_deg_s`: of the front wheels. [deg, deg/s]
    max_steer_deg: float = 32.0  # [deg] source: assumed, no measurement kept
    max_steer_rate_deg_s: float = 30.0  # [deg/s] source: assumed, no measurement kept
    # `steer_lag_s`, `latency_s`: [s] time constant of the wheels, and delay of a command
    steer_lag_s: float = 0.10  # [s] source: assumed, no measurement kept
    latency_s: float = 0.12  # [s] source: assumed, no measurement kept
    steer_offset_deg: float = 0.0  # [deg] Misalignment of the wheels, left positive
    # `max_acceleration_m_s2`, `max_braking_m_s2`, `drive_lag_s`: limits of speed control and its time constant
    max_acceleration_m_s2: float = 2.0  # [m/s2] source: assumed, comfortable driving
    max_braking_m_s2: float = 3.0  # [m/s2] source: assumed, comfortable driving
    drive_lag_s: float = 0.3  # [s] assumed

    def __post_init__(self) -> None:
        for name, low, high in (
            ("wheelbase_m", 0.5, 20.0), ("max_steer_deg", 1.0, 60.0), ("max_steer_rate_deg_s", 1.0, 500.0),
            ("steer_lag_s", 0.0, 1.0), ("latency_s", 0.0, 0.5), ("steer_offset_deg", -5.0, 5.0),
            ("max_acceleration_m_s2", 0.1, 10.0), ("max_braking_m_s2", 0.1, 10.0), ("drive_lag_s", 0.0, 2.0),
        ):  # fmt: skip
            check_range(getattr(self, name), low, high, f"vehicle.{name}")


@dataclass(frozen=True, slots=True)
class PoseNoise:
    """Errors of the poses for a controller: RTK with two antennas.

    Notes
    -----
    By default 0.02 m in the plane, as stated for the paper's receiver: 0.014 m on each axis, most of it slow.
    """

    # `drift_m`, `drift_over_s`: standard deviation on each axis, and time constant of errors that change slowly. [m, s]
    drift_m: float = 0.0135  # [m] source: the paper's receiver, 0.02 m in the plane
    drift_over_s: float = 20.0  # [s] source: assumed, no measurement kept
    # [m] standard deviation on each axis from one fix to the next
    jitter_m: float = 0.004  # [m] source: assumed, no measurement kept
    # [deg] standard deviation of the heading from one fix to the next
    heading_deg: float = 0.1  # [deg] source: assumed, two antennas

    def __post_init__(self) -> None:
        for name, low, high in (
            ("drift_m", 0.0, 10.0), ("drift_over_s", 0.01, 1e5), ("jitter_m", 0.0, 10.0), ("heading_deg", 0.0, 45.0),
        ):  # fmt: skip
            check_range(getattr(self, name), low, high, f"noise.{name}")


def draw_pose_errors(noise: PoseNoise | None, count: int, rng: np.random.Generator) -> Floats:
    """Errors of east [m], north [m] and heading [rad] at each step, shape (count, 3)."""
    errors = np.zeros((count, 3))
    if noise is None:
        return errors
    normal = rng.standard_normal((count, 5))
    keep = math.exp(-STEP_S / noise.drift_over_s)
    innovations = noise.drift_m * math.sqrt(1 - keep**2) * normal[:, :2]
    innovations[0] = noise.drift_m * normal[0, :2]
    errors[:, :2] = _correlate(innovations, keep) + noise.jitter_m * normal[:, 2:4]
    errors[:, 2] = math.radians(noise.heading_deg) * normal[:, 4]
    return errors


@ieee_kernel
def _correlate(values, keep):  # type: ignore[no-untyped-def]
    out = values.copy()
    for k in range(1, out.shape[0]):
        out[k] += keep * out[k - 1]
    return out


@ieee_kernel
def turn_wheels(steer, command, lag, max_rate, max_steer, dt):  # type: ignore[no-untyped-def]
    """Angle of the front wheels one step later. [rad]"""
    rate = (command - steer) / max(lag, dt)
    rate = min(max(rate, -max_rate), max_rate)
    return min(max(steer + rate * dt, -max_steer), max_steer)


@ieee_kernel
def move_vehicle(x, y, yaw, speed, steer, wheelbase, dt):  # type: ignore[no-untyped-def]
    """Rear axle's centre and heading one step later: a kinematic bicycle on the chord of its arc. [m, m, rad]"""
    turn = speed * math.tan(steer) / wheelbase * dt
    along = speed * dt
    return x + along * math.cos(yaw + turn / 2), y + along * math.sin(yaw + turn / 2), yaw + turn


# === The simulated drive of `steering`, step by step: control law, actuators, vehicle.


OFF_PATH_M = 3.0  # [m] of the front axle from its path, at which a drive ends; a lane's width
_INTEGRATED_M = 0.15  # [m] only smaller errors are integrated
_MAX_INTEGRAL_RAD = 0.05  # [rad] of steering by the integral; 2.9 degrees of misalignment
_SPEED_P, _SPEED_I, _SPEED_D = 1.5, 0.15, 0.05  # of the speed's PID
_SPEED_AHEAD_S = 0.5  # [s] the target speed is that of the path this far ahead; source: lag of engine and brakes
_MAX_START_SINE = 0.5  # of the wheels' angle at the start; 30 degrees
ENDINGS = ("reached the end", "left the path", "took too long")
REACHED_END, _LEFT_PATH, _TOOK_TOO_LONG = range(3)
_ON_PATH = -1  # the drive goes on


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
    errors : ndarray, shape (T, 3)
        Of the controller's poses: east [m], north [m], heading [rad].

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
        near, ending = _measure(course, state, car, near, rows[k])
        if ending != _ON_PATH:
            return rows[: k + 1], ending
        steer, error, seen, far = _steer(course, state, errors[k], law, car, sent[depth - waiting :], held, seen, far)
        if abs(error) < _INTEGRATED_M:
            integral -= law.integral_per_m_s * error * STEP_S
            integral = min(max(integral, -_MAX_INTEGRAL_RAD), _MAX_INTEGRAL_RAD)
        state, control = _send_and_step(course, state, control, car, steer + integral, sent, rows[k, 6], k == 0)
    return rows, _TOOK_TOO_LONG


def drive_course_by_mpc(
    course: Course, start: State, errors: Floats, latency_s: float, car: Car, steering: MpcSteering
) -> tuple[Floats, int]:
    """Simulate a drive as `drive_course` does, but steered by model predictive control, which assumes a latency."""
    waiting = round(latency_s / STEP_S)
    sent = np.full(max(car.latency_steps, waiting) + 1, start.wheel - car.misalignment_rad)
    rows = np.empty((len(errors), 8))
    state, control, near = start, SpeedControl(0.0, 0.0), 0
    for k, (east_m, north_m, yaw_rad) in enumerate(errors.tolist()):
        near, ending = _measure(course, state, car, near, rows[k])
        if ending != _ON_PATH:
            return rows[: k + 1], ending
        pose = state.x + east_m, state.y + north_m, state.yaw + yaw_rad
        wheel = state.wheel - car.misalignment_rad
        command, _error = steering.steer(*pose, state.speed, wheel, sent[len(sent) - waiting :], STEP_S)
        state, control = _send_and_step(course, state, control, car, command, sent, rows[k, 6], k == 0)
    return rows, _TOOK_TOO_LONG


@ieee_kernel
def _measure(course, state, car, near, row):  # type: ignore[no-untyped-def]
    """Write a row of `drive_course`; returns the nearest piece of the path, and how the drive ends if it does."""
    front_x = state.x + car.wheelbase_m * math.cos(state.yaw)
    front_y = state.y + car.wheelbase_m * math.sin(state.yaw)
    near, share, left = nearest_on_path(course.points, front_x, front_y, near)
    station = (near + share) * course.step_m
    values = (state.x, state.y, state.yaw, state.speed, _speed_at(course, station), state.wheel, station, left)
    for column in range(8):
        row[column] = values[column]
    if near == course.points.shape[0] - 2 and share >= 1.0:
        return near, REACHED_END
    if not abs(left) <= OFF_PATH_M:
        return near, _LEFT_PATH
    return near, _ON_PATH


@ieee_kernel
def _send_and_step(course, state, control, car, command, sent, station, first):  # type: ignore[no-untyped-def]
    """State and speed control one step after a command [rad] was sent; ``sent`` has all commands, newest last."""
    sent[:-1] = sent[1:]
    sent[-1] = min(max(command, -car.max_steer_rad), car.max_steer_rad)
    target = _speed_at(course, station + _SPEED_AHEAD_S * state.speed)
    return _step(state, sent[sent.shape[0] - 1 - car.latency_steps], target, control, car, first)


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


# === A simulated drive along a decoded path.


_SPARE_S, _SPARE_SHARE = 30.0, 1.5  # [s, 1] time allowed beyond the planned one


@dataclass(frozen=True, slots=True, eq=False)
class SteeringTrace:
    """A simulated drive, at 100 Hz."""

    time_s: Floats  # shape (T,)
    # `front_enu_m`, `rear_enu_m`: shape (T, 2): [m] centres of the axles
    front_enu_m: Floats
    rear_enu_m: Floats
    heading_deg: Floats  # shape (T,): [deg] clockwise from north
    # `speed_m_s`, `planned_speed_m_s`: shape (T,)
    speed_m_s: Floats
    planned_speed_m_s: Floats
    steer_deg: Floats  # shape (T,): [deg] of the front wheels, left positive
    station_m: Floats  # shape (T,): [m] along the path driven
    # `path_error_m`, `cross_track_m`: shape (T,): [m] front axle left of the path driven, and of the true line; NaN
    # before and after the latter
    path_error_m: Floats
    cross_track_m: Floats


@dataclass(frozen=True, slots=True, eq=False)
class SteeringCheck:
    """Errors of a simulated drive along a path.

    Notes
    -----
    Table 1 of the CERPM paper gives an "overall magnitude" of its MSE in metres: 0.42 on route 2 is the root of the
    sum of squares of the components printed, 0.25 and 0.34; 0.38 on route 3 is not that of 0.24 and 0.38, which would
    be 0.45. A mean square of metres is in square metres. Here the error vector at each place runs from the nearest
    point of the true line to the front axle, MSE_x and MSE_y are the means of its squared components, and |MSE| =
    sqrt(MSE_x^2 + MSE_y^2): between 0.71 and 1 times the square of the RMS error. Means are over the distance driven,
    so that slow stretches don't weigh more.
    """

    controller: Controller
    # `rms_m`, `max_m`: [m] Cross-track error of the front axle's centre against the true line, over the distance driven
    rms_m: float
    max_m: float
    # `mse_east_m2`, `mse_north_m2`, `mse_m2`: [m2] mean squares of the error vector's two components, and their
    # magnitude (see Notes)
    mse_east_m2: float
    mse_north_m2: float
    mse_m2: float
    # `path_rms_m`, `rear_rms_m`: [m] front axle against the path driven, rear axle's centre against the true line
    path_rms_m: float
    rear_rms_m: float
    # `steer_rate_rms_deg_s`, `steer_rate_max_deg_s`: [deg/s] steering effort: rates of the front wheels
    steer_rate_rms_deg_s: float
    steer_rate_max_deg_s: float
    lateral_acceleration_m_s2: float  # [m/s2] largest
    # `mean_speed_m_s`, `excess_speed_m_s`: [m/s] mean speed, and the maximum by which the planned speed (the limit or
    # less) was exceeded
    mean_speed_m_s: float
    excess_speed_m_s: float
    distance_m: float
    duration_s: float
    completed: bool  # whether the front axle reached the path's end
    ended: str  # why the drive ended
    unsolved_steps: int  # steps in which model predictive control found no solution, steered by equation 4
    trace: SteeringTrace


def check_steering(
    path_enu_m: npt.ArrayLike,
    speed_limit_kmh: npt.ArrayLike,
    *,
    controller: Controller | str = Controller.PREDICTIVE,
    settings: SteeringSettings | None = None,
    vehicle: Vehicle | None = None,
    noise: PoseNoise | None = None,
    truth_enu_m: npt.ArrayLike | None = None,
    rng: np.random.Generator | None = None,
    start_offset_m: float = 0.0,
) -> SteeringCheck:
    """Drive a simulated car along a path.

    Parameters
    ----------
    path_enu_m : array_like, shape (S, 2)
        The path decoded: east, north in the direction of travel. [m]
    speed_limit_kmh : float or array_like, shape (S,)
        Driven at except in bends, which are driven at 2 m/s2 of lateral acceleration, with 1.5 m/s2 of braking before
        them. [km/h]
    settings : SteeringSettings, optional
        Gains, and the vehicle's delays as assumed by the controller.
    noise : PoseNoise, optional
        Errors of the poses for the controller; none by default.
    truth_enu_m : array_like, shape (M, 2), optional
        The true centre line; the path itself by default. [m]
    rng : numpy.random.Generator, optional
        Draws the noise; required with it.
    start_offset_m : float
        Offset of the start left of the path, as on a steady bend of its curvature. [m]

    Returns
    -------
    SteeringCheck

    Raises
    ------
    InvalidParameter
        The path or the true line cannot be driven along (see `follow_path`), a limit is out of range, the controller
        is unknown, noise comes without a generator, or the drive never passes along the true line.

    Notes
    -----
    CERPM paper, section 2.3: speed by PID, steering by equation 4 or 5. The pose that the law gets is the front axle's
    (the paper's figure 10), so errors are those of the front axle; the rear axle cuts bends, as it does behind any
    driver. In a steady turn psi is the steering angle, so equation 5 brings the point ahead on to the path, whatever
    its gain: on a bend of radius R the axle runs at the root of R^2 - d_l^2 - 2 d_l L, 2.6 m inside one of 60 m. And
    equation 4 turns back a heading error at speed over wheelbase per second: with 0.2 s of delay and lag it is unstable
    from about 70 km/h. Both are kept as the paper has them, as peers of ``predictive``.
    """
    law = _known_controller(controller)
    settings, vehicle = settings or SteeringSettings.suited_to(law), vehicle or Vehicle()
    if noise is not None and rng is None:
        raise InvalidParameter("noise needs a generator", field="rng", cure="pass numpy.random.default_rng(seed)")
    if not abs(start_offset_m) < OFF_PATH_M:
        raise InvalidParameter("the start is off the path", field="start_offset_m", limit=f"< {OFF_PATH_M:g} m")
    path = follow_path(path_enu_m)
    truth = path if truth_enu_m is None else follow_path(truth_enu_m, field="truth_enu_m")
    speed = plan_speed(path, path_enu_m, speed_limit_kmh)
    longest_s = _SPARE_SHARE * path.step_m * float(np.sum(1 / speed)) + _SPARE_S
    steps = math.ceil(longest_s / STEP_S)
    errors = draw_pose_errors(noise, steps, rng or np.random.default_rng(0))
    course = Course(path.position_enu_m, path.heading_rad, speed, path.step_m)
    start = start_on_bend(course, float(path.curvature_per_m[0]), start_offset_m, vehicle.wheelbase_m)
    car, unsolved = car_values(vehicle), 0
    if law is Controller.MPC:
        steering = MpcSteering(path, settings)
        rows, ending = drive_course_by_mpc(course, start, errors, settings.latency_s, car, steering)
        unsolved = steering.unsolved_steps
    else:
        rows, ending = drive_course(course, start, errors, law_values(law, settings), car)
    return _evaluate(law, rows, path, truth, vehicle, ENDINGS[ending], unsolved)


def _known_controller(controller: Controller | str) -> Controller:
    """Raises InvalidParameter if the controller is unknown."""
    try:
        return Controller(controller)
    except ValueError as error:
        raise InvalidParameter(
            f"{controller!r} is not a controller", field="controller", limit=", ".join(Controller)
        ) from error


@ieee_kernel
def _errors_along(points, track, first):  # type: ignore[no-untyped-def]
    """Cross-track errors and error vectors of a track from a line; NaN before its start and after its end."""
    out = np.full((track.shape[0], 3), np.nan)
    last = points.shape[0] - 2
    near = first
    for k in range(track.shape[0]):
        near, share, left = nearest_on_path(points, track[k, 0], track[k, 1], near)
        if (near == 0 and share < 0) or (near == last and share > 1):
            continue
        out[k, 0] = left
        for axis in range(2):
            foot = points[near, axis] + share * (points[near + 1, axis] - points[near, axis])
            out[k, 1 + axis] = track[k, axis] - foot
    return out


# --- evaluation ----------------------------------------------------------------------------------------------------


def _evaluate(
    law: Controller, rows: Floats, path: FollowedPath, truth: FollowedPath, vehicle: Vehicle, ended: str, unsolved: int
) -> SteeringCheck:
    """Errors of the rows of a drive."""
    rear, yaw, speed, wheel = rows[:, :2], rows[:, 2], rows[:, 3], rows[:, 5]
    time_s = np.arange(len(rows), dtype=float) * np.float64(STEP_S)
    heading_deg = np.asarray((90.0 - np.degrees(yaw)) % 360.0, float)
    steer_deg: Floats = np.asarray(np.degrees(wheel), float)
    front = rear + vehicle.wheelbase_m * np.column_stack([np.cos(yaw), np.sin(yaw)])
    errors, rear_errors = (_errors_along(truth.position_enu_m, t, _nearest_start(truth, t[0])) for t in (front, rear))
    if not np.isfinite(errors).any():
        raise InvalidParameter("the drive never passes along the true line", field="truth_enu_m")
    weights = np.maximum(speed, 1e-6) * STEP_S
    along = np.isfinite(errors[:, 0])

    def mean(values: Floats, of: npt.NDArray[np.bool_]) -> float:
        return float(np.average(values[of], weights=weights[of])) if of.any() else math.nan

    east, north = mean(errors[:, 1] ** 2, along), mean(errors[:, 2] ** 2, along)
    everywhere, behind = np.ones(len(rows), bool), np.isfinite(rear_errors[:, 0])
    rates = np.diff(steer_deg, prepend=steer_deg[0]) / STEP_S
    lateral = speed**2 * np.abs(np.tan(wheel)) / vehicle.wheelbase_m
    trace = SteeringTrace(
        time_s, front, rear, heading_deg, speed, rows[:, 4], steer_deg, rows[:, 6], rows[:, 7], errors[:, 0]
    )
    return SteeringCheck(
        controller=law,
        rms_m=math.sqrt(mean(errors[:, 0] ** 2, along)),
        max_m=float(np.nanmax(np.abs(errors[:, 0]))),
        mse_east_m2=east,
        mse_north_m2=north,
        mse_m2=math.hypot(east, north),
        path_rms_m=math.sqrt(mean(rows[:, 7] ** 2, everywhere)),
        rear_rms_m=math.sqrt(mean(rear_errors[:, 0] ** 2, behind)),
        steer_rate_rms_deg_s=math.sqrt(float(np.mean(rates**2))),
        steer_rate_max_deg_s=float(np.abs(rates).max()),
        lateral_acceleration_m_s2=float(lateral.max()),
        mean_speed_m_s=float(speed.mean()),
        excess_speed_m_s=max(float(np.max(speed - rows[:, 4])), 0.0),
        distance_m=float(weights.sum()),
        duration_s=len(rows) * STEP_S,
        completed=ended == ENDINGS[REACHED_END],
        ended=ended,
        unsolved_steps=unsolved,
        trace=trace,
    )


def _nearest_start(line: FollowedPath, point: Floats) -> int:
    away = np.sum((line.position_enu_m - point) ** 2, axis=1)
    return min(int(away.argmin()), len(away) - 2)
