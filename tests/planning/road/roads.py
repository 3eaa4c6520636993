"""Roads of known geometry, drawn in a local plane."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from pyproj import Transformer

from app.formats.alignments.geometry import AlignmentFile, LaneGeometry
from app.planning.alignment import Alignment
from app.planning.build_alignment import build_alignment
from app.planning.rules import RoadRules
from app.values import Floats

RULES = RoadRules(design_speed_kmh=50.0)
PLACE = (8.4, 49.0)


def straight_and_arc(spacing_m: float, radius_m: float, turn_rad: float, offset_m: float = 0.0) -> Floats:
    """150 m straight, an arc (left positive), 150 m straight; vertices at even chainages. Offset is left positive."""
    arc_m = radius_m * abs(turn_rad)
    s = np.arange(0.0, 300.0 + arc_m, spacing_m)
    bend = np.clip((s - 150.0) / arc_m, 0.0, 1.0) * turn_rad
    sign = math.copysign(1.0, turn_rad)
    east = np.minimum(s, 150.0) + radius_m * np.sin(np.abs(bend)) + np.maximum(s - 150 - arc_m, 0) * math.cos(turn_rad)
    north = sign * radius_m * (1 - np.cos(bend)) + np.maximum(s - 150 - arc_m, 0) * math.sin(turn_rad)
    return np.stack([east - offset_m * np.sin(bend), north + offset_m * np.cos(bend)], axis=1)


def wgs84(east_north_m: Floats, place: tuple[float, float] = PLACE) -> Floats:
    """Longitude, latitude and no height, shape (N, 3)."""
    plane = Transformer.from_pipeline(f"+proj=tmerc +lat_0={place[1]} +lon_0={place[0]} +k=1 +ellps=WGS84")
    lon, lat = plane.transform(east_north_m[:, 0], east_north_m[:, 1], direction="INVERSE")
    return np.column_stack([lon, lat, np.full(len(lon), np.nan)])


def east_north(lon_deg: Floats, lat_deg: Floats, place: tuple[float, float] = PLACE) -> Floats:
    """In the plane of `wgs84`. [m]"""
    plane = Transformer.from_pipeline(f"+proj=tmerc +lat_0={place[1]} +lon_0={place[0]} +k=1 +ellps=WGS84")
    return np.stack(plane.transform(lon_deg, lat_deg), axis=1)


def build(*lanes: LaneGeometry, rules: RoadRules = RULES, **file: object) -> Alignment:
    """Alignment of lanes in WGS 84."""
    return build_alignment(AlignmentFile("geojson", tuple(lanes), **file), rules)  # type: ignore[arg-type]


def centre_lane(points: Sequence[Sequence[float]] | Floats, name: str = "1", **values: object) -> LaneGeometry:
    """Lane by its centre line in the plane."""
    return LaneGeometry(name, wgs84(np.asarray(points, dtype=np.float64)), **values)  # type: ignore[arg-type]
