"""Clients that write without pause, repeat what was not acknowledged, and remember what was."""

from __future__ import annotations

import hashlib
import io
import json
import math
import random
import threading
import uuid
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import httpx
import numpy as np

from benchmarks.faults.server import HEADERS

_PAUSE_S, _JOB_PAUSE_S = 0.2, 1.0
ALLOWED = (429, 503, 507)
"""Answers after which a request is repeated."""
IMPORT_ROWS = 20
IMPORT_ROAD = "import "
"""Rows of each survey, and the beginning of the name of its road, which no other survey has."""


@dataclass(frozen=True)
class WriteRequest:
    """A request that is sent until it is acknowledged, always with the same key."""

    path: str
    # `json`, `file`, `declaration`: the body: JSON, or a form
    json: object = None
    file: tuple[str, bytes] | None = None
    declaration: Mapping[str, Any] | None = None
    headers: Mapping[str, str] = field(default_factory=dict)
    accepted: tuple[int, ...] = (200, 201, 202)  # statuses that acknowledge it
    then: Callable[[Any], WriteRequest] | None = None  # makes the request that follows from the response's document
    key: str = field(default_factory=lambda: uuid.uuid4().hex)  # the Idempotency-Key

    def send(self, client: httpx.Client) -> httpx.Response:
        """Send it once."""
        headers = {"Idempotency-Key": self.key, **self.headers}
        if self.file is None:
            return client.post(self.path, json=self.json, headers=headers)
        parts: dict[str, Any] = {"file": self.file}
        if self.declaration is not None:
            parts["declaration"] = (None, json.dumps(self.declaration))
        return client.post(self.path, files=parts, headers=headers)


@dataclass
class Acknowledged:
    """What the server has acknowledged."""

    markers: set[str] = field(default_factory=set)  # ids of markers
    uploads: dict[str, str] = field(default_factory=dict)  # id of a decode to the SHA-256 of its upload
    jobs: set[str] = field(default_factory=set)  # ids of decodes and imports that were answered with 202
    imports: dict[str, str] = field(default_factory=dict)  # id of an import to the name of the road of its markers
    plans: dict[str, int] = field(default_factory=dict)  # id of a committed plan to the number of its markers
    unexpected: list[str] = field(default_factory=list)  # answers that are neither 2xx nor `ALLOWED`

    @property
    def count(self) -> int:
        """Number of acknowledged writes."""
        return len(self.markers) + len(self.uploads) + len(self.imports) + len(self.plans)

    @property
    def all_markers(self) -> int:
        """Number of markers that are stored once every job is done."""
        return len(self.markers) + IMPORT_ROWS * len(self.imports) + sum(self.plans.values())

    def since(self, earlier: Acknowledged) -> Acknowledged:
        """What was acknowledged after an `earlier` copy."""
        uploads = {found: sha256 for found, sha256 in list(self.uploads.items()) if found not in earlier.uploads}
        return Acknowledged(
            set(self.markers) - earlier.markers, uploads,
            imports=dict(self.imports.items() - earlier.imports.items()),
            plans=dict(self.plans.items() - earlier.plans.items()),
        )  # fmt: skip

    def copy(self) -> Acknowledged:
        """As it is now."""
        return self.since(Acknowledged())

    def note(self, request: WriteRequest, response: httpx.Response) -> None:
        """Remember what a response acknowledges."""
        if response.status_code not in request.accepted:
            if response.status_code not in ALLOWED:
                self.unexpected.append(f"{request.path}: {response.status_code} {response.text[:300]}")
            return
        document = response.json()
        if response.status_code == 202:
            self.jobs.add(document["id"])
        if request.path == "/v1/decodes":
            assert request.file is not None
            self.uploads[document["id"]] = hashlib.sha256(request.file[1]).hexdigest()
        elif request.path == "/v1/imports":
            assert request.declaration is not None
            self.imports[document["id"]] = request.declaration["road"]
        elif request.path.endswith("/commit"):
            self.plans[document["id"]] = document["markers"]
        elif request.path.endswith("/bulk"):
            self.markers.update(result["id"] for result in document["results"])
        elif request.path == "/v1/markers":
            self.markers.add(document["id"])


def _position(seed: random.Random) -> dict[str, float]:
    return {"lon_deg": round(seed.uniform(-170, 170), 7), "lat_deg": round(seed.uniform(-60, 60), 7)}


def marker(seed: random.Random) -> WriteRequest:
    """A plate somewhere."""
    return WriteRequest("/v1/markers", {"position": _position(seed)})


def _bulk(seed: random.Random) -> WriteRequest:
    items = [{"create": {"position": _position(seed), "family": "cerpm"}} for _ in range(20)]
    return WriteRequest("/v1/markers/bulk", {"items": items})


def _picture(seed: random.Random) -> bytes:
    pixels = np.random.default_rng(seed.getrandbits(32)).integers(0, 255, (64, 96, 3), np.uint8)
    return bytes(cv2.imencode(".jpg", pixels)[1])


def frame(seed: random.Random) -> WriteRequest:
    """A frame of noise: nothing is found in it, but it is stored."""
    return WriteRequest("/v1/decodes", file=("frame.jpg", _picture(seed)))


