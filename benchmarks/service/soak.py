"""An hour of mixed load: memory, open files, threads and temporary files of the service must not grow.

Clients upload frames, recordings and ZIPs, read markers and searches, and export, at a steady rate. Every half minute
the processes of the service are looked at. After a first sixth of the time, in which caches and pools fill, a straight
line is fitted to each count.

Run: python -m benchmarks.service --only soak [--minutes 60]
"""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import httpx
import numpy as np
import psutil

from benchmarks.http_overhead import LAT_DEG, LON_DEG
from benchmarks.service.throughput import context_headers, make_frames, service, zip_of

EVERY_S = 30.0
WARM_SHARE = 1 / 6


@dataclass(frozen=True, slots=True)
class Sample:
    """The service at one moment."""

    at_s: float
    # `web_mb`, `children_mb`: [MB] Resident memory of the web process, and of its decoder processes together
    web_mb: float
    children_mb: float
    # `files`, `threads`: open files and threads of the web process
    files: int
    threads: int
    temporary: int  # files in the folder for uploads on their way


def look_at(pid: int, folder: Path, began_s: float) -> Sample:
    """Measure the processes of a server."""
    web = psutil.Process(pid)
    children = sum(child.memory_info().rss for child in web.children(recursive=True))
    stored = {"blobs", "uploads", "pictures", "owners"}
    loose = [path for path in folder.rglob("*") if path.is_file() and not stored & set(path.parts)]
    return Sample(
        time.monotonic() - began_s, web.memory_info().rss / 1e6, children / 1e6, web.num_fds(), web.num_threads(),
        len(loose),
    )  # fmt: skip


def growth_per_h(samples: Sequence[Sample], name: str) -> float:
    """Slope of a straight line through a count after the warm-up, for an hour."""
    kept = [sample for sample in samples if sample.at_s >= WARM_SHARE * samples[-1].at_s]
    at_h = np.array([sample.at_s for sample in kept]) / 3600
    return float(np.polyfit(at_h, [getattr(sample, name) for sample in kept], 1)[0])


def run(minutes: float, requests_per_s: float) -> tuple[list[Sample], int]:
    """Samples, and the number of requests that were sent; an answer of 500 or more ends the run with an error."""
    frames, trace = make_frames(), Path("docs/images/drive.zip").read_bytes()
    archive = zip_of(frames, 4)
    samples: list[Sample] = []
    with TemporaryDirectory() as folder, service(Path(folder) / "data", "embedded") as server:
        began = time.monotonic()
        looked, sent = -EVERY_S, 0
        with server.client() as client:
            for number in itertools.count():
                now = time.monotonic() - began
                if now > 60 * minutes:
                    break
                if now - looked >= EVERY_S:
                    looked = now
                    samples.append(look_at(server.pid, server.folder, began))
                answer = _send(client, number, frames, trace, archive)
                sent += 1
                if answer.status_code >= 500 and answer.status_code != 503:
                    raise RuntimeError(f"{answer.status_code}: {answer.text[:300]}")
                time.sleep(max(0.0, sent / requests_per_s - (time.monotonic() - began)))
        samples.append(look_at(server.pid, server.folder, began))
    return samples, sent


def _send(client: httpx.Client, number: int, frames: Sequence[bytes], trace: bytes, archive: bytes) -> httpx.Response:
    kind = number % 10
    if kind in (0, 1, 2, 3):
        return client.post("/v1/decodes", content=frames[number % len(frames)], headers=context_headers("image/jpeg"))
    if kind == 4 and number % 40 == 4:
        return client.post(
            "/v1/decodes", content=trace,
            headers={"Content-Type": "application/zip", "Waymark-Context": json.dumps({"trace": {}})},
        )  # fmt: skip
    if kind == 5 and number % 20 == 5:
        return client.post("/v1/decodes", content=archive, headers=context_headers("application/zip"))
    if kind == 6:
        return client.get("/v1/exports/markers.csv") if number % 30 == 6 else client.get("/v1/decodes?limit=5")
    if kind == 7:
        return client.post("/v1/decodes", content=b"not a picture", headers=context_headers("image/jpeg"))
    box = f"{LON_DEG - 0.01},{LAT_DEG - 0.01},{LON_DEG + 0.01},{LAT_DEG + 0.01}"
    return client.get("/v1/markers", params={"bbox": box})


def tables(minutes: float, requests_per_s: float = 4.0) -> str:
    """The table as Markdown."""
    samples, sent = run(minutes, requests_per_s)
    first = next(sample for sample in samples if sample.at_s >= WARM_SHARE * samples[-1].at_s)
    lines = [
        f"{sent} requests in {minutes:g} minutes",
        "",
        "| what | after the warm-up | at the end | growth an hour |",
        "|---|---|---|---|",
    ]
    names = {"web_mb": "memory of the web process [MB]", "children_mb": "memory of its children [MB]",
             "files": "open files", "threads": "threads", "temporary": "files outside the store"}  # fmt: skip
    for name, text in names.items():
        at = [getattr(sample, name) for sample in (first, samples[-1])]
        lines.append(f"| {text} | {at[0]:.0f} | {at[1]:.0f} | {growth_per_h(samples, name):+.1f} |")
    return "\n".join(lines)
