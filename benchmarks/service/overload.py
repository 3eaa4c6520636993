"""What others notice while 64 clients upload at once, and while 200 connections stand still.

The clients upload parts of large files by tus, each of its own file, and one in eight posts frames; a probe in this
process asks for a page of markers all the while. The files have repeated content and are never completed, so that
nothing is measured but their way to the disk. Clients, probe and server share the machine's processors.

Run: python -m benchmarks.service --only overload [--short]
"""

from __future__ import annotations

import multiprocessing
import os
import socket
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import psutil

from app.markers.plate import PlateCode
from benchmarks.faults.server import HEADERS, FaultServer
from benchmarks.http_overhead import frame_1080p

CLIENTS = 64
STANDING = 200
GOAL_P99_MS, GOAL_SLOW_P99_MS, GOAL_MIB = 100.0, 500.0, 300.0
_TUS = {"Tus-Resumable": "1.0.0"}
_BLOCK = bytes(1 << 20)
_PROBE_EVERY_S = 0.05
_SETTINGS = {
    "WAYMARK_KEY_OPEN_UPLOADS": "0",
    "WAYMARK_MAX_CONNECTIONS_PER_ADDRESS": "900",
    "WAYMARK_WARM_DECODERS": "true",
}


@dataclass(slots=True)
class Probe:
    """Requests of somebody else, and what they saw."""

    server: FaultServer
    waits_ms: list[float] = field(default_factory=list)
    statuses: Counter[int] = field(default_factory=Counter)
    peak_mib: float = 0.0

    def run(self, until: threading.Event) -> None:
        """Ask until the event is set."""
        process = psutil.Process(self.server.pid)
        with self.server.client() as client:
            while not until.is_set():
                began = time.perf_counter()
                self.statuses[client.get("/v1/markers?limit=10").status_code] += 1
                self.waits_ms.append(1e3 * (time.perf_counter() - began))
                self.peak_mib = max(self.peak_mib, process.memory_info().rss / 2**20)
                time.sleep(_PROBE_EVERY_S)

    @property
    def p99_ms(self) -> float:
        """[ms]"""
        return float(np.percentile(self.waits_ms, 99)) if self.waits_ms else float("nan")


def tables(short: bool) -> str:
    """The table."""
    lines = ["| load | GET p50 | GET p99 | goal | web memory | statuses of the load | other statuses of the probe |",
             "|---|---|---|---|---|---|---|"]  # fmt: skip
    with tempfile.TemporaryDirectory(prefix="waymark-bench-overload-") as name:
        server = FaultServer(Path(name) / "var", settings=_SETTINGS)
        server.start()
        try:
            _warm(server)
            lines.append(_row("none", server, _idle, 3.0 if short else 20.0, GOAL_P99_MS))
            size = (4 << 20, 128 << 20) if short else (64 << 20, 1 << 30)
            loaded = f"{CLIENTS} clients, files of {size[0] >> 20} MiB and 4 of {size[1] >> 20} MiB"
            lines.append(_row(loaded, server, lambda s: _upload_all(s, size), 0.0, GOAL_P99_MS))
            lines.append(_row(f"{STANDING} slow connections", server, _stand, 5.0 if short else 60.0, GOAL_SLOW_P99_MS))
        finally:
            server.stop()
    load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
    goal = f"Goals: p99 as stated, at most {GOAL_MIB:.0f} MiB, and no status but 2xx, 429 and 503 with Retry-After."
    return "\n".join((*lines, "", f"{goal} Load average at the end: {load}."))


def _row(what: str, server: FaultServer, load: Any, seconds: float, goal_ms: float) -> str:
    probe, until = Probe(server), threading.Event()
    thread = threading.Thread(target=probe.run, args=(until,))
    thread.start()
    statuses = load(server)
    until.wait(seconds)
    if callable(statuses):
        statuses = statuses()
    until.set()
    thread.join()
    shown = ", ".join(f"{status}: {number}" for status, number in sorted(statuses.items())) or "-"
    others = {status: number for status, number in probe.statuses.items() if status != 200}
    return (
        f"| {what} | {np.median(probe.waits_ms):.1f} ms | {probe.p99_ms:.1f} ms | {goal_ms:.0f} ms "
        f"| {probe.peak_mib:.0f} MiB | {shown} | {others or 'none'} |"
    )


