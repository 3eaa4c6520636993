"""The whole content of a database as files, and back: a copied SQLite file, or one COPY file for each PostgreSQL table.

Nothing here depends on the schema of this version: an older database is written and loaded as it is, and migrated
afterwards. The schema itself, with its row level security, comes from the migrations.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from graphlib import TopologicalSorter
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple
from urllib.parse import quote

import sqlalchemy as sa

from app.errors import Unavailable
from app.registry.database import Database, stored_revision
from app.registry.engines import BUSY_TIMEOUT_S
from app.registry.spatial import register_functions

if TYPE_CHECKING:
    import psycopg

_CHUNK_BYTES = 1024**2
_REVISIONS = "alembic_version"
_OWN_TABLES = """
SELECT c.oid, c.relname FROM pg_class c
WHERE c.relnamespace = current_schema()::regnamespace AND c.relkind = 'r' AND c.relname <> 'alembic_version'
  AND NOT EXISTS (SELECT 1 FROM pg_depend d WHERE d.objid = c.oid AND d.deptype = 'e')
ORDER BY c.relname
"""
"""Tables of the schema, without those of extensions (PostGIS has spatial_ref_sys)."""
_REFERENCES = "SELECT conrelid, confrelid FROM pg_constraint WHERE contype = 'f'"
_COLUMNS = """
SELECT attname FROM pg_attribute
WHERE attrelid = %s AND attnum > 0 AND NOT attisdropped AND attgenerated = '' ORDER BY attnum
"""
_PLAIN_TEXT = (
    "SET LOCAL DateStyle = 'ISO, YMD'",
    "SET LOCAL IntervalStyle = 'postgres'",
    "SET LOCAL extra_float_digits = 3",
)
"""Whatever the server's configuration: text that any other server reads as the same value."""


class TableDump(NamedTuple):
    """A table: its name, the columns of its file, and its rows."""

    name: str
    columns: tuple[str, ...]
    rows: int


class DatabaseSummary(NamedTuple):
    """What a dump contains."""

    revision: str  # of the schema
    tables: tuple[TableDump, ...]  # in an order in which no row refers to one that is loaded later
    heads: dict[str, str]  # by the name of each agency, its newest audit entry as NUMBER:HASH


# --- SQLite ---------------------------------------------------------------------------------------------------------


def copy_sqlite(source: Path, target: Path) -> None:
    """Copy a database file to a new file, also while another process writes to it: one snapshot.

    The connection only reads, also when it is closed: two processes that write or run checkpoints could damage the log
    (SQLite before 3.51.3).

    Raises
    ------
    Unavailable
        The database is damaged, or cannot be read.
    """
    try:
        with (
            closing(sqlite3.connect(f"{_uri(source)}?mode=ro", uri=True, timeout=BUSY_TIMEOUT_S)) as database,
            closing(sqlite3.connect(target)) as copy,
        ):
            database.backup(copy)  # all pages in one step, so that no write can come between
            copy.execute("PRAGMA journal_mode = DELETE")  # the copy is complete in one file
            faults = [row[0] for row in copy.execute("PRAGMA integrity_check(5)") if row[0] != "ok"]
            faults += [f"{row[0]}: row {row[1]} refers to nothing" for row in copy.execute("PRAGMA foreign_key_check")]
    except sqlite3.Error as error:
        raise Unavailable(f"{source} cannot be copied: {error}") from error
    if faults:
        raise Unavailable(f"{source} is damaged: {'; '.join(faults[:5])}", cure="restore the last backup")


@contextmanager
def finished_sqlite(path: Path) -> Iterator[sa.Connection]:
    """A connection to a file that nobody writes to; nothing is created beside it."""
    database = f"{_uri(path)}?mode=ro&immutable=1"
    engine = sa.create_engine("sqlite://", creator=lambda: sqlite3.connect(database, uri=True), poolclass=sa.StaticPool)
    sa.event.listen(engine, "connect", lambda connection, _record: register_functions(connection))
    try:
        with engine.connect() as connection:
            yield connection
    finally:
        engine.dispose()


def summarize_sqlite(connection: sa.Connection) -> DatabaseSummary:
    """What a copied file contains; its tables have no order."""
    names = connection.exec_driver_sql(
        "SELECT name FROM pragma_table_list WHERE schema = 'main' AND type = 'table' AND name NOT LIKE 'sqlite\\_%'"
        " ESCAPE '\\' ORDER BY name"
    ).scalars()
    tables = [TableDump(name, (), _count(connection, name)) for name in names if name != _REVISIONS]
    return DatabaseSummary(_revision(connection), tuple(tables), _heads(connection, tables))


def _uri(path: Path) -> str:
    return f"file:{quote(str(path.resolve()))}"


# --- PostgreSQL -----------------------------------------------------------------------------------------------------


def dump_postgres(connection: sa.Connection, folder: Path) -> DatabaseSummary:
    """Write the rows of a read transaction to a file for each table, in the text format of COPY.

    The transaction is one snapshot (REPEATABLE READ) and has to see the rows of every agency.
    """
    _write_plain_text(connection)
    tables = []
    for oid, name in _ordered_tables(connection):
        columns = tuple(connection.exec_driver_sql(_COLUMNS, (oid,)).scalars())
        statement = f"COPY (SELECT {_listed(columns)} FROM {_quoted(name)}) TO STDOUT"
        with (folder / f"{name}.copy").open("xb") as file, _cursor(connection) as cursor:
            with cursor.copy(statement) as copy:
                for part in copy:
                    file.write(part)
            tables.append(TableDump(name, columns, max(cursor.rowcount, 0)))
    return DatabaseSummary(_revision(connection), tuple(tables), _heads(connection, tables))


