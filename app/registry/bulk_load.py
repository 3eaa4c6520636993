"""Rows by the hundred thousand: past SQLAlchemy's compiler, by COPY on PostgreSQL, with the indexes filled afterwards.

SQLite gets one prepared statement a table. A load that is large beside what a table holds drops the secondary indexes
and the R*Tree's trigger for its transaction: keeping them up row by row costs more than making them anew.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from functools import lru_cache
from operator import itemgetter
from typing import Any

import orjson
import psycopg
import sqlalchemy as sa

LARGE = 50_000
"""From as many rows on the indexes are made anew, if the table does not hold more than the rows that come."""
_CACHE_KIB = 96 * 1024
_RTREE_TRIGGER = "markers_rtree_insert"
_FILL_RTREE = """INSERT INTO markers_rtree
    SELECT row, lon_deg, lon_deg, lat_deg, lat_deg FROM markers WHERE row > ? ORDER BY row"""


def load_rows(connection: sa.Connection, table: sa.Table, rows: Sequence[Mapping[str, Any]]) -> None:
    """Insert rows that all have the same columns.

    JSON columns take values, or `orjson.Fragment` of what is JSON already; times are aware.
    """
    if not rows:
        return
    names = tuple(name for name in rows[0] if name in table.c)
    pick = itemgetter(*names)
    convert = [(k, _converter(table.c[name].type, connection.dialect.name)) for k, name in enumerate(names)]
    changed = [(k, function) for k, function in convert if function is not None]
    values = []
    for row in rows:
        picked = list(pick(row))
        for k, function in changed:
            picked[k] = function(picked[k])
        values.append(picked)
    if connection.dialect.name == "postgresql":
        _copy(connection, table, names, values)
    else:
        places = ", ".join("?" * len(names))
        statement = f"INSERT INTO {table.name} ({_listed(names)}) VALUES ({places})"
        connection.exec_driver_sql(statement, [tuple(row) for row in values])


@contextmanager
def large_load(connection: sa.Connection, tables: Sequence[sa.Table], rows: int) -> Iterator[None]:
    """Put off what indexes need until the block ends, where that is cheaper; in the transaction of the connection."""
    if rows < LARGE:
        yield
        return
    if connection.dialect.name == "sqlite":
        connection.exec_driver_sql(f"PRAGMA cache_size = -{_CACHE_KIB}")
    put_off = _put_off_postgresql if connection.dialect.name == "postgresql" else _put_off_sqlite
    again = [statement for table in tables if _count_up_to(connection, table, rows) <= rows
             for statement in put_off(connection, table)]  # fmt: skip
    try:
        yield
    finally:
        if connection.dialect.name == "sqlite":
            connection.exec_driver_sql("PRAGMA cache_size = -2000")
    for statement, values in again:
        connection.exec_driver_sql(statement, values)


def _count_up_to(connection: sa.Connection, table: sa.Table, most: int) -> int:
    query = sa.select(sa.literal(1)).select_from(table).limit(most + 1).subquery()
    return int(connection.execute(sa.select(sa.func.count()).select_from(query)).scalar_one())


def _put_off_sqlite(connection: sa.Connection, table: sa.Table) -> list[tuple[str, tuple[Any, ...]]]:
    """Drop the indexes of a table that have statements of their own; what makes them again."""
    query = "SELECT name, type, sql FROM sqlite_master WHERE tbl_name = ? AND sql IS NOT NULL AND type IN (?, ?)"
    found = connection.exec_driver_sql(query, (table.name, "index", "trigger")).all()
    again: list[tuple[str, tuple[Any, ...]]] = []
    for name, kind, statement in found:
        if kind == "index":
            connection.exec_driver_sql(f"DROP INDEX {name}")
            again.append((statement, ()))
        elif name == _RTREE_TRIGGER:
            last = connection.exec_driver_sql(f"SELECT coalesce(max(row), 0) FROM {table.name}").scalar_one()
            connection.exec_driver_sql(f"DROP TRIGGER {name}")
            again += [(_FILL_RTREE, (last,)), (statement, ())]
    return again


def _put_off_postgresql(connection: sa.Connection, table: sa.Table) -> list[tuple[str, tuple[Any, ...]]]:
    """Drop the indexes and foreign keys of a table that is empty and ours; what makes them again.

    Nobody waits for the lock: there is nothing to read in an empty table.
    """
    owned = connection.exec_driver_sql(
        "SELECT pg_get_userbyid(relowner) = current_user FROM pg_class WHERE oid = to_regclass(%s)", (table.name,)
    ).scalar_one()
    if not owned or _count_up_to(connection, table, 0):
        return []
    indexes = connection.exec_driver_sql(
        """SELECT i.indexrelid::regclass::text, pg_get_indexdef(i.indexrelid) FROM pg_index i
           WHERE i.indrelid = to_regclass(%s)
             AND NOT EXISTS (SELECT 1 FROM pg_constraint c WHERE c.conindid = i.indexrelid)""",
        (table.name,),
    ).all()
    keys = connection.exec_driver_sql(
        """SELECT quote_ident(conname), pg_get_constraintdef(oid) FROM pg_constraint
           WHERE conrelid = to_regclass(%s) AND contype = 'f'""",
        (table.name,),
    ).all()
    for name, _definition in keys:
        connection.exec_driver_sql(f"ALTER TABLE {table.name} DROP CONSTRAINT {name}")
    for name, _definition in indexes:
        connection.exec_driver_sql(f"DROP INDEX {name}")
    return [
        *((definition, ()) for _name, definition in indexes),
        *((f"ALTER TABLE {table.name} ADD CONSTRAINT {name} {definition}", ()) for name, definition in keys),
    ]


def _copy(connection: sa.Connection, table: sa.Table, names: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    driver = connection.connection.driver_connection
    assert driver is not None
    statement = f"COPY {table.name} ({_listed(names)}) FROM STDIN"
    try:
        with driver.cursor() as cursor, cursor.copy(statement) as copy:
            for row in rows:
                copy.write_row(row)
    except psycopg.Error as error:  # as SQLAlchemy names what goes wrong in its own statements
        raise sa.exc.DBAPIError.instance(statement, None, error, psycopg.Error) from error


def _listed(names: Sequence[str]) -> str:
    return ", ".join(f'"{name}"' for name in names)


def _converter(kind: sa.types.TypeEngine[Any], dialect: str) -> Callable[[Any], Any] | None:
    if isinstance(kind, sa.JSON):
        return _json
    if isinstance(kind, sa.TypeDecorator) and isinstance(kind.impl, sa.DateTime) and dialect == "sqlite":
        return _sqlite_time
    return None


def _json(value: Any) -> str | None:
    return None if value is None else orjson.dumps(value).decode()


@lru_cache(maxsize=64)
def _sqlite_time(value: datetime | None) -> str | None:
    """As SQLAlchemy stores UTC times in SQLite."""
    return None if value is None else value.strftime("%Y-%m-%d %H:%M:%S.%f")
