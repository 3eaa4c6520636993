"""Queries on jobs: work that outlives the request that asked for it, its leases and counts."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from datetime import datetime, timedelta
from enum import StrEnum
from typing import Literal, NamedTuple

import sqlalchemy as sa

from app import tracing
from app.errors import NotFound
from app.registry import column_types
from app.registry.column_types import (
    ID,
    AnyColumn,
    UtcTime,
    agency_column,
    fetch_all,
    fetch_in,
    find_one,
    metadata,
    one_of,
    select_rows,
)
from app.registry.webhooks import add_event, events
from app.values import JsonObject

# work that outlives the request that asked for it; what is true of a job is true in its row, and nowhere else
UNFINISHED_JOBS = sa.text("state IN ('queued', 'running')")

jobs = sa.Table(
    "jobs",
    metadata,
    sa.Column("id", ID, primary_key=True),
    agency_column(),
    sa.Column("holder_id", sa.String(200)),  # of the key that asked for it
    sa.Column("kind", sa.String(32), nullable=False),
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("attempts", sa.Integer, nullable=False, server_default="0"),
    sa.Column("progress", sa.Double, nullable=False, server_default="0"),
    sa.Column("cancel_requested", sa.Boolean, nullable=False, server_default=sa.false()),
    sa.Column("input", sa.JSON, nullable=False),
    sa.Column("upload_key", sa.String(200)),
    sa.Column("result", sa.JSON(none_as_null=True)),
    sa.Column("error", sa.JSON(none_as_null=True)),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("finished_at", UtcTime),
    sa.Column("subject_id", ID),  # of the row that it is about, e.g. a plan
    sa.Column("steps_done", sa.Integer),
    sa.Column("steps_total", sa.Integer),
    sa.Column("started_at", UtcTime),  # first
    sa.Column("runner", sa.String(100)),  # the run of a job that has the lease
    sa.Column("lease_until", UtcTime),
    sa.Column("turn_at", UtcTime),  # when it was started last
    sa.Column("dead_letter", sa.Boolean, nullable=False, server_default=sa.false()),
    sa.Column("traceparent", sa.String(55)),  # of the span that made it
    one_of("state", column_types.JOB_STATES),
    sa.Index("ix_jobs_agency_id_kind_id", "agency_id", "kind", "id"),
    sa.Index("ix_jobs_agency_id_id", "agency_id", "id"),
    sa.Index("ix_jobs_state", "state"),
    sa.Index("ix_jobs_subject_id", "subject_id"),
    sa.Index("ix_jobs_agency_id_kind_turn_at", "agency_id", "kind", "turn_at"),
    sa.Index(
        "ix_jobs_unfinished",
        "kind",
        "agency_id",
        "id",
        postgresql_where=UNFINISHED_JOBS,
        sqlite_where=UNFINISHED_JOBS,
    ),
)

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
    ARTWORK = "artwork"
    """Draws plates into one ZIP."""
    REPROCESS = "reprocess"
    """Decodes a shard of stored uploads again."""
    EXPORT = "export"
    """Writes markers into a file."""
    DRIVE = "drive"
    """Fuses decodes of one drive into a track. The input names them, the result is its report and its files."""
    AUDIT = "audit"
    """Verifies the agency's log."""


class JobRow(NamedTuple):
    """A job."""

    id: str
    agency_id: str
    holder_id: str | None  # of the key that asked for it
    kind: str
    state: JobState
    attempts: int
    progress: float  # from 0 to 1
    cancel_requested: bool
    input: JsonObject  # what the job needs to know besides its upload
    upload_key: str | None  # key of the blob that the job reads
    # `result`, `error`: what the job returned, or why it failed
    result: JsonObject | None
    error: dict[str, str] | None
    created_at: datetime
    finished_at: datetime | None
    subject_id: str | None = None  # of the row that it is about, e.g. a plan.
    # `steps_done`, `steps_total`: of jobs that are divided into steps, once they are known
    steps_done: int | None = None
    steps_total: int | None = None
    started_at: datetime | None = None  # when it was started first
    dead_letter: bool = False  # whether it failed because it stopped the processes that worked on it


class UnfinishedJob(NamedTuple):
    """A job that is still to be done."""

    id: str
    agency_id: str
    kind: JobKind


