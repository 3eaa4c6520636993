"""Uploads as they come over HTTP: a form with two parts, or the bare file with its context in a header."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from typing import Annotated, Any

from fastapi import Depends, Request
from fastapi.exceptions import RequestValidationError
from pydantic import ValidationError
from starlette.datastructures import FormData, UploadFile

from app.api.dependencies import checked_idempotency_key
from app.api.schemas_decodes import ContextIn
from app.api.strict_json import parse_json
from app.errors import MalformedRequest, UnreadableUpload, UnsupportedUpload
from app.services.decode_context import DecodeContext
from app.services.idempotency import IdempotencyKey

CONTEXT_HEADER = "waymark-context"
MAX_CONTEXT_BYTES = 64 * 1024
RAW_TYPES = (
    "image/jpeg", "image/png", "application/zip", "application/octet-stream", "text/csv",
    "application/vnd.apache.parquet", "application/json", "application/x-ndjson", "text/plain",
)  # fmt: skip
_FORM = "multipart/form-data"
_JSON = "application/json"  # uplinks, as network servers post them: with the header that says so
_CURE = "send multipart/form-data with the parts file and context"


@dataclass(frozen=True, slots=True)
class UploadedFile:
    """A file with its context, and the client's Idempotency-Key if it sent one."""

    data: bytes
    context: DecodeContext
    idempotency: IdempotencyKey | None


async def get_upload(request: Request) -> UploadedFile:
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
    media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media_type == _FORM:
        data, text, name = await _read_form(request)
    elif media_type in RAW_TYPES and (media_type != _JSON or CONTEXT_HEADER in request.headers):
        data, name = await request.body(), ""
        # headers arrive as Latin-1; the bytes themselves are the JSON text
        text = request.headers.get(CONTEXT_HEADER, "").encode("latin-1")
    else:
        raise UnsupportedUpload(
            f"the content type {media_type[:80] or '(none)'} carries no upload",
            field="Content-Type",
            limit=", ".join((_FORM, *RAW_TYPES)),
            cure=_CURE,
        )
    if len(text) > MAX_CONTEXT_BYTES:
        raise MalformedRequest("the context is too long", field="context", limit=f"{MAX_CONTEXT_BYTES} bytes")
    return UploadedFile(data, _named(_read_context(text), name), idempotency_of(request, data, text))


def _named(context: DecodeContext, name: str) -> DecodeContext:
    """A trace's or a packet log's context with the name of its file: its suffix tells kinds of text apart."""
    if not name:
        return context
    if context.trace is not None:
        return replace(context, trace={**context.trace, "file_name": name[:120]})
    if context.packets is not None:
        return replace(context, packets={**context.packets, "file_name": name[:120]})
    return context


def idempotency_of(request: Request, data: bytes, text: bytes) -> IdempotencyKey | None:
    """The key with the hash of what was uploaded: a form's boundaries differ at each try."""
    key = checked_idempotency_key(request)
    if key is None:
        return None
    digest = hashlib.sha256(f"{request.url.path} {len(text)}\n".encode())
    digest.update(text)
    digest.update(data)
    return IdempotencyKey(key, digest.hexdigest())


async def _read_form(request: Request) -> tuple[bytes, bytes, str]:
    async with request.form(max_files=2, max_fields=2, max_part_size=MAX_CONTEXT_BYTES) as form:
        _check_parts(form)
        file, context = form.get("file"), form.get("context", "")
        if not isinstance(file, UploadFile):
            raise UnreadableUpload(
                "there is no file in the form" if file is None else "the part file has no filename, so it came as text",
                field="file",
                limit="one part named file, with a filename",
                cure=_CURE,
            )
        data = await file.read()
        text = await context.read() if isinstance(context, UploadFile) else context.encode()
    return data, text, file.filename or ""


def _check_parts(form: FormData) -> None:
    names = [name for name, _value in form.multi_items()]
    wrong = next((name for name in names if name not in ("file", "context") or names.count(name) > 1), None)
    if wrong is not None:
        raise MalformedRequest(
            f"the form has an unexpected part {wrong[:80]!r}, or has it twice",
            field="file" if wrong == "file" else "body",
            limit="one file, one context",
            cure="send several frames as a ZIP archive",
        )


def _read_context(text: bytes) -> DecodeContext:
    if not text.strip():
        return DecodeContext()
    value: Any = parse_json(text, "context")
    try:
        return ContextIn.model_validate(value).domain()
    except ValidationError as error:
        # where pydantic says what is wrong inside the context, the problem table expects it inside a request
        faults = [{**fault, "loc": ("context", *fault["loc"])} for fault in error.errors()]
        raise RequestValidationError(faults) from error


Upload = Annotated[UploadedFile, Depends(get_upload)]
