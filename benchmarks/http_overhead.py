"""What an upload over HTTP costs beyond the decoder: the same frames bare and through a real server.

Bare is JPEG bytes to readings in one warm thread. Over HTTP the same bytes go through a kept-alive connection to
uvicorn, the key check, the form, a decoder process, the registry and one durable transaction. The two alternate frame
by frame, so that a busy machine slows both; the difference of the medians is the overhead.

Run: python -m benchmarks.http_overhead [--frames N] [--registered N] [--limit-ms 5]
"""

from __future__ import annotations

import argparse
import asyncio
import json
import logging
import statistics
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import structlog
import uvicorn

from app.decoders.images import load_image
from app.decoders.plate import decode_plates
from app.main import create_app
from app.markers.plate import PlateCode
from app.settings import Settings

KEY = "benchmark-key-that-is-long-enough"
LON_DEG, LAT_DEG = 8.412345, 49.012345


def frame_1080p(seed: int, code: PlateCode) -> bytes:
    """JPEG of asphalt with one plate flat to the camera: the decoder's share does not matter here."""
    rng = np.random.default_rng(seed)
    frame = rng.normal(100, 6, (1080, 1920, 3)).clip(0, 255).astype(np.uint8)
    frame = cv2.GaussianBlur(frame, (0, 0), 1.2)
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
    """uvicorn in a thread, as `waymark serve` runs it."""

    def __init__(self, folder: Path) -> None:
        structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.ERROR))
        settings = Settings(data_dir=folder, admin_key=KEY, log_level="ERROR")
        config = uvicorn.Config(
            create_app(settings), host="127.0.0.1", port=0, log_level="error", access_log=False, loop="uvloop"
        )
        self.server = uvicorn.Server(config)
        self.thread = threading.Thread(target=lambda: asyncio.run(self.server.serve()), daemon=True)

    def __enter__(self) -> str:
        self.thread.start()
        while not self.server.started:
            time.sleep(0.01)
        return f"http://127.0.0.1:{self.server.servers[0].sockets[0].getsockname()[1]}"

    def __exit__(self, *_: object) -> None:
        self.server.should_exit = True
        self.thread.join()


def register(client: httpx.Client, count: int) -> None:
    """Plates along a road, 20 m apart; the first is the one in the frames."""
    for k in range(count):
        position = {"lon_deg": LON_DEG + k * 0.000271, "lat_deg": LAT_DEG, "horizontal_rmse_m": 0.01}
        answer = client.post("/v1/markers", json={"position": position, "heading_deg": 90.0, "status": "surveyed"})
        answer.raise_for_status()


def post(client: httpx.Client, data: bytes, context: dict[str, Any], bare_body: bool) -> httpx.Response:
    """One upload."""
    text = json.dumps(context)
    if bare_body:
        headers = {"Content-Type": "image/jpeg", "Waymark-Context": text}
        return client.post("/v1/decodes", content=data, headers=headers)
    return client.post("/v1/decodes", files={"file": ("f.jpg", data), "context": (None, text)})


def main() -> int:
    """Print one table; the exit status says whether the limit was kept."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--registered", type=int, default=5)
    parser.add_argument("--limit-ms", type=float, default=5.0)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    code = PlateCode.from_position(LON_DEG, LAT_DEG)
    frames = [frame_1080p(seed, code) for seed in range(4)]
    camera = {"horizontal_fov_deg": 70.0, "width_px": 1920, "height_px": 1080}
    context = {"coarse_position": {"lon_deg": LON_DEG, "lat_deg": LAT_DEG, "accuracy_m": 15.0}, "camera": camera}
    times: dict[str, list[float]] = {"bare": [], "server: load + decode": [], "form": [], "bare body": []}
    with tempfile.TemporaryDirectory() as folder, Server(Path(folder)) as url:
        headers = {"Authorization": f"Bearer {KEY}"}
        with httpx.Client(base_url=url, headers=headers, timeout=120, trust_env=False) as client:
            register(client, arguments.registered)
            for k in range(arguments.frames + 6):
                data = frames[k % len(frames)]
                took = {}
                began = time.perf_counter()
                decode_plates(load_image(data).pixels, codebook=(code,))
                took["bare"] = time.perf_counter() - began
                for name, bare_body in (("form", False), ("bare body", True)):
                    began = time.perf_counter()
                    answer = post(client, data, context, bare_body)
                    took[name] = time.perf_counter() - began
                    answer.raise_for_status()
                told = answer.json()["frames"][0]
                took["server: load + decode"] = (told["load_ms"] + told["decode_ms"]) / 1e3
                if k >= 6:
                    for name, seconds in took.items():
                        times[name].append(1e3 * seconds)
    middle = {name: statistics.median(values) for name, values in times.items()}
    print(f"{arguments.frames} frames of {len(frames[0]) // 1024} KiB, {arguments.registered} plates registered")
    for name, value in middle.items():
        tenths = statistics.quantiles(times[name], n=10)
        print(f"  {name:24s} p10 {tenths[0]:7.2f} ms   median {value:7.2f} ms   p90 {tenths[-1]:7.2f} ms")
    overhead = {name: middle[name] - middle["bare"] for name in ("form", "bare body")}
    for name, value in overhead.items():
        print(f"  overhead, {name:14s} {value:14.2f} ms   (limit {arguments.limit_ms:g} ms)")
    return 0 if max(overhead.values()) <= arguments.limit_ms else 1


if __name__ == "__main__":
    raise SystemExit(main())
