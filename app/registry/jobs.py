"""Queries on jobs: work that outlives the request that asked for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from enum import StrEnum
from typing import Any, Literal, NamedTuple

import sqlalchemy as sa

from app.errors import NotFound
from app.registry.rows import fetch_all, find_one, select_rows
from app.registry.tables import jobs

JobState = Literal["queued", "running", "done", "failed", "cancelled"]
UNFINISHED = ("queued", "running")


class JobKind(StrEnum):
    """What a job does; `app.services.jobs` has one handler for each."""

    DECODE = "decode"
    """Decodes the upload of the row of `decodes` with the same id. The result is stored there."""
    IMPORT = "import"
    """Imports a survey. The input is its declaration, the result its report."""
    PLAN = "plan"
    """Makes a plan of a long road."""
    PROOF = "proof"
    """Proves a plan by simulated drives; finished units are in `proof_units`."""
    PACKAGE = "package"
    """Writes all files of a plan into one ZIP."""


class JobRow(NamedTuple):
    """A job.

    Attributes
    ----------
    holder_id : str or None
        Of the key that asked for it.
    progress : float
        From 0 to 1.
    input : dict
        What the job needs to know besides its upload.
    upload_key : str or None
        Key of the blob that the job reads.
    result, error : dict or None
        What the job returned, or why it failed.
    subject_id : str or None
        Of the row that it is about, e.g. a plan.
    steps_done, steps_total : int or None
        Of jobs that are divided into steps, once they are known.
    """

    id: str
    agency_id: str
    holder_id: str | None
    kind: str
    state: JobState
    attempts: int
    progress: float
    cancel_requested: bool
    input: dict[str, Any]
    upload_key: str | None
    result: dict[str, Any] | None
    error: dict[str, str] | None
    created_at: datetime
    finished_at: datetime | None
    subject_id: str | None = None
    steps_done: int | None = None
    steps_total: int | None = None


def new_job(
    kind: JobKind, job_id: str, agency_id: str, holder_id: str, now: datetime,
    *, job_input: Mapping[str, Any] | None = None, upload_key: str | None = None, subject_id: str | None = None,
) -> JobRow:  # fmt: skip
    """A job that waits to be started."""
    return JobRow(
        job_id, agency_id, holder_id, kind, "queued", 0, 0.0, False, dict(job_input or {}), upload_key, None, None, now,
        None, subject_id,
    )  # fmt: skip


def add_job(connection: sa.Connection, job: JobRow) -> None:
    """Store a new job."""
    connection.execute(sa.insert(jobs), job._asdict())


def get_job(connection: sa.Connection, agency_id: str, kind: JobKind | Sequence[JobKind], job_id: str) -> JobRow:
    """One job of the agency, of one kind or of several.

    Raises
    ------
    NotFound
        There is none of this kind with this id, or it belongs to another agency.
    """
    query = select_rows(JobRow, jobs).where(jobs.c.id == job_id, jobs.c.agency_id == agency_id, _of_kind(kind))
    row = find_one(connection, query, JobRow)
    if row is None:
        name = kind if isinstance(kind, JobKind) else "job"
        raise NotFound(f"there is no {name} {job_id}", field=f"{name}_id")
    return row


def list_jobs(
    connection: sa.Connection, agency_id: str, kind: JobKind | Sequence[JobKind],
    *, state: str | None, before: str | None, limit: int, subject_id: str | None = None,
) -> list[JobRow]:  # fmt: skip
    """Jobs of one kind or of several without their results, newest first."""
    columns = [sa.null().label("result") if name == "result" else jobs.c[name] for name in JobRow._fields]
    query = sa.select(*columns).where(jobs.c.agency_id == agency_id, _of_kind(kind))
    if subject_id is not None:
        query = query.where(jobs.c.subject_id == subject_id)
    if state is not None:
        query = query.where(jobs.c.state == state)
    if before is not None:
        query = query.where(jobs.c.id < before)
    return fetch_all(connection, query.order_by(jobs.c.id.desc()).limit(limit), JobRow)


def find_job_about(
    connection: sa.Connection, agency_id: str, kind: JobKind, subject_id: str, states: Sequence[str]
) -> JobRow | None:
    """The newest job of a kind about a row, in one of some states."""
    query = select_rows(JobRow, jobs).where(
        jobs.c.subject_id == subject_id, jobs.c.agency_id == agency_id, jobs.c.kind == kind, jobs.c.state.in_(states)
    )
    return find_one(connection, query.order_by(jobs.c.id.desc()).limit(1), JobRow)


def list_unfinished(connection: sa.Connection, kinds: Sequence[JobKind] = tuple(JobKind)) -> list[tuple[str, str]]:
    """Ids and agencies of the jobs of some kinds and all agencies that are still to be done, oldest first."""
    unfinished = jobs.c.state.in_(UNFINISHED)
    query = sa.select(jobs.c.id, jobs.c.agency_id).where(unfinished, _of_kind(kinds)).order_by(jobs.c.id)
    return [(job_id, agency_id) for job_id, agency_id in connection.execute(query)]


def start_job(connection: sa.Connection, job_id: str) -> JobRow | None:
    """Start a job that is queued, or that an earlier process left running; None if it is finished or gone."""
    statement = (
        sa.update(jobs)
        .where(jobs.c.id == job_id, jobs.c.state.in_(UNFINISHED))
        .values(state="running", attempts=jobs.c.attempts + 1)
    )
    if connection.execute(statement).rowcount != 1:
        return None
    return find_one(connection, select_rows(JobRow, jobs).where(jobs.c.id == job_id), JobRow)


def return_attempt(connection: sa.Connection, job_id: str) -> None:
    """Do not count the start of a job that stopped through no fault of its own."""
    statement = sa.update(jobs).where(jobs.c.id == job_id, jobs.c.state == "running", jobs.c.attempts > 0)
    connection.execute(statement.values(attempts=jobs.c.attempts - 1))


def record_progress(
    connection: sa.Connection, job_id: str, progress: float,
    *, steps: tuple[int, int] | None = None, kept: bool = False,
) -> bool:  # fmt: skip
    """Record how far a running job is. Returns False if it was cancelled or is gone, so that it has to stop.

    Parameters
    ----------
    steps : (int, int), optional
        Steps that are done, and all.
    kept : bool, optional
        A part of the result was stored, which the next attempt need not compute: attempts are counted anew.
    """
    values: dict[str, Any] = {"progress": progress}
    if steps is not None:
        values["steps_done"], values["steps_total"] = steps
    if kept:
        values["attempts"] = 1
    statement = sa.update(jobs).where(
        jobs.c.id == job_id, jobs.c.state == "running", jobs.c.cancel_requested.is_(False)
    )
    return connection.execute(statement.values(**values)).rowcount == 1


def request_cancel(
    connection: sa.Connection, agency_id: str, job_id: str, now: datetime, *, below_progress: float = 2.0
) -> None:
    """Ask a job to stop: a queued one is cancelled now, a running one when it reports its progress next.

    Parameters
    ----------
    below_progress : float, optional
        A running job that has come so far is not stopped any more.
    """
    own = (jobs.c.id == job_id, jobs.c.agency_id == agency_id)
    queued = sa.update(jobs).where(*own, jobs.c.state == "queued")
    connection.execute(queued.values(state="cancelled", cancel_requested=True, finished_at=now))
    running = sa.update(jobs).where(*own, jobs.c.state == "running", jobs.c.progress < below_progress)
    connection.execute(running.values(cancel_requested=True))


def finish_job(
    connection: sa.Connection, job_id: str, state: JobState, now: datetime,
    *, result: Mapping[str, Any] | None = None, error: Mapping[str, object] | None = None,
    subject_id: str | None = None,
) -> bool:  # fmt: skip
    """Record how a job ended, unless it has ended before. Returns whether it did now."""
    values: dict[str, Any] = {"state": state, "finished_at": now, "result": result, "error": error}
    if subject_id is not None:
        values["subject_id"] = subject_id
    if state == "done":
        values["progress"] = 1.0
    statement = sa.update(jobs).where(jobs.c.id == job_id, jobs.c.state.in_(UNFINISHED)).values(**values)
    return connection.execute(statement).rowcount == 1


def _of_kind(kind: JobKind | Sequence[JobKind]) -> sa.ColumnElement[bool]:
    return jobs.c.kind == kind if isinstance(kind, JobKind) else jobs.c.kind.in_(kind)
