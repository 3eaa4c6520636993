"""What HD maps are written from: lanes, stop lines and markers, of a plan or of the registry."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from xml.sax.saxutils import quoteattr

import numpy as np
import numpy.typing as npt
import scipy

from app.geodesy.frames import ecef_from_wgs84
from app.markers.cerpm import LaneSide
from app.planning.alignment import Alignment, Lane, RoadEvent
from app.planning.plan import Plan, PlannedCerpm, PlannedMarker, PlannedPlate, PlannedTag
from app.values import Floats

_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")  # source: XML 1.0, section 2.2
_PLAIN = re.compile("[-+., /0-9:A-Z_a-z]*")


@dataclass(frozen=True, slots=True)
class MapMarker:
    """One thing on the road that vehicles detect: a plate, a sign, a CERPM, or one magnet."""

    id: str  # unique in the map
    family: str  # ``plate``, ``magnet``, ``cerpm`` or ``fiducial``
    code: str  # what a vehicle reads
    # `lon_deg`, `lat_deg`: [deg] of its centre, WGS 84
    lon_deg: float
    lat_deg: float
    height_m: float | None = None  # [m] of its centre, in the datum of the map
    heading_deg: float | None = None  # [deg] direction of travel, clockwise from true north
    kind: str = ""  # within the family: scheme of a plate, ``line`` or ``information`` of a magnet, side of a CERPM
    side_m: float | None = None  # [m] outer edge of a square face; None for what is a point in a map
    # whether a square face stands and faces the traffic; it lies with its upper edge forward otherwise
    upright: bool = False
    # `grade`, `crossfall`: [-] rise of the road in the direction of the heading, and to its left
    grade: float = 0.0
    crossfall: float = 0.0
    vertical_datum: str | None = None  # of the height; None where it is that of the map, or where there is no height


@dataclass(frozen=True, slots=True)
class HdMap:
    """Content of an HD map."""

    name: str
    lanes: tuple[Lane, ...]
    markers: tuple[MapMarker, ...]
    events: tuple[RoadEvent, ...] = ()  # of which the stop lines are written
    urban: bool = False  # whether the roads are in a town
    vertical_datum: str | None = None  # of the heights; None where it is unknown


def map_of_plan(plan: Plan) -> HdMap:
    """The lanes and the markers of a plan; each magnet of an information tag is one marker of the map."""
    lanes = {lane.name: lane for lane in plan.alignment.lanes}
    slopes = _slopes(plan, lanes)
    markers: list[MapMarker] = []
    for marker, (grade, crossfall) in zip(plan.markers, slopes.tolist(), strict=True):
        markers += _map_markers(marker, grade, crossfall)
    urban = plan.rules.applies.road_class == "urban"
    road = plan.alignment
    return HdMap(plan.name, road.lanes, tuple(markers), road.events, urban, road.vertical_datum)


def _slopes(plan: Plan, lanes: dict[str, Lane]) -> Floats:
    """Grade and crossfall at each marker, shape (M, 2)."""
    slopes = np.zeros((len(plan.markers), 2))
    names = np.array([marker.lane for marker in plan.markers])
    chainage = np.array([marker.chainage_m for marker in plan.markers])
    for name, lane in lanes.items():
        own = names == name
        slopes[own, 0] = lane.value_at(lane.grade, chainage[own])
        slopes[own, 1] = np.tan(lane.value_at(lane.superelevation_rad, chainage[own]))
    return slopes


def _map_markers(marker: PlannedMarker, grade: float, crossfall: float) -> list[MapMarker]:
    detail = marker.detail
    at = marker.lon_deg, marker.lat_deg, marker.height_m, marker.heading_deg
    name = str(marker.number)
    if isinstance(detail, PlannedTag):
        first_m = detail.magnets[0][0]
        return [
            MapMarker(
                f"{name}.{number}", "magnet", marker.code, lon, lat,
                None if marker.height_m is None else marker.height_m + grade * (chainage - first_m),
                marker.heading_deg, "information", grade=grade, crossfall=crossfall,
            )
            for number, (chainage, lon, lat) in enumerate(detail.magnets, 1)
        ]  # fmt: skip
    if isinstance(detail, PlannedPlate):
        kind, side_m = detail.code.scheme.value, detail.geometry.side_mm / 1000
    elif isinstance(detail, PlannedCerpm):
        kind, side_m = "" if detail.side is LaneSide.UNKNOWN else detail.side.name.lower(), None
    else:
        kind, side_m = "line", None
    return [MapMarker(name, marker.family, marker.code, *at, kind, side_m, grade=grade, crossfall=crossfall)]


def map_of_road(road: Alignment, markers: Sequence[MapMarker], *, within_m: float) -> HdMap:
    """The lanes of a road, and the markers near them.

    Parameters
    ----------
    markers : sequence of MapMarker
        Grade and crossfall are those of the road.
    within_m : float
        Greatest distance of a marker from the centre line of the nearest lane. [m]

    Notes
    -----
    A height in another datum than that of the road's heights is left out: it would lie above or below the road.
    """
    near: list[MapMarker] = []
    if markers:
        lane, sample, distance_m = _nearest_samples(road.lanes, markers)
        for k in np.flatnonzero(distance_m <= within_m).tolist():
            near.append(_on_road(road, markers[k], road.lanes[lane[k]], int(sample[k])))
    return HdMap(road.name, road.lanes, tuple(near), road.events, vertical_datum=road.vertical_datum)


def _nearest_samples(
    lanes: Sequence[Lane], markers: Sequence[MapMarker]
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp], Floats]:
    """Number of the nearest lane and of its nearest sample, and the distance from its centre line, shape (M,)."""
    number = np.repeat(np.arange(len(lanes)), [len(lane.chainage_m) for lane in lanes])
    samples = np.concatenate([np.arange(len(lane.chainage_m)) for lane in lanes])
    lon, lat = (np.concatenate([getattr(lane, name) for lane in lanes]) for name in ("lon_deg", "lat_deg"))
    places = np.array([(marker.lon_deg, marker.lat_deg) for marker in markers])
    away, found = scipy.spatial.cKDTree(ecef_from_wgs84(lon, lat)).query(ecef_from_wgs84(places[:, 0], places[:, 1]))
    half_step = np.array([lane.step_m / 2 for lane in lanes])[number[found]]
    # the centre line passes nearer than its samples, by half a step along it at most
    distance = np.sqrt(np.maximum(np.asarray(away) ** 2 - half_step**2, 0.0))
    return number[found], samples[found], distance


def _on_road(road: Alignment, marker: MapMarker, lane: Lane, sample: int) -> MapMarker:
    """A marker with the slopes of the road in its own direction, and its height in the road's datum."""
    grade, crossfall = float(lane.grade[sample]), math.tan(float(lane.superelevation_rad[sample]))
    turn = 0.0 if marker.heading_deg is None else math.radians(marker.heading_deg - float(lane.heading_deg[sample]))
    along, left = math.cos(turn), -math.sin(turn)
    same_datum = road.vertical_datum is not None and marker.vertical_datum == road.vertical_datum
    return replace(
        marker,
        height_m=marker.height_m if same_datum else None,
        grade=grade * along + crossfall * left,
        crossfall=crossfall * along - grade * left,
    )


