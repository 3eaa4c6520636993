"""A decoded lane as clients see it: columns of numbers, and GeoJSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, NotRequired, cast

import numpy as np
from typing_extensions import TypedDict

from app.lanes.smooth_line import wgs84_from_plane
from app.lanes.types import UNKNOWN, Lane, LaneBeside, LaneStretch, TrackAgreement
from app.services.documents import document_of, listed
from app.values import Floats, Ints

if TYPE_CHECKING:  # it loads numba
    from app.simulation.steering import SteeringCheck

LonLat = list[list[float]]
_STRAIGHT_PER_M = 1e-4
GeometryType = Literal["LineString", "MultiLineString", "Point"]
_OF_PATH = ("method", "localization_grade", "length_m", "sigma_median_m", "refusal", "speed_limits_kmh")
_OF_OTHER_LANE = ("position", "direction", "length_m", "sigma_median_m", "markers")
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


class OtherLaneDocument(TypedDict):
    """The path of another lane whose markers were received, in its direction of travel where that is known.

    `position` counts lanes to the left of the driven one: 1 is the next one on the left, -1 the next on the right.
    """

    position: int
    direction: Literal["same", "oncoming", "unknown"]
    length_m: float
    sigma_median_m: float
    markers: list[int]
    path: LonLat


class DecodedLaneDocument(TypedDict):
    """The lane's reference path, at stations along it; `stretches` say in which lane the vehicle was beside it."""

    method: str
    refusal: str | None
    localization_warnings: list[str]
    localization_grade: str
    length_m: float
    sigma_median_m: float | None
    sigma_max_m: float | None
    min_radius_m: float | None
    speed_limits_kmh: list[float]
    track_agreement: TrackAgreement | None
    origin: Origin
    stations: LaneStations
    left: list[list[list[float]]]
    right: list[list[list[float]]]
    stretches: NotRequired[list[LaneStretch]]
    other_lanes: NotRequired[list[OtherLaneDocument]]


class SteeringDocument(TypedDict):
    """A simulated drive along the path; `refusal` has the reason if there is none."""

    refusal: str | None
    controller: str | None
    completed: bool | None
    rms_m: float | None
    max_m: float | None
    mse_m2: float | None
    steer_rate_max_deg_s: float | None
    mean_speed_m_s: float | None
    lateral_acceleration_m_s2: float | None
    distance_m: float | None
    unsolved_steps: int | None


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


def lane_document(lane: Lane, markers: Ints, *, grade: str) -> DecodedLaneDocument:
    """A lane at stations along it; values that are not known are null.

    Parameters
    ----------
    markers : ndarray of int, shape (K,)
        Numbers of the markers that the lane was fitted to.
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
        "track_agreement": lane.track_agreement,
        "origin": {"lon_deg": origin[0], "lat_deg": origin[1]},
        "stations": {
            "station_m": listed(lane.station_m, 3),
            "lon_deg": listed(lane.lon_deg, 9),
            "lat_deg": listed(lane.lat_deg, 9),
            "north_m": listed(lane.north_m, 4),
            "east_m": listed(lane.east_m, 4),
            "down_m": listed(lane.down_m, 4),
            "heading_deg": listed(lane.heading_deg, 4),
            "curvature_per_m": listed(lane.curvature_per_m, 6),
            "width_m": listed(lane.width_m, 3),
            "speed_limit_kmh": listed(lane.speed_limit_kmh, 3),
            "preview_m": listed(lane.station_m[-1] - lane.station_m if known else lane.station_m, 3),
            "sigma_m": listed(lane.sigma_m, 4),
            "confidence": listed(lane.confidence, 5),
        },
        "left": _pieces(lane.left_enu_m, origin),
        "right": _pieces(lane.right_enu_m, origin),
        "stretches": list(lane.stretches),
        "other_lanes": [_other_lane(other, markers) for other in lane.beside],
    }


def _other_lane(other: LaneBeside, markers: Ints) -> OtherLaneDocument:
    lane = other.lane
    return {
        "position": other.position,
        "direction": other.direction,
        "length_m": round(float(lane.station_m[-1]), 3),
        "sigma_median_m": round(float(np.median(lane.sigma_m)), 4),
        "markers": sorted(set(markers[lane.side != UNKNOWN].tolist())),
        "path": np.round(np.stack([lane.lon_deg, lane.lat_deg], 1), 9).tolist(),
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
    for other in lane.get("other_lanes", []):
        properties = {name: other[name] for name in _OF_OTHER_LANE}  # type: ignore[literal-required]
        features.append(_feature("other lane", "LineString", other["path"], properties))
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
        return cast("SteeringDocument", dict.fromkeys(SteeringDocument.__annotations__) | {"refusal": check})
    return document_of(SteeringDocument, check, refusal=None)


def _feature(kind: str, geometry: GeometryType, coordinates: Any, properties: dict[str, object]) -> LaneFeature:
    return {
        "type": "Feature",
        "geometry": {"type": geometry, "coordinates": coordinates},
        "properties": {"kind": kind, **properties},
    }


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
