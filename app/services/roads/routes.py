"""Roads as routes: positions to measures and offsets, and back; what a marker's place on its road is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
import orjson
import sqlalchemy as sa

from app.registry.roads import ROADS, RoadRow, StoredStation
from app.roads.axis import Axis, Foot
from app.roads.measures import CalibrationPoint, Measures, calibrate

MARKER_REACH_M = 100.0
"""A marker that is farther from its road's axis has no measure on it. [m]"""
AMBIGUOUS_M = 1.0
"""Feet whose distances differ by less than this cannot be distinguished by the position alone. [m]"""
_ON_END_M = 0.01
_AT_ONCE = 1_000  # markers that are located at the same time; source: as `locate` of a road, bounds its pairs


@dataclass(frozen=True, slots=True)
class Route:
    """An axis with its measures."""

    axis: Axis
    measures: Measures

    def feet(self, positions: Sequence[tuple[float, float]], reach_m: float) -> list[list[Foot]]:
        """Feet of positions (lon_deg, lat_deg), for each the nearest first."""
        lon, lat = (np.array([position[k] for position in positions], dtype=np.float64) for k in (0, 1))
        return self.axis.locate(lon, lat, reach_m)

    def measure_of(self, foot: Foot) -> float:
        """Measure of a foot. [m]"""
        return self.measures.measure_at(foot.part, foot.chainage_m)


def route_of(row: RoadRow) -> Route:
    """The route of a road's row; those of the last 64 are kept."""
    return _route(orjson.dumps([row.parts, row.calibration]))


@lru_cache(maxsize=64)
def _route(content: bytes) -> Route:
    parts, points = orjson.loads(content)
    return build_route(parts, [calibration_point(point) for point in points])


def build_route(parts: Sequence[Sequence[Sequence[float]]], points: Sequence[CalibrationPoint]) -> Route:
    """A route from its lines and its calibration.

    Raises
    ------
    InvalidParameter
        The lines are none, or the measures do not rise along them.
    """
    axis = Axis(parts)
    return Route(axis, calibrate(axis.part_ranges_m, points))


def calibration_point(stored: StoredStation) -> CalibrationPoint:
    """A calibration point as it is stored."""
    return CalibrationPoint(stored["part"], stored["chainage_m"], stored["measure_m"], stored["ahead_m"])


def is_ambiguous(feet: Sequence[Foot]) -> bool:
    """Whether the position alone does not determine the foot."""
    return len(feet) > 1 and feet[1].distance_m - feet[0].distance_m < AMBIGUOUS_M


# --- markers on roads ---------------------------------------------------------------------------------------------


class Reference(NamedTuple):
    """A marker's place on its road, or why it has none there."""

    measure_m: float | None
    offset_m: float | None
    why_not: str | None = None


def references_of(
    route: Route,
    positions: Sequence[tuple[float, float]],
    before_m: Sequence[float | None],
    old: Route | None = None,
) -> list[Reference]:
    """Places of markers on a road.

    Parameters
    ----------
    positions : sequence of (lon_deg, lat_deg)
    before_m : sequence of float or None
        Their previous measures, which distinguish ambiguous feet. [m]
    old : Route, optional
        What those measures were on, if that was another.
    """
    found = []
    located = chain.from_iterable(
        route.feet(positions[start : start + _AT_ONCE], MARKER_REACH_M) for start in range(0, len(positions), _AT_ONCE)
    )
    for feet, measure_m in zip(located, before_m, strict=True):
        if not feet:
            found.append(Reference(None, None, f"farther than {MARKER_REACH_M:g} m from the road"))
            continue
        foot = feet[0]
        if is_ambiguous(feet):
            if measure_m is None:
                found.append(Reference(None, None, "the road passes more than once"))
                continue
            near = [f for f in feet if f.distance_m - foot.distance_m < AMBIGUOUS_M]
            foot = min(near, key=lambda f: _disagreement(route, f, measure_m, old))
        if abs(foot.beyond_m) > _ON_END_M:
            found.append(Reference(None, None, f"{abs(foot.beyond_m):.2f} m beyond the road's end"))
            continue
        found.append(Reference(route.measure_of(foot), foot.offset_m + 0.0))  # SQLite stores no -0.0
    return found


def _disagreement(route: Route, foot: Foot, measure_m: float, old: Route | None) -> float:
    """How far a foot is from where a measure was, along the axis if that is still the same. [m]"""
    if old is not None and old.axis.part_ranges_m == route.axis.part_ranges_m:
        places = old.measures.places_of(measure_m)
        return min((abs(chainage_m - foot.chainage_m) for _, _, chainage_m in places), default=float("inf"))
    return abs(route.measure_of(foot) - measure_m)


def linear_references(
    connection: sa.Connection,
    agency_id: str,
    markers: Sequence[Mapping[str, Any]],
    before_m: Sequence[float | None],
) -> list[dict[str, float | None]]:
    """Measure and offset of markers whose columns name a road with an axis, None where they have no place on it.

    Empty for those on no registered road.
    """
    found: list[dict[str, float | None]] = [{} for _ in markers]
    named: dict[str, list[int]] = {}
    for k, marker in enumerate(markers):
        if marker.get("road") is not None:
            named.setdefault(marker["road"], []).append(k)
    for name, own in named.items():
        row = ROADS.find(connection, agency_id, name=name)
        if row is None:
            continue
        positions = [(markers[k]["lon_deg"], markers[k]["lat_deg"]) for k in own]
        references = references_of(route_of(row), positions, [before_m[k] for k in own])
        for k, reference in zip(own, references, strict=True):
            found[k] = {"measure_m": reference.measure_m, "offset_m": reference.offset_m}
    return found
