"""Bars that are mounted, wired or working otherwise than declared: drives with a fault each, and healthy ones."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from app.markers.magnet import Polarity
from app.sensors.magnetometer_bar import MagnetometerBar, MagnetTrace
from app.simulation.magnetic.clutter import ferrous_clutter, town_clutter
from app.simulation.magnetic.drive import MPH, Course, Scene, SimulatedDrive, Vehicle, simulate_drive
from app.simulation.magnetic.road import PlacedTag, Road, line_magnets
from app.values import Floats
from benchmarks.magnets.drawn_scenes import FORMAT, draw_vehicle
from benchmarks.magnets.scenes import LEAD_M, random_magnets, random_tag

BAR = MagnetometerBar.metro(forward_m=3.2)
CLEARANCES_M = (0.16, 0.20, 0.25, 0.30)
SPEEDS_MPH = (15.0, 60.0)
RADII_M = (30.0, 120.0)
"""Of bends. [m] Both sharp turns in a town and wide ones."""


# === Roads.


def draw_road_drive(
    rng: np.random.Generator, *, turning: bool, bar: MagnetometerBar = BAR, magnets: int = 24, tags: int = 5,
    iron: str = "",
) -> SimulatedDrive:  # fmt: skip
    """Single magnets, tags, and a line that begins beside the tags, at any speed and one of four clearances."""
    spacing_m = float(rng.uniform(2.5, 5.0))
    singles = random_magnets(rng, magnets, spacing_m)
    first_m = LEAD_M + magnets * spacing_m + 10
    placed = [PlacedTag(random_tag(rng, FORMAT), first_m + 12 * k, float(rng.uniform(-0.2, 0.2))) for k in range(tags)]
    length_m = first_m + 12 * tags + 20
    lines = line_magnets(first_m, length_m - 15, 6.0, float(rng.choice((-0.8, 0.8))), Polarity.N) if magnets else []
    bends = []
    if turning:
        radius_m = float(rng.choice((-1, 1)) * rng.uniform(*RADII_M))
        turn_m = abs(radius_m) * math.radians(float(rng.uniform(70, 110)))
        start_m = float(rng.uniform(20, 60))
        bends = [(start_m, min(start_m + turn_m, length_m), radius_m)]
    clutter = []
    if iron == "town":
        clutter = town_clutter(LEAD_M, length_m, rng)
    elif iron:
        clutter = ferrous_clutter(LEAD_M + 5, length_m, 20, rng)
    vehicle = replace(draw_vehicle(rng, float(rng.choice(CLEARANCES_M))), bar=bar)
    top_mph = min(SPEEDS_MPH[1], math.sqrt(4 * abs(bends[0][2])) / MPH) if bends else SPEEDS_MPH[1]
    course = Course(float(rng.uniform(SPEEDS_MPH[0], max(top_mph, SPEEDS_MPH[0] + 1))) * MPH, weave_m=0.08)
    road = Road(length_m, bends, heading_deg=float(rng.uniform(0, 360)))
    return simulate_drive(Scene(road, vehicle, course, tags=placed, lines=[*singles, *lines], clutter=clutter), rng)


# === Faults.


def yaw_matrix(angle_deg: float) -> Floats:
    """Rotation about z."""
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def turned_bar(rotation: Floats) -> MagnetometerBar:
    """METRO's bar turned about its middle, with its references as they are."""
    positions = BAR.positions_m.copy()
    middle = positions[BAR.array].mean(axis=0)
    positions[BAR.array] = middle + (positions[BAR.array] - middle) @ rotation.T
    return replace(BAR, positions_m=positions)


def _with_signs(trace: MagnetTrace, sensors: np.ndarray, signs: tuple[float, float, float]) -> MagnetTrace:
    field = trace.field_ut.copy()
    field[:, sensors] *= np.array(signs, np.float32)
    return replace(trace, field_ut=field)


def _ordered(trace: MagnetTrace, order: list[int]) -> MagnetTrace:
    return replace(trace, field_ut=np.ascontiguousarray(trace.field_ut[:, order]))


