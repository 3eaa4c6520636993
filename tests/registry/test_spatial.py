"""Boxes and circles, against the plain definition on every marker."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
import sqlalchemy as sa
from pyproj import Geod

from app.registry import agencies
from app.registry.column_types import new_id
from app.registry.database import Database
from app.registry.marker_rows import markers
from app.registry.markers import MarkerFilter, list_markers
from app.registry.spatial import Box, box_around

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

PLAIN = {
    "family": "plate",
    "status": "planned",
    "crs": "EPSG:4326",
    "original": {},
    "localization_grade": "cm",
    "version": 1,
    "created_at": NOW,
    "updated_at": NOW,
}


@pytest.fixture(scope="module")
def store(
    tmp_path_factory: pytest.TempPathFactory, new_database_url: Callable[[Path], str]
) -> Iterator[tuple[Database, str, np.ndarray]]:
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
    database = Database(new_database_url(tmp_path_factory.mktemp("spatial")))
    database.open()
    database.migrate()
    with database.write() as connection:
        agency_id = agencies.add_agency(connection, "a", NOW)
        rows = [
            {"id": new_id(NOW), "agency_id": agency_id, "lon_deg": float(lon), "lat_deg": float(lat), **PLAIN}
            for lon, lat in spots
        ]
        connection.execute(sa.insert(markers), rows)
    yield database, agency_id, np.array(spots)
    database.close()


def _found(store: tuple[Database, str, np.ndarray], filtered: MarkerFilter) -> set[tuple[float, float]]:
    database, agency_id, _ = store
    with database.read() as connection:
        rows = list_markers(connection, agency_id, filtered, after=None, limit=10_000)
    return {(row.lon_deg, row.lat_deg) for row in rows}


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


def test_both_databases_measure_the_distance_of_proj(store: tuple[Database, str, np.ndarray]) -> None:
    """Karney's geodesic, from 0.1 mm to the other side of the world."""
    database, _, _ = store
    rng = np.random.default_rng(11)
    lon, lat = rng.uniform(-180, 180, 400), np.degrees(np.arcsin(rng.uniform(-1, 1, 400)))
    to_lon, to_lat, _ = GEOD.fwd(lon, lat, rng.uniform(0, 360, 400), 10.0 ** rng.uniform(-4, 7.3, 400))
    pairs = [*np.stack([lon, lat, to_lon, to_lat], axis=1).tolist()]
    pairs += [(180, 0, -180, 0), (0, 90, 50, 90), (0, -90, 120, -89), (179.9999, 10, -179.9999, 10), (5, 5, 5, 5)]
    pairs += [(0, 0, 179.5, 0.3), (0, 0, 180, 0), (10, 45, -170, -45)]
    query = sa.select(sa.func.waymark_distance_m(*(sa.bindparam(name, type_=sa.Double) for name in "abcd")))
    with database.read() as connection:
        asked = [connection.execute(query, dict(zip("abcd", pair, strict=True))).scalar() for pair in pairs]
    expected = GEOD.inv(*np.array(pairs, dtype=float).T)[2]
    np.testing.assert_allclose(np.array(asked, dtype=float), expected, rtol=0, atol=2e-8)


def test_the_spatial_index_follows_the_table(store: tuple[Database, str, np.ndarray]) -> None:
    database, agency_id, _ = store
    from_there, to_there = Box(-70.1, -33.1, -69.9, -32.9), Box(69.9, 32.9, 70.1, 33.1)
    new = {"id": new_id(NOW), "agency_id": agency_id, "lon_deg": -70.0, "lat_deg": -33.0, **PLAIN}

    def counts() -> tuple[int, int]:
        found = [_found(store, MarkerFilter(box=box)) for box in (from_there, to_there)]
        return len(found[0]), len(found[1])

    with database.write() as connection:
        connection.execute(sa.insert(markers), new)
    assert counts() == (1, 0)
    with database.write() as connection:
        connection.execute(sa.update(markers).where(markers.c.id == new["id"]).values(lon_deg=70.0, lat_deg=33.0))
    assert counts() == (0, 1)
    with database.write() as connection:
        connection.execute(sa.delete(markers).where(markers.c.id == new["id"]))
    assert counts() == (0, 0)


@pytest.mark.parametrize(
    "box",
    [
        Box(8.0, 49.0, 8.1, 49.1), Box(179.99, -17.0, -179.99, -16.9), Box(-180.0, 10.0, -179.9, 10.1),
        Box(179.9, 69.0, 180.0, 69.1), Box(20.0, 89.99, 21.0, 89.9995), Box(-180.0, -90.0, 180.0, 90.0),
        Box(-10.0, -5.0, -10.0, -5.0),
    ],
    ids=str,
)  # fmt: skip
def test_a_widened_box_has_every_place_within_the_margin(box: Box) -> None:
    margin_m = 150.0
    wide = box.widened(margin_m)
    for lon in (box.west_deg, box.east_deg):
        for lat in (box.south_deg, box.north_deg):
            for azimuth in range(0, 360, 15):
                away_lon, away_lat, _ = GEOD.fwd(lon, lat, azimuth, margin_m)
                parts = wide.parts
                assert any(
                    p.west_deg <= away_lon <= p.east_deg and p.south_deg <= away_lat <= p.north_deg for p in parts
                )
    spread = (wide.east_deg - wide.west_deg) % 360.0 or 360.0
    if abs(box.north_deg) < 80:
        assert spread < (box.east_deg - box.west_deg) % 360.0 + 0.01
