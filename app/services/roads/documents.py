"""Roads as clients send them and what the API returns about them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import lru_cache
from itertools import chain, pairwise
from typing import Annotated, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import orjson
import sqlalchemy as sa
from pydantic import BaseModel, ConfigDict, FailFast, Field, JsonValue
from typing_extensions import TypedDict

from app.errors import InvalidParameter
from app.families.documents import Metres
from app.geodesy import PlacedPositions, place_positions
from app.inputs import Number, StrictModel, Text
from app.registry.roads import ROADS, RoadRow, RoadSummaryRow, StoredStation
from app.roads.axis import Axis, Foot
from app.roads.lane_line import CalibrationPoint, Measures, calibrate
from app.services.documents import document_of
from app.values import JsonObject

# === The lines and the calibration of a road as they are sent, brought to WGS 84 and onto the axis.


_REACH_M = 50.0
_AMBIGUOUS_M = 1.0
_ROUNDING_M = 0.001  # of chainages that a form shows

MAX_CALIBRATION = 5_000
Reason = Annotated[Text, Field(min_length=1, max_length=500, description="Why; goes into the history.")]
Count = Annotated[int, Field(strict=True, ge=0, lt=2**31)]
# long lists stop at their first error: a body of 1 MiB has room for 200,000 of them
_Line = Annotated[
    list[Annotated[list[Number], Field(min_length=2, max_length=4), FailFast()]], Field(min_length=2), FailFast()
]


class _Geometry(BaseModel):
    model_config = ConfigDict(extra="ignore")  # RFC 7946, section 6.1: foreign members


class GeoLineIn(_Geometry):
    """A line."""

    type: Literal["LineString"]
    coordinates: _Line

    @property
    def lines(self) -> list[list[list[float]]]:
        """The line alone."""
        return [self.coordinates]


class MultiLineStringIn(_Geometry):
    """Several lines."""

    type: Literal["MultiLineString"]
    coordinates: Annotated[list[_Line], Field(min_length=1), FailFast()]

    @property
    def lines(self) -> list[list[list[float]]]:
        """All lines."""
        return self.coordinates


AnyLine = Annotated[GeoLineIn | MultiLineStringIn, Field(discriminator="type")]
"""Lines of longitude and latitude [deg], or of easting and northing in the unit of the CRS; heights are left out."""


class StationIn(StrictModel):
    """A calibration point: a place with a known measure. The place is a vertex, a position or a chainage."""

    measure_m: Metres = Field(description="Measure there, coming from before. [m]")
    ahead_m: Metres | None = Field(None, description="At an equation of stationing: the measure going on. [m]")
    part: Count = Field(0, description="Line of a MultiLineString, from 0; with `vertex` or `chainage_m`.")
    vertex: Count | None = Field(None, description="Vertex of the line, from 0.")
    position: Annotated[list[Number], Field(min_length=2, max_length=2)] | None = Field(
        None, description="Instead of a vertex: a position within 50 m of the axis, in the road's CRS."
    )
    chainage_m: Metres | None = Field(
        None, description="Instead of a vertex: distance along the axis from the start of its first line. [m]"
    )


class AxisIn(StrictModel):
    """Reference system of an axis and of its calibration, and what is done with it."""

    crs: Text | None = Field(None, max_length=100, description="EPSG code or URN of the geometry; WGS 84 if left out.")
    realization: Text | None = Field(None, min_length=1, max_length=64)
    epoch: Annotated[float, Field(strict=True, allow_inf_nan=False, ge=1900, le=2200)] | None = None
    measure_markers: Annotated[bool, Field(strict=True)] = Field(
        True, description="Give the markers that name the road the measure and offset of their position."
    )
    dry_run: Annotated[bool, Field(strict=True)] = Field(False, description="Say what would happen; store nothing.")
    reason: Reason | None = None


ROAD_EXAMPLE: dict[str, JsonValue] = {
    "name": "A 5 northbound",
    "crs": "EPSG:25832",
    "geometry": {"type": "LineString", "coordinates": [[456000, 5427000], [456060, 5427210], [456150, 5427400]]},
    "calibration": [{"measure_m": 612000, "vertex": 0}, {"measure_m": 612430, "vertex": 2}],
}


class RoadIn(AxisIn):
    """A road to register."""

    model_config = ConfigDict(json_schema_extra={"examples": [ROAD_EXAMPLE]})

    name: Text = Field(min_length=1, max_length=200, description="As the markers on it say in `road`.")
    geometry: AnyLine = Field(description="The axis in the direction of rising measures; heights are left out.")
    calibration: Annotated[list[StationIn], Field(max_length=MAX_CALIBRATION)] = Field(
        default_factory=list, description="Known measures; without, true metres from 0."
    )


class RoadPatch(AxisIn):
    """Members to change; one that is left out stays. A new geometry comes with its calibration."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [{"calibration": [{"measure_m": 612000, "vertex": 0}], "reason": "new kilometre posts"}]
        },
    )

    geometry: AnyLine | None = None
    calibration: Annotated[list[StationIn], Field(max_length=MAX_CALIBRATION)] | None = None


