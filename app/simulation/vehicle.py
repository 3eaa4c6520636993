"""A car as a kinematic bicycle whose steering has limits, a lag and a delay, and the errors of its poses."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.compiled import ieee_kernel
from app.lanes.control import check_range

Floats = npt.NDArray[np.float64]

STEP_S = 0.01  # [s] time step of simulation and controller; source: by hand, 100 Hz


@dataclass(frozen=True, slots=True)
class Vehicle:
    """Parameters of the car.

    Attributes
    ----------
    wheelbase_m : float
        [m]
    max_steer_deg, max_steer_rate_deg_s : float
        Of the front wheels. [deg, deg/s]
    steer_lag_s, latency_s : float
        Time constant of the wheels, and delay of a command. [s]
    steer_offset_deg : float
        Misalignment of the wheels, left positive. [deg]
    max_acceleration_m_s2, max_braking_m_s2, drive_lag_s : float
        Limits of speed control and its time constant.

    Notes
    -----
    Tyres do not slip: valid for comfortable driving (2 m/s2 sideways), not for emergencies.
    """

    wheelbase_m: float = 2.70  # [m] source: Kia Niro, the paper's car
    max_steer_deg: float = 32.0  # [deg] source: assumed, no measurement kept
    max_steer_rate_deg_s: float = 30.0  # [deg/s] source: assumed, no measurement kept
    steer_lag_s: float = 0.10  # [s] source: assumed, no measurement kept
    latency_s: float = 0.12  # [s] source: assumed, no measurement kept
    steer_offset_deg: float = 0.0
    max_acceleration_m_s2: float = 2.0  # [m/s2] source: assumed, comfortable driving
    max_braking_m_s2: float = 3.0  # [m/s2] source: assumed, comfortable driving
    drive_lag_s: float = 0.3  # [s] source: assumed, no measurement kept

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

    Attributes
    ----------
    drift_m, drift_over_s : float
        Standard deviation on each axis, and time constant of errors that change slowly. [m, s]
    jitter_m : float
        Standard deviation on each axis from one fix to the next. [m]
    heading_deg : float
        Standard deviation of the heading from one fix to the next. [deg]

    Notes
    -----
    By default 0.02 m in the plane, as stated for the paper's receiver: 0.014 m on each axis, most of it slow.
    """

    drift_m: float = 0.0135  # [m] source: the paper's receiver, 0.02 m in the plane
    drift_over_s: float = 20.0  # [s] source: assumed, no measurement kept
    jitter_m: float = 0.004  # [m] source: assumed, no measurement kept
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
