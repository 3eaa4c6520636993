"""What only a SQLite file has: its owner, its durability, its lock, its R*Tree."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

import pytest
import sqlalchemy as sa

from app.errors import CommitUnknown, StorageFull, Unavailable
from app.families.documents import PositionIn
from app.families.plate.plates import PlateIn
from app.registry import agencies
from app.registry.database import Database
from app.services.access.access import Access, Caller, Scope
from app.services.blobs import staged
from app.services.markers.markers import Markers
from app.storage.blobs import Blobs

NOW = datetime(2026, 3, 4, 5, 6, 7, tzinfo=UTC)


@pytest.fixture(scope="module")
def backend() -> str:
    return "sqlite"


def test_constructing_a_database_touches_nothing(tmp_path: Path) -> None:
    Database(f"sqlite:///{tmp_path / 'db' / 'waymark.sqlite3'}")
    assert list(tmp_path.iterdir()) == []


def test_the_connection_is_durable(database: Database) -> None:
    with database.read() as connection:
        journal = connection.exec_driver_sql("PRAGMA journal_mode").scalar()
        numbers = [connection.exec_driver_sql(f"PRAGMA {name}").scalar() for name in ("synchronous", "foreign_keys")]
    assert journal == "wal"
    assert numbers == [2, 1]


def test_a_new_file_has_large_pages(database: Database) -> None:
    with database.read() as connection:
        assert connection.exec_driver_sql("PRAGMA page_size").scalar() == 16_384


def test_a_full_disk_is_no_defect_and_stores_nothing(database: Database) -> None:
    with database.write() as connection:
        connection.exec_driver_sql("CREATE TABLE filler (content BLOB)")
        pages = connection.exec_driver_sql("PRAGMA page_count").scalar_one()
        connection.exec_driver_sql(f"PRAGMA max_page_count = {pages + 1}")  # SQLite's own limit fails as a disk does
    with pytest.raises(StorageFull, match="no room in the database"), database.write() as connection:
        connection.exec_driver_sql("INSERT INTO filler VALUES (zeroblob(1000000))")
    with database.write() as connection:
        assert connection.exec_driver_sql("SELECT count(*) FROM filler").scalar() == 0


class Failing(sqlite3.Connection):
    """A connection whose commits end as on a disk whose fsync fails."""

    code = sqlite3.SQLITE_IOERR | 4 << 8
    """SQLITE_IOERR_FSYNC"""

    def commit(self) -> None:
        error = sqlite3.OperationalError("disk I/O error")
        error.sqlite_errorcode = self.code
        raise error


def test_a_commit_whose_fsync_fails_is_unknown_and_its_blobs_stay(tmp_path: Path) -> None:
    engine_url = f"sqlite:///{tmp_path / 'db'}"
    database, blobs = Database(engine_url), Blobs((tmp_path / "blobs").as_uri())
    database.engine = sa.create_engine(engine_url, connect_args={"factory": Failing})
    blobs.open()
    keys: list[str] = []

    def store() -> None:
        with staged(blobs) as stage:
            keys.append(stage.put("uploads", b"x"))
            with database.write() as connection:
                connection.exec_driver_sql("CREATE TABLE t (a)")

    with pytest.raises(CommitUnknown):
        store()
    assert blobs.get(keys[0]) == b"x"
    with (
        closing(Failing(":memory:")) as failing,
        pytest.raises(Unavailable, match="disk of the database"),
        database.write(),
    ):
        failing.commit()
    database.close()


def test_a_write_takes_the_lock_at_its_start(database: Database) -> None:
    rival = sa.create_engine(database.url, connect_args={"timeout": 0})
    with database.write(), rival.connect() as connection, pytest.raises(sa.exc.OperationalError, match="locked"):
        connection.exec_driver_sql("INSERT INTO agencies VALUES ('a', 'b', '2026-01-01')")
    rival.dispose()


@pytest.mark.slow
def test_a_second_process_is_told_who_owns_the_file(database: Database) -> None:
    program = (
        "import sys; from app.registry.database import Database; from app.errors import Unavailable\n"
        "try: Database(sys.argv[1]).open()\nexcept Unavailable as error: print(error.message, '|', error.cure)"
    )
    second = subprocess.run(
        [sys.executable, "-c", program, str(database.url)],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parents[2],
    )
    assert "in use by another Waymark process (pid " in second.stdout
    assert "WAYMARK_DATA_DIR" in second.stdout
    database.close()
    reopened = Database(str(database.url))
    reopened.open()
    reopened.close()


def test_the_spatial_index_follows_the_table(database: Database) -> None:
    with database.write() as connection:
        caller = Caller(agencies.add_agency(connection, "one", NOW), "key", "tester", Scope.PLANNER)
    plate = PlateIn(position=PositionIn(lon_deg=7.5, lat_deg=1.0))
    marker = Markers(database, lambda: NOW).register(caller, plate)[0]

    def boxes() -> list[tuple[float, ...]]:
        with database.read() as connection:
            rows = connection.exec_driver_sql("SELECT min_lon, max_lon, min_lat, max_lat FROM markers_rtree").all()
        return [tuple(row) for row in rows]

    assert boxes() == [(7.5, 7.5, 1.0, 1.0)]
    with database.write() as connection:
        connection.exec_driver_sql("UPDATE markers SET lon_deg = -3.25")
    assert boxes() == [(-3.25, -3.25, 1.0, 1.0)]
    with database.write() as connection:
        connection.exec_driver_sql("DELETE FROM marker_versions")
        connection.exec_driver_sql("DELETE FROM markers WHERE id = ?", (marker["id"],))
    assert boxes() == []


def test_no_key_is_in_the_files(database: Database) -> None:
    key = Access(database, lambda: NOW).create_key("agency", Scope.VIEWER, "a key")
    assert database.path is not None
    database.engine.dispose()
    assert all(key.encode() not in file.read_bytes() for file in database.path.parent.iterdir())
