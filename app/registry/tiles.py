"""Features as Mapbox vector tiles of WebMercatorQuad: groups of crowded points, and the tile's bytes."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from types import NoneType

import numpy as np
import numpy.typing as npt
import orjson
import sqlalchemy as sa

from app.registry.column_types import AnyColumn, AnySelect
from app.registry.features import FeatureTable, in_box
from app.registry.spatial import Box
from app.values import Ints

# === Mapbox Vector Tiles 2.1 of points, for databases that cannot write them. Section numbers are those of the
#
# specification.


EXTENT = 4096
_POINT = 1
_MOVE_TO_ONCE = 9  # 4.3.1: command 1, count 1
# keys of fields in a message, 4.1 and the .proto: number << 3 | kind
_FEATURE, _TAGS, _TYPE, _GEOMETRY = 0x12, 0x12, 0x18, 0x22
_DOUBLE = struct.Struct("<d").pack
Value = str | int | float | bool


def write_layer(name: str, columns: Mapping[str, Sequence[Value | None]], points_px: Ints) -> bytes:
    """A tile with one layer of points.

    Parameters
    ----------
    name : str
        Name of the layer.
    columns : mapping of sequences, each of length N
        Values of each property, by its name; None is left out.
    points_px : ndarray of int64, shape (N, 2)
        Right of and down from the tile's north-west corner; the tile is `EXTENT` wide. [px]

    Returns
    -------
    bytes
        Empty without points (4.1: a layer has at least one feature).
    """
    if not len(points_px):
        return b""
    distinct = [_distinct(column) for column in columns.values()]
    parts = [b"\x0a", _text(name), _features(_tags(columns.values(), distinct), points_px)]
    for key in columns:
        parts += (b"\x1a", _text(key))
    for values in distinct:
        parts += map(_value, values)
    parts.append(b"\x28" + _varint(EXTENT) + b"\x78\x02")  # extent, version 2
    return b"\x1a" + _sized(b"".join(parts))


def _distinct(column: Sequence[Value | None]) -> list[Value]:
    """The distinct values of a column: True differs from 1, and 1 from 1.0."""
    if len({type(value) for value in column} - {NoneType}) > 1:
        raise ValueError("the values of a property are of one type")
    return [value for value in dict.fromkeys(column) if value is not None]


def _tags(columns: Iterable[Sequence[Value | None]], distinct: Sequence[Sequence[Value]]) -> Ints:
    """Key and value of each property of each feature, shape (N, 2 x properties); -1 twice for a missing value."""
    tags, first = [], 0
    for k, (column, values) in enumerate(zip(columns, distinct, strict=True)):
        index: dict[Value | None, int] = dict(zip(values, range(first, first + len(values)), strict=True))
        index[None] = -1
        chosen = np.fromiter(map(index.__getitem__, column), np.int64, len(column))
        tags += [np.where(chosen < 0, -1, k), chosen]
        first += len(values)
    return np.column_stack(tags)


def _features(tags: Ints, points_px: Ints) -> bytes:
    """All features; a point's feature consists of varints only."""
    count = len(points_px)
    zigzag = (points_px << 1) ^ (points_px >> 63)  # 4.3.2
    tag_bytes = _lengths(tags).sum(axis=1)
    geometry_bytes = 1 + _lengths(zigzag).sum(axis=1)
    body_bytes = 1 + _lengths(tag_bytes) + tag_bytes + 3 + _lengths(geometry_bytes) + geometry_bytes
    numbers = np.column_stack(
        (
            *(np.full(count, _FEATURE), body_bytes, np.full(count, _TAGS), tag_bytes, tags),
            *(np.full((count, 3), (_TYPE, _POINT, _GEOMETRY)), geometry_bytes),
            *(np.full(count, _MOVE_TO_ONCE), zigzag),
        )
    )
    return _varints(numbers[numbers >= 0])


