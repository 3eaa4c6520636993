"""How a vehicle moves over the road: speed, path, springs, and its magnetised wheels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import scipy

from app.sensors.magnetometer_bar import MagnetometerBar
from app.simulation.magnetic.dipoles import dipole_field_ut

Floats = npt.NDArray[np.float64]

MPH = 0.44704
"""A mile per hour. [m/s] Source: international mile of 1609.344 m."""
_STEP_S = 0.005  # [s] of the motion; source: by hand, well below the 9 to 13 Hz of the axle


@dataclass(frozen=True, slots=True)
class Wheel:
    """A front wheel as dipoles in its belt, which turn with it: many harmonics of its rotation.

    Attributes
    ----------
    axle_m : tuple of float
        Middle of the wheel in the vehicle frame. [m]
    radius_m : float
        Of the belt and of rolling. [m]
    moment_am2 : float
        Typical moment of each of the dipoles. [A m2]
    dipoles : int
    """

    axle_m: tuple[float, float, float]
    radius_m: float = 0.31
    moment_am2: float = 0.15
    dipoles: int = 5

    def table_ut(self, points_m: Floats, rng: np.random.Generator, size: int = 1024) -> Floats:
        """Field at points of the vehicle over one turn, shape (size, N, 3). [uT]"""
        turn = np.arange(size) * 2 * np.pi / size
        table = np.zeros((size, len(points_m), 3))
        for _ in range(self.dipoles):
            start, left = rng.uniform(0, 2 * np.pi), rng.normal(0, 0.06)
            moment = rng.normal(0, self.moment_am2, 3)  # radial, along the axle, tangential
            for k, a in enumerate(turn + start):
                place = np.array(self.axle_m) + self.radius_m * np.array([math.sin(a), 0, math.cos(a)]) + (0, left, 0)
                m = moment[0] * np.array([math.sin(a), 0, math.cos(a)]) + moment[2] * np.array(
                    [math.cos(a), 0, -math.sin(a)]
                )
                m[1] = moment[1]
                table[k] += dipole_field_ut(points_m, place, m)
        return table


@dataclass(frozen=True, slots=True)
class Vehicle:
    """A car with a bar under its front bumper.

    Attributes
    ----------
    bar : MagnetometerBar
    clearance_m : float
        Of the array above the road at rest. [m]
    wheels : tuple of Wheel
    roughness : float
        1 an ordinary road, 3 a rough one: scales pitch, roll and bounce.
    pitch_centre_m : float
        Distance from the bar back to the axis of pitch. [m]
    """

    bar: MagnetometerBar
    clearance_m: float = 0.16
    wheels: tuple[Wheel, ...] = ()
    roughness: float = 1.0
    pitch_centre_m: float = 1.9

    @classmethod
    def compact(
        cls, *, clearance_m: float = 0.16, roughness: float = 1.0, wheel_moment_am2: float = 0.15,
        bar: MagnetometerBar | None = None,
    ) -> Vehicle:  # fmt: skip
        """A compact car; METRO's bar 55 cm ahead of the front axle, a reference in each wheel well."""
        bar = bar or MagnetometerBar.metro(forward_m=3.2)
        ahead = float(np.mean(bar.positions_m[bar.array, 0]))
        low = float(np.mean(bar.positions_m[bar.array, 2]))
        axle = (ahead - 0.55, 0.76, low + 0.31 - clearance_m)
        wheels = tuple(
            Wheel((axle[0], side * axle[1], axle[2]), 0.31 * (1 + 0.003 * side), wheel_moment_am2) for side in (1, -1)
        )
        return cls(bar, clearance_m, wheels if wheel_moment_am2 else (), roughness)


@dataclass(frozen=True, slots=True)
class Course:
    """How it is driven.

    Attributes
    ----------
    speed_m_s : float
        Cruising speed. [m/s]
    speeds : sequence of (chainage_m, speed_m_s)
        Speeds to reach at chainages, linear in between; overrides the cruising speed. [m, m/s]
    hunting : float
        Standard deviation of slow changes of speed, share of it.
    left_m : float
        Offset from the lane's centre. [m]
    lefts : sequence of (chainage_m, left_m)
        Offsets at chainages, smooth in between; added to the offset. [m]
    weave_m, weave_period_s : float
        Amplitude and period of weaving. [m, s]
    """

    speed_m_s: float = 30 * MPH
    speeds: Sequence[tuple[float, float]] = ()
    hunting: float = 0.01
    left_m: float = 0.0
    lefts: Sequence[tuple[float, float]] = ()
    weave_m: float = 0.05
    weave_period_s: float = 9.0


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """A drive, every 5 ms: time, chainage and offset of the origin, speed, direction, attitude, height of the bar."""

    t_s: Floats
    chainage_m: Floats
    left_m: Floats
    speed_m_s: Floats
    slip_rad: Floats = field(repr=False)
    pitch_rad: Floats = field(repr=False)
    roll_rad: Floats = field(repr=False)
    heave_m: Floats = field(repr=False)


