"""Markers as vector tiles of the tile matrix set WebMercatorQuad."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np
import numpy.typing as npt
import orjson
import sqlalchemy as sa

from app.registry.features import FIELDS_BY_NAME, in_box, owned
from app.registry.mvt import EXTENT, write_layer
from app.registry.spatial import Box
from app.registry.tables import markers

MAX_ZOOM = 24
MAX_FEATURES = 10_000
_BUFFER_PX = 64
_SOUTHERNMOST_DEG = 85.05112877980659
TILE_FIELDS = ("family", "status", "code", "heading_deg", "road")


@dataclass(frozen=True, slots=True)
class Tile:
    """A tile: its zoom level, and its column and row from the north-west."""

    zoom: int
    column: int
    row: int

    def box(self) -> Box:
        """The area of the tile with a margin, in which symbols at its edge are drawn whole."""
        size, margin = 2**self.zoom, _BUFFER_PX / EXTENT
        west, east = (self.column - margin) / size * 360 - 180, (self.column + 1 + margin) / size * 360 - 180
        north, south = (_lat_deg((self.row + step) / size) for step in (-margin, 1 + margin))
        return Box(max(west, -180.0), south, min(east, 180.0), north)

    def from_lon_lat(self, lon_lat_deg: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
        """Positions on the tile, shape (N, 2). [px]"""
        lat = np.clip(lon_lat_deg[:, 1], -_SOUTHERNMOST_DEG, _SOUTHERNMOST_DEG)
        right = (lon_lat_deg[:, 0] + 180.0) / 360.0
        down = 0.5 - np.arcsinh(np.tan(np.radians(lat))) / (2 * np.pi)
        world = np.column_stack((right, down)) * 2**self.zoom - (self.column, self.row)
        return np.asarray(np.rint(world * EXTENT), dtype=np.int64)


def _lat_deg(down: float) -> float:
    return math.degrees(math.atan(math.sinh(math.pi * (1 - 2 * min(max(down, 0.0), 1.0)))))


def marker_tile(connection: sa.Connection, agency_id: str, tile: Tile, *, retired: bool, layer: str) -> bytes:
    """The agency's markers on a tile, at most `MAX_FEATURES`; empty if there are none.

    Both databases write the same, but for the last digits of headings.
    """
    box = tile.box()
    values: dict[str, Any] = {"agency": agency_id, "most": MAX_FEATURES}
    values |= {"w0": box.west_deg, "s0": box.south_deg, "e0": box.east_deg, "n0": box.north_deg}
    if connection.dialect.name == "postgresql":
        place = {"size": 2.0**tile.zoom, "column": float(tile.column), "row": float(tile.row), "layer": layer}
        return bytes(connection.execute(_tile(retired, tile.zoom < 3), values | place).scalar_one() or b"")
    row = connection.execute(_columns(retired, tile.zoom < 3), values).one()
    lon_deg, lat_deg, *columns = (orjson.loads(column) for column in row)
    if not lon_deg:
        return b""
    places = tile.from_lon_lat(np.column_stack((lon_deg, lat_deg)))
    return write_layer(layer, dict(zip(("id", *TILE_FIELDS), columns, strict=True)), places)


_COLUMNS = (markers.c.id, *(FIELDS_BY_NAME[name].column.label(name) for name in TILE_FIELDS))


def _selected(retired: bool, wide: bool, *columns: sa.ColumnElement[Any]) -> sa.Select[Any]:
    most = sa.bindparam("most", type_=sa.Integer)
    return sa.select(*columns).where(*owned(retired), in_box(0, wide)).order_by(markers.c.row).limit(most)


@lru_cache(maxsize=4)
def _columns(retired: bool, wide: bool) -> sa.Select[Any]:
    """One row of JSON arrays, their numbers with 15 digits: a row for each marker would take longer than the search."""
    q = _selected(retired, wide, markers.c.lon_deg, markers.c.lat_deg, *_COLUMNS).subquery()
    return sa.select(*map(sa.func.json_group_array, q.c))


@lru_cache(maxsize=4)
def _tile(retired: bool, wide: bool) -> sa.Select[Any]:
    """A tile by PostGIS, with the projection of `Tile.from_lon_lat`: ST_Transform takes longer than the whole query."""
    number = partial(sa.bindparam, type_=sa.Double)
    lat_deg = sa.func.least(sa.func.greatest(markers.c.lat_deg, -_SOUTHERNMOST_DEG), _SOUTHERNMOST_DEG)
    right = (markers.c.lon_deg + 180.0) / 360.0
    down = 0.5 - sa.func.asinh(sa.func.tan(sa.func.radians(lat_deg))) / (2 * math.pi)
    place = sa.func.ST_MakePoint(
        sa.func.round((right * number("size") - number("column")) * float(EXTENT)),
        sa.func.round((down * number("size") - number("row")) * float(EXTENT)),
    )
    q = _selected(retired, wide, place.label("place"), *_COLUMNS).subquery("q")
    layer = sa.bindparam("layer", type_=sa.String)
    return sa.select(sa.func.ST_AsMVT(sa.literal_column("q"), layer, EXTENT, "place")).select_from(q)
