"""What decodes saw of a marker, by marker."""

from __future__ import annotations

from datetime import datetime
from typing import Any, NamedTuple

import sqlalchemy as sa

from app.registry.column_types import UtcTime
from app.registry.rows import fetch_all, select_rows
from app.registry.tables import observations

_C = observations.c


class ObservationRow(NamedTuple):
    """What one decode saw of a marker, in one frame."""

    decode_id: str
    frame: int
    at: datetime
    what: str
    detail: dict[str, Any] | None


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
