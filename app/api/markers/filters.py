"""Which markers are meant: the query parameters that the list of markers and its exports share."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, Query

from app.api.http.dependencies import Text
from app.errors import InvalidParameter
from app.families import FamilyName
from app.geodesy import check_lon_lat
from app.markers.status import Status
from app.registry.markers import MarkerFilter
from app.registry.spatial import Box
from app.services.markers.search_areas import area_of_text

_MAX_POLYGON_TEXT = 8_000
MAX_OVER_ANTIMERIDIAN_DEG = 180.0
"""Width of a box over the antimeridian. Source: RFC 7946 section 5.2 allows any; a wider one has its sides swapped."""
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


def parse_box(text: str) -> Box:
    """West, south, east, north as a query writes them."""
    return checked_box(*parse_numbers(text, "bbox", "west,south,east,north"))


def checked_box(west_deg: float, south_deg: float, east_deg: float, north_deg: float) -> Box:
    """A box; a west above the east spans the antimeridian.

    Raises
    ------
    InvalidParameter
        A side is out of range, the south is above the north, or the box over the antimeridian is wider than half the
        earth: its west and east are swapped.
    """
    check_lon_lat(west_deg, south_deg, field="bbox")
    check_lon_lat(east_deg, north_deg, field="bbox")
    if south_deg > north_deg:
        raise InvalidParameter(
            "bbox has its south above its north",
            field="bbox",
            limit="south <= north",
            cure="send west,south,east,north; only the longitudes may be the other way round, over the antimeridian",
        )
    if west_deg > east_deg and (width_deg := 360.0 + east_deg - west_deg) > MAX_OVER_ANTIMERIDIAN_DEG:
        raise InvalidParameter(
            f"bbox has its west above its east, so it spans {width_deg:.6g} degrees over the antimeridian",
            field="bbox",
            limit=f"{MAX_OVER_ANTIMERIDIAN_DEG:g} degrees over the antimeridian",
            cure="send west,south,east,north",
        )
    return Box(west_deg, south_deg, east_deg, north_deg)


def parse_numbers(text: str, field: str, *forms: str) -> list[float]:
    """Numbers between commas, as many as one of the forms has names; else InvalidParameter."""
    parts = text.split(",")
    if len(parts) not in [len(form.split(",")) for form in forms]:
        form = " or ".join(forms)
        raise InvalidParameter(f"{field} is {form}", field=field, limit=form, cure="separate the numbers by commas")
    try:
        return [float(part) for part in parts]
    except ValueError as error:
        raise InvalidParameter(f"{field} holds something that is not a number", field=field, limit=forms[0]) from error
