"""Bars that are mounted, wired or working otherwise than declared: drives with a fault each, and healthy ones."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from app.decoders.magnet.decoder import decode_trace
from app.decoders.magnet.identify import TagCandidates
from app.decoders.magnet.readings import MagnetReading
from app.decoders.magnet.recording_check import decode_checked
from app.markers.magnet import Polarity
from app.sensors.magnetometer_bar import MagnetometerBar, MagnetTrace
from app.simulation.magnetic.clutter import Clutter, ferrous_clutter, town_clutter
from app.simulation.magnetic.drive import MPH, Course, Scene, SimulatedDrive, simulate_drive
from app.simulation.magnetic.road import PlacedTag, Road, line_magnets
from app.values import Floats
from benchmarks.magnets.drawn_scenes import FORMAT, draw_vehicle
from benchmarks.magnets.scenes import LEAD_M, random_magnets, random_tag
from benchmarks.magnets.score import score_magnets

BAR = MagnetometerBar.metro(forward_m=3.2)
CLEARANCES_M = (0.16, 0.20, 0.25, 0.30)
SPEEDS_MPH = (15.0, 60.0)
RADII_M = (30.0, 120.0)
"""Of bends. [m] Both sharp turns in a town and wide ones."""

SURE = 0.95
"""Confidence from which on a reading that is wrong is counted."""
HIGH_CLEARANCES_M = (0.33, 0.37, 0.40)
HEALTHY: Mapping[str, dict[str, Any]] = {
    "magnets, tags and a line": {}, "iron": {"iron": "ferrous"}, "town": {"iron": "town"},
    "few magnets": {"magnets": 3, "tags": 1}, "strong wheels": {"wheels_am2": (1.0, 3.0)},
    "high": {"clearances_m": HIGH_CLEARANCES_M}, "high, town": {"clearances_m": HIGH_CLEARANCES_M, "iron": "town"},
    "lines that are crossed": {"crossing": True, "magnets": 6},
    "magnets beside the bar": {"magnets": 6, "line_left_m": (1.0, 1.4)},
    "joints": {"iron": "joints"}, "iron of spheroids": {"iron": "town", "spheroid_iron": True},
    "short": {"magnets": 2, "tags": 0, "lead_m": 8.0}, "no place ahead declared": {"forward_m": 0.0},
    "speed in a wrong unit": {"speed_factor": 1.609344},
}  # fmt: skip
"""Healthy bars. The last two have a wrong declaration, but not of the order or the axes."""


# === Roads.


def draw_road_drive(
    rng: np.random.Generator, *, turning: bool, bar: MagnetometerBar = BAR, magnets: int = 24, tags: int = 5,
    iron: str = "", wheels_am2: tuple[float, float] | None = None, clearances_m: Sequence[float] = CLEARANCES_M,
    crossing: bool = False, line_left_m: tuple[float, float] = (0.8, 0.8), lead_m: float = LEAD_M,
    spheroid_iron: bool = False, speed_factor: float = 1.0,
) -> SimulatedDrive:  # fmt: skip
    """Single magnets, tags, and a line that begins beside the tags, at any speed and one of some clearances."""
    spacing_m = float(rng.uniform(2.5, 5.0))
    singles = [replace(m, chainage_m=m.chainage_m - LEAD_M + lead_m) for m in random_magnets(rng, magnets, spacing_m)]
    first_m = lead_m + magnets * spacing_m + 10 * bool(tags)
    placed = [PlacedTag(random_tag(rng, FORMAT), first_m + 12 * k, float(rng.uniform(-0.2, 0.2))) for k in range(tags)]
    length_m = first_m + 12 * tags + 20
    left_m = float(rng.choice((-1, 1)) * rng.uniform(*line_left_m))
    lines = line_magnets(first_m, length_m - 15, 6.0, left_m, Polarity.N) if tags else []
    lefts: list[tuple[float, float]] = []
    if crossing:
        lines = line_magnets(lead_m, length_m - 5, float(rng.uniform(1.5, 6)), left_m, Polarity.N)
        other_m = left_m - math.copysign(rng.uniform(1.2, 1.5), left_m)
        lines += line_magnets(lead_m, length_m - 5, float(rng.uniform(1.5, 6)), other_m, Polarity.S)
        at = np.arange(lead_m, length_m, 25.0)
        lefts = [(float(x), float(rng.uniform(-1.5, 1.5))) for x in at]
    bends = []
    if turning:
        radius_m = float(rng.choice((-1, 1)) * rng.uniform(*RADII_M))
        turn_m = abs(radius_m) * math.radians(float(rng.uniform(70, 110)))
        start_m = float(rng.uniform(20, 60)) if length_m > 80 else 2.0
        bends = [(start_m, min(start_m + turn_m, length_m), radius_m)]
    clutter = []
    if iron == "town":
        clutter = town_clutter(lead_m, length_m, rng)
    elif iron == "joints":
        kinds, joint_m = ("slab joint", "bridge joint"), float(rng.uniform(6, 15))
        clutter = [Clutter(str(rng.choice(kinds)), float(at), 0.0) for at in np.arange(lead_m, length_m, joint_m)]
    elif iron:
        clutter = ferrous_clutter(lead_m + 5, length_m, 20, rng)
    vehicle = replace(draw_vehicle(rng, float(rng.choice(clearances_m))), bar=bar)
    if wheels_am2 is not None:
        strength = float(rng.uniform(*wheels_am2))
        vehicle = replace(vehicle, wheels=tuple(replace(wheel, moment_am2=strength) for wheel in vehicle.wheels))
    top_mph = min(SPEEDS_MPH[1], math.sqrt(4 * abs(bends[0][2])) / MPH) if bends else SPEEDS_MPH[1]
    speed_m_s = float(rng.uniform(SPEEDS_MPH[0], max(top_mph, SPEEDS_MPH[0] + 1))) * MPH
    course = Course(speed_m_s, weave_m=0.08, lefts=lefts)
    road = Road(length_m, bends, heading_deg=float(rng.uniform(0, 360)))
    scene = Scene(
        road, vehicle, course, tags=placed, lines=[*singles, *lines], clutter=clutter, spheroid_iron=spheroid_iron
    )
    drive = simulate_drive(scene, rng)
    return replace(drive, trace=replace(drive.trace, speed_m_s=speed_factor * drive.trace.speed_m_s))


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
    named: str  # the mistake's whole name, with {sensors} and {axes} of what is spoilt
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
    return _with_signs(trace, _one(rng), (float(signs[0]), float(signs[1]), float(signs[2])))


_LEFT, _RIGHT = [0, 1, 2, 3, 4, 5], [7, 8, 9, 10, 11, 12]
_BACKWARDS = [*_RIGHT, 6, *_LEFT, 13]
"""Array sensors from left to right in place of right to left; the references are in their places."""


def _turned(degrees: float) -> Fault:
    rotation = yaw_matrix(degrees)
    return Fault(f"bar turned by {degrees:g} degrees", lambda t, _r: _rotated(t, rotation), "", rotation)


FAULTS = (
    Fault("one sensor upside down", lambda t, r: _any_sign(t, r, 2),
        "sensor {sensors} is turned over ({axes} are inverted)"),
    Fault("one axis of one sensor inverted", lambda t, r: _any_sign(t, r, 1),
        "of sensor {sensors}, {axes} is inverted"),
    _turned(3), _turned(8), _turned(15),
    Fault("sensor order reversed", lambda t, _r: _ordered(t, list(range(14))[::-1]),
        "the order of all sensors is reversed"),
    Fault("left and right exchanged", lambda t, _r: _ordered(t, _BACKWARDS), "left and right of the bar are exchanged"),
    Fault("halves mirrored", lambda t, _r: _ordered(t, [*_LEFT[::-1], 6, *_RIGHT[::-1], 13]),
        "both halves are numbered from their other ends"),
    Fault("neighbouring cables swapped", _swap, "sensors {sensors} are exchanged"),
    Fault("x and z inverted", lambda t, _r: _with_signs(t, np.arange(14), (-1, 1, -1)), "x and z are inverted"),
    Fault("y and z inverted", lambda t, _r: _with_signs(t, np.arange(14), (1, -1, -1)),
        "the axes are FRD where FLU was declared or the other way round"),
    Fault("one sensor dead", _dead, "sensor {sensors} shows no field"),
    Fault("one sensor scaled by 1.5", _scaled, "the gain of sensor {sensors} is 1.5"),
    Fault(
        "bar mounted backwards", lambda t, _r: _with_signs(_ordered(t, _BACKWARDS), BAR.array, (-1, -1, 1)),
        "the bar is mounted backwards"
    ),
)  # fmt: skip


def draw_faulty_drive(fault: Fault, rng: np.random.Generator, *, turning: bool) -> tuple[SimulatedDrive, str]:
    """A drive that a faulty bar recorded, with the fault's name; the true magnets are as on a healthy one."""
    bar = BAR if fault.rotation is None else turned_bar(fault.rotation)
    drive = draw_road_drive(rng, turning=turning, bar=bar)
    spoilt = fault.spoil(drive.trace, rng)
    changed = (spoilt.field_ut != drive.trace.field_ut).any(axis=0)
    sensors = " and ".join(str(j + 1) for j in np.flatnonzero(changed.any(axis=1)))
    axes = " and ".join("xyz"[k] for k in np.flatnonzero(changed.any(axis=0)))
    return replace(drive, trace=spoilt), fault.named.format(sensors=sensors, axes=axes)


