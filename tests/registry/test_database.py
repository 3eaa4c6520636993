"""Transactions, ownership and migrations on real SQLite files."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext

from app.errors import Unavailable
from app.registry import agencies
from app.registry.database import Database, head_revision
from app.registry.tables import metadata
from app.services.access import Access, Caller, Scope
from app.services.markers import GivenPosition, Markers, NewPlate

NOW = datetime(2026, 3, 4, 5, 6, 7, tzinfo=UTC)


def _url(folder: Path) -> str:
    return f"sqlite:///{folder / 'db' / 'waymark.sqlite3'}"


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Database]:
    database = Database(_url(tmp_path))
    database.open()
    yield database
    database.close()


@pytest.fixture
def migrated(database: Database) -> Database:
    database.migrate()
    return database


def _register(database: Database, lon_deg: float) -> dict[str, object]:
    caller = Caller(_agency(database), "key", "tester", Scope.WRITE)
    plate = NewPlate(GivenPosition(lon_deg=lon_deg, lat_deg=1.0))
    return Markers(database, lambda: NOW).register_plate(caller, plate)[0]


def _agency(database: Database) -> str:
    with database.write() as connection:
        return agencies.find_first_agency(connection) or agencies.add_agency(connection, "one", NOW)


def _tables(database: Database) -> set[str]:
    with database.read() as connection:
        return set(sa.inspect(connection).get_table_names())


def test_constructing_a_database_touches_nothing(tmp_path: Path) -> None:
    Database(_url(tmp_path))
    assert list(tmp_path.iterdir()) == []


def test_the_connection_is_durable_and_strict(migrated: Database) -> None:
    with migrated.read() as connection:
        journal = connection.exec_driver_sql("PRAGMA journal_mode").scalar()
        numbers = [connection.exec_driver_sql(f"PRAGMA {name}").scalar() for name in ("synchronous", "foreign_keys")]
    assert journal == "wal"
    assert numbers == [2, 1]
    with pytest.raises(sa.exc.IntegrityError), migrated.write() as connection:
        agencies.add_key(connection, "x" * 40, agency_id="nobody", scope="read", label="x", now=NOW)


def test_migrations_make_what_the_code_declares(migrated: Database) -> None:
    with migrated.read() as connection:
        context = MigrationContext.configure(
            connection,
            opts={"include_name": lambda name, kind, _: kind != "table" or "_rtree" not in name},
        )
        assert compare_metadata(context, metadata) == []


def test_migrations_run_up_down_and_up_on_data(migrated: Database) -> None:
    _register(migrated, 7.5)
    assert migrated.is_ready()
    migrated.migrate("base")
    assert not migrated.is_ready()
    assert _tables(migrated) <= {"alembic_version", "sqlite_sequence"}
    migrated.migrate()
    assert migrated.is_ready()
    assert set(metadata.tables) <= _tables(migrated)
    _register(migrated, 7.5)


def test_a_migration_that_fails_leaves_nothing_behind(database: Database) -> None:
    with database.write() as connection:
        connection.exec_driver_sql("CREATE TABLE observations (x INTEGER)")
    with pytest.raises(sa.exc.OperationalError, match="already exists"):
        database.migrate()
    assert _tables(database) == {"observations"}


def test_migrating_twice_changes_nothing(migrated: Database) -> None:
    before = _register(migrated, 7.5)
    migrated.migrate()
    with migrated.read() as connection:
        assert MigrationContext.configure(connection).get_current_revision() == head_revision()
        assert connection.exec_driver_sql("SELECT id FROM markers").scalar() == before["id"]


def test_every_owned_table_names_its_agency() -> None:
    assert [name for name, table in metadata.tables.items() if "agency_id" not in table.c] == ["agencies"]


def test_a_failed_write_is_undone(migrated: Database) -> None:
    def fail() -> None:
        with migrated.write() as connection:
            agencies.add_agency(connection, "never", NOW)
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    with migrated.read() as connection:
        assert agencies.find_agency(connection, "never") is None


def test_concurrent_writers_never_lose_an_update(migrated: Database) -> None:
    with migrated.write() as connection:
        connection.exec_driver_sql("CREATE TABLE counter (n INTEGER)")
        connection.exec_driver_sql("INSERT INTO counter VALUES (0)")

    def count() -> None:
        for _ in range(25):
            with migrated.write() as connection:
                n = connection.exec_driver_sql("SELECT n FROM counter").scalar_one()
                connection.exec_driver_sql("UPDATE counter SET n = ?", (n + 1,))

    threads = [threading.Thread(target=count) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    with migrated.read() as connection:
        assert connection.exec_driver_sql("SELECT n FROM counter").scalar() == 100


def test_a_write_takes_the_lock_at_its_start(migrated: Database) -> None:
    rival = sa.create_engine(migrated.url, connect_args={"timeout": 0})
    with migrated.write(), rival.connect() as connection, pytest.raises(sa.exc.OperationalError, match="locked"):
        connection.exec_driver_sql("INSERT INTO agencies VALUES ('a', 'b', '2026-01-01')")
    rival.dispose()


def test_a_second_process_is_told_who_owns_the_file(database: Database, tmp_path: Path) -> None:
    program = (
        "import sys; from app.registry.database import Database; from app.errors import Unavailable\n"
        "try: Database(sys.argv[1]).open()\nexcept Unavailable as error: print(error.message, '|', error.cure)"
    )
    second = subprocess.run(
        [sys.executable, "-c", program, _url(tmp_path)],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parents[2],
    )
    assert "in use by another Waymark process (pid " in second.stdout
    assert "WAYMARK_DATA_DIR" in second.stdout
    database.close()
    reopened = Database(_url(tmp_path))
    reopened.open()
    reopened.close()


def test_only_sqlite_files_are_accepted() -> None:
    for url in ("sqlite://", "sqlite:///:memory:", "postgresql+psycopg://localhost/x"):
        with pytest.raises(Unavailable):
            Database(url)


def test_the_spatial_index_follows_the_table(migrated: Database) -> None:
    marker = _register(migrated, 7.5)

    def boxes() -> list[tuple[float, ...]]:
        with migrated.read() as connection:
            rows = connection.exec_driver_sql("SELECT min_lon, max_lon, min_lat, max_lat FROM markers_rtree").all()
        return [tuple(row) for row in rows]

    assert boxes() == [(7.5, 7.5, 1.0, 1.0)]
    with migrated.write() as connection:
        connection.exec_driver_sql("UPDATE markers SET lon_deg = -3.25")
    assert boxes() == [(-3.25, -3.25, 1.0, 1.0)]
    with migrated.write() as connection:
        connection.exec_driver_sql("DELETE FROM marker_versions")
        connection.exec_driver_sql("DELETE FROM markers WHERE id = ?", (marker["id"],))
    assert boxes() == []


def test_keys_are_stored_as_hashes_only(migrated: Database) -> None:
    key = Access(migrated, lambda: NOW).create_key("agency", Scope.READ, "a key")
    with migrated.read() as connection:
        row = agencies.find_key(connection, key)
    assert row is not None
    assert key not in [str(value) for value in row.values()]
    migrated.engine.dispose()
    assert all(key.encode() not in file.read_bytes() for file in migrated.path.parent.iterdir())
