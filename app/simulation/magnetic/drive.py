"""Simulate a drive: what is on the road, how it is driven, and what the bar records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import numpy.typing as npt

from app.markers.magnet import MOMENT_AM2, Orientation, Polarity
from app.sensors.magnetometer_bar import MagnetTrace
from app.simulation.magnetic.clutter import Clutter, dipole_clutter, place_clutter
from app.simulation.magnetic.cylinders import Cylinder, cylinder_dipoles
from app.simulation.magnetic.dipoles import add_static_field
from app.simulation.magnetic.readout import CanBus, Chip
from app.simulation.magnetic.road import PlacedTag, Road, RoadMagnet, Spread, place_magnets, tag_magnets
from app.simulation.magnetic.spheroid_clutter import spheroid_clutter
from app.simulation.magnetic.vehicle import Course, Motion, Vehicle, drive_course, wheel_field_ut

Floats = npt.NDArray[np.float64]

EARTH_UT = (0.0, 18.0, -51.0)
"""The earth's field in southern Michigan, east, north, up. [uT] Source: rounded by hand, without declination."""
_REACH_M, _FAR_M = 3.0, 14.0  # [m] reach of a magnet's and of a car's field; source: by hand, below 0.02 uT
_BLOCK = 8192  # samples that are rendered at a time; bounds the memory


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Everything about a drive but its noise.

    Attributes
    ----------
    road : Road
    tags : sequence of PlacedTag
        Information tags.
    lines : sequence of RoadMagnet
        Magnets of lines.
    clutter : sequence of Clutter
    wrong_way : bool
        Driven against the direction of legal travel: chainages then count along the drive, and tags are met backwards.
    magnet_shape : Cylinder or None
        Size of the magnets; None for point dipoles.
    spheroid_iron : bool
        Clutter of spheroids that the earth's field magnetises (`spheroid_clutter`) in place of dipoles.
    """

    road: Road
    vehicle: Vehicle
    course: Course = field(default_factory=Course)
    tags: Sequence[PlacedTag] = ()
    lines: Sequence[RoadMagnet] = ()
    clutter: Sequence[Clutter] = ()
    spread: Spread = field(default_factory=Spread)
    chip: Chip = field(default_factory=Chip)
    can: CanBus = field(default_factory=CanBus)
    wrong_way: bool = False
    earth_ut: tuple[float, float, float] = EARTH_UT
    moment_am2: float = MOMENT_AM2
    magnet_shape: Cylinder | None = None
    spheroid_iron: bool = False


@dataclass(frozen=True, slots=True)
class TrueMagnet:
    """A magnet when the bar is over it.

    Attributes
    ----------
    t_s : float
        Time at which it is level with the bar. [s]
    lateral_cm : float
        On the bar, left positive. [cm]
    polarity : Polarity
        As the driver meets it: flipped for phi = 0 on the wrong way.
    speed_m_s, clearance_m : float
        At that time. [m/s, m]
    """

    t_s: float
    lateral_cm: float
    polarity: Polarity
    orientation: Orientation
    tag: int
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
    scene : Scene
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
    return PlacedTag(placed.tag.reversed_wrong_way(), placed.chainage_m, placed.left_m)


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
