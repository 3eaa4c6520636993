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
from app.services.decode_context import GivenContext
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
    context: GivenContext
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
        data, text, name, vehicle = await _read_form(request)
    elif media_type in RAW_TYPES and (media_type != _JSON or CONTEXT_HEADER in request.headers):
        data, name, vehicle = await request.body(), "", ""
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
    context = replace(_read_context(text), file_name=name)
    if vehicle:
        context = _of_vehicle(context, vehicle)
        text += b"\n" + vehicle.encode()
    return UploadedFile(data, context, idempotency_of(request, data, text))


def _of_vehicle(context: GivenContext, vehicle: str) -> GivenContext:
    """The context with the vehicle that the form's part names."""
    named = _validated({"vehicle": vehicle}, ("form",)).vehicle
    if context.vehicle not in (None, named):
        raise MalformedRequest(
            "the form and the context name different vehicles",
            field="vehicle",
            limit="one vehicle",
            cure="name it once",
        )
    return replace(context, vehicle=named)


def idempotency_of(request: Request, data: bytes, text: bytes) -> IdempotencyKey | None:
    """The key with the hash of what was uploaded: a form's boundaries differ at each try."""
    key = checked_idempotency_key(request)
    if key is None:
        return None
    digest = hashlib.sha256(f"{request.url.path} {len(text)}\n".encode())
    digest.update(text)
    digest.update(data)
    return IdempotencyKey(key, digest.hexdigest())


async def _read_form(request: Request) -> tuple[bytes, bytes, str, str]:
    async with request.form(max_files=2, max_fields=3, max_part_size=MAX_CONTEXT_BYTES) as form:
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
        vehicle = form.get("vehicle", "")
        if isinstance(vehicle, UploadFile):
            raise MalformedRequest(
                "the vehicle came as a file", field="vehicle", limit="a name", cure="send it as text"
            )
    return data, text, file.filename or "", vehicle


def _check_parts(form: FormData) -> None:
    names = [name for name, _value in form.multi_items()]
    wrong = next((name for name in names if name not in ("file", "context", "vehicle") or names.count(name) > 1), None)
    if wrong is not None:
        raise MalformedRequest(
            f"the form has an unexpected part {wrong[:80]!r}, or has it twice",
            field="file" if wrong == "file" else "body",
            limit="one file, one context, one vehicle",
            cure="send several frames as a ZIP archive",
        )


def _read_context(text: bytes) -> GivenContext:
    if not text.strip():
        return GivenContext()
    value: Any = parse_json(text, "context")
    return _validated(value, ("context",)).given()


def _validated(value: Any, where: tuple[str, ...]) -> ContextIn:
    try:
        return ContextIn.model_validate(value)
    except ValidationError as error:
        # where pydantic says what is wrong inside the context, the problem table expects it inside a request
        faults = [{**fault, "loc": (*where, *fault["loc"])} for fault in error.errors()]
        raise RequestValidationError(faults) from error


Upload = Annotated[UploadedFile, Depends(get_upload)]
