"""Throughput of the service beside two bare decoder processes on the same cores, for frames and traces.

Bare is two processes that hold the files in memory and call the decoder, nothing else. The service decodes the same
files: as single requests of clients that keep their connections, and as jobs (ZIPs of frames, long recordings), on each
engine. Clients run on the same cores; the processor time that they take is in the table as their share.

Run: python -m benchmarks.service --only throughput [--short]
"""

from __future__ import annotations

import io
import json
import multiprocessing
import os
import sys
import tempfile
import threading
import time
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.synchronize import Barrier
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np

from app.decoders.plate.reader import decode_plates
from app.formats.format import SpooledFile
from app.formats.images import load_image
from app.jobs.decoder_process import ONE_THREAD, keep_memory
from app.markers.plate import EXPECTED_GEOMETRIES, PlateCode
from app.sensors.camera import Camera
from app.services.decodes.trace_tasks import decode_recording
from benchmarks.faults.server import FaultServer
from benchmarks.http_overhead import CAMERA, LAT_DEG, LON_DEG, STEP_DEG, frame_1080p
from benchmarks.service.processor_time import ProcessorTime, counted

PROCESSES = 2
_CAMERA = {"horizontal_fov_deg": 70.0, "width_px": 1920, "height_px": 1080}
_CONTEXT = {"coarse_position": {"lon_deg": LON_DEG, "lat_deg": LAT_DEG, "accuracy_m": 15.0}, "camera": _CAMERA}
_REGISTERED = 5


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table."""

    what: str
    per_s: float  # [1/s] files decoded in a second
    client_share: float = 0.0  # processor time of the clients over that of both cores
    bare_ms: float = 0.0  # [ms] processor time of a bare process for a file
    files: int = 0
    spent: ProcessorTime | None = None  # of the parts of the service, for all files

    def processor_ms(self) -> str:
        """Processor time of each part for a file."""
        return f"{self.bare_ms:.2f}" if self.spent is None else self.spent.per_file(self.files)

    def decoder_share(self, bare: Row) -> float:
        """Processor time of bare decoding over that of the service: what the ratio is where no core waits."""
        return 1.0 if self.spent is None else bare.bare_ms * self.files / (1e3 * self.spent.service_s)


# --- bare -------------------------------------------------------------------------------------------------------------


def _codebook() -> list[PlateCode]:
    return [PlateCode.from_position(LON_DEG + k * STEP_DEG, LAT_DEG) for k in range(_REGISTERED)]


def make_frames() -> list[bytes]:
    """Eight JPEGs of 1080p: six with a plate, two without."""
    code = _codebook()[0]
    frames = [frame_1080p(seed, code) for seed in range(6)]
    rng = np.random.default_rng(99)
    for _ in range(2):
        empty = rng.normal(100, 6, (1080, 1920, 3)).clip(0, 255).astype(np.uint8)
        blurred = cv2.GaussianBlur(empty, (0, 0), 1.2)
        frames.append(bytes(cv2.imencode(".jpg", blurred, [cv2.IMWRITE_JPEG_QUALITY, 90])[1]))
    return frames


def _bare_frames(files: Sequence[bytes]) -> Callable[[bytes], object]:
    codebook = _codebook()
    camera: Camera = CAMERA

    def decode(data: bytes) -> object:
        pixels = load_image(data).pixels
        return decode_plates(pixels, codebook=codebook, camera=camera, geometries=EXPECTED_GEOMETRIES)

    for data in files:
        decode(data)
    return decode


def _bare_traces(files: Sequence[bytes]) -> Callable[[bytes], object]:
    def decode(data: bytes) -> object:
        return decode_recording("drive.zip", SpooledFile.of(data))

    decode(files[0])
    return decode


def _bare_process(kind: str, files: Sequence[bytes], count: int, barrier: Barrier, spent: Any) -> None:
    cv2.setNumThreads(1)
    keep_memory()
    decode = {"frames": _bare_frames, "traces": _bare_traces}[kind](files)
    barrier.wait()
    began = time.process_time()
    for k in range(count):
        decode(files[k % len(files)])
    spent.put(time.process_time() - began)
    barrier.wait()


def measure_bare(kind: str, files: Sequence[bytes], count: int) -> Row:
    """Two processes, each with half of the files."""
    context = multiprocessing.get_context("spawn")
    barrier = context.Barrier(PROCESSES + 1, timeout=600)
    spent: Any = context.SimpleQueue()
    arguments = (kind, files, count // PROCESSES, barrier, spent)
    workers = [context.Process(target=_bare_process, args=arguments) for _ in range(PROCESSES)]
    for worker in workers:
        worker.start()
    barrier.wait()
    began = time.perf_counter()
    barrier.wait()
    took = time.perf_counter() - began
    for worker in workers:
        worker.join()
    used = sum(spent.get() for _ in range(PROCESSES))
    return Row(f"two bare processes, {kind}", count / took, bare_ms=1e3 * used / count)


# --- the service ------------------------------------------------------------------------------------------------------


@contextmanager
def service(folder: Path, engine: str) -> Iterator[FaultServer]:
    """A server, and with Celery a worker beside it, which then decodes all jobs."""
    settings = {"WAYMARK_WARM_DECODERS": "true", "WAYMARK_KEY_PROCESSOR_S_PER_MIN": "0",
                "WAYMARK_AGENCY_PROCESSOR_S_PER_MIN": "0", "WAYMARK_EXPENSIVE_AT_ONCE": "64",
                "WAYMARK_EXPENSIVE_PER_AGENCY": "64"}  # fmt: skip
    url = ""
    if engine == "celery":
        url = os.environ["WAYMARK_BENCH_POSTGRES_URL"]
        settings |= {"WAYMARK_BROKER_URL": os.environ["WAYMARK_BENCH_BROKER_URL"], "WAYMARK_BLOBS_SHARED": "true"}
    server = FaultServer(folder, url, settings)
    server.start()
    try:
        if engine == "celery":
            server.start_worker()
        with server.client() as client:
            for k in range(_REGISTERED):
                position = {"lon_deg": LON_DEG + k * STEP_DEG, "lat_deg": LAT_DEG, "horizontal_rmse_m": 0.01}
                client.post("/v1/markers", json={"position": position, "heading_deg": 90.0, "status": "surveyed"})
        yield server
    finally:
        server.stop()


def _post_all(server: FaultServer, bodies: Sequence[bytes], headers: dict[str, str], clients: int, count: int) -> None:
    """Clients that keep their connections, each sending its next file when the last one is decoded."""
    numbers = iter(range(count))
    lock = threading.Lock()
    failed: list[str] = []

    def send() -> None:
        with server.client() as client:
            while not failed:
                with lock:
                    number = next(numbers, None)
                if number is None:
                    return
                answer = client.post("/v1/decodes", content=bodies[number % len(bodies)], headers=headers)
                if answer.status_code != 201:
                    failed.append(answer.text[:300])

    threads = [threading.Thread(target=send) for _ in range(clients)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if failed:
        raise RuntimeError(failed[0])


def measure_requests(
    server: FaultServer, what: str, bodies: Sequence[bytes], headers: dict[str, str], clients: int, count: int
) -> Row:
    """Single requests, each answered with its decode."""
    _post_all(server, bodies, headers, clients, 2 * clients)
    with counted(server) as spent:
        began = time.perf_counter()
        _post_all(server, bodies, headers, clients, count)
        took = time.perf_counter() - began
    share = spent.clients / (PROCESSES * took)
    return Row(f"{what}, {clients} clients that wait", count / took, share, files=count, spent=spent)


def measure_jobs(server: FaultServer, what: str, archives: Sequence[bytes], headers: dict[str, str], each: int) -> Row:
    """Jobs, from the first upload to the last result."""
    with server.client() as client:
        _wait(client, [client.post("/v1/decodes", content=archives[0], headers=headers).json()["id"]])
        with counted(server) as spent:
            began = time.perf_counter()
            answers = [client.post("/v1/decodes", content=archive, headers=headers) for archive in archives]
            for answer in answers:
                if answer.status_code != 202:
                    raise RuntimeError(answer.text[:300])
            _wait(client, [answer.json()["id"] for answer in answers])
            took = time.perf_counter() - began
    files, share = len(archives) * each, spent.clients / (PROCESSES * took)
    return Row(what, files / took, share, files=files, spent=spent)


def _wait(client: httpx.Client, ids: Sequence[str]) -> None:
    for decode_id in ids:
        while (head := client.get(f"/v1/decodes/{decode_id}").json())["state"] in ("queued", "running"):
            time.sleep(0.1)
        if head["state"] != "done":
            raise RuntimeError(json.dumps(head)[:500])


def context_headers(media_type: str) -> dict[str, str]:
    """Headers of a bare file of the camera above."""
    return {"Content-Type": media_type, "Waymark-Context": json.dumps(_CONTEXT)}


def zip_of(frames: Sequence[bytes], count: int) -> bytes:
    """An archive of frames, stored as they are: JPEGs do not get smaller."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for k in range(count):
            archive.writestr(f"{k:05d}.jpg", frames[k % len(frames)])
    return file.getvalue()


