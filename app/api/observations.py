"""/v1/markers/{marker_id}/observations: what vehicles saw of a marker."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request, Response
from pydantic import AfterValidator, AwareDatetime, BaseModel

from app.api.dependencies import Caller, Text, json_response, next_link
from app.api.problems import problem_responses
from app.api.schemas_markers import MarkerId
from app.errors import InvalidParameter
from app.services.observations import Observations as ObservationsService
from app.services.observations import place_of

router = APIRouter(prefix="/v1/markers/{marker_id}/observations", tags=["markers"])


def _storable(time: datetime) -> datetime:
    if not 1900 <= time.year <= 2200:
        raise InvalidParameter(
            "the time is too far away", limit="years 1900 to 2200", cure="send an RFC 3339 time with its offset"
        )
    return time


Time = Annotated[AwareDatetime, AfterValidator(_storable)]


class ObservationOut(BaseModel):
    """What one decode saw of the marker, in one frame if it was a video."""

    decode_id: str
    frame: int
    at: str
    what: str
    detail: dict[str, Any] | None


class ObservationPage(BaseModel):
    """A page of observations, newest first."""

    items: list[ObservationOut]


class ObservationSummary(BaseModel):
    """How often a marker was seen, and how."""

    marker_id: str
    observations: int
    first_at: str | None
    last_at: str | None
    last_what: str | None
    last_seen_at: str | None
    counts: dict[str, int]


async def get_observations(request: Request) -> ObservationsService:
    """Use cases on observations."""
    service: ObservationsService = request.app.state.observations
    return service


Observations = Annotated[ObservationsService, Depends(get_observations)]


@router.get("", response_class=Response, responses={200: {"model": ObservationPage}, **problem_responses(404)})
def list_marker_observations(
    marker_id: MarkerId,
    request: Request,
    caller: Caller,
    observations: Observations,
    what: Annotated[Text | None, Query(min_length=1, max_length=32, examples=["seen"])] = None,
    since: Time | None = None,
    until: Time | None = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
    before: Annotated[Text | None, Query(max_length=120, description="As the link to the next page has it.")] = None,
) -> Response:
    """What decodes saw of the marker, newest first.

    `what` is `seen`, `ambiguous`, `out-of-place`, `wrong-way`, `off-line`, or what else a decode found of it.
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
    return json_response({"items": page}, headers=next_link(request, before=last) if last else None)


@router.get(
    "/summary", response_class=Response, responses={200: {"model": ObservationSummary}, **problem_responses(404)}
)
def get_observation_summary(marker_id: MarkerId, caller: Caller, observations: Observations) -> Response:
    """When the marker was seen first and last, and how often which way."""
    return json_response(observations.summary(caller, marker_id))
