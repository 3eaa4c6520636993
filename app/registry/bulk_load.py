"""Bulk inserts: without SQLAlchemy's compiler, by COPY on PostgreSQL, and with indexes built after the rows.

SQLite gets one prepared statement for hundreds of rows; values that all rows share are bound once. A load that is
large compared with the table drops indexes and the R*Tree's trigger for its transaction: updating them row by row costs
more than building them again.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from functools import lru_cache, partial
from itertools import chain
from typing import Any

import orjson
import sqlalchemy as sa

from app.registry.engines import seeing_every_agency
from app.registry.spatial import fill_rtree
from app.values import JsonObject

# === Many rows by column: shared values are stored once, and the JSON of each row is made from one template.


class JsonTexts(list[str]):
    """A column of values that are JSON already, their keys sorted."""


@dataclass(frozen=True, slots=True)
class Columns:
    """Rows that have the same columns."""

    count: int  # rows
    same: JsonObject  # columns in which all rows agree: name to value
    own: dict[str, Sequence[object]]  # the others: name to `count` values; of JSON columns either values or `JsonTexts`

    @classmethod
    def of(cls, count: int, same: Mapping[str, object], lists: Mapping[str, Sequence[object]]) -> Columns:
        """Columns from lists; a list whose values are all the same becomes one shared value."""
        alike = {name for name, values in lists.items() if not isinstance(values, JsonTexts) and _is_one_value(values)}
        return cls(
            count,
            {**same, **{name: lists[name][0] for name in alike}},
            {name: values for name, values in lists.items() if name not in alike},
        )

    def but(self, **lists: Sequence[object]) -> Columns:
        """A copy with other values in some columns."""
        return Columns.of(
            self.count,
            {name: value for name, value in self.same.items() if name not in lists},
            {**self.own, **lists},
        )

    def values(self, name: str) -> list[Any]:
        """A column as a list."""
        return list(self.own[name]) if name in self.own else [self.same[name]] * self.count

    def rows(self) -> list[JsonObject]:
        """The rows one by one."""
        lists = [
            [orjson.loads(text) for text in values] if isinstance(values, JsonTexts) else values
            for values in self.own.values()
        ]
        if not lists:
            return [dict(self.same) for _ in range(self.count)]
        return [{**self.same, **dict(zip(self.own, row, strict=True))} for row in zip(*lists, strict=True)]


def json_objects(columns: Columns, *, names: Sequence[str] | None = None, optional: Collection[str] = ()) -> JsonTexts:
    """Each row as a JSON object: byte by byte what `orjson.dumps` with sorted keys writes.

    Parameters
    ----------
    names : sequence of str, optional
        All columns in the order of the members, instead of sorted.
    optional : collection of str
        Columns of `own` that a row leaves out where its value is None.
    """
    template: list[str] = []
    texts: list[Sequence[str]] = []
    for name in names or sorted({*columns.same, *columns.own}):
        key = f",{_text(name)}:".replace("%", "%%")
        if name in columns.same:
            template.append(key + _text(columns.same[name]).replace("%", "%%"))
        elif name in optional:
            template.append("%s")
            own = json_texts(columns.own[name])
            texts.append(["" if text == "null" else f",{_text(name)}:{text}" for text in own])
        else:
            template.append(key + "%s")
            texts.append(json_texts(columns.own[name]))
    members = "".join(template)
    if not texts:
        return JsonTexts(["{" + (members % ())[1:] + "}"] * columns.count)
    return JsonTexts(["{" + (members % row)[1:] + "}" for row in zip(*texts, strict=True)])


def json_texts(values: Sequence[object]) -> Sequence[str]:
    """Each value as JSON with sorted keys."""
    if isinstance(values, JsonTexts):
        return values
    texts = orjson.dumps(values, option=orjson.OPT_SORT_KEYS)[1:-1].decode().split(",")
    if len(texts) == len(values):  # there is no comma within a value
        return texts
    return [_text(value) for value in values]


def _text(value: object) -> str:
    return orjson.dumps(value, option=orjson.OPT_SORT_KEYS).decode()


def _is_one_value(values: Sequence[object]) -> bool:
    """Whether all values are equal and of one type: 0 is not False."""
    first = values[0] if values else None
    return bool(values) and list(values).count(first) == len(values) and len(set(map(type, values))) == 1


# === Bulk inserts.


LARGE = 50_000
"""Number of rows from which on indexes are built afterwards, if the table does not hold more rows than are loaded."""
_CACHE_KIB = 32 * 1024  # [KiB] SQLite's page cache during a large load
_ROWS_PER_STATEMENT = 500
_MAX_VALUES = 30_000
"""SQLite accepts 32 766 values in a statement (https://www.sqlite.org/limits.html, SQLITE_MAX_VARIABLE_NUMBER)."""
_RTREE_TRIGGER = "markers_rtree_insert"


def load_rows(connection: sa.Connection, table: sa.Table, rows: Sequence[Mapping[str, object]]) -> None:
    """Insert rows that all have the same columns.

    JSON columns take values, or `orjson.Fragment` of what is JSON already; times are aware.
    """
    if not rows:
        return
    lists = {
        name: _stored(connection, table, name, [row[name] for row in rows])
        for name in map(str, rows[0])
        if name in table.c
    }
    _load(connection, table, Columns.of(len(rows), {}, lists))


def load_columns(connection: sa.Connection, table: sa.Table, columns: Columns) -> None:
    """Insert rows that come by column; JSON columns take values or `JsonTexts`, times are aware."""
    if not columns.count:
        return
    same = {name: _stored(connection, table, name, [value])[0] for name, value in columns.same.items()}
    own = {name: _stored(connection, table, name, values) for name, values in columns.own.items()}
    _load(connection, table, Columns(columns.count, same, own))


def _stored(connection: sa.Connection, table: sa.Table, name: str, values: Sequence[object]) -> Sequence[object]:
    """Values as the driver takes them."""
    kind = table.c[name].type
    if isinstance(kind, sa.JSON):
        return values if isinstance(values, JsonTexts) else list(map(_json, values))
    is_time = isinstance(kind, sa.TypeDecorator) and isinstance(kind.impl, sa.DateTime)
    return list(map(_sqlite_time, values)) if is_time and connection.dialect.name == "sqlite" else values


def _load(connection: sa.Connection, table: sa.Table, columns: Columns) -> None:
    """Insert values as the driver takes them; a column that is None in all rows gets the table's default."""
    same = {
        name: value
        for name, value in columns.same.items()
        if value is not None or table.c[name].server_default is not None
    }
    own = dict(columns.own)
    if not own:
        name, value = same.popitem()
        own[name] = [value] * columns.count
    columns_of_rows = Columns(columns.count, same, own)
    if connection.dialect.name == "postgresql":
        _copy(connection, table, columns_of_rows)
    else:
        _insert(connection, table, columns_of_rows)


def _insert(connection: sa.Connection, table: sa.Table, columns: Columns) -> None:
    # keeps the schema's pages in memory: were one written now and again with the indexes at the end, SQLite would
    # compute the checksums of its whole log a second time (sqlite3WalFrames, iReCksum)
    connection.exec_driver_sql("SELECT count(*) FROM sqlite_schema").scalar_one()
    rows_per_statement = min(_ROWS_PER_STATEMENT, (_MAX_VALUES - len(columns.same)) // len(columns.own))
    for start in range(0, columns.count, rows_per_statement):
        part = [values[start : start + rows_per_statement] for values in columns.own.values()]
        statement = _insert_statement(table.name, tuple(columns.own), tuple(columns.same), len(part[0]))
        connection.exec_driver_sql(statement, (*chain.from_iterable(zip(*part, strict=True)), *columns.same.values()))


@lru_cache(maxsize=16)
def _insert_statement(table: str, own: tuple[str, ...], same: tuple[str, ...], rows: int) -> str:
    """An INSERT of rows with values of their own, followed once by the values that they share."""
    row = f"({_places(len(own))})"
    rest = f", {_places(len(same))}" if same else ""
    return (
        f"WITH new_rows AS (VALUES {', '.join([row] * rows)}) "
        f"INSERT INTO {table} ({_listed((*own, *same))}) SELECT new_rows.*{rest} FROM new_rows"
    )


def _places(count: int) -> str:
    return ", ".join("?" * count)


@contextmanager
def large_load(connection: sa.Connection, tables: Sequence[sa.Table], rows: int) -> Iterator[None]:
    """Build indexes when the block ends, if that is cheaper; in the transaction of the connection."""
    if rows < LARGE:
        yield
        return
    if connection.dialect.name == "sqlite":
        connection.exec_driver_sql(f"PRAGMA cache_size = -{_CACHE_KIB}")
    postpone = _postpone_postgresql if connection.dialect.name == "postgresql" else _postpone_sqlite
    with seeing_every_agency(connection):  # the rows of others count too
        rebuild = [
            step
            for table in tables
            if _count_up_to(connection, table, rows) <= rows
            for step in postpone(connection, table)
        ]
    try:
        yield
    finally:
        if connection.dialect.name == "sqlite":
            connection.exec_driver_sql("PRAGMA cache_size = -2000")
    for step in rebuild:
        step()


def _count_up_to(connection: sa.Connection, table: sa.Table, limit: int) -> int:
    query = sa.select(sa.literal(1)).select_from(table).limit(limit + 1).subquery()
    return int(connection.execute(sa.select(sa.func.count()).select_from(query)).scalar_one())


def _postpone_sqlite(connection: sa.Connection, table: sa.Table) -> list[Callable[[], object]]:
    """Drop the indexes by digits and the R*Tree's trigger. Returns the steps that build them again.

    The other indexes end in the rising id: updating them costs less than reading the table again.
    """
    query = "SELECT name, type, sql FROM sqlite_master WHERE tbl_name = ? AND sql IS NOT NULL AND type IN (?, ?)"
    found = connection.exec_driver_sql(query, (table.name, "index", "trigger")).all()
    rebuild: list[Callable[[], object]] = []
    for name, kind, statement in found:
        if kind == "index" and "digits" in statement:
            connection.exec_driver_sql(f"DROP INDEX {name}")
        elif name == _RTREE_TRIGGER:
            connection.exec_driver_sql(f"DROP TRIGGER {name}")
            last = connection.exec_driver_sql(f"SELECT coalesce(max(row), 0) FROM {table.name}").scalar_one()
            rebuild.append(partial(_fill_rtree, connection, table.name, last))
        else:
            continue
        rebuild.append(partial(connection.exec_driver_sql, statement))
    return rebuild


def _fill_rtree(connection: sa.Connection, table: str, last: int) -> None:
    """Put the rows after the `last` one into the R*Tree."""
    if last:
        statement = f"INSERT INTO {table}_rtree SELECT row, lon_deg, lon_deg, lat_deg, lat_deg FROM {table}"
        connection.exec_driver_sql(f"{statement} WHERE row > ?", (last,))
    else:
        fill_rtree(connection, table)


def _postpone_postgresql(connection: sa.Connection, table: sa.Table) -> list[Callable[[], object]]:
    """Drop the indexes and foreign keys of an empty table that we own. Returns the steps that build them again.

    Nobody waits for the lock: an empty table has nothing to read.
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
    # no other session sees the rows before they are committed, and then the policies apply to the owner again
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


def _copy(connection: sa.Connection, table: sa.Table, columns: Columns) -> None:
    import psycopg  # here: a server on SQLite loads none of it

    driver = connection.connection.driver_connection
    assert driver is not None
    names = (*columns.own, *columns.same)
    target = _copied_into(connection, table, names)
    statement = f"COPY {target} ({_listed(names)}) FROM STDIN"
    try:
        with driver.cursor() as cursor, cursor.copy(statement) as copy:
            copy.write(_copy_text(columns))
    except psycopg.Error as error:  # the exception that SQLAlchemy raises for its own statements
        raise sa.exc.DBAPIError.instance(statement, None, error, psycopg.Error) from error
    if target != table.name:
        listed = _listed(names)
        connection.exec_driver_sql(f"INSERT INTO {table.name} ({listed}) SELECT {listed} FROM {target}")
        connection.exec_driver_sql(f"DROP TABLE {target}")


def _copy_text(columns: Columns) -> str:
    """Rows in the text format of COPY (https://www.postgresql.org/docs/current/sql-copy.html, "File Formats")."""
    same = "".join(f"\t{_copy_value(value)}" for value in columns.same.values()) + "\n"
    own = [list(map(_copy_value, values)) for values in columns.own.values()]
    return same.join(map("\t".join, zip(*own, strict=True))) + same


def _copy_value(value: object) -> str:
    if isinstance(value, str):
        return value.replace("\\", "\\\\").replace("\t", "\\t").replace("\n", "\\n").replace("\r", "\\r")
    if isinstance(value, bytes):
        return f"\\\\x{value.hex()}"
    return "\\N" if value is None else str(value)


def _copied_into(connection: sa.Connection, table: sa.Table, names: Sequence[str]) -> str:
    """The table itself, or a temporary one if row level security applies to us: PostgreSQL then refuses COPY."""
    if not connection.exec_driver_sql("SELECT row_security_active(%s)", (table.name,)).scalar_one():
        return table.name
    target = f"{table.name}_copied"
    connection.exec_driver_sql(
        f"CREATE TEMPORARY TABLE {target} ON COMMIT DROP AS SELECT {_listed(names)} FROM {table.name} WITH NO DATA"
    )
    return target


def _listed(names: Sequence[str]) -> str:
    return ", ".join(f'"{name}"' for name in names)


def _json(value: object) -> str | None:
    return None if value is None else orjson.dumps(value).decode()


@lru_cache(maxsize=64)
def _sqlite_time(value: datetime | None) -> str | None:
    """A UTC time as SQLAlchemy stores it in SQLite."""
    return None if value is None else value.strftime("%Y-%m-%d %H:%M:%S.%f")
