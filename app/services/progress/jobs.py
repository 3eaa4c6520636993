"""Jobs of every kind are listed, read and cancelled alike."""

from __future__ import annotations

from collections.abc import Sequence

import sqlalchemy as sa

from app.errors import Conflict, NotAllowed, NotFound
from app.registry import jobs as store
from app.registry.database import Database
from app.registry.jobs import UNFINISHED, JobKind, JobRow
from app.registry.tenancy import across_agencies
from app.services.access.access import Caller
from app.services.ports import Clock
from app.services.progress.documents import JobDocument, JobPage, job_document
from app.services.progress.kinds import may_cancel, rules_of, visible_kinds


class AllJobs:
    """Use cases on jobs, whatever they do. A caller sees the kinds whose resources its scope may read.

    Attributes
    ----------
    clock : Clock
    """

    def __init__(self, database: Database, clock: Clock) -> None:
        self._database, self.clock = database, clock

    def get(self, caller: Caller, job_id: str) -> JobDocument:
        """A job with its progress.

        Raises
        ------
        NotFound
            There is none with this id that the caller may see.
        """
        return job_document(self.row(caller, job_id), self.clock())

    def row(self, caller: Caller, job_id: str) -> JobRow:
        """As `get`, as a row."""
        with self._database.read() as connection:
            return _visible(connection, caller, job_id)

    def page(
        self, caller: Caller, *, kind: JobKind | None = None, state: str | None = None, dead_letter: bool | None = None,
        before: str | None = None, limit: int = 100,
    ) -> tuple[JobPage, str | None]:  # fmt: skip
        """A page of jobs, newest first, and the id to continue before."""
        kinds = [one for one in visible_kinds(caller) if kind is None or one == kind]
        with self._database.read() as connection:
            rows = store.list_jobs(
                connection, caller.agency_id, kinds,
                state=state, before=before, limit=limit + 1, holder_id=caller.own_key_id, dead_letter=dead_letter,
            )  # fmt: skip
        now = self.clock()
        page = JobPage(items=[job_document(row, now) for row in rows[:limit]])
        return page, rows[limit - 1].id if len(rows) > limit else None

    def cancel(self, caller: Caller, job_id: str) -> JobDocument:
        """Cancel a job: a queued one never starts, a running one stops at its next step, a finished one stays.

        Raises
        ------
        NotFound
            There is none with this id that the caller may see.
        NotAllowed
            It is another's, and the scope does not cover that.
        Conflict
            It is too late: what it makes is being stored.
        """
        with self._database.write() as connection:
            job = _visible(connection, caller, job_id)
            if not may_cancel(caller, job):
                raise NotAllowed(
                    f"a key with the scope {caller.scope} may not cancel this job",
                    limit="the key that asked for it, or " + " or ".join(sorted(rules_of(job.kind).cancellers)),
                )
            limit = rules_of(job.kind).too_late_progress
            if job.state in UNFINISHED and job.progress >= limit:
                raise Conflict(
                    f"the {job.kind} is storing already", field="job_id", limit="jobs that store nothing yet",
                    cure="read its result",
                )  # fmt: skip
            store.request_cancel(connection, caller.agency_id, job_id, self.clock(), below_progress=limit)
            return job_document(_visible(connection, caller, job_id), self.clock())

    def watched(self, job_ids: Sequence[str]) -> dict[str, JobRow]:
        """Jobs by their ids, without inputs and results; whoever follows one was checked before."""
        with across_agencies(), self._database.read() as connection:
            return {row.id: row for row in store.list_progress(connection, job_ids)}


def _visible(connection: sa.Connection, caller: Caller, job_id: str) -> JobRow:
    job = store.find_job(connection, caller.agency_id, job_id)
    if (
        job is None
        or caller.scope not in rules_of(job.kind).readers
        or caller.own_key_id not in (None, job.holder_id)
    ):  # fmt: skip
        raise NotFound(f"there is no job {job_id}", field="job_id", cure="GET /v1/jobs lists yours")
    return job
