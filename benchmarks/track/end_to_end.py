"""Tracks of whole drives: a vehicle's files through the decoders and routes of a server, against the truth."""

from __future__ import annotations

import csv
import io
import json
import tempfile
import time
from datetime import datetime
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from app.demo.server import LocalServer, checked
from benchmarks.track.vehicle import CAMERA_LATE_S, LOG_LATE_S, Recorded, install, record


def print_end_to_end(seeds: range) -> None:
    """Print a row for each drive."""
    print("### Files of a simulated vehicle through the real decoders, over HTTP\n")
    print(
        f"A drive of 170 m. The true offset of the camera's clock is {CAMERA_LATE_S} s, that of the packet log's clock "
        f"{LOG_LATE_S} s.\n"
    )
    print(
        "| seed | plates | tags | CERPMs | along [m] | across [m] | camera's clock [s] | log's clock [s] | fusing [s] |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder, LocalServer(Path(folder)) as server:
        headers = {"Authorization": f"Bearer {server.key}"}
        with httpx.Client(base_url=server.url, headers=headers, timeout=600, trust_env=False) as client:
            road = install(client, (11.0, 48.0, 100.0), np.random.default_rng(5))
            for seed in seeds:
                recorded = record(road, seed)
                decodes = {name: upload(client, recorded, name) for name in recorded.uploads}
                began = time.monotonic()
                drive = make_drive(client, {name: decode["id"] for name, decode in decodes.items()})
                _print_row(client, recorded, seed, drive, time.monotonic() - began)
    print()


def upload(client: httpx.Client, recorded: Recorded, name: str) -> dict[str, Any]:
    """A decode of one of a vehicle's files, once it is done."""
    data, context = recorded.uploads[name]
    text = json.dumps(context)
    parts: dict[str, tuple[str | None, bytes | str, str]]
    parts = {"file": (f"{name}.zip", data, "application/zip"), "context": (None, text, "application/json")}
    return _ended(client, f"/v1/decodes/{checked(client.post('/v1/decodes', files=parts)).json()['id']}")


def make_drive(client: httpx.Client, decode_ids: dict[str, str]) -> dict[str, Any]:
    """A drive of decodes, each with a clock of its own, once it is done."""
    decodes = [{"id": decode_id, "clock": name} for name, decode_id in decode_ids.items()]
    answer = checked(client.post("/v1/drives", json={"decodes": decodes, "options": {"rate_hz": 5}}))
    return _ended(client, answer.headers["location"])


def track_errors_m(client: httpx.Client, recorded: Recorded, drive: dict[str, Any]) -> tuple[float, float]:
    """Root of the mean square of the errors along and across."""
    rows = list(csv.DictReader(io.StringIO(client.get(drive["links"]["csv"]).text)))
    time_s = np.array([datetime.fromisoformat(row["time"]).timestamp() for row in rows])
    lon, lat = (np.array([float(row[name]) for row in rows]) for name in ("lon_deg", "lat_deg"))
    inside = (time_s > recorded.time_s[0]) & (time_s < recorded.time_s[-1])
    errors = recorded.errors_m(time_s[inside], lon[inside], lat[inside])
    along, across = (float(np.sqrt(np.mean(part**2))) for part in errors)
    return along, across


def _print_row(client: httpx.Client, recorded: Recorded, seed: int, drive: dict[str, Any], seconds: float) -> None:
    used = [marker["family"] for marker in drive["report"]["markers"] if marker["used"]]
    clocks = {clock["clock"]: clock for clock in drive["report"]["clocks"]}
    along, across = track_errors_m(client, recorded, drive)
    found = [
        f"{clocks[name]['offset_s']:.3f} ± {clocks[name]['sigma_s']:.3f}" for name in ("frames", "packets, receiver")
    ]
    counts = [str(used.count(family)) for family in ("plate", "magnet", "cerpm")]
    print(f"| {seed} | {' | '.join(counts)} | {along:.3f} | {across:.3f} | {' | '.join(found)} | {seconds:.1f} |")


def _ended(client: httpx.Client, path: str) -> dict[str, Any]:
    while (document := checked(client.get(path)).json())["state"] in ("queued", "running"):
        time.sleep(0.1)
    if document["state"] != "done":
        raise RuntimeError(f"{path} is {document['state']}: {document['error']}")
    found: dict[str, Any] = document
    return found
