"""Hundreds of connections that send nothing, or a byte a second, or never read, while an honest client works."""

from __future__ import annotations

import selectors
import socket
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import httpx

from benchmarks.faults.rows import FaultRow
from benchmarks.faults.server import ADMIN_KEY, HEADERS, FaultServer

_HEAD = (
    f"POST /v1/markers HTTP/1.1\r\nHost: x\r\nX-API-Key: {ADMIN_KEY}\r\nContent-Type: application/json\r\n"
    "Content-Length: 100000\r\n\r\n"
).encode()
_KINDS = {
    "half-open": (b"", b""),
    "headers, a byte a second": (b"GET /healthz HTTP/1.1\r\nX-Slow: ", b"x"),
    "body, a byte a second": (_HEAD, b" "),
    "never read": (b"GET /openapi.json HTTP/1.1\r\nHost: x\r\n\r\n" * 16, b""),
}
_GOAL_S = 60.0
_READERS_SHARE = 20
"""One connection in this many never reads: its responses have to be larger than what the kernel keeps, 4 MB."""


def attack(count: int) -> list[FaultRow]:
    """Rows of the table: `count` half-open connections, and as many in each of the other ways."""
    with tempfile.TemporaryDirectory() as folder:
        limits = {"WAYMARK_MAX_CONNECTIONS": "4000", "WAYMARK_MAX_CONNECTIONS_PER_ADDRESS": "4000"}
        server = FaultServer(Path(folder) / "var", settings=limits)
        server.start()
        try:
            closed_after_s, slowest_s, failed = _attack(server, count)
        finally:
            server.stop()
    rows = []
    for kind, times in closed_after_s.items():
        last = f"last after {max(times):.0f} s" if times else "none"
        closed = f"{len(times)} closed, {last}"
        tried = _number_of(kind, count)
        met = len(times) == tried and max(times) <= _GOAL_S
        rows.append(FaultRow(f"connections: {kind}", f"{tried}", closed, f"closed within {_GOAL_S:.0f} s", met))
    answered = f"{failed} failed, slowest {slowest_s * 1000:.0f} ms"
    rows.append(FaultRow("connections: honest requests meanwhile", "10 a second", answered, "0 failed", not failed))
    return rows


def _attack(server: FaultServer, count: int) -> tuple[dict[str, list[float]], float, int]:
    """Seconds after which connections were closed by kind, and the slowest and failed honest requests."""
    selector = selectors.DefaultSelector()
    began = time.monotonic()
    for kind, (head, _) in _KINDS.items():
        for _number in range(_number_of(kind, count)):
            attacker = socket.create_connection(("127.0.0.1", server.port))
            if kind == "never read":
                attacker.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            attacker.sendall(head)
            attacker.setblocking(False)
            selector.register(attacker, selectors.EVENT_READ, (kind, time.monotonic()))
    closed: dict[str, list[float]] = {kind: [] for kind in _KINDS}
    slowest_s, failed, next_byte = 0.0, 0, time.monotonic()
    with httpx.Client(base_url=server.url, trust_env=False, timeout=10) as honest:
        while selector.get_map() and time.monotonic() - began < _GOAL_S + 30:
            if time.monotonic() >= next_byte:
                next_byte += 1.0
                _drip(selector, closed)
            asked = time.monotonic()
            try:
                failed += honest.get("/v1/markers", headers=HEADERS).status_code != 200
            except httpx.HTTPError:
                failed += 1
            slowest_s = max(slowest_s, time.monotonic() - asked)
            _collect(selector, closed)
            time.sleep(0.1)
    for key in list(selector.get_map().values()):
        _socket_of(key).close()
    return closed, slowest_s, failed


def _number_of(kind: str, count: int) -> int:
    return max(1, count // _READERS_SHARE) if kind == "never read" else count


def _drip(selector: selectors.BaseSelector, closed: dict[str, list[float]]) -> None:
    """Send a byte on each connection that sends bytes, and see which of those that never read were reset."""
    for key in list(selector.get_map().values()):
        client = _socket_of(key)
        byte = _KINDS[key.data[0]][1]
        try:
            if byte:
                client.send(byte)
            elif client.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
                _end(selector, key, closed)
        except BlockingIOError:
            pass
        except OSError:
            _end(selector, key, closed)


def _collect(selector: selectors.BaseSelector, closed: dict[str, list[float]]) -> None:
    """Note which connections were ended."""
    for key, _events in selector.select(0):
        if key.data[0] == "never read":
            continue
        with suppress(OSError):
            if _socket_of(key).recv(65536):
                continue  # the answer; the end comes next
        _end(selector, key, closed)


def _end(selector: selectors.BaseSelector, key: selectors.SelectorKey, closed: dict[str, list[float]]) -> None:
    kind, since_s = key.data
    closed[kind].append(time.monotonic() - since_s)
    selector.unregister(key.fileobj)
    _socket_of(key).close()


def _socket_of(key: selectors.SelectorKey) -> socket.socket:
    assert isinstance(key.fileobj, socket.socket)
    return key.fileobj
