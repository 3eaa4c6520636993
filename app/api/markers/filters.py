"""Which markers are meant: the query parameters that the list of markers and its exports share."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, Query

from app.api.http.dependencies import Text
from app.errors import InvalidParameter
from app.families import FamilyName
from app.markers.status import Status
from app.registry.markers import MarkerFilter
from app.services.markers.search_areas import area_of_text
from app.services.markers.search_boxes import parse_box

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
