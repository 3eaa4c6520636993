"""What an upload over HTTP costs beyond the decoder: the same frames bare and through a real server.

Bare is JPEG bytes to readings in one warm thread that keeps its memory as the decoder processes do. Over HTTP the same
bytes go through a kept-alive connection to `waymark serve`: key check, form, decoder process, registry, one durable
transaction. They take turns in changing order, frame by frame: a busy machine slows all, and who comes after the bare
decoder finds the caches full of its pixels. The difference of the medians is the overhead. What durability alone costs
stands below: one row of the same size through sqlite3, committed in a file on the same disk.

Run: python -m benchmarks.http_overhead [--frames N] [--registered N] [--limit-ms 5]
"""

from __future__ import annotations

import argparse
import http.client
import json
import os
import sqlite3
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from app.decoders.plate.reader import decode_plates
from app.demo.server import free_ports
from app.formats.images import load_image
from app.jobs.decoder_process import keep_memory
from app.markers.plate import EXPECTED_GEOMETRIES, PlateCode
from app.sensors.camera import Camera

KEY = "benchmark-key-that-is-long-enough"
LON_DEG, LAT_DEG = 8.412345, 49.012345
CAMERA = Camera.from_field_of_view(1920, 1080, 70.0)
STEP_DEG = 0.000271
WARM_UP = 8


def frame_1080p(seed: int, code: PlateCode) -> bytes:
    """JPEG of asphalt with one plate flat to the camera: the decoder's share does not matter here."""
    rng = np.random.default_rng(seed)
    frame = rng.normal(100, 6, (1080, 1920, 3)).clip(0, 255).astype(np.uint8)
    frame = np.asarray(cv2.GaussianBlur(frame, (0, 0), 1.2), np.uint8)
    pitch, gap = 16, 2
    side = code.n * pitch + gap
    plate = np.full((side, side, 3), 230, np.uint8)
    for row, column in np.argwhere(code.units):
        plate[gap + row * pitch : (row + 1) * pitch, gap + column * pitch : (column + 1) * pitch] = 25
    far = side - 2 * pitch
    for y, x in ((gap, far), (far, far), (far, gap)):
        plate[y : y + 2 * pitch - gap, x : x + 2 * pitch - gap] = (60, 160, 30)
    corner = np.array([[gap, gap], [2 * pitch, gap], [gap, 2 * pitch]], np.int32)
    cv2.fillPoly(plate, [corner], (40, 40, 200))
    frame[600 : 600 + side, 800 : 800 + side] = plate
    encoded = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, 90])[1]
    return bytes(encoded)


class Server:
    """`waymark serve` in a process of its own, on a free port."""

    def __init__(self, folder: Path) -> None:
        (self.port,) = free_ports(1)
        self._environment = os.environ | {
            "WAYMARK_DATA_DIR": str(folder),
            "WAYMARK_ADMIN_KEY": KEY,
            "WAYMARK_REQUESTS_PER_S": "0",
            "WAYMARK_LOG_FORMAT": "json",
        }

    def __enter__(self) -> http.client.HTTPConnection:
        command = [sys.executable, "-c", "from app.cli import main; main()", "serve", "--port", str(self.port)]
        self._log = tempfile.TemporaryFile()
        self._process = subprocess.Popen(command, env=self._environment, stdout=self._log, stderr=self._log)
        self._connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=300)
        deadline = time.monotonic() + 120
        while True:
            try:
                self._connection.connect()
                return self._connection
            except ConnectionRefusedError:
                if time.monotonic() > deadline or self._process.poll() is not None:
                    raise
                time.sleep(0.05)

    def __exit__(self, *_: object) -> None:
        self._connection.close()
        self._process.terminate()
        self._process.wait(60)
        self._log.close()


def request(connection: http.client.HTTPConnection, path: str, body: bytes, headers: dict[str, str]) -> bytes:
    """Post and read the whole answer, on the connection that stays open."""
    connection.request("POST", path, body, headers | {"Authorization": f"Bearer {KEY}"})
    answer = connection.getresponse()
    content = answer.read()
    if answer.status != 201:
        raise SystemExit(f"{path} answered {answer.status}: {content[:500]!r}")
    return content


def register(connection: http.client.HTTPConnection, count: int) -> None:
    """Plates along a road, 20 m apart; the first is the one in the frames."""
    for k in range(count):
        position = {"lon_deg": LON_DEG + k * STEP_DEG, "lat_deg": LAT_DEG, "horizontal_rmse_m": 0.01}
        body = json.dumps({"position": position, "heading_deg": 90.0, "status": "surveyed"}).encode()
        request(connection, "/v1/markers", body, {"Content-Type": "application/json"})


