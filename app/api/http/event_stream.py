"""Server-sent events (HTML Living Standard, section 9.2): streams that stay open, each at the cost of one task.

A stream ends when its events end, when its client leaves, when the server stops, or after `MAX_STREAM_S`; clients
then connect again with `Last-Event-ID`. Nothing runs in a thread while a stream waits.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import AsyncIterator, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Annotated

import orjson
from fastapi import Header, Response
from starlette.exceptions import HTTPException
from starlette.types import Receive, Scope, Send

from app.errors import TooManyRequests

MEDIA_TYPE = "text/event-stream"
HEARTBEAT_S = 15.0
"""Longest silence of a stream. [s] Source: the standard's advice for proxies that cut quiet connections."""
MAX_STREAM_S = 900.0
"""Longest stream; the key of a client that connects again is checked again. [s]"""
RETRY_MS = 2000
"""When a client whose stream was cut connects again. [ms]"""
MAX_STREAMS_PER_KEY = 20
MAX_STREAMS = 500
"""In one process. Source: half of the connections that it accepts by default, `max_connections`."""
STOP = "end_stream"
"""Member of the scope's state by which a server that stops ends a stream."""
LastEventId = Annotated[
    str | None,
    Header(alias="Last-Event-ID", max_length=100, description="Id of the last event that the client has seen."),
]
_RETRY_AFTER_S = 5


@dataclass(frozen=True, slots=True)
class ServerEvent:
    """An event: its type, its id for `Last-Event-ID`, and its data as JSON. Without a type it is a heartbeat."""

    kind: str = ""
    id: str = ""
    data: object = None

    def encode(self) -> bytes:
        """As it is sent. JSON of orjson is one line."""
        if not self.kind:
            return b": still here\n\n"
        return b"event: %s\nid: %s\ndata: %s\n\n" % (self.kind.encode(), self.id.encode(), orjson.dumps(self.data))


class StreamPlaces:
    """Limits on streams at a time. For the event loop only."""

    def __init__(self, per_key: int = MAX_STREAMS_PER_KEY, in_all: int = MAX_STREAMS) -> None:
        self._per_key, self._in_all = per_key, in_all
        self.open: Counter[str] = Counter()

    @contextmanager
    def place(self, key_id: str) -> Iterator[None]:
        """A place for a stream of a key.

        Raises
        ------
        TooManyRequests
            There are too many already.
        """
        own = self.open[key_id]
        if own >= self._per_key or self.open.total() >= self._in_all:
            raise TooManyRequests(
                "too many event streams are open",
                limit=f"{self._per_key} of one key, {self._in_all} in all",
                cure="close streams, or follow all jobs in one: GET /v1/events",
                retry_after_s=_RETRY_AFTER_S,
            )
        self.open[key_id] += 1
        try:
            yield
        finally:
            self.open -= Counter([key_id])


class EventStream(Response):
    """A response that sends events as they come.

    Parameters
    ----------
    events : async iterator of ServerEvent
        Yields a heartbeat at least each `HEARTBEAT_S`.
    key_id : str
        Whose stream it is.
    max_s : float, optional
        Longest time. [s]
    """

    media_type = MEDIA_TYPE

    def __init__(
        self, events: AsyncIterator[ServerEvent], places: StreamPlaces, key_id: str, max_s: float = MAX_STREAM_S
    ) -> None:
        headers: Mapping[str, str] = {"Cache-Control": "private, no-store", "X-Accel-Buffering": "no"}
        super().__init__(None, headers=headers)
        del self.headers["content-length"]
        self._events, self._places, self._key_id, self._max_s = events, places, key_id, max_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send events until one of the ends."""
        with self._places.place(self._key_id):
            stopped = asyncio.Event()
            scope.setdefault("state", {})[STOP] = stopped.set
            await send({"type": "http.response.start", "status": self.status_code, "headers": self.raw_headers})
            tasks = [
                asyncio.create_task(self._send_events(send)),
                asyncio.create_task(_client_leaves(receive)),
                asyncio.create_task(stopped.wait()),
            ]
            try:
                await asyncio.wait(tasks, timeout=self._max_s, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for task in tasks:
                    task.cancel()
                results = await asyncio.gather(*tasks, return_exceptions=True)
            if isinstance(results[0], Exception):
                raise results[0]
            await send({"type": "http.response.body", "body": b"", "more_body": False})

    async def _send_events(self, send: Send) -> None:
        await _send_part(send, b"retry: %d\n\n" % RETRY_MS)
        async for event in self._events:
            await _send_part(send, event.encode())


async def _send_part(send: Send, part: bytes) -> None:
    await send({"type": "http.response.body", "body": part, "more_body": True})


async def _client_leaves(receive: Receive) -> None:
    with suppress(HTTPException):
        while (await receive())["type"] != "http.disconnect":
            pass
