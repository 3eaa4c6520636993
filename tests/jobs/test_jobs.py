"""Jobs wait for a store that is full or does not answer, however often they are tried."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest

from app.errors import StorageFull, Unavailable
from app.registry import agencies
from app.registry import jobs as store
from app.registry.column_types import new_id
from app.registry.database import Database
from app.registry.jobs import JobKind, new_job
from app.services.jobs import MAX_ATTEMPTS, Jobs, RunningJob

NOW = datetime(2026, 3, 4, 5, 6, 7, tzinfo=UTC)


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Database]:
    made = Database(f"sqlite:///{tmp_path / 'waymark.sqlite3'}")
    made.open()
    made.migrate()
    yield made
    made.close()


class Troubled:
    """Carries out a job, but fails before as often as there are errors."""

    def __init__(self, database: Database, errors: list[Exception]) -> None:
        self._database, self._errors = database, errors

    def run(self, job: RunningJob) -> None:
        if self._errors:
            raise self._errors.pop()
        with self._database.write() as connection:
            job.finish(connection, {"answer": 42})


@pytest.mark.parametrize(
    "error", [StorageFull("the database"), Unavailable("no answer"), OSError(errno.ENOSPC, "no space")]
)
def test_a_job_waits_for_room(database: Database, error: Exception) -> None:
    jobs = Jobs(database, lambda: NOW, {JobKind.PLAN: Troubled(database, [error] * (2 * MAX_ATTEMPTS))})
    with database.write() as connection:
        agency_id = agencies.add_agency(connection, "one", NOW)
        job = new_job(JobKind.PLAN, new_id(NOW), agency_id, "x", NOW)
        store.add_job(connection, job)
    for _ in range(2 * MAX_ATTEMPTS):
        with pytest.raises(Unavailable):
            jobs.run_job(job.id)
    assert jobs.list_startable() == [(job.id, agency_id, JobKind.PLAN)]
    jobs.run_job(job.id)
    with database.read() as connection:
        done = store.get_job(connection, agency_id, JobKind.PLAN, job.id)
    assert (done.state, done.result, done.attempts) == ("done", {"answer": 42}, 1)
