"""Tiles: what the two databases write is the same, read by a reader of protocol buffers written for this test."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from functools import partial
from typing import Any

import numpy as np
import pytest
import sqlalchemy as sa

from app.registry import agencies, audit
from app.registry.audit import Author
from app.registry.database import Database
from app.registry.features import ON_ROAD, RETIRED, TILE_FIELDS
from app.registry.marker_rows import markers
from app.registry.tiles import EXTENT, MAX_FEATURES, MAX_SINGLE, FeatureGrid, Tile, feature_tile, read_grid, write_layer
from app.services.access.access import Caller, Scope
from app.services.markers.features import MARKERS, Features
from tests.databases import PostgresServer

NOW = datetime(2026, 3, 4, tzinfo=UTC)


@pytest.fixture(scope="module", params=["sqlite"])
def backend(request: pytest.FixtureRequest) -> str:
    """The tests open both databases themselves."""
    return str(request.param)


def _fields(message: bytes) -> Iterator[tuple[int, Any]]:
    """Numbers and contents of the fields of a message."""
    at = 0

    def varint() -> int:
        nonlocal at
        value = shift = 0
        while True:
            byte = message[at]
            at += 1
            value |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                return value

    while at < len(message):
        number, kind = divmod(varint(), 8)
        if kind == 0:
            yield number, varint()
        else:
            size = {1: 8, 5: 4}.get(kind) or varint()
            yield number, message[at : at + size]
            at += size


def _varints(content: bytes) -> list[int]:
    return [value for _, value in _fields(b"".join(b"\x08" + part for part in _split(content)))]


def _split(content: bytes) -> Iterator[bytes]:
    start = 0
    for k, byte in enumerate(content):
        if byte < 0x80:
            yield content[start : k + 1]
            start = k + 1


def _value(message: bytes) -> Any:
    ((number, content),) = _fields(message)
    if number == 1:
        return content.decode()
    if number == 3:
        return struct.unpack("<d", content)[0]
    if number == 6:  # zigzag
        return content >> 1 ^ -(content & 1)
    return {4: int, 5: int, 7: bool}[number](content)


def read_tile(tile: bytes) -> tuple[str, list[tuple[dict[str, Any], tuple[int, int]]]]:
    """Name of the layer, and properties and place of each point."""
    ((_, layer),) = _fields(tile)
    parts: dict[int, list[Any]] = {}
    for number, content in _fields(layer):
        parts.setdefault(number, []).append(content)
    keys, values = [key.decode() for key in parts.get(3, [])], [_value(value) for value in parts.get(4, [])]
    assert (parts[5], parts[15]) == ([EXTENT], [2])
    points = []
    for feature in parts[2]:
        content = dict(_fields(feature))
        tags = _varints(content[2])
        (command, *zigzag) = _varints(content[4])
        assert (content[3], command) == (1, 9)
        right, down = (n >> 1 ^ -(n & 1) for n in zigzag)
        pairs = zip(tags[::2], tags[1::2], strict=True)
        points.append(({keys[k]: values[v] for k, v in pairs}, (right, down)))
    return parts[1][0].decode(), points


def test_the_encoder_writes_every_kind_of_value() -> None:
    columns: dict[str, list[Any]] = {
        "text": ["", "Å" * 300, None],
        "number": [1.0, -2.5, 1.0],
        "whole": [-1, 2**40, 1],
        "flag": [True, None, False],
        "nothing": [None, None, None],
    }
    points = np.array([[-64, 0], [4160, 8191], [2**31, -(2**31)]])
    name, found = read_tile(write_layer("Märkte", columns, points))
    assert name == "Märkte"
    assert [place for _, place in found] == [tuple(point) for point in points.tolist()]
    for k, (properties, _) in enumerate(found):
        expected = {key: values[k] for key, values in columns.items() if values[k] is not None}
        assert properties == expected
        assert {key: type(value) for key, value in properties.items()} == {k: type(v) for k, v in expected.items()}
    assert write_layer("none", {"text": []}, np.empty((0, 2), np.int64)) == b""
    with pytest.raises(ValueError, match="of one type"):
        write_layer("mixed", {"number": [1, True]}, np.zeros((2, 2), np.int64))


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory, postgres: PostgresServer) -> Iterator[tuple[Database, Database]]:
    """Both databases with the same markers of the same agency."""
    rng = np.random.default_rng(3)
    lon = np.concatenate((rng.uniform(-180, 180, 400), rng.uniform(8.0, 8.1, 400), [180, -180, 0, 0, 7.0]))
    lat = np.concatenate((rng.uniform(-90, 90, 400), rng.uniform(49.0, 49.1, 400), [0, 0, 90, -90, 85.0511287798066]))
    rows = [_row(k, *place) for k, place in enumerate(zip(lon.tolist(), lat.tolist(), strict=True))]
    path = tmp_path_factory.mktemp("tiles") / "waymark.sqlite3"
    databases = Database(f"sqlite:///{path}"), Database(postgres.empty())
    for database in databases:
        database.open()
        database.migrate()
        with database.write() as connection:
            agency_id = agencies.add_agency(connection, "a", NOW)
            connection.execute(sa.insert(markers), [{**row, "agency_id": agency_id} for row in rows])
    yield databases
    for database in databases:
        database.close()


def _row(k: int, lon_deg: float, lat_deg: float) -> dict[str, Any]:
    return {
        "id": f"{k:08d}",
        "family": ("plate", "cerpm")[k % 2],
        "status": "retired" if k % 50 == 0 else "active",
        "digits": f"{k}" if k % 3 else None,
        "heading_deg": k / 7 if k % 5 else None,
        "road": f"Å{k % 4}" if k % 4 else None,
        "lon_deg": lon_deg,
        "lat_deg": lat_deg,
        "crs": "EPSG:4326",
        "original": {},
        "localization_grade": "cm",
        "version": 1,
        "created_at": NOW,
        "updated_at": NOW,
    }


def _tile(database: Database, tile: Tile, *, retired: bool = False) -> bytes:
    def ask(connection: sa.Connection) -> bytes:
        agency_id = connection.execute(sa.select(sa.column("id")).select_from(sa.table("agencies"))).scalar_one()
        return feature_tile(connection, agency_id, tile, RETIRED if retired else ON_ROAD, layer="markers")

    with database.read() as connection:
        return ask(connection)


@pytest.mark.parametrize(
    "tile",
    [Tile(0, 0, 0), Tile(1, 0, 0), Tile(2, 3, 1), Tile(3, 4, 2), Tile(7, 66, 43), Tile(12, 2139, 1403), Tile(24, 0, 0)],
    ids=str,
)
@pytest.mark.parametrize("retired", [False, True])
def test_both_databases_write_the_same_tile(both: tuple[Database, Database], tile: Tile, retired: bool) -> None:
    ours, postgis = (_tile(database, tile, retired=retired) for database in both)
    assert bool(ours) == bool(postgis)
    if ours:
        assert _rounded(ours) == _rounded(postgis)
        assert set(read_tile(ours)[1][0][0]) <= {"id", *TILE_FIELDS}


def _rounded(tile: bytes) -> tuple[str, list[Any]]:
    """A tile with headings to a millionth of a millionth of a degree."""
    name, points = read_tile(tile)
    for properties, _ in points:
        if "heading_deg" in properties:
            properties["heading_deg"] = round(properties["heading_deg"], 12)
    return name, points


def test_a_full_tile_holds_the_markers_that_were_registered_first(
    both: tuple[Database, Database], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert MAX_FEATURES == 10_000
    monkeypatch.setattr("app.registry.tiles.MAX_FEATURES", 20)
    whole = [properties["id"] for properties, _ in read_tile(_tile(both[0], Tile(0, 0, 0)))[1]]
    monkeypatch.setattr("app.registry.tiles.MAX_FEATURES", 20)
    for database in both:
        _, found = read_tile(_tile(database, Tile(0, 0, 0)))
        assert [properties["id"] for properties, _ in found] == sorted(whole)[:20]


def _grid(database: Database, zoom: int, on: Tile | None = None) -> FeatureGrid:
    with database.read() as connection:
        agency_id = connection.execute(sa.select(sa.column("id")).select_from(sa.table("agencies"))).scalar_one()
        return read_grid(connection, agency_id, ON_ROAD, zoom=zoom, on=on)


def test_groups_hold_every_marker_of_its_kind_once(both: tuple[Database, Database]) -> None:
    with both[0].read() as connection:
        rows = connection.execute(sa.select(markers.c.family).where(markers.c.status != "retired")).scalars().all()
    for database in both:
        grid = _grid(database, 3)
        assert grid.kinds == ("cerpm_active", "plate_active")
        for zoom in (0, 1, 3):
            tiles = [Tile(zoom, column, row) for column in range(2**zoom) for row in range(2**zoom)]
            groups = [group for tile in tiles if grid.count_on(tile) for group in _groups(grid, tile)]
            assert sum(properties["count"] for properties, _ in groups) == len(rows)
            for family in ("plate", "cerpm"):
                assert sum(properties.get(f"{family}_active", 0) for properties, _ in groups) == rows.count(family)
            assert all(properties["count"] >= 1 and 0 not in properties.values() for properties, _ in groups)
            assert all(0 <= right < EXTENT and 0 <= down < EXTENT for _, (right, down) in groups)


def _groups(grid: FeatureGrid, tile: Tile) -> list[tuple[dict[str, Any], tuple[int, int]]]:
    name, groups = read_tile(grid.write(tile, "markers_groups"))
    assert name == "markers_groups"
    return groups


def test_a_group_is_at_the_mean_of_its_markers(both: tuple[Database, Database]) -> None:
    town = Tile(9, 267, 175)  # the 400 markers close together, with some that are far away
    for database in both:
        singles = [place for _, place in read_tile(_tile(database, town))[1]]
        groups = _groups(_grid(database, town.zoom, town), town)
        assert 1 < len(groups) < len(singles) / 5
        total = sum(properties["count"] for properties, _ in groups)
        mean = sum(np.array(place) * properties["count"] for properties, place in groups) / total
        inside = [place for place in singles if min(place) >= 0 and max(place) < EXTENT]
        assert total == len(inside)
        assert mean == pytest.approx(np.mean(inside, axis=0), abs=1)


def test_only_tiles_with_too_many_markers_have_groups(
    both: tuple[Database, Database], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert MAX_SINGLE == 2_000
    monkeypatch.setattr("app.services.markers.features.MAX_SINGLE", 100)
    now = [NOW]
    for database in both:
        with database.read() as connection:
            agency_id = connection.execute(sa.select(sa.column("id")).select_from(sa.table("agencies"))).scalar_one()
        caller, features = Caller(agency_id, "key", "test", Scope.VIEWER), Features(database, lambda: now[0])
        for zoom, layer in ((0, "markers_groups"), (8, "markers_groups"), (12, "markers")):
            lon, lat = 8.05, 49.05
            down = 0.5 - np.arcsinh(np.tan(np.radians(lat))) / (2 * np.pi)
            tile = Tile(zoom, int((lon + 180) / 360 * 2**zoom), int(down * 2**zoom))
            name, points = read_tile(features.grouped_tile(caller, MARKERS, tile))
            assert name == layer
            assert all(0 <= right <= EXTENT and 0 <= down_px <= EXTENT for _, (right, down_px) in points)
        assert features.grouped_tile(caller, MARKERS, Tile(8, 0, 200)) == b""


def test_tiles_are_counted_once_until_something_changes(both: tuple[Database, Database]) -> None:
    counted: list[str] = []
    now = [NOW]

    def note(_connection: object, _cursor: object, statement: str, *_: object) -> None:
        counted.append(statement)

    tiles = [Tile(2, column, row) for column in range(4) for row in range(4)]
    for database in both:
        counted.clear()
        with database.read() as connection:
            agency_id = connection.execute(sa.select(sa.column("id")).select_from(sa.table("agencies"))).scalar_one()
        sa.event.listen(sa.Engine, "before_cursor_execute", note)
        ask = partial(
            Features(database, lambda: now[0]).grouped_tile, Caller(agency_id, "key", "test", Scope.VIEWER), MARKERS
        )
        for passes, later in ((1, timedelta(seconds=61)), (1, timedelta(hours=1)), (2, timedelta(seconds=61))):
            with ThreadPoolExecutor(4) as threads:
                list(threads.map(ask, tiles))
            assert sum("GROUP BY" in statement for statement in counted) == passes
            now[0] += later
        with database.write() as connection:
            audit.record(connection, agency_id, Author("test"), "marker.registered", now=now[0])
        ask(tiles[0])
        assert sum("GROUP BY" in statement for statement in counted) == 3
        sa.event.remove(sa.Engine, "before_cursor_execute", note)
