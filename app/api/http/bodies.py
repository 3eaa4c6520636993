"""Bodies with files: forms and bare files, streamed into the spool folder a few at a time while they arrive."""

from __future__ import annotations

import asyncio
import hashlib
import io
from collections import deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeVar, cast

import anyio
from anyio import to_thread
from fastapi import Request
from pydantic import TypeAdapter
from starlette.datastructures import FormData, Headers, UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser

from app.api.http.dependencies import caller_of, checked_idempotency_key
from app.api.http.problems import reference
from app.api.http.strict_json import in_thread_if_large, validated
from app.errors import MalformedRequest, UnsupportedUpload
from app.formats.format import SpooledFile
from app.formats.json_text import parse_json
from app.services.idempotency import IdempotencyKey
from app.storage.spool import Spool, SpoolWriter
from app.values import JsonObject

# === Turns of bodies: of many that arrive at once, a few go on in each round of the event loop.


AT_ONCE = 2
"""Pieces of bodies that are taken in one round of the event loop. Source: `python -m benchmarks.service --only
overload`; each takes up to half a millisecond, for which every other request waits."""


class Turns:
    """A queue of those who want to go on, first come, first served.

    A body that does not ask for its next piece is not read from its connection either (uvicorn stops at 64 KiB), so a
    round of the event loop takes as long as `AT_ONCE` pieces, however many clients upload.
    """

    def __init__(self) -> None:
        self._waiting: deque[asyncio.Future[None]] = deque()
        self._left = AT_ONCE
        self._is_due = False

    async def wait(self) -> None:
        """Return in a round of the event loop in which there is a turn left."""
        loop = asyncio.get_running_loop()
        if not self._is_due:
            self._is_due = True
            loop.call_soon(self._next_round, loop)
        if self._left and not self._waiting:
            self._left -= 1
            return
        turn = loop.create_future()
        self._waiting.append(turn)
        await turn

    def _next_round(self, loop: asyncio.AbstractEventLoop) -> None:
        self._left = AT_ONCE
        while self._left and self._waiting:
            turn = self._waiting.popleft()
            if not turn.done():  # its request was cancelled
                turn.set_result(None)
                self._left -= 1
        self._is_due = bool(self._waiting)
        if self._is_due:
            loop.call_soon(self._next_round, loop)


# === Bodies with files: streamed into the spool folder while they arrive, as a form's parts or bare.


_THREADS = anyio.CapacityLimiter(8)
"""Threads that write bodies: a slow disk must not take the threads of other requests."""
_TURNS = Turns()


def spool_of(request: Request) -> Spool:
    """The server's spool folder."""
    spool: Spool = request.app.state.spool
    return spool


async def append(writer: SpoolWriter, chunk: bytes) -> None:
    """Add bytes to a file, and wait for the turn of the next ones."""
    if writer.add(chunk):
        await to_thread.run_sync(writer.flush, limiter=_THREADS)
    await _TURNS.wait()


async def finish(writer: SpoolWriter) -> SpooledFile:
    """The complete file."""
    if writer.is_on_disk:
        return await to_thread.run_sync(writer.finish, limiter=_THREADS)
    return writer.finish()


@asynccontextmanager
async def received_body(request: Request) -> AsyncIterator[SpooledFile]:
    """The body of a request as a file, which is deleted at the end of the block unless it was moved away."""
    spool = spool_of(request)
    spool.check_room(_declared_length(request))
    with spool.writing() as writer:
        async for chunk in request.stream():
            await append(writer, chunk)
        yield await finish(writer)


class SpooledPart(UploadFile):
    """A part of a form with a file name; its content is `spooled`."""

    def __init__(self, writer: SpoolWriter, filename: str | None, headers: Headers) -> None:
        super().__init__(io.BytesIO(), size=0, filename=filename, headers=headers)
        self._writer = writer
        self.spooled = SpooledFile.of(b"")

    async def write(self, data: bytes) -> None:
        """Add bytes."""
        await append(self._writer, data)

    async def seek(self, offset: int) -> None:
        """The parser calls this when the part is complete."""
        self.spooled = await finish(self._writer)

    async def read(self, size: int = -1) -> bytes:
        """Its first bytes, or all."""
        return self.spooled.read() if size < 0 else self.spooled.head(size)

    async def close(self) -> None:
        """Delete the file, unless it was moved away."""
        self._writer.discard()


class _SpoolingParser(MultiPartParser):
    """Starlette's parser, but for where the content of files goes."""

    def __init__(self, request: Request, *, max_files: int, max_fields: int, max_part_size: int) -> None:
        super().__init__(
            request.headers, request.stream(), max_files=max_files, max_fields=max_fields, max_part_size=max_part_size
        )
        self._spool = spool_of(request)
        self._parts: list[SpooledPart] = []

    def on_headers_finished(self) -> None:
        super().on_headers_finished()
        part = self._current_part.file
        if part is not None:
            part.file.close()  # Starlette's own temporary file
            spooled = SpooledPart(self._spool.create(), part.filename, part.headers)
            self._parts.append(spooled)
            self._current_part.file = spooled

    async def parse(self) -> FormData:
        try:
            return await super().parse()
        except BaseException:
            for part in self._parts:
                await part.close()
            raise


@asynccontextmanager
async def received_form(
    request: Request, *, max_files: int, max_fields: int, max_part_size: int
) -> AsyncIterator[FormData]:
    """The form in a request; its files are deleted at the end of the block unless they were moved away.

    Raises
    ------
    MalformedRequest
        The form is malformed, or a field is too long.
    StorageFull
        There is no room for it.
    """
    spool_of(request).check_room(_declared_length(request))
    parser = _SpoolingParser(request, max_files=max_files, max_fields=max_fields, max_part_size=max_part_size)
    try:
        form = await parser.parse()
    except MultiPartException as error:
        raise MalformedRequest(
            f"the form cannot be read: {error.message}",
            field="body",
            limit=f"multipart/form-data of at most {max_files} files and {max_fields} fields of {max_part_size} bytes",
            cure="send large content as a file, with a file name",
        ) from error
    try:
        yield form
    finally:
        await form.close()


def _declared_length(request: Request) -> int:
    """Content-Length, which the middleware has checked; 0 without it. [byte]"""
    return int(request.headers.get("content-length", "0"))


# === Forms with files: their media type, text parts, declarations and Idempotency-Keys, and their OpenAPI description.


FORM = "multipart/form-data"
ModelT = TypeVar("ModelT")


@dataclass(frozen=True, slots=True)
class DeclaredForm:
    """A form with files and the part `declaration`."""

    what: str  # the request, in a sentence such as "an import is a form"
    part: str  # name of the part with the file, or of those with files
    max_declaration_bytes: int  # [byte]
    cure: str  # of a request that is another one
    max_files: int = 1  # in `part`

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
def _adapter(model: type) -> TypeAdapter[Any]:
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
        found: ModelT = validated(
            _adapter(cast("type", model)), parse_json(text, where[-1]) if text.strip() else {}, *where
        )
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


def form_body(parts: JsonObject, declared_in: str, declaration: type, example: object, **others: object) -> JsonObject:
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
