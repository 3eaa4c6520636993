"""Transactions, ownership and migrations of the database: a SQLite file, or PostgreSQL with PostGIS.

Both give the same guarantees. A read sees one snapshot. Writes come one after another, so what a write finds by a
query stays true until it is committed: SQLite's BEGIN IMMEDIATE, PostgreSQL's advisory lock (engines.py).
"""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import sqlalchemy as sa

from app import shipped_folder
from app.errors import InvalidParameter, Unavailable
from app.registry.engines import (
    BUSY_TIMEOUT_S,
    LONG,
    SETTING,
    WRITE,
    across_agencies,
    busy_is_unavailable,
    cut_commit_is_unknown,
    isolation,
    postgres_asking_engine,
    postgres_engine,
    set_whose,
    sqlite_asking_engine,
    sqlite_engine,
    stoppable,
    whose_rows,
)

if TYPE_CHECKING:
    from alembic.config import Config

Answer = TypeVar("Answer")
_NEW_BYTES = 8 * 2**20
"""Room for a new database: 2.5 MB and its log while the schema is made. [byte]"""
_RESERVE_BYTES = 2**20
"""Room that is kept in a file, and given up when the disk is full: for the files that SQLite needs to read. [byte]"""
MIGRATIONS = shipped_folder("migrations")


