"""A part of an upload as it arrives: it is made durable piece by piece, so that an interrupted request keeps most."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import TypeVar

import anyio
from anyio import to_thread
from fastapi import Request

from app.api.http.bodies import append, finish, spool_of
from app.api.http.problems import BodyRefused
from app.api.uploads.headers import Checksum
from app.errors import UploadTooLarge, WaymarkError, WrongChecksum
from app.formats.spooled_file import SpooledFile
from app.services.uploads.documents import UploadDocument
from app.services.uploads.uploads import Grant, Uploads

PIECE_BYTES = 16 << 20
"""Bytes after which a piece is made durable. [byte] Source: chosen by hand; a killed server loses so much at most."""
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
