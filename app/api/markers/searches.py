"""Finding markers: GET /v1/markers, and POST /v1/markers/search for what does not fit into an address."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from app.api.http.cursors import checked_id, cursor_of
from app.api.http.dependencies import AfterLink, Caller, LastId, PageSize, Text, use_cases
from app.api.http.responses import document_response, json_response, page_response
from app.api.http.strict_json import StrictRoute
from app.api.http.times import parse_time
from app.api.markers.filters import Filtered, check_measures
from app.api.markers.schemas_searches import MAX_PAGE, MAX_RADIUS_M, AlongIn, SearchIn
from app.errors import InvalidParameter
from app.geodesy import check_lon_lat
from app.registry.markers import MarkerFilter
from app.services.markers.documents import FoundMarker, MarkerPage
from app.services.markers.search_areas import area_of
from app.services.markers.search_boxes import checked_box, parse_numbers
from app.services.markers.searches import Searches as SearchesService
from app.services.markers.searches import circle

router = APIRouter(prefix="/v1/markers", tags=["markers"], route_class=StrictRoute)

Searches = Annotated[SearchesService, use_cases("searches")]


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


@router.get("", responses=document_response(MarkerPage))
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
    """Markers in the order they were registered; with `nearest`, that many in the order of their distance.

    `bbox` is west,south,east,north, and spans the antimeridian where its west is above its east. `near` is lon,lat with
    `radius_m` or `nearest`, or lon,lat,radius_m. `from_m` and `to_m` are measures on a `road`.
    With `as_of` the filter is about the markers as they were then; a page may hold fewer than `limit` though `Link`
    leads on.

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


@router.post("/search", responses=document_response(MarkerPage))
def search_markers(
    body: SearchIn, request: Request, caller: Caller, searches: Searches, limit: PageSize = 100, after: AfterLink = None
) -> Response:
    """Search by a body: as the list of markers, with polygons of up to 10 000 vertices and corridors along a line.

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