class Database:
    """A database and its transactions.

    Parameters
    ----------
    url : str
        SQLAlchemy URL of a SQLite file, or postgresql+psycopg://... of a database that has PostGIS. Nothing is opened
        or created before `open` or the first transaction.

    Attributes
    ----------
    writes : int
        Write transactions that this process has ended: what was read since the last one is as it was.
    waiting_writers : int
        Write transactions of this process that wait for another one of it; nearly exact, for metrics.
    """

    def __init__(self, url: str) -> None:
        try:
            self.url = sa.make_url(url)
        except (sa.exc.ArgumentError, ValueError) as error:
            raise Unavailable("this is not the URL of a database", field="database_url") from error
        self.path: Path | None = None
        if self.url.drivername == "postgresql+psycopg" and self.url.database:
            self.engine = postgres_engine(self.url)
            self._asking = postgres_asking_engine(self.url)
        elif (
            self.url.get_backend_name() == "sqlite"
            and self.url.database
            and not self.url.database.startswith(":memory:")
        ):
            self.path = Path(self.url.database)
            self.engine = sqlite_engine(self.url)
            self._asking = sqlite_asking_engine(self.url)
        else:
            raise Unavailable(
                f"{self.name} is neither a SQLite file nor a PostgreSQL database",
                field="database_url",
                limit="sqlite:///PATH or postgresql+psycopg://USER@HOST/DATABASE",
            )
        self._one_writer = threading.Lock()
        self.writes = 0
        self.waiting_writers = 0
        self._lock_fd: int | None = None
        self._file: tuple[int, int] | None = None  # device and inode when it was first seen

    @property
    def name(self) -> str:
        """Name of the database for messages: its path, or its URL without the password."""
        return str(self.path) if self.path is not None else self.url.set(query={}).render_as_string()

    def open(self) -> None:
        """Take ownership of the file for this process, or check that the server can be used.

        Raises
        ------
        Unavailable
            Another process owns the file; the server cannot be reached or has no PostGIS; the disk has no room for a
            new database, or for the files that SQLite needs to read one.
        """
        if self.path is None:
            self._see_the_server()
            return
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._lock_fd = _lock_file(self.path.with_name(self.path.name + ".lock"), self.path)
        except OSError as error:
            if error.errno != errno.EROFS or not self.path.exists():
                raise
            self._read_only()
            return
        try:
            self._check_room(self.path)
        except BaseException:
            self.close()
            raise

    def _read_only(self) -> None:
        """Read a file on a disk that is mounted read-only: SQLite needs no file beside it then."""
        assert self.path is not None
        log = self.path.with_name(self.path.name + "-wal")
        if log.exists() and log.stat().st_size:
            raise Unavailable(
                f"{self.path} is on a read-only disk, and its last changes are still in {log.name}",
                field="data_dir",
                cure="mount the disk for writing once, so that they are moved into the file",
            )
        query = {"mode": "ro", "immutable": "1", "uri": "true"}
        url = self.url.set(database=f"file:{self.path.resolve()}", query=query)
        self.engine, self._asking = sqlite_engine(url), sqlite_asking_engine(url)

    def _check_room(self, path: Path) -> None:
        """Make sure that SQLite can open the file, with the reserve where the disk is full, and keep a reserve if not.

        Even for reading, SQLite needs a file of 32 kB beside the database, which the last process deleted.
        """
        reserve = path.with_name(path.name + ".reserve")
        free = shutil.disk_usage(path.parent).free
        if free < _NEW_BYTES and not (path.exists() and path.stat().st_size):
            raise _no_room(path.parent)
        if free >= _NEW_BYTES and not reserve.exists():
            with suppress(OSError):  # a quota may be smaller than what is free
                reserve.write_bytes(bytes(_RESERVE_BYTES))
        if not path.exists():  # reading would make an empty one
            return
        try:
            with self.read() as connection:
                connection.exec_driver_sql("SELECT count(*) FROM sqlite_master")
        except Unavailable as error:
            if not reserve.exists():
                raise _no_room(path.parent) if free < _NEW_BYTES else error from error
            reserve.unlink()
            self.disconnect()
            self._check_room(path)

    def pools(self) -> Iterator[tuple[str, sa.QueuePool]]:
        """The pools of connections, by what they are for."""
        for name, engine in (("transactions", self.engine), ("questions", self._asking)):
            if isinstance(engine.pool, sa.QueuePool):
                yield name, engine.pool

    def disconnect(self) -> None:
        """Close the connections, and open new ones when they are needed."""
        self.engine.dispose()
        self._asking.dispose()

    def close(self) -> None:
        """Close the connections and release the file. What a thread opens later is closed after its use."""
        self.disconnect()
        for _, pool in self.pools():
            pool.dispose()  # the pool that `disconnect` made, without another one in its place
        if self._lock_fd is not None:
            os.close(self._lock_fd)
            self._lock_fd = None

    @contextmanager
    def read(self, *, long: bool = False) -> Iterator[sa.Connection]:
        """A read transaction: one consistent snapshot.

        Parameters
        ----------
        long : bool, optional
            Single statements may take as long as they take: verifying a log.
        """
        with busy_is_unavailable(), self.engine.connect() as connection:
            connection = connection.execution_options(**isolation(self.url, write=False), **{LONG: long})
            with stoppable(connection):
                yield connection

    def ask(self, question: Callable[[sa.Connection], Answer]) -> Answer:
        """The result of a single reading statement; `read` is for more than one.

        Parameters
        ----------
        question : callable
            Runs one statement on the connection that it gets, and may be called again if the connection was cut.
        """
        with busy_is_unavailable():
            try:
                return self._ask(question)
            except sa.exc.OperationalError as error:
                if not error.connection_invalidated:
                    raise
            return self._ask(question)

    def _ask(self, question: Callable[[sa.Connection], Answer]) -> Answer:
        with self._asking.connect() as connection:
            if self.path is None and connection.info.get(SETTING) != (whose := whose_rows()):
                set_whose(connection, whose, local=False)  # of the session: each statement is its own transaction
                connection.info[SETTING] = whose
            with stoppable(connection):
                return question(connection)

    @contextmanager
    def write(self, *, long: bool = False) -> Iterator[sa.Connection]:
        """A write transaction, committed when the block ends without an error. Then it survives a power failure.

        Parameters
        ----------
        long : bool, optional
            Single statements may take as long as they take: migrations, bulk imports.
        """
        self.waiting_writers += 1
        try:
            if not self._one_writer.acquire(timeout=BUSY_TIMEOUT_S):
                raise Unavailable("the database is busy", cure="try again in a few seconds")
        finally:
            self.waiting_writers -= 1
        try:
            with busy_is_unavailable(), self.engine.connect() as connection:
                connection = connection.execution_options(**isolation(self.url, write=True), **{LONG: long})
                transaction = connection.begin()
                try:
                    yield connection
                except BaseException:
                    transaction.rollback()
                    raise
                if transaction.is_active:  # the block may have rolled it back
                    with cut_commit_is_unknown():
                        transaction.commit()
        finally:
            self.writes += 1
            self._one_writer.release()

    @contextmanager
    def write_aside(self) -> Iterator[sa.Connection]:
        """A write transaction that does not wait for others, for what no other transaction relies on: leases."""
        with busy_is_unavailable(), self.engine.connect() as connection:
            options = {WRITE: False, "isolation_level": "READ COMMITTED", "postgresql_readonly": False}
            connection = connection.execution_options(**options if self.path is None else {WRITE: True})
            with connection.begin():
                yield connection

    def migrate(self, revision: str = "head") -> None:
        """Bring the schema to a revision, up or down, in one transaction; nothing is written if it is there already.

        Raises
        ------
        InvalidParameter
            There is no such revision.
        """
        target = head_revision() if revision == "head" else revision
        if target not in ("base", *_revisions()):
            raise InvalidParameter(
                f"there is no revision {revision[:40]!r} of the schema",
                field="revision",
                limit="head, base, or a file's revision in migrations/versions",
                cure="run waymark migrate without a revision for the newest schema",
            )
        if self.current_revision() == target:
            return  # without Alembic: loading it takes longer than most parts of a start
        with across_agencies(), self.write(long=True) as connection:
            from alembic import command

            config = alembic_config()
            config.attributes["connection"] = connection
            now = stored_revision(connection)
            if now is not None and (target == "base" or target < now):
                command.downgrade(config, target)
            else:
                command.upgrade(config, target)

    def current_revision(self) -> str | None:
        """The revision of the schema; None if there is none."""
        with self.read() as connection:
            return stored_revision(connection)

    def count_other_clients(self) -> int:
        """Connections of other Waymark processes to a PostgreSQL database; an open SQLite file is ours alone."""
        if self.path is not None:
            return 0
        own = self.url.query.get("application_name", "waymark")
        with self.engine.connect() as connection:
            self._asking.dispose()
            return int(
                connection.exec_driver_sql(
                    "SELECT count(*) FROM pg_stat_activity WHERE datname = current_database()"
                    " AND application_name = %s AND pid <> pg_backend_pid() AND usename = session_user",
                    (own,),
                ).scalar_one()
            )

    def is_ready(self) -> bool:
        """Whether requests can be answered."""
        return self.find_fault() is None

    def find_fault(self) -> str | None:
        """Why requests cannot be answered: the file is gone, the schema is not the current one, or the database does
        not answer or takes no changes. None if they can."""
        if self.path is not None:
            try:
                found = self.path.stat()
            except OSError as error:
                return f"{self.path}: {error.strerror}"
            self._file = self._file or (found.st_dev, found.st_ino)
            if self._file != (found.st_dev, found.st_ino):
                return f"{self.path} is not the file that was opened"
        standby = "0" if self.path is not None else "pg_is_in_recovery()"
        question = f"SELECT version_num, {standby} FROM alembic_version"
        try:
            row = self.ask(lambda connection: connection.exec_driver_sql(question).first())
        except (Unavailable, sa.exc.SQLAlchemyError) as error:
            return str(getattr(error, "orig", error))
        if row is None or row[0] != head_revision():
            return f"the schema has the revision {row and row[0]}, not {head_revision()}"
        return "the database is a standby and takes no changes" if row[1] else None

    def list_warnings(self) -> list[str]:
        """Warnings for the operator of a PostgreSQL server: row level security does not apply, or searches are slow."""
        if self.path is not None:
            return []
        with self.engine.connect() as connection:
            bound = connection.exec_driver_sql(
                "SELECT NOT (rolsuper OR rolbypassrls) FROM pg_roles WHERE rolname = current_user"
            ).scalar_one()
            fast = connection.exec_driver_sql(
                "SELECT proleakproof FROM pg_proc WHERE oid = to_regprocedure('geometry_overlaps(geometry, geometry)')"
            ).scalar()
        if not bound:
            return ["row level security does not bind this role; connect as one that is no superuser (docs/access.md)"]
        if not fast:
            statement = "ALTER FUNCTION geometry_overlaps(geometry, geometry) LEAKPROOF"
            return [f"searches cannot use the spatial index until a superuser runs: {statement} (docs/access.md)"]
        return []

    def _see_the_server(self) -> None:
        try:
            with self.engine.connect() as connection:
                postgis = connection.exec_driver_sql("SELECT 1 FROM pg_extension WHERE extname = 'postgis'").scalar()
                encoding = connection.exec_driver_sql("SHOW server_encoding").scalar()
        except sa.exc.OperationalError as error:
            raise Unavailable(
                f"{self.name} cannot be reached: {str(error.orig).strip()}",
                field="database_url",
                cure="start the server, or correct WAYMARK_DATABASE_URL",
            ) from error
        if postgis is None:
            raise Unavailable(
                f"{self.name} has no PostGIS",
                field="database_url",
                cure="run CREATE EXTENSION postgis in it once, as a superuser",
            )
        if encoding != "UTF8":
            raise Unavailable(f"{self.name} is encoded in {encoding}", field="database_url", limit="UTF8")