def new_job(
    kind: JobKind, job_id: str, agency_id: str, holder_id: str, now: datetime,
    *, job_input: Mapping[str, object] | None = None, upload_key: str | None = None, subject_id: str | None = None,
) -> JobRow:  # fmt: skip
    """A job that waits to be started."""
    return JobRow(
        job_id, agency_id, holder_id, kind, "queued", 0, 0.0, False, dict(job_input or {}), upload_key, None, None, now,
        None, subject_id,
    )  # fmt: skip


def add_job(connection: sa.Connection, job: JobRow) -> None:
    """Store a new job."""
    connection.execute(sa.insert(jobs), {**job._asdict(), "traceparent": tracing.current()})


def find_traceparent(connection: sa.Connection, job_id: str) -> str | None:
    """The context of the span that made a job."""
    return connection.execute(sa.select(jobs.c.traceparent).where(jobs.c.id == job_id)).scalar_one_or_none()


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


def find_job(connection: sa.Connection, agency_id: str, job_id: str) -> JobRow | None:
    """One job of the agency, of any kind."""
    return find_one(
        connection, select_rows(JobRow, jobs).where(jobs.c.id == job_id, jobs.c.agency_id == agency_id), JobRow
    )


def list_progress(connection: sa.Connection, job_ids: Sequence[str]) -> list[JobRow]:
    """Jobs with some ids, of the agencies of the transaction, without their inputs and results."""
    query = sa.select(*_without("input", "result"))
    return list(fetch_in(connection, query, JobRow, jobs.c.id, job_ids))


def _without(*names: str) -> list[AnyColumn]:
    return [sa.null().label(name) if name in names else jobs.c[name] for name in JobRow._fields]


def list_jobs(
    connection: sa.Connection, agency_id: str, kind: JobKind | Sequence[JobKind],
    *, state: str | None, before: str | None, limit: int, subject_id: str | None = None, holder_id: str | None = None,
    dead_letter: bool | None = None,
) -> list[JobRow]:  # fmt: skip
    """Jobs of one kind or of several without their results, newest first; of anybody, or of one holder of a key."""
    query = sa.select(*_without("result")).where(jobs.c.agency_id == agency_id, _of_kind(kind))
    if holder_id is not None:
        query = query.where(jobs.c.holder_id == holder_id)
    if subject_id is not None:
        query = query.where(jobs.c.subject_id == subject_id)
    if state is not None:
        query = query.where(jobs.c.state == state)
    if dead_letter is not None:
        query = query.where(jobs.c.dead_letter == dead_letter)
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


