"""Forms with files: their media type, text parts, declarations and Idempotency-Keys, and their OpenAPI description."""

from __future__ import annotations

import hashlib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeVar

from fastapi import Request
from pydantic import BaseModel, TypeAdapter
from starlette.datastructures import FormData, UploadFile

from app.api.http.bodies import received_form
from app.api.http.components import reference
from app.api.http.dependencies import caller_of, checked_idempotency_key
from app.api.http.strict_json import in_thread_if_large, validated
from app.errors import MalformedRequest, UnsupportedUpload
from app.formats.json_text import parse_json
from app.formats.spooled_file import SpooledFile
from app.services.idempotency import IdempotencyKey

FORM = "multipart/form-data"
ModelT = TypeVar("ModelT", bound=BaseModel)


@dataclass(frozen=True, slots=True)
class DeclaredForm:
    """A form with files and the part `declaration`.

    Attributes
    ----------
    what : str
        The request, in a sentence such as "an import is a form".
    part : str
        Name of the part with the file, or of those with files.
    max_declaration_bytes : int
        [byte]
    cure : str
        Of a request that is another one.
    max_files : int
        In `part`.
    """

    what: str
    part: str
    max_declaration_bytes: int
    cure: str
    max_files: int = 1

    @asynccontextmanager
    async def received(self, request: Request) -> AsyncIterator[tuple[FormData, bytes]]:
        """The form in a request and the text of its declaration; its files are deleted at the end of the block.

        Raises
        ------
        UnsupportedUpload
            The request is no form.
        MalformedRequest
            It has other parts, or a declaration that is too long.
        """
        if media_type_of(request) != FORM:
            raise UnsupportedUpload(f"{self.what} is a form", field="Content-Type", limit=FORM, cure=self.cure)
        limit = self.max_declaration_bytes
        async with received_form(request, max_files=self.max_files + 1, max_fields=2, max_part_size=limit) as form:
            if self.max_files > 1:
                check_parts(form, self.part, "declaration")
            else:
                check_parts(form, None, self.part, "declaration")
            text = await read_text(form, "declaration", limit)
            if len(text) > limit:
                shown = f"{limit // 1024} KiB"
                raise MalformedRequest("the declaration is too long", field="declaration", limit=shown, cure=self.cure)
            yield form, text


def media_type_of(request: Request) -> str:
    """The media type of a request's body, without parameters."""
    return request.headers.get("content-type", "").partition(";")[0].strip().lower()


async def read_text(form: FormData, name: str, max_bytes: int) -> bytes:
    """A part that is text, sent as a file or not; empty if there is none.

    At most one byte more than `max_bytes` is read, so that the caller can refuse it.
    """
    part = form.get(name, "")
    return await part.read(max_bytes + 1) if isinstance(part, UploadFile) else part.encode()


@cache
def _adapter(model: type[BaseModel]) -> TypeAdapter[BaseModel]:
    return TypeAdapter(model)


def check_parts(form: FormData, several: str | None, *known: str) -> None:
    """Refuse parts that a form does not have, and parts that are sent twice, but for the one that may be.

    Raises
    ------
    MalformedRequest
        There is one.
    """
    names = [name for name, _value in form.multi_items()]
    allowed = (*known, several) if several else known
    for name in names:
        if name not in allowed:
            shown = name[:80]
            file = several or known[0]
            raise MalformedRequest(
                f"the form has no part {shown!r}",
                field=shown,
                limit=", ".join(allowed),
                cure=f"name the part with the file {file}, or leave {shown} out",
            )
        if name != several and names.count(name) > 1:
            raise MalformedRequest(
                f"the part {name!r} was sent twice", field=name, limit=f"one {name}", cure="send it once"
            )


async def read_declaration(model: type[ModelT], text: bytes, *where: str) -> ModelT:
    """A model from the JSON text of the part that `where` ends with; an empty text declares nothing.

    Raises
    ------
    MalformedRequest
        It is not JSON.
    RequestValidationError
        It is not valid.
    """

    def read() -> ModelT:
        found = validated(_adapter(model), parse_json(text, where[-1]) if text.strip() else {}, *where)
        assert isinstance(found, model)
        return found

    return await in_thread_if_large(len(text), read)


def idempotency_of(request: Request, header: str | None, text: bytes, *files: SpooledFile) -> IdempotencyKey | None:
    """The key with the hash of what was uploaded: a form's boundaries differ at each try."""
    key = checked_idempotency_key(header)
    if key is None:
        return None
    digest = hashlib.sha256(f"{request.url.path} {len(text)} {[file.sha256 for file in files]}\n".encode())
    digest.update(text)
    return IdempotencyKey(key, digest.hexdigest(), caller_of(request).key_id)


def form_body(
    parts: dict[str, Any], declared_in: str, declaration: type[BaseModel], example: Any, **others: Any
) -> dict[str, Any]:
    """OpenAPI description of a body that is a form: its first part is required, and one part is a declaration in JSON.

    Parameters
    ----------
    parts : dict
        Schemas of the other parts.
    declared_in : str
        Name of the part that is declared as JSON.
    declaration : type
        Model of that part.
    example : dict
        A form.
    **others
        Further media types of the body.
    """
    first = next(iter(parts))
    form = {
        "schema": {"type": "object", "required": [first], "properties": {**parts, declared_in: reference(declaration)}},
        "encoding": {declared_in: {"contentType": "application/json"}},
        "example": example,
    }
    return {"requestBody": {"required": True, "content": {FORM: form, **others}}}
