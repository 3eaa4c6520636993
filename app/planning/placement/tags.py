"""Information tags ahead of events: where they lie, and what they mean there."""

from __future__ import annotations

from dataclasses import replace

from app.formats.alignments.geometry import EventKind
from app.markers.magnet_codebook import Meaning, MeaningKind
from app.planning.alignment import Alignment, Lane, RoadEvent
from app.planning.placement.site import Site, distance_ahead_m
from app.planning.plan import LeftOut, Purpose
from app.planning.rules import TagRules

_ROUND_DISTANCE_M = 5.0  # [m] of the distance to a stop line; source: chosen by hand, so that few codes serve a road
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
