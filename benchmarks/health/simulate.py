"""Drives through a scene, and what the tests make of them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import product
from zlib import crc32

import numpy as np

from app.health import MarkerState, Pass, VehicleState, judge_drive, update_marker, update_unregistered
from benchmarks.health.scenes import (
    DAY_S,
    FAMILIES,
    SURVEY_SIGMA_M,
    Markers,
    Rng,
    Scene,
    Vehicles,
    draw_markers,
    draw_vehicles,
)

_FAR = (10.0, 50.0)
_NOISE_M = {"plate": 1.0, "magnet": 1.0, "cerpm": 0.25}
_CLONE_SHARE, _STRAY_SHARE = 0.3, 2e-4
_UNKNOWN_SHARE, _UNKNOWN_CODES = 0.6, 3


@dataclass(slots=True)
class Found:
    """When a fault was found: by passes since it began, and by distinct vehicles."""

    passes: int
    vehicles: int


@dataclass(slots=True)
class Outcome:
    """Of one scene with one seed."""

    # of each injected fault, by kind; None where it was not found
    found: dict[str, list[Found | None]] = field(default_factory=lambda: defaultdict(list))
    # kinds of the faults that healthy markers were accused of, or faulty ones of another fault
    false_alarms: list[str] = field(default_factory=list)
    healthy: int = 0  # markers without a fault
    wrong_way_drives: int = 0
    wrong_way_found: int = 0
    wrong_way_false: int = 0
    fewest_vehicles: int = 99  # of all suspects


@dataclass(slots=True)
class _Record:
    """Of one marker: passes and vehicles since its fault began, and what was suspected when."""

    passes: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    vehicles: set[str] = field(default_factory=set)
    moved_vehicles: set[str] = field(default_factory=set)
    suspected: dict[str, Found] = field(default_factory=dict)


def simulate(scene: Scene, seed: int, fault_share: float = 0.06, only_vehicle: bool = False) -> Outcome:
    """Drive 30 days through a scene.

    Parameters
    ----------
    only_vehicle : bool
        The same vehicle makes all drives.
    """
    rng = np.random.default_rng(seed)
    markers, vehicles = draw_markers(scene, rng, fault_share), draw_vehicles(scene, rng)
    states: dict[tuple[int, int], MarkerState] = {}
    records: dict[tuple[int, int], _Record] = defaultdict(_Record)
    own = [[VehicleState() for _ in FAMILIES] for _ in range(scene.vehicles)]
    outcome = Outcome()
    unknown = [(MarkerState.new("plate"), _Record()) for _ in range(min(_UNKNOWN_CODES, scene.roads))]
    wrong_way = set(rng.choice(scene.drives, scene.wrong_way_drives, replace=False).tolist())
    for number in range(scene.drives):
        at_s = (number + rng.random()) / scene.drives * 30 * DAY_S
        vehicle = 0 if only_vehicle else int(rng.integers(scene.vehicles))
        road, is_wrong_way = int(rng.integers(scene.roads)), number in wrong_way
        passes = _drive(scene, rng, markers, vehicles, road, vehicle, at_s, is_wrong_way)
        evidences, found = [], False
        for name, vehicle_state in zip(FAMILIES, own[vehicle], strict=True):  # each sensor makes its own upload
            part = [(place, one) for place, one in passes if one.family == name]
            judged = judge_drive([one for _place, one in part], vehicle_state, at_s)
            found |= judged.wrong_way and not judged.only_one
            evidences += [(place, evidence) for (place, _), evidence in zip(part, judged.evidence, strict=True)]
        _count_incident(outcome, found, is_wrong_way, passes)
        for place, evidence in evidences:
            key = (road, place)
            state = states.setdefault(key, MarkerState.new(FAMILIES[markers.family[key]]))
            record = records[key]
            if markers.fault[key] and at_s >= markers.since_s[key]:
                record.vehicles.add(str(vehicle))
                record.passes["all"] += 1
                if evidence.offset_m is not None:
                    record.moved_vehicles.add(str(vehicle))
                record.passes["moved"] = len(record.moved_vehicles)
                record.passes["missing"] += evidence.read_probability > 0
                record.passes["cloned"] += evidence.elsewhere is not None
                record.passes["wrong-way"] += evidence.reversed is not None
                record.passes["fading"] += evidence.quality is not None
            for verdict in update_marker(state, evidence, str(vehicle), at_s):
                outcome.fewest_vehicles = min(outcome.fewest_vehicles, verdict.vehicles)
                kind = str(verdict.fault)
                known = record.suspected.setdefault(kind, Found(record.passes[kind], len(record.vehicles)))
                if known.passes == 0 and not (markers.fault[key] and at_s >= markers.since_s[key]):
                    known.passes = -1  # before anything was wrong
        if road < len(unknown) and rng.random() < _UNKNOWN_SHARE and at_s > 5 * DAY_S:
            state, record = unknown[road]
            record.passes["unregistered"] += 1
            record.vehicles.add(str(vehicle))
            for verdict in update_unregistered(state, 1 - 10 ** -rng.uniform(1.5, 6), str(vehicle), at_s):
                outcome.fewest_vehicles = min(outcome.fewest_vehicles, verdict.vehicles)
                now = Found(record.passes["unregistered"], len(record.vehicles))
                record.suspected.setdefault("unregistered", now)
    outcome.found["unregistered"] = [record.suspected.get("unregistered") for _state, record in unknown]
    _collect(outcome, markers, records)
    return outcome


def _count_incident(outcome: Outcome, found: bool, is_wrong_way: bool, passes: list[tuple[int, Pass]]) -> None:
    shown = [one.family for _place, one in passes if one.reversed is not None]
    if is_wrong_way and any(shown.count(name) >= 3 for name in FAMILIES):
        outcome.wrong_way_drives += 1
        outcome.wrong_way_found += found
    elif not is_wrong_way:
        outcome.wrong_way_false += found


def _collect(outcome: Outcome, markers: Markers, records: dict[tuple[int, int], _Record]) -> None:
    for key in product(*map(range, markers.fault.shape)):
        fault, record = str(markers.fault[key]), records[key[0], key[1]]
        outcome.healthy += not fault
        if fault:
            found = record.suspected.get(fault)
            outcome.found[fault].append(found if found is not None and found.passes >= 0 else None)
        wrong = [kind for kind, found in record.suspected.items() if not (kind == fault and found.passes >= 0)]
        # what is wrong with a faulty marker may also show as another fault: a faded plate is missed
        outcome.false_alarms += wrong if not fault else [kind for kind in wrong if record.suspected[kind].passes < 0]


def _drive(
    scene: Scene, rng: Rng, markers: Markers, vehicles: Vehicles, road: int, vehicle: int, at_s: float,
    is_wrong_way: bool,
) -> list[tuple[int, Pass]]:  # fmt: skip
    """What an upload of a drive along a road shows of its markers."""
    count = scene.markers
    drive_shift = vehicles.shift_m[vehicle] + rng.normal(0.0, 0.1, 2)
    walk = np.cumsum(rng.normal(0.0, 0.02, (count, 2)), axis=0)
    miss = _miss_shares(scene, rng, vehicles.miss[vehicle], count)
    seen_from = 0.5 if rng.random() < scene.other_lane else 1.0
    light = rng.normal(0.0, 1.0)
    found: list[tuple[int, Pass]] = []
    for place in range(count):
        key = (road, place)
        fault = markers.fault[key] if at_s >= markers.since_s[key] else ""
        name = FAMILIES[markers.family[key]]
        true_rate = markers.expected[key] * seen_from
        # the tables know lanes only roughly
        expected = float(np.clip(true_rate + rng.normal(0.0, 0.04), 0.05, 0.98))
        read = bool(rng.random() < true_rate * (1 - miss[place]) * markers.dirt[key]) and fault != "missing"
        if fault == "fading":
            read = read and bool(rng.random() < 0.85)
        found.append(
            (place, _pass(scene, rng, markers, key, name, fault, read, expected, drive_shift + walk[place], light,
                          is_wrong_way))
        )  # fmt: skip
        if (fault == "cloned" and rng.random() < _CLONE_SHARE) or rng.random() < _STRAY_SHARE:
            spot = _FAR if fault == "cloned" else (rng.uniform(9, 11), rng.uniform(49, 51))
            jitter = rng.normal(0.0, 5e-5, 2)
            far = (float(spot[0] + jitter[0]), float(spot[1] + jitter[1]))
            found.append((place, Pass(f"{road}.{place}", name, True, along=float(place), elsewhere=far)))
    return found


def _pass(
    scene: Scene, rng: Rng, markers: Markers, key: tuple[int, int], name: str, fault: str, read: bool, expected: float,
    shift_m: np.ndarray, light: float, is_wrong_way: bool,
) -> Pass:  # fmt: skip
    marker_id, along = f"{key[0]}.{key[1]}", float(key[1])
    if not read:
        return Pass(marker_id, name, False, expected, along)
    sigma = scene.noise_m * _NOISE_M[name]
    noise = rng.standard_t(3, 2) * sigma
    if rng.random() < 0.005:
        noise = rng.uniform(-8, 8, 2)  # a wrong pose, or the digits of a neighbour
    offset = noise + shift_m - markers.survey_m[key]
    if name == "cerpm":
        offset = noise - markers.survey_m[key]  # by its message: no vehicle's position is in it
    if fault == "moved":
        offset = offset + markers.offset_m[key]
    is_reversed: bool | None = None
    if name != "cerpm":
        is_reversed = bool((fault == "wrong-way") ^ is_wrong_way ^ (rng.random() < 0.001))
    quality = (
        light
        + rng.normal(0.0, 1.0)
        + 0.5 * (crc32(marker_id.encode()) % 100 / 50 - 1)
        - (4.0 if fault == "fading" else 0.0)
    )
    return Pass(
        marker_id, name, True, expected, along, (float(offset[0]), float(offset[1])), sigma, 0.1, name == "cerpm",
        SURVEY_SIGMA_M, 0.0, is_reversed, quality,
    )  # fmt: skip


def _miss_shares(scene: Scene, rng: Rng, miss: float, count: int) -> np.ndarray:
    """Shares that are missed along a drive: the vehicle's own, fog over it or a stretch, a dead sensor, trucks."""
    shares = np.full(count, miss)
    if rng.random() < scene.fog:
        first = 0 if rng.random() < 0.5 else int(rng.integers(count))
        shares[first : count if first == 0 else first + count // 3] = rng.uniform(0.8, 1.0)
    if rng.random() < 0.01:
        shares[int(rng.integers(count)) :] = 1.0  # the sensor fails
    for first in rng.integers(count, size=rng.poisson(count / 60)):
        shares[first : first + int(rng.integers(1, 4))] = 1.0  # a truck in front
    return shares


def run(scene: Scene, seeds: range) -> Iterator[Outcome]:
    """Outcomes of several seeds."""
    for seed in seeds:
        yield simulate(scene, seed)
