"""Scenes of magnets: a road with magnets, tags and iron, a vehicle with a bar, and what is decoded from its trace."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from app.decoders.magnet.decoder import decode_trace
from app.decoders.magnet.identify import TagCandidates
from app.decoders.magnet.readings import Finding, MagnetReading, TagReading
from app.decoders.magnet.recording_check import find_mistakes
from app.markers.magnet import MOMENT_AM2, Orientation, Polarity
from app.sensors.magnetometer_bar import MagnetometerBar, MagnetTrace
from app.simulation.magnetic.clutter import Clutter, ferrous_clutter, slab_joints, town_clutter
from app.simulation.magnetic.dipoles import dipole_field_ut
from app.simulation.magnetic.drive import Course, Scene, SimulatedDrive, TrueMagnet, Vehicle, Wheel, simulate_drive
from app.simulation.magnetic.recorder import Chip
from app.simulation.magnetic.road import PlacedTag, Road, RoadMagnet, line_magnets
from benchmarks.hunt.bars import FAULTS, lossy_trace, spoiled_trace, turned_bar, turned_trace
from benchmarks.hunt.scenes import Bound, Kind, Outcome, Parameters, draw_parameters, simplest, switch
from benchmarks.magnets.drawn_scenes import FORMAT
from benchmarks.magnets.scenes import LEAD_M, random_magnets, random_tag
from benchmarks.magnets.score import REACH_M, UNDER_CM

_BY_HAND = "by hand"
VEHICLE = {
    "clearance_m": Bound(0.12, 0.42, 0.16, "ground clearances of cars to heavy trucks, 37 cm", plain=0.1),
    "roughness": Bound(0.3, 3, 1, "`Vehicle`: 1 an ordinary road, 3 a rough one", logarithmic=True),
    "wheel_am2": Bound(0.005, 1.2, 0.15, "METRO table 1 needs about 1; weak belts a hundredth", logarithmic=True),
    "wheel_radius_m": Bound(0.27, 0.38, 0.31, "small cars to vans; the axle is 55 cm behind the bar"),
    "wheel_dipoles": Bound(1, 9, 5, _BY_HAND, whole=True),
    "wheel_difference": Bound(-0.02, 0.02, 0.003, "tyre wear of 6 mm on 310 mm"),
    "noise_ut": Bound(0.5, 3, 1.5, "MLX90393 data sheet, by oversampling", logarithmic=True, plain=0.4),
    "gain_sd": Bound(0, 0.05, 0.02, "MLX90393 data sheet, sensitivity of axes", plain=0.4),
    "misalignment_deg": Bound(0, 4, 1.5, "soldering and mounting", plain=0.4),
    "jitter": Bound(0, 0.1, 0.03, "a loop without real time", plain=0.4),
}
COURSE = {
    "speed_m_s": Bound(2, 36, 13.4, "walking traffic to a motorway", logarithmic=True),
    "slows_to": Bound(0, 1, 1, "share of the speed in the middle of the drive: stop and go", plain=0.6),
    "weave_m": Bound(0, 0.3, 0.05, "lateral position in driving studies"),
    "hunting": Bound(0, 0.05, 0.01, "by hand; less where speed times it is harder than comfortable braking", plain=0.5),
    "radius_m": Bound(40, 1000, 1000, "a roundabout to a motorway", logarithmic=True, plain=0.5),
    "bends_left": switch("either"),
    "wrong_way": switch("against the direction of travel", plain=0.85),
    "dip_deg": Bound(-85, 85, 70, "Earth's field, pole to pole"),
    "earth_ut": Bound(25, 65, 54, "Earth's field, from Brazil to the poles (IGRF)"),
}
ROADWAY = {
    "magnets": Bound(0, 30, 12, "single magnets", whole=True, plain=0.2),
    "spacing_m": Bound(1.5, 6, 3, "each is up to 0.5 m off: at least 0.5 m apart, as plans demand", logarithmic=True),
    "tags": Bound(0, 6, 0, "information tags", whole=True, plain=0.5),
    "side_line_m": Bound(0.5, 1.2, 0, "a line beside tags; plans permit 0.5 m", plain=0.6),
    "side_spacing_m": Bound(1.5, 6, 6, "METRO section 6", logarithmic=True),
    "moment": Bound(0.6, 1.2, 1, "share of the nominal moment: aged and warm to grades above N42", plain=0.4),
    "iron_per_100_m": Bound(0, 8, 0, "objects in the lane", plain=0.4),
    "town": switch("cars beside the lane, covers and joints"),
}
_FAULTS = ("", *FAULTS)
BESIDES = {
    "lift_m": Bound(0, 0.15, 0, "higher still: off-road vehicles and trucks without a load", plain=0.85),
    "slab_m": Bound(4, 7.5, 0, "slabs of concrete roads with dowels, 4.5 to 7.5 m, and bridges", plain=0.85),
    "rails": switch("a tram's rails along 60 m of the lane", plain=0.92),
    "rails_left_m": Bound(-0.8, 0.8, 0, "of the track's middle: a vehicle follows it about"),
    "bar_yaw_deg": Bound(0, 15, 0, "a bracket that slipped", plain=0.85),
    "fault": Bound(0, len(_FAULTS) - 1, 0, "`benchmarks.hunt.bars`", whole=True, plain=0.85),
    "faulty_sensor": Bound(0, 1, 0.5, "any of them"),
    "lost_samples": Bound(0, 0.15, 0, "a full bus drops them in runs", plain=0.85),
}
SURE = 0.95
"""Confidence from which on a reading that is not true is a failure; below it, the table of reliability judges it."""
_LIMIT_SNR = 25.0  # standard deviations of white noise that a magnet explains, above which it must be read; by hand
_MIN_MAGNETS = 4  # with fewer, iron at another clearance looks the same; source: `clearance.KNOWN_STD_M`
_MAX_MISSED = 0.15  # share of these magnets; source: by hand
_BAR = MagnetometerBar.metro(forward_m=3.2)
_APART_M = 1.0  # [m] source: by hand, the width of a manhole cover's field at 20 cm
_SLOPE_PER_M = (
    2 * math.pi / 60
)  # [1/m] of slow changes of speed, standard deviations; derived: `drive_course` filters at 60 m
_BRAKING_M_S2 = 2.5  # [m/s2] source: comfortable braking, AASHTO Green Book, section 3.2.2: 3.4 m/s2 is the limit


class MagnetScenes:
    """Drives over magnets, tags and iron.

    The physical limit is that of a matched filter in the white noise of the chips, without wheels and iron: a magnet
    that explains 25 standard deviations must be read, unless it lies between rails, or the bar is not as it was
    declared and the mistake is named. The badness is a number of wrong readings or a share missed.
    """

    bounds: Mapping[str, Bound] = {**VEHICLE, **COURSE, **ROADWAY, **BESIDES}

    def evaluate(self, parameters: Parameters, seed: int) -> Outcome:
        """Decode a drive, and compare its readings with the true magnets and tags."""
        drive = _simulate(parameters, seed)
        findings = decode_trace(drive.trace, _BAR, candidates=TagCandidates(formats=[FORMAT]))
        outcome = _judge(parameters, drive, findings)
        if outcome.kind is Kind.MISSED and _is_misdeclared(parameters):
            named = find_mistakes(drive.trace, _BAR, findings, TagCandidates(formats=[FORMAT]))
            if named:
                return replace(outcome, kind=Kind.RIGHT, detail=f"named: {named[0].reason}")
        return outcome

    def draw(self, parameters: Parameters, seed: int, path: Path) -> None:
        """Draw the strength at the middle of the bar over the drive, with magnets and readings, as SVG."""
        drive = _simulate(parameters, seed)
        findings = decode_trace(drive.trace, _BAR, candidates=TagCandidates(formats=[FORMAT]))
        path.with_suffix(".svg").write_text(_picture(drive, findings))


def simulate_scene(seed: int) -> tuple[SimulatedDrive, MagnetometerBar]:
    """The drive of a drawn scene with its bar as declared, and that bar."""
    bounds = {**VEHICLE, **COURSE, **ROADWAY}
    return _simulate({**simplest(MagnetScenes.bounds), **draw_parameters(bounds, seed)}, seed), _BAR


def _simulate(p: Parameters, seed: int) -> SimulatedDrive:
    rng = np.random.default_rng([seed, 2])
    magnets = random_magnets(rng, int(p["magnets"]), p["spacing_m"])
    first_tag_m = LEAD_M + len(magnets) * p["spacing_m"] + 10
    tags = [
        PlacedTag(random_tag(rng, FORMAT), first_tag_m + 12 * k, float(rng.uniform(-0.2, 0.2)))
        for k in range(int(p["tags"]))
    ]
    length_m = first_tag_m + 12 * len(tags) + 20 + (0 if magnets or tags else 300)
    if p["side_line_m"]:
        side = float(rng.choice((-1, 1))) * p["side_line_m"]
        magnets += line_magnets(first_tag_m, length_m - 15, p["side_spacing_m"], side, Polarity.N)
    vehicle = _vehicle(p)
    if p["bar_yaw_deg"]:
        vehicle = replace(vehicle, bar=turned_bar(_BAR, p["bar_yaw_deg"]))
    clutter = [*_apart(_clutter(p, length_m, rng), magnets, tags), *_structures(p, length_m)]
    scene = Scene(
        Road(length_m, _bends(p, length_m)), vehicle, _course(p, length_m), tags=tags, lines=magnets, clutter=clutter,
        chip=_chip(p), wrong_way=bool(p["wrong_way"]), earth_ut=_earth_ut(p, rng), moment_am2=MOMENT_AM2 * p["moment"],
    )  # fmt: skip
    drive = simulate_drive(scene, rng)
    return replace(drive, trace=_recorded(p, drive.trace, np.random.default_rng([seed, 5])))


def _recorded(p: Parameters, trace: MagnetTrace, rng: np.random.Generator) -> MagnetTrace:
    """The trace as a bar records it that may be turned, wired wrongly, or on a full bus."""
    if p["bar_yaw_deg"]:
        trace = turned_trace(trace, _BAR, p["bar_yaw_deg"])
    if p["fault"]:
        trace = spoiled_trace(trace, _BAR, _FAULTS[int(p["fault"])], p["faulty_sensor"])
    return lossy_trace(trace, p["lost_samples"], rng) if p["lost_samples"] else trace


def _is_misdeclared(p: Parameters) -> bool:
    return bool(p["bar_yaw_deg"] or p["fault"])


def _structures(p: Parameters, length_m: float) -> list[Clutter]:
    """What the road itself is made of, which magnets lie between."""
    found = slab_joints(LEAD_M + 3, length_m - 5, p["slab_m"]) if p["slab_m"] else []
    if p["rails"]:
        found.append(Clutter("tram rails", LEAD_M + 40, p["rails_left_m"]))
    return found


def _vehicle(p: Parameters) -> Vehicle:
    clearance_m = p["clearance_m"] + p["lift_m"]
    plain = Vehicle.compact(clearance_m=clearance_m, roughness=p["roughness"], wheel_moment_am2=p["wheel_am2"])
    wheels = []
    for wheel, sign in zip(plain.wheels, (1, -1), strict=True):
        x, y, z = wheel.axle_m
        radius = p["wheel_radius_m"] * (1 + sign * p["wheel_difference"] / 2)
        wheels.append(Wheel((x, y, z + radius - wheel.radius_m), radius, p["wheel_am2"], int(p["wheel_dipoles"])))
    return Vehicle(plain.bar, clearance_m, tuple(wheels), p["roughness"])


def _course(p: Parameters, length_m: float) -> Course:
    speed = p["speed_m_s"]
    slow = max(speed * p["slows_to"], 0.6)
    ramp_m = min((speed**2 - slow**2) / (2 * _BRAKING_M_S2), 0.35 * length_m)
    slow = math.sqrt(max(speed**2 - 2 * _BRAKING_M_S2 * ramp_m, 0.36))
    middle = 0.5 * length_m
    speeds = [(middle + at * ramp_m, speed - (speed - slow) * down) for at, down in ((-1, 0), (0, 1), (1, 0))]
    # three standard deviations of the acceleration are comfortable braking: traffic at 130 km/h holds its speed better
    hunting = min(p["hunting"], _BRAKING_M_S2 / 3 / (speed**2 * _SLOPE_PER_M))
    return Course(speed, speeds if p["slows_to"] < 1 else (), hunting=hunting, weave_m=p["weave_m"])


def _bends(p: Parameters, length_m: float) -> list[tuple[float, float, float]]:
    if p["radius_m"] >= 1000:
        return []
    return [(50.0, length_m - 10, p["radius_m"] * (1 if p["bends_left"] else -1))]


def _clutter(p: Parameters, length_m: float, rng: np.random.Generator) -> list[Clutter]:
    found: list[Clutter] = []
    if p["iron_per_100_m"] > 0:
        found += ferrous_clutter(LEAD_M + 100 / p["iron_per_100_m"] / 2, length_m, 100 / p["iron_per_100_m"], rng)
    if p["town"]:
        found += town_clutter(LEAD_M, length_m, rng)
    return found


def _apart(clutter: Sequence[Clutter], magnets: Sequence[RoadMagnet], tags: Sequence[PlacedTag]) -> list[Clutter]:
    """Iron that lies on no magnet: no limit tells what could still be read there."""
    at = np.array([m.chainage_m for m in magnets] + [t.chainage_m + o for t in tags for o in t.tag.offsets_m])
    return [one for one in clutter if one.kind == "car" or not (np.abs(at - one.chainage_m) < _APART_M).any()]


def _chip(p: Parameters) -> Chip:
    noise = p["noise_ut"]
    return Chip(
        noise_ut=(noise, noise, noise * 1.27), gain=p["gain_sd"], misalignment_deg=p["misalignment_deg"],
        jitter=p["jitter"],
    )  # fmt: skip


def _earth_ut(p: Parameters, rng: np.random.Generator) -> tuple[float, float, float]:
    dip, heading = math.radians(p["dip_deg"]), float(rng.uniform(0, 2 * math.pi))
    level = p["earth_ut"] * math.cos(dip)
    return (level * math.sin(heading), level * math.cos(heading), -p["earth_ut"] * math.sin(dip))


def white_noise_snr(p: Parameters, magnet: TrueMagnet) -> float:
    """Root of the energy of a magnet's field at the bar over the white noise of the chips."""
    sensors = _BAR.positions_m[_BAR.array]
    bar = sensors - sensors.mean(0)
    along = np.linspace(-1.0, 1.0, 81)
    place = np.array([0.0, magnet.lateral_cm / 100, -magnet.clearance_m])
    moment = (
        MOMENT_AM2
        * p["moment"]
        * (np.array([0, 0, 1.0]) if magnet.orientation is Orientation.UP else np.array([1.0, 0, 0]))
    )
    energy = 0.0
    for x in along:
        energy += float(np.sum(dipole_field_ut(bar + np.array([x, 0.0, 0.0]), place, moment) ** 2))
    samples = 350.0 * (along[1] - along[0]) / magnet.speed_m_s
    return math.sqrt(energy * samples) / (1.1 * p["noise_ut"])


