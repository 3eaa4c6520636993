"""Damaged and hostile files of all formats through the real upload routes, on each engine.

Every file is sent to the route of its kind. What the answers and the jobs are is counted; a status of 500 or above
(503 with Retry-After is repeated), a job beyond its time limit, and a process above 1.5 GB are failures.

Run: python -m benchmarks.service --only malformed [--short]; on Celery too with WAYMARK_BENCH_POSTGRES_URL and
WAYMARK_BENCH_BROKER_URL.
"""

from __future__ import annotations

import io
import json
import os
import random
import struct
import tempfile
import threading
import time
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import psutil

from benchmarks.faults.server import FaultServer
from benchmarks.fuzz.frames import _damaged
from benchmarks.fuzz.parsers import list_parsers
from benchmarks.fuzz.pictures import list_pictures
from benchmarks.service.throughput import service

GOAL_MIB = 1536.0
JOB_LIMIT_S = 330.0
"""Longest time of a job. [s] Source: `trace_timeout_s`, and a tenth for its start."""
_RAW = {"Content-Type": "application/octet-stream"}
_CONTEXTS: dict[str, dict[str, dict[str, object]]] = {"traces": {"trace": {}}, "packets": {"packets": {}}}


@dataclass(slots=True)
class Outcome:
    """What came of the files of one format."""

    files: int = 0
    statuses: Counter[str] = field(default_factory=Counter)
    jobs: Counter[str] = field(default_factory=Counter)
    slowest_s: float = 0.0  # [s] longest time from the request to the end of its job
    slowest: int = 0  # number of that file in `make_files`
    failures: list[str] = field(default_factory=list)


def hostile_files() -> Iterator[tuple[str, bytes]]:
    """Files that are built to harm: lists of other files, bombs, headers that lie. Each with the route of its kind."""
    yield "archives", b"ffconcat version 1.0\nfile other.avi\n"
    yield "archives", b"#EXTM3U\n#EXTINF:10,\nfile:///etc/passwd\n"
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.png", bytes(64 << 20))
    yield "archives", packed.getvalue()
    yield "traces", packed.getvalue()
    yield "packets", packed.getvalue()
    yield "surveys", packed.getvalue()
    yield (
        "image-headers",
        b"\x89PNG\r\n\x1a\n"
        + _chunk(b"IHDR", struct.pack(">IIBBBBB", 64, 64, 8, 2, 0, 0, 0))
        + (struct.pack(">I", 3_670_000_000) + b"IDAT" + bytes(2000)),
    )
    huge = _chunk(b"IHDR", struct.pack(">IIBBBBB", 60_000, 60_000, 8, 0, 0, 0, 0))
    yield (
        "image-headers",
        b"\x89PNG\r\n\x1a\n" + huge + _chunk(b"IDAT", zlib.compress(bytes(100_000))) + _chunk(b"IEND", b""),
    )
    for text in (b'{"a":' * 100_000, b"[" * 100_000, b"\x00" * 100_000, b"9" * 100_000, b"nan,1e999\n" * 1000):
        yield from ((kind, text) for kind in ("packets", "traces", "surveys", "alignments"))


def _chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


def make_files(count: int, seed: int) -> list[tuple[str, bytes]]:
    """The hostile files, and damaged or truncated copies of sound ones, as many of each format."""
    rng = random.Random(seed)
    seeds = {parser.name: parser.seeds for parser in list_parsers()}
    kinds = {name: seeds[name] for name in ("traces", "archives", "packets", "surveys", "alignments")}
    kinds["image-headers"] = list_pictures()
    found = list(hostile_files())
    while len(found) < count:
        for kind, sound in kinds.items():
            data = rng.choice(list(sound))
            found.append((kind, data[: rng.randrange(len(data))] if rng.random() < 0.3 else _damaged(data, rng)))
    return found[:count]


