"""Conflicts between markers of a plan, and with markers that are installed or planned."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from app.geodesy.ellipsoid import ecef_from_wgs84
from app.markers.checks import Verdict
from app.markers.magnet import MIN_GAP_M
from app.planning.alignment import Floats
from app.planning.plan import Plan, PlanFinding, PlannedLineMagnet, PlannedMarker, PlannedPlate, PlannedTag
from app.planning.plan_checks.finding import compare

CONFUSION_M = 20.0
"""Distance within which equal codes of two markers are confused. [m] Source: chosen by hand, a receiver's position in a
street of houses."""
_ROOM_M = {"cerpm": 0.1, "magnet": MIN_GAP_M / 2}  # [m] half of the free distance round a marker; source: its size


@dataclass(frozen=True, slots=True)
class ExistingMarker:
    """A marker of the registry near the plan."""

    marker_id: str
    family: str
    code: str
    lon_deg: float
    lat_deg: float
    status: str
    radius_m: float = 0.25


def check_conflicts(plan: Plan, existing: Sequence[ExistingMarker]) -> Iterator[PlanFinding]:
    """Overlaps and equal codes, within the plan and with existing markers; registry numbers used twice."""
    if not plan.markers:
        return
    places, owners, room = _footprints(plan.markers)
    yield _overlaps(places, owners, room)
    yield _equal_codes(plan.markers)
    numbers = [(marker.family, marker.code) for marker in plan.markers if marker.family != "magnet"]
    yield compare(
        "unique-codes", len(numbers) - len(set(numbers)), "<=", 0, "markers", "docs/architecture.md",
        "plates and CERPMs whose code another marker of the plan has",
    )  # fmt: skip
    if existing:
        yield _existing_overlaps(places, owners, room, existing)
        yield _existing_codes(plan.markers, existing)


def _footprints(markers: Sequence[PlannedMarker]) -> tuple[Floats, list[PlannedMarker], Floats]:
    """Centres, their markers, and radii in which nothing else may be; a tag has one for each magnet."""
    lon, lat, room, owners = [], [], [], []
    for marker in markers:
        detail = marker.detail
        if isinstance(detail, PlannedTag):
            for _, magnet_lon, magnet_lat in detail.magnets:
                lon.append(magnet_lon)
                lat.append(magnet_lat)
                room.append(_ROOM_M["magnet"])
                owners.append(marker)
            continue
        lon.append(marker.lon_deg)
        lat.append(marker.lat_deg)
        if isinstance(detail, PlannedPlate):
            room.append(detail.geometry.side_mm / 2000 * math.sqrt(2))  # half a diagonal
        else:
            room.append(_ROOM_M[marker.family])
        owners.append(marker)
    return ecef_from_wgs84(np.array(lon), np.array(lat)), owners, np.array(room)


def _overlaps(places: Floats, owners: list[PlannedMarker], room: Floats) -> PlanFinding:
    """Pairs of markers of one plan that stand in each other's place."""
    pairs = scipy.spatial.cKDTree(places).query_pairs(2 * float(room.max()), output_type="ndarray")
    apart = np.linalg.norm(places[pairs[:, 0]] - places[pairs[:, 1]], axis=1)
    near = pairs[apart < room[pairs[:, 0]] + room[pairs[:, 1]] - 0.001]
    found = [(a, b) for a, b in near.tolist() if owners[a] is not owners[b]]
    names = ", ".join(f"{owners[a].number} and {owners[b].number}" for a, b in found[:3])
    sentence = f"markers that overlap: {names}" if found else "markers that overlap"
    return compare(
        "overlaps", len(found), "<=", 0, "pairs", "sizes of the markers; METRO figure 17a for magnets", sentence,
        owners[found[0][0]] if found else None,
    )  # fmt: skip


def _equal_codes(markers: Sequence[PlannedMarker]) -> PlanFinding:
    """Tags and plates of equal codes so near to each other that a vehicle cannot know which it read."""
    coded = [marker for marker in markers if not isinstance(marker.detail, PlannedLineMagnet)]
    groups: dict[tuple[str, str], list[PlannedMarker]] = {}
    for marker in coded:
        groups.setdefault((marker.family, marker.code), []).append(marker)
    found: list[tuple[PlannedMarker, PlannedMarker]] = []
    for group in groups.values():
        if len(group) > 1:
            points = ecef_from_wgs84(np.array([m.lon_deg for m in group]), np.array([m.lat_deg for m in group]))
            found += [(group[a], group[b]) for a, b in sorted(scipy.spatial.cKDTree(points).query_pairs(CONFUSION_M))]
    names = ", ".join(f"{a.number} and {b.number}" for a, b in found[:3])
    sentence = f"pairs of equal codes within {CONFUSION_M:g} m of each other" + (f": {names}" if found else "")
    return compare(
        "confusable-codes", len(found), "<=", 0, "pairs", "position uncertainty without markers", sentence,
        found[0][0] if found else None, missed=Verdict.WARN,
    )  # fmt: skip


def _existing_overlaps(
    places: Floats, owners: list[PlannedMarker], room: Floats, existing: Sequence[ExistingMarker]
) -> PlanFinding:
    points = _points(existing)
    distance, nearest = (np.asarray(found) for found in scipy.spatial.cKDTree(points).query(places))
    radius = np.array([marker.radius_m for marker in existing])
    over = np.flatnonzero(distance < room + radius[nearest])
    sentence = "planned markers that stand in the place of an installed or planned one"
    if len(over):
        first = existing[int(nearest[over[0]])]
        sentence += f": number {owners[int(over[0])].number} and the {first.status} {first.family} {first.marker_id}"
    return compare(
        "existing-markers", len(over), "<=", 0, "markers", "the registry", sentence,
        owners[int(over[0])] if len(over) else None,
    )  # fmt: skip


def _existing_codes(markers: Sequence[PlannedMarker], existing: Sequence[ExistingMarker]) -> PlanFinding:
    known: dict[tuple[str, str], list[ExistingMarker]] = {}
    for stored in existing:
        known.setdefault((stored.family, stored.code), []).append(stored)
    found = []
    for marker in markers:
        if isinstance(marker.detail, PlannedLineMagnet):
            continue
        for other in known.get((marker.family, marker.code), ()):
            if marker.family != "magnet" or _apart_m(marker, other) < CONFUSION_M:
                found.append((marker, other))
    sentence = "planned markers with the code of an installed or planned one"
    if found:
        sentence += f": number {found[0][0].number} and {found[0][1].marker_id}"
    return compare(
        "existing-codes", len(found), "<=", 0, "markers", "the registry", sentence, found[0][0] if found else None
    )


def _apart_m(marker: PlannedMarker, other: ExistingMarker) -> float:
    a = ecef_from_wgs84(np.array([marker.lon_deg, other.lon_deg]), np.array([marker.lat_deg, other.lat_deg]))
    return float(np.linalg.norm(a[0] - a[1]))


def _points(existing: Sequence[ExistingMarker]) -> Floats:
    return ecef_from_wgs84(np.array([m.lon_deg for m in existing]), np.array([m.lat_deg for m in existing]))