def _lengths(numbers: Ints) -> Ints:
    """Length of each value as a varint; 0 for a negative value, which is left out. [byte]"""
    lengths = (numbers >= 0).astype(np.int64)
    for bits in range(7, 64, 7):
        more = numbers >= np.int64(1) << np.int64(bits)
        if not more.any():
            break
        lengths += more
    return lengths


def _varints(numbers: Ints) -> bytes:
    lengths = _lengths(numbers)
    ends = lengths.cumsum()
    out = np.empty(int(ends[-1]), np.uint8)
    for k in range(int(lengths.max())):
        has = lengths > k
        part = numbers[has] >> (7 * k) & 0x7F
        out[(ends - lengths)[has] + k] = part | np.where(lengths[has] > k + 1, 0x80, 0)
    return out.tobytes()


def _value(value: Value) -> bytes:
    """A value of the layer, with its key and size."""
    if isinstance(value, str):
        text = value.encode()
        size = len(text)
        if size < 126:  # both sizes are varints of one byte
            return b"\x22%c\x0a%c%b" % (size + 2, size, text)
        return b"\x22" + _sized(b"\x0a" + _sized(text))
    if isinstance(value, float):
        return b"\x22\x09\x19" + _DOUBLE(value)
    if isinstance(value, bool):
        return b"\x22\x02\x38" + bytes((value,))
    return b"\x22" + _sized(b"\x30" + _varint((value << 1) ^ (value >> 63)))


def _text(text: str) -> bytes:
    return _sized(text.encode())


def _sized(content: bytes) -> bytes:
    return _varint(len(content)) + content


def _varint(value: int) -> bytes:
    if value < 0x80:
        return bytes((value,))
    made = bytearray()
    while value >= 0x80:
        made.append(value & 0x7F | 0x80)
        value >>= 7
    made.append(value)
    return bytes(made)


# === Features as vector tiles of the tile matrix set WebMercatorQuad.


MAX_ZOOM = 24
MAX_FEATURES = 10_000
_BUFFER_PX = 64
_SOUTHERNMOST_DEG = 85.05112877980659


