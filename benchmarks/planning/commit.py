"""Seconds that a commit of a plan takes, through the service, on SQLite and PostGIS."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from app.families.surveys import MarkerRules
from app.formats.alignments.geometry import AlignmentDeclaration
from app.formats.format import SpooledFile
from app.registry.database import Database
from app.registry.engines import across_agencies
from app.services.access.access import Access, Scope
from app.services.decoder_tasks import SameProcess
from app.services.plans.alignments import Alignments
from app.services.plans.plans import Plans
from app.storage.blobs import Blobs
from benchmarks.planning.roads import generated_file
from benchmarks.planning.tables import Section, table
from benchmarks.registry.servers import drop_database, make_database

GOAL_S, GOAL_MARKERS = 10.0, 50_000
"""Source: issue 13, commit of 50,000 markers on both databases."""
_DATABASE = "waymark_bench_plan_commit"
_KM, _SHORT_KM = 125.0, 2.5
_SPACING_M = 5.0
_RULES = {"version": 1, "plates": {"spacing_m": _SPACING_M}}
"""Plates alone: each is a row of the registry, while a whole line of magnets is one."""


def measure_commit(short: bool) -> Section:
    """The table."""
    km = _SHORT_KM if short else _KM
    rows, met = [], True
    for kind in ("SQLite", "PostgreSQL"):
        markers, made_s, seconds = _commit(kind, km)
        limit_s = GOAL_S * max(markers / GOAL_MARKERS, 0.2)
        met &= seconds <= limit_s
        rows.append((kind, markers, f"{made_s:.1f}", f"{seconds:.1f}", f"{markers / seconds:.0f}"))
    head = ("database", "markers", "place, check and store the plan [s]", "commit [s]", "markers/s")
    text = (
        "A plan of plates is made, approved by the holder of another key, and committed through the service, in one "
        "process.\n\n"
        f"{table(head, rows)}\n\nGoal: {GOAL_MARKERS} markers within {GOAL_S:g} s on each database."
    )
    return Section("planning-commit", text, met)


def _commit(kind: str, km: float) -> tuple[int, float, float]:
    """Markers committed, seconds to make the plan, and seconds of the commit."""
    with _database(kind) as (database, folder), across_agencies():
        access = Access(database, _now)
        author, approver = (
            access.authenticate(access.create_key("bench", Scope.PLANNER, name)) for name in ("author", "approver")
        )
        blobs, processes = Blobs(folder.as_uri()), SameProcess()
        blobs.open()
        roads = Alignments(database, _now, blobs, processes, accuracy_m=0.1)
        plans = Plans(database, _now, blobs, processes, MarkerRules())
        data = generated_file(1000 * km, 13, radii_m=(400.0, 900.0))
        road, _ = roads.add(author, "road", SpooledFile.of(data), "road.geojson", AlignmentDeclaration())
        began = time.perf_counter()
        plan, _ = plans.make(author, "plan", road["id"], _RULES)
        made_s = time.perf_counter() - began
        plan = plans.approve(approver, plan["id"], None)
        began = time.perf_counter()
        committed, _ = plans.commit(approver, plan["id"], None)
        return committed["markers"], made_s, time.perf_counter() - began


@contextmanager
def _database(kind: str) -> Iterator[tuple[Database, Path]]:
    folder = Path(tempfile.mkdtemp(prefix="waymark-bench-planning-"))
    postgres = kind != "SQLite"
    try:
        url = make_database(_DATABASE) if postgres else f"sqlite:///{folder / 'waymark.sqlite3'}"
        database = Database(url)
        database.open()
        database.migrate()
        yield database, folder
        database.close()
    finally:
        shutil.rmtree(folder)
        if postgres:
            drop_database(_DATABASE)


def _now() -> datetime:
    return datetime.now(UTC)
