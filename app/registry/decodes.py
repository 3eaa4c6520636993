"""Queries on decodes and the observations that they made.

A decode that was answered while the caller waited is done. One that was queued has a job of the same id, whose row
has its state, its progress and its error.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any, NamedTuple

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite

from app.errors import NotFound
from app.registry.column_types import ID, UtcTime, agency_column, fetch_all, find_one, metadata, select_rows
from app.registry.jobs import JobState, jobs
from app.values import JsonObject

# an upload that is decoded; one that is not decoded while its sender waits has a job of the same id
decodes = sa.Table(
    "decodes",
    metadata,
    sa.Column("id", ID, primary_key=True),
    agency_column(),
    sa.Column("kind", sa.String(32), nullable=False),  # of the upload
    sa.Column("holder_id", sa.String(200)),  # of the key that uploaded it
    sa.Column("context", sa.JSON, nullable=False),
    sa.Column("upload_key", sa.String(200)),
    sa.Column("upload_bytes", sa.BigInteger),
    sa.Column("upload_sha256", sa.String(64)),
    sa.Column("picture_key", sa.String(200)),
    sa.Column("result", sa.JSON(none_as_null=True)),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("finished_at", UtcTime),  # when the result was stored
    sa.Column("decoder", sa.String(200)),  # of the result, with its release
    sa.Index("ix_decodes_agency_id_id", "agency_id", "id"),
)

observations = sa.Table(
    "observations",
    metadata,
    sa.Column("decode_id", ID, sa.ForeignKey("decodes.id"), primary_key=True),
    sa.Column("marker_id", ID, sa.ForeignKey("markers.id"), primary_key=True),
    sa.Column("frame", sa.Integer, primary_key=True, autoincrement=False, server_default="0"),
    agency_column(),
    sa.Column("at", UtcTime, nullable=False),
    sa.Column("what", sa.String(32), nullable=False),
    sa.Column("detail", sa.JSON(none_as_null=True)),
    sa.Index("ix_observations_marker_id_at", "marker_id", "at"),
)


StoredResult = Mapping[str, Any]
"""The result of a decode, or a part of it, as JSON."""


class DecodeRow(NamedTuple):
    """A decode with the state of its job."""

    id: str
    kind: str  # of the upload: frame, archive, trace or packets
    context: JsonObject  # what was declared of the upload
    created_at: datetime
    finished_at: datetime | None = None
    # `upload_key`, `picture_key`: keys of the blobs of the upload and of the plot
    upload_key: str | None = None
    picture_key: str | None = None
    result: JsonObject | None = None  # None until the decode is done
    state: JobState = "queued"
    progress: float = 0.0
    attempts: int = 0
    error: dict[str, str] | None = None
    upload_bytes: int | None = None  # [byte] size of the upload; None of those that were stored before it was recorded
    upload_sha256: str | None = None  # its hash, in hexadecimal digits


class DecodeFilter(NamedTuple):
    """Which decodes a list has; None: any."""

    state: str | None = None
    kind: str | None = None
    vehicle: str | None = None  # name or id of the vehicle that the upload named
    # `since`, `until`: uploaded then or later, and before then
    since: datetime | None = None
    until: datetime | None = None


class NewObservation(NamedTuple):
    """What a decode observed of a marker."""

    marker_id: str
    frame: int  # index of the frame in an archive; 0 for every other upload
    at: datetime
    what: str  # ``seen``, or what was wrong
    detail: JsonObject


_JOB_COLUMNS: dict[str, sa.ColumnElement[object]] = {
    "state": sa.func.coalesce(jobs.c.state, "done"),
    "progress": sa.func.coalesce(jobs.c.progress, 1.0),
    "attempts": sa.func.coalesce(jobs.c.attempts, 1),
    "error": jobs.c.error,
    "finished_at": sa.func.coalesce(jobs.c.finished_at, decodes.c.finished_at),
}
_COLUMNS = {
    name: (_JOB_COLUMNS[name] if name in _JOB_COLUMNS else decodes.c[name]).label(name) for name in DecodeRow._fields
}
_WITH_JOB = decodes.outerjoin(jobs, jobs.c.id == decodes.c.id)
_FULL = sa.select(*_COLUMNS.values()).select_from(_WITH_JOB)
_WITHOUT_RESULT = sa.select(*{**_COLUMNS, "result": sa.null().label("result")}.values()).select_from(_WITH_JOB)
_ADD_DECODE = sa.insert(decodes)  # built once: building a statement costs more than running it
_ADD_OBSERVATIONS = {
    "sqlite": sqlite.insert(observations).on_conflict_do_nothing(),
    "postgresql": postgresql.insert(observations).on_conflict_do_nothing(),
}


def add_decode(connection: sa.Connection, agency_id: str, holder_id: str | None, decode: DecodeRow) -> None:
    """Store a new decode, uploaded with the key of a holder; the columns of its job are not stored here."""
    values = {name: value for name, value in decode._asdict().items() if name in decodes.c}
    owner = {"agency_id": agency_id, "holder_id": holder_id}
    connection.execute(_ADD_DECODE, {**values, **owner, "decoder": (decode.result or {}).get("decoder")})


def get_decode(connection: sa.Connection, agency_id: str, decode_id: str, *, holder_id: str | None = None) -> DecodeRow:
    """One decode, of anybody in the agency or of one holder of a key.

    Raises
    ------
    NotFound
        There is none with this id, or it belongs to another.
    """
    query = _FULL.where(decodes.c.id == decode_id, decodes.c.agency_id == agency_id)
    if holder_id is not None:
        query = query.where(decodes.c.holder_id == holder_id)
    row = find_one(connection, query, DecodeRow)
    if row is None:
        raise NotFound(f"there is no decode {decode_id}", field="decode_id", cure="GET /v1/decodes lists yours")
    return row


def list_decodes(
    connection: sa.Connection, agency_id: str, wanted: DecodeFilter,
    *, before: str | None, limit: int, holder_id: str | None = None,
) -> list[DecodeRow]:  # fmt: skip
    """Decodes without their results, newest first; of anybody in the agency or of one holder of a key."""
    query = _WITHOUT_RESULT.where(decodes.c.agency_id == agency_id)
    if holder_id is not None:
        query = query.where(decodes.c.holder_id == holder_id)
    if wanted.state == "done":
        query = query.where(sa.or_(jobs.c.id.is_(None), jobs.c.state == wanted.state))
    elif wanted.state is not None:  # of a decode with a job: an index of jobs finds the few that are not done
        query = query.where(jobs.c.state == wanted.state, jobs.c.agency_id == agency_id, jobs.c.kind == "decode")
    if wanted.kind is not None:
        query = query.where(decodes.c.kind == wanted.kind)
    if wanted.vehicle is not None:
        named = decodes.c.context["vehicle"]
        query = query.where(sa.or_(*(named[part].as_string() == wanted.vehicle for part in ("name", "id"))))
    if wanted.since is not None:
        query = query.where(decodes.c.created_at >= wanted.since)
    if wanted.until is not None:
        query = query.where(decodes.c.created_at < wanted.until)
    if before is not None:
        query = query.where(decodes.c.id < before)
    return fetch_all(connection, query.order_by(decodes.c.id.desc()).limit(limit), DecodeRow)


def store_result(
    connection: sa.Connection, agency_id: str, decode_id: str,
    *, result: Mapping[str, object], picture_key: str | None, now: datetime,
) -> None:  # fmt: skip
    """Store the result of a decode that was queued, in the transaction that finishes its job."""
    own = sa.update(decodes).where(decodes.c.id == decode_id, decodes.c.agency_id == agency_id)
    decoder = result.get("decoder")
    connection.execute(own.values(result=result, picture_key=picture_key, finished_at=now, decoder=decoder))


def store_part(connection: sa.Connection, agency_id: str, decode_id: str, result: Mapping[str, object]) -> None:
    """Store the result so far of a decode that runs."""
    own = sa.update(decodes).where(decodes.c.id == decode_id, decodes.c.agency_id == agency_id)
    connection.execute(own.values(result=result))


def add_observations(connection: sa.Connection, agency_id: str, decode_id: str, rows: Sequence[NewObservation]) -> None:
    """Store what a decode observed of markers; a row that is there already stays."""
    if not rows:
        return
    same = {"agency_id": agency_id, "decode_id": decode_id}
    connection.execute(_ADD_OBSERVATIONS[connection.dialect.name], [{**row._asdict(), **same} for row in rows])


# === What decodes saw of a marker, by marker.


_C = observations.c


class ObservationRow(NamedTuple):
    """What one decode saw of a marker, in one frame."""

    decode_id: str
    frame: int
    at: datetime
    what: str
    detail: JsonObject | None


class KindCount(NamedTuple):
    """How often a marker was seen in one way, and the first and last time."""

    what: str
    number: int
    first: datetime
    last: datetime


class Place(NamedTuple):
    """Where an observation stands in the order of a marker's observations."""

    at: datetime
    decode_id: str
    frame: int


