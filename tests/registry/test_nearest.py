"""The nearest markers and those inside polygons, against every marker looked at, on both databases."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
import shapely
import sqlalchemy as sa
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pyproj import Geod
from sqlalchemy import event

from app.registry import agencies, nearest
from app.registry.column_types import new_id
from app.registry.database import Database
from app.registry.marker_rows import markers
from app.registry.markers import MarkerFilter, list_markers
from app.registry.nearest import find_nearest_at_once, list_nearest
from app.services.markers.searches import area_of

NOW = datetime(2026, 3, 4, tzinfo=UTC)
GEOD = Geod(ellps="WGS84")
PLACES = [
    (8.4, 49.0),
    (179.9999, 10.0),
    (-179.9999, 10.0),
    (180.0, -45.0),
    (10.0, 89.99),
    (-120.0, -90.0),
    (77.0, 90.0),
    (0.0, 0.0),
    (-30.0, 40.0),
]
Store = tuple[Database, str, np.ndarray, list[str]]


def _spots() -> np.ndarray:
    """Clusters of every density at the places, one spot with many markers, and a few far from all."""
    rng = np.random.default_rng(7)
    spots = [(8.41, 49.01)] * 40
    for lon, lat in PLACES[:-1]:
        for spread_m in (1.0, 30.0, 1_000.0, 50_000.0):
            count = 25
            azimuth, far = rng.uniform(0, 360, count), np.abs(rng.normal(0, spread_m, count))
            to_lon, to_lat, _ = GEOD.fwd(np.full(count, lon), np.full(count, lat), azimuth, far)
            spots += list(zip(to_lon, to_lat, strict=True))
    return np.array(spots)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory, new_database_url: Callable[[Path], str]) -> Iterator[Store]:
    spots = _spots()
    database = Database(new_database_url(tmp_path_factory.mktemp("nearest")))
    database.open()
    database.migrate()
    families = ["plate" if k % 5 else "cerpm" for k in range(len(spots))]
    with database.write() as connection:
        agency_id = agencies.add_agency(connection, "a", NOW)
        other_id = agencies.add_agency(connection, "b", NOW)
        rows = [
            {
                "id": new_id(NOW),
                "agency_id": owner,
                "family": family,
                "status": "planned",
                "digits": f"{owner} {k}",
                "crs": "EPSG:4326",
                "original": {},
                "localization_grade": "cm",
                "version": 1,
                "created_at": NOW,
                "updated_at": NOW,
                "lon_deg": float(lon),
                "lat_deg": float(lat),
            }
            for owner in (agency_id, other_id)
            for k, ((lon, lat), family) in enumerate(zip(spots, families, strict=True))
        ]
        connection.execute(sa.insert(markers), rows)
    yield database, agency_id, spots, families
    database.close()


def _expected(store: Store, place: tuple[float, float], count: int, family: str | None, within_m: float) -> list[float]:
    _, _, spots, families = store
    lon, lat = np.full(len(spots), place[0]), np.full(len(spots), place[1])
    distances = GEOD.inv(lon, lat, spots[:, 0], spots[:, 1])[2]
    kept = [d for d, f in zip(distances.tolist(), families, strict=True) if family in (None, f) and d <= within_m]
    return sorted(kept)[:count]


def _check(store: Store, place: tuple[float, float], count: int, family: str | None, within_m: float | None) -> None:
    database, agency_id, _, _ = store
    asked = (agency_id, MarkerFilter(family=family), *place, count, within_m)
    with database.read() as connection:
        found = list_nearest(connection, *asked)
        at_once = find_nearest_at_once(connection, *asked)
    if at_once is not None:
        assert [(row.id, distance) for row, distance in at_once] == [(row.id, d) for row, d in found]
    distances = [distance for _, distance in found]
    expected = _expected(store, place, count, family, np.inf if within_m is None else within_m)
    assert distances == pytest.approx(expected, abs=1e-6)
    assert len({row.id for row, _ in found}) == len(found)
    assert all(row.digits.startswith(agency_id) for row, _ in found)
    for row, distance in found:
        assert GEOD.inv(*place, row.lon_deg, row.lat_deg)[2] == pytest.approx(distance, abs=1e-6)


lon_deg = st.floats(-180, 180) | st.sampled_from([lon for lon, _ in PLACES])
lat_deg = st.floats(-90, 90) | st.sampled_from([lat for _, lat in PLACES])


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    place=st.tuples(lon_deg, lat_deg) | st.sampled_from(PLACES),
    count=st.sampled_from([1, 2, 10, 50, 1000]),
    family=st.sampled_from([None, "cerpm", "magnet"]),
    within_m=st.none() | st.floats(0, 3e6),
)
def test_the_nearest_are_those_that_every_distance_says(
    store: Store, place: tuple[float, float], count: int, family: str | None, within_m: float | None
) -> None:
    _check(store, place, count, family, within_m)


def test_a_few_near_by_are_found_by_one_statement(store: Store) -> None:
    database, agency_id, _, _ = store
    for place in ((8.4, 49.0), (0.0, 0.0)):
        with database.read() as connection:
            assert find_nearest_at_once(connection, agency_id, MarkerFilter(), *place, 10) is not None


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("count", [1, 10, 30, 200])
def test_the_nearest_where_the_index_is_hard_to_ask(store: Store, place: tuple[float, float], count: int) -> None:
    _check(store, place, count, None, None)


@pytest.mark.parametrize("count", [5, 60])
def test_a_crowd_is_not_read_as_a_whole(store: Store, count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The circle shrinks again where it took in more than it may, also where they all lie at one spot."""
    monkeypatch.setattr(nearest, "_MANY", 10)
    monkeypatch.setattr(nearest, "_FEW", 3)
    monkeypatch.setattr(nearest, "_FIRST_M", 0.5)
    for place in PLACES:
        _check(store, place, count, None, None)


