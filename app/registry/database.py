"""Connections, transactions, ownership and migrations of the database.

SQLite runs in WAL mode with synchronous FULL and foreign keys on. Reads use plain transactions; writes start with
BEGIN IMMEDIATE, so that a writer never discovers halfway that another one came first.
"""

from __future__ import annotations

import fcntl
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import orjson
import sqlalchemy as sa
from alembic import command
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import event

from app.errors import Unavailable
from app.registry.spatial import register_functions

MIGRATIONS = Path(__file__).resolve().parents[2] / "migrations"
BUSY_TIMEOUT_S = 10.0
_WRITE = "waymark_write"


class Database:
    """A database and its transactions.

    Parameters
    ----------
    url : str
        SQLAlchemy URL of a SQLite file. Nothing is opened or created before `open` or the first transaction.
    """

    def __init__(self, url: str) -> None:
        self.url = sa.make_url(url)
        if self.url.get_backend_name() != "sqlite" or not self.url.database or self.url.database == ":memory:":
            raise Unavailable(f"{self.url.render_as_string()} is not a SQLite file", field="database_url")
        self.path = Path(self.url.database)
        self.engine = _sqlite_engine(self.url)
        self._one_writer = threading.Lock()
        self._lock_fd: int | None = None

    def open(self) -> None:
        """Take ownership of the file for this process.

        Raises
        ------
        Unavailable
            Another process owns it.
        """
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._lock_fd = _lock_file(self.path.with_name(self.path.name + ".lock"), self.path)

    def close(self) -> None:
        """Close the connections and give the file up."""
        self.engine.dispose()
        if self._lock_fd is not None:
            os.close(self._lock_fd)
            self._lock_fd = None

    @contextmanager
    def read(self) -> Iterator[sa.Connection]:
        """A read transaction: one consistent snapshot."""
        with _busy_is_unavailable(), self.engine.connect() as connection:
            yield connection

    @contextmanager
    def write(self) -> Iterator[sa.Connection]:
        """A write transaction, committed when the block ends without an error."""
        if not self._one_writer.acquire(timeout=BUSY_TIMEOUT_S):
            raise Unavailable("the database is busy", cure="try again in a few seconds")
        try:
            with _busy_is_unavailable(), self.engine.connect() as connection:
                connection = connection.execution_options(**{_WRITE: True})
                with connection.begin():
                    yield connection
        finally:
            self._one_writer.release()

    def migrate(self, revision: str = "head") -> None:
        """Bring the schema to a revision, up or down, in one transaction."""
        with self.write() as connection:
            config = alembic_config()
            config.attributes["connection"] = connection
            now = MigrationContext.configure(connection).get_current_revision()
            target = ScriptDirectory.from_config(config).get_revision(revision) if revision != "base" else None
            if now is not None and (target is None or target.revision < now):
                command.downgrade(config, revision)
            else:
                command.upgrade(config, revision)

    def is_ready(self) -> bool:
        """Whether the schema is current and a write transaction can start."""
        try:
            with self.write() as connection:
                return MigrationContext.configure(connection).get_current_revision() == head_revision()
        except (Unavailable, sa.exc.SQLAlchemyError):
            return False


def alembic_config() -> Config:
    """Alembic's configuration, without a file."""
    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS).replace("%", "%%"))
    return config


def head_revision() -> str | None:
    """The newest revision that this code knows."""
    return ScriptDirectory.from_config(alembic_config()).get_current_head()


def _sqlite_engine(url: sa.URL) -> sa.Engine:
    engine = sa.create_engine(
        url,
        connect_args={"timeout": BUSY_TIMEOUT_S, "check_same_thread": False},
        json_serializer=lambda value: orjson.dumps(value).decode(),
        json_deserializer=orjson.loads,
        pool_size=8,
        max_overflow=40,
    )

    @event.listens_for(engine, "connect")
    def configure(connection: Any, _record: Any) -> None:
        connection.isolation_level = None  # the driver starts no transaction of its own; `begin` below does
        register_functions(connection)
        for pragma in ("journal_mode = WAL", "synchronous = FULL", "foreign_keys = ON"):
            connection.execute(f"PRAGMA {pragma}")

    @event.listens_for(engine, "begin")
    def begin(connection: sa.Connection) -> None:
        immediate = connection.get_execution_options().get(_WRITE, False)
        connection.exec_driver_sql("BEGIN IMMEDIATE" if immediate else "BEGIN")

    return engine


def _lock_file(lock: Path, database: Path) -> int:
    descriptor = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        owner = os.read(descriptor, 32).decode(errors="replace").strip() or "unknown"
        os.close(descriptor)
        raise Unavailable(
            f"{database} is in use by another Waymark process (pid {owner})",
            field="data_dir",
            limit="one process owns the embedded database",
            cure="stop the other process, or set WAYMARK_DATA_DIR to another folder",
        ) from error
    os.ftruncate(descriptor, 0)
    os.write(descriptor, f"{os.getpid()}\n".encode())
    return descriptor


@contextmanager
def _busy_is_unavailable() -> Iterator[None]:
    try:
        yield
    except sa.exc.TimeoutError as error:
        raise Unavailable("every database connection is in use", cure="try again in a few seconds") from error
    except sa.exc.OperationalError as error:
        if "locked" in str(error.orig) or "busy" in str(error.orig):
            raise Unavailable("the database is busy", cure="try again in a few seconds") from error
        raise
