"""Engines of the two databases: connections, their settings, and the failures after which a request can be repeated."""

from __future__ import annotations

import sqlite3
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import orjson
import sqlalchemy as sa
from sqlalchemy import event

from app.errors import ClientLeft, CommitUnknown, StorageFull, Unavailable
from app.registry.spatial import register_functions
from app.values import JsonObject

# === The agency of a transaction, for row level security on PostgreSQL (migration 0009).
#
# Every query has a condition on `agency_id`. If one is forgotten, the policies still hide the rows of other agencies:
# each transaction states its agency when it starts, and a transaction without an agency sees no rows. A context
# variable stores the agency; the threads of a request inherit it, and the middleware sets it when a request is
# authenticated.


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


# === Engines of the two databases.


BUSY_TIMEOUT_S = 10.0
STATEMENT_TIMEOUT_S = 60.0
WRITE = "waymark_write"
LONG = "waymark_long"
# Every write transaction on PostgreSQL holds this lock of its database from its first statement until it is committed.
_ONE_WRITER = 0x5741594D41524B  # "WAYMARK"
_SESSION = {
    "timezone": "UTC",
    "statement_timeout": f"{STATEMENT_TIMEOUT_S * 1000:.0f}",
    "lock_timeout": f"{BUSY_TIMEOUT_S * 1000:.0f}",
    "jit": "off",  # compiling costs more than any of these queries
    "plan_cache_mode": "force_custom_plan",  # a plan for any box reads the whole agency for a small one
}
_PAGE_BYTES = 16_384
"""Page size of a new SQLite file. [byte] Rows have 2 kB, and finding a page takes longer the more pages the log holds,
which contains the whole of an import. No figure was kept; `python -m benchmarks.imports` measures it."""
_CANNOT_BE_REACHED = "the database cannot be reached"
_BUSY, _DISK_FAILED = "the database is busy", "the disk of the database failed"
_SQLITE_TEMPORARY = {
    sqlite3.SQLITE_BUSY: _BUSY,
    sqlite3.SQLITE_LOCKED: _BUSY,
    sqlite3.SQLITE_IOERR: _DISK_FAILED,
    sqlite3.SQLITE_CANTOPEN: _DISK_FAILED,
}
"""Result codes that say nothing about the request. Source: https://www.sqlite.org/rescode.html"""


def _operational() -> tuple[type[Exception], ...]:
    """Failures of the database, as SQLAlchemy raises them and as the drivers do where they are used without it."""
    own: tuple[type[Exception], ...] = (sa.exc.OperationalError, sqlite3.OperationalError)
    psycopg = _loaded_psycopg()
    return own if psycopg is None else (*own, psycopg.OperationalError)


def _loaded_psycopg() -> Any:
    """The driver of PostgreSQL if the process has loaded it: a server on SQLite does not."""
    return sys.modules.get("psycopg")


