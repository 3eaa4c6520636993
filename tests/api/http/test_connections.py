"""Connections over real sockets: late headers, unread responses, too many at a time."""

from __future__ import annotations

import errno
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import httpx
import pytest
import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route

from app.api.http.connections import MAX_HEADER_BYTES, ConnectionLimits, limited_connections
from tests.http import WITHIN_S, wait_until

LARGE_BYTES = 64 * 1024**2
"""More than the buffers of two sockets hold. [byte]"""
Start = Callable[[ConnectionLimits], int]


def hello(_request: Request) -> Response:
    return PlainTextResponse("hello")


def large(_request: Request) -> Response:
    return Response(bytes(LARGE_BYTES))


@pytest.fixture
def app_routes() -> list[Route]:
    """What the servers answer."""
    return [Route("/", hello, methods=["GET", "POST"]), Route("/large", large)]


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


def test_connections_have_a_number(start: Start) -> None:
    port = start(ConnectionLimits(total=3, per_address=2, proxies=frozenset({"127.0.0.4"})))
    held = [connect(port, source="127.0.0.4") for _ in range(3)]
    wait_until(lambda: refused(port, "127.0.0.2"), "a connection to be refused")
    for client in held:
        client.close()
    wait_until(lambda: not refused(port, "127.0.0.2"), "a place to be free again")


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
