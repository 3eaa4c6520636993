"""A plan as GeoJSON (RFC 7946): markers, lanes, events and areas to avoid, for any map."""

from __future__ import annotations

from typing import Any

import numpy as np
import orjson
from shapely import LineString, get_coordinates, simplify

from app.markers.cerpm import LaneSide
from app.planning.alignment import Lane, format_station
from app.planning.plan import Detail, Plan, PlannedCerpm, PlannedLineMagnet, PlannedMarker, PlannedPlate, PlannedTag

_DECIMALS = 9  # of degrees, 0.1 mm; source: as drilling sheets
_LANE_TOLERANCE_M = 0.02  # [m] of a lane's line on the map; source: chosen by hand, below what a map shows
_M_PER_DEG = 111_195.0  # [m/deg] on a sphere of 6371 km, the Earth's mean radius


def write_plan_geojson(plan: Plan) -> bytes:
    """A FeatureCollection in WGS 84; each feature has a property `kind`: marker, lane, event, area."""
    road = plan.alignment
    features = [marker_feature(plan, marker) for marker in plan.markers]
    features += [_feature(_line(lane), {"kind": "lane", "name": lane.name, "road": lane.road}) for lane in road.lanes]
    for event in road.events:
        lon, lat = road.lane(event.lane).position_at(event.chainage_m)
        properties = {"event": event.kind.value, "lane": event.lane, "value": event.value}
        features.append(_feature(_point(float(lon[0]), float(lat[0])), {"kind": "event", **properties}))
    for area in road.areas:
        rings = [np.round(area.ring_deg, _DECIMALS).tolist()]
        features.append(_feature({"type": "Polygon", "coordinates": rings}, {"kind": "area", "area": area.kind}))
    document = {"type": "FeatureCollection", "name": plan.name, "surveyed": road.surveyed, "features": features}
    return orjson.dumps(document)


def marker_feature(plan: Plan, marker: PlannedMarker) -> dict[str, Any]:
    """One marker as a GeoJSON feature."""
    road = plan.alignment
    height = marker.height_m if road.vertical_datum == "ellipsoid" else None  # RFC 7946, section 3.1.1
    properties = {
        "kind": "marker",
        "number": marker.number,
        "family": marker.family,
        "code": marker.code,
        "purpose": marker.purpose.value,
        "lane": marker.lane,
        "station": format_station(road.displayed_station_m(marker.station_m)),
        "chainage_m": round(marker.chainage_m, 4),
        "offset_m": round(marker.offset_m, 4),
        "heading_deg": round(marker.heading_deg, 4),
        "height_m": marker.height_m,
        **_details(marker.detail),
    }
    return {**_feature(_point(marker.lon_deg, marker.lat_deg, height), properties), "id": marker.number}


def _details(detail: Detail) -> dict[str, Any]:
    match detail:
        case PlannedPlate():
            return {"scheme": detail.code.scheme.value, "side_mm": detail.geometry.side_mm}
        case PlannedTag():
            return {"meaning": detail.meaning.text, "magnets": detail.tag.magnet_count}
        case PlannedLineMagnet():
            return {"side": _side(detail.side), "line": detail.style.value}
        case PlannedCerpm():
            limit = detail.speed_limit
            return {"side": _side(detail.side), "speed_limit": None if limit is None else f"{limit.value} {limit.unit}"}


def _side(side: LaneSide) -> str:
    return side.name.lower()


def _feature(geometry: dict[str, Any], properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def _point(lon_deg: float, lat_deg: float, height_m: float | None = None) -> dict[str, Any]:
    place = [round(lon_deg, _DECIMALS), round(lat_deg, _DECIMALS)]
    return {"type": "Point", "coordinates": place if height_m is None else [*place, round(height_m, 4)]}


def _line(lane: Lane) -> dict[str, Any]:
    return {"type": "LineString", "coordinates": lane_points_deg(lane)}


def lane_points_deg(lane: Lane) -> list[list[float]]:
    """The centre line as [lon, lat], with the points that it needs to be drawn within 2 cm."""
    line = LineString(np.column_stack([lane.lon_deg, lane.lat_deg]))
    points = get_coordinates(simplify(line, _LANE_TOLERANCE_M / _M_PER_DEG, preserve_topology=False))
    return [[lon, lat] for lon, lat in np.round(points, _DECIMALS).tolist()]