@dataclass(frozen=True, slots=True)
class PlacedLines:
    """Lines in WGS 84 / ITRF, and how good that is."""

    parts: list[list[list[float]]]
    crs: str
    realization: str | None
    epoch: float | None
    transform_accuracy_m: float | None
    grade: str
    note: str | None


def place_lines(geometry: AnyLine, axis: AxisIn, accuracy_m: float) -> PlacedLines:
    """Bring lines to WGS 84 / ITRF.

    Raises
    ------
    InvalidParameter, ReferenceSystemError
        The CRS is unknown, or a vertex is out of its range.
    """
    flat = np.array([point[:2] for line in geometry.lines for point in line], dtype=np.float64)
    placed = _placed(flat, axis, accuracy_m, ["geometry.coordinates"] * len(flat))
    points = np.stack([placed.lon_deg, placed.lat_deg], axis=1).tolist()
    ends = np.cumsum([len(line) for line in geometry.lines]).tolist()
    parts = [points[start:end] for start, end in zip([0, *ends[:-1]], ends, strict=True)]
    accuracy, grade = placed.transform_accuracy_m, str(placed.grade)
    return PlacedLines(parts, placed.crs, placed.realization, placed.epoch, accuracy, grade, placed.note)


def resolve_calibration(
    axis: Axis, given: AxisIn, points: Sequence[StationIn], accuracy_m: float
) -> list[CalibrationPoint]:
    """Calibration points on the axis, in its order.

    Raises
    ------
    InvalidParameter
        A vertex or a part that is not there, or a position that is too far from the axis or beside it twice.
    """
    feet = _feet(axis, given, points, accuracy_m)
    settled = [_settled(axis, point, feet.get(k, []), f"calibration.{k}") for k, point in enumerate(points)]
    return sorted(settled, key=lambda point: (point.part, point.chainage_m))


def _feet(axis: Axis, given: AxisIn, points: Sequence[StationIn], accuracy_m: float) -> dict[int, list[Foot]]:
    """Feet of the calibration points that are positions, by the number of the point."""
    positions = {k: point.position for k, point in enumerate(points) if point.position is not None}
    if not positions:
        return {}
    fields = [f"calibration.{k}.position" for k in positions]
    placed = _placed(np.array(list(positions.values()), dtype=np.float64), given, accuracy_m, fields)
    return dict(zip(positions, axis.locate(placed.lon_deg, placed.lat_deg, _REACH_M), strict=True))