def tables(short: bool, engines: tuple[str, ...] = ("embedded",)) -> str:
    """One table for all engines."""
    lines = ["| engine | format | files | statuses | jobs | slowest | failures |", "|---|---|---|---|---|---|---|"]
    peaks = []
    for engine in engines:
        folder = tempfile.TemporaryDirectory(prefix="waymark-bench-malformed-")
        with folder as name, service(Path(name) / "var", engine) as server:
            outcomes, peak_mib = attack(server, make_files(60 if short else 480, seed=1500))
        peaks.append(f"{engine} {peak_mib:.0f} MiB")
        for kind, found in sorted(outcomes.items()):
            counted = [
                ", ".join(f"{k}: {n}" for k, n in sorted(c.items())) or "-" for c in (found.statuses, found.jobs)
            ]
            lines.append(
                f"| {engine} | {kind} | {found.files} | {counted[0]} | {counted[1]} | {found.slowest_s:.1f} s "
                f"(file {found.slowest}) "
                f"| {len(found.failures)} |"
            )
            lines += [f"|  | {failure[:200]} |  |  |  |  |  |" for failure in found.failures[:5]]
    load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
    return "\n".join((*lines, "", f"Largest process: {', '.join(peaks)} (limit {GOAL_MIB:.0f}). Load average: {load}."))


def attack(server: FaultServer, files: list[tuple[str, bytes]]) -> tuple[dict[str, Outcome], float]:
    """Send files one after the other; returns the outcomes by format, and the most memory of a process. [MiB]"""
    outcomes: dict[str, Outcome] = {}
    ended, peak = threading.Event(), [0.0]
    watcher = threading.Thread(target=_watch, args=(server, ended, peak))
    watcher.start()
    try:
        with server.client() as client:
            client.timeout = httpx.Timeout(400)
            for number, (kind, data) in enumerate(files):
                _send(client, kind, data, number, outcomes.setdefault(kind, Outcome()))
    finally:
        ended.set()
        watcher.join()
    return outcomes, peak[0]


def _watch(server: FaultServer, ended: threading.Event, peak: list[float]) -> None:
    while not ended.wait(0.05):
        for process in [child for pid in server.pids() for child in psutil.Process(pid).children(recursive=True)]:
            try:
                peak[0] = max(peak[0], process.memory_info().rss / 2**20)
            except psutil.NoSuchProcess:
                continue


def _send(client: httpx.Client, kind: str, data: bytes, number: int, found: Outcome) -> None:
    found.files += 1
    began = time.monotonic()
    response = _post(client, kind, data)
    while response.status_code == 503 and "retry-after" in response.headers and time.monotonic() - began < JOB_LIMIT_S:
        time.sleep(1)
        response = _post(client, kind, data)
    found.statuses[str(response.status_code)] += 1
    if response.status_code >= 500:
        found.failures.append(f"{response.status_code} {response.text[:150]}")
    if response.status_code == 202:
        found.jobs[_wait(client, response.headers["Location"], began, found)] += 1
    if (took := time.monotonic() - began) > found.slowest_s:
        found.slowest_s, found.slowest = took, number


def _post(client: httpx.Client, kind: str, data: bytes) -> httpx.Response:
    if kind in ("surveys", "alignments"):
        declaration: dict[str, Any] = {"name": os.urandom(6).hex()} if kind == "alignments" else {"dry_run": True}
        parts: dict[str, tuple[str | None, bytes | str] | tuple[str | None, bytes | str, str]]
        parts = {"file": ("file", data), "declaration": (None, json.dumps(declaration), "application/json")}
        return client.post("/v1/imports" if kind == "surveys" else "/v1/alignments", files=parts)
    headers = {**_RAW, "Waymark-Context": json.dumps(_CONTEXTS.get(kind, {}))}
    return client.post("/v1/decodes", content=data, headers=headers)


def _wait(client: httpx.Client, place: str, began: float, found: Outcome) -> str:
    while time.monotonic() - began < JOB_LIMIT_S:
        document = client.get(place).json()
        if document["state"] not in ("queued", "running"):
            return str(document["state"])
        time.sleep(0.2)
    found.failures.append(f"the job at {place} is {document['state']} after {JOB_LIMIT_S:g} s")
    return str(document["state"])
