"""Tables of webhooks and of what is delivered to them."""

from __future__ import annotations

import sqlalchemy as sa

from app.registry.column_types import ID, UtcTime, agency_column, one_of
from app.registry.metadata import metadata

WEBHOOK_STATES = ("active", "disabled")
DELIVERY_STATES = ("waiting", "delivered", "failed")

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