def _warm(server: FaultServer) -> None:
    with server.client() as client:
        frame = frame_1080p(1, PlateCode.from_position(8.4, 49.0))
        client.post("/v1/decodes", content=frame, headers={"Content-Type": "image/jpeg"}, timeout=300)


def _idle(_server: FaultServer) -> Counter[str]:
    return Counter()


# --- uploads ----------------------------------------------------------------------------------------------------------


def _upload_all(server: FaultServer, size: tuple[int, int]) -> Counter[str]:
    """All clients in a process of their own; each writes its file once."""
    context = multiprocessing.get_context("spawn")
    results: Any = context.SimpleQueue()
    process = context.Process(target=_clients, args=(server.url, size, results))
    process.start()
    found: Counter[str] = results.get()
    process.join()
    return found


def _clients(url: str, size: tuple[int, int], results: Any) -> None:
    statuses: Counter[str] = Counter()
    frame = frame_1080p(2, PlateCode.from_position(8.4, 49.0))
    threads = [
        threading.Thread(target=_frames if k % 8 == 7 else _file, args=(url, size[k < 4], statuses, frame))
        for k in range(CLIENTS)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    results.put(statuses)


def _note(response: httpx.Response, statuses: Counter[str]) -> None:
    refused = response.status_code in (429, 503)
    name = str(response.status_code) + (
        " without Retry-After" if refused and "retry-after" not in response.headers else ""
    )
    statuses[name] += 1


def _file(url: str, size: int, statuses: Counter[str], _frame: bytes) -> None:
    """One file but for its last byte, so that it never becomes a decode; then it is given up."""
    with httpx.Client(base_url=url, headers=HEADERS | _TUS, trust_env=False, timeout=300) as client:
        started = client.post("/v1/uploads", headers={"Upload-Length": str(size + 1)})
        _note(started, statuses)
        if started.status_code != 201:
            return
        place = started.headers["Location"]
        headers = {"Upload-Offset": "0", "Content-Type": "application/offset+octet-stream", "Content-Length": str(size)}
        with suppress(httpx.TransportError):
            _note(client.patch(place, content=_blocks(size), headers=headers), statuses)
            client.delete(place)
            return
        statuses["connection lost"] += 1


def _blocks(size: int) -> Iterator[bytes]:
    for _ in range(size // len(_BLOCK)):
        yield _BLOCK


def _frames(url: str, _size: int, statuses: Counter[str], frame: bytes) -> None:
    with httpx.Client(base_url=url, headers=HEADERS, trust_env=False, timeout=300) as client:
        for _ in range(10):
            _note(client.post("/v1/decodes", content=frame, headers={"Content-Type": "image/jpeg"}), statuses)


# --- slow connections -------------------------------------------------------------------------------------------------


def _stand(server: FaultServer) -> Any:
    """Half of the connections send nothing after the first line, half a byte of a body each second."""
    raw = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(STANDING)]
    key = HEADERS["X-API-Key"]
    for number, connection in enumerate(raw):
        head = f"POST /v1/decodes HTTP/1.1\r\nHost: x\r\nX-API-Key: {key}\r\n"
        if number % 2:
            head += "Content-Type: image/jpeg\r\nContent-Length: 1000000\r\n\r\n"
        connection.sendall(head.encode())
    ended = threading.Event()

    def drip() -> None:
        while not ended.wait(1.0):
            for connection in raw[1::2]:
                with suppress(OSError):
                    connection.send(b"x")

    thread = threading.Thread(target=drip)
    thread.start()

    def finish() -> Counter[str]:
        ended.set()
        thread.join()
        for connection in raw:
            connection.close()
        return Counter()

    return finish