# --- the table --------------------------------------------------------------------------------------------------------


def measure(short: bool, engines: Sequence[str]) -> list[tuple[Row, Row]]:
    """Rows, each with the one of the bare processes of the same run."""
    os.environ.update(ONE_THREAD)
    frames, trace = make_frames(), Path("docs/images/drive.zip").read_bytes()
    count, traces = (80, 8) if short else (800, 240)
    headers, zipped = context_headers("image/jpeg"), context_headers("application/zip")
    recorded = {"Content-Type": "application/zip", "Waymark-Context": json.dumps({"trace": {}})}
    rows: list[tuple[Row, Row]] = []

    def add(row: Row, bare: Row) -> None:
        rows.append((row, bare))
        ratios = f"{row.per_s / bare.per_s:6.1%}  clients {row.client_share:.1%}"
        processor = f"processor {row.processor_ms()} ms  {row.decoder_share(bare):.1%}"
        print(f"{row.what:55s} {row.per_s:8.1f} /s  {ratios}  {processor}", file=sys.stderr, flush=True)

    for engine in engines:
        with tempfile.TemporaryDirectory() as folder, service(Path(folder) / "data", engine) as server:
            bare = measure_bare("frames", frames, count)
            add(bare, bare)
            each = count // 4
            archives = [zip_of(frames, each)] * 4
            add(measure_jobs(server, f"{engine}: ZIPs of {each} frames as jobs", archives, zipped, each), bare)
            for clients in (2, 4, 8) if not short else (4,):
                add(measure_requests(server, f"{engine}: single frames", frames, headers, clients, count), bare)
            bare = measure_bare("traces", [trace], traces)
            add(bare, bare)
            add(measure_requests(server, f"{engine}: single traces", [trace], recorded, 4, traces), bare)
    return rows


def tables(short: bool, engines: Sequence[str] = ("embedded", "celery")) -> str:
    """The table as Markdown."""
    lines = [
        "| what | files/s | of two bare processes | clients' share of the cores "
        "| processor time a file: decoders + server + database + clients | of it bare decoding |",
        "|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row.what} | {row.per_s:.1f} | {row.per_s / bare.per_s:.0%} | {row.client_share:.0%} "
        f"| {row.processor_ms()} ms | {row.decoder_share(bare):.0%} |"
        for row, bare in measure(short, engines)
    ]
    load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
    return "\n".join(
        (*lines, "", f"Bare decoding: the processor time that the bare processes take. Load average: {load}.")
    )


def main(arguments: Sequence[str] = sys.argv[1:]) -> Any:
    """Print the table."""
    print(tables("--short" in arguments, [name for name in arguments if not name.startswith("-")] or ["embedded"]))


if __name__ == "__main__":
    main()
