"""The server, the worker or a decoder process of a fleet is killed at random while clients upload.

`python -m benchmarks.faults` kills the embedded server. The broker and the database are not killed here.
"""

from __future__ import annotations

import os
import random
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import psutil
import sqlalchemy as sa

from app.registry.tables import jobs
from app.registry.tenancy import across_agencies
from benchmarks.faults.server import FaultServer
from benchmarks.faults.stored import Stored
from benchmarks.faults.writers import Writers

VICTIMS = ("web", "worker", "child")
SHORT_CYCLES, CYCLES = 3, 100
_MINUTE_S = 60.0
_COMMAND = ("import sys; sys.argv[1:] = ['worker']; from app.cli import main; main()",)


class Worker:
    """`waymark worker` with the settings of a server."""

    def __init__(self, server: FaultServer) -> None:
        self._server = server
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start it; it takes jobs a few seconds later."""
        with self._server.log.open("ab") as log:
            command = [sys.executable, "-c", *_COMMAND]
            self.process = subprocess.Popen(command, env=self._server.environment, stdout=log, stderr=log)

    def kill(self) -> None:
        """Kill it at once."""
        assert self.process is not None
        self.process.kill()
        self.process.wait()

    def kill_child(self, choice: random.Random) -> None:
        """Kill one of its processes."""
        assert self.process is not None
        with suppress(psutil.NoSuchProcess, IndexError):
            choice.choice(psutil.Process(self.process.pid).children(recursive=True)).kill()

    def stop(self) -> None:
        """Ask it to end."""
        assert self.process is not None
        self.process.terminate()
        self.process.wait()


def tables(short: bool, seed: int = 15) -> str:
    """The table; needs WAYMARK_BENCH_POSTGRES_URL (an empty database with PostGIS) and WAYMARK_BENCH_BROKER_URL."""
    names = ("WAYMARK_BENCH_POSTGRES_URL", "WAYMARK_BENCH_BROKER_URL")
    if any(name not in os.environ for name in names):
        return f"left out: {' and '.join(names)} are not set"
    database, broker = (os.environ[name] for name in names)
    settings = {
        "WAYMARK_BROKER_URL": broker, "WAYMARK_BROKER_PREFIX": f"waymark_kills_{os.getpid()}",
        "WAYMARK_BLOBS_SHARED": "true",
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        server = FaultServer(Path(folder) / "var", database, settings)
        return _kill(server, database, SHORT_CYCLES if short else CYCLES, seed)


def _kill(server: FaultServer, database: str, cycles: int, seed: int) -> str:
    choice, ready_s = random.Random(seed), []
    kills = dict.fromkeys(VICTIMS, 0)
    ready_s.append(server.start())
    worker, stored = Worker(server), Stored(server.folder, database)
    worker.start()
    writers = Writers(server.url, seed)
    try:
        for _ in range(cycles):
            writers.resume()
            time.sleep(choice.uniform(0.5, 4.0))
            victim = choice.choice(VICTIMS)
            kills[victim] += 1
            if victim == "web":
                server.kill()
                writers.pause()
                ready_s.append(server.start())
            elif victim == "worker":
                worker.kill()
                worker.start()
            else:
                worker.kill_child(choice)
        writers.resume()
        writers.finish()
        killed_at = time.monotonic()
        while stored.count_jobs("queued", "running") and time.monotonic() < killed_at + 4 * _MINUTE_S:
            time.sleep(0.2)
        ended_s = time.monotonic() - killed_at
        worker.stop()
        server.stop()
        return _table(stored, writers, kills, ready_s, ended_s)
    finally:
        writers.finish()
        for process in (server.process, worker.process):
            if process is not None and process.poll() is None:
                process.kill()
        stored.database.close()


def _table(stored: Stored, writers: Writers, kills: dict[str, int], ready_s: list[float], ended_s: float) -> str:
    done = writers.done
    with across_agencies(), stored.database.read() as connection:
        twice = len(connection.execute(sa.select(jobs.c.id).group_by(jobs.c.id).having(sa.func.count() > 1)).all())
    lost, faults = stored.list_lost(done), stored.list_faults()
    failed, left = stored.count_jobs("failed"), stored.count_jobs("queued", "running")
    rows = [
        ("kills", ", ".join(f"{name} {number}" for name, number in kills.items())),
        ("acknowledged writes, of them jobs", f"{done.count}, {len(done.jobs)}"),
        ("acknowledged writes that are lost, or without their blob", str(len(lost))),
        ("markers stored twice or in part", str(stored.count_markers() - len(done.markers) + twice)),
        ("unexpected answers", str(len(done.unexpected))),
        ("jobs that failed; that were not done after four minutes", f"{failed}; {left}"),
        ("all jobs done after the last kill", f"{ended_s:.1f} s"),
        ("faults of the audit log", str(len(faults))),
        ("server ready after a kill, slowest", f"{max(ready_s):.1f} s, load {os.getloadavg()[0]:.1f}"),
    ]
    return "| Celery, PostgreSQL | |\n|---|---|\n" + "\n".join(f"| {name} | {value} |" for name, value in rows)
