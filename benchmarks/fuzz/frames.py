"""Damaged pictures for the decoder processes: whatever the native codecs do, the server gets an answer and goes on."""

from __future__ import annotations

import random
import time
from collections import deque
from concurrent.futures import Future
from typing import Any

from app.decoders.plate.reader import decode_plates
from app.decoding.frames import PlateSearch
from app.errors import WaymarkError
from app.families.plate.plates import PLATE
from app.formats.format import SpooledFile
from app.jobs.pool import DecodePool
from app.services.decodes.frame_tasks import FramePicture, FrameSearch, decode_frame
from benchmarks.fuzz.parsers import Outcome
from benchmarks.fuzz.pictures import list_pictures

_IN_FLIGHT = 8
_LENGTHS = (b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"\x00\x00\x00\x00", b"\x00\x01\x00\x00")


def attack_frames(count: int, *, workers: int = 2, seed: int = 1) -> Outcome:
    """Decode so many damaged pictures in decoder processes; at the end an undamaged one must still be accepted."""
    rng = random.Random(seed)
    seeds = list_pictures()
    found = Outcome()
    pool = DecodePool(decode_plates, workers=workers)
    waiting: deque[tuple[bytes, float, Any]] = deque()
    try:
        for _ in range(count):
            data = _damaged(rng.choice(seeds), rng)
            waiting.append((data, time.monotonic(), _submit(pool, data)))
            if len(waiting) >= _IN_FLIGHT:
                _collect(found, *waiting.popleft())
        while waiting:
            _collect(found, *waiting.popleft())
        _submit(pool, seeds[0]).result()
    finally:
        pool.close()
    return found


def _submit(pool: DecodePool, data: bytes) -> Any:
    search: Future[FrameSearch] = Future()
    search.set_result({PLATE.name: PlateSearch()})
    return pool.submit(decode_frame, FramePicture(SpooledFile.of(data)), search, wait_s=60.0)


def _collect(found: Outcome, data: bytes, began_s: float, pending: Any) -> None:
    found.tried += 1
    try:
        pending.result()
        found.accepted += 1
    except WaymarkError as error:
        found.refused[type(error).__name__] += 1
    except Exception as error:  # noqa: BLE001 - whatever it is, it is what we look for
        found.failures.append(f"{type(error).__name__}: {error}\npicture: {data[:4000].hex()}")
    found.slowest_s = max(found.slowest_s, time.monotonic() - began_s)


def _damaged(data: bytes, rng: random.Random) -> bytes:
    """A copy with one to eight damages, most of them in the header, where the codecs decide what to allocate."""
    copy = bytearray(data)
    for _ in range(rng.randint(1, 8)):
        reach = len(copy) if rng.random() < 0.4 else min(len(copy), 700)
        at = rng.randrange(max(reach, 1))
        kind = rng.random()
        if kind < 0.6:
            copy[at : at + 1] = bytes([rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))])
        elif kind < 0.75:
            del copy[at : at + rng.randint(1, 64)]
        elif kind < 0.9:
            copy[at:at] = copy[at : at + rng.randint(1, 64)]
        else:
            copy[at : at + 4] = rng.choice(
                (b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"\x00\x00\x00\x00", b"\x00\x01\x00\x00")
            )
    return bytes(copy)
