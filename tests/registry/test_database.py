"""Transactions and migrations, on both databases alike."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor, wait
from contextvars import copy_context
from datetime import UTC, datetime

import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext

from app.errors import ClientLeft, CodeTaken, Unavailable
from app.families.documents import PositionIn
from app.families.plate.plates import CodeInput, PlateIn
from app.markers.plate import PlateScheme
from app.registry import agencies
from app.registry.database import Database, head_revision
from app.registry.engines import across_agencies
from app.registry.tables import metadata
from app.services.access.access import Access, Caller, Scope
from app.services.markers.markers import Markers
from app.services.request_work import working
from tests.http import WITHIN_S

NOW = datetime(2026, 3, 4, 5, 6, 7, tzinfo=UTC)


def _register(database: Database, lon_deg: float) -> dict[str, object]:
    caller = Caller(_agency(database), "key", "tester", Scope.PLANNER)
    plate = PlateIn(position=PositionIn(lon_deg=lon_deg, lat_deg=1.0), code=CodeInput(scheme=PlateScheme.POSITION))
    return Markers(database, lambda: NOW).register(caller, plate)[0]


def _agency(database: Database) -> str:
    with database.write() as connection:
        return agencies.find_first_agency(connection) or agencies.add_agency(connection, "one", NOW)


def _tables(database: Database) -> set[str]:
    with database.read() as connection:
        return set(sa.inspect(connection).get_table_names()) - {"spatial_ref_sys"}  # PostGIS brings it


def _is_declared(name: str | None, kind: str, parents: Mapping[str, str | None]) -> bool:
    """Whether something is part of the tables, and not of the spatial index or of PostGIS."""
    if kind == "table":
        return name in metadata.tables or (name is not None and "_rtree" not in name and name != "spatial_ref_sys")
    return "geom" not in str(name).split("_")


def test_the_connection_is_strict(database: Database) -> None:
    with pytest.raises(sa.exc.IntegrityError), database.write() as connection:
        agencies.add_key(connection, "x" * 40, agency_id="nobody", scope="viewer", label="x", prefix="x", now=NOW)


@pytest.mark.filterwarnings("ignore:Did not recognize type 'geometry'")
def test_migrations_make_what_the_code_declares(database: Database) -> None:
    with database.read() as connection:
        context = MigrationContext.configure(
            connection,
            opts={"include_name": _is_declared},
        )
        assert compare_metadata(context, metadata) == []


def test_migrations_run_up_down_and_up_on_data(database: Database) -> None:
    _register(database, 7.5)
    assert database.is_ready()
    database.migrate("base")
    assert not database.is_ready()
    assert _tables(database) <= {"alembic_version", "sqlite_sequence"}
    database.migrate()
    assert database.is_ready()
    assert set(metadata.tables) <= _tables(database)
    _register(database, 7.5)


def test_a_migration_that_fails_leaves_nothing_behind(empty_database: Database) -> None:
    with empty_database.write() as connection:
        connection.exec_driver_sql("CREATE TABLE observations (x INTEGER)")
    with pytest.raises(sa.exc.DBAPIError, match="already exists"):
        empty_database.migrate()
    assert _tables(empty_database) == {"observations"}


def test_migrating_twice_changes_nothing(database: Database) -> None:
    before = _register(database, 7.5)
    database.migrate()
    with database.read() as connection:
        assert MigrationContext.configure(connection).get_current_revision() == head_revision()
        assert connection.exec_driver_sql("SELECT id FROM markers").scalar() == before["id"]


def test_every_owned_table_names_its_agency() -> None:
    assert [name for name, table in metadata.tables.items() if "agency_id" not in table.c] == ["agencies"]


def test_a_failed_write_is_undone(database: Database) -> None:
    def fail() -> None:
        with database.write() as connection:
            agencies.add_agency(connection, "never", NOW)
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    with database.read() as connection:
        assert agencies.find_agency(connection, "never") is None


def test_concurrent_writers_never_lose_an_update(database: Database) -> None:
    with database.write() as connection:
        connection.exec_driver_sql("CREATE TABLE counter (n INTEGER)")
        connection.exec_driver_sql("INSERT INTO counter VALUES (0)")

    second = Database(database.url.render_as_string(hide_password=False))  # shares no lock of the process

    def count(database: Database) -> None:
        for _ in range(25):
            with database.write() as connection:
                n = connection.exec_driver_sql("SELECT n FROM counter").scalar_one()
                connection.exec_driver_sql(f"UPDATE counter SET n = {n + 1}")

    threads = [threading.Thread(target=count, args=(each,)) for each in (database, second) * 2]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    second.close()
    with database.read() as connection:
        assert connection.exec_driver_sql("SELECT n FROM counter").scalar() == 100


def test_a_read_sees_one_snapshot_and_waits_for_no_writer(database: Database) -> None:
    with database.read() as reader:
        assert agencies.find_agency(reader, "late") is None
        with database.write() as connection:
            agencies.add_agency(connection, "late", NOW)
            assert agencies.find_agency(reader, "late") is None
        assert agencies.find_agency(reader, "late") is None
    with database.read() as reader:
        assert agencies.find_agency(reader, "late") is not None


def test_what_is_unique_by_a_query_stays_unique(database: Database) -> None:
    """Two processes register the same position at the same time; no unique index stands behind it."""
    second = Database(database.url.render_as_string(hide_password=False))
    together = threading.Barrier(4)
    _agency(database)

    def register(database: Database, lon_deg: float) -> bool:
        together.wait(WITHIN_S)
        try:
            with across_agencies():
                _register(database, lon_deg)
        except CodeTaken:
            return False
        return True

    with ThreadPoolExecutor(4) as pool:
        for k in range(10):
            told = pool.map(register, (database, second) * 2, [float(k)] * 4)
            assert sorted(told) == [False, False, False, True]
    second.close()


def test_keys_are_stored_as_hashes_only(database: Database) -> None:
    key = Access(database, lambda: NOW).create_key("agency", Scope.VIEWER, "a key")
    with database.read() as connection:
        assert agencies.find_key(connection, key) is not None
        stored = connection.execute(sa.text("SELECT * FROM api_keys")).all()
    assert len(stored) == 1
    assert key not in str(stored)


@pytest.mark.parametrize(
    "url", ["sqlite://", "sqlite:///:memory:", "postgresql://localhost/x", "postgresql+psycopg://localhost", "nothing"]
)
def test_other_urls_are_refused(url: str) -> None:
    with pytest.raises(Unavailable) as refused:
        Database(url)
    assert refused.value.field == "database_url"


@pytest.mark.parametrize("question", [False, True], ids=["read", "ask"])
def test_a_statement_ends_when_the_client_leaves(database: Database, question: bool) -> None:
    """One that runs is interrupted, a further one does not start, and the next request has a connection that works."""
    endless = "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n) SELECT count(*) FROM n"
    statement = sa.text(endless if database.path is not None else "SELECT pg_sleep(600)")

    def run(connection: sa.Connection) -> None:
        started.set()
        connection.execute(statement).all()

    def ask() -> None:
        if question:
            database.ask(run)
            return
        with database.read() as connection:
            run(connection)

    started = threading.Event()
    with working(600.0) as work, ThreadPoolExecutor(1) as pool:
        asked = pool.submit(copy_context().run, ask)
        assert started.wait(WITHIN_S)
        while not asked.done():  # the first time may be before the statement starts
            work.stops.stop()
            wait([asked], 0.01)
        with pytest.raises(ClientLeft):
            asked.result()
        with pytest.raises(ClientLeft):
            ask()
    assert database.current_revision() == head_revision()
    assert database.ask(lambda connection: connection.execute(sa.text("SELECT 1")).scalar_one()) == 1
