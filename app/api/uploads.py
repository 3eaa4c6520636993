"""/v1/uploads: files that arrive in parts, by tus 1.0."""

from __future__ import annotations

import base64
import binascii
import hashlib
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from email.utils import format_datetime
from functools import partial
from typing import Annotated, Literal, NamedTuple, TypeVar

import anyio
from anyio import to_thread
from fastapi import Depends, Path, Request, Response
from pydantic import BaseModel, ConfigDict, Field

from app.api.decodes.uploads import context_of, with_vehicle
from app.api.http.bodies import append, finish, media_type_of, read_declaration, spool_of
from app.api.http.dependencies import Caller, use_case
from app.api.http.permissions import UPLOADERS
from app.api.http.problems import BodyRefused, Described, problem_responses, reference
from app.api.http.responses import BINARY, document_response, json_response
from app.api.http.routes import Router
from app.decoding.declarations import UploadContext
from app.errors import (
    MalformedRequest,
    UnsupportedUpload,
    UnsupportedVersion,
    UploadTooLarge,
    WaymarkError,
    WrongChecksum,
)
from app.formats.format import SpooledFile
from app.inputs import Identifier
from app.services.uploads.quotas import UploadDocument
from app.services.uploads.uploads import Grant, Uploads
from app.services.uploads.uploads import Uploads as UploadsService
from app.storage.blobs import PART_BYTES
from app.values import JsonObject

# === Request and response headers of tus 1.0 (https://tus.io/protocols/resumable-upload).


VERSION = "1.0.0"
BODY = "application/offset+octet-stream"
EXTENSIONS = "creation,creation-with-upload,termination,checksum,expiration"
ALGORITHMS: dict[str, str] = {"sha1": "sha1", "sha256": "sha256", "md5": "md5"}
"""Names of checksums in the protocol, and in hashlib. They find errors of transmission and nothing else."""
_DIGITS = 15


class Checksum(NamedTuple):
    """What a part's bytes are to be: the name of a hash, and its value."""

    algorithm: str
    digest: bytes

    def of(self, blocks: Iterable[bytes]) -> bool:
        """Whether bytes have it."""
        found = hashlib.new(ALGORITHMS[self.algorithm], usedforsecurity=False)
        for block in blocks:
            found.update(block)
        return found.digest() == self.digest


def check_version(request: Request) -> None:
    """Refuse other versions of the protocol.

    Raises
    ------
    UnsupportedVersion
    """
    version = request.headers.get("tus-resumable")
    if version != VERSION:
        raise UnsupportedVersion(
            f"the version of tus is {version[:20] if version else 'missing'}",
            field="Tus-Resumable",
            limit=VERSION,
            cure=f"send the header Tus-Resumable: {VERSION}",
        )


def read_number(request: Request, name: str) -> int:
    """A header that is a number of bytes.

    Raises
    ------
    MalformedRequest
        It is missing, or no such number.
    """
    text = request.headers.get(name, "")
    if not (text.isascii() and text.isdigit() and len(text) <= _DIGITS):
        raise MalformedRequest(f"{name} is missing or no number", field=name, limit="digits", cure="send it in bytes")
    return int(text)


def read_metadata(request: Request) -> dict[str, bytes]:
    """The header Upload-Metadata.

    Raises
    ------
    MalformedRequest
        It is no list of keys with values in Base64, or has a key twice.
    """
    found: dict[str, bytes] = {}
    for entry in request.headers.get("upload-metadata", "").split(","):
        name, _, value = entry.strip().partition(" ")
        if not name:
            continue
        try:
            decoded = base64.b64decode(value, validate=True)
        except binascii.Error as error:
            raise _bad_metadata(f"the value of {name[:40]} is no Base64") from error
        if name in found:
            raise _bad_metadata(f"{name[:40]} is there twice")
        found[name] = decoded
    return found


def read_checksum(request: Request) -> Checksum | None:
    """The header Upload-Checksum, if it was sent.

    Raises
    ------
    MalformedRequest
        Its algorithm is not known, or its value is no Base64.
    """
    text = request.headers.get("upload-checksum")
    if text is None:
        return None
    name, _, value = text.partition(" ")
    try:
        digest = base64.b64decode(value, validate=True)
    except binascii.Error:
        digest = b""
    if name not in ALGORITHMS or not digest:
        raise MalformedRequest(
            "Upload-Checksum cannot be read",
            field="Upload-Checksum",
            limit=", ".join(ALGORITHMS),
            cure="send the name of the algorithm, a space and the digest in Base64",
        )
    return Checksum(name, digest)


def described(document: UploadDocument) -> dict[str, str]:
    """Headers that describe an upload."""
    headers = {
        "Tus-Resumable": VERSION,
        "Upload-Offset": str(document["received"]),
        "Upload-Length": str(document["length"]),
        "Cache-Control": "no-store",
    }
    if document["state"] == "open":
        headers["Upload-Expires"] = format_datetime(document["expires_at"], usegmt=True)
    if "decode_id" in document:
        headers["Waymark-Decode"] = f"/v1/decodes/{document['decode_id']}"
    return headers


