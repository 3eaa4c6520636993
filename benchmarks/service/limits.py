"""Limits of the database and the queue, found by load, and what a fleet needs by calculation from measured figures.

- Decodes that one database stores in a second: whole write transactions (decode, observations, job) from several
  processes at once, because writes come one after another (app/registry/database.py).
- Jobs that the queue accepts in a second.
- Workers for a fleet: vehicles on the road at the busiest time, what they upload, and the time that a decoder process
  takes for it, measured in the same run.

Run: python -m benchmarks.service --only limits [--short]
"""

from __future__ import annotations

import multiprocessing
import os
import secrets
import sys
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from app.formats.format import SpooledFile
from app.registry import agencies, jobs
from app.registry import decodes as store
from app.registry.column_types import new_id
from app.registry.database import Database
from app.registry.decodes import DecodeRow
from app.registry.engines import acting_for
from app.registry.jobs import JobKind, new_job
from app.services.decodes.trace_tasks import decode_recording
from benchmarks.service.throughput import PROCESSES, make_frames, measure_bare

VEHICLES = 10_000
SHARE_AT_PEAK = 0.15
"""Of a fleet's vehicles that drive at the busiest time. Source: an assumption; motor cars in Germany are driven about
an hour a day, and two rush hours have about a third of it: 1 h x 1/3 / 2 h = 0.17."""
MEAN_SPEED_M_S = 60 / 3.6
PLATE_SPACING_M = 100.0
FRAMES_A_PLATE = 3
"""Frames that a vehicle uploads of each plate that it passes: those in which it is large enough."""
UPLOAD_EVERY_S = 300.0
"""A vehicle collects its frames and its trace, and uploads them as one job of each kind."""
CORE_HOUR_EUR = 0.04
"""Source: an assumption, the order of the price of a rented virtual core in 2026; scale the column by your own."""
BUSY_SHARE = 0.7
"""Of a worker's time that is planned for; the rest takes peaks."""


@dataclass(frozen=True, slots=True)
class Needs:
    """What a fleet needs."""

    decode_cores: float  # cores of workers
    # `stores_per_s`, `jobs_per_s`: [1/s] write transactions and jobs
    stores_per_s: float
    jobs_per_s: float


def needs_of_fleet(frame_s: float, trace_s_per_h: float, *, vehicles: int = VEHICLES) -> Needs:
    """What a fleet needs at its busiest time.

    Parameters
    ----------
    frame_s : float
        Time of a decoder process for a frame. [s]
    trace_s_per_h : float
        For an hour of a recording. [s]
    vehicles : int, optional
    """
    driving = vehicles * SHARE_AT_PEAK
    frames_per_s = driving * MEAN_SPEED_M_S / PLATE_SPACING_M * FRAMES_A_PLATE
    cores = frames_per_s * frame_s + driving * trace_s_per_h / 3600
    jobs_per_s = 2 * driving / UPLOAD_EVERY_S
    return Needs(cores / BUSY_SHARE, 3 * jobs_per_s, jobs_per_s)  # a job is added, started and finished


def euros_per_million_frames(frame_s: float) -> float:
    """Cost of decoding. [EUR]"""
    return 1e6 * frame_s / BUSY_SHARE / 3600 * CORE_HOUR_EUR


def euros_per_thousand_hours(trace_s_per_h: float) -> float:
    """Cost of decoding recordings. [EUR]"""
    return 1e3 * trace_s_per_h / BUSY_SHARE / 3600 * CORE_HOUR_EUR


# --- the database -----------------------------------------------------------------------------------------------------

_RESULT: dict[str, Any] = {"frames": [{"index": k, "readings": [], "fix": None, "warnings": []} for k in range(10)]}


