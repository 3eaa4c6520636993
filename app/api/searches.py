"""Finding markers: GET /v1/markers, and POST /v1/markers/search for what does not fit into an address."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from datetime import datetime
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request, Response

from app.api.dependencies import Caller, Identifier, Text, json_response, next_link
from app.api.marker_filter import Narrowed, check_measures, checked_box, parse_numbers
from app.api.problems import problem_responses
from app.api.schemas_searches import MAX_PAGE, MAX_RADIUS_M, AlongIn, MarkerPage, SearchIn
from app.api.strict_json import StrictRoute
from app.api.times import parse_time
from app.errors import InvalidParameter
from app.geodesy import check_lon_lat
from app.registry.markers import MarkerFilter
from app.services.search_areas import area_of
from app.services.searches import Searches as SearchesService
from app.services.searches import circle

router = APIRouter(prefix="/v1/markers", tags=["markers"], route_class=StrictRoute)

_CURSOR = re.compile(r"([0-9]{1,7}(?:\.[0-9]{1,20})?(?:e-[0-9]{1,3})?),([0-9a-f-]{36})")


async def get_searches(request: Request) -> SearchesService:
    """Use cases that find markers."""
    service: SearchesService = request.app.state.searches
    return service


Searches = Annotated[SearchesService, Depends(get_searches)]


@dataclass(frozen=True, slots=True)
class _Search:
    """A search as both routes ask it."""

    narrowed: MarkerFilter
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
        check_measures(self.narrowed)

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
                caller, self.narrowed, line, self.along.corridor_m, after=_cursor(after), limit=limit
            )
        else:
            narrowed = self.narrowed
            if self.place is not None and self.radius_m is not None:
                narrowed = circle(narrowed, self.place, self.radius_m)
            if self.as_of is not None:
                page, last = searches.page_as_of(caller, narrowed, self.as_of, after=_id(after), limit=limit)
            else:
                page, last = searches.page(caller, narrowed, after=_id(after), limit=limit)
        return json_response({"items": page}, headers=next_link(request, after=last) if last else None)

    def _nearest(self, caller: Caller, searches: SearchesService, after: str | None) -> list[dict[str, Any]]:
        assert self.place is not None
        assert self.nearest is not None
        if after is not None:
            raise InvalidParameter(
                "the nearest markers come at once", field="after", limit="no pages", cure="leave after out"
            )
        return searches.nearest(caller, self.narrowed, self.place, self.nearest, self.radius_m)


@router.get("", response_class=Response, responses={200: {"model": MarkerPage}, **problem_responses()})
def list_markers(
    request: Request,
    caller: Caller,
    searches: Searches,
    narrowed: Narrowed,
    near: Annotated[Text | None, Query(max_length=200, examples=["114.179,22.304,500"])] = None,
    radius_m: Annotated[float | None, Query(ge=0, le=MAX_RADIUS_M, allow_inf_nan=False)] = None,
    nearest: Annotated[int | None, Query(ge=1, le=MAX_PAGE)] = None,
    as_of: Annotated[
        Text | None, Query(max_length=40, description="The registry as it was at this time (RFC 3339).")
    ] = None,
    limit: Annotated[int, Query(ge=1, le=MAX_PAGE)] = 100,
    after: Annotated[Identifier | None, Query(description="Last id of the page before.")] = None,
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
    search = _Search(narrowed, place, said_m if radius_m is None else radius_m, nearest, as_of=at)
    return search.answer(request, caller, searches, limit=limit, after=after)


@router.post("/search", response_class=Response, responses={200: {"model": MarkerPage}, **problem_responses()})
def search_markers(
    body: SearchIn,
    request: Request,
    caller: Caller,
    searches: Searches,
    limit: Annotated[int, Query(ge=1, le=MAX_PAGE)] = 100,
    after: Annotated[Text | None, Query(max_length=100, description="As the link to the next page has it.")] = None,
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
    narrowed = MarkerFilter(
        box=checked_box(*body.bbox) if body.bbox is not None else None,
        area=area,
        digits=body.code,
        **body.model_dump(include={"road", "from_m", "to_m", "status", "family"}),
    )
    search = _Search(narrowed, place, body.radius_m, body.nearest, body.along)
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


def _id(after: str | None) -> str | None:
    if after is not None and not re.fullmatch(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}", after):
        raise _bad_cursor()
    return after


def _cursor(after: str | None) -> tuple[float, str] | None:
    if after is None:
        return None
    found = _CURSOR.fullmatch(after)
    if found is None or not math.isfinite(float(found[1])):
        raise _bad_cursor()
    return float(found[1]), found[2]


def _bad_cursor() -> InvalidParameter:
    return InvalidParameter(
        "this is not where a page of this search ended",
        field="after",
        limit="as the link to the next page has it",
        cure="start without after, and follow the links",
    )
