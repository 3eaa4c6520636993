"""Attacks on the protocol, without a key: trailers, pipelined requests, connections that are held."""

from __future__ import annotations

import http.client
import json
import socket
import threading
import time
from collections import Counter
from collections.abc import Iterable
from contextlib import ExitStack, suppress

from benchmarks.abuse.attacks import AttackSucceeded, attack
from benchmarks.abuse.server import ObservedServer

ATTACKERS = tuple(f"127.0.0.{number}" for number in range(2, 7))
OTHER = "127.0.0.7"
"""Address of an honest client."""
_TRAILERS = b"GET /healthz HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n"
_HEALTH = b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n"
_UNREAD = b"GET /openapi.json HTTP/1.1\r\nHost: x\r\n\r\n"


def connect(server: ObservedServer, address: str = ATTACKERS[0], *, buffer_bytes: int = 0) -> socket.socket:
    """A connection from an address of this machine; `buffer_bytes` of what it receives wait for it at most, if set."""
    client = socket.socket()
    if buffer_bytes:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer_bytes)
    client.settimeout(60)
    client.bind((address, 0))
    client.connect(("127.0.0.1", server.port))
    return client


def exchange(server: ObservedServer, sent: bytes) -> bytes:
    """What the server answers until it ends the connection, or for 60 s."""
    answer = b""
    with connect(server) as client:
        with suppress(ConnectionError):
            client.sendall(sent)
        with suppress(OSError):
            while part := client.recv(65536):
                answer += part
    return answer


def status_of(answer: bytes) -> str:
    """The status of an answer, or that there is none."""
    return answer[9:12].decode("latin-1") or "no answer"


def ask_as_another(server: ObservedServer, path: str = "/healthz", count: int = 20) -> str:
    """Requests of an honest client on new connections.

    Raises
    ------
    AttackSucceeded
        One was not answered.
    """
    answered, slowest_s = 0, 0.0
    for _ in range(count):
        began_s = time.monotonic()
        client = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10, source_address=(OTHER, 0))
        with suppress(OSError, http.client.HTTPException):
            client.request("GET", path)
            answered += client.getresponse().status == 200
        client.close()
        slowest_s = max(slowest_s, time.monotonic() - began_s)
    text = f"{answered} of {count} of others answered, slowest {slowest_s * 1000:.0f} ms"
    if answered < count:
        raise AttackSucceeded(text)
    return text


def _counted(statuses: Iterable[str]) -> str:
    return ", ".join(f"{number} x {status}" for status, number in sorted(Counter(statuses).items()))


@attack("trailers", cpu_s=0.5, memory_mb=20)
def send_trailers(server: ObservedServer, short: bool) -> str:
    """Trailers without end after a chunked body."""
    with connect(server) as client, suppress(ConnectionError):
        client.sendall(_TRAILERS)
        client.sendall(b"a:b\r\n" * (800_000 if short else 8_000_000))
        return "all were read"
    return "the connection was closed"


@attack("a key in a trailer", cpu_s=0.5, memory_mb=20)
def authenticate_by_trailer(server: ObservedServer, _short: bool) -> str:
    """A key that no proxy has seen among the headers."""
    key = server.client.headers["X-API-Key"].encode()
    head = b"GET /v1/markers HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n"
    status = status_of(exchange(server, head + b"X-API-Key: " + key + b"\r\nConnection: close\r\n\r\n"))
    if status != "401":
        raise AttackSucceeded(f"{status} instead of 401")
    return status


@attack("pipelined requests", cpu_s=2.0, memory_mb=20)
def send_pipelined(server: ObservedServer, short: bool) -> str:
    """Requests in one write, by a client that reads nothing and leaves."""
    count = (1_000_000 if short else 10_000_000) // len(_HEALTH)
    with connect(server) as client:
        client.settimeout(2)
        with suppress(TimeoutError, ConnectionError):
            client.sendall(_HEALTH * count)
    return f"{count} sent"


