"""Rows by the hundred thousand: past SQLAlchemy's compiler, by COPY on PostgreSQL, with the indexes filled afterwards.

SQLite gets one prepared statement a table. A load that is large beside what a table holds drops indexes
and the R*Tree's trigger for its transaction: keeping them up row by row costs more than making them anew.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from functools import lru_cache, partial
from operator import itemgetter
from typing import Any

import orjson
import psycopg
import sqlalchemy as sa

from app.registry.rtree_pack import fill_rtree
from app.registry.tenancy import seeing_every_agency

LARGE = 50_000
"""From as many rows on the indexes are made anew, if the table does not hold more than the rows that come."""
_CACHE_KIB = 96 * 1024
_RTREE_TRIGGER = "markers_rtree_insert"


def load_rows(connection: sa.Connection, table: sa.Table, rows: Sequence[Mapping[str, Any]]) -> None:
    """Insert rows that all have the same columns.

    JSON columns take values, or `orjson.Fragment` of what is JSON already; times are aware.
    """
    if not rows:
        return
    names = tuple(str(name) for name in rows[0] if name in table.c)
    pick = itemgetter(*names)
    columns = list(zip(*map(pick, rows), strict=True))
    for k, name in enumerate(names):
        convert = _converter(table.c[name].type, connection.dialect.name)
        if convert is not None:
            columns[k] = tuple(map(convert, columns[k]))
    values = list(zip(*columns, strict=True))
    if connection.dialect.name == "postgresql":
        _copy(connection, table, names, values)
    else:
        places = ", ".join("?" * len(names))
        statement = f"INSERT INTO {table.name} ({_listed(names)}) VALUES ({places})"
        connection.exec_driver_sql(statement, values)


@contextmanager
def large_load(connection: sa.Connection, tables: Sequence[sa.Table], rows: int) -> Iterator[None]:
    """Put off what indexes need until the block ends, where that is cheaper; in the transaction of the connection."""
    if rows < LARGE:
        yield
        return
    if connection.dialect.name == "sqlite":
        connection.exec_driver_sql(f"PRAGMA cache_size = -{_CACHE_KIB}")
    put_off = _put_off_postgresql if connection.dialect.name == "postgresql" else _put_off_sqlite
    with seeing_every_agency(connection):  # the rows of others count too
        again = [
            step
            for table in tables
            if _count_up_to(connection, table, rows) <= rows
            for step in put_off(connection, table)
        ]
    try:
        yield
    finally:
        if connection.dialect.name == "sqlite":
            connection.exec_driver_sql("PRAGMA cache_size = -2000")
    for step in again:
        step()


def _count_up_to(connection: sa.Connection, table: sa.Table, most: int) -> int:
    query = sa.select(sa.literal(1)).select_from(table).limit(most + 1).subquery()
    return int(connection.execute(sa.select(sa.func.count()).select_from(query)).scalar_one())


def _put_off_sqlite(connection: sa.Connection, table: sa.Table) -> list[Callable[[], object]]:
    """Drop the indexes by digits and the R*Tree's trigger; what makes them again.

    The other indexes end in the rising id: keeping them up costs less than reading the table again.
    """
    query = "SELECT name, type, sql FROM sqlite_master WHERE tbl_name = ? AND sql IS NOT NULL AND type IN (?, ?)"
    found = connection.exec_driver_sql(query, (table.name, "index", "trigger")).all()
    again: list[Callable[[], object]] = []
    for name, kind, statement in found:
        if kind == "index" and "digits" in statement:
            connection.exec_driver_sql(f"DROP INDEX {name}")
        elif name == _RTREE_TRIGGER:
            connection.exec_driver_sql(f"DROP TRIGGER {name}")
            last = connection.exec_driver_sql(f"SELECT coalesce(max(row), 0) FROM {table.name}").scalar_one()
            again.append(partial(_fill_rtree, connection, table.name, last))
        else:
            continue
        again.append(partial(connection.exec_driver_sql, statement))
    return again


def _fill_rtree(connection: sa.Connection, table: str, last: int) -> None:
    """Put the rows after the `last` one into the R*Tree."""
    if last:
        statement = f"INSERT INTO {table}_rtree SELECT row, lon_deg, lon_deg, lat_deg, lat_deg FROM {table}"
        connection.exec_driver_sql(f"{statement} WHERE row > ?", (last,))
    else:
        fill_rtree(connection, table)


def _put_off_postgresql(connection: sa.Connection, table: sa.Table) -> list[Callable[[], object]]:
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
    # nobody sees the rows before they are committed, and then the policies bind the owner again
    connection.exec_driver_sql(f"ALTER TABLE {table.name} NO FORCE ROW LEVEL SECURITY")
    for name, _definition in keys:
        connection.exec_driver_sql(f"ALTER TABLE {table.name} DROP CONSTRAINT {name}")
    for name, _definition in indexes:
        connection.exec_driver_sql(f"DROP INDEX {name}")
    statements = [
        f"ALTER TABLE {table.name} FORCE ROW LEVEL SECURITY",
        *(definition for _name, definition in indexes),
        *(f"ALTER TABLE {table.name} ADD CONSTRAINT {name} {definition}" for name, definition in keys),
    ]
    return [partial(connection.exec_driver_sql, statement) for statement in statements]


def _copy(connection: sa.Connection, table: sa.Table, names: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    driver = connection.connection.driver_connection
    assert driver is not None
    target = _copied_into(connection, table, names)
    statement = f"COPY {target} ({_listed(names)}) FROM STDIN"
    try:
        with driver.cursor() as cursor, cursor.copy(statement) as copy:
            for row in rows:
                copy.write_row(row)
    except psycopg.Error as error:  # as SQLAlchemy names what goes wrong in its own statements
        raise sa.exc.DBAPIError.instance(statement, None, error, psycopg.Error) from error
    if target != table.name:
        listed = _listed(names)
        connection.exec_driver_sql(f"INSERT INTO {table.name} ({listed}) SELECT {listed} FROM {target}")
        connection.exec_driver_sql(f"DROP TABLE {target}")


def _copied_into(connection: sa.Connection, table: sa.Table, names: Sequence[str]) -> str:
    """The table itself, or one of this transaction where policies on rows bind us: COPY is refused there."""
    if not connection.exec_driver_sql("SELECT row_security_active(%s)", (table.name,)).scalar_one():
        return table.name
    target = f"{table.name}_copied"
    connection.exec_driver_sql(
        f"CREATE TEMPORARY TABLE {target} ON COMMIT DROP AS SELECT {_listed(names)} FROM {table.name} WITH NO DATA"
    )
    return target


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
