"""A decoded lane as clients see it: columns of numbers, and GeoJSON."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from app.decoders.cerpm.lane_frame import wgs84_from_plane
from app.decoders.cerpm.lane_types import Lane
from app.decoders.cerpm.overlay import LaneOverlay, LineInFrame, PointsInFrame
from app.simulation.steering import SteeringCheck

Floats = npt.NDArray[np.float64]
LonLat = list[list[float]]
_STRAIGHT_1PM = 1e-4
_BOUNDARIES = ("left", "right")
_IN_GEOMETRY = ("lon_deg", "lat_deg")


def lane_document(lane: Lane, *, grade: str) -> dict[str, Any]:
    """A lane at stations along it; nothing is null but what is not known.

    Parameters
    ----------
    lane : Lane
    grade : str
        Whether positions may be used to localize a vehicle.
    """
    origin = (lane.origin_lon_deg, lane.origin_lat_deg)
    known = len(lane.station_m) > 0
    sharpest = float(np.abs(lane.curvature_1pm).max()) if known else 0.0
    has_sigma = known and bool(np.isfinite(lane.sigma_m).all())
    return {
        "method": lane.method,
        "refusal": lane.refusal,
        "doubts": list(lane.doubts),
        "localization_grade": grade,
        "length_m": round(float(lane.station_m[-1]), 3) if known else 0.0,
        "sigma_median_m": round(float(np.median(lane.sigma_m)), 4) if has_sigma else None,
        "sigma_max_m": round(float(lane.sigma_m.max()), 4) if has_sigma else None,
        "min_radius_m": round(1 / sharpest, 1) if sharpest > _STRAIGHT_1PM else None,
        "speed_limits_km_h": _distinct(lane.speed_limit_km_h),
        "origin": {"lon_deg": origin[0], "lat_deg": origin[1]},
        "stations": {
            "station_m": _column(lane.station_m, 3),
            "lon_deg": _column(lane.lon_deg, 9),
            "lat_deg": _column(lane.lat_deg, 9),
            "north_m": _column(lane.north_m, 4),
            "east_m": _column(lane.east_m, 4),
            "down_m": _column(lane.down_m, 4),
            "heading_deg": _column(lane.heading_deg, 4),
            "curvature_1pm": _column(lane.curvature_1pm, 6),
            "width_m": _column(lane.width_m, 3),
            "speed_limit_km_h": _column(lane.speed_limit_km_h, 3),
            "preview_m": _column(lane.station_m[-1] - lane.station_m if known else lane.station_m, 3),
            "sigma_m": _column(lane.sigma_m, 4),
            "confidence": _column(lane.confidence, 5),
        },
        "left": _pieces(lane.left_enu_m, origin),
        "right": _pieces(lane.right_enu_m, origin),
    }


def lane_geojson(document: dict[str, Any], markers: list[dict[str, Any]]) -> dict[str, Any]:
    """Path, boundaries and markers of a stored lane, RFC 7946."""
    stations = document["stations"]
    path = [list(place) for place in zip(stations["lon_deg"], stations["lat_deg"], strict=True)]
    head = {name: document[name] for name in ("method", "localization_grade", "length_m", "sigma_median_m", "refusal")}
    features: list[dict[str, Any]] = []
    if len(path) > 1:
        columns = {name: values for name, values in stations.items() if name not in _IN_GEOMETRY}
        limits = {"speed_limits_km_h": document["speed_limits_km_h"]}
        geometry = {"type": "LineString", "coordinates": path}
        features.append(_feature("path", geometry, {**head, **limits, "stations": columns}))
    for side in _BOUNDARIES:
        if document[side]:
            geometry = {"type": "MultiLineString", "coordinates": document[side]}
            features.append(_feature(f"{side} boundary", geometry, {}))
    for marker in markers:
        if marker["lon_deg"] is not None:
            geometry = {"type": "Point", "coordinates": [marker["lon_deg"], marker["lat_deg"]]}
            features.append(
                _feature("marker", geometry, {k: marker[k] for k in ("number", "side", "left_out", "packets")})
            )
    return {"type": "FeatureCollection", "features": features}


def steering_document(check: SteeringCheck | str | None) -> dict[str, Any] | None:
    """A simulated drive along the path; `refusal` where none could be made."""
    if check is None:
        return None
    names = (
        "controller", "completed", "rms_m", "max_m", "mse_m2", "mean_speed_m_s", "lateral_acceleration_m_s2",
        "distance_m",
    )  # fmt: skip
    if isinstance(check, str):
        return {"refusal": check, **dict.fromkeys(names)}
    return {
        "refusal": None,
        "controller": str(check.controller),
        "completed": check.completed,
        **{name: round(float(getattr(check, name)), 6) for name in names[2:]},
    }


def overlay_document(overlay: LaneOverlay, frame: str) -> dict[str, Any]:
    """Pixel coordinates of a lane in a frame."""
    return {
        "frame": frame,
        "left_px": _line_px(overlay.left),
        "right_px": _line_px(overlay.right),
        "centre_px": _line_px(overlay.centre),
        "area_px": [_points_px(polygon) for polygon in overlay.area_px],
        "markers_px": _points_px(overlay.markers.points_px[overlay.markers.visible]),
    }


def overlay_from_document(document: dict[str, Any]) -> LaneOverlay:
    """A stored overlay, to be drawn again."""

    def line(name: str) -> LineInFrame:
        return LineInFrame(_NO_POINTS, tuple(np.array(piece, float).reshape(-1, 2) for piece in document[name]))

    markers = np.array(document["markers_px"], float).reshape(-1, 2)
    shown = PointsInFrame(markers, np.ones(len(markers), bool), np.full(len(markers), np.nan))
    area = tuple(np.array(polygon, float).reshape(-1, 2) for polygon in document["area_px"])
    return LaneOverlay(line("left_px"), line("right_px"), line("centre_px"), area, shown)


_NO_POINTS = PointsInFrame(np.empty((0, 2)), np.empty(0, bool), np.empty(0))


def _feature(kind: str, geometry: dict[str, Any], properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": geometry, "properties": {"kind": kind, **properties}}


def _line_px(line: LineInFrame) -> list[list[list[float]]]:
    return [_points_px(piece) for piece in line.pieces_px]


def _points_px(points: Floats) -> list[list[float]]:
    rounded: list[list[float]] = np.round(points, 2).tolist()
    return rounded


def _column(values: Floats, places: int) -> list[float | None]:
    rounded = np.round(values, places) + 0.0  # no negative zero
    return [value if math.isfinite(value) else None for value in rounded.tolist()]


def _distinct(values: Floats) -> list[float]:
    return sorted({round(float(value), 3) for value in values[np.isfinite(values)]})


def _pieces(boundary_m: Floats, origin: tuple[float, float]) -> list[LonLat]:
    """Stretches of a boundary that are known, two points or more each."""
    known = np.isfinite(boundary_m).all(axis=1) if len(boundary_m) else np.zeros(0, bool)
    edges = np.flatnonzero(np.diff(np.r_[0, known.astype(np.int8), 0]))
    pieces = []
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        if end - start >= 2:
            lon, lat = wgs84_from_plane(boundary_m[start:end], origin)
            pieces.append(np.round(np.stack([lon, lat], 1), 9).tolist())
    return pieces
