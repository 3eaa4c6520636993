"""Roads on which a vehicle hears the markers of more than the lane that it drives.

Each topology is the driven lane and the other marked lanes within radio range, in one frame. Boundaries are offsets of
a made lane's centre line, so widths, bends and positions are random.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely

from app.errors import InvalidParameter
from app.lanes.types import MarkerPlace
from app.markers.cerpm import LaneSide
from app.planning.cerpm_placement import place_markers
from app.simulation.radio.lanes import InstalledMarkers, TrueLane, install_markers, lane_between, make_lane
from app.values import Floats, Ints
from benchmarks.cerpm.scenes import LIMIT, SURVEY_M

LENGTH_M = 500.0
_MAX_CURVATURE_PER_M = 0.01  # [1/m] so that four lanes beside each other do not cross in a bend
_ORIGIN = (-83.7, 42.3, 250.0)
_TAPER_M = 120.0  # [m] over which a ramp comes beside a lane; a merging taper at 50 km/h
_AWAY_M = 12.0  # [m] of a ramp from its lane where it begins
_CHANGE_M = (40.0, 110.0)  # [m] of a change of lane: 3 to 8 s at 50 km/h
_ROW_M = 0.15  # [m] between the two rows of a double line


@dataclass(frozen=True, slots=True, eq=False)
class Topology:
    """A road: the lane that is driven, and all markers that are installed, by lane."""

    lane: TrueLane  # that is driven; of a vehicle that changes lane, the last one
    installed: InstalledMarkers  # of all lanes; chainages are along their own lanes
    own: frozenset[int]  # numbers of markers on the boundaries of the driven lane
    course: TrueLane  # between its boundaries the vehicle drives: the lane, but where it changes lane
    line: Ints  # of each installed marker, as a plan registers it: the boundary of the lane that placed it first


@dataclass(frozen=True, slots=True)
class _Row:
    """Markers of one boundary."""

    line_m: Floats
    side: LaneSide  # that they send: of the lane that placed them first
    own: bool


def make_topology(name: str, rng: np.random.Generator) -> Topology:
    """A road of a topology, at random."""
    for _ in range(100):
        try:
            return TOPOLOGIES[name](rng)
        except InvalidParameter:  # a bend that is tighter than the lanes beside it
            continue
    raise RuntimeError(f"no {name} in 100 attempts")


def _base(rng: np.random.Generator) -> TrueLane:
    return make_lane(rng, length_m=LENGTH_M, max_curvature_per_m=_MAX_CURVATURE_PER_M, origin=_ORIGIN)


def _offset(base: TrueLane, left_m: Floats | float) -> Floats:
    """A line beside the centre line of a lane."""
    normal = np.stack([-np.sin(base.yaw_rad), np.cos(base.yaw_rad)], 1)
    return np.asarray(base.centre_m + normal * np.broadcast_to(left_m, len(base.yaw_rad))[:, None])


def _lane(left_m: Floats, right_m: Floats) -> TrueLane:
    return lane_between(left_m[::8], right_m[::8], _ORIGIN)


def _build(
    driven: TrueLane, lanes: list[tuple[TrueLane, bool, bool]], rng: np.random.Generator, first: int = 1
) -> Topology:
    """Markers of lanes, each with whether its left and its right row are installed."""
    parts: list[InstalledMarkers] = []
    for lane, left, right in lanes:
        places = place_markers(lane.left_m, lane.right_m)
        kept: list[MarkerPlace] = [place for place in places if (left if place.side == LaneSide.LEFT else right)]
        part = install_markers(lane, kept, rng, speed_limit=LIMIT, survey_sd_m=SURVEY_M, first_number=first)
        first += len(part)
        parts.append(part)
    return _topology(driven, parts)


def _topology(driven: TrueLane, parts: list[InstalledMarkers]) -> Topology:
    """A road with the markers of several lanes, whose numbers differ."""
    names = ("number", "side", "chainage_m", "point_m", "lon_deg", "lat_deg", "broadcast_side")
    arrays: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    installed = replace(parts[0], **arrays)
    beside = np.minimum(_nearest_m(installed.point_m, driven.left_m), _nearest_m(installed.point_m, driven.right_m))
    own = frozenset(installed.number[beside < _ROW_M / 2].tolist())
    line = np.concatenate([3 * number + part.side for number, part in enumerate(parts)])
    return Topology(driven, installed, own, driven, line)


def _nearest_m(points_m: Floats, line_m: Floats) -> Floats:
    return np.asarray(shapely.distance(shapely.points(points_m), shapely.linestrings(line_m)))


def _beside(rng: np.random.Generator, count: int, shared: bool) -> Topology:
    """Lanes of one direction beside each other, the first on the right."""
    base, width = _base(rng), float(rng.uniform(3.0, 3.7))
    edges = [(k - count / 2) * width for k in range(count + 1)]
    gap = 0.0 if shared else _ROW_M / 2
    lanes = [_lane(_offset(base, edges[k + 1] - gap), _offset(base, edges[k] + gap)) for k in range(count)]
    which = int(rng.integers(count))
    rows = [(lane, True, k == 0 or not shared) for k, lane in enumerate(lanes)]
    return _build(lanes[which], rows, rng)


def _changing(rng: np.random.Generator, count: int, shared: bool, back: bool) -> Topology:
    """Lanes of one direction, and a vehicle that changes to another one, or to it and back."""
    base, width = _base(rng), float(rng.uniform(3.0, 3.7))
    edges = [(k - count / 2) * width for k in range(count + 1)]
    gap = 0.0 if shared else _ROW_M / 2
    lanes = [_lane(_offset(base, edges[k + 1] - gap), _offset(base, edges[k] + gap)) for k in range(count)]
    first = int(rng.integers(count))
    other = first + int(rng.choice([step for step in (-1, 1) if 0 <= first + step < count]))
    over_m, starts_m = rng.uniform(*_CHANGE_M, 2), [float(rng.uniform(130.0, 190.0)), float(rng.uniform(310.0, 350.0))]
    stays = [first, other, first] if back else [first, other]
    centre = np.full(len(base.chainage_m), edges[first] + width / 2)
    for k, (start, after) in enumerate(zip(starts_m, stays[1:], strict=False)):
        share = np.clip((base.chainage_m - start) / over_m[k], 0.0, 1.0)
        centre += (after - stays[k]) * width * (share - np.sin(2 * np.pi * share) / (2 * np.pi))
    course = _lane(_offset(base, centre + width / 2), _offset(base, centre - width / 2))
    rows = [(lane, True, k == 0 or not shared) for k, lane in enumerate(lanes)]
    return replace(_build(lanes[stays[-1]], rows, rng), course=course)


def _oncoming(rng: np.random.Generator) -> Topology:
    base, width = _base(rng), float(rng.uniform(2.9, 3.6))
    own = _lane(_offset(base, -_ROW_M / 2), _offset(base, -width))
    other = _lane(_offset(base, _ROW_M / 2)[::-1], _offset(base, width)[::-1])
    return _build(own, [(own, True, True), (other, bool(rng.random() < 0.5), True)], rng)


def _ramp(rng: np.random.Generator, merges: bool, driven_ramp: bool) -> Topology:
    """A ramp on the right that comes beside the lane and runs along it, or leaves it."""
    base, width = _base(rng), float(rng.uniform(3.2, 3.7))
    at = base.chainage_m if merges else base.length_m - base.chainage_m
    share = np.clip((at - 60.0) / _TAPER_M, 0.0, 1.0)
    away = _AWAY_M * (1 - (1 - np.cos(np.pi * share)) / 2)
    main = _lane(_offset(base, width / 2), _offset(base, -width / 2))
    ramp_left, ramp_right = -width / 2 - away, -width / 2 - away - width
    ramp = _lane(_offset(base, ramp_left), _offset(base, ramp_right))
    on_main = _build(main, [(main, True, True)], rng).installed
    on_ramp = _build(ramp, [(ramp, True, True)], rng, first=len(on_main) + 1).installed
    shared = _nearest_m(on_ramp.point_m, main.right_m) < 0.3  # there the line between them is marked once
    return _topology(ramp if driven_ramp else main, [on_main, on_ramp.chosen(~shared)])


def _crossing(rng: np.random.Generator) -> Topology:
    base, width = _base(rng), float(rng.uniform(3.0, 3.6))
    own = _lane(_offset(base, width / 2), _offset(base, -width / 2))
    middle = base.centre_m[len(base.centre_m) // 2]
    angle = base.yaw_rad[len(base.yaw_rad) // 2] + math.radians(float(rng.uniform(50, 130)))
    ahead, left = np.array([math.cos(angle), math.sin(angle)]), np.array([-math.sin(angle), math.cos(angle)])
    line = middle + np.linspace(-150, 150, 601)[:, None] * ahead
    lanes = [(own, True, True)]
    for direction in (1, -1):
        near, far = line - direction * left * 0.08, line - direction * left * width
        lanes.append((lane_between(near[::direction], far[::direction], _ORIGIN), True, True))
    return _build(own, lanes, rng)


def _frontage(rng: np.random.Generator) -> Topology:
    base, width = _base(rng), float(rng.uniform(3.0, 3.6))
    away, left = float(rng.uniform(7.0, 12.0)), -1 if rng.random() < 0.5 else 1
    own = _lane(_offset(base, width / 2), _offset(base, -width / 2))
    other = _lane(_offset(base, left * away + width / 2), _offset(base, left * away - width / 2))
    return _build(own, [(own, True, True), (other, True, True)], rng)


def _arcs(pieces: list[tuple[float, float]], heading_rad: float) -> Floats:
    """A line of arcs of a length and a curvature, every 0.25 m."""
    curvature = np.concatenate([np.full(round(length / 0.25), k) for length, k in pieces])
    smooth = np.convolve(np.pad(curvature, 24, mode="edge"), np.ones(49) / 49, mode="valid")
    yaw = heading_rad + np.concatenate([[0.0], np.cumsum(smooth * 0.25)])
    mid = (yaw[1:] + yaw[:-1]) / 2
    steps = 0.25 * np.stack([np.cos(mid), np.sin(mid)], 1)
    return np.asarray(np.concatenate([[[0.0, 0.0]], np.cumsum(steps, axis=0)]))


def _around(line_m: Floats, left_m: float, right_m: float) -> TrueLane:
    step = np.gradient(line_m, axis=0)
    normal = np.stack([-step[:, 1], step[:, 0]], 1) / np.linalg.norm(step, axis=1)[:, None]
    return lane_between((line_m + left_m * normal)[::2], (line_m - right_m * normal)[::2], _ORIGIN)


def _roundabout(rng: np.random.Generator) -> Topology:
    """In by a short bend to the right, around to the left, out by a bend to the right; the circle's other part too."""
    radius, half = float(rng.uniform(14, 22)), float(rng.uniform(1.9, 2.3))
    heading, turn = float(rng.uniform(-math.pi, math.pi)), float(rng.choice([math.pi / 2, math.pi, 1.5 * math.pi]))
    bend = math.radians(55)
    inward = (15.0 * bend, -1 / 15.0)
    line = _arcs(
        [(100.0, 0.0), inward, (radius * (turn - math.pi + 2 * bend + math.pi / 2), 1 / radius), inward, (100.0, 0.0)],
        heading,
    )
    own = _around(line, half, half)
    start = round((100.0 + inward[0]) / 0.25)
    step = line[start + 6] - line[start + 5]
    middle = line[start + 5] + radius * np.array([-step[1], step[0]]) / np.linalg.norm(step)
    angle = np.linspace(0, 2 * math.pi * 0.98, round(2 * math.pi * radius * 2))
    circle = middle + radius * np.stack([np.cos(angle), np.sin(angle)], 1)
    return _with_others(own, [_around(circle, half, half)], rng)


