"""Would a car that follows a decoded path stay in its lane? A simulated drive along it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba as nb
import numpy as np
import numpy.typing as npt

from app.decoders.cerpm.control import (
    Controller,
    FollowedPath,
    SteeringSettings,
    follow_path,
    nearest_on_path,
    plan_speed,
    predict_pose,
    stanley_rad,
)
from app.errors import InvalidParameter
from app.simulation.vehicle import STEP_S, PoseNoise, Vehicle, draw_pose_errors, move_vehicle, turn_wheels

Floats = npt.NDArray[np.float64]

OFF_PATH_M = 3.0
"""A drive ends where the front axle is farther from its path. [m]"""
_SPARE_S, _SPARE_SHARE = 30.0, 1.5
_NEAR_M, _MAX_SUM_RAD = 0.15, 0.05
"""The integral learns from errors smaller than this, and steers by no more than this. [m, rad]"""
_SPEED_PID = (1.5, 0.15, 0.05)
_SPEED_AHEAD_S = 0.5
"""The speed wanted is that of the path so long ahead: the engine and the brakes need about it. [s]"""


@dataclass(frozen=True, slots=True, eq=False)
class SteeringTrace:
    """A simulated drive, at 100 Hz.

    Attributes
    ----------
    time_s : ndarray, shape (T,)
    front_enu_m, rear_enu_m : ndarray, shape (T, 2)
        Centres of the axles. [m]
    heading_deg : ndarray, shape (T,)
        Clockwise from north. [deg]
    speed_m_s, planned_speed_m_s : ndarray, shape (T,)
    steer_deg : ndarray, shape (T,)
        Of the front wheels, left positive. [deg]
    station_m : ndarray, shape (T,)
        Along the path driven. [m]
    path_error_m, cross_track_m : ndarray, shape (T,)
        Front axle left of the path driven, and of the true line; NaN before and after the latter. [m]
    """

    time_s: Floats
    front_enu_m: Floats
    rear_enu_m: Floats
    heading_deg: Floats
    speed_m_s: Floats
    planned_speed_m_s: Floats
    steer_deg: Floats
    station_m: Floats
    path_error_m: Floats
    cross_track_m: Floats


@dataclass(frozen=True, slots=True, eq=False)
class SteeringCheck:
    """How a simulated drive along a path went.

    Attributes
    ----------
    controller : Controller
    rms_m, max_m : float
        Cross-track error of the front axle's centre against the true line, over the way driven. [m]
    mse_east_m2, mse_north_m2, mse_m2 : float
        Mean squares of the error vector's two components, and their magnitude (see Notes). [m2]
    path_rms_m, rear_rms_m : float
        Front axle against the path driven, rear axle's centre against the true line. [m]
    steer_rate_rms_deg_s : float
        Steering effort: RMS rate of the front wheels. [deg/s]
    lateral_acceleration_m_s2 : float
        Largest. [m/s2]
    mean_speed_m_s, excess_speed_m_s : float
        Mean speed, and the most by which the planned speed was exceeded: the limit or less. [m/s]
    distance_m, duration_s : float
    completed : bool
        The front axle came to the path's end.
    ended : str
        Why the drive ended.
    trace : SteeringTrace

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
    rms_m: float
    max_m: float
    mse_east_m2: float
    mse_north_m2: float
    mse_m2: float
    path_rms_m: float
    rear_rms_m: float
    steer_rate_rms_deg_s: float
    lateral_acceleration_m_s2: float
    mean_speed_m_s: float
    excess_speed_m_s: float
    distance_m: float
    duration_s: float
    completed: bool
    ended: str
    trace: SteeringTrace


