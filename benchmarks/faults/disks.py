"""Disks that fail: the N-th fsync ends with EIO, and a data folder of 16 MB becomes full."""

from __future__ import annotations

import random
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import httpx

from benchmarks.faults.rows import FaultRow
from benchmarks.faults.server import FaultServer
from benchmarks.faults.stored import Stored
from benchmarks.faults.writers import Acknowledged, WriteRequest, archive, frame, marker

_DISK_BYTES = 16 * 1024**2
_WITHIN_S = 120.0
_MORE = 10
"""Requests beyond the N-th, so that its fsync is reached: each has one at least."""


# --- fsync ------------------------------------------------------------------------------------------------------------


def failing_syncs(numbers: Iterable[int]) -> list[FaultRow]:
    """Rows of the table. Each thread of the server has its own N-th fsync or fdatasync, so more than one may fail."""
    name = "EIO at the N-th fsync"
    if shutil.which("strace") is None:
        return [FaultRow(name, "strace is not installed", "", "0 lost", None)]
    tried = list(numbers)
    with tempfile.TemporaryDirectory() as folder:
        server, done, seed = FaultServer(Path(folder) / "var"), Acknowledged(), random.Random(14)
        server.start()
        stored = Stored(server.folder)
        try:
            injected = sum(_fail_one(server, number, done, seed, Path(folder)) for number in tried)
            writable = server.wait_until_ready()
            server.kill()
            server.start()
            lost = stored.list_lost(done)
            server.stop()
            faults = stored.list_faults()
        finally:
            server.stop()
            stored.database.close()
    what = f"N = {tried[0]} to {tried[-1]}, {len(tried)} runs, {injected} failures, {done.count} writes"
    return [
        FaultRow(f"{name}: acknowledged writes", what, f"{len(lost)} lost", "0 lost", not lost and injected > 0),
        FaultRow(f"{name}: answers", what, f"{len(done.unexpected)} but 2xx, 503, 507", "0", not done.unexpected),
        FaultRow(f"{name}: audit log", "verified", f"{len(faults)} faults", "0", not faults),
        FaultRow(f"{name}: ready afterwards", "", "yes" if writable else "no", "yes", writable),
    ]


def _fail_one(server: FaultServer, number: int, done: Acknowledged, seed: random.Random, folder: Path) -> int:
    """Attach strace, write, detach; returns how many calls failed."""
    log = folder / "strace"
    calls = "fsync,fdatasync"
    inject = ["-e", f"trace={calls}", "-e", f"inject={calls}:error=EIO:when={number}"]
    with subprocess.Popen(
        ["strace", "-f", "-qq", "-p", str(server.pid), "-o", str(log), *inject], stderr=subprocess.PIPE
    ) as tracer:
        try:
            _wait_until_traced(server.pid)
            with server.client() as client:
                for count in range(number + _MORE):
                    request = frame(seed) if count % 3 == 0 else marker(seed)
                    done.note(request, request.send(client))
        finally:
            tracer.terminate()
    return log.read_text().count("(INJECTED)")


def _wait_until_traced(pid: int) -> None:
    """Until every thread is traced."""
    deadline = time.monotonic() + _WITHIN_S
    while time.monotonic() < deadline:
        with suppress(FileNotFoundError):
            statuses = [path.read_text() for path in Path(f"/proc/{pid}/task").glob("*/status")]
            if all("TracerPid:\t0\n" not in status for status in statuses):
                return
        time.sleep(0.02)
    raise RuntimeError("strace could not be attached")


# --- a full disk ------------------------------------------------------------------------------------------------------


def full_disk() -> list[FaultRow]:
    """Rows of the table for a data folder in a file system of 16 MB."""
    name = "tmpfs of 16 MB"
    with tempfile.TemporaryDirectory() as folder:
        try:
            with _small_disk(Path(folder) / "disk") as disk:
                return _fill(name, disk, Path(folder))
        except subprocess.CalledProcessError:
            return [FaultRow(name, "no file system may be mounted here", "", "0 lost", None)]


@contextmanager
def _small_disk(place: Path) -> Iterator[Path]:
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={_DISK_BYTES}", "tmpfs", str(place)]
    subprocess.run(mount, check=True, capture_output=True)
    try:
        yield place
    finally:
        subprocess.run(["umount", "--lazy", str(place)], check=True)


def _fill(name: str, disk: Path, folder: Path) -> list[FaultRow]:
    server = FaultServer(disk / "var")
    server.log = folder / "server.log"  # not on the small disk
    done, seed, ballast = Acknowledged(), random.Random(14), disk / "ballast"
    server.start()
    stored = Stored(server.folder)
    try:
        with server.client() as client:
            for make in [archive] * 4 + [frame, marker] * 10:
                _write(client, done, make(seed, 20) if make is archive else make(seed))
            _write_ballast(ballast)
            answers = [_write(client, done, (frame if k % 2 else marker)(seed)) for k in range(40)]
            not_ready = client.get("/readyz").status_code == 503
            failed = stored.count_jobs("failed")
            ballast.unlink()
            ready = server.wait_until_ready()
            resumed = [_write(client, done, make(seed)) for make in (frame, marker)]
        _wait_for_jobs(stored)
        server.kill()
        server.start()
        lost, unfinished = stored.list_lost(done), stored.count_jobs("queued", "running", "failed")
    finally:
        server.stop()
        stored.database.close()
    full = answers.count(507)
    what = f"{len(answers)} writes, {full} answered 507"
    again = ready and set(resumed) <= {200, 201}
    return [
        FaultRow(f"{name}: acknowledged writes", f"{done.count}", f"{len(lost)} lost", "0 lost", not lost),
        FaultRow(f"{name}: answers", what, f"{len(done.unexpected)} but 2xx, 503, 507", "0", not done.unexpected),
        FaultRow(
            f"{name}: /readyz while it is full", what, "503" if not_ready else "200", "503", not_ready and full > 0
        ),
        FaultRow(f"{name}: writes when there is room again", "2", "stored" if again else "refused", "stored", again),
        FaultRow(
            f"{name}: jobs",
            f"{len(done.jobs)}",
            f"{failed} failed, {unfinished} not done",
            "0",
            not failed + unfinished,
        ),
    ]


def _write(client: httpx.Client, done: Acknowledged, request: WriteRequest) -> int:
    response = request.send(client)
    done.note(request, response)
    return response.status_code


def _write_ballast(path: Path) -> None:
    """Take all room that is left."""
    with path.open("wb", buffering=0) as file, suppress(OSError):
        while file.write(bytes(4096)):
            pass


def _wait_for_jobs(stored: Stored) -> None:
    deadline = time.monotonic() + _WITHIN_S
    while stored.count_jobs("queued", "running") and time.monotonic() < deadline:
        time.sleep(0.2)
