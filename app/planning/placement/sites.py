"""Places on lanes before codes are assigned, family by family, and clear of areas to avoid."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy
import shapely

from app.formats.alignments.geometry import BoundaryStyle, EventKind
from app.geodesy.frames import ecef_from_wgs84
from app.markers.cerpm import LaneSide
from app.markers.magnet import MIN_GAP_M
from app.markers.magnet_design import Meaning, MeaningKind
from app.planning.alignment import Alignment, Lane, RoadEvent
from app.planning.magnet_checks import turn_margin_m
from app.planning.plan import LeftOut, Purpose
from app.planning.rules import Ahead, AvoidRules, LineRules, PlanRules, PlateRules, TagRules
from app.values import Floats

# === Places on lanes before codes are assigned, and the distances ahead of events at which they are.


GRAVITY_M_S2 = 9.81  # [m/s2] source: the stopping distance on a grade, AASHTO Green Book (2018), equation 3-3
_APPROACH_M = 300.0  # [m] before an event, whose highest design speed counts; above the stopping
# distance at 130 km/h


@dataclass(frozen=True, slots=True)
class Site:
    """A place for one marker on a lane."""

    # `chainage_m`, `offset_m`: [m] along the centre line, and from it, left positive; of a tag its first magnet
    chainage_m: float
    offset_m: float
    purpose: Purpose
    event: RoadEvent | None = None  # what it stands ahead of
    meaning: Meaning | None = None  # of a tag
    side: LaneSide = LaneSide.UNKNOWN  # of the boundary or the painted line on which it stands
    style: BoundaryStyle = BoundaryStyle.UNKNOWN  # of the painted line


def distance_ahead_m(lane: Lane, event_m: float, rule: Ahead) -> float:
    """How far ahead of an event a vehicle must know of it. [m]

    Notes
    -----
    Stopping distance: v t + v^2 / (2 g (a / g + G)) with the grade G of the approach, AASHTO Green Book (2018),
    equations 3-2 and 3-3. Reaction distance: v t. The highest design speed of the 300 m before the event counts.
    """
    approach = (lane.chainage_m >= event_m - _APPROACH_M) & (lane.chainage_m <= event_m)
    speed = float(lane.design_speed_m_s[approach].max()) if approach.any() else float(lane.design_speed_m_s[0])
    if not isinstance(rule.before, str):
        return max(rule.before, rule.min_before_m)
    distance = speed * rule.reaction_s
    if rule.before == "stopping_distance":
        grade = float(lane.grade[approach].mean()) if approach.any() else 0.0
        friction = max(rule.deceleration_m_s2 / GRAVITY_M_S2 + grade, 0.05)
        distance += speed**2 / (2 * GRAVITY_M_S2 * friction)
    return max(distance, rule.min_before_m)


def spread_evenly(start_m: float, end_m: float, spacing_m: float) -> Floats:
    """Middles of the fewest equal parts of a stretch that are no longer than the spacing, shape (K,). [m]"""
    count = max(int(np.ceil((end_m - start_m) / spacing_m - 1e-9)), 1)
    return np.asarray(start_m + (np.arange(count) + 0.5) * (end_m - start_m) / count)


# === Boundaries of lanes as lines on the road: one that two lanes share is found, so that it is marked once.


SAME_LINE_M = 0.6
"""Boundaries nearer than this are one line. [m] Above the width of a double line."""


class Stretch(NamedTuple):
    """Part of a boundary that no lane before it has: samples of the lane, and distances along it. [m]"""

    lane: Lane
    side: LaneSide
    offset_m: Floats
    first: int
    last: int
    along_m: Floats

    @property
    def length_m(self) -> float:
        """Along the boundary, which is longer than the lane outside of bends. [m]"""
        return float(self.along_m[self.last] - self.along_m[self.first])

    def chainages_m(self, spacing_m: float, circumference_m: tuple[float, float]) -> Floats:
        """Chainages of the fewest points at even distances along the boundary, both ends among them, shape (K,). [m]

        The points are no half, one or two turns of the vehicles' wheels apart, where any distance is left.
        """
        fewest = max(int(np.ceil(self.length_m / spacing_m - 1e-9)), 1)
        steps = range(fewest, max(int(self.length_m / MIN_GAP_M), fewest) + 1)
        free = (n for n in steps if turn_margin_m(self.length_m / n, circumference_m) >= 0)
        count = next(free, fewest) + 1
        at = self.along_m[self.first] + np.linspace(0.0, self.length_m, count)
        part = slice(self.first, self.last + 1)
        return np.asarray(np.interp(at, self.along_m[part], self.lane.chainage_m[part]))


class Boundaries:
    """Boundaries that are known so far."""

    def __init__(self) -> None:
        self._trees: list[scipy.spatial.cKDTree] = []
        self._sides: list[tuple[str, LaneSide]] = []
        self.shared_as_other_side: set[tuple[str, LaneSide]] = set()
        """Boundaries (lane, side) that are the other side of another lane."""

    def add(self, lane: Lane, side: LaneSide, shift_m: float = 0.0) -> list[Stretch]:
        """Stretches of a lane's boundary, shifted to the left by `shift_m`, that no earlier boundary covers."""
        sign = 1.0 if side is LaneSide.LEFT else -1.0
        offset = sign * lane.width_m / 2 + shift_m
        points = ecef_from_wgs84(*lane.position_at(lane.chainage_m, offset))
        reach_m = float(np.hypot(SAME_LINE_M, lane.step_m))
        covered = np.zeros(len(points), dtype=bool)
        for tree, (other, other_side) in zip(self._trees, self._sides, strict=True):
            near = np.isfinite(tree.query(points, distance_upper_bound=reach_m)[0])
            covered |= near
            if near.mean() > 0.5 and other_side is not side:
                self.shared_as_other_side.add((other, other_side))
        self._trees.append(scipy.spatial.cKDTree(points))
        self._sides.append((lane.name, side))
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        return [Stretch(lane, side, offset, first, last, along) for first, last in _runs(~covered)]


