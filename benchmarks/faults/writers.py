"""Clients that write without pause, repeat what was not acknowledged, and remember what was."""

from __future__ import annotations

import hashlib
import io
import random
import threading
import uuid
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import httpx
import numpy as np

from benchmarks.faults.server import HEADERS

_PAUSE_S, _JOB_PAUSE_S = 0.2, 1.0
ALLOWED = (429, 503, 507)
"""Answers after which a request is repeated."""


@dataclass(frozen=True)
class WriteRequest:
    """A request that is sent until it is acknowledged, always with the same key."""

    path: str
    json: object = None
    file: tuple[str, bytes] | None = None
    key: str = field(default_factory=lambda: uuid.uuid4().hex)

    def send(self, client: httpx.Client) -> httpx.Response:
        """Send it once."""
        headers = {"Idempotency-Key": self.key}
        if self.file is not None:
            return client.post(self.path, files={"file": self.file}, headers=headers)
        return client.post(self.path, json=self.json, headers=headers)


@dataclass
class Acknowledged:
    """What the server has acknowledged.

    Attributes
    ----------
    markers : set of str
        Ids of markers.
    uploads : dict
        Id of a decode to the SHA-256 of its upload.
    jobs : set of str
        Ids of decodes that were answered with 202.
    unexpected : list of str
        Answers that are neither 2xx nor `ALLOWED`.
    """

    markers: set[str] = field(default_factory=set)
    uploads: dict[str, str] = field(default_factory=dict)
    jobs: set[str] = field(default_factory=set)
    unexpected: list[str] = field(default_factory=list)

    @property
    def count(self) -> int:
        """Number of acknowledged writes."""
        return len(self.markers) + len(self.uploads)

    def since(self, earlier: Acknowledged) -> Acknowledged:
        """What was acknowledged after an `earlier` copy."""
        uploads = {found: sha256 for found, sha256 in list(self.uploads.items()) if found not in earlier.uploads}
        return Acknowledged(set(self.markers) - earlier.markers, uploads)

    def note(self, request: WriteRequest, response: httpx.Response) -> None:
        """Remember what a response acknowledges."""
        if response.status_code not in (200, 201, 202):
            if response.status_code not in ALLOWED:
                self.unexpected.append(f"{response.status_code} {response.text[:300]}")
        elif request.file is not None:
            found = response.json()["id"]
            self.uploads[found] = hashlib.sha256(request.file[1]).hexdigest()
            if response.status_code == 202:
                self.jobs.add(found)
        elif request.path.endswith("bulk"):
            self.markers.update(result["id"] for result in response.json()["results"])
        else:
            self.markers.add(response.json()["id"])


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


KINDS: tuple[Callable[[random.Random], WriteRequest], ...] = (marker, marker, _bulk, frame, archive)


class Writers:
    """One thread for each of `KINDS`; they wait while the server is down.

    Parameters
    ----------
    url : str
    seed : int
    """

    def __init__(self, url: str, seed: int) -> None:
        self.done = Acknowledged()
        self._url, self._lock = url, threading.Lock()
        self._up, self._ending = threading.Event(), threading.Event()
        self._threads = [
            threading.Thread(target=self._write, args=(make, random.Random(seed + k))) for k, make in enumerate(KINDS)
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

    def _write(self, make: Callable[[random.Random], WriteRequest], seed: random.Random) -> None:
        request = None
        with httpx.Client(base_url=self._url, headers=HEADERS, trust_env=False, timeout=120) as client:
            while request is not None or not self._ending.is_set():
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
                    request = None
                if response.status_code not in (200, 201):
                    self._ending.wait(_JOB_PAUSE_S if response.status_code == 202 else _PAUSE_S)
