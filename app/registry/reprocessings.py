"""Queries on reprocessings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import datetime
from typing import NamedTuple

import sqlalchemy as sa

from app.registry.column_types import ID, UtcTime, agency_column, fetch_all, metadata, select_rows
from app.registry.decodes import decodes
from app.registry.jobs import JobKind, jobs, request_cancel
from app.registry.resources import Resource
from app.registry.vehicles import vehicle_uploads
from app.values import JsonObject

reprocessings = sa.Table(
    "reprocessings",
    metadata,
    sa.Column("id", ID, primary_key=True),
    agency_column(),
    sa.Column("who", sa.String(200), nullable=False),
    sa.Column("criteria", sa.JSON, nullable=False),
    sa.Column("decodes", sa.Integer, nullable=False),  # to be decoded again
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("approved_at", UtcTime),
    sa.Column("approved_by", sa.String(200)),
    sa.Index("ix_reprocessings_agency_id_id", "agency_id", "id"),
)

reprocessed_decodes = sa.Table(
    "reprocessed_decodes",
    metadata,
    sa.Column("reprocessing_id", ID, sa.ForeignKey("reprocessings.id"), primary_key=True),
    sa.Column("decode_id", ID, sa.ForeignKey("decodes.id"), primary_key=True),
    agency_column(),
    sa.Column("decoder_before", sa.String(200)),
    sa.Column("decoder", sa.String(200)),
    sa.Column("result", sa.JSON(none_as_null=True)),  # null where it failed
    sa.Column("picture_key", sa.String(200)),
    sa.Column("error", sa.JSON(none_as_null=True)),
    sa.Column("changes", sa.JSON, nullable=False),
    sa.Column("gained", sa.Integer, nullable=False),
    sa.Column("lost", sa.Integer, nullable=False),
    sa.Column("changed", sa.Integer, nullable=False),
    sa.Column("same", sa.Integer, nullable=False),
)

# results that were current before; the newest is in `decodes`
decode_versions = sa.Table(
    "decode_versions",
    metadata,
    sa.Column("decode_id", ID, sa.ForeignKey("decodes.id"), primary_key=True),
    sa.Column("reprocessing_id", ID, sa.ForeignKey("reprocessings.id"), primary_key=True),  # that replaced it
    agency_column(),
    sa.Column("decoder", sa.String(200)),
    sa.Column("result", sa.JSON, nullable=False),
    sa.Column("picture_key", sa.String(200)),
    sa.Column("finished_at", UtcTime),
    sa.Column("replaced_at", UtcTime, nullable=False),
)

_R, _D = reprocessed_decodes.c, decodes.c
_ROWS = 1_000


class ReprocessingRow(NamedTuple):
    """A reprocessing; `decodes` is the number of uploads that are decoded again."""

    id: str
    agency_id: str
    who: str
    criteria: JsonObject
    decodes: int
    created_at: datetime
    approved_at: datetime | None = None
    approved_by: str | None = None


class ReprocessedRow(NamedTuple):
    """An upload that was decoded again, and how its readings differ; `result` is None where that failed."""

    reprocessing_id: str
    decode_id: str
    agency_id: str
    decoder_before: str | None
    decoder: str | None
    result: dict[str, object] | None
    picture_key: str | None
    error: dict[str, object] | None
    changes: list[dict[str, object]]
    gained: int
    lost: int
    changed: int
    same: int


class StoredDecode(NamedTuple):
    """What decides whether an upload is decoded again."""

    id: str
    context: dict[str, object]
    decoder: str | None


class VersionRow(NamedTuple):
    """A result that was replaced."""

    decode_id: str
    reprocessing_id: str
    decoder: str | None
    result: JsonObject
    finished_at: datetime | None
    replaced_at: datetime


REPROCESSINGS = Resource("reprocessing", ReprocessingRow, reprocessings, "GET /v1/reprocessings lists them")


def stream_decodes(
    connection: sa.Connection, agency_id: str, *, kinds: Sequence[str] | None, since: datetime | None,
    until: datetime | None, vehicle_id: str | None,
) -> Iterator[StoredDecode]:  # fmt: skip
    """Decodes of an agency with a result and an upload, oldest first."""
    query = sa.select(_D.id, _D.context, _D.decoder).where(
        _D.agency_id == agency_id, _D.finished_at.is_not(None), _D.result.is_not(None), _D.upload_key.is_not(None)
    )
    if kinds is not None:
        query = query.where(_D.kind.in_(kinds))
    if since is not None:
        query = query.where(_D.created_at >= since)
    if until is not None:
        query = query.where(_D.created_at < until)
    if vehicle_id is not None:
        query = query.join(vehicle_uploads, vehicle_uploads.c.decode_id == _D.id).where(
            vehicle_uploads.c.vehicle_id == vehicle_id
        )
    with connection.execute(query.order_by(_D.id).execution_options(yield_per=_ROWS)) as rows:
        for row in rows:
            yield StoredDecode(*row)


def count_jobs(connection: sa.Connection, reprocessing_id: str) -> dict[str, int]:
    """Number of the shards of a reprocessing by their states."""
    query = sa.select(jobs.c.state, sa.func.count()).where(
        jobs.c.subject_id == reprocessing_id, jobs.c.kind == JobKind.REPROCESS
    )
    return {state: count for state, count in connection.execute(query.group_by(jobs.c.state))}  # noqa: C416


def cancel_jobs(connection: sa.Connection, agency_id: str, reprocessing_id: str, now: datetime) -> None:
    """Ask the shards of a reprocessing to stop."""
    query = sa.select(jobs.c.id).where(
        jobs.c.subject_id == reprocessing_id, jobs.c.kind == JobKind.REPROCESS, jobs.c.state.in_(("queued", "running"))
    )
    for job_id in list(connection.execute(query).scalars()):
        request_cancel(connection, agency_id, job_id, now)


def sums(connection: sa.Connection, reprocessing_id: str) -> dict[str, int]:
    """What was decoded again, in numbers."""
    counts = ("gained", "lost", "changed", "same")
    query = sa.select(
        sa.func.count(), sa.func.count(_R.error), *(sa.func.coalesce(sa.func.sum(_R[name]), 0) for name in counts)
    ).where(_R.reprocessing_id == reprocessing_id)
    done, failed, *found = connection.execute(query).one()
    return {"done": done, "failed": failed, **dict(zip(counts, map(int, found), strict=True))}


def done_ids(connection: sa.Connection, reprocessing_id: str, decode_ids: Sequence[str]) -> set[str]:
    """Those of some decodes that were decoded again."""
    query = sa.select(_R.decode_id).where(_R.reprocessing_id == reprocessing_id, _R.decode_id.in_(decode_ids))
    return set(connection.execute(query).scalars())


def add_reprocessed(connection: sa.Connection, row: ReprocessedRow) -> None:
    """Store an upload that was decoded again."""
    connection.execute(sa.insert(reprocessed_decodes), row._asdict())


def list_reprocessed(
    connection: sa.Connection, reprocessing_id: str, *, after: str | None, limit: int
) -> list[ReprocessedRow]:
    """Uploads whose readings differ or that failed, without their results, oldest first."""
    columns = [sa.null().label(name) if name == "result" else _R[name] for name in ReprocessedRow._fields]
    differs = sa.or_(_R.gained > 0, _R.lost > 0, _R.changed > 0, _R.error.is_not(None))
    query = sa.select(*columns).where(_R.reprocessing_id == reprocessing_id, differs)
    if after is not None:
        query = query.where(_R.decode_id > after)
    return fetch_all(connection, query.order_by(_R.decode_id).limit(limit), ReprocessedRow)


def approve(connection: sa.Connection, reprocessing_id: str, who: str, now: datetime) -> int:
    """Make the new results current, and keep those of before. Returns their number."""
    mine = sa.and_(_R.reprocessing_id == reprocessing_id, _R.result.is_not(None))
    before = sa.select(
        _D.id, sa.literal(reprocessing_id), _D.agency_id, _D.decoder, _D.result, _D.picture_key, _D.finished_at,
        sa.literal(now, decode_versions.c.replaced_at.type),
    ).join(reprocessed_decodes, sa.and_(_R.decode_id == _D.id, mine))  # fmt: skip
    names = [
        "decode_id", "reprocessing_id", "agency_id", "decoder", "result", "picture_key", "finished_at", "replaced_at"
    ]  # fmt: skip
    kept = connection.execute(sa.insert(decode_versions).from_select(names, before)).rowcount
    new = {
        name: sa.select(_R[name]).where(_R.decode_id == _D.id, mine).scalar_subquery()
        for name in ("result", "decoder", "picture_key")
    }
    replaced = sa.select(_R.decode_id).where(mine)
    connection.execute(sa.update(decodes).where(_D.id.in_(replaced)).values(**new))
    own = sa.update(reprocessings).where(reprocessings.c.id == reprocessing_id)
    connection.execute(own.values(approved_at=now, approved_by=who))
    return kept


def is_outdated(connection: sa.Connection, reprocessing_id: str) -> bool:
    """Whether another reprocessing has replaced results of the same decodes since this one was started."""
    own = sa.select(reprocessings.c.created_at).where(reprocessings.c.id == reprocessing_id).scalar_subquery()
    query = (
        sa.select(decode_versions.c.decode_id)
        .join(reprocessed_decodes, _R.decode_id == decode_versions.c.decode_id)
        .where(_R.reprocessing_id == reprocessing_id, decode_versions.c.replaced_at >= own)
    )
    return connection.execute(query.limit(1)).first() is not None


def list_versions(connection: sa.Connection, decode_id: str) -> list[VersionRow]:
    """Results of a decode that were replaced, newest first."""
    query = select_rows(VersionRow, decode_versions).where(decode_versions.c.decode_id == decode_id)
    return fetch_all(connection, query.order_by(decode_versions.c.replaced_at.desc()), VersionRow)


def add_reprocessing(connection: sa.Connection, row: ReprocessingRow) -> None:
    """Store a new reprocessing."""
    connection.execute(sa.insert(reprocessings), row._asdict())


def online_jobs_wait(connection: sa.Connection, kinds: Sequence[JobKind]) -> bool:
    """Whether jobs of some kinds of any agency are unfinished."""
    query = sa.select(jobs.c.id).where(jobs.c.state.in_(("queued", "running")), jobs.c.kind.in_(kinds)).limit(1)
    return connection.execute(query).first() is not None
