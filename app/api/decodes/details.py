"""/v1/decodes/{decode_id}: samples, packets, the vehicle's track and lists of readings of one decode."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Query, Response

from app.api.decodes.decodes import DecodeId
from app.api.http.dependencies import Caller, use_cases
from app.api.http.problems import problem_responses
from app.api.http.responses import document_response, file_response, json_response
from app.api.http.strict_json import StrictRoute
from app.services.decodes.details import DecodeDetails
from app.services.decodes.sample_task import MAX_POINTS, MAX_SERIES, PacketsDocument, SamplesDocument

router = APIRouter(prefix="/v1/decodes", tags=["decodes"], route_class=StrictRoute)

Details = Annotated[DecodeDetails, use_cases("decode_details")]
_MEDIA_TYPES = {"geojson": "application/geo+json", "csv": "text/csv", "gpx": "application/gpx+xml"}


@router.get("/{decode_id}/samples", responses=document_response(SamplesDocument, 404, 422))
def get_samples(
    decode_id: DecodeId,
    caller: Caller,
    details: Details,
    series: Annotated[
        list[Annotated[str, Query(max_length=20)]] | None,
        Query(
            max_length=MAX_SERIES, description="`vertical`, `forward` (the largest change on any sensor), `s3_x` ..."
        ),
    ] = None,
    from_s: Annotated[float | None, Query(allow_inf_nan=False, description="Of the recording. [s]")] = None,
    to_s: Annotated[float | None, Query(allow_inf_nan=False, description="Of the recording. [s]")] = None,
    points: Annotated[int, Query(ge=100, le=MAX_POINTS, description="Of each series at most.")] = 100_000,
) -> Response:
    """Samples of a trace, to plot them: all between two times, or the extremes of groups of them."""
    document = details.samples(caller, decode_id, series=series or (), from_s=from_s, to_s=to_s, points=points)
    return json_response(document)


@router.get("/{decode_id}/packets", responses=document_response(PacketsDocument, 404))
def get_packets(decode_id: DecodeId, caller: Caller, details: Details) -> Response:
    """Packets of a log with time, strength and verdict, and the vehicle's track beside them."""
    return json_response(details.packets(caller, decode_id))


@router.get("/{decode_id}/track.{form}", responses={**file_response(_MEDIA_TYPES.values()), **problem_responses(404)})
def get_decode_track(
    decode_id: DecodeId, form: Literal["geojson", "csv", "gpx"], caller: Caller, details: Details
) -> Response:
    """The vehicle's track by this decode alone: fixes, poses, its receiver, or dead reckoning between tags.

    A drive (`/v1/drives`) estimates the best track from several decodes.
    """
    return _file(details.track(caller, decode_id, form), f"track-{decode_id}.{form}", form)


@router.get(
    "/{decode_id}/readings.{form}",
    responses={**file_response([_MEDIA_TYPES[form] for form in ("geojson", "csv")]), **problem_responses(404)},
)
def get_readings(decode_id: DecodeId, form: Literal["geojson", "csv"], caller: Caller, details: Details) -> Response:
    """All readings in the order of their times, with confidence, reason and marker."""
    return _file(details.readings(caller, decode_id, form), f"readings-{decode_id}.{form}", form)


def _file(content: object, name: str, form: str) -> Response:
    response = Response(content.encode()) if isinstance(content, str) else json_response(content)
    response.headers["Content-Type"] = _MEDIA_TYPES[form]
    response.headers["Content-Disposition"] = f'attachment; filename="{name}"'
    response.headers["Cache-Control"] = "private, no-cache"
    return response
