"""Finding markers: GET /v1/markers, and POST /v1/markers/search for what does not fit into an address."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Annotated

from fastapi import Depends, Query, Request, Response
from pydantic import ConfigDict, Field, model_validator

from app.api.http.dependencies import AfterLink, Caller, LastId, PageSize, use_case
from app.api.http.permissions import READERS
from app.api.http.responses import checked_id, cursor_of, document_response, json_response, page_response, parse_time
from app.api.http.routes import Router
from app.api.http.strict_json import AnyPolygon
from app.errors import InvalidParameter
from app.families import FamilyName
from app.families.documents import Metres
from app.geodesy import check_lon_lat
from app.inputs import Identifier, Number, StrictModel, Text
from app.markers.reading import Status
from app.registry.markers import MarkerFilter
from app.services.markers.markers import FoundMarker, MarkerPage
from app.services.markers.searches import Searches as SearchesService
from app.services.markers.searches import (
    Selection,
    area_of,
    area_of_text,
    checked_box,
    circle,
    parse_box,
    parse_numbers,
)
from app.services.roads.documents import GeoLineIn

# === Which markers are meant: the query parameters that the list of markers and its exports share.


_MAX_POLYGON_TEXT = 8_000
_MetresQuery = Annotated[float | None, Query(ge=-1e8, le=1e8, allow_inf_nan=False)]


async def get_marker_filter(
    bbox: Annotated[Text | None, Query(max_length=200, examples=["114.1,22.2,114.3,22.4"])] = None,
    polygon: Annotated[
        Text | None, Query(max_length=_MAX_POLYGON_TEXT, description="WKT of a POLYGON or MULTIPOLYGON.")
    ] = None,
    road: Annotated[Text | None, Query(min_length=1, max_length=200)] = None,
    from_m: _MetresQuery = None,
    to_m: _MetresQuery = None,
    code: Annotated[
        Text | None,
        Query(
            min_length=1,
            max_length=64,
            description="All digits of a plate, the text of a tag, or the number of a CERPM.",
        ),
    ] = None,
    status: Status | None = None,
    family: FamilyName | None = None,
) -> MarkerFilter:
    """The filter in a query.

    Raises
    ------
    InvalidParameter
        A part cannot be read or is out of range, or measures come without their road.
    """
    filtered = MarkerFilter(
        box=parse_box(bbox) if bbox is not None else None,
        area=area_of_text(polygon) if polygon is not None else None,
        road=road,
        from_m=from_m,
        to_m=to_m,
        digits=code,
        status=status,
        family=family,
    )
    check_measures(filtered)
    return filtered


Filtered = Annotated[MarkerFilter, Depends(get_marker_filter)]


def check_measures(filtered: MarkerFilter) -> None:
    """Refuse measures without their road, as InvalidParameter."""
    if filtered.road is None and (filtered.from_m is not None or filtered.to_m is not None):
        raise InvalidParameter(
            "measures belong to a road", field="road", limit="a road with from_m, to_m", cure="name the road"
        )


# === Schema of a selection of markers.


class SelectionIn(StrictModel):
    """Markers by id or by filter."""

    marker_ids: list[Identifier] | None = Field(None, min_length=1, description="Ids, up to 5 000.")
    bbox: Annotated[list[Number], Field(min_length=4, max_length=4)] | None = Field(
        None, description="west, south, east, north. [deg]"
    )
    status: Status | None = Field(None, description="Only markers with this status.")

    @model_validator(mode="after")
    def _by_id_or_by_filter(self) -> SelectionIn:
        if (self.marker_ids is None) == (self.bbox is None and self.status is None):
            raise InvalidParameter(
                "markers are selected by id, or by a filter",
                field="marker_ids",
                limit="marker_ids; or bbox, status or both",
                cure="send one of the two",
            )
        return self

    def selection(self) -> Selection:
        """The selection as the use cases know it."""
        box = checked_box(*self.bbox) if self.bbox is not None else None
        return Selection(tuple(self.marker_ids or ()), MarkerFilter(box=box, status=self.status))


# === Schemas of searches for markers.


MAX_PAGE = 1000
MAX_RADIUS_M = 100_000.0
MAX_CORRIDOR_M = 2_000.0

Nearest = Annotated[int, Field(strict=True, ge=1, le=MAX_PAGE)]
Radius = Annotated[float, Field(allow_inf_nan=False, ge=0, le=MAX_RADIUS_M)]


class PlaceIn(StrictModel):
    """A place to search from."""

    lon_deg: Number = Field(description="Longitude. [deg]")
    lat_deg: Number = Field(description="Latitude. [deg]")


class AlongIn(StrictModel):
    """A corridor along a line."""

    geometry: GeoLineIn = Field(description="In the direction of travel, in longitude and latitude.")
    corridor_m: Annotated[float, Field(allow_inf_nan=False, gt=0, le=MAX_CORRIDOR_M)] = Field(
        description="Width: half of it to each side. [m]"
    )


class SearchIn(StrictModel):
    """What to search for; each member narrows further."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "polygon": {
                        "type": "Polygon",
                        "coordinates": [[[8.40, 49.00], [8.44, 49.00], [8.42, 49.02], [8.40, 49.00]]],
                    },
                    "family": "plate",
                },
                {"near": {"lon_deg": 114.1792, "lat_deg": 22.3041}, "nearest": 10, "status": "active"},
                {
                    "along": {
                        "geometry": {"type": "LineString", "coordinates": [[8.40, 49.00], [8.44, 49.01]]},
                        "corridor_m": 20,
                    }
                },
            ]
        },
    )

    bbox: Annotated[list[Number], Field(min_length=4, max_length=4)] | None = Field(
        None, description="west, south, east, north; a west above the east spans the antimeridian. [deg]"
    )
    polygon: AnyPolygon | None = Field(None, description="Markers inside or on the edge; up to 10 000 vertices.")
    near: PlaceIn | None = Field(None, description="With `radius_m`, `nearest` or both.")
    radius_m: Radius | None = Field(None, description="Geodesic distance from `near`. [m]")
    nearest: Nearest | None = Field(None, description="How many of the nearest to `near`, nearest first.")
    along: AlongIn | None = Field(None, description="Markers in the order of a line.")
    road: Text | None = Field(None, min_length=1, max_length=200)
    from_m: Metres | None = Field(None, description="Least measure on the road. [m]")
    to_m: Metres | None = Field(None, description="Greatest measure on the road. [m]")
    code: Text | None = Field(None, min_length=1, max_length=64)
    status: Status | None = None
    family: FamilyName | None = None