def archive(seed: random.Random, frames: int = 1) -> WriteRequest:
    """An archive of frames, which becomes a job."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as file:
        for number in range(frames):
            file.writestr(f"{number}.jpg", _picture(seed))
    return WriteRequest("/v1/decodes", file=("drive.zip", packed.getvalue()))


def survey(seed: random.Random) -> WriteRequest:
    """A survey of `IMPORT_ROWS` markers as CSV, which becomes a job."""
    lon_deg, lat_deg = _position(seed).values()
    rows = [f"{lon_deg + k * 5e-4:.7f},{lat_deg:.7f}" for k in range(IMPORT_ROWS)]
    declaration = {
        "crs": "EPSG:4326", "family": "cerpm", "road": f"{IMPORT_ROAD}{seed.getrandbits(64):x}",
        "area_deg": [lon_deg - 0.01, lat_deg - 0.01, lon_deg + 0.05, lat_deg + 0.01],
    }  # fmt: skip
    data = "\n".join(["lon,lat", *rows]).encode()
    return WriteRequest(
        "/v1/imports", file=("survey.csv", data), declaration=declaration, headers={"Prefer": "respond-async"}
    )


class PlanCommits:
    """Roads with a plan, which the holder of another key approves, and which is then committed.

    Parameters
    ----------
    approver_key : str
    """

    def __init__(self, approver_key: str) -> None:
        self._approver_key = approver_key

    def __call__(self, seed: random.Random) -> WriteRequest:
        """The first request: the road."""
        name = f"road {seed.getrandbits(64):x}"
        return WriteRequest(
            "/v1/alignments",
            file=("road.geojson", _road(seed)),
            declaration={"name": name},
            then=lambda road: self._plan(name, road["id"]),
        )

    def _plan(self, name: str, alignment_id: str) -> WriteRequest:
        rules = {"version": 1, "plates": {"spacing_m": 100}}
        wanted = {"name": name, "alignment_id": alignment_id, "rules": rules}
        return WriteRequest("/v1/plans", wanted, then=lambda plan: self._approval(plan["id"]))

    def _approval(self, plan_id: str) -> WriteRequest:
        """A repeated approval has no key: it finds that the plan is of a newer version."""
        headers = {"X-API-Key": self._approver_key, "If-Match": '"1"'}
        path, accepted = f"/v1/plans/{plan_id}", (200, 409, 412)
        commit = WriteRequest(f"{path}/commit", headers={"If-Match": '"2"'})
        return WriteRequest(f"{path}/approve", headers=headers, accepted=accepted, then=lambda _: commit)


def _road(seed: random.Random) -> bytes:
    """A straight lane of 300 m to the east as GeoJSON."""
    lon_deg, lat_deg = _position(seed).values()
    step_deg = 20.0 / (111_320.0 * math.cos(math.radians(lat_deg)))
    properties = {
        "lane": "1", "width_m": 3.5, "speed_limit_kmh": 70, "left_style": "dashed", "right_style": "solid",
    }  # fmt: skip
    points = [(lon_deg + k * step_deg, lat_deg) for k in range(16)]
    lane = {
        "type": "Feature", "properties": properties, "geometry": {"type": "LineString", "coordinates": points},
    }  # fmt: skip
    return json.dumps({"type": "FeatureCollection", "features": [lane]}).encode()


Kind = Callable[[random.Random], WriteRequest]
KINDS: tuple[Kind, ...] = (marker, marker, _bulk, frame, archive)


class Writers:
    """One thread for each kind of write; they wait while the server is down.

    Parameters
    ----------
    url : str
    seed : int
    kinds : sequence of Kind, optional
    pause_s : float, optional
        After each acknowledged write. [s]
    """

    def __init__(self, url: str, seed: int, kinds: Sequence[Kind] = KINDS, pause_s: float = 0.0) -> None:
        self.done = Acknowledged()
        self._url, self._lock, self._rest_s = url, threading.Lock(), pause_s
        self._up, self._ending, self._abandoned = threading.Event(), threading.Event(), threading.Event()
        self._threads = [
            threading.Thread(target=self._write, args=(make, random.Random(seed + k))) for k, make in enumerate(kinds)
        ]
        for thread in self._threads:
            thread.start()

    def resume(self) -> None:
        """The server is up."""
        self._up.set()

    def pause(self) -> None:
        """The server is going down: send nothing new."""
        self._up.clear()

    def finish(self) -> None:
        """Have each writer end when its last request is acknowledged; the server has to be up."""
        self._ending.set()
        self._up.set()
        for thread in self._threads:
            thread.join()

    def abandon(self) -> None:
        """Have each writer end with its next answer, whichever it is."""
        self._abandoned.set()
        self.finish()

    def _write(self, make: Kind, seed: random.Random) -> None:
        request = None
        with httpx.Client(base_url=self._url, headers=HEADERS, trust_env=False, timeout=120) as client:
            while (request is not None or not self._ending.is_set()) and not self._abandoned.is_set():
                self._up.wait()
                if request is None:
                    request = make(seed)
                try:
                    response = request.send(client)
                except httpx.TransportError:
                    self._ending.wait(_PAUSE_S)
                    continue
                if response.status_code not in ALLOWED:
                    with self._lock:
                        self.done.note(request, response)
                    followed = request.then is not None and response.status_code in request.accepted
                    request = request.then(response.json()) if request.then is not None and followed else None
                    self._ending.wait(self._rest_s)
                if response.status_code not in (200, 201):
                    self._ending.wait(_JOB_PAUSE_S if response.status_code == 202 else _PAUSE_S)
