"""Bodies with files: streamed into the spool folder while they arrive, as a form's parts or bare."""

from __future__ import annotations

import io
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import anyio
from anyio import to_thread
from fastapi import Request
from starlette.datastructures import FormData, Headers, UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser

from app.api.http.turns import Turns
from app.errors import MalformedRequest
from app.formats.spooled_file import SpooledFile
from app.storage.spool import Spool, SpoolWriter

_THREADS = anyio.CapacityLimiter(8)
"""Threads that write bodies: a slow disk must not take the threads of other requests. Source: chosen by hand."""
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
            request.headers, request.stream(),
            max_files=max_files, max_fields=max_fields, max_part_size=max_part_size,
        )  # fmt: skip
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
