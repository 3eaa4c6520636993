"""Whose rows a transaction may see: the second lock, row level security on PostgreSQL (migration 0009).

The first lock is the `agency_id` in every query. Should one be forgotten, the policies still hide what belongs to
others: a transaction says at its start for whom it is, and one that says nothing sees no rows. For whom is a matter of
the context (`contextvars`), which threads of a request inherit: the middleware says it once a request is authenticated.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import sqlalchemy as sa

SETTING = "waymark.agency_id"
EVERY_AGENCY = "*"
_WHOSE: ContextVar[str] = ContextVar("waymark_agency", default="")


def whose_rows() -> str:
    """What transactions that start here say: an agency's id, `EVERY_AGENCY`, or nothing."""
    return _WHOSE.get()


@contextmanager
def acting_for(agency_id: str) -> Iterator[None]:
    """Transactions that start in this block see the rows of one agency."""
    token = _WHOSE.set(agency_id)
    try:
        yield
    finally:
        _WHOSE.reset(token)


@contextmanager
def across_agencies() -> Iterator[None]:
    """Transactions that start in this block see all rows: the server's own work, or its operator's."""
    with acting_for(EVERY_AGENCY):
        yield


@contextmanager
def seeing_every_agency(connection: sa.Connection) -> Iterator[None]:
    """Statements of this block see all rows: whether a number or a place on the road is taken by anybody."""
    if connection.dialect.name != "postgresql":
        yield
        return
    set_whose(connection, EVERY_AGENCY)
    yield
    set_whose(connection, whose_rows())  # after an error the transaction is given up anyway


def set_whose(connection: sa.Connection, whose: str, *, local: bool = True) -> None:
    """Say for whom a transaction is, or with `local` false a session."""
    connection.exec_driver_sql(f"SELECT set_config('{SETTING}', %s, {'true' if local else 'false'})", (whose,))
