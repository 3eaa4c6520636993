"""Connections over real sockets: late headers, unread responses, too many at a time."""

from __future__ import annotations

import asyncio
import errno
import socket
import struct
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

import httpx
import pytest
import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route

from app.api.http.connections import (
    MAX_HEADER_BYTES,
    MAX_TRAILER_BYTES,
    ConnectionLimits,
    LimitedConnection,
    limited_connections,
)
from app.demo.server import free_ports
from tests.http import WITHIN_S, wait_until
from tests.machine import require_tool

ROOT = Path(__file__).parents[3]
LARGE_BYTES = 64 * 1024**2
"""More than the buffers of two sockets hold. [byte]"""
Start = Callable[[ConnectionLimits], int]


def hello(_request: Request) -> Response:
    return PlainTextResponse("hello")


def large(_request: Request) -> Response:
    return Response(bytes(LARGE_BYTES))


async def seen(request: Request) -> Response:
    """Names of the headers when the whole body has come, and the body."""
    body = await request.body()
    return PlainTextResponse(f"{sorted(request.headers)} {body.decode()}")


class Gate:
    """A route whose requests wait until it is opened or their client leaves."""

    def __init__(self) -> None:
        self.opened = threading.Event()
        self.entered, self.left = 0, 0

    async def pass_through(self, request: Request) -> Response:
        self.entered += 1
        while not self.opened.is_set():
            if await request.is_disconnected():
                self.left += 1
                break
            await asyncio.sleep(0.01)
        return PlainTextResponse("through")


GATE = b"GET /gate HTTP/1.1\r\nHost: x\r\n\r\n"


@pytest.fixture
def gate() -> Iterator[Gate]:
    """What `/gate` of the servers waits for."""
    made = Gate()
    yield made
    made.opened.set()


@pytest.fixture
def app_routes(gate: Gate) -> list[Route]:
    """What the servers answer."""
    return [
        Route("/", hello, methods=["GET", "POST"]),
        Route("/large", large),
        Route("/seen", seen, methods=["GET", "POST"]),
        Route("/gate", gate.pass_through),
    ]


@pytest.fixture
def start(app_routes: list[Route]) -> Iterator[Start]:
    """Start servers with limits; each returns its port."""
    app = Starlette(routes=app_routes)
    with ExitStack() as running:

        def serve(limits: ConnectionLimits) -> int:
            config = uvicorn.Config(
                app, port=0, http=limited_connections(limits), ws="none", log_config=None, lifespan="off"
            )
            server = uvicorn.Server(config)
            thread = threading.Thread(target=server.run)
            running.callback(thread.join, WITHIN_S)
            running.callback(setattr, server, "should_exit", True)
            thread.start()
            wait_until(lambda: server.started, "the server to start")
            return int(server.servers[0].sockets[0].getsockname()[1])

        yield serve


def connect(port: int, sent: bytes = b"", *, source: str = "127.0.0.1") -> socket.socket:
    client = socket.create_connection(("127.0.0.1", port), WITHIN_S, source_address=(source, 0))
    client.sendall(sent)
    return client


def read_until(client: socket.socket, expected: bytes) -> None:
    """Read what comes, in however many pieces, until it has what is expected."""
    found = b""
    while expected not in found:
        part = client.recv(65536)
        assert part, found
        found += part


def read_all(client: socket.socket) -> bytes:
    """What comes until the server ends the connection."""
    parts = []
    with client:
        while part := client.recv(65536):
            parts.append(part)
    return b"".join(parts)


QUICK = ConnectionLimits(header_s=0.3, stall_s=0.3, check_s=0.05)


@pytest.mark.parametrize("sent", [b"", b"GET / HTTP/1.1\r\nHost: x\r\n"])
def test_headers_that_do_not_come_are_given_up(start: Start, sent: bytes) -> None:
    answer = read_all(connect(start(QUICK), sent))
    assert b"HTTP/1.1 408 Request Timeout" in answer
    assert b"connection: close" in answer.lower()


