"""Uploads as they come over HTTP: a form with two parts, or the bare file with its context in a header."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Annotated

from anyio import to_thread
from fastapi import Depends, Header, Request
from pydantic import TypeAdapter
from starlette.datastructures import UploadFile

from app.api.http.bodies import (
    FORM,
    SpooledPart,
    check_parts,
    idempotency_of,
    media_type_of,
    read_declaration,
    read_text,
    received_body,
    received_form,
)
from app.api.http.dependencies import caller_of
from app.api.http.problems import BodyRefused
from app.api.http.responses import IdempotencyKeyHeader
from app.api.http.strict_json import validated
from app.decoding.declarations import UploadContext
from app.errors import MalformedRequest, QuotaExceeded, UnreadableUpload, UnsupportedUpload
from app.formats.format import SpooledFile
from app.services.idempotency import IdempotencyKey
from app.services.uploads.quotas import Quotas

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

    file: SpooledFile
    name: str  # of the file; empty where it has none
    context: UploadContext
    idempotency: IdempotencyKey | None


ContextHeader = Annotated[
    str | None,
    Header(alias="Waymark-Context", description="The context of a bare file, as JSON; a form has a part for it."),
]


async def get_upload(
    request: Request, idempotency_key: IdempotencyKeyHeader = None, context_header: ContextHeader = None
) -> AsyncIterator[UploadedFile]:
    """Read the file and its context from the request; the file is deleted when the request ends.

    Raises
    ------
    UnsupportedUpload
        The request's content type is none that carries an upload.
    UnreadableUpload
        There is no file in it.
    MalformedRequest
        The form or the context's JSON cannot be read.
    """
    await check_quota(request)
    async with _received(request, context_header) as (file, text, name, vehicle):
        context = await context_of(text)
        if vehicle:
            context = with_vehicle(context, vehicle)
            text += b"\n" + vehicle.encode()
        yield UploadedFile(file, name, context, idempotency_of(request, idempotency_key, text, file))


async def check_quota(request: Request) -> None:
    """Refuse a body beyond the quota of its key before it is read, by its Content-Length."""
    quotas: Quotas = request.app.state.use_cases.quotas
    caller, size = caller_of(request), int(request.headers.get("content-length", "0"))
    try:
        if quotas.is_known(caller):
            quotas.check(caller, size)
        else:
            await to_thread.run_sync(quotas.check, caller, size)
    except QuotaExceeded as error:
        raise BodyRefused(error) from error


async def context_of(text: bytes) -> UploadContext:
    """The context of an upload from its JSON.

    Raises
    ------
    MalformedRequest
        It is too long, or cannot be read.
    """
    if len(text) > MAX_CONTEXT_BYTES:
        raise MalformedRequest("the context is too long", field="context", limit=f"{MAX_CONTEXT_BYTES} bytes")
    return await read_declaration(UploadContext, text, "context")


@asynccontextmanager
async def _received(request: Request, context_header: str | None) -> AsyncIterator[tuple[SpooledFile, bytes, str, str]]:
    """The file, the text of its context, its name, and the vehicle of the form."""
    media_type = media_type_of(request)
    if media_type == FORM:
        async with _received_form(request) as found:
            yield found
    elif media_type in RAW_TYPES and (media_type != _JSON or context_header is not None):
        async with received_body(request) as file:
            # headers arrive as Latin-1; the bytes themselves are the JSON text
            yield file, (context_header or "").encode("latin-1"), "", ""
    else:
        raise UnsupportedUpload(
            f"the content type {media_type[:80] or '(none)'} carries no upload",
            field="Content-Type",
            limit=", ".join((FORM, *RAW_TYPES)),
            cure=_CURE,
        )


def with_vehicle(context: UploadContext, vehicle: str) -> UploadContext:
    """The context with the vehicle that the form's part names."""
    named = validated(TypeAdapter(UploadContext), {"vehicle": vehicle}, "form").vehicle
    if context.vehicle not in (None, named):
        raise MalformedRequest(
            "the form and the context name different vehicles",
            field="vehicle",
            limit="one vehicle",
            cure="name it once",
        )
    return context.model_copy(update={"vehicle": named})


@asynccontextmanager
async def _received_form(request: Request) -> AsyncIterator[tuple[SpooledFile, bytes, str, str]]:
    async with received_form(request, max_files=2, max_fields=3, max_part_size=MAX_CONTEXT_BYTES) as form:
        check_parts(form, None, "file", "context", "vehicle")
        file = form.get("file")
        if not isinstance(file, SpooledPart):
            raise UnreadableUpload(
                "there is no file in the form" if file is None else "the part file has no filename, so it came as text",
                field="file",
                limit="one part named file, with a filename",
                cure=_CURE,
            )
        text = await read_text(form, "context", MAX_CONTEXT_BYTES)
        vehicle = form.get("vehicle", "")
        if isinstance(vehicle, UploadFile):
            raise MalformedRequest(
                "the vehicle came as a file", field="vehicle", limit="a name", cure="send it as text"
            )
        yield file.spooled, text, file.filename or "", vehicle


Upload = Annotated[UploadedFile, Depends(get_upload)]
