"""Simulate a drive: what is on the road, the vehicle and how it is driven, and what the bar records."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import scipy

from app.markers.magnet import MOMENT_AM2, Orientation, Polarity
from app.sensors.magnetometer_bar import MagnetometerBar, MagnetTrace
from app.simulation.magnetic.clutter import Clutter, dipole_clutter, place_clutter, spheroid_clutter
from app.simulation.magnetic.dipoles import Cylinder, add_static_field, cylinder_dipoles, dipole_field_ut
from app.simulation.magnetic.recorder import CanBus, Chip
from app.simulation.magnetic.road import PlacedTag, Road, RoadMagnet, Spread, place_magnets, tag_magnets
from app.values import Floats

# === How a vehicle moves over the road: speed, path, springs, and its magnetised wheels.


MPH = 0.44704
"""A mile per hour. [m/s] Source: international mile of 1609.344 m."""
_STEP_S = 0.005  # [s] of the motion; well below the 9 to 13 Hz of the axle


@dataclass(frozen=True, slots=True)
class Wheel:
    """A front wheel as dipoles in its belt, which turn with it: many harmonics of its rotation."""

    axle_m: tuple[float, float, float]  # [m] middle of the wheel in the vehicle frame
    radius_m: float = 0.31  # [m] of the belt and of rolling
    moment_am2: float = 0.15  # [A m2] Typical moment of each of the dipoles
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
    """A car with a bar under its front bumper."""

    bar: MagnetometerBar
    clearance_m: float = 0.16  # [m] of the array above the road at rest
    wheels: tuple[Wheel, ...] = ()
    roughness: float = 1.0  # 1 an ordinary road, 3 a rough one: scales pitch, roll and bounce
    pitch_centre_m: float = 1.9  # [m] distance from the bar back to the axis of pitch

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
    """How it is driven."""

    speed_m_s: float = 30 * MPH  # [m/s] Cruising speed
    # speeds to reach at chainages, linear in between; overrides the cruising speed. [m, m/s]
    speeds: Sequence[tuple[float, float]] = ()
    hunting: float = 0.01  # standard deviation of slow changes of speed, share of it
    left_m: float = 0.0  # [m] offset from the lane's centre
    lefts: Sequence[tuple[float, float]] = ()  # [m] offsets at chainages, smooth in between; added to the offset
    # `weave_m`, `weave_period_s`: Amplitude and period of weaving. [m, s]
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


# === Simulate a drive: what is on the road, how it is driven, and what the bar records.


EARTH_UT = (0.0, 18.0, -51.0)
"""The earth's field in southern Michigan, east, north, up. [uT] Source: rounded by hand, without declination."""
_REACH_M, _FAR_M = 3.0, 14.0  # [m] reach of a magnet's and of a car's field; below 0.02 uT
_BLOCK = 8192  # samples that are rendered at a time; bounds the memory


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Everything about a drive but its noise."""

    road: Road
    vehicle: Vehicle
    course: Course = field(default_factory=Course)
    tags: Sequence[PlacedTag] = ()  # information tags
    lines: Sequence[RoadMagnet] = ()  # magnets of lines
    clutter: Sequence[Clutter] = ()
    spread: Spread = field(default_factory=Spread)
    chip: Chip = field(default_factory=Chip)
    can: CanBus = field(default_factory=CanBus)
    # driven against the direction of legal travel: chainages then count along the drive, and tags are met backwards
    wrong_way: bool = False
    earth_ut: tuple[float, float, float] = EARTH_UT
    moment_am2: float = MOMENT_AM2
    magnet_shape: Cylinder | None = None  # size of the magnets; None for point dipoles
    # clutter of spheroids that the earth's field magnetises in place of dipoles
    spheroid_iron: bool = False


@dataclass(frozen=True, slots=True)
class TrueMagnet:
    """A magnet when the bar is over it."""

    t_s: float  # [s] time at which it is level with the bar
    lateral_cm: float  # [cm] on the bar, left positive
    polarity: Polarity  # as the driver meets it: flipped for phi = 0 on the wrong way
    orientation: Orientation
    tag: int
    # `speed_m_s`, `clearance_m`: at that time. [m/s, m]
    speed_m_s: float
    clearance_m: float


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedDrive:
    """A trace and what is true of it."""

    trace: MagnetTrace
    magnets: tuple[TrueMagnet, ...]
    tags: tuple[PlacedTag, ...]
    length_m: float


def simulate_drive(scene: Scene, rng: np.random.Generator) -> SimulatedDrive:
    """Render a drive over the whole road.

    Parameters
    ----------
    rng : numpy.random.Generator
        Draws placement, motion, sensors and noise.
    """
    road = scene.road
    tags = [_met(p) for p in scene.tags] if scene.wrong_way else list(scene.tags)
    magnets = [*tag_magnets(tags), *scene.lines]
    motion = drive_course(scene.course, scene.vehicle, road.length_m, rng)
    yaw = road.yaw_rad(motion.chainage_m) + motion.slip_rad
    dipoles, at = place_magnets(magnets, road, scene.spread, rng, moment_am2=scene.moment_am2)
    sources, sources_at = dipoles, at
    if scene.magnet_shape is not None:
        sources, sources_at = cylinder_dipoles(dipoles, at, scene.magnet_shape)
    draw = partial(spheroid_clutter, earth_ut=scene.earth_ut) if scene.spheroid_iron else dipole_clutter
    iron, iron_at = place_clutter(scene.clutter, road, rng, draw=draw)
    t = scene.chip.sample_times_s(motion.t_s[-1] - 0.05, rng)
    sensors = scene.vehicle.bar.sensor_count
    chip_axes = scene.chip.mixed_axes(scene.chip.axes(sensors, rng), rng)
    soft = np.eye(3) + rng.normal(0, scene.chip.soft_iron, (sensors, 3, 3))
    yaw_rate = np.gradient(yaw, motion.t_s)
    axis_t = scene.chip.true_times_s(t, rng)[:, None] + np.array(scene.chip.axis_delay_s)
    out = wheel_field_ut(scene.vehicle, motion, yaw_rate, axis_t, rng)
    out = np.einsum("saj,tsj->tsa", chip_axes, out) if out.any() else out
    order, iron_order = np.argsort(sources_at), np.argsort(iron_at)
    earth = np.array(scene.earth_ut)
    for start in range(0, len(t), _BLOCK):
        stop = min(start + _BLOCK, len(t))
        for axis in range(3):
            turn, points, along = _pose(scene, motion, yaw, axis_t[start:stop, axis])
            sensed = np.einsum("sj,tkj->tsk", chip_axes[:, axis], turn)  # the sensor's axis in the world
            through = np.einsum("sj,sjk,tlk->tsl", chip_axes[:, axis], soft, turn)
            part = through @ earth
            add_static_field(part, points, sensed, along, sources[order], sources_at[order], _REACH_M)
            add_static_field(part, points, sensed, along, iron[iron_order], iron_at[iron_order], _FAR_M)
            out[start:stop, :, axis] += part
    speed_t, speed = scene.can.speed(motion.t_s, motion.speed_m_s)
    heading_t, heading = scene.can.heading(motion.t_s, 90 - np.degrees(yaw))
    trace = MagnetTrace(t, scene.chip.read(out, rng), speed_t, speed, heading_t, heading)
    truth = _truth(scene, magnets, dipoles, at, motion, yaw)
    return SimulatedDrive(trace, truth, tuple(tags), float(motion.chainage_m[-1] - motion.chainage_m[0]))


def _met(placed: PlacedTag) -> PlacedTag:
    return replace(placed, tag=placed.tag.reversed_wrong_way())


def _pose(scene: Scene, motion: Motion, yaw: Floats, t: Floats) -> tuple[Floats, Floats, Floats]:
    """world_from_vehicle (T, 3, 3), sensors in the world (T, S, 3), chainage of the bar (T,)."""
    bar = scene.vehicle.bar
    ahead = float(np.mean(bar.positions_m[bar.array, 0]))
    low = float(np.mean(bar.positions_m[bar.array, 2]))
    chainage = np.interp(t, motion.t_s, motion.chainage_m)
    place = scene.road.world_m(chainage, np.interp(t, motion.t_s, motion.left_m))
    a, p, r = (np.interp(t, motion.t_s, x) for x in (yaw, motion.pitch_rad, motion.roll_rad))
    ca, sa, cp, sp, cr, sr = np.cos(a), np.sin(a), np.cos(p), np.sin(p), np.cos(r), np.sin(r)
    turn = np.empty((len(t), 3, 3))
    turn[:, 0] = np.stack([ca * cp, ca * sp * sr - sa * cr, ca * sp * cr + sa * sr], 1)
    turn[:, 1] = np.stack([sa * cp, sa * sp * sr + ca * cr, sa * sp * cr - ca * sr], 1)
    turn[:, 2] = np.stack([-sp, cp * sr, cp * cr], 1)
    height = scene.vehicle.clearance_m + np.interp(t, motion.t_s, motion.heave_m)
    lever = bar.positions_m - (ahead, 0.0, low)
    points = np.einsum("tij,sj->tsi", turn, lever)
    points[:, :, 0] += (place[:, 0] + ahead * ca)[:, None]
    points[:, :, 1] += (place[:, 1] + ahead * sa)[:, None]
    points[:, :, 2] += height[:, None]
    return turn, points, chainage + ahead


def _truth(
    scene: Scene, magnets: Sequence[RoadMagnet], dipoles: Floats, at: Floats, motion: Motion, yaw: Floats
) -> tuple[TrueMagnet, ...]:
    """When the bar is level with each magnet, and where on it."""
    bar = scene.vehicle.bar
    ahead = float(np.mean(bar.positions_m[bar.array, 0]))
    place = scene.road.world_m(motion.chainage_m, motion.left_m)
    found = []
    for magnet, dipole, chainage in zip(magnets, dipoles, at, strict=True):
        low = max(int(np.searchsorted(motion.chainage_m, chainage - ahead - 4)), 0)
        high = int(np.searchsorted(motion.chainage_m, chainage - ahead + 4))
        if high - low < 3:
            continue
        east, north = (dipole[:2] - place[low:high]).T
        c, s = np.cos(yaw[low:high]), np.sin(yaw[low:high])
        forward = c * east + s * north - ahead
        if not (forward[0] > 0 > forward[-1]):
            continue
        k = int(np.flatnonzero(forward > 0)[-1])
        share = forward[k] / (forward[k] - forward[k + 1])
        left = -s * east + c * north
        i = low + k
        found.append(
            TrueMagnet(
                t_s=float(motion.t_s[i] + share * (motion.t_s[i + 1] - motion.t_s[i])),
                lateral_cm=100 * float(left[k] + share * (left[k + 1] - left[k])),
                polarity=magnet.polarity,
                orientation=magnet.orientation,
                tag=magnet.tag,
                speed_m_s=float(motion.speed_m_s[i]),
                clearance_m=scene.vehicle.clearance_m + float(motion.heave_m[i]),
            )
        )
    return tuple(sorted(found, key=lambda m: m.t_s))