def _judge(p: Parameters, drive: SimulatedDrive, findings: Sequence[Finding]) -> Outcome:
    readings = [f for f in findings if isinstance(f, MagnetReading)]
    sure: list[tuple[float, bool]] = []
    squared: list[tuple[float, int]] = []
    wrong: list[str] = []
    taken: set[int] = set()
    for reading in readings:
        near = _nearest(drive.magnets, reading, taken)
        if near is None:
            at_edge = any(abs(reading.t_s - m.t_s) * m.speed_m_s < REACH_M for m in drive.magnets)
            if not at_edge:
                sure.append((reading.confidence, False))
                if reading.confidence >= SURE:
                    wrong.append("a magnet where none is")
            continue
        taken.add(near)
        magnet = drive.magnets[near]
        right = reading.polarity is magnet.polarity and reading.phi_deg is magnet.orientation
        sure.append((reading.confidence, right))
        if not right and reading.confidence >= SURE:
            wrong.append("wrong polarity" if reading.phi_deg is magnet.orientation else "wrong axis")
        elif right and reading.along_std_m:
            squared.append((((reading.t_s - magnet.t_s) * magnet.speed_m_s / reading.along_std_m) ** 2, 1))
    wrong += ["wrong tag"] * _wrong_tags(drive, findings)
    readable = () if p["rails"] else drive.magnets
    possible = [
        k for k, m in enumerate(readable) if abs(m.lateral_cm) < UNDER_CM - 8 and white_noise_snr(p, m) > _LIMIT_SNR
    ]
    missed = [k for k in possible if k not in taken]
    few = len(drive.magnets) < _MIN_MAGNETS
    read = 1 - len(missed) / len(possible) if possible and not few else None
    if wrong:
        said = ", ".join(f"{wrong.count(what)} x {what}" for what in dict.fromkeys(wrong))
        return Outcome(Kind.WRONG, float(len(wrong)), said, sure, squared, read)
    if few:
        return Outcome(Kind.BEYOND, 0.0, "too few magnets to show the clearance", sure, squared)
    if len(missed) > max(_MAX_MISSED * len(possible), 1):
        share = len(missed) / len(possible)
        return Outcome(Kind.MISSED, share, f"{len(missed)} of {len(possible)} magnets not read", sure, squared, read)
    said = f"{len(taken)} of {len(drive.magnets)} magnets read"
    return Outcome(Kind.RIGHT, detail=said, sure=sure, squared=squared, read=read)


