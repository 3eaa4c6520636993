"""Features as vector tiles of the tile matrix set WebMercatorQuad."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np
import numpy.typing as npt
import orjson
import sqlalchemy as sa

from app.registry.features import FeatureTable, in_box
from app.registry.mvt import EXTENT, write_layer
from app.registry.spatial import Box

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
    values: dict[str, Any] = {**table.values(connection, agency_id), "most": MAX_FEATURES}
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


def _selected(table: FeatureTable, wide: bool, *columns: sa.ColumnElement[Any]) -> sa.Select[Any]:
    most = sa.bindparam("most", type_=sa.Integer)
    rows = sa.select(*columns, table.table.c.id, *(table.columns[name].label(name) for name in table.tiled))
    rows = rows.select_from(table.source).where(*table.conditions, in_box(0, wide, table.table))
    return rows.order_by(table.table.c.row).limit(most)


@lru_cache
def _columns(table: FeatureTable, wide: bool) -> sa.Select[Any]:
    """One row of JSON arrays, their numbers with 15 digits: a row for each marker would take longer than the search."""
    q = _selected(table, wide, table.table.c.lon_deg, table.table.c.lat_deg).subquery()
    return sa.select(*map(sa.func.json_group_array, q.c))


@lru_cache
def _tile(table: FeatureTable, wide: bool) -> sa.Select[Any]:
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
