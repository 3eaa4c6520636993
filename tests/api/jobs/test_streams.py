"""Event streams over real sockets: a client that never reads is cut, a quiet stream is not."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator

import pytest
from starlette.responses import Response
from starlette.routing import Route

from app.api.http.connections import ConnectionLimits
from app.api.http.event_stream import EventStream, ServerEvent, StreamPlaces
from tests.api.http.test_connections import Start, connect
from tests.api.http.test_connections import start as start
from tests.http import WITHIN_S, wait_until

PLACES = StreamPlaces()
QUIET_FOR_S = 1.0
LIMITS = ConnectionLimits(stall_s=0.2, check_s=0.05, min_bytes_per_s=8000.0)


async def _quiet() -> AsyncIterator[ServerEvent]:
    await asyncio.sleep(QUIET_FOR_S)  # five times what a client has to read in
    yield ServerEvent("done", "1", {})


async def _busy() -> AsyncIterator[ServerEvent]:
    while True:
        yield ServerEvent("progress", "1", "x" * 100_000)
        await asyncio.sleep(0)


ROUTES = [
    Route("/quiet", lambda _r: EventStream(_quiet(), PLACES, "key")),
    Route("/busy", lambda _r: EventStream(_busy(), PLACES, "key")),
]


@pytest.fixture
def app_routes() -> list[Route]:
    return ROUTES


def _ask(port: int, path: str) -> socket.socket:
    return connect(port, b"GET %s HTTP/1.1\r\nHost: x\r\n\r\n" % path.encode())


def test_a_client_that_never_reads_is_cut_and_gives_its_place_back(start: Start) -> None:
    with _ask(start(LIMITS), "/busy"):
        wait_until(lambda: PLACES.open["key"] == 1, "the stream")
        wait_until(lambda: PLACES.open["key"] == 0, "its end")


def test_a_quiet_stream_is_not_cut(start: Start) -> None:
    with _ask(start(LIMITS), "/quiet") as client:
        client.settimeout(WITHIN_S)
        read = b""
        while b"event: done" not in read:
            part = client.recv(65536)
            assert part, read
            read += part
    assert read.startswith(b"HTTP/1.1 200")


def test_a_stream_ends_after_its_longest_time() -> None:
    sent: list[bytes] = []

    async def send(message: dict[str, object]) -> None:
        sent.append(bytes(message.get("body", b"")))  # type: ignore[call-overload]

    async def receive() -> dict[str, str]:
        await asyncio.sleep(WITHIN_S)
        return {"type": "http.disconnect"}

    async def forever() -> AsyncIterator[ServerEvent]:
        while True:
            yield ServerEvent()
            await asyncio.sleep(0.01)

    stream: Response = EventStream(forever(), PLACES, "other", max_s=0.05)
    asyncio.run(stream({"type": "http"}, receive, send))  # type: ignore[arg-type]
    assert sent[-1] == b""
    assert b": still here\n\n" in sent
    assert PLACES.open["other"] == 0
