"""A decoded lane as clients see it: columns of numbers, and GeoJSON."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt
from typing_extensions import TypedDict

from app.lanes.overlay import LaneOverlay, LineInFrame, PointsInFrame
from app.lanes.smooth_line import wgs84_from_plane
from app.lanes.types import Lane, TrackAgreement

if TYPE_CHECKING:  # it loads numba
    from app.simulation.steering import SteeringCheck

Floats = npt.NDArray[np.float64]
LonLat = list[list[float]]
_STRAIGHT_PER_M = 1e-4
GeometryType = Literal["LineString", "MultiLineString", "Point"]
_OF_PATH = ("method", "localization_grade", "length_m", "sigma_median_m", "refusal", "speed_limits_kmh")
_OF_MARKER = ("number", "side", "left_out", "packets")
_IN_GEOMETRY = ("lon_deg", "lat_deg")


class Origin(TypedDict):
    """Origin of the local north, east, down coordinates."""

    lon_deg: float
    lat_deg: float


class LaneStations(TypedDict):
    """Columns: one number for each station along the path, null where it is not known."""

    station_m: list[float | None]
    lon_deg: list[float | None]
    lat_deg: list[float | None]
    north_m: list[float | None]
    east_m: list[float | None]
    down_m: list[float | None]
    heading_deg: list[float | None]
    curvature_per_m: list[float | None]
    width_m: list[float | None]
    speed_limit_kmh: list[float | None]
    preview_m: list[float | None]
    sigma_m: list[float | None]
    confidence: list[float | None]


class TrackAgreementDocument(TypedDict):
    """How the path lies against the vehicle's track, beyond what driver and receiver explain where it disagrees."""

    east_m: float
    north_m: float
    shift_sigma_m: float
    turn_deg: float
    turn_sigma_deg: float
    scale_ppm: float
    scale_sigma_ppm: float
    significance: float
    disagrees: bool


class DecodedLaneDocument(TypedDict):
    """The lane's reference path, at stations along it."""

    method: str
    refusal: str | None
    localization_warnings: list[str]
    localization_grade: str
    length_m: float
    sigma_median_m: float | None
    sigma_max_m: float | None
    min_radius_m: float | None
    speed_limits_kmh: list[float]
    track_agreement: TrackAgreementDocument | None
    origin: Origin
    stations: LaneStations
    left: list[list[list[float]]]
    right: list[list[list[float]]]


class SteeringDocument(TypedDict):
    """A simulated drive along the path; `refusal` has the reason if there is none."""

    refusal: str | None
    controller: str | None
    completed: bool | None
    rms_m: float | None
    max_m: float | None
    mse_m2: float | None
    mean_speed_m_s: float | None
    lateral_acceleration_m_s2: float | None
    distance_m: float | None


class OverlayDocument(TypedDict):
    """Pixel coordinates of the lane in the camera frame."""

    frame: str
    left_px: list[list[list[float]]]
    right_px: list[list[list[float]]]
    centre_px: list[list[list[float]]]
    area_px: list[list[list[float]]]
    markers_px: list[list[float]]


class LaneGeometry(TypedDict):
    """GeoJSON geometry."""

    type: GeometryType
    coordinates: list[float] | list[list[float]] | list[list[list[float]]]


class LaneFeature(TypedDict):
    """The path, a boundary or a marker."""

    type: Literal["Feature"]
    geometry: LaneGeometry
    properties: dict[str, object]


class LaneCollection(TypedDict):
    """Path, boundaries and markers, RFC 7946."""

    type: Literal["FeatureCollection"]
    features: list[LaneFeature]


def lane_document(lane: Lane, *, grade: str) -> DecodedLaneDocument:
    """A lane at stations along it; values that are not known are null.

    Parameters
    ----------
    grade : str
        Whether positions may be used to localize a vehicle.
    """
    origin = (lane.origin_lon_deg, lane.origin_lat_deg)
    known = len(lane.station_m) > 0
    sharpest = float(np.abs(lane.curvature_per_m).max()) if known else 0.0
    has_sigma = known and bool(np.isfinite(lane.sigma_m).all())
    return {
        "method": lane.method,
        "refusal": lane.refusal,
        "localization_warnings": list(lane.localization_warnings),
        "localization_grade": grade,
        "length_m": round(float(lane.station_m[-1]), 3) if known else 0.0,
        "sigma_median_m": round(float(np.median(lane.sigma_m)), 4) if has_sigma else None,
        "sigma_max_m": round(float(lane.sigma_m.max()), 4) if has_sigma else None,
        "min_radius_m": round(1 / sharpest, 1) if sharpest > _STRAIGHT_PER_M else None,
        "speed_limits_kmh": _distinct(lane.speed_limit_kmh),
        "track_agreement": _track_agreement(lane.track_agreement),
        "origin": {"lon_deg": origin[0], "lat_deg": origin[1]},
        "stations": {
            "station_m": _column(lane.station_m, 3),
            "lon_deg": _column(lane.lon_deg, 9),
            "lat_deg": _column(lane.lat_deg, 9),
            "north_m": _column(lane.north_m, 4),
            "east_m": _column(lane.east_m, 4),
            "down_m": _column(lane.down_m, 4),
            "heading_deg": _column(lane.heading_deg, 4),
            "curvature_per_m": _column(lane.curvature_per_m, 6),
            "width_m": _column(lane.width_m, 3),
            "speed_limit_kmh": _column(lane.speed_limit_kmh, 3),
            "preview_m": _column(lane.station_m[-1] - lane.station_m if known else lane.station_m, 3),
            "sigma_m": _column(lane.sigma_m, 4),
            "confidence": _column(lane.confidence, 5),
        },
        "left": _pieces(lane.left_enu_m, origin),
        "right": _pieces(lane.right_enu_m, origin),
    }


