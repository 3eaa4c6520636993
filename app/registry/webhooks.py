"""Queries on events, webhooks and their deliveries."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import NamedTuple

import sqlalchemy as sa

from app.errors import NotFound
from app.registry.column_types import (
    COUNTED_ID,
    ID,
    AnySelect,
    UtcTime,
    agency_column,
    fetch_all,
    find_one,
    metadata,
    one_of,
    select_rows,
)

WEBHOOK_STATES = ("active", "disabled")

DELIVERY_STATES = ("waiting", "delivered", "failed")

# what happened that others want to know: written in the transaction in which it happens. Writes come one after
# another, so ids rise in the order of commits, and whoever reads on after an id misses nothing
events = sa.Table(
    "events",
    metadata,
    sa.Column("id", COUNTED_ID, primary_key=True, autoincrement=True),
    agency_column(),
    sa.Column("kind", sa.String(40), nullable=False),
    sa.Column("subject_id", sa.String(200)),
    sa.Column("at", UtcTime, nullable=False),
    sa.Column("detail", sa.JSON(none_as_null=True)),
    sa.Index("ix_events_agency_id_id", "agency_id", "id"),
    sqlite_autoincrement=True,
)

webhooks = sa.Table(
    "webhooks",
    metadata,
    sa.Column("id", ID, primary_key=True),
    agency_column(),
    sa.Column("url", sa.String(500), nullable=False),
    sa.Column("events", sa.JSON, nullable=False),  # kinds, or their beginnings with .*
    sa.Column("sealed_secret", sa.LargeBinary, nullable=False),  # under the server's key
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("reason", sa.String(500)),  # why it is disabled
    sa.Column("last_event_id", sa.BigInteger, nullable=False),  # up to which events have become deliveries
    sa.Column("last_success_at", UtcTime),
    sa.Column("who", sa.String(200), nullable=False),
    sa.Column("created_at", UtcTime, nullable=False),
    one_of("state", WEBHOOK_STATES),
    sa.Index("ix_webhooks_agency_id_id", "agency_id", "id"),
)

# one event for one webhook; a row is leased by moving `due_at`, so that two processes do not send it together
webhook_deliveries = sa.Table(
    "webhook_deliveries",
    metadata,
    sa.Column("id", ID, primary_key=True),
    agency_column(),
    sa.Column("webhook_id", ID, sa.ForeignKey("webhooks.id", ondelete="CASCADE"), nullable=False),
    sa.Column("event_id", sa.BigInteger, nullable=False),
    sa.Column("kind", sa.String(40), nullable=False),
    sa.Column("body", sa.Text, nullable=False),  # as it is signed and sent
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("attempts", sa.Integer, nullable=False, server_default="0"),
    sa.Column("due_at", UtcTime, nullable=False),
    sa.Column("give_up_at", UtcTime, nullable=False),
    sa.Column("status", sa.Integer),  # of the last response
    sa.Column("error", sa.String(300)),  # of the last attempt
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("ended_at", UtcTime),
    one_of("state", DELIVERY_STATES),
    sa.UniqueConstraint("webhook_id", "event_id"),
    sa.Index("ix_webhook_deliveries_state_due_at", "state", "due_at"),
    sa.Index("ix_webhook_deliveries_webhook_id_id", "webhook_id", "id"),
)

# === Events of an agency in the order in which they were committed: what webhooks and other subscribers are sent.
#
# An event is written in the transaction in which it happens, so there is none of what was rolled back.


_E = events.c


class EventRow(NamedTuple):
    """Something that happened."""

    id: int  # rises in the order of commits
    kind: str  # for example ``maintenance.suspect``
    subject_id: str | None  # what it is about: an id of the resource that the kind names
    at: datetime
    detail: dict[str, object] | None  # small JSON values, without anything secret


def add_event(
    connection: sa.Connection,
    agency_id: str,
    kind: str,
    *,
    subject_id: str | None,
    at: datetime,
    detail: Mapping[str, object] | None = None,
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
    about: sa.ColumnElement[bool] | None = None,
    limit: int = 100,
) -> list[EventRow]:
    """Events after one, oldest first.

    Parameters
    ----------
    job_kinds : sequence of str, optional
        Of the events of jobs, those of these kinds only.
    about : condition, optional
        What the events are about, as of `app.registry.jobs.event_of_holder`.
    """
    query = select_rows(EventRow, events).where(_E.agency_id == agency_id, _E.id > after)
    if job_kinds is not None:
        job_kind = _E.detail["job_kind"].as_string()
        query = query.where(sa.or_(_E.kind.not_like("job.%"), job_kind.in_(job_kinds)))
    if about is not None:
        query = query.where(about)
    return fetch_all(connection, query.order_by(_E.id).limit(limit), EventRow)


def newest_event(connection: sa.Connection, agency_id: str) -> int:
    """Id of the newest event, from which a new subscriber goes on; 0 where there is none."""
    query = sa.select(sa.func.max(_E.id)).where(_E.agency_id == agency_id)
    return connection.execute(query).scalar_one() or 0


def newest_events(connection: sa.Connection, agency_ids: Sequence[str]) -> dict[str, int]:
    """Ids of the newest events of some agencies, of those that have events."""
    query = sa.select(_E.agency_id, sa.func.max(_E.id)).where(_E.agency_id.in_(agency_ids)).group_by(_E.agency_id)
    return {row[0]: row[1] for row in connection.execute(query)}


# === Queries on webhooks and their deliveries.


_W, _D = webhooks.c, webhook_deliveries.c


class WebhookRow(NamedTuple):
    """A webhook."""

    id: str
    agency_id: str
    url: str
    events: list[str]  # kinds of events that it is sent; ``job.*`` are all that begin so
    sealed_secret: bytes  # under the server's key
    state: str
    reason: str | None  # why it is disabled
    last_event_id: int  # events up to this one have become deliveries
    last_success_at: datetime | None
    who: str
    created_at: datetime


class DeliveryRow(NamedTuple):
    """One event for one webhook."""

    id: str
    agency_id: str
    webhook_id: str
    event_id: int
    kind: str
    body: str  # JSON, as it is signed and sent
    state: str
    attempts: int
    due_at: datetime  # when it is sent next; while it is being sent, when another process may send it
    give_up_at: datetime
    # `status`, `error`: of the last attempt
    status: int | None
    error: str | None
    created_at: datetime
    ended_at: datetime | None


def add_webhook(connection: sa.Connection, webhook: WebhookRow) -> None:
    """Store a new webhook."""
    connection.execute(sa.insert(webhooks), webhook._asdict())


def count_webhooks(connection: sa.Connection, agency_id: str) -> int:
    """Number of an agency's webhooks."""
    return int(connection.execute(sa.select(sa.func.count()).where(_W.agency_id == agency_id)).scalar_one())


