"""A magnet marker's layout: kept as a lane, a tag and a place on it, from which everything else follows."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import pairwise
from typing import Any, ClassVar, Final, Literal

import orjson
from pyproj import Geod
from typing_extensions import TypedDict

from app.encoders.magnet import DrillingSheet, MagnetLayout, place_line, place_tag
from app.errors import InvalidParameter, naming
from app.families.documents import PositionIn
from app.families.surveys import NewMarker
from app.geodesy import PlacedPosition, place_position
from app.markers.magnet import InformationTag, LineStyle, LineTag, Orientation, parse_tag
from app.markers.magnet_design import Meaning, MeaningKind
from app.markers.reading import Check
from app.planning.magnet_checks import Neighbour, Site, drilling_sheet
from app.registry.marker_rows import MarkerRow
from app.roads.lane_line import LaneLine

# === What the row of a magnet marker has in its column `spec`.


class StoredMeaning(TypedDict):
    """The kind of a meaning and its value."""

    kind: str
    value: float | str


class TagPlaceDocument(TypedDict):
    """Where an information tag lies on its lane."""

    chainage_m: float
    offset_m: float


class LinePlaceDocument(TypedDict):
    """Which part of a line carries magnets."""

    from_m: float
    to_m: float | None
    spacing_m: float


class StoredLane(TypedDict):
    """Vertices in WGS 84, and in `given` the coordinates that were sent where they were of another system."""

    points_deg: list[list[float]]
    height_m: float | None
    given: list[list[float]] | None


class SiteDocument(TypedDict):
    """What the checks know of the road and its traffic."""

    design_speed_m_s: float | None
    stop_line_chainage_m: float | None
    vehicles: list[str]
    readable_clearance_m: float
    reaction_s: float
    deceleration_m_s2: float


class StoredNeighbour(TypedDict):
    """The nearest magnet of another marker with an orientation."""

    name: str
    lon_deg: float
    lat_deg: float
    phi_deg: int


class MagnetSpec(TypedDict):
    """What the layout of a magnet marker follows from."""

    kind: Literal["information-tag", "line-tag"]
    tag: str
    codebook_id: str | None
    meaning: StoredMeaning | None
    lane: StoredLane
    place: TagPlaceDocument | LinePlaceDocument
    site: SiteDocument
    neighbours: list[StoredNeighbour]


def meaning_of(spec: MagnetSpec) -> Meaning | None:
    """What the tag means, if it is in a codebook."""
    stored = spec["meaning"]
    return None if stored is None else Meaning(MeaningKind(stored["kind"]), stored["value"])


# === A magnet marker's layout.


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
    """A line in the direction of travel as it was sent."""

    # longitude and latitude [deg], or easting and northing [m] where `projected`
    coordinates: tuple[tuple[float, float], ...]
    projected: bool
    field: str  # name of the coordinates in errors
    provenance: PositionIn  # height and reference system, and how the line was surveyed; without coordinates


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


# === Magnets that are to be registered, as their use case knows them.


MAX_TAG_MAGNETS = 7  # source: `TagDesign`, seven magnets
_GEOD = Geod(ellps="WGS84")


@dataclass(frozen=True, slots=True)
class TagInput:
    """An information tag to place, named by its text or by its meaning in a codebook."""

    place: PlacedTag
    code: str | None = None
    codebook_id: str | None = None
    meaning: tuple[str, float | str] | None = None


@dataclass(frozen=True, slots=True)
class LineInput:
    """A line of line tags to place."""

    place: PlacedLine
    style: LineStyle


@dataclass(frozen=True, slots=True)
class NewMagnets(NewMarker):
    """A tag or a line of magnets to register."""

    family: ClassVar[str] = "magnet"
    lane: LaneInput
    what: TagInput | LineInput
    site: dict[str, Any] = field(default_factory=dict)

    @property
    def part_count(self) -> int:
        """Magnets of a line, from its length; up to those that one marker may have."""
        if isinstance(self.what, TagInput):
            return MAX_TAG_MAGNETS
        first, second = zip(*self.lane.coordinates, strict=True)
        length_m = _GEOD.line_length(first, second) if not self.lane.projected else _plane_length(first, second)
        place = self.what.place
        to_m = length_m if place.to_m is None else min(place.to_m, length_m)
        count = (to_m - place.from_m) / place.spacing_m if place.spacing_m > 0 else math.inf
        return 1 + math.ceil(min(max(count, 0.0), MAX_MAGNETS))


def _plane_length(east: tuple[float, ...], north: tuple[float, ...]) -> float:
    return sum(math.dist(one, other) for one, other in pairwise(zip(east, north, strict=True)))