def _settled(axis: Axis, point: StationIn, feet: list[Foot], field: str) -> CalibrationPoint:
    if [point.vertex, point.position, point.chainage_m].count(None) != 2:
        raise InvalidParameter(
            "a calibration point is a vertex, a position or a chainage",
            field=field,
            limit="vertex, position or chainage_m",
            cure="send one of the three",
        )
    if point.chainage_m is not None:
        return _at_chainage(axis, point, point.chainage_m, field)
    if point.vertex is not None:
        vertices_m = axis.vertex_chainages_m
        if point.part >= len(vertices_m) or point.vertex >= len(vertices_m[point.part]):
            raise InvalidParameter(
                f"there is no vertex {point.vertex} in part {point.part}",
                field=f"{field}.vertex",
                limit=f"{len(vertices_m)} parts of {', '.join(str(len(v)) for v in vertices_m[:20])} vertices, from 0",
                cure="count parts and vertices from 0",
            )
        chainage_m = float(vertices_m[point.part][point.vertex])
        return CalibrationPoint(point.part, chainage_m, point.measure_m, point.ahead_m)
    if not feet:
        raise InvalidParameter(
            f"the position of measure {point.measure_m:g} m is not at the road",
            field=f"{field}.position",
            limit=f"{_REACH_M:g} m from the axis",
            cure="give a position on the axis, in the road's own CRS",
        )
    if len(feet) > 1 and feet[1].distance_m - feet[0].distance_m < _AMBIGUOUS_M:
        raise InvalidParameter(
            f"the road passes the position of measure {point.measure_m:g} m more than once",
            field=f"{field}.position",
            limit="one place on the axis",
            cure="give the vertex instead",
        )
    return CalibrationPoint(feet[0].part, feet[0].chainage_m, point.measure_m, point.ahead_m)


def _at_chainage(axis: Axis, point: StationIn, chainage_m: float, field: str) -> CalibrationPoint:
    """The place at a chainage, in the part that was named: where parts touch, both have the chainage."""
    ranges_m = axis.part_ranges_m
    for start_m, end_m in ranges_m[point.part : point.part + 1]:
        if start_m - _ROUNDING_M <= chainage_m <= end_m + _ROUNDING_M:
            return CalibrationPoint(point.part, min(max(chainage_m, start_m), end_m), point.measure_m, point.ahead_m)
    parts = ", ".join(f"{start:.3f} to {end:.3f}" for start, end in ranges_m[:20])
    raise InvalidParameter(
        f"the chainage {chainage_m:g} m is not on part {point.part}",
        field=f"{field}.chainage_m",
        limit=f"along the axis, part by part: {parts} m",
        cure="give the distance along the axis from its start, and its part, from 0",
    )


def _placed(
    points: npt.NDArray[np.float64], given: AxisIn, accuracy_m: float, fields: Sequence[str]
) -> PlacedPositions:
    try:
        placed = place_positions(
            points[:, 0],
            points[:, 1],
            np.full(len(points), np.nan),
            crs=given.crs,
            realization=given.realization,
            epoch=given.epoch,
            accuracy_m=accuracy_m,
        )
    except InvalidParameter as error:
        error.field = "crs" if error.field == "position.crs" else fields[0]
        raise
    if not placed.placed.all():
        k = int(np.argmin(placed.placed))
        raise InvalidParameter(
            f"vertex {k}, {points[k, 0]:g} {points[k, 1]:g}, is not in the area of {placed.crs}",
            field=fields[k],
            limit=f"coordinates of {placed.crs}, longitude or easting first",
            cure="check the CRS and the order of the axes",
        )
    return placed


# === Roads as routes: positions to measures and offsets, and back; what a marker's place on its road is.


MARKER_REACH_M = 100.0
"""A marker that is farther from its road's axis has no measure on it. [m]"""
AMBIGUOUS_M = 1.0
"""Feet whose distances differ by less than this cannot be distinguished by the position alone. [m]"""
_ON_END_M = 0.01
_AT_ONCE = 1_000  # markers that are located at the same time; source: as `locate` of a road, bounds its pairs