def list_webhooks(connection: sa.Connection, agency_id: str) -> list[WebhookRow]:
    """All webhooks of an agency, oldest first."""
    return fetch_all(
        connection, select_rows(WebhookRow, webhooks).where(_W.agency_id == agency_id).order_by(_W.id), WebhookRow
    )


def get_webhook(connection: sa.Connection, agency_id: str, webhook_id: str) -> WebhookRow:
    """One webhook of an agency.

    Raises
    ------
    NotFound
    """
    query = select_rows(WebhookRow, webhooks).where(_W.id == webhook_id, _W.agency_id == agency_id)
    row = find_one(connection, query, WebhookRow)
    if row is None:
        raise NotFound(f"there is no webhook {webhook_id}", field="webhook_id", cure="GET /v1/webhooks lists them")
    return row


def delete_webhook(connection: sa.Connection, webhook_id: str) -> None:
    """Remove a webhook with its deliveries."""
    connection.execute(sa.delete(webhook_deliveries).where(_D.webhook_id == webhook_id))
    connection.execute(sa.delete(webhooks).where(_W.id == webhook_id))


def change_webhook(connection: sa.Connection, webhook_id: str, **values: object) -> None:
    """Set columns of a webhook."""
    connection.execute(sa.update(webhooks).where(_W.id == webhook_id).values(**values))


def list_webhooks_behind(connection: sa.Connection) -> list[WebhookRow]:
    """Active webhooks of all agencies whose agency has newer events."""
    newer = sa.exists().where(events.c.agency_id == _W.agency_id, events.c.id > _W.last_event_id)
    query = select_rows(WebhookRow, webhooks).where(_W.state == "active", newer)
    return fetch_all(connection, query.order_by(_W.id), WebhookRow)


