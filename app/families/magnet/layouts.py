"""Magnet markers as requests have them, and their layout: kept as a lane, a tag and a place on it."""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import pairwise
from typing import Annotated, Final, Literal

import orjson
from pydantic import ConfigDict, Field, JsonValue, model_validator
from pyproj import Geod

from app.encoders.magnet import DrillingSheet, MagnetLayout, place_line, place_tag
from app.errors import InvalidParameter, naming
from app.families.documents import Height, MarkerIn, Metres, ProvenanceIn
from app.geodesy import PlacedPosition, place_position
from app.inputs import Identifier, Number, StrictModel, Text
from app.markers.magnet import InformationTag, Installation, LineStyle, LineTag, Orientation, parse_tag
from app.markers.magnet_design import MagnetSpec, Meaning, StoredLane, installation_of, meaning_of
from app.markers.reading import Check, MarkerRow
from app.planning.magnet_checks import Neighbour, Site, drilling_sheet
from app.roads.lane_line import LaneLine

# === Requests that register magnet markers.


MAX_LANE_POINTS = 2000
MAX_TAG_MAGNETS = 7  # source: `TagDesign`, seven magnets
MAX_MAGNETS = 1000
"""Of one marker, so that no request takes long: six kilometres of a line."""
_GEOD = Geod(ellps="WGS84")


class LineStringIn(StrictModel):
    """A GeoJSON LineString (RFC 7946) in the direction of travel."""

    type: Literal["LineString"]
    coordinates: list[Annotated[list[Number], Field(min_length=2, max_length=3)]] = Field(
        min_length=2,
        max_length=MAX_LANE_POINTS,
        description="Longitude and latitude of each vertex [deg]; heights are left out.",
    )


class LaneIn(ProvenanceIn):
    """The line that chainages are measured on, in the direction of legal travel, and where it comes from."""

    geometry: LineStringIn | None = Field(None, description="Longitude and latitude in a geographic CRS.")
    points_m: list[Annotated[list[Metres], Field(min_length=2, max_length=2)]] | None = Field(
        None, min_length=2, max_length=MAX_LANE_POINTS, description="Easting and northing in a projected CRS. [m]"
    )
    height_m: Height | None = Field(None, description="Height of the road, at which distances are true. [m]")

    @model_validator(mode="after")
    def _one_line(self) -> LaneIn:
        if (self.geometry is None) == (self.points_m is None):
            raise InvalidParameter(
                "a lane is a geometry of longitudes and latitudes, or points_m with a projected crs",
                limit="one of geometry, points_m",
                cure="send exactly one of the two",
            )
        return self

    @property
    def is_projected(self) -> bool:
        """Whether the points are eastings and northings."""
        return self.geometry is None

    @property
    def points(self) -> list[tuple[float, float]]:
        """Longitude and latitude [deg], or easting and northing [m], of each vertex."""
        return [(p[0], p[1]) for p in (self.points_m if self.geometry is None else self.geometry.coordinates) or ()]


class TagPlace(StrictModel):
    """Where the first magnet of an information tag lies."""

    chainage_m: Number = Field(description="Of the first magnet, along the lane. [m]")
    offset_m: Number = Field(0.0, description="Of the tag from the lane, left positive, up to 50. [m]")


class TagIn(TagPlace):
    """An information tag, by its code or by what it means in a codebook, and where its first magnet lies."""

    code: Text | None = Field(
        None, min_length=1, max_length=64, description="Polarities, length [m], segment [m], gaps: SNS_4_0.1_10-30."
    )
    codebook_id: Identifier | None = Field(None, description="Codebook of the meaning, or that the code must be in.")
    meaning: Meaning | None = Field(None, description="What the tag means; its code is the codebook's.")


class LinePlace(StrictModel):
    """Which part of a line carries magnets."""

    from_m: Number = Field(0.0, description="Chainage of the first magnet. [m]")
    to_m: Number | None = Field(None, description="Chainage of the last magnet; the end of the line if left out. [m]")
    spacing_m: Number = Field(
        6.0, description="Most that neighbours may be apart, 0.5 to 6; it is evened out over the section. [m]"
    )


class LineIn(LinePlace):
    """Line tags along the lane, which is the painted line."""

    style: LineStyle = Field(description="What is painted.")


