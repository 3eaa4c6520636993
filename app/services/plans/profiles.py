"""Lanes of an alignment to draw: their lines, stations and curvature, with few enough samples for a web page."""

from __future__ import annotations

import numpy as np

from app.planning.alignment import Alignment, Floats, Lane, RoadEvent
from app.planning.outputs.plan_geojson import lane_points_deg
from app.services.plans.documents import AlignmentProfile, LaneProfile, ProfileEvent

MAX_SAMPLES = 5_000
"""Of one lane. Source: chosen by hand, more than a screen has columns."""
_MAX_ALL_SAMPLES = 100_000  # of all lanes together; source: chosen by hand, 5 MB of JSON
_DECIMALS = 9  # of degrees, 0.1 mm; source: as maps of plans


def alignment_profile(road: Alignment, samples: int) -> AlignmentProfile:
    """The lanes of a road with at most so many samples each."""
    per_lane = max(2, min(samples, _MAX_ALL_SAMPLES // len(road.lanes)))
    return {
        "lanes": [_lane_profile(road, lane, per_lane) for lane in road.lanes],
        "events": [_event(road.lane(event.lane), event) for event in road.events],
        "areas": [{"kind": area.kind, "ring_deg": np.round(area.ring_deg, _DECIMALS).tolist()} for area in road.areas],
    }


def _lane_profile(road: Alignment, lane: Lane, samples: int) -> LaneProfile:
    at = np.unique(np.linspace(0, len(lane.chainage_m) - 1, min(samples, len(lane.chainage_m))).round().astype(int))
    speed = lane.design_speed_mps[at] * 3.6
    return {
        "name": lane.name,
        "road": lane.road,
        "length_m": lane.length_m,
        "left_style": str(lane.left_style),
        "right_style": str(lane.right_style),
        "line": lane_points_deg(lane),
        "chainage_m": _rounded(lane.chainage_m[at], 3),
        "station_m": [round(road.displayed_station_m(station), 3) for station in lane.station_m[at].tolist()],
        "curvature_per_m": _rounded(_greatest_near(lane.curvature_per_m, at), 7),
        "grade": _rounded(lane.grade[at], 5),
        "design_speed_kmh": _rounded(speed, 2) if np.isfinite(speed).all() else None,
        "lon_deg": _rounded(lane.lon_deg[at], _DECIMALS),
        "lat_deg": _rounded(lane.lat_deg[at], _DECIMALS),
    }


def _greatest_near(values: Floats, at: np.ndarray[tuple[int], np.dtype[np.int_]]) -> Floats:
    """The value of the greatest size between the middles to the neighbours of each sample."""
    edges = np.concatenate([[0], (at[:-1] + at[1:] + 1) // 2])
    high, low = np.maximum.reduceat(values, edges), np.minimum.reduceat(values, edges)
    return np.asarray(np.where(high >= -low, high, low))


def _event(lane: Lane, event: RoadEvent) -> ProfileEvent:
    lon, lat = lane.position_at(event.chainage_m)
    return {
        "kind": event.kind.value,
        "lane": event.lane,
        "chainage_m": event.chainage_m,
        "value": event.value,
        "lon_deg": round(float(lon[0]), _DECIMALS),
        "lat_deg": round(float(lat[0]), _DECIMALS),
    }


def _rounded(values: Floats, digits: int) -> list[float]:
    found: list[float] = np.round(values, digits).tolist()
    return found