def alembic_config() -> Config:
    """Alembic's configuration, without a file."""
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS).replace("%", "%%"))
    return config


def stored_revision(connection: sa.Connection) -> str | None:
    """The revision of a database's schema; None if there is none."""
    if not sa.inspect(connection).has_table("alembic_version"):
        return None
    revision: str | None = connection.exec_driver_sql("SELECT version_num FROM alembic_version").scalar()
    return revision


@cache
def _revisions() -> tuple[str, ...]:
    """The revisions of the migrations, the newest last: the numbers with which the names of their files begin."""
    return tuple(sorted(path.name.partition("_")[0] for path in (MIGRATIONS / "versions").glob("[0-9]*_*.py")))


def head_revision() -> str:
    """The newest revision of the migrations."""
    return _revisions()[-1]


def is_known_revision(revision: str) -> bool:
    """Whether the migrations of this version have a revision."""
    return revision in _revisions()


def _no_room(folder: Path) -> Unavailable:
    return Unavailable(
        f"the disk of {folder} is full",
        field="data_dir",
        limit=f"{_NEW_BYTES // 2**20} MiB for a new database, 1 MiB to open one",
        cure="make room on this disk (df -h shows it), or set WAYMARK_DATA_DIR to another folder",
    )


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
    with suppress(OSError):  # the number is for people; on a full disk the lock holds without it
        os.write(descriptor, f"{os.getpid()}\n".encode())
    return descriptor