_LANE_EXAMPLE: dict[str, JsonValue] = {
    "geometry": {"type": "LineString", "coordinates": [[-84.48, 42.7263], [-84.4776, 42.7263]]},
    "horizontal_rmse_m": 0.02,
    "realization": "ITRF2014",
    "survey_method": "GNSS RTK",
}
MAGNET_EXAMPLES: list[JsonValue] = [
    {
        "family": "magnet",
        "lane": _LANE_EXAMPLE,
        "tag": {"code": "SNS_4_0.1_10-30", "chainage_m": 60.0},
        "site": {"design_speed_m_s": 13.4, "stop_line_chainage_m": 130.0},
        "road": "Farm Lane",
    },
    {
        "family": "magnet",
        "lane": {
            "geometry": {"type": "LineString", "coordinates": [[-84.48, 42.72635], [-84.4776, 42.72635]]},
        },
        "line": {"style": "dashed", "from_m": 10.0, "to_m": 100.0, "spacing_m": 6.0},
        "installation": {"mounting": "surface", "shell_height_mm": 15.0},
    },
]


class MagnetIn(MarkerIn):
    """An information tag, or a line of line tags, to register."""

    model_config = ConfigDict(json_schema_extra={"examples": MAGNET_EXAMPLES})

    family: Literal["magnet"]
    lane: LaneIn
    tag: TagIn | None = None
    line: LineIn | None = None
    site: Site = Field(default_factory=Site)
    installation: Installation = Field(default_factory=Installation)

    @model_validator(mode="after")
    def _tag_or_line(self) -> MagnetIn:
        if (self.tag is None) == (self.line is None):
            raise InvalidParameter(
                "magnets are an information tag or a line of line tags",
                field="tag",
                limit="one of tag, line",
                cure="send exactly one of the two",
            )
        return self

    @property
    def place(self) -> dict[str, float | None]:
        """The place of the tag or the line on the lane, as it is stored."""
        what = self.tag or self.line
        assert what is not None
        return what.model_dump(include=set((TagPlace if self.tag else LinePlace).model_fields))

    @property
    def part_count(self) -> int:
        """Magnets of a line, from its length; up to those that one marker may have."""
        if self.line is None:
            return MAX_TAG_MAGNETS
        points = self.lane.points
        if self.lane.is_projected:
            length_m = sum(math.dist(one, other) for one, other in pairwise(points))
        else:
            length_m = _GEOD.line_length([p[0] for p in points], [p[1] for p in points])
        line = self.line
        to_m = length_m if line.to_m is None else min(line.to_m, length_m)
        count = (to_m - line.from_m) / line.spacing_m if line.spacing_m > 0 else math.inf
        return 1 + math.ceil(min(max(count, 0.0), MAX_MAGNETS))


# === A magnet marker's layout.


LINE_TAG: Final = "line-tag"
_LAID_OUT: Final = ("lane", "tag", "place", "meaning", "installation")
MAX_RESURVEY_M = 1.0
"""Farthest that a survey may find a tag from its layout: magnets are set within millimetres, GNSS is right to
centimetres. [m]"""
_NEVER_BROKEN = ("magnet-spacing", "line-spacing")
"""Checks whose failure makes a layout unreadable; the others are for the planner to weigh."""


def place_lane(lane: LaneIn, accuracy_m: float) -> list[PlacedPosition]:
    """Every vertex in WGS 84 / ITRF.

    Raises
    ------
    InvalidParameter, ReferenceSystemError
        A vertex is out of range or does not fit the CRS.
    """
    placed = []
    for number, (first, second) in enumerate(lane.points):
        try:
            position = place_position(
                first,
                second,
                lane.height_m,
                crs=lane.crs,
                projected=lane.is_projected,
                realization=lane.realization,
                epoch=lane.epoch,
                ellipsoidal_height=lane.vertical_datum in (None, "ellipsoid"),
                accuracy_m=accuracy_m,
            )
        except InvalidParameter as error:
            points = "points_m" if lane.is_projected else "geometry.coordinates"
            error.field = "lane.crs" if error.field == "position.crs" else f"lane.{points}.{number}"
            raise
        placed.append(position)
    return placed


