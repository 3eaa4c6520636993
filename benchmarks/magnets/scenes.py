"""Drives that the benchmarks render; every one from a seed."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from app.decoders.magnet.identify import TagFormat
from app.markers.magnet import InformationTag, Orientation, Polarity
from app.simulation.magnetic.clutter import Clutter, ferrous_clutter, town_clutter
from app.simulation.magnetic.drive import MPH, Course, Scene, SimulatedDrive, Vehicle, simulate_drive
from app.simulation.magnetic.road import PlacedTag, Road, RoadMagnet, line_magnets

LEAD_M = 60.0
"""Without a magnet: the paper's thresholds are set there."""


def random_magnets(rng: np.random.Generator, count: int, spacing_m: float) -> list[RoadMagnet]:
    """Single magnets of both kinds and polarities, one after the other, anywhere under the bar."""
    return [
        RoadMagnet(
            LEAD_M + i * spacing_m + float(rng.uniform(-0.5, 0.5)), float(rng.uniform(-0.8, 0.8)),
            Polarity.N if rng.random() < 0.5 else Polarity.S,
            Orientation.UP if rng.random() < 0.5 else Orientation.FORWARD,
        )
        for i in range(count)
    ]  # fmt: skip


def magnets_drive(
    rng: np.random.Generator, *, clearance_m: float, speed_mph: float, count: int, spacing_m: float = 3.0
) -> SimulatedDrive:
    """Single magnets of both kinds and polarities, anywhere under the bar."""
    magnets = random_magnets(rng, count, spacing_m)
    road = Road(LEAD_M + count * spacing_m + 20)
    course = Course(speed_m_s=speed_mph * MPH, weave_m=0.03)
    vehicle = Vehicle.compact(clearance_m=clearance_m)
    return simulate_drive(Scene(road, vehicle, course, lines=magnets), rng)


def random_tag(rng: np.random.Generator, form: TagFormat, gaps: Sequence[int] | None = None) -> InformationTag:
    """A tag of a format, neighbours at least 0.5 m apart."""
    steps = round(form.length_m / form.segment_m)
    least = math.ceil(0.5 / form.segment_m - 1e-9)
    polarities = tuple(Polarity.N if n else Polarity.S for n in rng.random(form.magnets) < 0.5)
    if gaps:
        return InformationTag.from_gaps(polarities, form.segment_m, tuple(gaps))
    while True:
        places = sorted(rng.choice(np.arange(1, steps), form.magnets - 2, replace=False).tolist())
        if min(np.diff([0, *places, steps])) >= least:
            return InformationTag(polarities, form.length_m, form.segment_m, tuple(int(p) for p in places))


def tags_drive(
    rng: np.random.Generator, form: TagFormat, *, count: int, clearance_m: float = 0.16, speed_mph: float = 30,
    course: Course | None = None, bends: Sequence[tuple[float, float, float]] = (), roughness: float = 1.0,
    gaps: Sequence[int] | None = None, pitch_m: float = 15.0, clutter: Sequence[Clutter] = (), wheel: float = 0.15,
    wrong_way: bool = False,
) -> SimulatedDrive:  # fmt: skip
    """Tags of a format one after the other, somewhere under the middle of the bar."""
    tags = [
        PlacedTag(
            random_tag(rng, form, gaps), LEAD_M + i * (form.length_m + pitch_m - 4), float(rng.uniform(-0.3, 0.3))
        )
        for i in range(count)
    ]
    road = Road(LEAD_M + count * (form.length_m + pitch_m - 4) + 20, bends)
    vehicle = Vehicle.compact(clearance_m=clearance_m, roughness=roughness, wheel_moment_am2=wheel)
    scene = Scene(
        road, vehicle, course or Course(speed_m_s=speed_mph * MPH), tags=tags, clutter=clutter, wrong_way=wrong_way
    )
    return simulate_drive(scene, rng)


def wheel_drive(rng: np.random.Generator, *, passes: int, wheel: float = 1.0) -> SimulatedDrive:
    """Section 7.2: three upright magnets 1 and 3 m apart before the left wheel, 30 mph; here some passes on end."""
    magnets = [
        RoadMagnet(LEAD_M + 20 * i + at, 0.76 + float(rng.normal(0, 0.04)), Polarity.N, Orientation.UP)
        for i in range(passes)
        for at in (0.0, 1.0, 4.0)
    ]
    road = Road(LEAD_M + 20 * passes + 20)
    vehicle = Vehicle.compact(wheel_moment_am2=wheel)
    return simulate_drive(Scene(road, vehicle, Course(weave_m=0.02), lines=magnets), rng)


def noise_drive(rng: np.random.Generator, *, length_m: float, town: bool, clearance_m: float = 0.16) -> SimulatedDrive:
    """A road without information tags; the clearance is estimated from ten magnets of a line at its beginning."""
    clutter = town_clutter(LEAD_M + 60, length_m, rng) if town else ferrous_clutter(LEAD_M + 60, length_m, 20, rng)
    lines = line_magnets(LEAD_M, LEAD_M + 60, 6, 0.2, Polarity.N)
    course = Course(speed_m_s=(25 if town else 30) * MPH, weave_m=0.15)
    return simulate_drive(
        Scene(Road(length_m), Vehicle.compact(clearance_m=clearance_m), course, lines=lines, clutter=clutter), rng
    )


def long_drive(rng: np.random.Generator, *, minutes: float) -> SimulatedDrive:
    """Town and country with everything on it: tags, lines that are crossed, iron, bends, braking."""
    speeds = [(0.0, 10.0)]
    length = 0.0
    seconds = 0.0
    while seconds < 60 * minutes:
        step, speed = float(rng.uniform(150, 500)), float(rng.uniform(6, 28))
        seconds += 2 * step / (speeds[-1][1] + speed)
        length += step
        speeds.append((length, speed))
    form = TagFormat(3, 4.0, 0.1)
    tags = [
        PlacedTag(random_tag(rng, form), float(at), float(rng.uniform(-0.2, 0.2)))
        for at in np.arange(LEAD_M, length - 20, 60.0)
    ]
    keep = [(p.chainage_m - 2, p.chainage_m + 6) for p in tags]
    clutter = [
        c
        for c in town_clutter(LEAD_M, length, rng)
        if c.kind == "car" or all(not (low - 2 < c.chainage_m < high + 2) for low, high in keep)
    ]
    bends = [
        (float(a), float(a) + 60, float(rng.choice((-1, 1)) * rng.uniform(80, 300)))
        for a in np.arange(200, length, 700)
    ]
    lines = line_magnets(LEAD_M, length - 20, 6.0, 1.8, Polarity.N) + line_magnets(
        LEAD_M, length - 20, 6.0, -1.8, Polarity.S
    )
    scene = Scene(
        Road(length, bends),
        Vehicle.compact(),
        Course(speeds=speeds, weave_m=0.15),
        tags=tags,
        lines=lines,
        clutter=clutter,
    )
    return simulate_drive(scene, rng)