# --- geometry of lanes ----------------------------------------------------------------------------------------------


def boundary_heights_m(lane: Lane, chainage_m: Floats, offset_m: Floats) -> Floats:
    """Heights of the road beside the centre line; 0 where the heights of the lane are unknown, shape (K,). [m]"""
    tilt = np.tan(lane.value_at(lane.superelevation_rad, chainage_m))
    return np.asarray(np.nan_to_num(lane.value_at(lane.height_m, chainage_m)) + offset_m * tilt)


def points_m(lon_deg: Floats, lat_deg: Floats, height_m: Floats) -> Floats:
    """Earth-centred coordinates on the ellipsoid with the height as fourth, shape (K, 4). [m]"""
    return np.column_stack([ecef_from_wgs84(lon_deg, lat_deg), height_m])


def refine_breaks(
    breaks: npt.NDArray[np.intp], error_of: Callable[[npt.NDArray[np.intp]], Floats], limit: float
) -> npt.NDArray[np.intp]:
    """Samples at which a line is broken into pieces, so that no sample is farther than a limit from its piece.

    Parameters
    ----------
    breaks : ndarray of int, shape (B,)
        First breaks, increasing; the first and the last sample among them.
    error_of : callable
        Distance of every sample from the pieces between breaks, shape (N,).
    limit : float
        In the unit of the distances; pieces of one step are not broken again.
    """
    while True:
        error = error_of(breaks)
        piece = np.clip(np.searchsorted(breaks, np.arange(len(error)), side="right") - 1, 0, len(breaks) - 2)
        worst = np.zeros(len(breaks) - 1)
        np.maximum.at(worst, piece, error)
        split = (worst > limit) & (np.diff(breaks) > 1)
        if not split.any():
            return breaks
        breaks = np.sort(np.concatenate([breaks, ((breaks[:-1] + breaks[1:]) // 2)[split]]))


def speed_kmh(lane: Lane, first_m: float, last_m: float) -> float | None:
    """Lowest design speed of a stretch, to a tenth; None if it is unknown. [km/h]"""
    low, high = np.searchsorted(lane.chainage_m, [first_m + 1e-6, last_m - 1e-6])
    lowest = float(lane.design_speed_m_s[max(int(low) - 1, 0) : int(high) + 1].min())
    return round(lowest * 3.6, 1) if math.isfinite(lowest) else None


# --- XML --------------------------------------------------------------------------------------------------------


def attribute(value: str) -> str:
    """A text as an attribute of XML, with its quotes; characters that XML does not have become question marks."""
    if _PLAIN.fullmatch(value):
        return f'"{value}"'
    return quoteattr(_NOT_XML.sub("?", value))


def number(value: float) -> str:
    """A number with twelve significant digits: micrometres in 1,000 km."""
    if not math.isfinite(value):
        raise ValueError(f"{value} in a map")
    return f"{value:.12g}"