# === Finding markers.


router = Router("/v1/markers", "markers")

Searches = Annotated[SearchesService, use_case(lambda cases: cases.searches)]


@dataclass(frozen=True, slots=True)
class _Search:
    """A search as both routes ask it."""

    filtered: MarkerFilter
    place: tuple[float, float] | None = None
    radius_m: float | None = None
    nearest: int | None = None
    along: AlongIn | None = None
    as_of: datetime | None = None

    def __post_init__(self) -> None:
        far = self.radius_m is not None or self.nearest is not None
        if (self.place is not None) != far:
            raise InvalidParameter(
                "near needs radius_m or nearest, and they need near",
                field="near",
                limit="near=lon,lat with radius_m, nearest or both",
                cure="send both parts, or near=lon,lat,radius_m",
            )
        if self.along is not None and self.place is not None:
            raise InvalidParameter(
                "a search is about a place or along a line",
                field="along",
                limit="near or along",
                cure="search twice",
            )
        if self.as_of is not None and self.nearest is not None:
            raise InvalidParameter(
                "the nearest are found among the markers of today",
                field="as_of",
                limit="as_of without nearest",
                cure="ask for the markers within a radius",
            )
        check_measures(self.filtered)

    def answer(
        self, request: Request, caller: Caller, searches: SearchesService, *, limit: int, after: str | None
    ) -> Response:
        """A page, with a link to the next one."""
        if self.place is not None and self.nearest is not None:
            return json_response({"items": self._nearest(caller, searches, after)})
        if self.along is not None:
            line = self.along.geometry.coordinates
            for lon_deg, lat_deg, *_ in line:
                check_lon_lat(lon_deg, lat_deg, "along.geometry")
            page, last = searches.along(
                caller, self.filtered, line, self.along.corridor_m, after=cursor_of(after), limit=limit
            )
        else:
            filtered = self.filtered
            if self.place is not None and self.radius_m is not None:
                filtered = circle(filtered, self.place, self.radius_m)
            if self.as_of is not None:
                page, last = searches.page_as_of(caller, filtered, self.as_of, after=checked_id(after), limit=limit)
            else:
                page, last = searches.page(caller, filtered, after=checked_id(after), limit=limit)
        return page_response(request, {"items": page}, after=last)

    def _nearest(self, caller: Caller, searches: SearchesService, after: str | None) -> list[FoundMarker]:
        assert self.place is not None
        assert self.nearest is not None
        if after is not None:
            raise InvalidParameter(
                "the nearest markers come at once", field="after", limit="no pages", cure="leave after out"
            )
        return searches.nearest(caller, self.filtered, self.place, self.nearest, self.radius_m)