@dataclass(frozen=True, slots=True)
class Route:
    """An axis with its measures."""

    axis: Axis
    measures: Measures

    def feet(self, positions: Sequence[tuple[float, float]], reach_m: float) -> list[list[Foot]]:
        """Feet of positions (lon_deg, lat_deg), for each the nearest first."""
        lon, lat = (np.array([position[k] for position in positions], dtype=np.float64) for k in (0, 1))
        return self.axis.locate(lon, lat, reach_m)

    def measure_of(self, foot: Foot) -> float:
        """Measure of a foot. [m]"""
        return self.measures.measure_at(foot.part, foot.chainage_m)

    def section_ranges_m(self) -> list[tuple[float, float]]:
        """Measures of each section, with those before it that are on no section; the ends are open. [m]"""
        ends = [(float(one.measures_m[0]), float(one.measures_m[-1])) for one in self.measures.sections]
        lows = [-math.inf, *(min(low, before) for (_, before), (low, _) in pairwise(ends))]
        highs = [*(high for _, high in ends[:-1]), math.inf]
        return list(zip(lows, highs, strict=True))

    def sections_of(self, positions: Sequence[tuple[float, float]], measures_m: Sequence[float]) -> list[int]:
        """Section of each position (lon_deg, lat_deg) with its measure: where the measure repeats, the nearest one."""
        ranges = self.section_ranges_m()
        found = [
            [k for k, (low_m, high_m) in enumerate(ranges) if low_m <= measure_m <= high_m] for measure_m in measures_m
        ]
        several = [k for k, sections in enumerate(found) if len(sections) != 1]
        for k, feet in zip(several, self.feet([positions[k] for k in several], MARKER_REACH_M), strict=True):
            if feet:
                foot = min(feet, key=lambda one: abs(self.measure_of(one) - measures_m[k]) + one.distance_m)
                found[k] = [self.measures.section_at(foot.part, foot.chainage_m)]
        return [sections[0] if sections else 0 for sections in found]


def route_of(row: RoadRow) -> Route:
    """The route of a road's row; those of the last 64 are kept."""
    return _route(orjson.dumps([row.parts, row.calibration]))


@lru_cache(maxsize=64)
def _route(content: bytes) -> Route:
    parts, points = orjson.loads(content)
    return build_route(parts, [CalibrationPoint(**point) for point in points])


def build_route(parts: Sequence[Sequence[Sequence[float]]], points: Sequence[CalibrationPoint]) -> Route:
    """A route from its lines and its calibration.

    Raises
    ------
    InvalidParameter
        The lines are none, or the measures do not rise along them.
    """
    axis = Axis(parts)
    return Route(axis, calibrate(axis.part_ranges_m, points))


def is_ambiguous(feet: Sequence[Foot]) -> bool:
    """Whether the position alone does not determine the foot."""
    return len(feet) > 1 and feet[1].distance_m - feet[0].distance_m < AMBIGUOUS_M


# --- markers on roads ---------------------------------------------------------------------------------------------


class Reference(NamedTuple):
    """A marker's place on its road, or why it has none there."""

    measure_m: float | None
    offset_m: float | None
    why_not: str | None = None


def references_of(
    route: Route,
    positions: Sequence[tuple[float, float]],
    before_m: Sequence[float | None],
    old: Route | None = None,
) -> list[Reference]:
    """Places of markers on a road.

    Parameters
    ----------
    before_m : sequence of float or None
        Their previous measures, which distinguish ambiguous feet. [m]
    old : Route, optional
        What those measures were on, if that was another.
    """
    found = []
    located = chain.from_iterable(
        route.feet(positions[start : start + _AT_ONCE], MARKER_REACH_M) for start in range(0, len(positions), _AT_ONCE)
    )
    for feet, measure_m in zip(located, before_m, strict=True):
        if not feet:
            found.append(Reference(None, None, f"farther than {MARKER_REACH_M:g} m from the road"))
            continue
        foot = feet[0]
        if is_ambiguous(feet):
            if measure_m is None:
                found.append(Reference(None, None, "the road passes more than once"))
                continue
            near = [f for f in feet if f.distance_m - foot.distance_m < AMBIGUOUS_M]
            foot = min(near, key=lambda f: _disagreement(route, f, measure_m, old))
        if abs(foot.beyond_m) > _ON_END_M:
            found.append(Reference(None, None, f"{abs(foot.beyond_m):.2f} m beyond the road's end"))
            continue
        found.append(Reference(route.measure_of(foot), foot.offset_m + 0.0))  # SQLite stores no -0.0
    return found