def list_of_marker(
    connection: sa.Connection,
    agency_id: str,
    marker_id: str,
    *,
    what: str | None = None,
    since: datetime | None = None,
    until: datetime | None = None,
    before: Place | None = None,
    limit: int = 100,
) -> list[ObservationRow]:
    """What was seen of a marker, newest first."""
    query = select_rows(ObservationRow, observations).where(_C.marker_id == marker_id, _C.agency_id == agency_id)
    if what is not None:
        query = query.where(_C.what == what)
    if since is not None:
        query = query.where(_C.at >= since)
    if until is not None:
        query = query.where(_C.at <= until)
    if before is not None:
        place = sa.tuple_(sa.literal(before.at, UtcTime), sa.literal(before.decode_id), sa.literal(before.frame))
        query = query.where(_C.at <= before.at, sa.tuple_(_C.at, _C.decode_id, _C.frame) < place)
    query = query.order_by(_C.at.desc(), _C.decode_id.desc(), _C.frame.desc()).limit(limit)
    return fetch_all(connection, query, ObservationRow)


def summarize(connection: sa.Connection, agency_id: str, marker_id: str) -> list[KindCount]:
    """For each kind of observation of a marker: what, count, first, last."""
    query = (
        sa.select(
            _C.what,
            sa.func.count().label("number"),
            sa.func.min(_C.at, type_=UtcTime).label("first"),
            sa.func.max(_C.at, type_=UtcTime).label("last"),
        )
        .where(_C.marker_id == marker_id, _C.agency_id == agency_id)
        .group_by(_C.what)
        .order_by(_C.what)
    )
    return fetch_all(connection, query, KindCount)