def test_bytes_one_by_one_win_no_time(start: Start) -> None:
    port = start(QUICK)
    client, ended = connect(port), threading.Event()

    def send_slowly() -> None:
        for byte in b"GET / HTTP/1.1\r\nX-Slow: " + b"x" * 60_000:
            if ended.wait(0.02):
                return
            try:
                client.send(bytes([byte]))
            except OSError:
                return

    sender = threading.Thread(target=send_slowly)
    sender.start()
    read_until(client, b"408 Request Timeout")
    ended.set()
    sender.join()
    client.close()


@pytest.mark.parametrize("sent", [b"\r\n", b"GET /"])
def test_the_next_request_has_no_more_time(start: Start, sent: bytes) -> None:
    client = connect(start(QUICK), b"GET / HTTP/1.1\r\nHost: x\r\n\r\n")
    read_until(client, b"hello")
    client.sendall(sent)
    assert b"408 Request Timeout" in read_all(client)


def test_headers_have_a_size(start: Start) -> None:
    client = connect(start(ConnectionLimits()))
    client.sendall(b"GET / HTTP/1.1\r\nX-Long: " + b"x" * MAX_HEADER_BYTES)
    read_until(client, b"431 Request Header Fields Too Large")
    client.close()


def test_a_body_that_nobody_reads_ends_the_connection(start: Start) -> None:
    client = connect(start(ConnectionLimits()), b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: 1000000\r\n\r\nx")
    assert read_all(client).endswith(b"hello")


def test_a_body_that_comes_after_its_answer_is_no_header(start: Start) -> None:
    body = bytes(16 * MAX_HEADER_BYTES)  # more than one read takes
    head = f"POST / HTTP/1.1\r\nHost: x\r\nContent-Type: image/jpeg\r\nContent-Length: {len(body)}\r\n\r\n"
    client = connect(start(ConnectionLimits()), head.encode() + body[:1])
    read_until(client, b"hello")
    client.sendall(body[1:] + b"GET / HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n")
    answers = read_all(client)
    assert answers.startswith(b"HTTP/1.1 200")
    assert answers.count(b"HTTP/1.1") == 1


def test_a_response_that_is_not_read_is_given_up(start: Start) -> None:
    client = connect(start(QUICK), b"GET /large HTTP/1.1\r\nHost: x\r\n\r\n")
    # the server ends it, and the kernel drops what waits: this client learns that without reading
    wait_until(lambda: client.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) == errno.ECONNRESET, "a reset")
    client.close()


def test_a_response_that_is_read_comes_whole(start: Start) -> None:
    client = connect(start(ConnectionLimits()), b"GET /large HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n")
    assert len(read_all(client)) > LARGE_BYTES


def test_one_address_may_not_take_all_connections(start: Start) -> None:
    port = start(ConnectionLimits(total=4, per_address=2, proxies=frozenset({"127.0.0.4"})))
    first, second = connect(port), connect(port)
    wait_until(lambda: refused(port, "127.0.0.1"), "the third connection to be refused")
    assert not refused(port, "127.0.0.2")
    first.close()
    wait_until(lambda: not refused(port, "127.0.0.1"), "a place to be free again")
    second.close()


def test_connections_have_a_number(start: Start, gate: Gate) -> None:
    port = start(ConnectionLimits(total=3, per_address=2, proxies=frozenset({"127.0.0.4"})))
    held = [connect(port, GATE, source="127.0.0.4") for _ in range(3)]
    wait_until(lambda: gate.entered == 3, "the requests to run")
    assert refused(port, "127.0.0.2")
    gate.opened.set()
    for client in held:
        read_until(client, b"through")
        client.close()
    wait_until(lambda: not refused(port, "127.0.0.2"), "a place to be free again")