def _is_name(reason: str, fault: Fault, name: str) -> bool:
    """Whether a reason names this fault: its sensors and axes, or the angle within two degrees; or one of a choice."""
    if fault.rotation is None:
        return name in reason.split("; or ")
    found = re.fullmatch(r"the bar is turned by (\d+) degrees to the (left|right)", reason)
    true_deg = math.degrees(math.atan2(fault.rotation[1, 0], fault.rotation[0, 0]))
    return found is not None and abs(float(found[1]) * (1 if found[2] == "left" else -1) - true_deg) <= 2


# === Tables.


@dataclass
class FaultTally:
    """Drives with one fault."""

    drives: int = 0
    true: int = 0
    read: list[int] = field(default_factory=lambda: [0, 0])  # without and with the check of the bar
    wrong: list[int] = field(default_factory=lambda: [0, 0])  # readings at 0.95 and more
    corrected: int = 0  # under the fault's name
    refused: int = 0
    other: int = 0  # corrected under another name
    unseen: int = 0  # neither, and a reading at 0.95 is wrong

    def add(self, drive: SimulatedDrive, fault: Fault | None, name: str = "", bar: MagnetometerBar = BAR) -> None:
        """Decode a drive without and with the check of its bar."""
        candidates = TagCandidates(formats=[FORMAT])
        checked = decode_checked(drive.trace, bar, candidates=candidates)
        before = decode_trace(drive.trace, bar, candidates=candidates) if checked.faults else checked.findings
        self.drives += 1
        wrong = 0
        for k, findings in enumerate((before, checked.findings)):
            sure = [one for one in findings if not isinstance(one, MagnetReading) or one.confidence >= SURE]
            tally, of_sure = score_magnets(drive, findings), score_magnets(drive, sure)
            self.true += tally.true * (k == 0)
            self.read[k] += tally.found
            wrong = of_sure.wrong + of_sure.extra
            self.wrong[k] += wrong
        is_right = any(fault is not None and _is_name(one.reason, fault, name) for one in checked.faults)
        self.refused += checked.is_refused
        self.corrected += is_right and not checked.is_refused
        self.other += bool(checked.faults) and not is_right and not checked.is_refused
        self.unseen += not checked.faults and wrong > 0