POLYGONS = [
    [[[8.0, 48.5], [9.0, 48.5], [8.5, 49.5], [8.0, 48.5]]],
    [
        [[8.0, 48.5], [9.0, 48.5], [9.0, 49.5], [8.0, 49.5], [8.0, 48.5]],
        [[8.39, 48.99], [8.4, 49.02], [8.41, 48.99], [8.39, 48.99]],
    ],
    [[[-180, -90], [-100, -90], [-100, -89.9], [-180, -89.5], [-180, -90]]],
]


@pytest.mark.parametrize("rings", POLYGONS)
def test_polygons_hold_what_is_inside_or_on_the_edge(store: Store, rings: list[list[list[float]]]) -> None:
    database, agency_id, spots, _ = store
    area = area_of([rings, [[[179.9, 9], [180, 9], [180, 11], [179.9, 9]]]])
    with database.read() as connection:
        rows = list_markers(connection, agency_id, MarkerFilter(area=area), after=None, limit=10_000)
    inside = shapely.intersects_xy(shapely.from_wkb(area.wkb), spots[:, 0], spots[:, 1])
    assert inside.sum() > 20
    assert sorted((row.lon_deg, row.lat_deg) for row in rows) == sorted(map(tuple, spots[inside].tolist()))


def test_vertices_are_not_passed_for_each_marker(store: Store) -> None:
    """SQLite calls a function for each marker: 160 kB of vertices as its argument would be copied each time."""
    database, agency_id, _, _ = store
    if database.path is None:
        return
    angles = np.linspace(0.0, 2 * np.pi, 9_999)
    ring = np.column_stack((8.4 + np.cos(angles), 49.0 + np.sin(angles)))
    ring[-1] = ring[0]
    sent: list[object] = []
    remember = event.listens_for(database.engine, "before_cursor_execute")
    remember(lambda _connection, _cursor, _statement, values, *_: sent.extend(values))
    with database.read() as connection:
        areas = [area_of([[ring.tolist()]]) for _ in range(2)]
        del areas[0]  # an equal area that is no longer in use takes nothing from the other one
        rows = list_markers(connection, agency_id, MarkerFilter(area=areas[0]), after=None, limit=10_000)
    assert rows
    assert max(len(value) for value in sent if isinstance(value, bytes | str)) < 100