def _track_agreement(found: TrackAgreement | None) -> TrackAgreementDocument | None:
    if found is None:
        return None
    return {
        "east_m": round(found.east_m, 3),
        "north_m": round(found.north_m, 3),
        "shift_sigma_m": round(found.shift_sigma_m, 3),
        "turn_deg": round(found.turn_deg, 4),
        "turn_sigma_deg": round(found.turn_sigma_deg, 4),
        "scale_ppm": round(found.scale_ppm, 1),
        "scale_sigma_ppm": round(found.scale_sigma_ppm, 1),
        "significance": round(found.significance, 1),
        "disagrees": found.disagrees,
    }


def lane_geojson(lane: DecodedLaneDocument, markers: Sequence[Mapping[str, object]]) -> LaneCollection:
    """Path, boundaries and markers of a stored lane, RFC 7946."""
    stations = lane["stations"]
    path = [list(place) for place in zip(stations["lon_deg"], stations["lat_deg"], strict=True)]
    features: list[LaneFeature] = []
    if len(path) > 1:
        properties = {name: lane[name] for name in _OF_PATH}  # type: ignore[literal-required]
        columns = {name: values for name, values in stations.items() if name not in _IN_GEOMETRY}
        features.append(_feature("path", "LineString", path, {**properties, "stations": columns}))
    for side, pieces in (("left", lane["left"]), ("right", lane["right"])):
        if pieces:
            features.append(_feature(f"{side} boundary", "MultiLineString", pieces, {}))
    for marker in markers:
        if marker["lon_deg"] is not None:
            place = [marker["lon_deg"], marker["lat_deg"]]
            features.append(_feature("marker", "Point", place, {name: marker[name] for name in _OF_MARKER}))
    return {"type": "FeatureCollection", "features": features}


def steering_document(check: SteeringCheck | str | None) -> SteeringDocument | None:
    """A simulated drive along the path; `refusal` where none could be made."""
    if check is None:
        return None
    if isinstance(check, str):
        return {
            "refusal": check, "controller": None, "completed": None, "rms_m": None, "max_m": None, "mse_m2": None,
            "mean_speed_m_s": None, "lateral_acceleration_m_s2": None, "distance_m": None,
        }  # fmt: skip
    return {
        "refusal": None,
        "controller": str(check.controller),
        "completed": check.completed,
        "rms_m": round(float(check.rms_m), 6),
        "max_m": round(float(check.max_m), 6),
        "mse_m2": round(float(check.mse_m2), 6),
        "mean_speed_m_s": round(float(check.mean_speed_m_s), 6),
        "lateral_acceleration_m_s2": round(float(check.lateral_acceleration_m_s2), 6),
        "distance_m": round(float(check.distance_m), 6),
    }


def overlay_document(overlay: LaneOverlay, frame: str) -> OverlayDocument:
    """Pixel coordinates of a lane in a frame."""
    return {
        "frame": frame,
        "left_px": _line_px(overlay.left),
        "right_px": _line_px(overlay.right),
        "centre_px": _line_px(overlay.centre),
        "area_px": [_points_px(polygon) for polygon in overlay.area_px],
        "markers_px": _points_px(overlay.markers.points_px[overlay.markers.visible]),
    }


def overlay_from_document(document: OverlayDocument) -> LaneOverlay:
    """A stored overlay, to be drawn again."""

    def line(pieces: list[list[list[float]]]) -> LineInFrame:
        return LineInFrame(_NO_POINTS, tuple(np.array(piece, float).reshape(-1, 2) for piece in pieces))

    markers = np.array(document["markers_px"], float).reshape(-1, 2)
    shown = PointsInFrame(markers, np.ones(len(markers), bool), np.full(len(markers), np.nan))
    area = tuple(np.array(polygon, float).reshape(-1, 2) for polygon in document["area_px"])
    return LaneOverlay(line(document["left_px"]), line(document["right_px"]), line(document["centre_px"]), area, shown)


_NO_POINTS = PointsInFrame(np.empty((0, 2)), np.empty(0, bool), np.empty(0))


def _feature(kind: str, geometry: GeometryType, coordinates: Any, properties: dict[str, object]) -> LaneFeature:
    return {
        "type": "Feature",
        "geometry": {"type": geometry, "coordinates": coordinates},
        "properties": {"kind": kind, **properties},
    }


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
    """Connected stretches of a boundary, two points or more each."""
    known = np.isfinite(boundary_m).all(axis=1) if len(boundary_m) else np.zeros(0, bool)
    edges = np.flatnonzero(np.diff(np.r_[0, known.astype(np.int8), 0]))
    pieces = []
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        if end - start >= 2:
            lon, lat = wgs84_from_plane(boundary_m[start:end], origin)
            pieces.append(np.round(np.stack([lon, lat], 1), 9).tolist())
    return pieces