@dataclass(frozen=True, slots=True)
class Tile:
    """A tile: its zoom level, and its column and row from the north-west."""

    zoom: int
    column: int
    row: int

    def box(self, margin_px: int = _BUFFER_PX) -> Box:
        """The area of the tile with a margin, in which symbols at its edge are drawn whole."""
        size, margin = 2**self.zoom, margin_px / EXTENT
        west, east = (self.column - margin) / size * 360 - 180, (self.column + 1 + margin) / size * 360 - 180
        north, south = (_lat_deg((self.row + step) / size) for step in (-margin, 1 + margin))
        return Box(max(west, -180.0), south, min(east, 180.0), north)

    def from_lon_lat(self, lon_lat_deg: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
        """Positions on the tile, shape (N, 2), to the nearest pixel. [px]"""
        return np.asarray(np.rint(self.project(lon_lat_deg)), dtype=np.int64)

    def project(self, lon_lat_deg: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Positions on the tile, shape (N, 2). [px]"""
        lat = np.clip(lon_lat_deg[:, 1], -_SOUTHERNMOST_DEG, _SOUTHERNMOST_DEG)
        right = (lon_lat_deg[:, 0] + 180.0) / 360.0
        down = 0.5 - np.arcsinh(np.tan(np.radians(lat))) / (2 * np.pi)
        world = np.column_stack((right, down)) * 2**self.zoom - (self.column, self.row)
        return np.asarray(world * EXTENT)


def _lat_deg(down: float) -> float:
    return math.degrees(math.atan(math.sinh(math.pi * (1 - 2 * min(max(down, 0.0), 1.0)))))


def feature_tile(
    connection: sa.Connection,
    agency_id: str,
    tile: Tile,
    table: FeatureTable,
    *,
    layer: str,
    margin_px: int = _BUFFER_PX,
) -> bytes:
    """The agency's features on a tile and its margin, at most `MAX_FEATURES`; empty if there are none.

    Both databases write the same, but for the last digits of headings.
    """
    box = tile.box(margin_px)
    values: dict[str, object] = {**table.values(connection, agency_id), "most": MAX_FEATURES}
    values |= {"w0": box.west_deg, "s0": box.south_deg, "e0": box.east_deg, "n0": box.north_deg}
    if connection.dialect.name == "postgresql":
        place = {"size": 2.0**tile.zoom, "column": float(tile.column), "row": float(tile.row), "layer": layer}
        return bytes(connection.execute(_tile(table, tile.zoom < 3), values | place).scalar_one() or b"")
    row = connection.execute(_columns(table, tile.zoom < 3), values).one()
    lon_deg, lat_deg, *columns = (orjson.loads(column) for column in row)
    if not lon_deg:
        return b""
    places = tile.from_lon_lat(np.column_stack((lon_deg, lat_deg)))
    return write_layer(layer, dict(zip(("id", *table.tiled), columns, strict=True)), places)


def _selected(table: FeatureTable, wide: bool, *columns: AnyColumn) -> AnySelect:
    most = sa.bindparam("most", type_=sa.Integer)
    rows = sa.select(*columns, table.table.c.id, *(table.columns[name].label(name) for name in table.tiled))
    rows = rows.select_from(table.source).where(*table.conditions, in_box(0, wide, table.table))
    return rows.order_by(table.table.c.row).limit(most)


@lru_cache
def _columns(table: FeatureTable, wide: bool) -> AnySelect:
    """One row of JSON arrays, their numbers with 15 digits: a row for each marker would take longer than the search."""
    q = _selected(table, wide, table.table.c.lon_deg, table.table.c.lat_deg).subquery()
    return sa.select(*map(sa.func.json_group_array, q.c))


@lru_cache
def _tile(table: FeatureTable, wide: bool) -> AnySelect:
    """A tile by PostGIS, with the projection of `Tile.from_lon_lat`: ST_Transform takes longer than the whole query."""
    number = partial(sa.bindparam, type_=sa.Double)
    c = table.table.c
    lat_deg = sa.func.least(sa.func.greatest(c.lat_deg, -_SOUTHERNMOST_DEG), _SOUTHERNMOST_DEG)
    right = (c.lon_deg + 180.0) / 360.0
    down = 0.5 - sa.func.asinh(sa.func.tan(sa.func.radians(lat_deg))) / (2 * math.pi)
    place = sa.func.ST_MakePoint(
        sa.func.round((right * number("size") - number("column")) * float(EXTENT)),
        sa.func.round((down * number("size") - number("row")) * float(EXTENT)),
    )
    q = _selected(table, wide, place.label("place")).subquery("q")
    layer = sa.bindparam("layer", type_=sa.String)
    return sa.select(sa.func.ST_AsMVT(sa.literal_column("q"), layer, EXTENT, "place")).select_from(q)


# === Groups of features for maps of many: how many there are of each family and status, by cells of a grid.


COARSE_ZOOM = 7
"""The last zoom level whose tiles are made of one count of all features; a tile is then 310 km wide at the equator."""
GROUPED_ZOOM = 11
"""The last zoom level at which tiles have groups; a tile is then 20 km wide at the equator."""
MAX_SINGLE = 2_000
"""Features from which on a tile has groups: a browser draws as many at once without delay."""
_OUTERMOST_DEG = 85.05112  # just inside the tiles of a zoom level
_CELLS = 32  # across a tile: 16 px of a map that shows tiles 512 px wide


@dataclass(frozen=True, slots=True, eq=False)
class FeatureGrid:
    """An agency's features of a table, counted by cell, family and status."""

    lon_lat_deg: npt.NDArray[np.float64]  # shape (N, 2): [deg] mean position of the features of a row
    count: npt.NDArray[np.int64]  # shape (N,)
    kind: npt.NDArray[np.int64]  # shape (N,): index into `kinds`
    kinds: tuple[str, ...]  # ``{family}_{status}``, "other" in place of a family that is not known

    def count_on(self, tile: Tile) -> int:
        """Features on a tile, those of a cell all at their mean position."""
        return int(self.count[_inside(tile.project(self.lon_lat_deg))].sum())

    def write(self, tile: Tile, layer: str) -> bytes:
        """A tile with one layer of groups, each on the tile of its mean position, so that none is on two of them."""
        world = tile.project(self.lon_lat_deg)
        inside = _inside(world)
        count = self.count[inside]
        places = world[inside]
        cells, cell = np.unique(np.floor(places / (EXTENT // _CELLS)) @ (_CELLS, 1), return_inverse=True)
        numbers = np.zeros((len(cells), len(self.kinds)), np.int64)
        np.add.at(numbers, (cell, self.kind[inside]), count)
        total = numbers.sum(axis=1)
        means = np.column_stack([np.bincount(cell, places[:, axis] * count) / total for axis in (0, 1)])
        columns: dict[str, list[int | None]] = {"count": total.tolist()}
        for name, column in zip(self.kinds, numbers.T.tolist(), strict=True):
            columns[name] = [value or None for value in column]
        return write_layer(layer, columns, np.floor(means).astype(np.int64))


def _inside(places_px: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    return np.flatnonzero(((places_px >= 0) & (places_px < EXTENT)).all(axis=1))


def read_grid(
    connection: sa.Connection, agency_id: str, table: FeatureTable, *, zoom: int, on: Tile | None = None
) -> FeatureGrid:
    """Count the agency's features, all or those on a tile, in one pass over them.

    Parameters
    ----------
    zoom : int
        Zoom level whose tiles are 32 cells wide.
    """
    values = {**table.values(connection, agency_id), "step": 360.0 / 2**zoom / _CELLS}
    if on is not None:
        box = on.box(margin_px=0)
        values |= {"w0": box.west_deg, "s0": box.south_deg, "e0": box.east_deg, "n0": box.north_deg}
    rows = connection.execute(_counts(table, on is not None), values).all()
    if not rows:
        return FeatureGrid(np.empty((0, 2)), np.empty(0, np.int64), np.empty(0, np.int64), ())
    _, _, families, statuses, count, lon_deg, lat_deg = zip(*rows, strict=True)
    names = [f"{family or 'other'}_{status}" for family, status in zip(families, statuses, strict=True)]
    kinds = tuple(sorted(set(names)))
    index = {name: k for k, name in enumerate(kinds)}
    east, north = np.array(lon_deg), np.array(lat_deg)
    east[east == 180.0] = -180.0  # tiles begin at the antimeridian
    return FeatureGrid(
        np.column_stack((east, np.clip(north, -_OUTERMOST_DEG, _OUTERMOST_DEG))),
        np.array(count),
        np.array([index[name] for name in names]),
        kinds,
    )


@lru_cache
def _counts(table: FeatureTable, on_tile: bool) -> AnySelect:
    """Number and mean position of the features of each cell, family and status.

    Whether a database cuts a number or rounds it to a whole one moves all cells alike.
    """
    c, step = table.table.c, sa.bindparam("step", type_=sa.Double)
    x = sa.cast((c.lon_deg + 180.0) / step, sa.Integer).label("x")
    y = sa.cast((c.lat_deg + 90.0) / step, sa.Integer).label("y")
    kind = (table.columns["family"], table.columns["status"])
    means = (sa.func.count(), sa.func.avg(c.lon_deg), sa.func.avg(c.lat_deg))
    rows = sa.select(x, y, *kind, *means).select_from(table.source).where(*table.conditions)
    if on_tile:
        rows = rows.where(in_box(0, False, table.table))
    return rows.group_by(sa.literal_column("x"), sa.literal_column("y"), *kind)