class Stops:
    """How to stop what runs for a request, once its client has left. Safe for threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._stops: list[Callable[[], object]] = []
        self.stopped = False

    def check(self) -> None:
        """Stop here if the client has left.

        Raises
        ------
        ClientLeft
        """
        if self.stopped:
            raise ClientLeft

    @contextmanager
    def calling(self, stop: Callable[[], object]) -> Iterator[None]:
        """`stop` is called when the client leaves while the block runs, from another thread, perhaps repeatedly.

        Raises
        ------
        ClientLeft
            It has left already.
        """
        with self._lock:
            self.check()
            self._stops.append(stop)
        try:
            yield
        finally:
            with self._lock:  # after it `stop` is not called any more
                self._stops.remove(stop)

    def stop(self) -> None:
        """Stop everything. To be called again until the request has ended: a statement may be about to start."""
        with self._lock:
            self.stopped = True
            for stop in self._stops:
                stop()


STOPS: ContextVar[Stops | None] = ContextVar("waymark_stops", default=None)
"""Of the request for which this thread works; None in jobs and on the command line."""


@contextmanager
def stoppable(connection: sa.Connection) -> Iterator[None]:
    """Statements on a connection that only reads end with `Unavailable` when the client of the request leaves."""
    stops, driver = STOPS.get(), connection.connection.driver_connection
    if stops is None or driver is None:
        yield
        return
    is_sqlite = isinstance(driver, sqlite3.Connection)
    try:
        with stops.calling(driver.interrupt if is_sqlite else driver.cancel):
            yield
    finally:
        if stops.stopped and not is_sqlite:
            connection.invalidate()  # PostgreSQL may cancel what the next request would ask on it


def _check_before_statements(engine: sa.Engine) -> None:
    @event.listens_for(engine, "before_cursor_execute")
    def check(connection: sa.Connection, *_statement: object) -> None:
        stops = STOPS.get()
        if stops is not None and not connection.get_execution_options().get(WRITE, False):
            stops.check()


class _ClosingPool(sa.QueuePool):
    """A pool that, once it is disposed of, closes every connection as soon as it comes back.

    SQLAlchemy's keeps them for nobody, and the server keeps their sessions until the garbage collector finds them.
    """

    _disposed = False

    def dispose(self) -> None:
        self._disposed = True
        super().dispose()

    def _do_return_conn(self, record: Any) -> None:
        if self._disposed:
            record.close()
        super()._do_return_conn(record)
        if self._disposed:  # perhaps since the question above: nothing stays
            super().dispose()


def sqlite_engine(url: sa.URL) -> sa.Engine:
    """Engine of a SQLite file: WAL, synchronous FULL, foreign keys on; writes start with BEGIN IMMEDIATE."""
    pragmas = (f"page_size = {_PAGE_BYTES}", "journal_mode = WAL", "synchronous = FULL", "foreign_keys = ON")
    engine = _sqlite_engine(url, *pragmas)

    @event.listens_for(engine, "begin")
    def begin(connection: sa.Connection) -> None:
        immediate = connection.get_execution_options().get(WRITE, False)
        connection.exec_driver_sql("BEGIN IMMEDIATE" if immediate else "BEGIN")

    return engine


def sqlite_asking_engine(url: sa.URL) -> sa.Engine:
    """Engine of a SQLite file for single statements, each in its own transaction."""
    return _sqlite_engine(url, "query_only = ON", pool_reset_on_return=None)


def _sqlite_engine(url: sa.URL, *pragmas: str, **options: object) -> sa.Engine:
    engine = sa.create_engine(
        url,
        connect_args={"timeout": BUSY_TIMEOUT_S, "check_same_thread": False},
        json_serializer=_json,
        json_deserializer=orjson.loads,
        poolclass=_ClosingPool,
        pool_size=40,  # one for each thread that answers requests: opening one costs more than most queries
        max_overflow=8,
        **options,
    )

    @event.listens_for(engine, "connect")
    def configure(connection: Any, _record: object) -> None:
        connection.isolation_level = None  # the driver starts no transaction of its own
        register_functions(connection)
        for pragma in pragmas:
            connection.execute(f"PRAGMA {pragma}")

    _check_before_statements(engine)
    return engine


def postgres_asking_engine(url: sa.URL) -> sa.Engine:
    """Engine of a PostgreSQL database for single statements, without BEGIN, ROLLBACK or a ping.

    A statement sees one snapshot by itself. Before it a ping, a BEGIN and after it a ROLLBACK cost more than it does.
    """
    import psycopg  # here: a server on SQLite loads none of it

    class BinaryCursor(psycopg.Cursor[object]):
        """A cursor that returns numbers and times in binary, not as text."""

        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options)
            self.format = psycopg.pq.Format.BINARY

    options = _connect_args(url)
    options["cursor_factory"] = BinaryCursor
    options["options"] += " -c default_transaction_read_only=on"
    engine = sa.create_engine(
        url,
        connect_args=options,
        isolation_level="AUTOCOMMIT",
        json_deserializer=orjson.loads,
        poolclass=_ClosingPool,
        pool_size=10,
        max_overflow=30,
        pool_timeout=BUSY_TIMEOUT_S,
        pool_reset_on_return=None,
    )
    _check_before_statements(engine)
    return engine


def _connect_args(url: sa.URL) -> JsonObject:
    given = url.query.get("options", "")
    options = [f"-c {name}={value}" for name, value in _SESSION.items()]
    return {
        "options": " ".join([*options, given if isinstance(given, str) else " ".join(given)]),
        "connect_timeout": url.query.get("connect_timeout", int(BUSY_TIMEOUT_S)),
        "application_name": url.query.get("application_name", "waymark"),
    }


def postgres_engine(url: sa.URL) -> sa.Engine:
    """Engine of a PostgreSQL database: a read sees one snapshot and cannot write; writes run one after another."""
    engine = sa.create_engine(
        url,
        connect_args=_connect_args(url),
        json_serializer=_json,
        json_deserializer=orjson.loads,
        poolclass=_ClosingPool,
        pool_size=10,
        max_overflow=20,
        pool_timeout=BUSY_TIMEOUT_S,
        pool_pre_ping=True,
    )

    @event.listens_for(engine, "begin")
    def begin(connection: sa.Connection) -> None:
        options = connection.get_execution_options()
        if options.get(LONG, False):
            connection.exec_driver_sql("SET LOCAL statement_timeout = 0")
            connection.exec_driver_sql("SET LOCAL lock_timeout = 0")
        if options.get(WRITE, False):
            connection.exec_driver_sql(f"SELECT pg_advisory_xact_lock({_ONE_WRITER})")
        set_whose(connection, whose_rows())

    _check_before_statements(engine)
    return engine


def isolation(url: sa.URL, *, write: bool) -> dict[str, object]:
    """Execution options of a connection's next transaction."""
    if url.get_backend_name() == "sqlite":
        return {WRITE: write}
    # after it has the lock, a writer is the only one: each of its statements sees all that was committed before
    level = "READ COMMITTED" if write else "REPEATABLE READ"
    return {WRITE: write, "isolation_level": level, "postgresql_readonly": not write}