def record_progress(
    connection: sa.Connection, job_id: str, progress: float, *, steps: tuple[int, int] | None = None, kept: bool = False
) -> bool:
    """Record how far a running job is. Returns False if it was cancelled or is gone, so that it has to stop.

    Parameters
    ----------
    steps : (int, int), optional
        Steps that are done, and all.
    kept : bool, optional
        A part of the result was stored, which the next attempt need not compute: attempts are counted from zero again.
    """
    values: dict[str, object] = {"progress": progress}
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
        A job beyond this progress is not stopped any more, nor while it waits to go on.
    """
    own = (jobs.c.id == job_id, jobs.c.agency_id == agency_id, jobs.c.progress < below_progress)
    queued = sa.update(jobs).where(*own, jobs.c.state == "queued")
    end_job(connection, queued.values(state="cancelled", cancel_requested=True, finished_at=now), now)
    running = sa.update(jobs).where(*own, jobs.c.state == "running")
    connection.execute(running.values(cancel_requested=True))


def finish_job(
    connection: sa.Connection, job_id: str, state: JobState, now: datetime,
    *, result: Mapping[str, object] | None = None, error: Mapping[str, object] | None = None,
    subject_id: str | None = None, dead_letter: bool = False,
) -> bool:  # fmt: skip
    """Record how a job ended, unless it has ended before. Returns whether it did now.

    Parameters
    ----------
    dead_letter : bool, optional
        It stopped the processes that worked on it, so it is not to be run again as it is.
    """
    values: dict[str, object] = {
        "state": state, "finished_at": now, "result": result, "error": error, "dead_letter": dead_letter,
        "lease_until": None,
    }  # fmt: skip
    if subject_id is not None:
        values["subject_id"] = subject_id
    if state == "done":
        values["progress"] = 1.0
    statement = sa.update(jobs).where(jobs.c.id == job_id, jobs.c.state.in_(UNFINISHED)).values(**values)
    return end_job(connection, statement, now)


def event_of_holder(agency_id: str, holder_id: str) -> sa.ColumnElement[bool]:
    """Whether an event is about a job that a holder asked for."""
    own = sa.select(jobs.c.id).where(
        jobs.c.id == events.c.subject_id, jobs.c.agency_id == agency_id, jobs.c.holder_id == holder_id
    )
    return sa.and_(events.c.kind.like("job.%"), own.exists())


def delete_job(connection: sa.Connection, agency_id: str, job_id: str) -> bool:
    """Delete a finished job with its result. Returns whether there was one."""
    statement = sa.delete(jobs).where(
        jobs.c.id == job_id, jobs.c.agency_id == agency_id, jobs.c.state.not_in(UNFINISHED)
    )
    return connection.execute(statement).rowcount == 1


def end_job(connection: sa.Connection, statement: sa.Update, now: datetime) -> bool:
    """End a job by a statement, with an event for those who wait for it. Returns whether it had not ended before."""
    returned = statement.returning(jobs.c.id, jobs.c.agency_id, jobs.c.kind, jobs.c.state)
    ended = connection.execute(returned).one_or_none()
    if ended is None:
        return False
    detail = {"job_kind": ended.kind}
    add_event(connection, ended.agency_id, f"job.{ended.state}", subject_id=ended.id, at=now, detail=detail)
    return True


def _of_kind(kind: JobKind | Sequence[JobKind]) -> sa.ColumnElement[bool]:
    return jobs.c.kind == kind if isinstance(kind, JobKind) else jobs.c.kind.in_(kind)


def list_ended(connection: sa.Connection, kinds: Sequence[JobKind], before: datetime) -> list[JobRow]:
    """Jobs of some kinds that were done before a time, of the agencies of the transaction."""
    query = select_rows(JobRow, jobs).where(jobs.c.state == "done", _of_kind(kinds), jobs.c.finished_at < before)
    return fetch_all(connection, query.order_by(jobs.c.id), JobRow)


def replace_result(connection: sa.Connection, job_id: str, result: Mapping[str, object]) -> None:
    """Store another result of a job that is done."""
    connection.execute(sa.update(jobs).where(jobs.c.id == job_id, jobs.c.state == "done").values(result=dict(result)))


# === Which process runs a job, and which jobs may be started.
#
# On PostgreSQL several processes run jobs. Each holds a lease on the jobs that it runs and renews it; the job of a
# process that died may be started again when its lease has ended. On SQLite one process owns the file, so there are no
# leases: what is running when it opens the file was left by an earlier process.


LEASE = timedelta(seconds=15)
"""How long a job stays with a process that does not renew its lease. A process renews three times as often
(`app.services.jobs`), and a job of a killed one is to run again within a minute."""
_ONE_AT_A_TIME = 0x5741594D41524C  # "WAYMARL": another lock than that of writers in engines.py


def start_job(connection: sa.Connection, job_id: str, now: datetime, runner: str = "") -> JobRow | None:
    """Start a job that is queued, or whose process died; None if it is finished, gone, or another process runs it.

    Parameters
    ----------
    runner : str
        Names this run in `renew_leases` and `return_job`.
    """
    time = _database_time(connection, now)
    lease_until = time + LEASE if _has_leases(connection) else None
    started_at = sa.func.coalesce(jobs.c.started_at, sa.literal(now, UtcTime))
    statement = (
        sa.update(jobs)
        .where(jobs.c.id == job_id, _may_start(time))
        .values(
            state="running", attempts=jobs.c.attempts + 1, started_at=started_at, turn_at=time, runner=runner,
            lease_until=lease_until,
        )
    )  # fmt: skip
    if connection.execute(statement).rowcount != 1:
        return None
    return find_one(connection, select_rows(JobRow, jobs).where(jobs.c.id == job_id), JobRow)


def renew_leases(connection: sa.Connection, runners: Collection[str], now: datetime) -> None:
    """Keep the jobs of some runs for another `LEASE`."""
    lease_until = _database_time(connection, now) + LEASE
    statement = sa.update(jobs).where(jobs.c.runner.in_(runners), jobs.c.state == "running")
    connection.execute(statement.values(lease_until=lease_until))


def return_job(connection: sa.Connection, job_id: str, runner: str, now: datetime) -> None:
    """Let a job wait again that stopped through no fault of its own; this start is not counted.

    One that somebody has cancelled meanwhile ends.
    """
    own = sa.and_(jobs.c.id == job_id, jobs.c.state == "running", jobs.c.runner == runner)
    cancelled = sa.update(jobs).where(own, jobs.c.cancel_requested)
    if end_job(connection, cancelled.values(state="cancelled", finished_at=now), now):
        return
    attempts = sa.case((jobs.c.attempts > 0, jobs.c.attempts - 1), else_=0)
    waiting = sa.update(jobs).where(own)
    connection.execute(waiting.values(state="queued", attempts=attempts, runner=None, lease_until=None))


def list_startable(connection: sa.Connection, now: datetime) -> list[UnfinishedJob]:
    """The jobs of all agencies that may be started, oldest first."""
    query = sa.select(jobs.c.id, jobs.c.agency_id, jobs.c.kind).where(_may_start(_database_time(connection, now)))
    rows = connection.execute(query.order_by(jobs.c.id))
    return [UnfinishedJob(job_id, agency_id, JobKind(kind)) for job_id, agency_id, kind in rows]


def list_next(
    connection: sa.Connection, kinds: Sequence[JobKind], now: datetime, limit: int = 1
) -> list[UnfinishedJob]:
    """The jobs of some kinds whose turn it is, one of each agency at most.

    The agency of which a job of these kinds was started longest ago comes first, with its oldest job.
    """
    time = _database_time(connection, now)
    waiting = (
        sa.select(jobs.c.agency_id, sa.func.min(jobs.c.id).label("id"))
        .where(_may_start(time), jobs.c.kind.in_(kinds))
        .group_by(jobs.c.agency_id)
        .subquery()
    )
    earlier = jobs.alias()
    turns = [
        sa.func.coalesce(
            sa.select(sa.func.max(earlier.c.turn_at))
            .where(earlier.c.agency_id == waiting.c.agency_id, earlier.c.kind == kind)
            .scalar_subquery()
            .correlate(waiting),
            sa.literal(datetime(1970, 1, 1, tzinfo=now.tzinfo), UtcTime),
        )
        for kind in kinds
    ]
    latest = sa.func.greatest(*turns) if connection.dialect.name == "postgresql" else sa.func.max(*turns)
    turn = latest if len(turns) > 1 else turns[0]
    query = (
        sa.select(jobs.c.id, jobs.c.agency_id, jobs.c.kind)
        .join(waiting, waiting.c.id == jobs.c.id)
        .order_by(turn, jobs.c.id)
        .limit(limit)
    )
    return [UnfinishedJob(job_id, agency_id, JobKind(kind)) for job_id, agency_id, kind in connection.execute(query)]


def count_startable(connection: sa.Connection, now: datetime) -> dict[JobKind, int]:
    """How many jobs of each kind may be started."""
    may_start = _may_start(_database_time(connection, now))
    query = sa.select(jobs.c.kind, sa.func.count()).where(may_start).group_by(jobs.c.kind)
    return {JobKind(kind): count for kind, count in connection.execute(query)}


def is_only_one(connection: sa.Connection) -> bool:
    """Whether no other process is in a transaction in which this was true, until this transaction ends."""
    if connection.dialect.name != "postgresql":
        return True
    return bool(connection.exec_driver_sql(f"SELECT pg_try_advisory_xact_lock({_ONE_AT_A_TIME})").scalar_one())


def _may_start(time: datetime) -> sa.ColumnElement[bool]:
    ended = sa.or_(jobs.c.lease_until.is_(None), jobs.c.lease_until < time)
    return sa.and_(jobs.c.state.in_(UNFINISHED), sa.or_(jobs.c.state == "queued", ended))


def _has_leases(connection: sa.Connection) -> bool:
    return connection.dialect.name == "postgresql"


def _database_time(connection: sa.Connection, now: datetime) -> datetime:
    """The time on the clock that all processes share; `now` where there is one process."""
    if not _has_leases(connection):
        return now
    time: datetime = connection.exec_driver_sql("SELECT clock_timestamp()").scalar_one()
    return time


# === How many jobs of all agencies wait and run, for metrics.


class JobCount(NamedTuple):
    """Unfinished jobs of a kind and a state: how many, and when the oldest of them was made."""

    kind: str
    state: str
    number: int
    oldest: datetime


def count_unfinished(connection: sa.Connection) -> list[JobCount]:
    """Unfinished jobs, counted with a partial index, whatever the number of those that have ended."""
    oldest = sa.type_coerce(sa.func.min(jobs.c.created_at), UtcTime)
    query = sa.select(jobs.c.kind, jobs.c.state, sa.func.count(), oldest)
    query = query.where(jobs.c.state.in_(UNFINISHED)).group_by(jobs.c.kind, jobs.c.state)
    return [JobCount(*row) for row in connection.execute(query)]
