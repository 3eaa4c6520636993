"""The registry beside a model in a dictionary: random changes by up to eight writers at once, on both databases."""

from __future__ import annotations

import contextlib
import itertools
import tempfile
import threading
import traceback
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, ClassVar

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule, run_state_machine_as_test

from app.errors import CodeTaken, StaleVersion
from app.families.documents import PositionIn
from app.families.plate.plates import PlateIn
from app.registry.database import Database
from app.registry.markers import MarkerFilter
from app.services.access.access import Access, Scope
from app.services.access.audit import AuditLog
from app.services.markers.markers import MarkerChange, Markers
from app.services.markers.searches import Searches
from benchmarks.registry.servers import drop_database, make_database

WRITERS = 8
STEPS = 50
_NAMES = itertools.count(1)
_ROADS = st.sampled_from(("A1", "A2", "B9"))


class RegistryModel(RuleBasedStateMachine):
    """Markers by id: version, road and status, as they should be; every run has an agency of its own."""

    database: ClassVar[Database]

    def __init__(self) -> None:
        super().__init__()
        access = Access(self.database, lambda: datetime.now(UTC))
        self.agency = f"model {next(_NAMES)} of {id(self):x}"
        self.caller = access.authenticate(access.create_key(self.agency, Scope.ADMIN, label="model"))
        self.markers = Markers(self.database, lambda: datetime.now(UTC))
        self.searches, self.audit = Searches(self.database), AuditLog(self.database)
        self.model: dict[str, tuple[int, str, str]] = {}
        self.writes = 0

    def _id(self, pick: int) -> str:
        return sorted(self.model)[pick % len(self.model)]

    @rule(road=_ROADS, place=st.integers(0, 10_000))
    def register(self, road: str, place: int) -> None:
        position = PositionIn(lon_deg=8.0 + place * 1e-3, lat_deg=49.0)
        with contextlib.suppress(CodeTaken):
            made, _ = self.markers.register(self.caller, PlateIn(position=position, road=road))
            self.model[made["id"]] = (1, road, made["status"])
            self.writes += 1

    @rule(pick=st.integers(0, 1000), road=_ROADS)
    def change(self, pick: int, road: str) -> None:
        if self.model:
            marker_id = self._id(pick)
            version, _, status = self.model[marker_id]
            self.markers.change(self.caller, marker_id, MarkerChange({"road": road}), version)
            self.model[marker_id] = (version + 1, road, status)
            self.writes += 1

    @rule(pick=st.integers(0, 1000), road=_ROADS, behind=st.integers(1, 3))
    def change_an_older_version(self, pick: int, road: str, behind: int) -> None:
        if self.model:
            marker_id = self._id(pick)
            with contextlib.suppress(StaleVersion):
                self.markers.change(
                    self.caller, marker_id, MarkerChange({"road": road}), self.model[marker_id][0] - behind
                )
                raise AssertionError("a change of an older version was stored")

    @rule(pick=st.integers(0, 1000), roads=st.lists(_ROADS, min_size=2, max_size=WRITERS))
    def race(self, pick: int, roads: list[str]) -> None:
        """Several writers change one version at the same time: one of them does."""
        if not self.model:
            return
        marker_id = self._id(pick)
        version, _, status = self.model[marker_id]
        start = threading.Barrier(len(roads))

        def change(road: str) -> str | None:
            start.wait()
            try:
                self.markers.change(self.caller, marker_id, MarkerChange({"road": road}), version)
            except StaleVersion:
                return None
            return road

        with ThreadPoolExecutor(len(roads)) as writers:
            won = [road for road in writers.map(change, roads) if road is not None]
        assert len(won) == 1, f"{len(won)} of {len(roads)} writers changed the same version"
        self.model[marker_id] = (version + 1, won[0], status)
        self.writes += 1

    @rule(road=_ROADS)
    def search(self, road: str) -> None:
        found, _ = self.searches.page(self.caller, MarkerFilter(road=road), limit=1000)
        assert {m["id"] for m in found} == {key for key, (_, of, _) in self.model.items() if of == road}

    @rule(pick=st.integers(0, 1000))
    def history(self, pick: int) -> None:
        if self.model:
            marker_id = self._id(pick)
            versions, _ = self.markers.history(self.caller, marker_id, limit=1000)
            assert [v["version"] for v in versions] == list(range(1, self.model[marker_id][0] + 1))

    @invariant()
    def rows_are_as_modelled(self) -> None:
        for marker_id in list(self.model)[-3:]:
            stored: Any = self.markers.get(self.caller, marker_id)
            assert (stored["version"], stored["road"], stored["status"]) == self.model[marker_id]

    def teardown(self) -> None:
        for _, report, faults in self.audit.verify(self.agency):
            assert list(faults) == []
            assert report.versions == self.writes


def run_model(database: Database, runs: int, steps: int = STEPS, *, seeded: bool = False) -> None:
    """Run the model; raises what differs, at the shortest steps that show it.

    Parameters
    ----------
    database : Database
    runs, steps : int
    seeded : bool
        The same runs every time.
    """
    run_state_machine_as_test(
        type("Model", (RegistryModel,), {"database": database}),
        settings=settings(
            max_examples=runs, stateful_step_count=steps, deadline=None, database=None, derandomize=seeded,
            suppress_health_check=list(HealthCheck),
        ),
    )  # fmt: skip


def compare_with_model(runs: int) -> Iterator[tuple[str, list[str]]]:
    """Run it on SQLite and PostgreSQL: name of the database, and the failure if there is one."""
    name = "waymark_fuzz_registry"
    with tempfile.TemporaryDirectory() as folder:
        sqlite = f"sqlite:///{Path(folder) / 'waymark.sqlite3'}"
        for kind, url in (("SQLite", sqlite), ("PostgreSQL", make_database(name))):
            database = Database(url)
            database.open()
            database.migrate()
            failures = []
            try:
                run_model(database, runs)
            except Exception:  # noqa: BLE001 - whatever it is, it is what we look for
                failures.append(traceback.format_exc())
            database.close()
            yield kind, failures
    drop_database(name)
