"""/v1/uploads: files that arrive in parts, by tus 1.0."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Depends, Path, Request, Response
from pydantic import BaseModel, ConfigDict, Field

from app.api.decodes.schemas import ContextIn
from app.api.decodes.uploads import context_of, with_vehicle
from app.api.http.bodies import spool_of
from app.api.http.components import reference
from app.api.http.dependencies import Caller, Identifier, use_cases
from app.api.http.forms import media_type_of, read_declaration
from app.api.http.problems import BodyRefused, Described, problem_responses
from app.api.http.responses import BINARY, document_response, json_response
from app.api.http.strict_json import StrictRoute
from app.api.uploads.headers import BODY, check_version, described, options, read_checksum, read_metadata, read_number
from app.api.uploads.parts import in_thread, receive_part
from app.errors import MalformedRequest, UnsupportedUpload, WaymarkError
from app.services.uploads.documents import UploadDocument
from app.services.uploads.uploads import Uploads as UploadsService
from app.storage.s3_parts import PART_BYTES

router = APIRouter(prefix="/v1/uploads", tags=["uploads"], route_class=StrictRoute)

Service = Annotated[UploadsService, use_cases("uploads")]
UploadId = Annotated[Identifier, Path(description="Id of the upload.")]
_NO_CONTENT: Described = {204: {"description": "Done"}}
_OPTIONS: Described = {200: {"description": "Tus-Version, Tus-Extension, Tus-Max-Size and Tus-Checksum-Algorithm"}}


def _body(required: bool, **others: Any) -> dict[str, Any]:
    return {"requestBody": {"required": required, "content": {BODY: {"schema": BINARY}, **others}}}


class PartsIn(BaseModel):
    """A file whose parts go to S3 directly."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"example": {"method": "s3-parts", "size": 1000000}})

    method: Literal["s3-parts"]
    size: int = Field(gt=0, lt=2**50, description="Of the whole file. [byte]")
    file_name: str = Field(default="", max_length=200)
    context: ContextIn | None = None


class CompleteIn(BaseModel):
    """The ETags that S3 gave for the parts, in their order."""

    model_config = ConfigDict(
        extra="forbid", json_schema_extra={"example": {"etags": ['"9b2cf535f27731c974343645a3985328"']}}
    )

    etags: list[Annotated[str, Field(min_length=1, max_length=200)]] = Field(min_length=1, max_length=10_000)


async def _started_parts(request: Request, caller: Caller, uploads: Service) -> Response:
    wanted = await read_declaration(PartsIn, await request.body(), "body")
    context = (wanted.context or ContextIn()).given(wanted.file_name)
    made, urls = await in_thread(partial(uploads.create_parts, caller, wanted.size, context))
    document: UploadDocument = {**made, "part_bytes": PART_BYTES, "part_urls": urls}
    return json_response(document, 201, {"Location": f"/v1/uploads/{made['id']}"})


async def _created(request: Request, caller: Caller, uploads: Service) -> Response:
    """Read the headers of a new upload, store it, and take the part that may come with it."""
    if media_type_of(request) == "application/json":
        return await _started_parts(request, caller, uploads)
    document = await _started(request, caller, uploads)
    return json_response(document, 201, {**described(document), "Location": f"/v1/uploads/{document['id']}"})


async def _started(request: Request, caller: Caller, uploads: Service) -> UploadDocument:
    try:
        check_version(request)
        length = read_number(request, "Upload-Length")
        has_part = media_type_of(request) == BODY
        checksum = read_checksum(request) if has_part else None
        metadata = read_metadata(request)
        name = metadata.get("filename", b"").decode("utf-8", "replace")[:200]
        context = await context_of(metadata.get("context", b""), name)
        if vehicle := metadata.get("vehicle", b"").decode("utf-8", "replace"):
            context = with_vehicle(context, vehicle)
        if length == 0:
            raise MalformedRequest("the file is empty", field="Upload-Length", limit="1 byte or more")
        spool_of(request).check_room(length)
        document = await in_thread(partial(uploads.create, caller, length, context))
    except WaymarkError as error:
        raise BodyRefused(error) from error
    if not has_part:
        return document
    grant = await in_thread(partial(uploads.begin, caller, document["id"], 0, None))
    finished = await receive_part(request, uploads, grant, checksum)
    return finished or {**document, "received": grant.received}


