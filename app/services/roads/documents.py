"""What the API returns about roads."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from typing import Literal

import numpy as np
from typing_extensions import TypedDict

from app.registry.roads import RoadRow, RoadSummaryRow, StoredStation
from app.roads.axis import Foot
from app.services.documents import document_of
from app.services.roads.routes import Route, is_ambiguous, route_of

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
