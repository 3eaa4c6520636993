"""Every list and every search uses its index, with the markers of an agency in the tables."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest
import sqlalchemy as sa

from app.registry import agencies
from app.registry.database import Database
from app.registry.markers import MarkerFilter, find_code_near, list_magnets_in, list_markers, list_near
from app.registry.nearest import find_nearest_at_once
from app.registry.spatial import Box, box_around
from app.services.markers.searches import area_of
from tests.databases import query_plan

NOW = datetime(2026, 3, 4, tzinfo=UTC)
# PostgreSQL's planner goes by what is in the tables. SQLite's goes by the figures that the migrations gave it.
MARKERS = """
INSERT INTO markers (id, agency_id, family, status, digits, road, measure_m, lon_deg, lat_deg,
    crs, original, localization_grade, version, created_at, updated_at)
SELECT 'id ' || n, CASE mod(n, 3) WHEN 0 THEN '{agency_id}' ELSE '{other_id}' END,
    CASE mod(n, 20) WHEN 0 THEN 'magnet' ELSE 'plate' END,
    CASE mod(n, 20) WHEN 1 THEN 'suspect' ELSE 'active' END, n / 2, 'A ' || n / 50, n,
    6 + mod(n, 200) / 100.0, n / 200 / 100.0,
    'EPSG:4326', '{{}}', 'exact', 1, now(), now()
FROM generate_series(1, 10000) AS n
"""
MAGNETS = """
INSERT INTO magnets (marker_id, number, agency_id, lon_deg, lat_deg, polarity, phi_deg)
SELECT id, 1, agency_id, lon_deg, lat_deg, 'N', 0 FROM markers
"""


@pytest.fixture(scope="module")
def store(
    tmp_path_factory: pytest.TempPathFactory, new_database_url: Callable[[Path], str]
) -> Iterator[tuple[Database, str]]:
    database = Database(new_database_url(tmp_path_factory.mktemp("plans")))
    database.open()
    database.migrate()
    with database.write() as connection:
        agency_id = agencies.add_agency(connection, "a", NOW)
        if database.path is None:
            other_id = agencies.add_agency(connection, "b", NOW)
            connection.exec_driver_sql(MARKERS.format(agency_id=agency_id, other_id=other_id))
            connection.exec_driver_sql(MAGNETS)
            connection.exec_driver_sql("ANALYZE markers")
            connection.exec_driver_sql("ANALYZE magnets")
    yield database, agency_id
    database.close()


@pytest.mark.parametrize(
    ("filtered", "index", "columns"),
    [
        (MarkerFilter(), "ix_markers_agency_id_id", "agency_id=?"),
        (MarkerFilter(box=Box(-180, -90, 180, 90)), "ix_markers_agency_id_id", "agency_id=?"),
        (MarkerFilter(status="suspect"), "ix_markers_agency_id_status_id", "agency_id=? AND status=?"),
        (MarkerFilter(family="magnet"), "ix_markers_agency_id_family_id", "agency_id=? AND family=?"),
        (MarkerFilter(digits="0"), "ix_markers_digits", "digits=?"),
        (MarkerFilter(road="A 1"), "ix_markers_agency_id_road_measure_m_id", "agency_id=? AND road=?"),
    ],
    ids=["all", "world", "status", "family", "digits", "road"],
)
def test_lists_use_their_index(store: tuple[Database, str], filtered: MarkerFilter, index: str, columns: str) -> None:
    database, agency_id = store
    plan = query_plan(database, lambda c: list_markers(c, agency_id, filtered, after=None, limit=10))
    if database.path is None:
        # in the order of ids an agency of many has its markers sooner from the index of all ids
        scans = (f"Scan using {index} on markers", f"Bitmap Index Scan on {index}")
        assert any(scan in plan for scan in scans) or (columns == "agency_id=?" and "uq_markers_id" in plan)
        assert "Sort" not in plan or filtered.digits or filtered.road
    else:
        assert f"USING INDEX {index} ({columns})" in plan


TRIANGLE = area_of([[[[7.0, 0.5], [7.1, 0.5], [7.0, 0.6], [7.0, 0.5]]]])
SEARCHES: dict[str, Callable[[sa.Connection, str], object]] = {
    "box": lambda c, own: list_markers(c, own, MarkerFilter(box=Box(7, 0.5, 7.1, 0.6)), after=None, limit=10),
    "circle": lambda c, own: list_markers(c, own, MarkerFilter(near=(7.0, 0.5, 500.0)), after=None, limit=10),
    "plates near": lambda c, own: list_near(c, own, ("plate",), 7.0, 0.5, 50.0),
    "over the antimeridian": lambda c, own: list_near(c, own, ("plate",), 180.0, 0.5, 50.0),
    "polygon": lambda c, own: list_markers(c, own, MarkerFilter(area=TRIANGLE), after=None, limit=10),
    "a few nearby": lambda c, own: find_nearest_at_once(c, own, MarkerFilter(), 7.0, 0.5, 10),
    "magnets": lambda c, own: list_magnets_in(c, box_around(7.0, 0.5, 2.0)),
}


@pytest.mark.parametrize("name", SEARCHES)
def test_searches_ask_the_spatial_index_first(store: tuple[Database, str], name: str) -> None:
    database, agency_id = store
    plan = query_plan(database, lambda c: SEARCHES[name](c, agency_id))
    table = "magnets" if name == "magnets" else "markers"
    if database.path is None:
        assert f"ix_{table}_geom" in plan
        assert "Seq Scan" not in plan
    else:
        assert f"SEARCH {table} USING INTEGER PRIMARY KEY" in plan
        assert f"{table}_rtree VIRTUAL TABLE INDEX" in plan


def test_a_taken_code_is_found_by_its_digits(store: tuple[Database, str]) -> None:
    database, _ = store
    plan = query_plan(database, lambda c: find_code_near(c, "77", 7.0, 0.5, 20_000.0, mismatched_radius_m=20_000.0))
    assert "ix_markers_digits" in plan