@router.post(
    "",
    status_code=201,
    openapi_extra=_body(required=False, **{"application/json": {"schema": reference(PartsIn)}}),
    responses={
        201: {"model": UploadDocument, "description": "Started; Location is its address"},
        **problem_responses(409, 410, 412, 423),
    },
)
async def post_upload(response: Annotated[Response, Depends(_created)]) -> Response:
    """Start an upload by tus 1.0 (creation, creation-with-upload), or by JSON one whose parts go to S3 directly.

    Upload-Length is the size of the whole file. Upload-Metadata may have `filename`, `context` (the JSON of
    `Waymark-Context`) and `vehicle`. What is refused later, e.g. a file of no known kind, is refused by its last part.
    """
    return response


@router.post("/{upload_id}/complete", responses=document_response(UploadDocument, 404, 409, 410, 423))
def complete_upload(upload_id: UploadId, caller: Caller, uploads: Service, body: CompleteIn) -> Response:
    """Make the parts that were sent to S3 one file, and the file a decode; a repeated request gets the same answer."""
    return json_response(uploads.complete_parts(caller, upload_id, body.etags))


@router.get("/{upload_id}", responses=document_response(UploadDocument, 404, 410))
def get_upload(upload_id: UploadId, caller: Caller, uploads: Service) -> Response:
    """One upload: its offset, and its decode or the reason of its refusal."""
    document = uploads.get(caller, upload_id)
    return json_response(document, headers=described(document))


@router.head(
    "/{upload_id}",
    responses={200: {"description": "Upload-Offset is the number of bytes stored"}, **problem_responses(404, 410, 412)},
)
def head_upload(request: Request, upload_id: UploadId, caller: Caller, uploads: Service) -> Response:
    """How far an upload is (tus 1.0), and in `Waymark-Decode` the decode that it became."""
    check_version(request)
    return Response(headers=described(uploads.get(caller, upload_id)))


async def _patched(request: Request, upload_id: UploadId, caller: Caller, uploads: Service) -> dict[str, str]:
    """Append the body to an upload; returns the headers of the response."""
    try:
        check_version(request)
        if media_type_of(request) != BODY:
            raise UnsupportedUpload("a part has another media type", field="Content-Type", limit=BODY)
        offset, checksum = read_number(request, "Upload-Offset"), read_checksum(request)
        length = request.headers.get("content-length")
        spool_of(request).check_room(int(length or 0))
        grant = await in_thread(
            partial(uploads.begin, caller, upload_id, offset, int(length) if length is not None else None)
        )
    except WaymarkError as error:
        raise BodyRefused(error) from error
    finished = await receive_part(request, uploads, grant, checksum)
    if finished is None:
        return described(await in_thread(partial(uploads.get, caller, upload_id)))
    headers = described(finished)
    return {**headers, "Location": headers["Waymark-Decode"]}


@router.patch(
    "/{upload_id}",
    status_code=204,
    openapi_extra=_body(required=True),
    responses={
        204: {"description": "Upload-Offset is the number of bytes stored. With the last part, Location is the decode"},
        **problem_responses(404, 409, 410, 412, 423, 460),
    },
)
async def patch_upload(headers: Annotated[dict[str, str], Depends(_patched)]) -> Response:
    """Append a part (tus 1.0). The last one makes the file a decode; what arrives of an interrupted one stays."""
    return Response(status_code=204, headers=headers)


@router.delete("/{upload_id}", status_code=204, responses={**_NO_CONTENT, **problem_responses(404, 410, 412, 423)})
def delete_upload(upload_id: UploadId, caller: Caller, uploads: Service) -> Response:
    """Give an upload up (tus 1.0, termination). The decode of a complete one stays."""
    uploads.delete(caller, upload_id)
    return Response(status_code=204, headers={"Tus-Resumable": "1.0.0"})


@router.options("", responses={**_OPTIONS, **problem_responses()})
async def list_options(uploads: Service) -> Response:
    """Version, extensions and limits of tus."""
    return Response(headers=options(uploads.rules.max_bytes))


@router.options("/{upload_id}", responses={**_OPTIONS, **problem_responses()})
async def list_upload_options(upload_id: UploadId, uploads: Service) -> Response:
    """As OPTIONS /v1/uploads, whether there is such an upload or not."""
    return Response(headers=options(uploads.rules.max_bytes))
