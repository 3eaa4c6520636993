"""Queries on marker health: states of tests, readings of unknown codes, and what observations they rest on."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from datetime import datetime
from typing import Any, NamedTuple

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite

from app.registry.decodes import NewObservation
from app.registry.health_tables import marker_health, unregistered_readings
from app.registry.rows import fetch_all, fetch_in, find_one, select_rows
from app.registry.tables import decodes, observations, vehicle_uploads

_H, _U = marker_health.c, unregistered_readings.c


class HealthRow(NamedTuple):
    """Tests of a marker, of a code that is not registered, or a vehicle's own errors."""

    subject: str
    marker_id: str | None
    lon_deg: float | None
    lat_deg: float | None
    passes: int
    reads: int
    read_at: datetime | None
    last_at: datetime
    ratios: dict[str, float]
    quality: float | None
    state: dict[str, Any]
    updated_at: datetime


class NewUnregistered(NamedTuple):
    """A marker that a decode read where none is registered; `number` counts them in the decode."""

    number: int
    family: str
    code: str
    lon_deg: float
    lat_deg: float
    confidence: float
    at: datetime


class EvidenceDecode(NamedTuple):
    """A decode that observed a marker: its kind, the frame, and when."""

    decode_id: str
    kind: str
    frame: int
    at: datetime
    what: str


class StoredDecode(NamedTuple):
    """A decode that is done, with what identifies its vehicle."""

    id: str
    kind: str
    holder_id: str | None
    vehicle_id: str | None


_ROWS = select_rows(HealthRow, marker_health)
_CHANGED = [name for name in HealthRow._fields if name not in ("subject", "marker_id")]


def _upsert(insert: sqlite.Insert | postgresql.Insert) -> sa.Insert:
    """Insert rows, or replace those of the same subjects."""
    return insert.on_conflict_do_update(
        index_elements=["agency_id", "subject"], set_={column: insert.excluded[column] for column in _CHANGED}
    )


_UPSERT = {  # built once: building a statement costs more than running it
    "sqlite": _upsert(sqlite.insert(marker_health)),
    "postgresql": _upsert(postgresql.insert(marker_health)),
}
_ADD_UNREGISTERED = {
    "sqlite": sqlite.insert(unregistered_readings).on_conflict_do_nothing(),
    "postgresql": postgresql.insert(unregistered_readings).on_conflict_do_nothing(),
}


def find_health(connection: sa.Connection, agency_id: str, subjects: Collection[str]) -> dict[str, HealthRow]:
    """Rows of some subjects of an agency."""
    query = _ROWS.where(_H.agency_id == agency_id)
    return {row.subject: row for row in fetch_in(connection, query, HealthRow, _H.subject, subjects)}


def find_marker_health(connection: sa.Connection, agency_id: str, marker_id: str) -> HealthRow | None:
    """The row of one marker."""
    return find_one(connection, _ROWS.where(_H.agency_id == agency_id, _H.subject == marker_id), HealthRow)


def list_codes(connection: sa.Connection, agency_id: str, family: str, code: str) -> list[HealthRow]:
    """Places where a code was read that is not registered there."""
    prefix = f"code:{family}:{code}:"
    # the character after ':' is ';'
    query = _ROWS.where(_H.agency_id == agency_id, _H.subject >= prefix, _H.subject < prefix[:-1] + ";")
    return fetch_all(connection, query.order_by(_H.subject), HealthRow)


def store_health(connection: sa.Connection, agency_id: str, rows: Sequence[HealthRow]) -> None:
    """Store rows in place of those of the same subjects."""
    if rows:
        values = [{**row._asdict(), "agency_id": agency_id} for row in rows]
        connection.execute(_UPSERT[connection.dialect.name], values)


def delete_health(connection: sa.Connection, agency_id: str) -> None:
    """Forget the states of an agency, to compute them again."""
    connection.execute(sa.delete(marker_health).where(_H.agency_id == agency_id))


def add_unregistered(
    connection: sa.Connection, agency_id: str, decode_id: str, rows: Sequence[NewUnregistered]
) -> None:
    """Store readings of codes that are not registered; a row that is there already stays."""
    if rows:
        values = [{**row._asdict(), "agency_id": agency_id, "decode_id": decode_id} for row in rows]
        connection.execute(_ADD_UNREGISTERED[connection.dialect.name], values)


def list_evidence(connection: sa.Connection, agency_id: str, marker_id: str, *, limit: int) -> list[EvidenceDecode]:
    """The newest decodes that observed a marker."""
    o = observations.c
    query = (
        sa.select(o.decode_id, decodes.c.kind, o.frame, o.at, o.what)
        .join(decodes, decodes.c.id == o.decode_id)
        .where(o.agency_id == agency_id, o.marker_id == marker_id)
        .order_by(o.at.desc(), o.decode_id.desc(), o.frame)
        .limit(limit)
    )
    return fetch_all(connection, query, EvidenceDecode)


def iterate_decodes(connection: sa.Connection, agency_id: str, page: int = 500) -> Iterator[StoredDecode]:
    """All decodes of an agency with observations or readings, in the order in which they were uploaded."""
    last = ""
    columns = (decodes.c.id, decodes.c.kind, decodes.c.holder_id, vehicle_uploads.c.vehicle_id)
    query = (
        sa.select(*columns)
        .select_from(decodes.outerjoin(vehicle_uploads, vehicle_uploads.c.decode_id == decodes.c.id))
        .where(decodes.c.agency_id == agency_id)
        .order_by(decodes.c.id)
        .limit(page)
    )
    while rows := fetch_all(connection, query.where(decodes.c.id > last), StoredDecode):
        yield from rows
        last = rows[-1].id


def list_of_decode(
    connection: sa.Connection, agency_id: str, decode_id: str
) -> tuple[list[NewObservation], list[NewUnregistered]]:
    """What a decode observed of markers, and what it read where none is registered."""
    o = observations.c
    seen = select_rows(NewObservation, observations).where(o.agency_id == agency_id, o.decode_id == decode_id)
    unknown = select_rows(NewUnregistered, unregistered_readings).where(
        _U.agency_id == agency_id, _U.decode_id == decode_id
    )
    return (
        fetch_all(connection, seen.order_by(o.marker_id, o.frame), NewObservation),
        fetch_all(connection, unknown.order_by(_U.number), NewUnregistered),
    )
