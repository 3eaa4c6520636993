"""Queries on decodes and the observations that they left."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite

from app.errors import NotFound
from app.registry.tables import decodes, observations

Row = sa.RowMapping
UNFINISHED = ("queued", "running")
IMPORT = "import"
"""Kind of the jobs that are imports of surveys: they wait in the same queue, and nobody lists them as decodes."""
_PUBLIC = [column for column in decodes.c if column.name not in ("agency_id", "holder_id")]
_ADD_DECODE = sa.insert(decodes)  # built once: building a statement costs more than running it
_ADD_OBSERVATIONS = {
    "sqlite": sqlite.insert(observations).on_conflict_do_nothing(),
    "postgresql": postgresql.insert(observations).on_conflict_do_nothing(),
}
_SHORT = [column for column in _PUBLIC if column.name != "result"]


def add_decode(connection: sa.Connection, agency_id: str, holder_id: str, values: Mapping[str, Any]) -> None:
    """Store a new decode, uploaded with somebody's key."""
    connection.execute(_ADD_DECODE, {**values, "agency_id": agency_id, "holder_id": holder_id})


def get_decode(connection: sa.Connection, agency_id: str, decode_id: str, *, holder_id: str | None = None) -> Row:
    """One decode, of anybody in the agency or of one holder of a key.

    Raises
    ------
    NotFound
        There is none with this id, or it belongs to another.
    """
    query = sa.select(*_PUBLIC).where(
        decodes.c.id == decode_id, decodes.c.agency_id == agency_id, decodes.c.kind != IMPORT
    )
    if holder_id is not None:
        query = query.where(decodes.c.holder_id == holder_id)
    row = connection.execute(query).mappings().one_or_none()
    if row is None:
        raise NotFound(f"there is no decode {decode_id}", field="decode_id", cure="GET /v1/decodes lists yours")
    return row


def get_import(connection: sa.Connection, agency_id: str, import_id: str) -> Row:
    """One import of the agency that is or was a job.

    Raises
    ------
    NotFound
        There is none with this id, or it belongs to another.
    """
    query = sa.select(*_PUBLIC).where(
        decodes.c.id == import_id, decodes.c.agency_id == agency_id, decodes.c.kind == IMPORT
    )
    row = connection.execute(query).mappings().one_or_none()
    if row is None:
        raise NotFound(f"there is no import {import_id}", field="import_id")
    return row


def list_decodes(
    connection: sa.Connection,
    agency_id: str,
    *,
    state: str | None,
    before: str | None,
    limit: int,
    holder_id: str | None = None,
) -> list[Row]:
    """Decodes without their results, newest first; of anybody in the agency or of one holder of a key."""
    query = sa.select(*_SHORT).where(decodes.c.agency_id == agency_id, decodes.c.kind != IMPORT)
    if holder_id is not None:
        query = query.where(decodes.c.holder_id == holder_id)
    if state is not None:
        query = query.where(decodes.c.state == state)
    if before is not None:
        query = query.where(decodes.c.id < before)
    return list(connection.execute(query.order_by(decodes.c.id.desc()).limit(limit)).mappings())


def list_imports(
    connection: sa.Connection, agency_id: str, *, state: str | None, before: str | None, limit: int
) -> list[Row]:
    """Imports of the agency that are or were jobs, without their reports, newest first."""
    query = sa.select(*_SHORT).where(decodes.c.agency_id == agency_id, decodes.c.kind == IMPORT)
    if state is not None:
        query = query.where(decodes.c.state == state)
    if before is not None:
        query = query.where(decodes.c.id < before)
    return list(connection.execute(query.order_by(decodes.c.id.desc()).limit(limit)).mappings())


def list_unfinished(connection: sa.Connection) -> list[str]:
    """Ids of the decodes of all agencies that are still to be done, oldest first."""
    query = sa.select(decodes.c.id).where(decodes.c.state.in_(UNFINISHED)).order_by(decodes.c.id)
    return list(connection.execute(query).scalars())


def start_decode(connection: sa.Connection, decode_id: str) -> Row | None:
    """Take a job that is queued, or that an earlier process left running; None if it is finished or gone."""
    statement = (
        sa.update(decodes)
        .where(decodes.c.id == decode_id, decodes.c.state.in_(UNFINISHED))
        .values(state="running", attempts=decodes.c.attempts + 1)
    )
    if connection.execute(statement).rowcount != 1:
        return None
    return connection.execute(sa.select(decodes).where(decodes.c.id == decode_id)).mappings().one()


def record_progress(connection: sa.Connection, decode_id: str, progress: float) -> bool:
    """Note how far a job is; returns whether it shall stop."""
    connection.execute(
        sa.update(decodes).where(decodes.c.id == decode_id, decodes.c.state == "running").values(progress=progress)
    )
    query = sa.select(decodes.c.cancel_requested).where(decodes.c.id == decode_id)
    return bool(connection.execute(query).scalar_one_or_none() in (True, None))


def request_cancel(connection: sa.Connection, agency_id: str, decode_id: str, now: datetime) -> None:
    """Ask a job to stop; one that waits is cancelled at once, one that is finished stays as it is."""
    own = (decodes.c.id == decode_id, decodes.c.agency_id == agency_id)
    connection.execute(
        sa.update(decodes)
        .where(*own, decodes.c.state == "queued")
        .values(state="cancelled", cancel_requested=True, finished_at=now)
    )
    connection.execute(sa.update(decodes).where(*own, decodes.c.state == "running").values(cancel_requested=True))


def begin_step(connection: sa.Connection, decode_id: str, progress: float) -> bool:
    """Note how far a running job is, unless somebody asked it to stop; returns whether it goes on."""
    statement = sa.update(decodes).where(
        decodes.c.id == decode_id, decodes.c.state == "running", decodes.c.cancel_requested.is_(False)
    )
    return connection.execute(statement.values(progress=progress)).rowcount == 1


def request_cancel_before(
    connection: sa.Connection, agency_id: str, decode_id: str, now: datetime, *, progress: float
) -> bool:
    """Ask a job to stop that is not so far yet; one that waits is cancelled at once. Returns whether it will stop."""
    own = (decodes.c.id == decode_id, decodes.c.agency_id == agency_id)
    waiting = sa.update(decodes).where(*own, decodes.c.state == "queued")
    stopped = waiting.values(state="cancelled", cancel_requested=True, finished_at=now)
    if connection.execute(stopped).rowcount == 1:
        return True
    running = sa.update(decodes).where(*own, decodes.c.state == "running", decodes.c.progress < progress)
    return connection.execute(running.values(cancel_requested=True)).rowcount == 1


def finish_decode(connection: sa.Connection, decode_id: str, values: Mapping[str, Any]) -> bool:
    """Write a job's outcome, unless it has one already."""
    statement = sa.update(decodes).where(decodes.c.id == decode_id, decodes.c.state.in_(UNFINISHED)).values(**values)
    return connection.execute(statement).rowcount == 1


def add_observations(connection: sa.Connection, agency_id: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Store what was seen of markers; a row that is there already stays."""
    if not rows:
        return
    statement = _ADD_OBSERVATIONS[connection.dialect.name]
    connection.execute(statement, [{**row, "agency_id": agency_id} for row in rows])


def list_observations(connection: sa.Connection, agency_id: str, decode_id: str) -> list[Row]:
    """What a decode saw of the registry's markers."""
    query = (
        sa.select(observations)
        .where(observations.c.decode_id == decode_id, observations.c.agency_id == agency_id)
        .order_by(observations.c.frame, observations.c.marker_id)
    )
    return list(connection.execute(query).mappings())
