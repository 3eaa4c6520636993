"""Types of columns, values that columns may have, and columns that many tables have."""

from __future__ import annotations

import secrets
import struct
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import UTC, datetime
from typing import Any, TypeVar, cast

import sqlalchemy as sa
from sqlalchemy.engine import Dialect

# === What all tables are declared in, and how their constraints and indexes are named.


_NAMES = {
    "ix": "ix_%(table_name)s_%(column_0_N_name)s",
    "uq": "uq_%(table_name)s_%(column_0_N_name)s",
    "ck": "ck_%(table_name)s_%(constraint_name)s",
    "fk": "fk_%(table_name)s_%(column_0_name)s",
    "pk": "pk_%(table_name)s",
}
metadata = sa.MetaData(naming_convention=_NAMES)


# === Types of columns, values that columns may have, and columns that many tables have.


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


# === Identifiers that sort by the time they were made.


def new_ids(now: datetime, count: int, part: int = 0) -> list[str]:
    """Many UUIDs version 7, rising; those of a later `part` (0 to 4095) of the same time come after.

    Notes
    -----
    The part counts in the 12 bits after the time (RFC 9562, section 6.2, method 1).
    """
    milliseconds = int(now.timestamp() * 1000) & ((1 << 48) - 1)
    head = f"{milliseconds:012x}"
    head = f"{head[:8]}-{head[8:]}-7{part:03x}-"
    tails = sorted(f"{value | 1 << 63:016x}" for value in _random_62_bits(count))
    return [f"{head}{tail[:4]}-{tail[4:]}" for tail in tails]


def _random_62_bits(count: int) -> list[int]:
    values = struct.unpack(f">{count}Q", secrets.token_bytes(8 * count))
    return [value & (1 << 62) - 1 for value in values]


COUNTED_ID = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
"""An integer key that the database counts."""


def new_id(now: datetime) -> str:
    """A UUID version 7 (RFC 9562, section 5.7) as text."""
    milliseconds = int(now.timestamp() * 1000) & ((1 << 48) - 1)
    value = milliseconds << 80 | 0x7 << 76 | secrets.randbits(12) << 64 | 0b10 << 62 | secrets.randbits(62)
    return str(uuid.UUID(int=value))


# === Typed rows: a query's result as NamedTuples whose fields are the names of its columns.
#
# Outside the registry a row is read by attributes, so the type checker knows the type of each column. A NamedTuple
# costs as much as SQLAlchemy's own row.


AnySelect = sa.Select[*tuple[Any, ...]]
AnyColumn = sa.ColumnElement[Any]
RowT = TypeVar("RowT", bound=tuple[object, ...])
_CHUNK = 500
_TIMES = ("created_at", "updated_at")


def columns_of(row: type[RowT], table: sa.FromClause) -> list[AnyColumn]:
    """The columns of a table that a NamedTuple has, in the order of its fields."""
    return [table.c[name] for name in row.__dict__["_fields"]]


def select_rows(row: type[RowT], table: sa.FromClause) -> AnySelect:
    """A query for the columns of a table that a NamedTuple has; `fetch_all` and `find_one` run it."""
    return sa.select(*columns_of(row, table))


def row_maker(row: type[RowT]) -> Callable[[Iterable[object]], RowT]:
    """What makes a row from the values of its columns."""
    return cast("Callable[[Iterable[object]], RowT]", row._make)  # type: ignore[attr-defined]


def row_of(row: type[RowT], values: Any) -> RowT:
    """A row of a mapping with its columns: missing ones are None, and times may be texts, as JSON has them."""
    times = {name: datetime.fromisoformat(values[name]) for name in _TIMES if isinstance(values.get(name), str)}
    return row_maker(row)(map({**values, **times}.get, row.__dict__["_fields"]))


def fetch_all(
    connection: sa.Connection, query: AnySelect, row: type[RowT], values: Mapping[str, object] | None = None
) -> list[RowT]:
    """All rows that a query returns."""
    return list(map(row_maker(row), connection.execute(query, values)))


def fetch_in(
    connection: sa.Connection, query: AnySelect, row: type[RowT], column: sa.Column[Any], values: Iterable[object]
) -> Iterator[RowT]:
    """The rows of a query that have one of many values in a column, some values at a time."""
    wanted = list(values)
    for start in range(0, len(wanted), _CHUNK):
        yield from fetch_all(connection, query.where(column.in_(wanted[start : start + _CHUNK])), row)


def find_one(
    connection: sa.Connection, query: AnySelect, row: type[RowT], values: Mapping[str, object] | None = None
) -> RowT | None:
    """The only row that a query returns; None if there is none."""
    found = connection.execute(query, values).one_or_none()
    return row_maker(row)(found) if found is not None else None
