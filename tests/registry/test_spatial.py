"""Boxes and circles, against the plain definition on every marker."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime

import numpy as np
import pytest
import sqlalchemy as sa
from pyproj import Geod

from app.registry import agencies
from app.registry.database import Database
from app.registry.ids import new_id
from app.registry.markers import MarkerFilter, list_markers
from app.registry.spatial import Box, box_around
from app.registry.tables import markers

NOW = datetime(2026, 3, 4, tzinfo=UTC)
GEOD = Geod(ellps="WGS84")
CENTRES = [
    (0.0, 0.0),
    (179.9995, 10.0),
    (-179.9995, -45.0),
    (10.0, 89.9),
    (-120.0, -89.99),
    (0.0005, 51.4778),
    (114.18, 22.3),
    (33.0, 60.0),
    (180.0, 0.0),
]


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Database, str, np.ndarray]]:
    rng = np.random.default_rng(5)
    spots = [
        (
            (lon + rng.normal(0, spread) / max(np.cos(np.radians(lat)), 1e-3) + 180) % 360 - 180,
            lat + rng.normal(0, spread),
        )
        for lon, lat in CENTRES
        for spread in (1e-4, 1e-3, 1e-2, 0.1, 1.0)
        for _ in range(12)
    ]
    spots = [(lon, float(np.clip(lat, -90, 90))) for lon, lat in spots] + CENTRES
    database = Database(f"sqlite:///{tmp_path_factory.mktemp('spatial') / 'x.sqlite3'}")
    database.open()
    database.migrate()
    with database.write() as connection:
        agency_id = agencies.add_agency(connection, "a", NOW)
        rows = [
            {
                "id": new_id(NOW),
                "agency_id": agency_id,
                "family": "plate",
                "status": "planned",
                "lon_deg": float(lon),
                "lat_deg": float(lat),
                "crs": "EPSG:4326",
                "original": {},
                "localization_grade": "exact",
                "version": 1,
                "created_at": NOW,
                "updated_at": NOW,
            }
            for lon, lat in spots
        ]
        connection.execute(sa.insert(markers), rows)
    yield database, agency_id, np.array(spots)
    database.close()


def _found(store: tuple[Database, str, np.ndarray], narrowed: MarkerFilter) -> set[tuple[float, float]]:
    database, agency_id, _ = store
    with database.read() as connection:
        rows = list_markers(connection, agency_id, narrowed, after=None, limit=10_000)
    return {(row["lon_deg"], row["lat_deg"]) for row in rows}


@pytest.mark.parametrize("centre", CENTRES)
@pytest.mark.parametrize("radius_m", [0.0, 30.0, 1_000.0, 20_000.0, 100_000.0])
def test_circles_hold_exactly_what_is_near(
    store: tuple[Database, str, np.ndarray], centre: tuple[float, float], radius_m: float
) -> None:
    spots = store[2]
    lon, lat = np.full(len(spots), centre[0]), np.full(len(spots), centre[1])
    distances = GEOD.inv(lon, lat, spots[:, 0], spots[:, 1])[2]
    expected = {tuple(spot) for spot, distance in zip(spots.tolist(), distances, strict=True) if distance <= radius_m}
    assert expected or radius_m == 0.0
    assert _found(store, MarkerFilter(near=(*centre, radius_m))) == expected


@pytest.mark.parametrize(
    "box",
    [
        Box(114.0, 22.0, 114.3, 22.5),
        Box(179.0, -60.0, -179.0, 60.0),
        Box(-180.0, -90.0, 180.0, 90.0),
        Box(114.18, 22.3, 114.18, 22.3),
        Box(-0.001, 51.0, 0.0005, 51.4778),
    ],
)
def test_boxes_hold_exactly_what_is_inside(store: tuple[Database, str, np.ndarray], box: Box) -> None:
    lon, lat = store[2].T
    if box.west_deg <= box.east_deg:
        inside = (lon >= box.west_deg) & (lon <= box.east_deg)
    else:
        inside = (lon >= box.west_deg) | (lon <= box.east_deg)
    inside &= (lat >= box.south_deg) & (lat <= box.north_deg)
    assert inside.any()
    assert _found(store, MarkerFilter(box=box)) == {tuple(spot) for spot in store[2][inside].tolist()}


@pytest.mark.parametrize("radius_m", [1.0, 250.0, 20_000.0, 100_000.0, 3_000_000.0])
@pytest.mark.parametrize("centre", CENTRES)
def test_a_box_holds_the_rim_of_its_circle(centre: tuple[float, float], radius_m: float) -> None:
    azimuths = np.arange(0.0, 360.0, 7.5)
    same = np.ones_like(azimuths)
    lon, lat, _ = GEOD.fwd(centre[0] * same, centre[1] * same, azimuths, radius_m * same)
    parts = box_around(*centre, radius_m).parts
    for x, y in zip(lon, lat, strict=True):
        assert any(part.west_deg <= x <= part.east_deg and part.south_deg <= y <= part.north_deg for part in parts), (
            x,
            y,
        )


def test_a_box_around_a_small_circle_is_small() -> None:
    box = box_around(114.0, 60.0, 1_000.0)
    assert box.north_deg - box.south_deg < 0.019
    assert box.east_deg - box.west_deg < 0.04


@pytest.mark.parametrize(
    "narrowed", [MarkerFilter(box=Box(1, 1, 2, 2)), MarkerFilter(near=(114.0, 22.0, 500.0))], ids=["box", "circle"]
)
def test_the_spatial_index_goes_first(store: tuple[Database, str, np.ndarray], narrowed: MarkerFilter) -> None:
    plan = _plan(store, narrowed)
    assert "SEARCH markers USING INTEGER PRIMARY KEY" in plan
    assert "VIRTUAL TABLE INDEX" in plan


@pytest.mark.parametrize(
    ("narrowed", "index"),
    [
        (MarkerFilter(), "ix_markers_agency_id_id (agency_id=?)"),
        (MarkerFilter(box=Box(-180, -90, 180, 90)), "ix_markers_agency_id_id (agency_id=?)"),
        (MarkerFilter(status="suspect"), "ix_markers_agency_id_status_id (agency_id=? AND status=?)"),
        (MarkerFilter(digits="0"), "ix_markers_digits (digits=?)"),
    ],
    ids=["all", "world", "status", "digits"],
)
def test_lists_use_their_index(store: tuple[Database, str, np.ndarray], narrowed: MarkerFilter, index: str) -> None:
    assert f"USING INDEX {index}" in _plan(store, narrowed)


def _plan(store: tuple[Database, str, np.ndarray], narrowed: MarkerFilter) -> str:
    database, agency_id, _ = store
    statements = []

    def explain(_c: object, _cur: object, statement: str, parameters: tuple[object, ...], *_: object) -> None:
        if not statement.startswith("EXPLAIN"):
            statements.append((statement, parameters))

    sa.event.listen(database.engine, "before_cursor_execute", explain)
    try:
        with database.read() as connection:
            list_markers(connection, agency_id, narrowed, after=None, limit=10)
            query, parameters = statements[-1]
            return " ".join(str(row) for row in connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {query}", parameters))
    finally:
        sa.event.remove(database.engine, "before_cursor_execute", explain)