def load_postgres(connection: sa.Connection, folder: Path, tables: tuple[TableDump, ...]) -> None:
    """Load the files of a dump into the empty tables of a schema of the same revision.

    Row level security refuses COPY into a table, so rows go through a temporary one (registry/bulk_load.py does so,
    too). Sequences go on after the greatest number.

    Raises
    ------
    Unavailable
        A table is not empty, or has other rows afterwards than the dump.
    """
    _write_plain_text(connection)
    for table in tables:
        if _count(connection, table.name):
            raise Unavailable(f"the table {table.name} is not empty", cure="restore into a new database")
        if table.rows:
            _load_table(connection, folder / f"{table.name}.copy", table)
        if (found := _count(connection, table.name)) != table.rows:
            raise Unavailable(f"the table {table.name} has {found} rows, the backup {table.rows}")
        for column in table.columns:
            sequence = connection.exec_driver_sql(
                "SELECT pg_get_serial_sequence(%s, %s)", (_quoted(table.name), column)
            ).scalar()
            if sequence is not None and table.rows:
                last = f"(SELECT max({_quoted(column)}) FROM {_quoted(table.name)})"
                connection.exec_driver_sql(f"SELECT setval(%s, {last})", (sequence,))


def list_postgres_tables(connection: sa.Connection) -> list[str]:
    """Names of the tables of the schema."""
    return [name for _oid, name in connection.exec_driver_sql(_OWN_TABLES)]


def _load_table(connection: sa.Connection, path: Path, table: TableDump) -> None:
    columns, name = _listed(table.columns), _quoted(table.name)
    connection.exec_driver_sql(
        f"CREATE TEMPORARY TABLE restored ON COMMIT DROP AS SELECT {columns} FROM {name} WITH NO DATA"
    )
    with path.open("rb") as file, _cursor(connection) as cursor:
        with cursor.copy(f"COPY restored ({columns}) FROM STDIN") as copy:
            while part := file.read(_CHUNK_BYTES):
                copy.write(part)
        cursor.execute(f"INSERT INTO {name} ({columns}) OVERRIDING SYSTEM VALUE SELECT {columns} FROM restored")
        cursor.execute("DROP TABLE restored")


def _ordered_tables(connection: sa.Connection) -> list[tuple[int, str]]:
    names: dict[int, str] = {row.oid: row.relname for row in connection.exec_driver_sql(_OWN_TABLES)}
    order: TopologicalSorter[int] = TopologicalSorter(dict.fromkeys(names, ()))
    for table, referred in connection.exec_driver_sql(_REFERENCES):
        if table in names and referred in names and table != referred:
            order.add(table, referred)
    return [(oid, names[oid]) for oid in order.static_order()]


def _write_plain_text(connection: sa.Connection) -> None:
    for statement in _PLAIN_TEXT:
        connection.exec_driver_sql(statement)


@contextmanager
def _cursor(connection: sa.Connection) -> Iterator[psycopg.Cursor[tuple[object, ...]]]:
    import psycopg  # here: a server on SQLite loads none of it

    driver = connection.connection.driver_connection
    assert isinstance(driver, psycopg.Connection)
    try:
        with driver.cursor() as cursor:
            yield cursor
    except psycopg.Error as error:  # as SQLAlchemy raises it for its own statements
        raise sa.exc.DBAPIError.instance("COPY", None, error, psycopg.Error) from error


# --- both -----------------------------------------------------------------------------------------------------------


def has_rows(database: Database) -> bool:
    """Whether a database was used before: a server creates an agency at its first start."""
    with database.read() as connection:
        if not sa.inspect(connection).has_table("agencies"):
            return False
        return _count(connection, "agencies") > 0


def _read_heads(connection: sa.Connection) -> Mapping[str, str]:
    """By the name of each agency, its newest audit entry as NUMBER:HASH."""
    query = (
        "SELECT a.name, l.number, l.hash FROM agencies a JOIN audit_log l ON l.agency_id = a.id"
        " WHERE l.number = (SELECT max(number) FROM audit_log m WHERE m.agency_id = a.id) ORDER BY a.name"
    )
    return {name: f"{number}:{digest}" for name, number, digest in connection.exec_driver_sql(query)}


def _heads(connection: sa.Connection, tables: list[TableDump]) -> dict[str, str]:
    has_log = any(table.name == "audit_log" for table in tables)  # since revision 0006
    return dict(_read_heads(connection)) if has_log else {}


def _revision(connection: sa.Connection) -> str:
    revision = stored_revision(connection)
    if revision is None:
        raise Unavailable("the database has no schema yet", cure="start the server once, or run waymark migrate")
    return revision


def _count(connection: sa.Connection, table: str) -> int:
    return int(connection.exec_driver_sql(f"SELECT count(*) FROM {_quoted(table)}").scalar_one())


def _listed(names: tuple[str, ...]) -> str:
    return ", ".join(map(_quoted, names))


def _quoted(name: str) -> str:
    escaped = name.replace('"', '""')
    return f'"{escaped}"'
