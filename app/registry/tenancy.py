"""The agency of a transaction, for row level security on PostgreSQL (migration 0009).

Every query has a condition on `agency_id`. If one is forgotten, the policies still hide the rows of other agencies:
each transaction states its agency when it starts, and a transaction without an agency sees no rows. A context variable
stores the agency; the threads of a request inherit it, and the middleware sets it when a request is authenticated.
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
    """The agency of transactions that start here: its id, `EVERY_AGENCY`, or an empty text."""
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
    """Transactions that start in this block see all rows: for the work of the server itself or of its operator."""
    with acting_for(EVERY_AGENCY):
        yield


@contextmanager
def seeing_every_agency(connection: sa.Connection) -> Iterator[None]:
    """Statements in this block see all rows, to check whether any agency uses a number or a place on the road."""
    if connection.dialect.name != "postgresql":
        yield
        return
    set_whose(connection, EVERY_AGENCY)
    yield
    set_whose(connection, whose_rows())  # after an error the transaction is given up anyway


def set_whose(connection: sa.Connection, whose: str, *, local: bool = True) -> None:
    """Set the agency of a transaction, or of a session if `local` is false."""
    connection.exec_driver_sql(f"SELECT set_config('{SETTING}', %s, {'true' if local else 'false'})", (whose,))