HEAD = ("bar", "drives", "recall", "wrong at 0.95", "corrected", "refused", "otherwise corrected", "unseen and wrong")


def run_bars(seed: int, short: bool) -> tuple[str, Sequence[str], list[Sequence[object]]]:
    """Faulty bars, half of them on turning roads, and healthy ones."""
    rows: list[Sequence[object]] = []
    for fault in FAULTS:
        tally = FaultTally()
        for k in range(2 if short else 12):
            rng = np.random.default_rng([seed, 81, FAULTS.index(fault), k])
            drive, named = draw_faulty_drive(fault, rng, turning=bool(k % 2))
            tally.add(drive, fault, named)
        rows.append(_row(fault.name, tally))
    for name, options in HEALTHY.items():
        tally, drawn = FaultTally(), {key: value for key, value in options.items() if key != "forward_m"}
        bar = MagnetometerBar.metro(forward_m=options.get("forward_m", 3.2))
        for k in range(2 if short else 16):
            rng = np.random.default_rng([seed, 82, list(HEALTHY).index(name), k])
            tally.add(draw_road_drive(rng, turning=bool(k % 2), **drawn), None, bar=bar)
        rows.append(_row(f"healthy, {name}", tally))
    note = "Without and with the check of the bar. Wrong are readings of a confidence of 0.95 or more."
    return note, HEAD, rows


def _row(name: str, tally: FaultTally) -> Sequence[object]:
    before, after = (read / max(tally.true, 1) for read in tally.read)
    return (
        name, tally.drives, f"{before:.3f}, {after:.3f}", f"{tally.wrong[0]}, {tally.wrong[1]}", tally.corrected,
        tally.refused, tally.other, tally.unseen,
    )  # fmt: skip
