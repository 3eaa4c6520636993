"""Databases that tests make for themselves on a PostgreSQL server, and drop afterwards."""

from __future__ import annotations

import itertools
import os
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import sqlalchemy as sa

from app.registry.database import Database
from tests.machine import refuse

LEAKPROOF = "ALTER FUNCTION geometry_overlaps(geometry, geometry) LEAKPROOF"
LOCAL_SERVER = "postgresql+psycopg://postgres@127.0.0.1:5432/postgres"


class PostgresServer:
    """A server and the databases that were made on it.

    Schemas belong to a role that is no superuser, so that the policies on rows bind every test.

    Making and dropping a database writes the whole server to its disk. So a run makes one (each worker of pytest-xdist
    its own), and every module and every test that wants an empty one gets an empty schema in it.
    """

    def __init__(self, url: sa.URL) -> None:
        self.url = url
        self._prefix = f"waymark_test_{secrets.token_hex(4)}"
        self._made: list[str] = []
        self._shared: sa.URL | None = None
        self._schemas = itertools.count(1)

    def empty(self) -> str:
        """URL of an empty schema in a database with PostGIS."""
        if self._shared is None:
            self._shared = sa.make_url(self.create())
            with _connected(self._shared) as connection:
                connection.exec_driver_sql("CREATE EXTENSION postgis")
                connection.exec_driver_sql(LEAKPROOF)
                connection.exec_driver_sql(f"CREATE ROLE {self._prefix}")
        schema = f"test_{next(self._schemas)}"
        with _connected(self._shared) as connection:
            connection.exec_driver_sql(f"CREATE SCHEMA {schema} AUTHORIZATION {self._prefix}")
        options = f"-c search_path={schema},public -c role={self._prefix}"
        url = self._shared.update_query_dict({"options": options})
        return url.render_as_string(hide_password=False)

    def create(self) -> str:
        """URL of a new database without PostGIS."""
        name = f"{self._prefix}_{len(self._made)}"
        with _connected(self.url) as connection:
            connection.exec_driver_sql(f"CREATE DATABASE {name} TEMPLATE template0 ENCODING 'UTF8'")
        self._made.append(name)
        return self.url.set(database=name).render_as_string(hide_password=False)

    def drop_all(self) -> None:
        """Drop every database made here, whoever is still connected to it."""
        with _connected(self.url) as connection:
            while self._made:
                connection.exec_driver_sql(f"DROP DATABASE {self._made.pop()} WITH (FORCE)")
            connection.exec_driver_sql(f"DROP ROLE IF EXISTS {self._prefix}")


@contextmanager
def postgres_server() -> Iterator[PostgresServer]:
    """The server of WAYMARK_TEST_POSTGRES_URL, or the local one.

    Without one the tests that need it are skipped; with CI=true they fail.
    """
    url = sa.make_url(os.environ.get("WAYMARK_TEST_POSTGRES_URL") or LOCAL_SERVER)
    try:
        with _connected(url) as connection:
            connection.exec_driver_sql("SELECT 1")
    except sa.exc.OperationalError as error:
        reason = f"no PostgreSQL at {url}; WAYMARK_TEST_POSTGRES_URL names another: {error.orig}"
        refuse(reason)
    server = PostgresServer(url)
    try:
        yield server
    finally:
        server.drop_all()


@contextmanager
def _connected(url: sa.URL) -> Iterator[sa.Connection]:
    engine = sa.create_engine(url, isolation_level="AUTOCOMMIT", poolclass=sa.NullPool)
    try:
        with engine.connect() as connection:
            yield connection
    finally:
        engine.dispose()


def query_plan(database: Database, ask: Callable[[sa.Connection], object]) -> str:
    """How the database runs the last statement of `ask`."""
    statements: list[tuple[str, Any]] = []

    def keep(_c: object, _cursor: object, statement: str, parameters: Any, *_: object) -> None:
        if "set_config" not in statement:
            statements.append((statement, parameters))

    with database.read() as connection:
        sa.event.listen(connection, "before_cursor_execute", keep)
        ask(connection)
        query, parameters = statements[-1]
        explain = "EXPLAIN" if database.path is None else "EXPLAIN QUERY PLAN"
        return "\n".join(str(row) for row in connection.exec_driver_sql(f"{explain} {query}", parameters).all())
