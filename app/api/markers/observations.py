"""/v1/markers/{marker_id}/observations: what vehicles saw of a marker."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from app.api.http.dependencies import Caller, MarkerId, PageSize, Text, use_cases
from app.api.http.responses import document_response, json_response, page_response
from app.api.http.strict_json import StrictRoute
from app.api.http.times import Time
from app.services.markers.observations import ObservationPage, ObservationSummary, place_of
from app.services.markers.observations import Observations as ObservationsService

router = APIRouter(prefix="/v1/markers/{marker_id}/observations", tags=["markers"], route_class=StrictRoute)


Observations = Annotated[ObservationsService, use_cases("observations")]


@router.get("", responses=document_response(ObservationPage, 404))
def list_marker_observations(
    marker_id: MarkerId,
    request: Request,
    caller: Caller,
    observations: Observations,
    what: Annotated[Text | None, Query(min_length=1, max_length=32, examples=["seen"])] = None,
    since: Time | None = None,
    until: Time | None = None,
    limit: PageSize = 100,
    before: Annotated[Text | None, Query(max_length=120, description="As the link to the next page has it.")] = None,
) -> Response:
    """What decodes saw of the marker, newest first.

    `what` is `seen`, `missed`, `ambiguous`, `out-of-place`, `out-of-reach`, `moved`, `cloned`, `wrong-way` or
    `off-line`.
    """
    page, last = observations.page(
        caller,
        marker_id,
        what=what,
        since=since,
        until=until,
        before=place_of(before) if before is not None else None,
        limit=limit,
    )
    return page_response(request, page, before=last)


@router.get("/summary", responses=document_response(ObservationSummary, 404))
def get_observation_summary(marker_id: MarkerId, caller: Caller, observations: Observations) -> Response:
    """When the marker was seen first and last, and how often which way."""
    return json_response(observations.summary(caller, marker_id))