def _store_decodes(url: str, agency_id: str, seconds: float, barrier: Any, counts: Any) -> None:
    database = Database(url)
    database.open()
    count = 0
    barrier.wait()
    end = time.monotonic() + seconds
    with acting_for(agency_id):
        while time.monotonic() < end:
            now = datetime.now(UTC)
            decode_id = new_id(now)
            with database.write() as connection:
                row = DecodeRow(decode_id, "archive", {}, now, upload_key=None)
                store.add_decode(connection, agency_id, None, row)
                jobs.add_job(connection, new_job(JobKind.DECODE, decode_id, agency_id, "", now))
            with database.write() as connection:
                jobs.start_job(connection, decode_id, now)
            with database.write() as connection:
                jobs.finish_job(connection, decode_id, "done", now)
                store.store_result(connection, agency_id, decode_id, result=_RESULT, picture_key=None, now=now)
            count += 1
    counts.put(count)
    database.close()


def jobs_per_s(url: str, processes: int, seconds: float) -> float:
    """Jobs that are added, started and finished in a second, with three durable transactions each."""
    database = Database(url)
    database.open()
    database.migrate()
    ids = []
    for _number in range(processes):
        with database.write() as connection:
            ids.append(agencies.add_agency(connection, f"agency {secrets.token_hex(6)}", datetime.now(UTC)))
    database.close()
    context = multiprocessing.get_context("spawn")
    barrier, counts = context.Barrier(processes, timeout=120), context.Queue()
    workers = [
        context.Process(target=_store_decodes, args=(url, agency_id, seconds, barrier, counts)) for agency_id in ids
    ]
    for worker in workers:
        worker.start()
    total = sum(counts.get(timeout=seconds + 180) for _ in workers)
    for worker in workers:
        worker.join()
    return float(total / seconds)


# --- the table --------------------------------------------------------------------------------------------------------


def _recording_h(data: bytes) -> float:
    """Length of the recording that is decoded. [h]"""
    result = decode_recording("drive.zip", SpooledFile.of(data))
    return result.report.duration_s / 3600


def tables(short: bool) -> str:
    """What was measured, and what a fleet needs by it."""
    seconds, count = (2.0, 80) if short else (20.0, 800)
    recording = Path("docs/images/drive.zip").read_bytes()
    frame_s = PROCESSES / measure_bare("frames", make_frames(), count).per_s
    trace_s = PROCESSES / measure_bare("traces", [recording], max(8, count // 20)).per_s
    trace_s_per_h = trace_s / _recording_h(recording)
    lines = ["| database, processes that write | jobs/s added, started and finished |", "|---|---|"]
    urls = {}
    with TemporaryDirectory() as folder:
        urls["SQLite"] = f"sqlite:///{folder}/limits.sqlite3"
        if url := os.environ.get("WAYMARK_BENCH_POSTGRES_URL"):
            urls["PostgreSQL"] = url
        best = 0.0
        for name, url in urls.items():
            for processes in (1,) if name == "SQLite" else (1, 2, 4):
                rate = jobs_per_s(url, processes, seconds)
                best = max(best, rate)
                lines.append(f"| {name}, {processes} | {rate:.0f} |")
    need = needs_of_fleet(frame_s, trace_s_per_h)
    lines += [
        "",
        "| by calculation | |",
        "|---|---|",
        f"| a frame of 1080p, one core | {1e3 * frame_s:.1f} ms |",
        f"| an hour of recording, one core | {trace_s_per_h:.1f} s |",
        f"| a million frames | {1e6 * frame_s / BUSY_SHARE / 3600:.1f} core hours, "
        f"{euros_per_million_frames(frame_s):.2f} EUR at {CORE_HOUR_EUR} EUR a core hour |",
        f"| a thousand hours of recordings | {1e3 * trace_s_per_h / BUSY_SHARE / 3600:.1f} core hours, "
        f"{euros_per_thousand_hours(trace_s_per_h):.2f} EUR |",
        f"| {VEHICLES:,} vehicles, {SHARE_AT_PEAK:.0%} of them on the road | {need.decode_cores:.0f} cores of workers, "
        f"{need.jobs_per_s:.0f} jobs/s, {need.jobs_per_s / best:.0%} of what the best database above takes |",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    print(tables("--short" in sys.argv))
