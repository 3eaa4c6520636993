"""The server is killed at random moments while clients write; afterwards everything acknowledged has to be there."""

from __future__ import annotations

import random
import tempfile
import time
from pathlib import Path

from benchmarks.faults.rows import FaultRow
from benchmarks.faults.server import FaultServer
from benchmarks.faults.stored import Stored
from benchmarks.faults.writers import Acknowledged, Writers
from benchmarks.registry.servers import drop_database, make_database

_DATABASE = "waymark_faults"
_QUIET_EVERY = 3
"""In every third cycle jobs may finish before the kill: one that is killed in each of its three attempts fails."""
_WITHIN_S = 180.0


def kill_cycles(kind: str, cycles: int, seed: int) -> list[FaultRow]:
    """Rows of the table for `sqlite` or `postgresql`."""
    url = make_database(_DATABASE) if kind == "postgresql" else ""
    try:
        with tempfile.TemporaryDirectory() as folder:
            return _kill_cycles(kind, FaultServer(Path(folder) / "var", url), url, cycles, seed)
    finally:
        if url:
            drop_database(_DATABASE)


def _kill_cycles(kind: str, server: FaultServer, url: str, cycles: int, seed: int) -> list[FaultRow]:
    moments, lost = random.Random(seed), list[str]()
    checked = Acknowledged()
    server.start()
    stored, writers = Stored(server.folder, url), Writers(server.url, seed)
    try:
        for cycle in range(cycles):
            writers.resume()
            time.sleep(moments.uniform(0.1, 3.0))
            if cycle % _QUIET_EVERY == _QUIET_EVERY - 1:
                _wait_for_jobs(stored)
            server.kill()
            writers.pause()
            server.start()
            new = writers.done.since(checked)
            lost += stored.list_lost(new)
            checked = Acknowledged(checked.markers | new.markers, checked.uploads | new.uploads)
            print(f"{kind}: {cycle + 1} of {cycles}, {writers.done.count} writes, {len(lost)} lost", flush=True)
        writers.finish()
        _wait_for_jobs(stored)
        done = writers.done
        lost += stored.list_lost(done)
        server.stop()
        unfinished = stored.count_jobs("queued", "running", "failed")
        more, faults = stored.count_markers() - len(done.markers), stored.list_faults()
        unused, blobs, left = stored.delete_unused()
        lost += stored.list_lost(done)
    finally:
        writers.finish()
        server.stop()
        stored.database.close()
    name, tried = f"kill -9, {kind}", f"{cycles} kills, {done.count} writes"
    return [
        FaultRow(f"{name}: acknowledged writes", tried, f"{len(lost)} lost", "0 lost", not lost),
        FaultRow(f"{name}: repeated requests", tried, f"{more} stored twice or in part", "0", not more),
        FaultRow(f"{name}: answers", tried, f"{len(done.unexpected)} unexpected", "0", not done.unexpected),
        FaultRow(f"{name}: jobs", f"{len(done.jobs)}", f"{unfinished} not done", "0", not unfinished),
        FaultRow(f"{name}: audit log", "verified", f"{len(faults)} faults", "0", not faults),
        FaultRow(f"{name}: unused blobs", f"{unused} of {blobs}", f"{left} left", "0 left", not left),
    ]


def _wait_for_jobs(stored: Stored) -> None:
    deadline = time.monotonic() + _WITHIN_S
    while stored.count_jobs("queued", "running") and time.monotonic() < deadline:
        time.sleep(0.2)