def _disagreement(route: Route, foot: Foot, measure_m: float, old: Route | None) -> float:
    """How far a foot is from where a measure was, along the axis if that is still the same. [m]"""
    if old is not None and old.axis.part_ranges_m == route.axis.part_ranges_m:
        places = old.measures.places_of(measure_m)
        return min((abs(chainage_m - foot.chainage_m) for _, _, chainage_m in places), default=float("inf"))
    return abs(route.measure_of(foot) - measure_m)


def linear_references(
    connection: sa.Connection,
    agency_id: str,
    markers: Sequence[JsonObject],
    before_m: Sequence[float | None],
) -> list[dict[str, float | None]]:
    """Measure and offset of markers whose columns name a road with an axis, None where they have no place on it.

    Empty for those on no registered road.
    """
    found: list[dict[str, float | None]] = [{} for _ in markers]
    named: dict[str, list[int]] = {}
    for k, marker in enumerate(markers):
        if marker.get("road") is not None:
            named.setdefault(marker["road"], []).append(k)
    for name, own in named.items():
        row = ROADS.find(connection, agency_id, name=name)
        if row is None:
            continue
        positions = [(markers[k]["lon_deg"], markers[k]["lat_deg"]) for k in own]
        references = references_of(route_of(row), positions, [before_m[k] for k in own])
        for k, reference in zip(own, references, strict=True):
            found[k] = {"measure_m": reference.measure_m, "offset_m": reference.offset_m}
    return found


# === What the API returns about roads.


_SAME_PLACE_DEG = 1e-9
_SAME_CHAINAGE_M = 1e-6


class RoadSummary(TypedDict):
    """A road without its geometry; a road that was only checked has no id."""

    id: str | None
    name: str
    version: int
    length_m: float
    from_m: float
    to_m: float
    localization_grade: str
    transform_note: str | None
    crs: str
    realization: str | None
    epoch: float | None
    created_at: datetime
    updated_at: datetime


class RoadGeometry(TypedDict):
    """The axis in WGS 84 / ITRF, as GeoJSON."""

    type: Literal["LineString", "MultiLineString"]
    coordinates: list[list[float]] | list[list[list[float]]]


class Station(StoredStation):
    """A calibration point on the axis; `vertex` counts within its part, and is null between vertices."""

    vertex: int | None


class Section(TypedDict):
    """A stretch of the road in which measures are unique."""

    part: int
    from_m: float
    to_m: float
    length_m: float


class UnmeasuredMarker(TypedDict):
    """A marker that has no place on the road."""

    marker_id: str
    why: str | None


class MeasuredMarkers(TypedDict):
    """How many markers that name the road got a new measure, kept theirs, or have no place on it."""

    measured: int
    unchanged: int
    left: int
    largest_change_m: float
    left_out: list[UnmeasuredMarker]


class RoadDocument(RoadSummary):
    """A road with its geometry and its calibration."""

    geometry: RoadGeometry
    calibration: list[Station]
    sections: list[Section]


class ChangedRoad(RoadDocument):
    """A road that was registered or changed; `markers` is null if its markers were not measured."""

    markers: MeasuredMarkers | None


class RoadPage(TypedDict):
    """A page of roads; the Link header leads to the next one."""

    items: list[RoadSummary]


class RoadVersionDocument(TypedDict):
    """One entry of a road's history."""

    version: int
    at: datetime
    who: str
    why: str | None
    road: RoadDocument


class RoadVersionPage(TypedDict):
    """A page of a road's history, oldest first."""

    items: list[RoadVersionDocument]


class FootDocument(TypedDict):
    """Where a position lies along the road."""

    measure_m: float
    offset_m: float
    section: int
    chainage_m: float
    heading_deg: float
    beyond_m: float
    exact: bool


class LocatedPosition(TypedDict):
    """Feet of a position, the nearest first; none if it is too far from the road."""

    ambiguous: bool
    feet: list[FootDocument]


class PlaceDocument(TypedDict):
    """Where a measure and an offset are."""

    lon_deg: float
    lat_deg: float
    section: int
    chainage_m: float
    heading_deg: float
    exact: bool