def _u_turn(rng: np.random.Generator) -> Topology:
    """Out, around, and back on the other carriageway; both go on past the turn."""
    radius, half = float(rng.uniform(9, 14)), float(rng.uniform(1.8, 2.2))
    heading = float(rng.uniform(-math.pi, math.pi))
    line = _arcs([(170.0, 0.0), (math.pi * radius, 1 / radius), (170.0, 0.0)], heading)
    own = _around(line, half, half)
    ahead = np.array([math.cos(heading), math.sin(heading)])
    out = np.linspace(0, 300, 1201)[:, None] * ahead
    back = line[-1] + np.linspace(300, 0, 1201)[:, None] * ahead
    return _with_others(own, [_around(out, half, half), _around(back, half, half)], rng)


def _with_others(own: TrueLane, others: list[TrueLane], rng: np.random.Generator) -> Topology:
    """The driven lane, and those markers of other lanes that stand neither on it nor on its boundaries."""
    parts = [_build(own, [(own, True, True)], rng).installed]
    for lane in others:
        part = _build(lane, [(lane, True, True)], rng, first=int(parts[-1].number.max()) + 1).installed
        on = _nearest_m(part.point_m, own.centre_m) < float(own.width_m.max()) / 2 + 0.6
        parts.append(part.chosen(~on))
    return _topology(own, parts)


TOPOLOGIES: dict[str, Callable[[np.random.Generator], Topology]] = {
    "two lanes": lambda rng: _beside(rng, 2, shared=False),
    "two lanes, shared line": lambda rng: _beside(rng, 2, shared=True),
    "three lanes": lambda rng: _beside(rng, 3, shared=True),
    "oncoming lane": _oncoming,
    "merge": lambda rng: _ramp(rng, merges=True, driven_ramp=bool(rng.random() < 0.5)),
    "exit": lambda rng: _ramp(rng, merges=False, driven_ramp=bool(rng.random() < 0.5)),
    "crossing": _crossing,
    "frontage road": _frontage,
    "roundabout": _roundabout,
    "U-turn": _u_turn,
    "lane change": lambda rng: _changing(rng, int(rng.integers(2, 4)), bool(rng.random() < 0.5), back=False),
    "overtaking": lambda rng: _changing(rng, int(rng.integers(2, 4)), bool(rng.random() < 0.5), back=True),
}