def lane_spec(lane: LaneIn, placed: list[PlacedPosition]) -> StoredLane:
    """What is kept of a lane: its vertices in WGS 84, and as they came where that was another system."""
    points_deg = [[p.lon_deg, p.lat_deg] for p in placed]
    sent = [list(point) for point in lane.points]
    return {
        "points_deg": points_deg,
        "height_m": lane.height_m,
        "given": sent if sent != points_deg else None,
    }


def worst_grade(placed: list[PlacedPosition]) -> PlacedPosition:
    """The vertex with the least accurate frame."""
    return max(placed, key=lambda p: math.inf if p.transform_accuracy_m is None else p.transform_accuracy_m)


def layout_of(name: str, spec: MagnetSpec) -> MagnetLayout:
    """Layout of a magnet marker by its id and its spec."""
    return _layout(name, orjson.dumps({member: spec.get(member) for member in _LAID_OUT}))


_FORMER_NAMES: Final = {"design_speed_mps": "design_speed_m_s", "deceleration_mps2": "deceleration_m_s2"}
"""Of a site's members in markers that earlier releases wrote: the hashes of their versions cover the names."""


def site_of(spec: MagnetSpec) -> Site:
    """The site of a stored layout."""
    stored = {_FORMER_NAMES.get(name, name): value for name, value in spec["site"].items()}
    for name in {"vehicles", "wheel_circumference_m"} & set(stored):
        stored[name] = tuple(stored[name])
    return Site(**stored)


def sheet_of(name: str, spec: MagnetSpec) -> DrillingSheet:
    """Drilling sheet of a magnet marker by its id and its spec."""
    neighbours = [
        Neighbour(n["name"], n["lon_deg"], n["lat_deg"], Orientation(n["phi_deg"])) for n in spec["neighbours"]
    ]
    return drilling_sheet(layout_of(name, spec), site_of(spec), neighbours)


@lru_cache(maxsize=32)
def _layout(name: str, spec: bytes) -> MagnetLayout:
    """The layout; every spec is laid out several times between its request and its answer."""
    stored = orjson.loads(spec)
    lane, place = _lane(stored["lane"]), stored["place"]
    tag, meaning = parse_tag(stored["tag"]), meaning_of(stored)
    installation = installation_of(stored)
    if isinstance(tag, LineTag):
        with naming("line"):
            return _place_line(lane, tag, LinePlace(**place), name, installation)
    with naming("tag"):
        return place_tag(
            lane, tag, place["chainage_m"], name=name, offset_m=place["offset_m"], meaning=meaning,
            installation=installation,
        )  # fmt: skip


def _lane(spec: StoredLane) -> LaneLine:
    try:
        return LaneLine.from_lon_lat(spec["points_deg"], spec["height_m"] or 0.0)
    except InvalidParameter as error:
        error.field = "lane.height_m" if error.field == "height_m" else "lane"
        raise


def _place_line(lane: LaneLine, tag: LineTag, place: LinePlace, name: str, installation: Installation) -> MagnetLayout:
    end_m = lane.length_m if place.to_m is None else place.to_m
    if place.spacing_m > 0 and end_m - place.from_m > place.spacing_m * (MAX_MAGNETS - 1):
        raise InvalidParameter(
            f"{end_m - place.from_m:g} m of line every {place.spacing_m:g} m take more than {MAX_MAGNETS} magnets",
            field="to_m",
            limit=f"{MAX_MAGNETS} magnets in one marker",
            cure="register the line in sections",
        )
    return place_line(
        lane, tag.style, name=name, from_m=place.from_m, to_m=place.to_m, spacing_m=place.spacing_m,
        installation=installation,
    )  # fmt: skip


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
    place = TagPlace(**row.spec["place"])
    for _ in range(20):  # a step is exact on a straight; on a bend the direction of the tag turns with its place
        east, north = (target - layout.holes[0].point_enu_m[:2]).tolist()
        if math.hypot(east, north) < 1e-7:
            break
        h = math.radians(layout.bearing_deg)
        place = TagPlace(
            chainage_m=place.chainage_m + east * math.sin(h) + north * math.cos(h),
            offset_m=place.offset_m - east * math.cos(h) + north * math.sin(h),
        )
        spec = {**spec, "place": place.model_dump()}
        layout = layout_of(row.id, spec)
    return spec