def check_steering(
    path_enu_m: npt.ArrayLike,
    speed_limit_km_h: npt.ArrayLike,
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
    speed_limit_km_h : float or array_like, shape (S,)
        Driven at, but for bends, which are taken at 2 m/s2 sideways, with 1.5 m/s2 of braking before them. [km/h]
    controller : Controller or str
    settings : SteeringSettings, optional
        Gains and the vehicle's delays as the controller believes them, which need not be true.
    vehicle : Vehicle, optional
    noise : PoseNoise, optional
        Errors of the poses that the controller is given; none without.
    truth_enu_m : array_like, shape (M, 2), optional
        The true centre line; the path itself without. [m]
    rng : numpy.random.Generator, optional
        Draws the noise; needed with it.
    start_offset_m : float
        The drive starts so far left of the path, as on a steady bend of its curvature. [m]

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
    speed = plan_speed(path, path_enu_m, speed_limit_km_h)
    longest_s = _SPARE_SHARE * path.step_m * float(np.sum(1 / speed)) + _SPARE_S
    steps = math.ceil(longest_s / STEP_S)
    errors = draw_pose_errors(noise, steps, rng or np.random.default_rng(0))
    rows, end = _drive(
        path.position_enu_m, path.heading_rad, speed, path.step_m, float(path.curvature_per_m[0]), start_offset_m,
        errors, _law_values(law, settings), _vehicle_values(vehicle),
    )  # fmt: skip
    return _judge(law, rows, path, truth, vehicle, ("reached the end", "left the path", "took too long")[end])


def _known_controller(controller: Controller | str) -> Controller:
    try:
        return Controller(controller)
    except ValueError as error:
        raise InvalidParameter(
            f"{controller!r} is not a controller", field="controller", limit=", ".join(Controller)
        ) from error


def _law_values(law: Controller, s: SteeringSettings) -> tuple[float, ...]:
    predictive = law is Controller.PREDICTIVE
    return (
        s.gain_per_s,
        s.lookahead_m if law is Controller.STANLEY_LOOKAHEAD else 0.0,
        s.latency_s if predictive else 0.0,
        s.lag_s if predictive else 0.0,
        s.wheelbase_m,
        s.integral_per_m_s if predictive else 0.0,
        1.0 if predictive else 0.0,
    )


def _vehicle_values(v: Vehicle) -> tuple[float, ...]:
    return (
        v.wheelbase_m, math.radians(v.max_steer_deg), math.radians(v.max_steer_rate_deg_s), v.steer_lag_s,
        float(round(v.latency_s / STEP_S)), math.radians(v.steer_offset_deg), v.max_acceleration_m_s2,
        v.max_braking_m_s2, v.drive_lag_s,
    )  # fmt: skip


# --- the drive ----------------------------------------------------------------------------------------------------


@nb.njit(cache=True)
def _drive(points, headings, speeds, step_m, curvature, offset, errors, law, car):  # type: ignore[no-untyped-def]
    """Rows of rear x, y, heading, speed, planned speed, wheel angle, station, path error; and how it ended (0 well)."""
    gain, ahead, assumed_latency, assumed_lag, assumed_base, integral_gain, predictive = law
    wheelbase, max_steer, max_rate, lag, latency, askew, push, brake, drive_lag = car
    dt, delay, last = STEP_S, int(latency), points.shape[0] - 1
    waiting, held = round(assumed_latency / dt), round(assumed_lag / dt)
    rows = np.empty((errors.shape[0], 8))
    # a steady turn: the front axle runs along the path, the wheels stand at sin(steer) = wheelbase x curvature
    wheel = math.asin(min(max(wheelbase * curvature, -0.5), 0.5))
    yaw, speed, pushed = headings[0] - wheel, speeds[0], 0.0
    x = points[0, 0] - offset * math.sin(headings[0]) - wheelbase * math.cos(yaw)
    y = points[0, 1] + offset * math.cos(headings[0]) - wheelbase * math.sin(yaw)
    depth = max(delay, waiting) + 1
    sent = np.full(depth, wheel - askew)  # newest last
    near, far, seen, summed, speed_sum, before = 0, min(int(ahead / step_m), last - 1), 0, 0.0, 0.0, 0.0
    for k in range(errors.shape[0]):
        front_x, front_y = x + wheelbase * math.cos(yaw), y + wheelbase * math.sin(yaw)
        near, share, left = nearest_on_path(points, front_x, front_y, near)
        station = (near + share) * step_m
        wanted = speeds[min(max(int((station + _SPEED_AHEAD_S * speed) / step_m), 0), last)]
        planned = speeds[min(max(int(station / step_m), 0), last)]
        rows[k] = (x, y, yaw, speed, planned, wheel, station, left)
        if near == last - 1 and share >= 1.0:
            return rows[: k + 1], 0
        if not abs(left) <= OFF_PATH_M:
            return rows[: k + 1], 1
        # the controller sees a pose with errors
        at_x, at_y, at_yaw, at_wheel = x + errors[k, 0], y + errors[k, 1], yaw + errors[k, 2], wheel - askew
        if predictive > 0:
            pending = sent[depth - waiting :]
            at_x, at_y, at_yaw, at_wheel = predict_pose(
                at_x, at_y, at_yaw, at_wheel, speed, assumed_base, assumed_lag, pending, held, dt
            )
        at_x, at_y = at_x + assumed_base * math.cos(at_yaw), at_y + assumed_base * math.sin(at_yaw)
        steer, error, seen, far = stanley_rad(points, headings, at_x, at_y, at_yaw, speed, gain, ahead, seen, far)
        if abs(error) < _NEAR_M:
            summed = min(max(summed - integral_gain * error * dt, -_MAX_SUM_RAD), _MAX_SUM_RAD)
        sent[:-1] = sent[1:]
        sent[-1] = min(max(steer + summed, -max_steer), max_steer)
        wheel = turn_wheels(wheel, sent[depth - 1 - delay] + askew, lag, max_rate, max_steer, dt)
        # speed by PID, its sum held while the limits hold
        behind = wanted - speed
        asked = _SPEED_PID[0] * behind + _SPEED_PID[1] * speed_sum
        asked += _SPEED_PID[2] * (behind - before) / dt if k else 0.0
        before = behind
        if -brake < asked < push:
            speed_sum += behind * dt
        pushed += dt / max(drive_lag, dt) * (min(max(asked, -brake), push) - pushed)
        x, y, yaw = move_vehicle(x, y, yaw, speed, wheel, wheelbase, dt)
        speed = max(speed + pushed * dt, 0.0)
    return rows, 2


@nb.njit(cache=True)
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


# --- judgement ----------------------------------------------------------------------------------------------------


def _judge(
    law: Controller, rows: Floats, path: FollowedPath, truth: FollowedPath, vehicle: Vehicle, ended: str
) -> SteeringCheck:
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
        time_s, front, rear, heading_deg, speed, rows[:, 4], steer_deg, rows[:, 6], rows[:, 7], errors[:, 0],
    )  # fmt: skip
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
        lateral_acceleration_m_s2=float(lateral.max()),
        mean_speed_m_s=float(speed.mean()),
        excess_speed_m_s=max(float(np.max(speed - rows[:, 4])), 0.0),
        distance_m=float(weights.sum()),
        duration_s=len(rows) * STEP_S,
        completed=ended == "reached the end",
        ended=ended,
        trace=trace,
    )


def _nearest_start(line: FollowedPath, point: Floats) -> int:
    away = np.sum((line.position_enu_m - point) ** 2, axis=1)
    return min(int(away.argmin()), len(away) - 2)
