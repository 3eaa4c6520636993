"""Places of plates: mid-lane at a spacing, and ahead of decision points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from app.markers.magnet import MIN_GAP_M
from app.planning.alignment import Alignment, Lane
from app.planning.placement.site import Site, distance_ahead_m, spread_evenly
from app.planning.placement.tags import place_tags
from app.planning.plan import LeftOut, Purpose
from app.planning.rules import PlanRules, PlateRules

_REPLACED_SHARE = 0.25  # of the spacing, within which a plate at a decision point replaces one; source: chosen by hand
_FROM_END_M = 1.0  # [m] of the lane, where no plate is; source: chosen by hand, more than half a plate's diagonal


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
