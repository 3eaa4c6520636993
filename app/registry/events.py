"""Events of an agency in the order in which they were committed: what webhooks and other subscribers are sent.

An event is written in the transaction in which it happens, so there is none of what was rolled back.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any, NamedTuple

import sqlalchemy as sa

from app.registry.health_tables import events
from app.registry.rows import fetch_all, select_rows
from app.registry.tables import jobs

_E = events.c


class EventRow(NamedTuple):
    """Something that happened.

    Attributes
    ----------
    id : int
        Rises in the order of commits.
    kind : str
        For example ``maintenance.suspect``.
    subject_id : str or None
        What it is about: an id of the resource that the kind names.
    detail : dict or None
        Small JSON values, without anything secret.
    """

    id: int
    kind: str
    subject_id: str | None
    at: datetime
    detail: dict[str, Any] | None


def add_event(
    connection: sa.Connection,
    agency_id: str,
    kind: str,
    *,
    subject_id: str | None,
    at: datetime,
    detail: Mapping[str, Any] | None = None,
) -> None:
    """Store an event, in the transaction in which it happens."""
    connection.execute(
        sa.insert(events).values(
            agency_id=agency_id,
            kind=kind,
            subject_id=subject_id,
            at=at,
            detail=None if detail is None else dict(detail),
        )
    )


def list_events(
    connection: sa.Connection,
    agency_id: str,
    *,
    after: int = 0,
    job_kinds: Sequence[str] | None = None,
    holder_id: str | None = None,
    limit: int = 100,
) -> list[EventRow]:
    """Events after one, oldest first.

    Parameters
    ----------
    job_kinds : sequence of str, optional
        Of the events of jobs, those of these kinds only.
    holder_id : str, optional
        Events of jobs that this holder asked for, and no others.
    """
    query = select_rows(EventRow, events).where(_E.agency_id == agency_id, _E.id > after)
    if job_kinds is not None:
        job_kind = _E.detail["job_kind"].as_string()
        query = query.where(sa.or_(_E.kind.not_like("job.%"), job_kind.in_(job_kinds)))
    if holder_id is not None:
        own = sa.select(jobs.c.id).where(
            jobs.c.id == _E.subject_id, jobs.c.agency_id == agency_id, jobs.c.holder_id == holder_id
        )
        query = query.where(_E.kind.like("job.%"), own.exists())
    return fetch_all(connection, query.order_by(_E.id).limit(limit), EventRow)


def newest_event(connection: sa.Connection, agency_id: str) -> int:
    """Id of the newest event, from which a new subscriber goes on; 0 where there is none."""
    query = sa.select(sa.func.max(_E.id)).where(_E.agency_id == agency_id)
    return connection.execute(query).scalar_one() or 0


def newest_events(connection: sa.Connection, agency_ids: Sequence[str]) -> dict[str, int]:
    """Ids of the newest events of some agencies, of those that have events."""
    query = sa.select(_E.agency_id, sa.func.max(_E.id)).where(_E.agency_id.in_(agency_ids)).group_by(_E.agency_id)
    return {row[0]: row[1] for row in connection.execute(query)}