def add_deliveries(connection: sa.Connection, rows: Sequence[DeliveryRow]) -> None:
    """Store deliveries."""
    if rows:
        connection.execute(sa.insert(webhook_deliveries), [row._asdict() for row in rows])


def list_deliveries(
    connection: sa.Connection, webhook_id: str, *, state: str | None, before: str | None, limit: int
) -> list[DeliveryRow]:
    """Deliveries of a webhook, newest first."""
    query = select_rows(DeliveryRow, webhook_deliveries).where(_D.webhook_id == webhook_id)
    if state is not None:
        query = query.where(_D.state == state)
    if before is not None:
        query = query.where(_D.id < before)
    return fetch_all(connection, query.order_by(_D.id.desc()).limit(limit), DeliveryRow)


def get_delivery(connection: sa.Connection, webhook_id: str, delivery_id: str) -> DeliveryRow:
    """One delivery of a webhook.

    Raises
    ------
    NotFound
    """
    query = select_rows(DeliveryRow, webhook_deliveries).where(_D.id == delivery_id, _D.webhook_id == webhook_id)
    row = find_one(connection, query, DeliveryRow)
    if row is None:
        raise NotFound(f"there is no delivery {delivery_id} of this webhook", field="delivery_id")
    return row


def change_delivery(connection: sa.Connection, delivery_id: str, **values: object) -> None:
    """Set columns of a delivery."""
    connection.execute(sa.update(webhook_deliveries).where(_D.id == delivery_id).values(**values))


def postpone_giving_up(connection: sa.Connection, webhook_id: str, give_up_at: datetime, due_at: datetime) -> None:
    """Give the deliveries that wait a new time: their webhook is enabled again."""
    waiting = sa.update(webhook_deliveries).where(_D.webhook_id == webhook_id, _D.state == "waiting")
    connection.execute(waiting.values(give_up_at=give_up_at, due_at=due_at))


def _due(now: datetime, per_webhook: int, limit: int) -> AnySelect:
    """Ids of deliveries to send now, oldest first: a few of each webhook, so that none that is slow delays others."""
    place = sa.func.row_number().over(partition_by=_D.webhook_id, order_by=(_D.due_at, _D.id)).label("place")
    ranked = (
        sa.select(_D.id, _D.due_at, place)
        .join(webhooks, _W.id == _D.webhook_id)
        .where(_D.state == "waiting", _D.due_at <= now, _W.state == "active")
        .subquery()
    )
    return sa.select(ranked.c.id).where(ranked.c.place <= per_webhook).order_by(ranked.c.due_at).limit(limit)


def has_due(connection: sa.Connection, now: datetime) -> bool:
    """Whether there is something to send."""
    return connection.execute(_due(now, 1, 1)).first() is not None


def lease_due(
    connection: sa.Connection, now: datetime, until: datetime, *, per_webhook: int, limit: int
) -> list[tuple[DeliveryRow, WebhookRow]]:
    """Take deliveries to send now; nobody else takes them before `until`, so one that is cut off is sent again."""
    wanted = select_rows(DeliveryRow, webhook_deliveries).where(_D.id.in_(_due(now, per_webhook, limit)))
    rows = fetch_all(connection, wanted.with_for_update(skip_locked=True, of=webhook_deliveries), DeliveryRow)
    taken = []
    for row in rows:
        lease = sa.update(webhook_deliveries).where(_D.id == row.id)
        connection.execute(lease.values(due_at=until, attempts=_D.attempts + 1))
        taken.append((row._replace(attempts=row.attempts + 1), get_webhook(connection, row.agency_id, row.webhook_id)))
    return taken


def delete_old(connection: sa.Connection, before: datetime) -> None:
    """Delete deliveries that ended before a time, and events from before it that no active webhook waits for."""
    connection.execute(sa.delete(webhook_deliveries).where(_D.ended_at < before))
    awaited = sa.exists().where(
        _W.agency_id == events.c.agency_id, _W.state == "active", _W.last_event_id < events.c.id
    )
    connection.execute(sa.delete(events).where(events.c.at < before, ~awaited))