class PlacedReference(TypedDict):
    """Places of a reference; several where the measure repeats, none where it is on no road."""

    ambiguous: bool
    places: list[PlaceDocument]


class OnRoad(TypedDict):
    """The road and its version that a response is about."""

    road_id: str
    road: str
    version: int
    sections: list[Section]


class RoadLocated(OnRoad, LocatedPosition):
    """One position on a road."""


class RoadPlaced(OnRoad, PlacedReference):
    """One reference on a road."""


class RoadLocatedMany(OnRoad):
    """Positions on a road, in the order of the request."""

    items: list[LocatedPosition]


class RoadPlacedMany(OnRoad):
    """References on a road, in the order of the request."""

    items: list[PlacedReference]


def road_document(row: RoadRow) -> RoadDocument:
    """A road with its geometry and its calibration."""
    several = row.given["several"] or len(row.parts) > 1
    route = route_of(row)
    return {
        **road_summary(row),
        "geometry": {
            "type": "MultiLineString" if several else "LineString",
            "coordinates": row.parts if several else row.parts[0],
        },
        "calibration": [{**point, "vertex": _vertex_of(route, point)} for point in row.calibration],
        "sections": sections(route),
    }


def _vertex_of(route: Route, point: StoredStation) -> int | None:
    vertices_m = route.axis.vertex_chainages_m[point["part"]]
    nearest = int(np.argmin(np.abs(vertices_m - point["chainage_m"])))
    return nearest if abs(vertices_m[nearest] - point["chainage_m"]) < _SAME_CHAINAGE_M else None


def road_summary(row: RoadRow | RoadSummaryRow) -> RoadSummary:
    """A road without its geometry."""
    return document_of(RoadSummary, row, **row.given)


def sections(route: Route) -> list[Section]:
    """Where the measures of a road are unique."""
    return [
        {
            "part": section.part,
            "from_m": float(section.measures_m[0]),
            "to_m": float(section.measures_m[-1]),
            "length_m": float(section.chainages_m[-1] - section.chainages_m[0]),
        }
        for section in route.measures.sections
    ]


def located_position(route: Route, feet: Sequence[Foot]) -> LocatedPosition:
    """Where a position lies along a road: its feet, the nearest first."""
    return {
        "ambiguous": is_ambiguous(feet),
        "feet": [
            {
                "measure_m": route.measure_of(foot),
                "offset_m": foot.offset_m,
                "section": route.measures.section_at(foot.part, foot.chainage_m),
                "chainage_m": foot.chainage_m,
                "heading_deg": _heading(route, foot.part, foot.chainage_m),
                "beyond_m": foot.beyond_m,
                "exact": foot.exact,
            }
            for foot in feet
        ],
    }


def placed_reference(route: Route, measure_m: float, offset_m: float) -> PlacedReference:
    """Where a measure and an offset are: more than one place where the measure occurs more than once."""
    places: list[PlaceDocument] = []
    for section, part, chainage_m in route.measures.places_of(measure_m):
        lon, lat, folded = route.axis.place(np.array([part]), np.array([chainage_m]), np.array([offset_m]))
        place: PlaceDocument = {
            "lon_deg": float(lon[0]),
            "lat_deg": float(lat[0]),
            "section": section,
            "chainage_m": chainage_m,
            "heading_deg": _heading(route, part, chainage_m),
            "exact": not bool(folded[0]),
        }
        if not any(_is_same(place, other) for other in places):
            places.append(place)
    return {"ambiguous": len(places) > 1, "places": places}


def _is_same(one: PlaceDocument, other: PlaceDocument) -> bool:
    return (
        abs(one["lon_deg"] - other["lon_deg"]) < _SAME_PLACE_DEG
        and abs(one["lat_deg"] - other["lat_deg"]) < _SAME_PLACE_DEG
    )


def _heading(route: Route, part: int, chainage_m: float) -> float:
    return float(route.axis.heading_deg(np.array([part]), np.array([chainage_m]))[0])