def _rotated(trace: MagnetTrace, rotation: Floats) -> MagnetTrace:
    """As chips on a bar read that is turned by a rotation."""
    field = trace.field_ut.copy()
    field[:, BAR.array] = field[:, BAR.array] @ rotation.astype(np.float32)
    return replace(trace, field_ut=field)


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of a bar."""

    name: str
    spoil: Callable[[MagnetTrace, np.random.Generator], MagnetTrace]
    named: str  # part of the mistake's name that counts as naming it
    rotation: Floats | None = None  # of the bar, if it is turned


def _one(rng: np.random.Generator) -> np.ndarray:
    return np.array([rng.choice(BAR.array)])


def _swap(trace: MagnetTrace, rng: np.random.Generator) -> MagnetTrace:
    by_place = BAR.array[np.argsort(BAR.positions_m[BAR.array, 1])]
    k = int(rng.integers(len(by_place) - 1))
    order = list(range(BAR.sensor_count))
    a, b = int(by_place[k]), int(by_place[k + 1])
    order[a], order[b] = b, a
    return _ordered(trace, order)


def _scaled(trace: MagnetTrace, rng: np.random.Generator) -> MagnetTrace:
    return _with_signs(trace, _one(rng), (1.5, 1.5, 1.5))


def _dead(trace: MagnetTrace, rng: np.random.Generator) -> MagnetTrace:
    """A sensor that sends noise, or the same values all the time."""
    field, sensor = trace.field_ut.copy(), int(_one(rng)[0])
    noise = rng.normal(0, 1.5, field[:, sensor].shape) if rng.random() < 0.5 else 0.0
    field[:, sensor] = field[0, sensor] + noise
    return replace(trace, field_ut=field)


def _any_sign(trace: MagnetTrace, rng: np.random.Generator, inverted: int) -> MagnetTrace:
    signs = np.ones(3)
    signs[rng.choice(3, inverted, replace=False)] = -1
    return _with_signs(trace, _one(rng), tuple(signs))


_LEFT, _RIGHT = [0, 1, 2, 3, 4, 5], [7, 8, 9, 10, 11, 12]
_BACKWARDS = [*_RIGHT, 6, *_LEFT, 13]
"""Array sensors from left to right in place of right to left; the references are in their places."""


def _turned(degrees: float) -> Fault:
    rotation = yaw_matrix(degrees)
    return Fault(f"bar turned by {degrees:g} degrees", lambda t, _r: _rotated(t, rotation), "turned by", rotation)


FAULTS = (
    Fault("one sensor upside down", lambda t, r: _any_sign(t, r, 2), "sensor"),
    Fault("one axis of one sensor inverted", lambda t, r: _any_sign(t, r, 1), "sensor"),
    _turned(3), _turned(8), _turned(15),
    Fault("sensor order reversed", lambda t, _r: _ordered(t, list(range(14))[::-1]), "order"),
    Fault("left and right exchanged", lambda t, _r: _ordered(t, _BACKWARDS), "left"),
    Fault("halves mirrored", lambda t, _r: _ordered(t, [*_LEFT[::-1], 6, *_RIGHT[::-1], 13]), "half"),
    Fault("neighbouring cables swapped", _swap, "exchanged"),
    Fault("x and z inverted", lambda t, _r: _with_signs(t, np.arange(14), (-1, 1, -1)), "inverted"),
    Fault("y and z inverted", lambda t, _r: _with_signs(t, np.arange(14), (1, -1, -1)), "FRD"),
    Fault("one sensor dead", _dead, "sensor"),
    Fault("one sensor scaled by 1.5", _scaled, "times"),
    Fault("bar mounted backwards", lambda t, _r: _with_signs(_ordered(t, _BACKWARDS), BAR.array, (-1, -1, 1)), "backwards"),
)  # fmt: skip


def draw_faulty_drive(fault: Fault, rng: np.random.Generator, *, turning: bool) -> SimulatedDrive:
    """A drive that a faulty bar recorded; the true magnets are as on a healthy one."""
    bar = BAR if fault.rotation is None else turned_bar(fault.rotation)
    drive = draw_road_drive(rng, turning=turning, bar=bar)
    return replace(drive, trace=fault.spoil(drive.trace, rng))
