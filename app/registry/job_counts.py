"""How many jobs of all agencies wait and run, for metrics."""

from __future__ import annotations

from datetime import datetime
from typing import NamedTuple

import sqlalchemy as sa

from app.registry.column_types import UtcTime
from app.registry.jobs import UNFINISHED
from app.registry.tables import jobs


class JobCount(NamedTuple):
    """Unfinished jobs of a kind and a state: how many, and when the oldest of them was made."""

    kind: str
    state: str
    number: int
    oldest: datetime


def count_unfinished(connection: sa.Connection) -> list[JobCount]:
    """Unfinished jobs, counted with a partial index, whatever the number of those that have ended."""
    oldest = sa.type_coerce(sa.func.min(jobs.c.created_at), UtcTime)
    query = sa.select(jobs.c.kind, jobs.c.state, sa.func.count(), oldest)
    query = query.where(jobs.c.state.in_(UNFINISHED)).group_by(jobs.c.kind, jobs.c.state)
    return [JobCount(*row) for row in connection.execute(query)]
