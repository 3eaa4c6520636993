"""Uploads as they come over HTTP: a form with two parts, or the bare file with its context in a header."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

from fastapi import Depends, Header, Request
from pydantic import TypeAdapter
from starlette.datastructures import UploadFile

from app.api.decodes.schemas import ContextIn
from app.api.http.forms import FORM, check_parts, idempotency_of, media_type_of, read_declaration, read_text
from app.api.http.responses import IdempotencyKeyHeader
from app.api.http.strict_json import validated
from app.errors import MalformedRequest, UnreadableUpload, UnsupportedUpload
from app.services.decodes.context import ContextInput
from app.services.idempotency import IdempotencyKey

MAX_CONTEXT_BYTES = 64 * 1024
RAW_TYPES = (
    "image/jpeg", "image/png", "application/zip", "application/octet-stream", "text/csv",
    "application/vnd.apache.parquet", "application/json", "application/x-ndjson", "text/plain",
)  # fmt: skip
_JSON = "application/json"  # uplinks, as network servers post them, with the context in a header
_CURE = "send multipart/form-data with the parts file and context"


@dataclass(frozen=True, slots=True)
class UploadedFile:
    """A file with its context, and the client's Idempotency-Key if it sent one."""

    data: bytes
    context: ContextInput
    idempotency: IdempotencyKey | None


ContextHeader = Annotated[
    str | None,
    Header(alias="Waymark-Context", description="The context of a bare file, as JSON; a form has a part for it."),
]


async def get_upload(
    request: Request, idempotency_key: IdempotencyKeyHeader = None, context_header: ContextHeader = None
) -> UploadedFile:
    """Read the file and its context from the request.

    Raises
    ------
    UnsupportedUpload
        The request's content type is none that carries an upload.
    UnreadableUpload
        There is no file in it.
    MalformedRequest
        The form or the context's JSON cannot be read.
    """
    media_type = media_type_of(request)
    if media_type == FORM:
        data, text, name, vehicle = await _read_form(request)
    elif media_type in RAW_TYPES and (media_type != _JSON or context_header is not None):
        data, name, vehicle = await request.body(), "", ""
        # headers arrive as Latin-1; the bytes themselves are the JSON text
        text = (context_header or "").encode("latin-1")
    else:
        raise UnsupportedUpload(
            f"the content type {media_type[:80] or '(none)'} carries no upload",
            field="Content-Type",
            limit=", ".join((FORM, *RAW_TYPES)),
            cure=_CURE,
        )
    if len(text) > MAX_CONTEXT_BYTES:
        raise MalformedRequest("the context is too long", field="context", limit=f"{MAX_CONTEXT_BYTES} bytes")
    context = (await read_declaration(ContextIn, text, "context")).given(name)
    if vehicle:
        context = _of_vehicle(context, vehicle)
        text += b"\n" + vehicle.encode()
    return UploadedFile(data, context, idempotency_of(request, idempotency_key, text, data))


def _of_vehicle(context: ContextInput, vehicle: str) -> ContextInput:
    """The context with the vehicle that the form's part names."""
    named = validated(TypeAdapter(ContextIn), {"vehicle": vehicle}, "form").vehicle
    if context.vehicle not in (None, named):
        raise MalformedRequest(
            "the form and the context name different vehicles",
            field="vehicle",
            limit="one vehicle",
            cure="name it once",
        )
    return replace(context, vehicle=named)


async def _read_form(request: Request) -> tuple[bytes, bytes, str, str]:
    async with request.form(max_files=2, max_fields=3, max_part_size=MAX_CONTEXT_BYTES) as form:
        check_parts(form, None, "file", "context", "vehicle")
        file = form.get("file")
        if not isinstance(file, UploadFile):
            raise UnreadableUpload(
                "there is no file in the form" if file is None else "the part file has no filename, so it came as text",
                field="file",
                limit="one part named file, with a filename",
                cure=_CURE,
            )
        data = await file.read()
        text = await read_text(form, "context")
        vehicle = form.get("vehicle", "")
        if isinstance(vehicle, UploadFile):
            raise MalformedRequest(
                "the vehicle came as a file", field="vehicle", limit="a name", cure="send it as text"
            )
    return data, text, file.filename or "", vehicle


Upload = Annotated[UploadedFile, Depends(get_upload)]
