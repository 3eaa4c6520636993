"""What GIS clients read of alignments and plans, made where these are computed."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import orjson

from app.geodesy.vertical import is_ellipsoidal
from app.planning.alignment import Alignment
from app.planning.outputs.plan_geojson import lane_points_deg
from app.planning.plan import Plan, PlannedCerpm, PlannedLineMagnet, PlannedMarker
from app.registry.columns import Columns
from app.registry.plan_features import OF_MARKER
from app.services.plans.summaries import road_summary

LaneFeature = tuple[dict[str, Any], list[list[float]]]
"""Properties of a lane, and its points [lon, lat]."""


def lane_features(road: Alignment) -> list[LaneFeature]:
    """The lanes of a road; one across the antimeridian is two lines (RFC 7946, section 3.1.9)."""
    found: list[LaneFeature] = []
    for lane, summary in zip(road.lanes, road_summary(road)["lanes"], strict=True):
        sharpest = summary["min_radius_m"]
        slowest, fastest = summary["design_speed_kmh"] or (None, None)
        properties = {
            "lane": summary["name"],
            "road": summary["road"],
            "length_m": round(summary["length_m"], 3),
            "min_width_m": round(summary["width_m"][0], 3),
            "max_width_m": round(summary["width_m"][1], 3),
            "min_speed_kmh": None if slowest is None else round(slowest, 3),
            "max_speed_kmh": None if fastest is None else round(fastest, 3),
            "min_radius_m": None if sharpest is None else round(sharpest, 3),
            "max_curvature_per_m": 0.0 if sharpest is None else round(1 / sharpest, 9),
            "max_grade": round(summary["max_grade"], 6),
            "left_style": summary["left_style"],
            "right_style": summary["right_style"],
            "localization_grade": str(road.grade),
        }
        found += ((properties, part) for part in _parts(lane_points_deg(lane)))
    return found


def _parts(points: list[list[float]]) -> Iterator[list[list[float]]]:
    """A line cut at the antimeridian."""
    part = points[:1]
    for (lon_a, lat_a), (lon, lat) in pairwise(points):
        if abs(lon - lon_a) > 180.0:
            edge = 180.0 if lon_a > 0 else -180.0
            ahead = lon + 2 * edge
            share = (edge - lon_a) / (ahead - lon_a) if ahead != lon_a else 0.0
            middle = lat_a + share * (lat - lat_a)
            yield [*part, [edge, middle]]
            part = [[-edge, middle]]
        part.append([lon, lat])
    yield part


def planned_columns(plan: Plan) -> Columns:
    """The markers of a plan as rows of `planned_markers`, without ids."""
    datum = plan.alignment.vertical_datum
    rows = [_row(marker, datum) for marker in plan.markers]
    lists = {name: [row[name] for row in rows] for name in rows[0]} if rows else {}
    return Columns.of(len(rows), {}, lists)


def _row(marker: PlannedMarker, datum: str | None) -> dict[str, Any]:
    detail, height_m = marker.detail, marker.height_m
    values: dict[str, Any] = {
        "number": marker.number,
        "family": marker.family,
        "code": marker.code,
        "purpose": marker.purpose.value,
        "lane": marker.lane,
        "side": detail.side.name.lower() if isinstance(detail, PlannedLineMagnet | PlannedCerpm) else None,
        "chainage_m": round(marker.chainage_m, 4),
        "station_m": round(marker.station_m, 4),
        "offset_m": round(marker.offset_m, 4),
        "heading_deg": round(marker.heading_deg, 4),
        "height_m": height_m,
        "vertical_datum": None if height_m is None else datum,
    }
    place = [marker.lon_deg, marker.lat_deg]
    if height_m is not None and is_ellipsoidal(datum):
        place.append(height_m)
    feature = {
        "geometry": {"type": "Point", "coordinates": place},
        "properties": {name: values[name] for name in OF_MARKER},
    }
    text = orjson.dumps(feature).decode()[1:-2]  # open at its end: what follows from the plan is added in queries
    at = {"lon_deg": marker.lon_deg, "lat_deg": marker.lat_deg}
    return {**values, **at, "feature": text}
