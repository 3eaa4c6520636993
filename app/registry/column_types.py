"""Types of columns, values that columns may have, and columns that many tables have."""

from __future__ import annotations

from datetime import UTC, datetime

import sqlalchemy as sa
from sqlalchemy.engine import Dialect

ID = sa.String(36)
VERSION_KINDS = ("as-planned", "as-built", "resurvey", "correction", "change")
JOB_STATES = ("queued", "running", "done", "failed", "cancelled")
PLAN_STATUSES = ("draft", "checked", "proved", "approved", "committed", "built", "surveyed")
SCOPES = ("admin", "planner", "surveyor", "viewer", "vehicle", "operator")


class UtcTime(sa.TypeDecorator[datetime]):
    """Aware UTC times, also on databases that keep no zone."""

    impl = sa.DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Store UTC."""
        if value is None:
            return None
        if value.tzinfo is None:
            raise ValueError("times are aware")
        return value.astimezone(UTC)

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Return aware UTC."""
        if value is None:
            return None
        return value.replace(tzinfo=UTC) if value.tzinfo is None else value.astimezone(UTC)


def one_of(column: str, values: tuple[str, ...]) -> sa.CheckConstraint:
    """A column has one of these values."""
    return sa.CheckConstraint(f"{column} IN ({', '.join(repr(v) for v in values)})", name=column)


def agency_column() -> sa.Column[str]:
    """The agency that a row belongs to."""
    return sa.Column("agency_id", ID, sa.ForeignKey("agencies.id"), nullable=False)
