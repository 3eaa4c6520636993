"""A magnet marker's layout: kept as a lane, a tag and a place on it, from which everything else follows."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import orjson

from app.encoders.magnet import DrillingSheet, MagnetLayout, place_line, place_tag
from app.errors import InvalidParameter, naming
from app.families.inputs import PositionIn
from app.families.magnet.spec import MagnetSpec, StoredLane, meaning_of
from app.geodesy import PlacedPosition, place_position
from app.markers.checks import Check
from app.markers.magnet import InformationTag, LineTag, Orientation, parse_tag
from app.planning.drilling_sheet import drilling_sheet
from app.planning.magnet_checks import Neighbour, Site
from app.registry.marker_rows import MarkerRow
from app.roads.lane_line import LaneLine

INFORMATION_TAG: Final = "information-tag"
LINE_TAG: Final = "line-tag"
_LAID_OUT: Final = ("lane", "tag", "place", "meaning")
MAX_MAGNETS = 1000
"""Of one marker, so that no request takes long: six kilometres of a line."""
MAX_RESURVEY_M = 1.0
"""Farthest that a survey may find a tag from its layout: drilling is right to millimetres, GNSS to centimetres. [m]"""
_NEVER_BROKEN = ("magnet-spacing", "line-spacing")
"""Checks whose failure makes a layout unreadable; the others are for the planner to weigh."""


@dataclass(frozen=True, slots=True)
class LaneInput:
    """A line in the direction of travel as it was sent.

    Parameters
    ----------
    coordinates : tuple of (float, float)
        Longitude and latitude [deg], or easting and northing [m] where `projected`.
    field : str
        Name of the coordinates in errors.
    provenance : PositionIn
        Height and reference system, and how the line was surveyed; without coordinates.
    """

    coordinates: tuple[tuple[float, float], ...]
    projected: bool
    field: str
    provenance: PositionIn


@dataclass(frozen=True, slots=True)
class PlacedTag:
    """Where an information tag lies on its lane. [m]"""

    chainage_m: float
    offset_m: float = 0.0


@dataclass(frozen=True, slots=True)
class PlacedLine:
    """Which part of a line carries magnets, and how far apart at most. [m]"""

    from_m: float = 0.0
    to_m: float | None = None
    spacing_m: float = 6.0


def place_lane(lane: LaneInput, accuracy_m: float) -> list[PlacedPosition]:
    """Every vertex in WGS 84 / ITRF.

    Raises
    ------
    InvalidParameter, ReferenceSystemError
        A vertex is out of range or does not fit the CRS.
    """
    placed, given = [], lane.provenance
    for number, (first, second) in enumerate(lane.coordinates):
        try:
            position = place_position(
                first,
                second,
                given.height_m,
                crs=given.crs,
                projected=lane.projected,
                realization=given.realization,
                epoch=given.epoch,
                ellipsoidal_height=given.vertical_datum in (None, "ellipsoid"),
                accuracy_m=accuracy_m,
            )
        except InvalidParameter as error:
            error.field = "lane.crs" if error.field == "position.crs" else f"lane.{lane.field}.{number}"
            raise
        placed.append(position)
    return placed


def lane_spec(lane: LaneInput, placed: list[PlacedPosition]) -> StoredLane:
    """What is kept of a lane: its vertices in WGS 84, and as they came where that was another system."""
    points_deg = [[p.lon_deg, p.lat_deg] for p in placed]
    sent = [list(point) for point in lane.coordinates]
    return {
        "points_deg": points_deg,
        "height_m": lane.provenance.height_m,
        "given": sent if sent != points_deg else None,
    }


def worst_grade(placed: list[PlacedPosition]) -> PlacedPosition:
    """The vertex with the least accurate frame."""
    return max(placed, key=lambda p: math.inf if p.transform_accuracy_m is None else p.transform_accuracy_m)


def layout_of(name: str, spec: MagnetSpec) -> MagnetLayout:
    """Layout of a magnet marker by its id and its spec."""
    return _layout(name, orjson.dumps({member: spec[member] for member in _LAID_OUT}))


def sheet_of(name: str, spec: MagnetSpec) -> DrillingSheet:
    """Drilling sheet of a magnet marker by its id and its spec."""
    return drilling_sheet(layout_of(name, spec), site_of(spec))


def site_of(spec: MagnetSpec) -> Site:
    """What the checks need to know of the road."""
    stored: Mapping[str, Any] = spec["site"]
    site = {name: value for name, value in stored.items() if value is not None}
    neighbours = tuple(
        Neighbour(n["name"], n["lon_deg"], n["lat_deg"], Orientation(n["phi_deg"])) for n in spec["neighbours"]
    )
    with naming("site"):
        return Site(**{**site, "vehicles": tuple(stored["vehicles"])}, neighbours=neighbours)


@lru_cache(maxsize=32)
def _layout(name: str, spec: bytes) -> MagnetLayout:
    """The layout; every spec is laid out several times between its request and its answer."""
    stored = orjson.loads(spec)
    lane, place = _lane(stored["lane"]), stored["place"]
    tag, meaning = parse_tag(stored["tag"]), meaning_of(stored)
    if isinstance(tag, LineTag):
        with naming("line"):
            return _place_line(lane, tag, PlacedLine(**place), name)
    with naming("tag"):
        return place_tag(lane, tag, place["chainage_m"], name=name, offset_m=place["offset_m"], meaning=meaning)


def _lane(spec: StoredLane) -> LaneLine:
    try:
        return LaneLine.from_lon_lat(spec["points_deg"], spec["height_m"] or 0.0)
    except InvalidParameter as error:
        error.field = "lane.height_m" if error.field == "height_m" else "lane"
        raise


def _place_line(lane: LaneLine, tag: LineTag, place: PlacedLine, name: str) -> MagnetLayout:
    end_m = lane.length_m if place.to_m is None else place.to_m
    if place.spacing_m > 0 and end_m - place.from_m > place.spacing_m * (MAX_MAGNETS - 1):
        raise InvalidParameter(
            f"{end_m - place.from_m:g} m of line every {place.spacing_m:g} m take more than {MAX_MAGNETS} magnets",
            field="to_m",
            limit=f"{MAX_MAGNETS} magnets in one marker",
            cure="register the line in sections",
        )
    return place_line(lane, tag.style, name=name, from_m=place.from_m, to_m=place.to_m, spacing_m=place.spacing_m)


def check_never_broken(layout: MagnetLayout, checks: tuple[Check, ...]) -> None:
    """Refuse a layout that could not be read.

    Raises
    ------
    InvalidParameter
        Magnets stand too near, or too far apart along a line.
    """
    for check in checks:
        if check.name in _NEVER_BROKEN and not check.passed:
            information = isinstance(layout.tag, InformationTag)
            raise InvalidParameter(
                f"{check.name}: {check.figure:.3f} {check.unit} ({check.note}), the limit is {check.relation} "
                f"{check.limit:g} {check.unit}: {check.source}",
                field="tag.code" if information else "line.spacing_m",
                limit=f"{check.relation} {check.limit:g} {check.unit}",
                cure="choose a code with wider gaps" if information else "choose a spacing between 0.5 and 6 m",
            )


def resurveyed(row: MarkerRow, lon_deg: float, lat_deg: float) -> MagnetSpec:
    """The spec of a tag whose first magnet was found at a position.

    Raises
    ------
    InvalidParameter
        It is a line, or lies too far from its layout.
    """
    spec: MagnetSpec = row.spec
    layout = layout_of(row.id, spec)
    if isinstance(layout.tag, LineTag):
        raise InvalidParameter(
            "a line of magnets has no single place",
            field="position",
            limit="positions of information tags",
            cure="retire the line and register it along its surveyed course",
        )
    target = layout.lane.from_position(lon_deg, lat_deg)[:2]
    away_m = float(math.dist(target, layout.holes[0].point_enu_m[:2]))
    if away_m > MAX_RESURVEY_M:
        raise InvalidParameter(
            f"the first magnet was surveyed {away_m:.2f} m away from its layout",
            field="position",
            limit=f"within {MAX_RESURVEY_M:g} m",
            cure="check the CRS; a tag somewhere else is another marker: retire this one and register it there",
        )
    place = PlacedTag(**row.spec["place"])
    for _ in range(20):  # a step is exact on a straight; on a bend the direction of the tag turns with its place
        east, north = (target - layout.holes[0].point_enu_m[:2]).tolist()
        if math.hypot(east, north) < 1e-7:
            break
        h = math.radians(layout.bearing_deg)
        place = PlacedTag(
            place.chainage_m + east * math.sin(h) + north * math.cos(h),
            place.offset_m - east * math.cos(h) + north * math.sin(h),
        )
        spec = {**spec, "place": {"chainage_m": place.chainage_m, "offset_m": place.offset_m}}
        layout = layout_of(row.id, spec)
    return spec
