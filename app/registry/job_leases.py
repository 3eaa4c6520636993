"""Which process runs a job, and which jobs may be started.

On PostgreSQL several processes run jobs. Each holds a lease on the jobs that it runs and renews it; the job of a
process that died may be started again when its lease has ended. On SQLite one process owns the file, so there are no
leases: what is running when it opens the file was left by an earlier process.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from datetime import datetime, timedelta

import sqlalchemy as sa

from app.registry.column_types import UtcTime
from app.registry.jobs import UNFINISHED, JobKind, JobRow, UnfinishedJob, end_job
from app.registry.rows import find_one, select_rows
from app.registry.tables import jobs

LEASE = timedelta(seconds=15)
"""How long a job stays with a process that does not renew its lease. Source: by hand; a process renews three times as
often (`app.services.job_leases`), and a job of a killed one is to run again within a minute."""
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