def _wrong_tags(drive: SimulatedDrive, findings: Sequence[Finding]) -> int:
    """Tags that were read as other ones; single magnets that happen to stand like a tag are no mistake."""
    wrong = 0
    for number, placed in enumerate(drive.tags):
        first = next((m for m in drive.magnets if m.tag == number), None)
        for reading in findings:
            if first is None or not isinstance(reading, TagReading) or reading.tag is None:
                continue
            wrong += abs(reading.start_s - first.t_s) * first.speed_m_s < 0.6 and reading.tag != placed.tag
    return wrong


def _nearest(magnets: Sequence[TrueMagnet], reading: MagnetReading, taken: set[int]) -> int | None:
    apart = {
        k: math.hypot((reading.t_s - m.t_s) * m.speed_m_s, (reading.lateral_cm - m.lateral_cm) / 100)
        for k, m in enumerate(magnets)
        if k not in taken and abs(reading.t_s - m.t_s) * m.speed_m_s < REACH_M
    }
    near = min(apart, key=lambda k: apart[k], default=None)
    return near if near is not None and apart[near] < REACH_M else None


def _picture(drive: SimulatedDrive, findings: Sequence[Finding]) -> str:
    """SVG: the field's change at the bar over time, true magnets below it, readings above it."""
    trace = drive.trace
    field = trace.field_ut[:, _BAR.array]
    strength = np.linalg.norm(field - np.median(field, axis=0), axis=2).max(1)
    step = max(len(strength) // 1500, 1)
    ends = float(trace.t_s[0]), float(trace.t_s[-1])
    top = max(float(np.percentile(strength, 99.9)), 1.0)

    def x(t_s: float) -> float:
        return 10 + 1180 * (t_s - ends[0]) / (ends[1] - ends[0])

    line = " ".join(
        f"{x(t):.1f},{150 - 130 * min(s / top, 1.1):.1f}"
        for t, s in zip(trace.t_s[::step], strength[::step], strict=True)
    )
    marks = [f'<circle cx="{x(m.t_s):.1f}" cy="165" r="3" fill="#1f77b4"/>' for m in drive.magnets]
    readings = [f for f in findings if isinstance(f, MagnetReading)]
    marks += [f'<circle cx="{x(r.t_s):.1f}" cy="178" r="3" fill="#d62728"/>' for r in readings]
    return (
        '<svg xmlns="http://www.w3.org/2000/svg" width="1200" height="200" font-family="sans-serif" font-size="11">'
        f'<rect width="1200" height="200" fill="white"/><polyline points="{line}" fill="none" stroke="#333"/>'
        + "".join(marks)
        + f'<text x="10" y="12">largest change of the field, up to {top:.0f} uT; blue: magnets, red: readings'
        "</text></svg>"
    )
