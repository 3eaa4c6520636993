"""Steering along a decoded path: the path on an even grid, speed planning, and control laws.

Angles inside are counter-clockwise from east, steering to the left positive, as in the ENU frame. A law takes the pose
of the front axle's centre; only `predict_pose` models how a vehicle moves, to compensate for its delays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt
import scipy

from app.compiled import ieee_kernel
from app.errors import InvalidParameter
from app.values import Floats

STEP_M = 0.25  # [m] between points of a followed path; source: 0.1 m driven a step at 36 km/h, 2 steps a point
SHORTEST_M, LONGEST_M = 10.0, 100_000.0  # [m] of a path
MAX_GAP_M = 25.0  # [m] between points of a path; source: two spacings of 40 ft, 24.4 m
MAX_TURN_DEG = 40.0  # [deg] from one metre to the next; a car's tightest circle of 5 m turns by 11
_TURN_OVER_M = 1.0  # [m] source: the stations of decoded paths
_HEADING_OVER_M = 1.0  # [m] to both sides; source: the stations of decoded paths
_CURVATURE_OVER_M = 3.0  # [m] to both sides; about a wheelbase
_SAME_POINT_M = 1e-6  # [m] source: below every accuracy, above rounding
_MIN_SPEED_M_S = 1.0  # [m/s] slower is steered as at this speed, by which equation 4 divides
_PIECES_BEHIND, _PIECES_AHEAD = 8, 40  # of the path that are searched: 2 m and 10 m


class Controller(StrEnum):
    """A law that steers.

    ``stanley`` is equation 4 of the CERPM paper, ``stanley-lookahead`` its equation 5. ``predictive`` is equation 4 at
    the pose where the vehicle will be when the command takes effect, and a slow integral for wheels that stand askew.
    ``mpc`` is model predictive control (`app.lanes.mpc`), with the same prediction and integral.
    """

    STANLEY = "stanley"
    STANLEY_LOOKAHEAD = "stanley-lookahead"
    PREDICTIVE = "predictive"
    MPC = "mpc"


@dataclass(frozen=True, slots=True)
class SteeringSettings:
    """Assumptions and gains of a controller."""

    # [1/s] k of equations 4 and 5
    gain_per_s: float = 1.0  # [1/s] `suited_to`
    # [m] d_l of equation 5
    lookahead_m: float = 15.0  # [m] source: CERPM paper, section 2.3.2
    # `latency_s`, `lag_s`, `wheelbase_m`: of the vehicle, as assumed by the predictive controllers. [s, s, m]
    latency_s: float = 0.12  # [s] source: `simulation.steering.Vehicle`
    lag_s: float = 0.10  # [s] source: `simulation.steering.Vehicle`
    wheelbase_m: float = 2.70  # [m] source: Kia Niro, the paper's car
    # [rad/(m s)] steering of the predictive controllers per integrated cross-track error
    integral_per_m_s: float = 0.06  # [rad/(m s)]
    # of model predictive control: limits of the front wheels; horizon; weights of lateral velocity and of lateral jerk
    # beside the cross-track error
    max_steer_deg: float = 32.0  # [deg] source: `simulation.steering.Vehicle`
    max_steer_rate_deg_s: float = 30.0  # [deg/s] source: `simulation.steering.Vehicle`
    horizon_s: float = 1.0  # [s]
    velocity_weight_s: float = 0.3  # [s]
    jerk_weight_s3: float = 0.015  # [s3]

    def __post_init__(self) -> None:
        for name, low, high in (
            ("gain_per_s", 0.01, 20.0), ("lookahead_m", 0.0, 100.0), ("latency_s", 0.0, 0.5), ("lag_s", 0.0, 1.0),
            ("wheelbase_m", 0.5, 20.0), ("integral_per_m_s", 0.0, 1.0), ("max_steer_deg", 1.0, 60.0),
            ("max_steer_rate_deg_s", 1.0, 500.0), ("horizon_s", 0.2, 5.0), ("velocity_weight_s", 0.0, 10.0),
            ("jerk_weight_s3", 1e-4, 10.0),
        ):  # fmt: skip
            check_range(getattr(self, name), low, high, f"settings.{name}")

    @classmethod
    def suited_to(cls, controller: Controller) -> SteeringSettings:
        """Gains chosen by hand for bends at 40 km/h; the paper does not print its own."""
        gains = {
            Controller.STANLEY: 1.0,
            Controller.STANLEY_LOOKAHEAD: 0.2,
            Controller.PREDICTIVE: 2.0,
            Controller.MPC: 1.0,
        }
        return cls(gain_per_s=gains[controller])


@dataclass(frozen=True, slots=True, eq=False)
class FollowedPath:
    """A path on an even grid of its length."""

    position_enu_m: Floats  # shape (N, 2): [m] east, north
    heading_rad: Floats  # shape (N,): [rad] Counter-clockwise from east, without jumps, from chords of two metres
    curvature_per_m: Floats  # shape (N,): [1/m] from headings six metres apart; bends to the left positive
    # `step_m`, `length_m`: [m] between points, and in all
    step_m: float
    length_m: float


def check_range(value: float, low: float, high: float, field: str) -> None:
    """Raises InvalidParameter if a number is not finite or out of range."""
    if not (math.isfinite(value) and low <= value <= high):
        raise InvalidParameter(f"{field} is {value}", field=field, limit=f"{low:g} to {high:g}")


def follow_path(path_enu_m: npt.ArrayLike, *, field: str = "path_enu_m") -> FollowedPath:
    """Resample a path on an even grid, if it can be driven along.

    Parameters
    ----------
    path_enu_m : array_like, shape (S, 2)
        East, north in the direction of travel; repeated points are ignored. [m]
    field : str
        Its name in errors.

    Raises
    ------
    InvalidParameter
        It is not finite, shorter than 10 m, has no point for more than 25 m, or turns by more than 40 degrees from
        one metre to the next, as it does where it jumps or runs back.
    """
    points = np.asarray(path_enu_m, float)
    if points.ndim != 2 or points.shape[1] != 2:
        raise InvalidParameter(f"{field} has shape {points.shape}", field=field, limit="east and north per point")
    if not np.isfinite(points).all():
        raise InvalidParameter(f"{field} has a point that is not finite", field=field, limit="finite numbers")
    steps = np.hypot(*np.diff(points, axis=0).T)
    kept = np.r_[True, steps > _SAME_POINT_M][: len(points)]
    points = points[kept]
    steps = np.hypot(*np.diff(points, axis=0).T)
    chainage = np.concatenate(([0.0], np.cumsum(steps)))
    length = float(chainage[-1])
    if not SHORTEST_M <= length <= LONGEST_M:
        raise InvalidParameter(
            f"{field} is {length:.1f} m long",
            field=field,
            limit=f"{SHORTEST_M:g} to {LONGEST_M:g} m",
            cure="decode a longer stretch of the lane",
        )
    if steps.max() > MAX_GAP_M:
        at = chainage[int(steps.argmax())]
        raise InvalidParameter(
            f"{field} has no point for {steps.max():.1f} m from {at:.1f} m on",
            field=field,
            limit=f"{MAX_GAP_M:g} m",
            cure="leave out unknown stretches of the path, or split it there",
        )
    count = max(round(length / STEP_M), 1) + 1
    grid = np.linspace(0.0, length, count)
    even = np.column_stack([np.interp(grid, chainage, points[:, k]) for k in (0, 1)])
    step_m = length / (count - 1)
    _check_turns(points, chainage, field)
    heading = _chord_headings(even, max(round(_HEADING_OVER_M / step_m), 1))
    reach = max(round(_CURVATURE_OVER_M / step_m), 1)
    low, high = np.maximum(np.arange(count) - reach, 0), np.minimum(np.arange(count) + reach, count - 1)
    curvature = (heading[high] - heading[low]) / ((high - low) * step_m)
    return FollowedPath(even, heading, curvature, step_m, length)


def _check_turns(points: Floats, chainage: Floats, field: str) -> None:
    pieces = max(int(chainage[-1] / _TURN_OVER_M), 2)
    at = np.linspace(0.0, chainage[-1], pieces + 1)
    chords = np.column_stack([np.diff(np.interp(at, chainage, points[:, k])) for k in (0, 1)])
    turned = np.arctan2(
        chords[:-1, 0] * chords[1:, 1] - chords[:-1, 1] * chords[1:, 0], np.sum(chords[:-1] * chords[1:], axis=1)
    )
    worst = int(np.abs(turned).argmax())
    turn_deg = abs(math.degrees(turned[worst]))
    if turn_deg > MAX_TURN_DEG:
        raise InvalidParameter(
            f"{field} jumps: it turns by {turn_deg:.0f} degrees at {at[worst + 1]:.0f} m",
            field=field,
            limit=f"{MAX_TURN_DEG:g} deg from one metre to the next",
            cure="split the path there",
        )


def _chord_headings(points: Floats, reach: int) -> Floats:
    ends = np.arange(len(points))
    low, high = np.maximum(ends - reach, 0), np.minimum(ends + reach, len(points) - 1)
    chords = points[high] - points[low]
    headings: Floats = np.unwrap(np.arctan2(chords[:, 1], chords[:, 0]))
    return headings


def plan_speed(
    path: FollowedPath,
    path_enu_m: npt.ArrayLike,
    speed_limit_kmh: npt.ArrayLike,
    *,
    comfort_m_s2: float = 2.0,
    braking_m_s2: float = 1.5,
) -> Floats:
    """Speed to drive at along a path: the limit, or less in bends and before them.

    Parameters
    ----------
    path_enu_m : array_like, shape (S, 2)
        The points that `path` was made of.
    speed_limit_kmh : float or array_like, shape (S,)
        For the whole path, or at its points; holds from its point on. [km/h]
    comfort_m_s2 : float
        Lateral acceleration in bends. [m/s2]
    braking_m_s2 : float
        Slowing down ahead of a bend or a lower limit. [m/s2]

    Returns
    -------
    ndarray, shape (N,)
        [m/s]

    Raises
    ------
    InvalidParameter
        A limit is not from 5 to 250 km/h, or there is not one for each point.
    """
    limits, points = np.asarray(speed_limit_kmh, float), np.asarray(path_enu_m, float)
    if limits.ndim > 1 or (limits.ndim == 1 and len(limits) != len(points)):
        raise InvalidParameter(
            "there is not one speed limit for each point", field="speed_limit_kmh", limit="one, or one per point"
        )
    if not (np.isfinite(limits).all() and (limits >= 5).all() and (limits <= 250).all()):
        raise InvalidParameter("a speed limit is out of range", field="speed_limit_kmh", limit="5 to 250 km/h")
    count = len(path.heading_rad)
    if limits.ndim == 1:
        chainage = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))))
        holds = np.searchsorted(chainage, np.arange(count) * path.step_m + 1e-9, side="right") - 1
        limits = limits[np.clip(holds, 0, len(limits) - 1)]
    # curvature is an average over a window: a bend that begins within it counts with its full curvature
    curvature = scipy.ndimage.maximum_filter1d(
        np.abs(path.curvature_per_m), 2 * max(round(_CURVATURE_OVER_M / path.step_m), 1) + 1
    )
    speed = np.minimum(limits / 3.6, np.sqrt(comfort_m_s2 / np.maximum(curvature, 1e-9)))
    squares = (speed * np.ones(count)) ** 2
    rise = 2 * braking_m_s2 * path.step_m * np.arange(count)
    # v(s)^2 <= v(s')^2 + 2 a (s' - s) for all s' ahead
    slowed: Floats = np.sqrt(np.minimum.accumulate((squares + rise)[::-1])[::-1] - rise)
    return slowed


# --- laws ---------------------------------------------------------------------------------------------------------


@ieee_kernel
def nearest_on_path(points, x, y, last):  # type: ignore[no-untyped-def]
    """Piece of a path that is nearest to a point, share along it, and left offset of the point.

    Only pieces near the last result are searched; the first and the last piece are extended without end.

    Returns
    -------
    piece : int
    share : float
        Along the piece; below 0 and over 1 beyond the path's ends only.
    left : float
        Cross-track error, left positive. [m]
    """
    pieces = points.shape[0] - 1
    best, piece, share, left = np.inf, last, 0.0, 0.0
    for k in range(max(last - _PIECES_BEHIND, 0), min(last + _PIECES_AHEAD, pieces)):
        ax, ay = points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1]
        bx, by = x - points[k, 0], y - points[k, 1]
        square = ax * ax + ay * ay
        t = (ax * bx + ay * by) / square
        if t < 0.0 and k > 0:
            t = 0.0
        if t > 1.0 and k < pieces - 1:
            t = 1.0
        dx, dy = bx - t * ax, by - t * ay
        away = dx * dx + dy * dy
        if away < best:
            side = 1.0 if ax * by - ay * bx >= 0 else -1.0
            best, piece, share, left = away, k, t, side * math.sqrt(away)
    return piece, share, left


@ieee_kernel
def stanley_rad(points, headings, x, y, yaw, speed, gain, ahead, near, far):  # type: ignore[no-untyped-def]
    """Steering by equation 4, or with ``ahead`` > 0 by equation 5 of the CERPM paper.

    The heading error psi is taken at the point nearest to the front axle, the cross-track error where the axle's centre
    is after moving ahead along the heading. The paper counts errors towards the path, this module to the left of it:
    hence the minus sign.

    Parameters
    ----------
    points, headings : ndarray, shape (N, 2), (N,)
        Of the path. [m, rad]
    x, y, yaw, speed : float
        Of the front axle's centre. [m, m, rad, m/s]
    gain, ahead : float
        k [1/s] and d_l [m].
    near, far : int
        Pieces of the path that were nearest to the axle and to the point ahead.

    Returns
    -------
    steer : float
        Left positive. [rad]
    left : float
        Cross-track error of the front axle. [m]
    near, far : int
        For the next call.
    """
    near, share, left = nearest_on_path(points, x, y, near)
    share = min(max(share, 0.0), 1.0)
    heading = headings[near] * (1 - share) + headings[near + 1] * share
    psi = (heading - yaw + math.pi) % (2 * math.pi) - math.pi
    error = left
    if ahead > 0:
        far, _, error = nearest_on_path(points, x + ahead * math.cos(yaw), y + ahead * math.sin(yaw), far)
    return psi + math.atan(-gain * error / max(speed, _MIN_SPEED_M_S)), left, near, far


@ieee_kernel
def predict_pose(x, y, yaw, steer, speed, wheelbase, lag, pending, held, dt):  # type: ignore[no-untyped-def]
    """Pose and steering angle after all pending commands have reached the wheels.

    Parameters
    ----------
    x, y, yaw, steer, speed : float
        Rear axle, heading, angle of the front wheels, speed now. [m, m, rad, rad, m/s]
    wheelbase, lag, dt : float
        [m, s, s]
    pending : ndarray, shape (P,)
        Commands not yet received by the actuator, oldest first. [rad]
    held : int
        Number of steps for which the last of them is kept.
    """
    last = pending[-1] if len(pending) else steer
    share = dt / max(lag, dt)
    for k in range(len(pending) + held):
        command = pending[k] if k < len(pending) else last
        steer += share * (command - steer)
        turn = speed * math.tan(steer) / wheelbase * dt
        x += speed * dt * math.cos(yaw + turn / 2)
        y += speed * dt * math.sin(yaw + turn / 2)
        yaw += turn
    return x, y, yaw, steer