@pytest.mark.parametrize("sent", [b"", b"GET / HTTP/1.1\r\nHost: x\r\n", b"GET /large HTTP/1.1\r\nHost: x\r\n\r\n"])
def test_connections_that_are_held_lock_nobody_out(start: Start, sent: bytes) -> None:
    port = start(ConnectionLimits(header_s=1000, stall_s=1000, check_s=1000, total=20, per_address=5))
    attackers = [f"127.0.0.{number}" for number in range(1, 5)]
    held = [connect(port, sent, source=address) for _ in range(5) for address in attackers]
    with ExitStack() as clients:
        for client in held:
            clients.enter_context(client)
        wait_until(lambda: not refused(port, "127.0.0.6"), "a place to be made")
        idle = clients.enter_context(connect(port, source="127.0.0.6"))
        for _ in range(20):
            assert not refused(port, "127.0.0.7")
        idle.sendall(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n")  # was not ended: its address has fewer
        read_until(idle, b"hello")


# --- what is parsed -----------------------------------------------------------------------------------------------


CHUNKED = b"POST /seen HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n3\r\nabc\r\n0\r\n"


@pytest.fixture
def proxy(tmp_path: Path) -> Iterator[Callable[[int], int]]:
    """Start the proxy of `docker/nginx.conf` in front of the server on a port; it returns its own port."""
    nginx = require_tool("nginx")
    (port,) = free_ports(1)

    def serve(server_port: int) -> int:
        text = (ROOT / "docker/nginx.conf").read_text()
        for shipped, here in (
            ("server waymark:8000", f"server 127.0.0.1:{server_port}"),
            ("listen 8080", f"listen 127.0.0.1:{port}"),
            ("/tmp/", f"{tmp_path}/"),
        ):
            assert shipped in text
            text = text.replace(shipped, here)
        (tmp_path / "nginx.conf").write_text(text)
        running.append(subprocess.Popen([nginx, "-p", str(tmp_path), "-c", "nginx.conf", "-g", "daemon off;"]))
        wait_until(lambda: _listens(port), "nginx to start")
        return port

    running: list[subprocess.Popen[bytes]] = []
    yield serve
    for process in running:
        process.terminate()
        process.wait(WITHIN_S)


def _listens(port: int) -> bool:
    with suppress(OSError), socket.create_connection(("127.0.0.1", port)):
        return True
    return False


def test_trailers_are_dropped_behind_the_shipped_proxy(start: Start, proxy: Callable[[int], int]) -> None:
    port = proxy(start(ConnectionLimits()))
    client = connect(port, CHUNKED + b"X-API-Key: secret\r\n\r\n")
    client.sendall(b"GET / HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n")
    answers = read_all(client)
    assert answers.count(b"HTTP/1.1 200") == 2
    assert b"abc" in answers
    assert b"x-api-key" not in answers
    with connect(port, CHUNKED) as endless, suppress(ConnectionError):
        endless.sendall(b"a:b\r\n" * 2_000_000)
    assert httpx.get(f"http://127.0.0.1:{port}/", timeout=WITHIN_S, trust_env=False).text == "hello"


def test_trailers_are_dropped(start: Start) -> None:
    client = connect(start(ConnectionLimits()), CHUNKED + b"X-API-Key: secret\r\n\r\n")
    client.sendall(b"GET /seen HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n")
    answers = read_all(client)
    assert answers.count(b"HTTP/1.1 200") == 2
    assert b"abc" in answers
    assert b"x-api-key" not in answers


@pytest.mark.parametrize("trailers", [b"a:b\r\n" * 200_000, b"a:" + b"b" * 1_000_000])
def test_trailers_have_a_size(start: Start, trailers: bytes) -> None:
    client = connect(start(ConnectionLimits()))
    with suppress(ConnectionError):
        client.sendall(CHUNKED + trailers)
    with suppress(ConnectionError):
        read_all(client)
    client = connect(start(ConnectionLimits()), CHUNKED + trailers[: MAX_TRAILER_BYTES + 10_000])
    assert b"431 Request Header Fields Too Large" in read_all(client)


def test_the_line_before_a_chunk_has_a_size(start: Start) -> None:
    head = b"POST /seen HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n3;"
    client = connect(start(ConnectionLimits()), head + b"x" * (MAX_TRAILER_BYTES + 10_000))
    assert b"431 Request Header Fields Too Large" in read_all(client)


@pytest.mark.parametrize(
    ("sent", "status"),
    [
        (b"GET / HTTP/1.1\r\n\r\n", b"400"),
        (b"GET / HTTP/1.1\r\nHost: x\r\nHost: x\r\n\r\n", b"400"),
        (b"GET / HTTP/1.1\r\nHost: x y\r\n\r\n", b"400"),
        (b"GET / HTTP/1.0\r\nHost: x\r\nHost: y\r\n\r\n", b"400"),
        (b"GET / HTTP/1.0\r\n\r\n", b"200"),
        (b"GET / HTTP/1.1\r\nHost:\r\nConnection: close\r\n\r\n", b"200"),
        (b"GET /" + b"x" * 65_536 + b" HTTP/1.1\r\nHost: x\r\n\r\n", b"414"),
        (b"GET /" + b"x" * 65_000 + b" HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n", b"404"),
        (b"GET / HTTP/1.1\r\nHost: x\r\n" + b"a:b\r\n" * 20_000 + b"\r\n", b"431"),
        (b"GET / HTTP/9.9\r\nHost: x\r\n\r\n", b"400"),
        (b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", b"400"),
        (b"GET / HTTP/1.1\r\nHost: x\r\nConnection: Upgrade\r\nUpgrade: h2c\r\n\r\nGET / HTTP/1.1\r\n", b"200"),
    ],
)
def test_each_request_is_answered_or_refused(start: Start, sent: bytes, status: bytes) -> None:
    answer = read_all(connect(start(ConnectionLimits()), sent))
    assert answer[9:12] == status, answer[:500]
    assert answer.count(b"HTTP/1.1 ") == 1
    if status == b"400":
        assert b"application/problem+json" in answer


def test_what_follows_a_request_waits_for_its_answer(start: Start, gate: Gate) -> None:
    client = connect(start(ConnectionLimits()), GATE + b"GET / HTTP/1.1\r\nHost: x\r\n\r\n" * 500 + b"bad\r\n\r\n")
    wait_until(lambda: gate.entered == 1, "the first request to run")
    gate.opened.set()
    answers = read_all(client)  # all, and then one to what is no request
    assert answers.count(b"through") == 1
    assert answers.count(b"hello") == 500
    assert b"HTTP/1.1 400" in answers[answers.rindex(b"hello") :]


def test_few_requests_are_parsed_ahead(start: Start, gate: Gate, monkeypatch: pytest.MonkeyPatch) -> None:
    parsed = []
    begin = LimitedConnection.on_message_begin
    monkeypatch.setattr(LimitedConnection, "on_message_begin", lambda self: parsed.append(1) or begin(self))
    client = connect(start(ConnectionLimits()), GATE)
    client.setblocking(False)
    with suppress(BlockingIOError):
        while True:
            client.send(GATE * 1000)  # until no buffer takes more
    wait_until(lambda: gate.entered == 1, "the first request to run")
    assert len(parsed) < 200
    client.close()
    gate.opened.set()


@pytest.mark.parametrize("behind", [1, 50_000])
def test_nothing_goes_on_when_its_client_has_left(start: Start, gate: Gate, behind: int) -> None:
    client = connect(start(QUICK), GATE)
    client.setblocking(False)
    with suppress(BlockingIOError):
        client.sendall(GATE * behind)
    wait_until(lambda: gate.entered == 1, "the first request to run")
    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # or the kernel goes on to send
    client.close()
    wait_until(lambda: gate.left == 1, "the server to notice it")
    assert gate.entered == 1


def test_headers_that_wait_for_an_answer_are_not_late(start: Start, gate: Gate) -> None:
    client = connect(start(QUICK), GATE + b"GET / HTTP/1.1\r\nHo")
    wait_until(lambda: gate.entered == 1, "the first request to run")
    time.sleep(3 * QUICK.header_s)  # their limit passes while they wait
    gate.opened.set()
    read_until(client, b"through")
    client.sendall(b"st: x\r\n\r\n")
    read_until(client, b"hello")
    client.close()


def refused(port: int, source: str) -> bool:
    """Whether the server refuses a connection from an address."""
    with httpx.Client(transport=httpx.HTTPTransport(local_address=source), trust_env=False) as client:
        response = client.get(f"http://127.0.0.1:{port}/")
    if response.status_code == 503:
        assert int(response.headers["retry-after"]) > 0
        assert response.headers["content-type"] == "application/problem+json"
        assert response.json()["status"] == 503
        return True
    return response.text != "hello"
