"""Pages, counts, filters and tiles of features ask the spatial index first."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import sqlalchemy as sa

from app.registry.conditions import Compared
from app.registry.database import Database
from app.registry.features import FeatureFilter, count_features, list_features
from app.registry.spatial import Box
from app.registry.tiles import Tile, marker_tile
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
    "tile": lambda c, own: marker_tile(c, own, Tile(12, 2127, 2041), retired=False, layer="markers"),
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