def options(max_bytes: int) -> Mapping[str, str]:
    """The versions and extensions of tus that the server supports."""
    return {
        "Tus-Resumable": VERSION,
        "Tus-Version": VERSION,
        "Tus-Extension": EXTENSIONS,
        "Tus-Max-Size": str(max_bytes),
        "Tus-Checksum-Algorithm": ",".join(ALGORITHMS),
    }


def _bad_metadata(message: str) -> MalformedRequest:
    return MalformedRequest(
        message, field="Upload-Metadata", limit="key Base64, key Base64", cure="encode each value in Base64"
    )


# === A part of an upload as it arrives: it is made durable piece by piece, so that an interrupted request keeps most.


PIECE_BYTES = 16 << 20
"""Bytes after which a piece is made durable. [byte] A killed server loses so much at most."""
PIECE_S = 10.0
"""Time after which it is, however few bytes came; also the sign of life that keeps the lock. [s] Source: a third of
`uploads.LOCK`."""
_THREADS = anyio.CapacityLimiter(8)
_BLOCK_BYTES = 1 << 20
T = TypeVar("T")


async def in_thread(call: Callable[[], T]) -> T:
    """Run a use case in a thread of uploads; those of other requests stay free."""
    return await to_thread.run_sync(call, limiter=_THREADS)


async def receive_part(
    request: Request, uploads: Uploads, grant: Grant, checksum: Checksum | None
) -> UploadDocument | None:
    """Append a request's body to an upload, and finish the upload if that completes it.

    What arrived of an interrupted body stays; with a checksum nothing does unless all of it is there and right.

    Returns
    -------
    UploadDocument or None
        The upload, if it is complete now.

    Raises
    ------
    BodyRefused
        The body is too long, or its checksum is wrong.
    """
    try:
        await _receive(request, uploads, grant, checksum)
    except BaseException:
        with anyio.CancelScope(shield=True):
            await in_thread(partial(uploads.end, grant))
        raise
    if grant.received < grant.row.length:
        await in_thread(partial(uploads.end, grant))
        return None
    return await in_thread(partial(uploads.finish, grant))


async def _receive(request: Request, uploads: Uploads, grant: Grant, checksum: Checksum | None) -> None:
    spool, began_s, left = spool_of(request), time.monotonic(), grant.row.length - grant.received
    writer = spool.create()
    try:
        async for chunk in request.stream():
            left -= len(chunk)
            if left < 0:
                raise UploadTooLarge("there are more bytes than the upload's length", limit=f"{grant.row.length} bytes")
            await append(writer, chunk)
            is_due = writer.size >= PIECE_BYTES or time.monotonic() - began_s >= PIECE_S
            if checksum is None and writer.size and is_due:
                file = await finish(writer)
                await in_thread(partial(uploads.save, grant, file))
                writer.discard()
                writer, began_s = spool.create(), time.monotonic()
        file = await finish(writer)
        if checksum is not None and not await in_thread(partial(checksum.of, _blocks(file))):
            raise WrongChecksum(
                "the part's bytes do not have its checksum", field="Upload-Checksum", cure="send the part again"
            )
        await in_thread(partial(uploads.save, grant, file))
    except WaymarkError as error:
        raise BodyRefused(error) from error
    except BaseException:
        if checksum is None and writer.size:  # the client left: what came of the last piece counts
            with anyio.CancelScope(shield=True):
                file = await finish(writer)
                await in_thread(partial(uploads.save, grant, file))
        raise
    finally:
        writer.discard()


def _blocks(file: SpooledFile) -> Iterator[bytes]:
    with file.open() as stream:
        while block := stream.read(_BLOCK_BYTES):
            yield block


# === /v1/uploads.


router = Router("/v1/uploads", "uploads")

Service = Annotated[UploadsService, use_case(lambda cases: cases.uploads)]
UploadId = Annotated[Identifier, Path(description="Id of the upload.")]
_NO_CONTENT: Described = {204: {"description": "Done"}}
_OPTIONS: Described = {200: {"description": "Tus-Version, Tus-Extension, Tus-Max-Size and Tus-Checksum-Algorithm"}}


def _body(required: bool, **others: object) -> JsonObject:
    return {"requestBody": {"required": required, "content": {BODY: {"schema": BINARY}, **others}}}


