"""Drives whose vehicle, road and traffic are drawn from wide, physically bounded distributions, one from each seed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from app.decoders.magnet.identify import TagFormat
from app.markers.magnet import Polarity
from app.simulation.magnetic.clutter import ferrous_clutter, town_clutter
from app.simulation.magnetic.drive import MPH, Course, Scene, SimulatedDrive, Vehicle, Wheel, simulate_drive
from app.simulation.magnetic.road import PlacedTag, Road, line_magnets
from benchmarks.magnets.scenes import LEAD_M, random_magnets, random_tag

WHEEL_MOMENTS_AM2 = (0.01, 1.0)
"""Of a belt's dipoles, evenly drawn as logarithms. [A m2] Source: `Wheel` has 0.15; Table 1 of METRO needs about 1."""
WHEEL_RADII_M = (0.29, 0.37)
"""[m] Source: car and van tyres, rolling circumferences of 1.8 to 2.3 m."""
WHEEL_DIPOLES = (2, 8)
"""Dipoles in a belt. Source: by hand."""
ROUGHNESS = (0.3, 2.0)
"""Of the road. Source: `Vehicle`: 1 an ordinary road, 3 a rough one."""
SPEEDS_MPH = (10.0, 70.0)
"""[mph] Source: METRO section 7.3 and motorways."""
RADII_M = (60.0, 400.0)
"""Of bends, which half of the drives have. [m] Source: roundabouts are narrower, motorways wider."""
FORMAT = TagFormat(3, 4.0, 0.1)


def draw_vehicle(rng: np.random.Generator, clearance_m: float) -> Vehicle:
    """A vehicle with wheels of any strength, size and number of dipoles."""
    low, high = np.log10(WHEEL_MOMENTS_AM2)
    vehicle = Vehicle.compact(
        clearance_m=clearance_m,
        roughness=float(rng.uniform(*ROUGHNESS)),
        wheel_moment_am2=float(10 ** rng.uniform(low, high)),
    )
    radius_m, wheels = float(rng.uniform(*WHEEL_RADII_M)), []
    for wheel in vehicle.wheels:
        x, y, z = wheel.axle_m
        wheels.append(
            replace(
                wheel,
                radius_m=radius_m * (1 + float(rng.normal(0, 0.003))),
                dipoles=int(rng.integers(WHEEL_DIPOLES[0], WHEEL_DIPOLES[1] + 1)),
                axle_m=(x, y, z + radius_m - wheel.radius_m),
            )
        )
    return replace(vehicle, wheels=tuple(wheels))


def draw_course(rng: np.random.Generator) -> Course:
    """Any speed, and a driver who weaves by up to 20 cm."""
    return Course(speed_m_s=float(rng.uniform(*SPEEDS_MPH)) * MPH, weave_m=float(rng.uniform(0.02, 0.2)))


def draw_magnets_drive(rng: np.random.Generator, clearance_m: float, *, count: int = 40) -> SimulatedDrive:
    """Single magnets of both kinds and polarities, 2 to 6 m apart, anywhere under the bar."""
    spacing_m = float(rng.uniform(2, 6))
    magnets = random_magnets(rng, count, spacing_m)
    length_m = LEAD_M + count * spacing_m + 20
    bends = []
    if rng.random() < 0.5:
        radius_m = float(rng.choice((-1, 1)) * rng.uniform(*RADII_M))
        bends = [(float(rng.uniform(50, length_m / 2)), length_m - 10, radius_m)]
    scene = Scene(Road(length_m, bends), draw_vehicle(rng, clearance_m), draw_course(rng), lines=magnets)
    return simulate_drive(scene, rng)


def draw_line_beside_tags(rng: np.random.Generator, *, count: int = 12, line: bool = True) -> SimulatedDrive:
    """Tags with a line of magnets 35 to 100 cm beside them, as plans permit it; the same drive without the line."""
    clearance_m = float(rng.uniform(0.14, 0.38))
    tags = [PlacedTag(random_tag(rng, FORMAT), LEAD_M + i * 15, float(rng.uniform(-0.2, 0.2))) for i in range(count)]
    length_m = LEAD_M + count * 15 + 20
    side_m = float(rng.choice((-1, 1)) * rng.uniform(0.55, 0.8))
    lines = line_magnets(LEAD_M, length_m - 15, float(rng.choice((2, 3, 6))), side_m, Polarity.N)
    beside = lines if line else []
    scene = Scene(Road(length_m), draw_vehicle(rng, clearance_m), draw_course(rng), tags=tags, lines=beside)
    return simulate_drive(scene, rng)


def draw_iron_drive(rng: np.random.Generator, *, town: bool, lines: bool, length_m: float) -> SimulatedDrive:
    """A road with iron and without information tags; with or without ten magnets of a line at its beginning."""
    clearance_m = float(rng.uniform(0.12, 0.35))
    clutter = town_clutter(2 * LEAD_M, length_m, rng) if town else ferrous_clutter(2 * LEAD_M, length_m, 20, rng)
    magnets = line_magnets(LEAD_M, 2 * LEAD_M, 6, 0.2, Polarity.N) if lines else []
    course = replace(draw_course(rng), weave_m=0.15)
    scene = Scene(Road(length_m), draw_vehicle(rng, clearance_m), course, lines=magnets, clutter=clutter)
    return simulate_drive(scene, rng)


def draw_line_per_turn(rng: np.random.Generator, *, spacing: float, clearance_m: float) -> SimulatedDrive:
    """A line whose magnets are about as far apart as a turn of a wheel is long: times that, anywhere under the bar."""
    turn_m = 2 * np.pi * Wheel((0.0, 0.0, 0.0)).radius_m
    lines = line_magnets(14, 200, spacing * turn_m, float(rng.uniform(-0.7, 0.7)), Polarity.N)
    wheels_am2 = float(np.exp(rng.uniform(np.log(0.1), np.log(1.0))))
    vehicle = Vehicle.compact(clearance_m=clearance_m, wheel_moment_am2=wheels_am2)
    course = Course(float(rng.uniform(8, 25)), weave_m=0.02)
    return simulate_drive(Scene(Road(210), vehicle, course, lines=lines), rng)
