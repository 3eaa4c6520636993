"""Typed rows: a query's result as NamedTuples whose fields are the names of its columns.

Outside the registry a row is read by attributes, so the type checker knows the type of each column. A NamedTuple costs
as much as SQLAlchemy's own row.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import datetime
from typing import Any, TypeVar, cast

import sqlalchemy as sa

RowT = TypeVar("RowT", bound=tuple[Any, ...])
_CHUNK = 500
_TIMES = ("created_at", "updated_at")


def columns_of(row: type[RowT], table: sa.FromClause) -> list[sa.ColumnElement[Any]]:
    """The columns of a table that a NamedTuple has, in the order of its fields."""
    return [table.c[name] for name in row.__dict__["_fields"]]


def select_rows(row: type[RowT], table: sa.FromClause) -> sa.Select[Any]:
    """A query for the columns of a table that a NamedTuple has; `fetch_all` and `find_one` run it."""
    return sa.select(*columns_of(row, table))


def row_maker(row: type[RowT]) -> Callable[[Iterable[Any]], RowT]:
    """What makes a row from the values of its columns."""
    return cast("Callable[[Iterable[Any]], RowT]", row._make)  # type: ignore[attr-defined]


def row_of(row: type[RowT], values: Any) -> RowT:
    """A row of a mapping with its columns: missing ones are None, and times may be texts, as JSON has them."""
    times = {name: datetime.fromisoformat(values[name]) for name in _TIMES if isinstance(values.get(name), str)}
    return row_maker(row)(map({**values, **times}.get, row.__dict__["_fields"]))


def fetch_all(
    connection: sa.Connection, query: sa.Select[Any], row: type[RowT], values: Mapping[str, Any] | None = None
) -> list[RowT]:
    """All rows that a query returns."""
    return list(map(row_maker(row), connection.execute(query, values)))


def fetch_in(
    connection: sa.Connection, query: sa.Select[Any], row: type[RowT], column: sa.Column[Any], values: Iterable[Any]
) -> Iterator[RowT]:
    """The rows of a query that have one of many values in a column, some values at a time."""
    wanted = list(values)
    for start in range(0, len(wanted), _CHUNK):
        yield from fetch_all(connection, query.where(column.in_(wanted[start : start + _CHUNK])), row)


def find_one(
    connection: sa.Connection, query: sa.Select[Any], row: type[RowT], values: Mapping[str, Any] | None = None
) -> RowT | None:
    """The only row that a query returns; None if there is none."""
    found = connection.execute(query, values).one_or_none()
    return row_maker(row)(found) if found is not None else None
