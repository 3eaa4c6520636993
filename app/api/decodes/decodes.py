"""/v1/decodes: upload frames and traces, read what was found in them."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import Path, Query, Request, Response

from app.api.decodes.uploads import RAW_TYPES, Upload
from app.api.http.bodies import form_body
from app.api.http.dependencies import Caller, LastId, PageSize, use_case
from app.api.http.permissions import EVERYBODY, UPLOADERS
from app.api.http.problems import problem_responses
from app.api.http.responses import (
    BINARY,
    NOT_MODIFIED,
    IfNoneMatch,
    created_response,
    document_response,
    file_response,
    json_response,
    page_response,
)
from app.api.http.routes import Router
from app.decoding.declarations import CONTEXT_EXAMPLE, UploadContext
from app.inputs import Identifier, Text, Time
from app.registry.decodes import DecodeFilter
from app.registry.jobs import JobState
from app.services.decodes.context import DecodeKind
from app.services.decodes.decodes import DecodeDetails, PacketsDocument
from app.services.decodes.decodes import Decodes as DecodesService
from app.services.decodes.documents import DecodeDocument, DecodePage
from app.services.decodes.outputs import DecodeOutputs
from app.services.decodes.trace_tasks import MAX_POINTS, MAX_SERIES, SamplesDocument

router = Router("/v1/decodes", "decodes")

DecodeId = Annotated[Identifier, Path(description="Id of the decode.")]
_MEDIA_TYPES = {"png": "image/png", "jpg": "image/jpeg"}

_JSON_BODY = {"type": "object", "description": "An uplink as a network server posts it."}
_BODY = form_body(
    {
        "file": {**BINARY, "description": "JPEG, PNG, or a ZIP of them; a trace."},
        "vehicle": {"type": "string", "description": "Name or id of the vehicle."},
    },
    "context",
    UploadContext,
    {"file": "frame.jpg", "context": CONTEXT_EXAMPLE},
    **{kind: {"schema": _JSON_BODY if kind == "application/json" else BINARY} for kind in RAW_TYPES},
)
Decodes = Annotated[DecodesService, use_case(lambda cases: cases.decodes)]
Outputs = Annotated[DecodeOutputs, use_case(lambda cases: cases.decode_outputs)]


@router.post(
    "",
    UPLOADERS,
    status_code=201,
    openapi_extra=_BODY,
    responses={
        201: {"model": DecodeDocument, "description": "Decoded"},
        202: {"model": DecodeDocument, "description": "Queued; Location leads to its progress"},
        **problem_responses(404, 409, 415),
    },
)
def post_decode(caller: Caller, upload: Upload, decodes: Decodes) -> Response:
    """Decode an upload of a vehicle.

    A frame, a magnetometer trace or a packet log (answered at once), a ZIP of frames or a long log (queued).

    A trace is announced by `trace` in its context; its file is METRO's stream, the recorder's or plain CSV, Parquet, or
    a ZIP of the files of one recording, CAN logs with them.

    A packet log of CERPMs is announced by `packets`; it is CSV, JSON lines, raw payloads or uplinks of ChirpStack or
    The Things Stack, or a ZIP of these with the vehicle's poses and a camera frame.

    The context comes as the form's part `context`, or beside a bare file in the header `Waymark-Context`, as JSON. With
    an Idempotency-Key a repeated request gets the first answer again. No plate is a result: an empty list.
    """
    document, replayed = decodes.decode_upload(
        caller, upload.file, upload.context, upload.idempotency, name=upload.name
    )
    if document["state"] == "done":
        return created_response(document, replayed, path="/v1/decodes")
    response = created_response(document, replayed, path="/v1/decodes", status=202)
    response.headers["Retry-After"] = "1"
    return response


@router.get("", EVERYBODY, responses=document_response(DecodePage))
def list_decodes(
    request: Request,
    caller: Caller,
    decodes: Decodes,
    state: JobState | None = None,
    kind: DecodeKind | None = None,
    vehicle: Annotated[Text | None, Query(max_length=80, description="Name or id of the vehicle.")] = None,
    since: Annotated[Time | None, Query(description="Uploaded then or later.")] = None,
    until: Annotated[Time | None, Query(description="Uploaded before then.")] = None,
    limit: PageSize = 100,
    after: LastId = None,
) -> Response:
    """List the decodes of an agency.

    Without their results, newest first.
    """
    wanted = DecodeFilter(state=state, kind=kind, vehicle=vehicle, since=since, until=until)
    page, last = decodes.page(caller, wanted, before=after, limit=limit)
    return page_response(request, {"items": page}, after=last)


@router.get("/{decode_id}", EVERYBODY, responses=document_response(DecodeDocument, 404))
def get_decode(decode_id: DecodeId, caller: Caller, decodes: Decodes) -> Response:
    """Get a decode.

    With its result, or its progress.
    """
    document = decodes.get(caller, decode_id)
    waiting = document["state"] in ("queued", "running")
    return json_response(document, headers={"Retry-After": "1"} if waiting else None)


@router.get(
    "/{decode_id}/plot.svg",
    EVERYBODY,
    responses={**file_response(["image/svg+xml"]), **NOT_MODIFIED, **problem_responses(404)},
)
def get_plot(decode_id: DecodeId, caller: Caller, outputs: Outputs, if_none_match: IfNoneMatch = None) -> Response:
    """Get the plot of a decode.

    Magnets, tags and line crossings in a trace, or the lane and the radio of a packet log.
    """
    headers = {"ETag": f'"{decode_id}-plot"', "Cache-Control": "private, no-cache"}
    plot = outputs.plot(caller, decode_id)
    if if_none_match == headers["ETag"]:
        return Response(status_code=304, headers=headers)
    return Response(plot, headers=headers, media_type="image/svg+xml")


@router.get(
    "/{decode_id}/lane.geojson",
    EVERYBODY,
    responses={**file_response(["application/geo+json"]), **problem_responses(404)},
)
def get_lane(decode_id: DecodeId, caller: Caller, outputs: Outputs) -> Response:
    """Get the lane that a packet log gave.

    Path, boundaries and markers, as GeoJSON.
    """
    answer = json_response(outputs.lane(caller, decode_id))
    answer.headers["Content-Type"] = "application/geo+json"
    return answer


@router.get(
    "/{decode_id}/overlay.{form}",
    EVERYBODY,
    responses={**file_response(_MEDIA_TYPES.values()), **NOT_MODIFIED, **problem_responses(404)},
)
def get_overlay(
    decode_id: DecodeId,
    form: Literal["png", "jpg"],
    caller: Caller,
    decodes: Decodes,
    outputs: Outputs,
    if_none_match: IfNoneMatch = None,
) -> Response:
    """Get the camera frame of a packet log with the lane.

    It is drawn when it is asked for.
    """
    headers = {"ETag": f'"{decode_id}-overlay-{form}"', "Cache-Control": "private, no-cache"}
    if if_none_match == headers["ETag"]:
        decodes.get(caller, decode_id)
        return Response(status_code=304, headers=headers)
    return Response(outputs.overlay(caller, decode_id, form), headers=headers, media_type=_MEDIA_TYPES[form])


@router.get(
    "/{decode_id}/annotated.{form}",
    EVERYBODY,
    responses={**file_response(_MEDIA_TYPES.values()), **NOT_MODIFIED, **problem_responses(404)},
)
def get_annotated(
    decode_id: DecodeId,
    form: Literal["png", "jpg"],
    caller: Caller,
    decodes: Decodes,
    outputs: Outputs,
    frame: Annotated[int, Query(ge=0, le=500_000, description="Number of the frame in an archive or a video.")] = 0,
    outlines: Annotated[bool, Query(description="false: the frame as it is.")] = True,
    if_none_match: IfNoneMatch = None,
) -> Response:
    """Get a frame with its readings drawn on it.

    Outlines, digits and confidence, drawn when it is asked for.

    Of a video, only frames in which something was found.
    """
    shown = form if outlines else f"{form}-plain"
    headers = {"ETag": f'"{decode_id}-{frame}-{shown}"', "Cache-Control": "private, no-cache"}
    if if_none_match == headers["ETag"]:
        decodes.get(caller, decode_id)
        return Response(status_code=304, headers=headers)
    picture = outputs.annotated(caller, decode_id, form, frame, outlined=outlines)
    return Response(picture, headers=headers, media_type=_MEDIA_TYPES[form])


# === /v1/decodes/{decode_id}: samples, packets, the vehicle's track and lists of readings of one decode.


detail_router = Router("/v1/decodes", "decodes")

Details = Annotated[DecodeDetails, use_case(lambda cases: cases.decode_details)]
_FILE_MEDIA_TYPES = {"geojson": "application/geo+json", "csv": "text/csv", "gpx": "application/gpx+xml"}


@detail_router.get(
    "/{decode_id}/samples", EVERYBODY, expensive=True, responses=document_response(SamplesDocument, 404, 422)
)
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
    """Get the samples of a trace to plot them.

    All between two times, or the extremes of groups of them.
    """
    document = details.samples(caller, decode_id, series=series or (), from_s=from_s, to_s=to_s, points=points)
    return json_response(document)


@detail_router.get("/{decode_id}/packets", EVERYBODY, expensive=True, responses=document_response(PacketsDocument, 404))
def get_packets(decode_id: DecodeId, caller: Caller, details: Details) -> Response:
    """Get the packets of a log.

    With time, strength and verdict, and the vehicle's track beside them.
    """
    return json_response(details.packets(caller, decode_id))


@detail_router.get(
    "/{decode_id}/track.{form}",
    EVERYBODY,
    responses={**file_response(_FILE_MEDIA_TYPES.values()), **problem_responses(404)},
)
def get_decode_track(
    decode_id: DecodeId, form: Literal["geojson", "csv", "gpx"], caller: Caller, details: Details
) -> Response:
    """Download the vehicle's track by one decode.

    Fixes, poses, its receiver, or dead reckoning between tags.

    A drive (`/v1/drives`) estimates the best track from several decodes.
    """
    return _file(details.track(caller, decode_id, form), f"track-{decode_id}.{form}", form)


@detail_router.get(
    "/{decode_id}/readings.{form}",
    EVERYBODY,
    responses={**file_response([_FILE_MEDIA_TYPES[form] for form in ("geojson", "csv")]), **problem_responses(404)},
)
def get_readings(decode_id: DecodeId, form: Literal["geojson", "csv"], caller: Caller, details: Details) -> Response:
    """Download the readings of a decode.

    In the order of their times, with confidence, reason and marker.
    """
    return _file(details.readings(caller, decode_id, form), f"readings-{decode_id}.{form}", form)


def _file(content: object, name: str, form: str) -> Response:
    response = Response(content.encode()) if isinstance(content, str) else json_response(content)
    response.headers["Content-Type"] = _FILE_MEDIA_TYPES[form]
    response.headers["Content-Disposition"] = f'attachment; filename="{name}"'
    response.headers["Cache-Control"] = "private, no-cache"
    return response
