"""/v1/decodes: upload frames and traces, read what was found in them."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Depends, Path, Query, Request, Response

from app.api.dependencies import Caller, Identifier, json_response, next_link
from app.api.problems import problem_responses
from app.api.schemas_decodes import CONTEXT_EXAMPLE, ContextIn, DecodeOut, DecodePage, State
from app.api.uploads import RAW_TYPES, Upload
from app.services.decodes import Decodes as DecodesService

router = APIRouter(prefix="/v1/decodes", tags=["decodes"])

MAX_PAGE = 1000
DecodeId = Annotated[Identifier, Path(description="Id of the decode.")]
_MEDIA_TYPES = {"png": "image/png", "jpg": "image/jpeg"}


def _inlined(schema: dict[str, Any]) -> dict[str, Any]:
    """A JSON schema without references, which may stand anywhere in the OpenAPI document."""
    definitions = schema.pop("$defs", {})

    def resolve(node: Any) -> Any:
        if isinstance(node, dict):
            if "$ref" in node:
                return resolve(definitions[node["$ref"].rpartition("/")[2]])
            return {name: resolve(value) for name, value in node.items()}
        return [resolve(value) for value in node] if isinstance(node, list) else node

    resolved: dict[str, Any] = resolve(schema)
    return resolved


_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": ["file"],
                    "properties": {
                        "file": {
                            "type": "string",
                            "format": "binary",
                            "description": "JPEG, PNG, or a ZIP of them; a trace.",
                        },
                        "context": _inlined(ContextIn.model_json_schema()),
                    },
                },
                "encoding": {"context": {"contentType": "application/json"}},
                "example": {"file": "frame.jpg", "context": CONTEXT_EXAMPLE},
            },
            **{kind: {"schema": {"type": "string", "format": "binary"}} for kind in RAW_TYPES},
        },
    }
}


async def get_decodes(request: Request) -> DecodesService:
    """Use cases on decodes."""
    service: DecodesService = request.app.state.decodes
    return service


Decodes = Annotated[DecodesService, Depends(get_decodes)]


@router.post(
    "",
    status_code=201,
    response_class=Response,
    openapi_extra=_BODY,
    responses={
        201: {"model": DecodeOut, "description": "Decoded"},
        202: {"model": DecodeOut, "description": "Queued; Location leads to its progress"},
        **problem_responses(409, 415),
    },
)
def post_decode(caller: Caller, upload: Upload, decodes: Decodes) -> Response:
    """Decode a frame, a magnetometer trace or a packet log (answered at once), a ZIP of frames or a long log (queued).

    A trace is announced by `trace` in its context; its file is METRO's stream, the recorder's or plain CSV, Parquet, or
    a ZIP of the files of one recording, CAN logs with them.

    A packet log of CERPMs is announced by `packets`; it is CSV, JSON lines, raw payloads or uplinks of ChirpStack or
    The Things Stack, or a ZIP of these with the vehicle's poses and a camera frame.

    The context comes as the form's part `context`, or beside a bare file in the header `Waymark-Context`, as JSON. With
    an Idempotency-Key a repeated request gets the first answer again. No plate is a result: an empty list.
    """
    document, replayed = decodes.decode_upload(caller, upload.data, upload.context, upload.idempotency)
    headers = {"Location": f"/v1/decodes/{document['id']}"}
    if replayed:
        headers["Idempotency-Replayed"] = "true"
    if document["state"] == "done":
        return json_response(document, 201, headers)
    return json_response(document, 202, {**headers, "Retry-After": "1"})


@router.get("", response_class=Response, responses={200: {"model": DecodePage}, **problem_responses()})
def list_decodes(
    request: Request,
    caller: Caller,
    decodes: Decodes,
    state: State | None = None,
    limit: Annotated[int, Query(ge=1, le=MAX_PAGE)] = 100,
    before: Annotated[Identifier | None, Query(description="Last id of the page before.")] = None,
) -> Response:
    """Decodes without their results, newest first."""
    page, last = decodes.page(caller, state=state, before=before, limit=limit)
    return json_response({"items": page}, headers=next_link(request, before=last) if last else None)


@router.get("/{decode_id}", response_class=Response, responses={200: {"model": DecodeOut}, **problem_responses(404)})
def get_decode(decode_id: DecodeId, caller: Caller, decodes: Decodes) -> Response:
    """One decode with its result, or its progress."""
    document = decodes.get(caller, decode_id)
    waiting = document["state"] in ("queued", "running")
    return json_response(document, headers={"Retry-After": "1"} if waiting else None)


@router.post(
    "/{decode_id}/cancel", response_class=Response, responses={200: {"model": DecodeOut}, **problem_responses(404)}
)
def cancel_decode(decode_id: DecodeId, caller: Caller, decodes: Decodes) -> Response:
    """Ask a queued or running decode to stop; a finished one stays as it is."""
    return json_response(decodes.cancel(caller, decode_id))


@router.get(
    "/{decode_id}/plot.svg",
    response_class=Response,
    responses={200: {"content": {"image/svg+xml": {}}}, **problem_responses(404)},
)
def get_plot(decode_id: DecodeId, request: Request, caller: Caller, decodes: Decodes) -> Response:
    """What was found: magnets, tags and line crossings in a trace, or the lane and the radio of a packet log."""
    headers = {"ETag": f'"{decode_id}-plot"', "Cache-Control": "private, max-age=86400"}
    plot = decodes.plot(caller, decode_id)
    if request.headers.get("if-none-match") == headers["ETag"]:
        return Response(status_code=304, headers=headers)
    return Response(plot, headers=headers, media_type="image/svg+xml")


@router.get(
    "/{decode_id}/lane.geojson",
    response_class=Response,
    responses={200: {"content": {"application/geo+json": {}}}, **problem_responses(404)},
)
def get_lane(decode_id: DecodeId, caller: Caller, decodes: Decodes) -> Response:
    """Path, boundaries and markers that a packet log gave, as GeoJSON."""
    answer = json_response(decodes.lane(caller, decode_id))
    answer.headers["Content-Type"] = "application/geo+json"
    return answer


@router.get(
    "/{decode_id}/overlay.{suffix}",
    response_class=Response,
    responses={200: {"content": {kind: {} for kind in _MEDIA_TYPES.values()}}, **problem_responses(404)},
)
def get_overlay(
    decode_id: DecodeId, suffix: Literal["png", "jpg"], request: Request, caller: Caller, decodes: Decodes
) -> Response:
    """The camera frame of a packet log with the lane drawn over it, drawn when it is asked for."""
    headers = {"ETag": f'"{decode_id}-overlay-{suffix}"', "Cache-Control": "private, max-age=86400"}
    if request.headers.get("if-none-match") == headers["ETag"]:
        decodes.get(caller, decode_id)
        return Response(status_code=304, headers=headers)
    return Response(decodes.overlay(caller, decode_id, suffix), headers=headers, media_type=_MEDIA_TYPES[suffix])


@router.get(
    "/{decode_id}/annotated.{suffix}",
    response_class=Response,
    responses={200: {"content": {kind: {} for kind in _MEDIA_TYPES.values()}}, **problem_responses(404)},
)
def get_annotated(
    decode_id: DecodeId,
    suffix: Literal["png", "jpg"],
    request: Request,
    caller: Caller,
    decodes: Decodes,
    frame: Annotated[int, Query(ge=0, le=100_000, description="Number of the frame in an archive.")] = 0,
) -> Response:
    """The frame with outlines, digits and confidence of its readings, drawn when it is asked for."""
    headers = {"ETag": f'"{decode_id}-{frame}-{suffix}"', "Cache-Control": "private, max-age=86400"}
    if request.headers.get("if-none-match") == headers["ETag"]:
        decodes.get(caller, decode_id)
        return Response(status_code=304, headers=headers)
    picture = decodes.annotated(caller, decode_id, suffix, frame)
    return Response(picture, headers=headers, media_type=_MEDIA_TYPES[suffix])