def _runs(flags: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last index of each run of flags that are set."""
    edges = np.flatnonzero(np.diff(flags.astype(np.int8), prepend=0, append=0))
    return [(int(start), int(end) - 1) for start, end in zip(edges[::2], edges[1::2], strict=True)]


# === Places that keep clear of areas: moved along the lane, or left out with the reason.


_SHIFT_STEP_M = 0.25  # [m] finer than a crew moves a marker to keep clear of a joint
_M_PER_DEG = 111_195.0  # [m/deg] on a sphere of 6371 km; source: the Earth's mean radius
_EDGE_M = 0.5  # [m] from the ends of a lane, where nothing is placed


class AvoidedAreas:
    """The areas of an alignment that the rules name, with their clearance."""

    def __init__(self, alignment: Alignment, rules: AvoidRules) -> None:
        chosen = [area for area in alignment.areas if area.kind in rules.layers]
        self.rules = rules
        self.kinds = [area.kind for area in chosen]
        self._rings = [_with_clearance(area.ring_deg, rules.clearance_m) for area in chosen]
        self._tree = shapely.STRtree(self._rings)

    def __len__(self) -> int:
        return len(self.kinds)

    def find(self, lon_deg: Floats, lat_deg: Floats) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
        """Number of an area that contains each place, -1 for none, shape (N,)."""
        found = np.full(len(lon_deg), -1, dtype=np.intp)
        if self.kinds:
            place, area = self._tree.query(shapely.points(lon_deg, lat_deg), predicate="intersects")
            found[place] = area
        return found

    def keep_clear(self, lane: Lane, family: str, sites: Sequence[Site]) -> tuple[list[Site], list[LeftOut]]:
        """Sites that are clear, moved along the lane where that helps, and what became of the others."""
        if not self.kinds or not sites:
            return list(sites), []
        chainage = np.array([site.chainage_m for site in sites])
        offset = np.array([site.offset_m for site in sites])
        inside = self.find(*lane.position_at(chainage, offset))
        kept, left_out = [], []
        for site, area in zip(sites, inside.tolist(), strict=True):
            if area < 0:
                kept.append(site)
                continue
            moved_m = self._nearest_clear(lane, site)
            name = f"{self.kinds[area]} within {self.rules.clearance_m:g} m"
            if moved_m is None:
                reason = f"{name}, and no clear place within {self.rules.max_shift_m:g} m along the lane"
                left_out.append(LeftOut(family, lane.name, site.chainage_m, reason))
                continue
            kept.append(replace(site, chainage_m=site.chainage_m + moved_m))
            left_out.append(LeftOut(family, lane.name, site.chainage_m, name, moved_m))
        return kept, left_out

    def _nearest_clear(self, lane: Lane, site: Site) -> float | None:
        """Shift along the lane to the nearest clear place; backwards first, where vehicles come from. [m]"""
        shifts = np.array(list(_shifts(self.rules.max_shift_m)))
        chainage = site.chainage_m + shifts
        on_lane = (chainage >= _EDGE_M) & (chainage <= lane.length_m - _EDGE_M)
        shifts, chainage = shifts[on_lane], chainage[on_lane]
        if not len(shifts):
            return None
        clear = np.flatnonzero(self.find(*lane.position_at(chainage, site.offset_m)) < 0)
        return float(shifts[clear[0]]) if len(clear) else None


def _shifts(max_m: float) -> Iterator[float]:
    for k in range(1, int(max_m / _SHIFT_STEP_M) + 1):
        yield -k * _SHIFT_STEP_M
        yield k * _SHIFT_STEP_M


def _with_clearance(ring_deg: Floats, clearance_m: float) -> shapely.Geometry:
    """The area grown by the clearance, in degrees; grown in a local plane, where a degree of longitude is shorter."""
    shrink = math.cos(math.radians(float(ring_deg[:, 1].mean())))
    scale = np.array([_M_PER_DEG * shrink, _M_PER_DEG])
    grown = shapely.buffer(shapely.make_valid(shapely.Polygon(ring_deg * scale)), clearance_m)
    return shapely.transform(grown, lambda points: points / scale)


# === Places of line magnets along painted lines; a line between two lanes is placed once.


def place_line_magnets(
    lane: Lane, rules: LineRules, painted: Boundaries, circumference_m: tuple[float, float]
) -> list[Site]:
    """Magnets of a lane's painted lines that no lane before it has, at even distances along each line.

    They do not repeat with the turns of wheels of these circumferences.

    A line of unknown style counts as solid; `check_plan` says so.
    """
    sites = []
    for side, style in ((LaneSide.LEFT, lane.left_style), (LaneSide.RIGHT, lane.right_style)):
        polarity = rules.dashed if style is BoundaryStyle.DASHED else rules.solid
        if rules.sides not in ("both", side.name.lower()) or style is BoundaryStyle.NONE or polarity is None:
            continue
        for stretch in painted.add(lane, side, rules.offset_m):
            if stretch.length_m < rules.max_spacing_m / 2:
                continue
            chainages = stretch.chainages_m(rules.max_spacing_m, circumference_m)
            offsets = lane.value_at(stretch.offset_m, chainages)
            sites += [
                Site(chainage, offset, Purpose.PAINTED_LINE, side=side, style=style)
                for chainage, offset in zip(chainages.tolist(), offsets.tolist(), strict=True)
            ]
    return sites


# === Information tags ahead of events: where they lie, and what they mean there.


_ROUND_DISTANCE_M = 5.0  # [m] of the distance to a stop line; so that few codes serve a road
_ROUND_TURN_DEG = 5.0  # [deg] of a bend's turn; source: as above; the METRO paper names a "125 degree right turn"
_FROM_START_M = 0.5  # [m] of the lane, where no magnet is; source: the magnets' smallest gap


def place_tags(alignment: Alignment, lane: Lane, rules: TagRules) -> tuple[list[Site], list[LeftOut]]:
    """Tags of a lane by chainage: their last magnet is the needed distance before the event."""
    sites: list[Site] = []
    left_out: list[LeftOut] = []
    for event in alignment.events:
        if event.lane != lane.name or event.kind not in rules.at:
            continue
        distance_m = distance_ahead_m(lane, event.chainage_m, rules)
        if event.kind is EventKind.ARROW:
            distance_m = 0.0  # METRO section 6.3: the tag of an arrow lies on the marking
        start_m = event.chainage_m - distance_m - rules.length_m
        if start_m < _FROM_START_M:
            reason = (
                f"{event.kind.value} at {event.chainage_m:.0f} m needs its tag {distance_m + rules.length_m:.0f} m "
                "before it, which is before the lane's start"
            )
            left_out.append(LeftOut("magnet", lane.name, event.chainage_m, reason))
            continue
        meaning = meaning_of(event, distance_m)
        sites.append(Site(start_m, 0.0, Purpose.INFORMATION, event, meaning))
    return _without_overlaps(lane, rules, sites, left_out), left_out


def meaning_of(event: RoadEvent, distance_m: float) -> Meaning:
    """What a tag ahead of an event says: its kind, with the value rounded so that few codes serve a road."""
    match event.kind:
        case EventKind.STOP_LINE:
            rounded = max(round(distance_m / _ROUND_DISTANCE_M) * _ROUND_DISTANCE_M, 1.0)
            return Meaning(MeaningKind.STOP_LINE_AHEAD, float(rounded))
        case EventKind.ARROW:
            return Meaning(MeaningKind.ARROW, event.value if event.value is not None else "straight")
        case EventKind.SPEED_LIMIT:
            return Meaning(MeaningKind.SPEED_LIMIT_KMH, float(event.value or 0.0))
        case EventKind.CURVE:
            turn = float(event.value or 0.0)
            size = min(max(round(abs(turn) / _ROUND_TURN_DEG) * _ROUND_TURN_DEG, 5.0), 180.0)
            return Meaning(MeaningKind.BEND_LEFT if turn > 0 else MeaningKind.BEND_RIGHT, float(size))
        case EventKind.JUNCTION:
            return Meaning(MeaningKind.NOTICE, "junction ahead")
        case EventKind.CROSSING:
            return Meaning(MeaningKind.NOTICE, "crossing ahead")


def _without_overlaps(lane: Lane, rules: TagRules, sites: list[Site], left_out: list[LeftOut]) -> list[Site]:
    """Tags that would overlap lie one behind the other, the later one first moved back; a tag length between them."""
    kept: list[Site] = []
    limit_m = lane.length_m - rules.length_m
    for tag in sorted(sites, key=lambda tag: -tag.chainage_m):
        chainage = min(tag.chainage_m, limit_m)
        if chainage < _FROM_START_M:
            reason = "the tags of the events behind it leave no room for it on the lane"
            left_out.append(LeftOut("magnet", lane.name, tag.chainage_m, reason))
            continue
        limit_m = chainage - 2 * rules.length_m
        kept.append(replace(tag, chainage_m=chainage))
    return kept[::-1]


# === Places of plates: mid-lane at a spacing, and ahead of decision points.


_REPLACED_SHARE = 0.25  # of the spacing, within which a plate at a decision point replaces one
_FROM_END_M = 1.0  # [m] of the lane, where no plate is; more than half a plate's diagonal


def place_plates(
    alignment: Alignment,
    lane: Lane,
    rules: PlanRules,
    tags_m: Sequence[tuple[float, float]] = (),
    chosen_m: Sequence[float] | None = None,
) -> tuple[list[Site], list[LeftOut]]:
    """Sites of a lane's plates by chainage, and what was left out.

    A plate that would cover a magnet of a tag lies before the tag; `tags_m` are the tags' first and last chainages. [m]
    Plates stand at `chosen_m` instead of at the spacing of the rules, if it is given. [m]
    """
    assert rules.plates is not None
    ahead, left_out = _ahead_of_events(alignment, lane, rules, rules.plates)
    taken = [site.chainage_m for site in ahead]
    near_m = 0.0 if chosen_m is not None else _REPLACED_SHARE * rules.plates.spacing_m
    sites = list(ahead)
    spaced_m = spread_evenly(0.0, lane.length_m, rules.plates.spacing_m).tolist() if chosen_m is None else chosen_m
    for chainage in spaced_m:
        if all(abs(chainage - other) > near_m for other in taken):
            sites.append(Site(chainage, rules.plates.offset_from_centre_m, Purpose.SPACING))
    kept = []
    clear_m = plate_room_m(rules.plates)
    sites = [_before_tags(site, tags_m, clear_m) for site in sites]
    for site in sorted(sites, key=lambda site: site.chainage_m):
        grade = float(lane.value_at(lane.grade, site.chainage_m))
        if abs(grade) > rules.plates.max_grade:
            reason = f"the grade is {grade:.1%}, above the {rules.plates.max_grade:.1%} of plates.max_grade"
            left_out.append(LeftOut("plate", lane.name, site.chainage_m, reason))
        else:
            kept.append(site)
    return kept, left_out


def covered_by_tags_m(alignment: Alignment, lane: Lane, rules: PlanRules) -> list[tuple[float, float]]:
    """Stretches of a lane in which a plate would cover a magnet of a tag. [m]"""
    if rules.tags is None or rules.plates is None:
        return []
    room_m = plate_room_m(rules.plates)
    sites, _ = place_tags(alignment, lane, rules.tags)
    return [(site.chainage_m - room_m, site.chainage_m + rules.tags.length_m + room_m) for site in sites]


def plate_room_m(plates: PlateRules) -> float:
    """Distance of a plate's centre from the nearest magnet of a tag. [m]"""
    return (plates.n * (plates.unit_mm + plates.gap_mm) + plates.gap_mm) / 2000 + MIN_GAP_M


def _ahead_of_events(
    alignment: Alignment, lane: Lane, rules: PlanRules, plates: PlateRules
) -> tuple[list[Site], list[LeftOut]]:
    sites: list[Site] = []
    left_out: list[LeftOut] = []
    points = rules.decision_points
    if points is None:
        return sites, left_out
    for event in alignment.events:
        if event.lane != lane.name or event.kind not in points.at:
            continue
        distance_m = distance_ahead_m(lane, event.chainage_m, points)
        chainage = event.chainage_m - distance_m
        if chainage < _FROM_END_M:
            reason = f"{event.kind.value} at {event.chainage_m:.0f} m needs a plate {distance_m:.0f} m before it, " + (
                "which is before the lane's start"
            )
            left_out.append(LeftOut("plate", lane.name, event.chainage_m, reason))
            continue
        sites.append(Site(chainage, plates.offset_from_centre_m, Purpose.DECISION_POINT, event))
    return _merge_near(sites), left_out


def _before_tags(site: Site, tags_m: Sequence[tuple[float, float]], clear_m: float) -> Site:
    """The site, moved back until no tag is under it."""
    for first_m, last_m in sorted(tags_m, reverse=True):
        if first_m - clear_m < site.chainage_m < last_m + clear_m:
            site = replace(site, chainage_m=max(first_m - clear_m, _FROM_END_M))
    return site


def _merge_near(sites: list[Site]) -> list[Site]:
    """Sites of several events at nearly the same place as one: the first, which is ahead of all of them."""
    merged: list[Site] = []
    for site in sorted(sites, key=lambda site: site.chainage_m):
        if not merged or site.chainage_m - merged[-1].chainage_m > 2 * _FROM_END_M:
            merged.append(site)
    return merged