class PartsIn(BaseModel):
    """A file whose parts go to S3 directly."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"example": {"method": "s3-parts", "size": 1000000}})

    method: Literal["s3-parts"]
    size: int = Field(gt=0, lt=2**50, description="Of the whole file. [byte]")
    file_name: str = Field(default="", max_length=200)
    context: UploadContext | None = None


class CompleteIn(BaseModel):
    """The ETags that S3 gave for the parts, in their order."""

    model_config = ConfigDict(
        extra="forbid", json_schema_extra={"example": {"etags": ['"9b2cf535f27731c974343645a3985328"']}}
    )

    etags: list[Annotated[str, Field(min_length=1, max_length=200)]] = Field(min_length=1, max_length=10_000)


async def _started_parts(request: Request, caller: Caller, uploads: Service) -> Response:
    wanted = await read_declaration(PartsIn, await request.body(), "body")
    made, urls = await in_thread(
        partial(uploads.create_parts, caller, wanted.size, wanted.context or UploadContext(), wanted.file_name)
    )
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
        context = await context_of(metadata.get("context", b""))
        if vehicle := metadata.get("vehicle", b"").decode("utf-8", "replace"):
            context = with_vehicle(context, vehicle)
        if length == 0:
            raise MalformedRequest("the file is empty", field="Upload-Length", limit="1 byte or more")
        spool_of(request).check_room(length)
        document = await in_thread(partial(uploads.create, caller, length, context, name))
    except WaymarkError as error:
        raise BodyRefused(error) from error
    if not has_part:
        return document
    grant = await in_thread(partial(uploads.begin, caller, document["id"], 0, None))
    finished = await receive_part(request, uploads, grant, checksum)
    return finished or {**document, "received": grant.received}


@router.post(
    "",
    UPLOADERS,
    status_code=201,
    openapi_extra=_body(required=False, **{"application/json": {"schema": reference(PartsIn)}}),
    responses={
        201: {"model": UploadDocument, "description": "Started; Location is its address"},
        **problem_responses(409, 410, 412, 423),
    },
)
async def post_upload(response: Annotated[Response, Depends(_created)]) -> Response:
    """Start an upload in parts.

    By tus 1.0 (creation, creation-with-upload), or by JSON one whose parts go to S3 directly.

    Upload-Length is the size of the whole file. Upload-Metadata may have `filename`, `context` (the JSON of
    `Waymark-Context`) and `vehicle`. What is refused later, e.g. a file of no known kind, is refused by its last part.
    """
    return response


@router.post("/{upload_id}/complete", UPLOADERS, responses=document_response(UploadDocument, 404, 409, 410, 423))
def complete_upload(upload_id: UploadId, caller: Caller, uploads: Service, body: CompleteIn) -> Response:
    """Complete an upload whose parts were sent to S3.

    They become one file, and the file a decode; a repeated request gets the same answer.
    """
    return json_response(uploads.complete_parts(caller, upload_id, body.etags))


@router.get("/{upload_id}", UPLOADERS, responses=document_response(UploadDocument, 404, 410))
def get_upload(upload_id: UploadId, caller: Caller, uploads: Service) -> Response:
    """Get an upload.

    Its offset, and its decode or the reason of its refusal.
    """
    document = uploads.get(caller, upload_id)
    return json_response(document, headers=described(document))


@router.head(
    "/{upload_id}",
    UPLOADERS,
    responses={200: {"description": "Upload-Offset is the number of bytes stored"}, **problem_responses(404, 410, 412)},
)
def head_upload(request: Request, upload_id: UploadId, caller: Caller, uploads: Service) -> Response:
    """Get how far an upload is.

    By tus 1.0; `Waymark-Decode` names the decode that it became.
    """
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
    UPLOADERS,
    status_code=204,
    openapi_extra=_body(required=True),
    responses={
        204: {"description": "Upload-Offset is the number of bytes stored. With the last part, Location is the decode"},
        **problem_responses(404, 409, 410, 412, 423, 460),
    },
)
async def patch_upload(headers: Annotated[dict[str, str], Depends(_patched)]) -> Response:
    """Append a part to an upload.

    By tus 1.0. The last part makes the file a decode; what arrives of an interrupted one stays.
    """
    return Response(status_code=204, headers=headers)


@router.delete(
    "/{upload_id}", UPLOADERS, status_code=204, responses={**_NO_CONTENT, **problem_responses(404, 410, 412, 423)}
)
def delete_upload(upload_id: UploadId, caller: Caller, uploads: Service) -> Response:
    """Give an upload up.

    By tus 1.0, termination. The decode of a complete one stays.
    """
    uploads.delete(caller, upload_id)
    return Response(status_code=204, headers={"Tus-Resumable": "1.0.0"})


@router.options("", UPLOADERS, responses={**_OPTIONS, **problem_responses()})
async def list_options(uploads: Service) -> Response:
    """List the version, extensions and limits of tus."""
    return Response(headers=options(uploads.rules.max_bytes))


@router.options("/{upload_id}", UPLOADERS, responses={**_OPTIONS, **problem_responses()})
async def list_upload_options(upload_id: UploadId, uploads: Service) -> Response:
    """List the version, extensions and limits of tus for an upload.

    Whether there is such an upload or not.
    """
    return Response(headers=options(uploads.rules.max_bytes))
