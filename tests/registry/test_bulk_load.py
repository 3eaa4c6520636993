"""Rows by the hundred thousand are stored as single ones are, and leave the indexes as they were."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import numpy as np
import orjson
import pytest
import sqlalchemy as sa

from app.registry import agencies, bulk_load
from app.registry.bulk_load import Columns, JsonTexts, large_load, load_columns, load_rows
from app.registry.column_types import new_id
from app.registry.database import Database
from app.registry.marker_rows import marker_versions, markers
from app.registry.markers import MarkerFilter, list_markers
from app.registry.spatial import box_around, fill_rtree

NOW = datetime(2026, 3, 4, 5, 6, 7, 890123, tzinfo=UTC)
TEXTS = ("plain", "tab\tand\nline", 'quote " and \\N', "Straße 日本", "")


@pytest.fixture
def agency(database: Database) -> str:
    with database.write() as connection:
        return agencies.add_agency(connection, "one", NOW)


@pytest.fixture
def few_are_many(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bulk_load, "LARGE", 10)


def _rows(agency: str, count: int, lon_deg: float = 8.0) -> list[dict[str, Any]]:
    empty = {**{column.name: None for column in markers.c if column.name != "row"}, "feature": "{}"}
    return [
        {
            **empty, "id": new_id(NOW), "agency_id": agency, "family": "cerpm", "status": "planned", "digits": str(k),
            "scheme": "cerpm", "digits_match_position": (None, True, False)[k % 3], "lon_deg": lon_deg + k * 1e-4,
            "lat_deg": 49.123456789012345, "height_m": None if k % 2 else 1e-9, "crs": "EPSG:4326",
            "original": {"point": TEXTS[k % 5], "row": k}, "spec": None if k % 4 else {"side": "left"},
            "localization_grade": "cm", "road": TEXTS[k % 5], "version": 1, "created_at": NOW, "updated_at": NOW,
        }
        for k in range(count)
    ]  # fmt: skip


def _stored(connection: sa.Connection, agency: str) -> list[dict[str, Any]]:
    query = sa.select(markers).where(markers.c.agency_id == agency).order_by(sa.cast(markers.c.digits, sa.Integer))
    return [{name: v for name, v in row.items() if name != "row"} for row in connection.execute(query).mappings()]


def test_rows_are_stored_as_sqlalchemy_stores_them(database: Database, agency: str) -> None:
    rows = _rows(agency, 20)
    with database.write() as connection:
        connection.execute(sa.insert(markers), rows)
    with database.read() as connection:
        wanted = _stored(connection, agency)
    prepared = [{**row, "original": orjson.Fragment(orjson.dumps(row["original"]))} for row in rows]
    with database.write() as connection:
        connection.execute(sa.delete(markers))
        load_rows(connection, markers, prepared)
        load_rows(connection, markers, [])
    with database.read() as connection:
        assert _stored(connection, agency) == wanted == rows
        nulls = sa.select(sa.func.count()).where(markers.c.spec.is_(sa.null()))
        assert connection.execute(nulls).scalar_one() == 15


@pytest.mark.parametrize("count", [1, 3, 1700])
def test_columns_are_stored_as_rows_are(database: Database, agency: str, count: int) -> None:
    rows = _rows(agency, count)
    lists: dict[str, Any] = {name: [row[name] for row in rows] for name in rows[0]}
    lists["original"] = JsonTexts([orjson.dumps(value).decode() for value in lists["original"]])
    with database.write() as connection:
        load_columns(connection, markers, Columns.of(count, {}, lists))
        load_columns(connection, markers, Columns(0, {}, {}))
    with database.read() as connection:
        assert _stored(connection, agency) == rows


@pytest.mark.slow
def test_rows_that_are_all_the_same(database: Database) -> None:
    table = sa.Table("alike", sa.MetaData(), sa.Column("a", sa.Integer, server_default="5"), sa.Column("b", sa.Text))
    with database.write() as connection:
        table.create(connection)
        load_columns(connection, table, Columns(3, {"a": None, "b": "x"}, {}))
        load_columns(connection, table, Columns(2, {"b": None}, {"a": [1, 2]}))
        stored = connection.execute(sa.select(table)).all()
        table.drop(connection)
    assert sorted(stored, key=str) == [(1, None), (2, None), (None, "x"), (None, "x"), (None, "x")]


def _schema(database: Database) -> list[tuple[Any, ...]]:
    query = "SELECT type, name, sql FROM sqlite_master ORDER BY name"
    if database.path is None:
        query = """SELECT indexrelid::regclass::text, pg_get_indexdef(indexrelid) FROM pg_index
                   WHERE indrelid IN (to_regclass('markers'), to_regclass('marker_versions'))
                   UNION SELECT conname, pg_get_constraintdef(oid) FROM pg_constraint
                   WHERE conrelid IN (to_regclass('markers'), to_regclass('marker_versions')) ORDER BY 1, 2"""
    with database.read() as connection:
        return [tuple(row) for row in connection.exec_driver_sql(query).all()]


@pytest.mark.usefixtures("few_are_many")
def test_a_large_load_leaves_every_index_and_finds_what_it_stored(database: Database, agency: str) -> None:
    schema = _schema(database)
    for part, lon_deg in enumerate((8.0, 20.0)):
        rows = _rows(agency, 40, lon_deg)
        for row in rows:
            row["digits"] = str(int(row["digits"]) + 100 * part)
        with database.write(long=True) as connection, large_load(connection, [markers, marker_versions], len(rows)):
            load_rows(connection, markers, rows)
    assert _schema(database) == schema
    with database.read() as connection:
        if database.path is not None:
            assert connection.exec_driver_sql("SELECT rtreecheck('markers_rtree')").scalar_one() == "ok"
        for lon_deg in (8.0, 20.0):
            near = MarkerFilter(box=box_around(lon_deg, 49.123456789, 50.0))
            found = list_markers(connection, agency, near, after=None, limit=100)
            assert sorted(int(row.digits) % 100 for row in found) == list(range(7))


@pytest.mark.usefixtures("few_are_many")
def test_a_large_load_that_fails_leaves_nothing(database: Database, agency: str) -> None:
    schema = _schema(database)
    rows = _rows(agency, 40)
    rows[7]["digits"] = rows[3]["digits"]  # a number names one CERPM
    with (
        pytest.raises(sa.exc.IntegrityError),
        database.write(long=True) as connection,
        large_load(connection, [markers, marker_versions], len(rows)),
    ):
        load_rows(connection, markers, rows)
    assert _schema(database) == schema
    with database.read() as connection:
        assert _stored(connection, agency) == []


@pytest.mark.slow
@pytest.mark.parametrize("count", [0, 1, 51, 52, 2_700, 140_000])
def test_a_packed_rtree_is_sound_and_proposes_every_row(count: int) -> None:
    rng = np.random.default_rng(count)
    places = np.column_stack([rng.uniform(-180, 180, count), rng.uniform(-90, 90, count)])
    places[::7] = places[:1]  # many at one place
    engine = sa.create_engine("sqlite://")
    with engine.begin() as connection:
        connection.exec_driver_sql("CREATE TABLE markers (row INTEGER PRIMARY KEY, lon_deg, lat_deg)")
        connection.exec_driver_sql(
            "CREATE VIRTUAL TABLE markers_rtree USING rtree(row, min_lon, max_lon, min_lat, max_lat)"
        )
        if count:
            connection.exec_driver_sql(
                "INSERT INTO markers (lon_deg, lat_deg) VALUES (?, ?)", list(map(tuple, places.tolist()))
            )
        fill_rtree(connection, "markers")
        assert connection.exec_driver_sql("SELECT rtreecheck('markers_rtree')").scalar_one() == "ok"
        query = "SELECT row FROM markers_rtree WHERE max_lon >= ? AND min_lon <= ? AND max_lat >= ? AND min_lat <= ?"
        for west, south in rng.uniform((-180, -90), (170, 80), (20, 2)).tolist():
            found = set(connection.exec_driver_sql(query, (west, west + 10, south, south + 10)).scalars())
            inside = (places >= (west, south)).all(axis=1) & (places <= (west + 10, south + 10)).all(axis=1)
            assert found >= set((np.flatnonzero(inside) + 1).tolist())
        connection.exec_driver_sql("INSERT INTO markers_rtree VALUES (999999, 1, 1, 1, 1)")
        connection.exec_driver_sql("DELETE FROM markers_rtree WHERE row = 1")
        assert connection.exec_driver_sql("SELECT rtreecheck('markers_rtree')").scalar_one() == "ok"
    engine.dispose()