def drive_course(course: Course, vehicle: Vehicle, length_m: float, rng: np.random.Generator) -> Motion:
    """The motion over a length of lane, at least 0.5 m/s fast."""
    step_m = 0.1
    at = np.arange(0, length_m, step_m)
    speed = np.full(at.size, course.speed_m_s)
    if course.speeds:
        speed = np.interp(at, *np.array(course.speeds, float).T)
    rough = rng.standard_normal(at.size)
    slow = scipy.signal.sosfilt(scipy.signal.butter(2, 1 / 60.0, fs=1 / step_m, output="sos"), rough)
    speed = np.maximum(speed * (1 + course.hunting * slow / max(slow.std(), 1e-9)), 0.5)
    time = np.concatenate([[0], np.cumsum(2 * step_m / (speed[1:] + speed[:-1]))])
    t = np.arange(0, time[-1], _STEP_S)
    chainage = np.interp(t, time, at)
    v = np.gradient(chainage, _STEP_S)
    left = np.full(t.size, course.left_m)
    if course.lefts:
        knots = np.array(course.lefts, float)
        left = left + _smooth_steps(chainage, knots)
    left += course.weave_m * np.sin(2 * np.pi * t / course.weave_period_s + rng.uniform(0, 2 * np.pi))
    acceleration = np.gradient(_lowpass(v, 2.0), _STEP_S)
    r = vehicle.roughness
    pitch = np.radians(-0.35 * acceleration + _band(t, 1.0, 2.2, 0.2 * r, rng))
    roll = np.radians(_band(t, 0.8, 2.0, 0.15 * r, rng))
    heave = _band(t, 1.0, 2.2, 0.004 * r, rng) + _band(t, 9.0, 13.0, 0.001 * r, rng)
    heave -= vehicle.pitch_centre_m * np.sin(pitch)
    heave = np.maximum(heave, 0.04 - vehicle.clearance_m)
    return Motion(t, chainage, left, v, np.arctan2(np.gradient(left, _STEP_S), v), pitch, roll, heave)


def _smooth_steps(x: Floats, knots: Floats) -> Floats:
    i = np.clip(np.searchsorted(knots[:, 0], x) - 1, 0, len(knots) - 2) if len(knots) > 1 else np.zeros(x.size, int)
    if len(knots) == 1:
        return np.full(x.size, knots[0, 1])
    u = np.clip((x - knots[i, 0]) / (knots[i + 1, 0] - knots[i, 0]), 0, 1)
    smooth: Floats = knots[i, 1] + (knots[i + 1, 1] - knots[i, 1]) * u * u * (3 - 2 * u)
    return smooth


def _lowpass(x: Floats, corner_hz: float) -> Floats:
    padding = min(300, x.size - 2)
    return np.asarray(
        scipy.signal.sosfiltfilt(
            scipy.signal.butter(2, corner_hz, fs=1 / _STEP_S, output="sos"), x, padlen=max(padding, 0)
        )
    )


def _band(t: Floats, low_hz: float, high_hz: float, std: float, rng: np.random.Generator) -> Floats:
    lead = 400
    filtered = scipy.signal.sosfilt(
        scipy.signal.butter(2, (low_hz, high_hz), "band", fs=1 / _STEP_S, output="sos"),
        rng.standard_normal(t.size + lead),
    )
    return np.asarray(filtered[lead:] * std / max(float(filtered.std()), 1e-12))


def wheel_field_ut(vehicle: Vehicle, motion: Motion, yaw_rate: Floats, t_s: Floats, rng: np.random.Generator) -> Floats:
    """Field of the wheels at each sensor, in vehicle axes; t_s has shape (T, 3), one time for each axis. [uT]"""
    out = np.zeros((len(t_s), vehicle.bar.sensor_count, 3))
    for wheel in vehicle.wheels:
        table = wheel.table_ut(vehicle.bar.positions_m, rng)
        rolling = motion.speed_m_s - yaw_rate * wheel.axle_m[1]
        angle = np.concatenate([[0], np.cumsum((rolling[1:] + rolling[:-1]) / 2 * _STEP_S)]) / wheel.radius_m
        for axis in range(3):
            at = np.interp(t_s[:, axis], motion.t_s, angle) / (2 * np.pi) * len(table) % len(table)
            low = at.astype(int)
            share = (at - low)[:, None]
            out[:, :, axis] += (1 - share) * table[low, :, axis] + share * table[(low + 1) % len(table), :, axis]
    return out