def uploads(data: bytes, context: dict[str, Any]) -> dict[str, tuple[bytes, dict[str, str]]]:
    """Body and headers of both ways to upload a frame, made before the clock runs."""
    text, edge = json.dumps(context), "frame-boundary"
    form = (
        f'--{edge}\r\nContent-Disposition: form-data; name="context"\r\n\r\n{text}\r\n--{edge}\r\n'
        'Content-Disposition: form-data; name="file"; filename="f.jpg"\r\nContent-Type: image/jpeg\r\n\r\n'
    ).encode() + data
    form += f"\r\n--{edge}--\r\n".encode()
    return {
        "form": (form, {"Content-Type": f"multipart/form-data; boundary={edge}"}),
        "bare body": (data, {"Content-Type": "image/jpeg", "Waymark-Context": text}),
    }


class Durable:
    """One row in one transaction, as SQLite makes it durable (WAL, synchronous FULL), without anything of ours."""

    def __init__(self, folder: Path) -> None:
        self._connection = sqlite3.connect(folder / "durable.sqlite3", isolation_level=None)
        self._connection.execute("PRAGMA journal_mode = WAL")
        self._connection.execute("PRAGMA synchronous = FULL")
        self._connection.execute("CREATE TABLE result (content TEXT)")

    def commit(self) -> None:
        """Write it."""
        self._connection.execute("BEGIN IMMEDIATE")
        self._connection.execute("INSERT INTO result VALUES (?)", ("x" * 4000,))
        self._connection.execute("COMMIT")


def measure(folder: Path, frames: int, registered: int) -> dict[str, list[float]]:
    """Times of each way by name. [ms]"""
    codebook = [PlateCode.from_position(LON_DEG + k * STEP_DEG, LAT_DEG) for k in range(registered)]
    pictures = [frame_1080p(seed, codebook[0]) for seed in range(4)]
    camera = {"horizontal_fov_deg": 70.0, "width_px": 1920, "height_px": 1080}
    context = {"coarse_position": {"lon_deg": LON_DEG, "lat_deg": LAT_DEG, "accuracy_m": 15.0}, "camera": camera}
    print(f"{frames} frames of {len(pictures[0]) // 1024} KiB, {registered} plates registered")

    def decode_bare(data: bytes) -> None:
        decode_plates(load_image(data).pixels, codebook=codebook, camera=CAMERA, geometries=EXPECTED_GEOMETRIES)

    decode_bare(pictures[0])  # compiles the kernels, if need be, before the server waits for a request
    durable, times = Durable(folder), defaultdict(list)
    with Server(folder) as connection:
        register(connection, registered)
        for k in range(frames + WARM_UP):
            data, took, told = pictures[k % len(pictures)], {}, []
            sent = uploads(data, context)
            ways = [("bare", None), *sent.items()]
            for name, upload in ways[k % 3 :] + ways[: k % 3]:
                began = time.perf_counter()
                if upload is None:
                    decode_bare(data)
                    took[name] = time.perf_counter() - began
                else:
                    answer = request(connection, "/v1/decodes", *upload)
                    took[name] = time.perf_counter() - began
                    frame = json.loads(answer)["frames"][0]
                    told.append((frame["load_ms"] + frame["decode_ms"]) / 1e3)
            took["server: load + decode"] = statistics.mean(told)
            began = time.perf_counter()
            durable.commit()
            took["one durable row alone"] = time.perf_counter() - began
            if k >= WARM_UP:
                for name, seconds in took.items():
                    times[name].append(1e3 * seconds)
    return times


def main() -> int:
    """Print one table; the exit status says whether the limit was kept."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--registered", type=int, default=5)
    parser.add_argument("--limit-ms", type=float, default=5.0)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    keep_memory()
    with tempfile.TemporaryDirectory() as folder:
        times = measure(Path(folder), arguments.frames, arguments.registered)
    tenths = {name: statistics.quantiles(values, n=10) for name, values in times.items()}
    for name in ("bare", "form", "bare body", "server: load + decode", "one durable row alone"):
        low, middle, high = tenths[name][0], statistics.median(times[name]), tenths[name][-1]
        print(f"  {name:24s} p10 {low:7.2f} ms   median {middle:7.2f} ms   p90 {high:7.2f} ms")
    kept = True
    for name in ("form", "bare body"):
        low = tenths[name][0] - tenths["bare"][0]
        middle = statistics.median(times[name]) - statistics.median(times["bare"])
        kept &= middle <= arguments.limit_ms
        print(f"  overhead, {name:14s} p10 {low:7.2f} ms   median {middle:7.2f} ms   (limit {arguments.limit_ms:g} ms)")
    return 0 if kept else 1


if __name__ == "__main__":
    raise SystemExit(main())