@router.get("", READERS, responses=document_response(MarkerPage))
def list_markers(
    request: Request,
    caller: Caller,
    searches: Searches,
    filtered: Filtered,
    near: Annotated[Text | None, Query(max_length=200, examples=["114.179,22.304,500"])] = None,
    radius_m: Annotated[float | None, Query(ge=0, le=MAX_RADIUS_M, allow_inf_nan=False)] = None,
    nearest: Annotated[int | None, Query(ge=1, le=MAX_PAGE)] = None,
    as_of: Annotated[
        Text | None, Query(max_length=40, description="The registry as it was at this time (RFC 3339).")
    ] = None,
    limit: PageSize = 100,
    after: LastId = None,
) -> Response:
    """List the markers of an agency.

    In the order they were registered; with `nearest`, that many in the order of their distance.

    `bbox` is west,south,east,north, and spans the antimeridian where its west is above its east. `near` is lon,lat with
    `radius_m` or `nearest`, or lon,lat,radius_m. `from_m` and `to_m` are measures on a `road`. With `as_of` the filter
    is about the markers as they were then; a page may hold fewer than `limit` though `Link` leads on.

    Magnets are where their first one lies; lists leave out their lanes, magnets, checks and costs.
    """
    place, said_m = _near(near) if near is not None else (None, None)
    if said_m is not None and radius_m is not None:
        raise InvalidParameter(
            "the radius is said twice", field="near", limit="one radius", cure="leave radius_m out, or the third number"
        )
    at = parse_time(as_of, "as_of") if as_of is not None else None
    search = _Search(filtered, place, said_m if radius_m is None else radius_m, nearest, as_of=at)
    return search.answer(request, caller, searches, limit=limit, after=after)


@router.post("/search", READERS, expensive=True, responses=document_response(MarkerPage))
def search_markers(
    body: SearchIn, request: Request, caller: Caller, searches: Searches, limit: PageSize = 100, after: AfterLink = None
) -> Response:
    """Search markers by a polygon or a corridor.

    As the list of markers, with polygons of up to 10 000 vertices and corridors along a line.

    For the next page send the same body to the address in `Link`.
    """
    area = None
    if body.polygon is not None:
        single = body.polygon.type == "Polygon"
        area = area_of([body.polygon.coordinates] if single else body.polygon.coordinates)  # type: ignore[arg-type,list-item]
    place = (body.near.lon_deg, body.near.lat_deg) if body.near is not None else None
    if place is not None:
        check_lon_lat(*place, field="near")
    filtered = MarkerFilter(
        box=checked_box(*body.bbox) if body.bbox is not None else None,
        area=area,
        digits=body.code,
        **body.model_dump(include={"road", "from_m", "to_m", "status", "family"}),
    )
    search = _Search(filtered, place, body.radius_m, body.nearest, body.along)
    return search.answer(request, caller, searches, limit=limit, after=after)


def _near(text: str) -> tuple[tuple[float, float], float | None]:
    lon_deg, lat_deg, *rest = parse_numbers(text, "near", "lon,lat", "lon,lat,radius_m")
    check_lon_lat(lon_deg, lat_deg, field="near")
    radius_m = rest[0] if rest else None
    if radius_m is not None and not 0 <= radius_m <= MAX_RADIUS_M:
        raise InvalidParameter(
            f"a radius of {radius_m:g} m is too large or negative",
            field="near",
            limit=f"0 to {MAX_RADIUS_M:g} m",
            cure="search a box, or nearest",
        )
    return (lon_deg, lat_deg), radius_m