@attack("pipelined requests, client leaves", cpu_s=4.0, memory_mb=50)
def leave_pipelined(server: ObservedServer, short: bool) -> str:
    """Requests that take a second each, behind each other, by clients that leave at once."""
    key = server.client.headers["X-API-Key"]
    radio = {"interval_s": 0.05, "spreading_factor": 7, "bandwidth_hz": 500_000}
    body = json.dumps({"radio": radio, "receiver": {"sensitivity_dbm": -150.0}, "design_speed_m_s": 0.5})
    head = "POST /v1/radio-checks HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\n"
    slow = f"{head}X-API-Key: {key}\r\nContent-Length: {len(body)}\r\n\r\n{body}".encode()
    clients, each = (2, 20) if short else (5, 200)
    for _ in range(clients):
        with connect(server) as client:
            client.sendall(slow * each)
    return f"{clients} clients, {each} requests each"


@attack("no Host, two, long headers", cpu_s=1.0, memory_mb=20)
def send_odd_headers(server: ObservedServer, _short: bool) -> str:
    """Requests whose headers are refused, each with an answer."""
    end = b"Connection: close\r\n\r\n"
    cases = {
        "no Host": (b"GET /healthz HTTP/1.1\r\n" + end, ("400",)),
        "two Hosts": (b"GET /healthz HTTP/1.1\r\nHost: x\r\nHost: y\r\n" + end, ("400",)),
        "HTTP/1.0": (b"GET /healthz HTTP/1.0\r\n\r\n", ("200",)),
        "long target": (b"GET /" + b"x" * 66_000 + b" HTTP/1.1\r\nHost: x\r\n" + end, ("414",)),
        "long header": (b"GET /healthz HTTP/1.1\r\nHost: x\r\nX: " + b"x" * 80_000 + b"\r\n" + end, ("431",)),
        "10 MB header": (b"GET /healthz HTTP/1.1\r\nHost: x\r\nX: " + b"x" * 10_000_000, ("431",)),
        "many headers": (b"GET /healthz HTTP/1.1\r\nHost: x\r\n" + b"a:b\r\n" * 20_000 + end, ("431",)),
    }
    found = {name: status_of(exchange(server, sent)) for name, (sent, _) in cases.items()}
    text = ", ".join(f"{name}: {status}" for name, status in found.items())
    if any(found[name] not in expected for name, (_, expected) in cases.items()):
        raise AttackSucceeded(text)
    return text


@attack("half-open connections", cpu_s=2.0, memory_mb=30)
def hold_half_open(server: ObservedServer, short: bool) -> str:
    """Connections from five addresses that send nothing, or half a header."""
    with ExitStack() as held:
        for number in range(300 if short else 1_000):
            client = held.enter_context(connect(server, ATTACKERS[number % len(ATTACKERS)]))
            with suppress(ConnectionError):
                client.sendall(b"GET /healthz HTTP/1.1\r\nHost: x\r\n" if number % 2 else b"")
        return ask_as_another(server)


@attack("unread answers", cpu_s=3.0, memory_mb=150)
def read_nothing(server: ObservedServer, short: bool) -> str:
    """Connections from five addresses that ask for 1 MB and do not read."""
    with ExitStack() as held:
        for number in range(200 if short else 1_000):
            address = ATTACKERS[number % len(ATTACKERS)]
            client = held.enter_context(connect(server, address, buffer_bytes=4096))
            with suppress(ConnectionError):
                client.sendall(_UNREAD)
        return ask_as_another(server)


@attack("probes of /readyz", cpu_s=1.0, memory_mb=20)
def probe_readiness(server: ObservedServer, short: bool) -> str:
    """1,200 probes by 60 clients."""
    clients, each = (20, 10) if short else (60, 20)
    statuses: list[str] = []

    def probe() -> None:
        client = http.client.HTTPConnection("127.0.0.1", server.port, timeout=60)
        for _ in range(each):
            try:
                client.request("GET", "/readyz")
                answer = client.getresponse()
                answer.read()
                statuses.append(str(answer.status))
            except (OSError, http.client.HTTPException):
                statuses.append("no answer")
                client.close()
        client.close()

    threads = [threading.Thread(target=probe) for _ in range(clients)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    text = _counted(statuses)
    if set(statuses) != {"200"}:
        raise AttackSucceeded(text)
    return text