@contextmanager
def busy_is_unavailable() -> Iterator[None]:
    """Raise temporary failures of the database as `Unavailable`."""
    try:
        yield
    except sa.exc.TimeoutError as error:
        raise Unavailable("every database connection is in use", cure="try again in a few seconds") from error
    except _operational() as error:
        failure = _temporary(error)
        if failure is None:
            raise
        raise failure from error


@contextmanager
def cut_commit_is_unknown() -> Iterator[None]:
    """Raise a failure in the middle of a commit as `CommitUnknown`: it may be durable although nothing confirmed it."""
    try:
        yield
    except _operational() as error:
        if isinstance(_temporary(error), StorageFull):
            raise  # the end of the transaction was not written
        raise CommitUnknown(
            "the database failed while it stored the change, which may be stored or not",
            cure="read it again, or repeat the request with the same Idempotency-Key",
        ) from error


def _temporary(error: Exception) -> Unavailable | None:
    """A failure that has nothing to do with the request; None if it may have."""
    cause = error.orig if isinstance(error, sa.exc.OperationalError) else error
    message = _CANNOT_BE_REACHED
    if isinstance(cause, sqlite3.OperationalError):
        code = cause.sqlite_errorcode & 0xFF  # without what the extended code adds
        if code == sqlite3.SQLITE_FULL:
            return StorageFull("the database")
        if code == sqlite3.SQLITE_INTERRUPT:
            return ClientLeft()
        if code == sqlite3.SQLITE_READONLY:
            return Unavailable("the database is on a read-only disk", cure="try again when the operator has changed it")
        if code not in _SQLITE_TEMPORARY:
            return None
        message = _SQLITE_TEMPORARY[code]
    elif (psycopg := _loaded_psycopg()) is not None and isinstance(cause, psycopg.Error):
        if cause.sqlstate == "53100":
            return StorageFull("the database")
        if cause.sqlstate == "57014" and (stops := STOPS.get()) is not None and stops.stopped:
            return ClientLeft()
        if cause.sqlstate == "57014":
            message = f"the database needed more than {STATEMENT_TIMEOUT_S:.0f} s for one statement"
        elif cause.sqlstate in ("55P03", "40001", "40P01"):
            message = _BUSY
        elif cause.sqlstate == "58030":
            message = _DISK_FAILED
    return Unavailable(message, cure="try again in a few seconds")


def _json(value: object) -> str:
    return orjson.dumps(value, option=orjson.OPT_SERIALIZE_NUMPY).decode()
