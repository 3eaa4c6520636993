"""Pages, counts, filters and tiles of features ask the spatial index first."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import sqlalchemy as sa

from app.registry.conditions import Compared
from app.registry.database import Database
from app.registry.features import ON_ROAD, FeatureFilter, count_features, list_features
from app.registry.plan_features import PLANNED
from app.registry.spatial import Box
from app.registry.tiles import Tile, feature_tile
from tests.databases import query_plan
from tests.registry.test_plans import store  # noqa: F401  (a fixture)

BOX = Box(7.0, 0.5, 7.1, 0.6)
ACROSS = Box(179.9, 0.5, -179.9, 0.6)


def _page(c: sa.Connection, own: str, filtered: FeatureFilter, *, counted: bool = False) -> object:
    return list_features(c, own, filtered, after="id", limit=10, counted=counted)


ASKED: dict[str, Callable[[sa.Connection, str], object]] = {
    "page": lambda c, own: _page(c, own, FeatureFilter(box=BOX)),
    "page and count": lambda c, own: _page(c, own, FeatureFilter(box=BOX), counted=True),
    "count": lambda c, own: count_features(c, own, FeatureFilter(box=BOX)),
    "antimeridian": lambda c, own: _page(c, own, FeatureFilter(box=ACROSS)),
    "filter": lambda c, own: _page(c, own, FeatureFilter(box=BOX, where=Compared("road", "like", "A%"))),
    "tile": lambda c, own: feature_tile(c, own, Tile(12, 2127, 2041), ON_ROAD, layer="markers"),
}


@pytest.mark.parametrize("name", ASKED)
def test_features_are_found_by_the_spatial_index(store: tuple[Database, str], name: str) -> None:  # noqa: F811
    database, agency_id = store
    plan = query_plan(database, lambda c: ASKED[name](c, agency_id))
    scans = 2 if name in ("page and count", "antimeridian") else 1
    if database.path is None:
        assert plan.count("Index Scan on ix_markers_geom") + plan.count("using ix_markers_geom") == scans
        assert "Seq Scan" not in plan
    else:
        assert plan.count("markers_rtree VIRTUAL TABLE INDEX") == scans
        assert "SCAN markers " not in f"{plan} "


PLANNED_ROWS = """
INSERT INTO planned_markers (id, agency_id, plan_id, number, family, code, purpose, lane, chainage_m, station_m,
    offset_m, heading_deg, lon_deg, lat_deg, feature)
SELECT 'p' || mod(n, 20) || '.' || n, '{agency_id}', 'p' || mod(n, 20), n, 'plate', n, 'spacing', '1', n, n, 0, 0,
    6 + mod(n, 200) / 100.0, n / 200 / 100.0, ''
FROM generate_series(1, 10000) AS n
"""
PLAN_ROWS = """
INSERT INTO plans (id, agency_id, alignment_id, name, status, rules, document_key, summary, author, author_id, version,
    created_at, updated_at)
SELECT 'p' || n, '{agency_id}', 'a', 'p' || n, 'checked', '{{}}', '', '{{}}', '', '', 1, now(), now()
FROM generate_series(0, 19) AS n
"""
ALIGNMENT_ROW = """
INSERT INTO alignments (id, agency_id, name, source_key, source_sha256, declaration, summary, version, created_at,
    updated_at)
VALUES ('a', '{agency_id}', 'a', '', '', '{{}}', '{{}}', 1, now(), now())
"""
ASKED_OF_PLANS: dict[str, Callable[[sa.Connection, str], object]] = {
    "page": lambda c, own: _page(c, own, FeatureFilter(PLANNED, box=BOX)),
    "status": lambda c, own: _page(c, own, FeatureFilter(PLANNED, box=BOX, equal=(("status", "built"),))),
    "tile": lambda c, own: feature_tile(c, own, Tile(12, 2127, 2041), PLANNED, layer="plans"),
}


@pytest.fixture(scope="module")
def with_plans(store: tuple[Database, str]) -> tuple[Database, str]:  # noqa: F811
    database, agency_id = store
    if database.path is None:
        with database.write() as connection:
            for statement in (ALIGNMENT_ROW, PLAN_ROWS, PLANNED_ROWS):
                connection.exec_driver_sql(statement.format(agency_id=agency_id))
            connection.exec_driver_sql("ANALYZE planned_markers")
            connection.exec_driver_sql("ANALYZE plans")
    return store


@pytest.mark.parametrize("name", ASKED_OF_PLANS)
def test_planned_markers_are_found_by_their_spatial_index(with_plans: tuple[Database, str], name: str) -> None:
    database, agency_id = with_plans
    plan = query_plan(database, lambda c: ASKED_OF_PLANS[name](c, agency_id))
    if database.path is None:
        assert "ix_planned_markers_geom" in plan
        assert "Seq Scan on planned_markers" not in plan
    else:
        assert plan.count("planned_markers_rtree VIRTUAL TABLE INDEX") == 1
        assert "SCAN planned_markers " not in f"{plan} "
        assert "SCAN plans" not in plan
