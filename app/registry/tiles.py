"""Markers as vector tiles of the tile matrix set WebMercatorQuad."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
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
        """What the tile shows, with a margin so that symbols at its edge are whole."""
        size, margin = 2**self.zoom, _BUFFER_PX / EXTENT
        west, east = (self.column - margin) / size * 360 - 180, (self.column + 1 + margin) / size * 360 - 180
        north, south = (_lat_deg((self.row + step) / size) for step in (-margin, 1 + margin))
        return Box(max(west, -180.0), south, min(east, 180.0), north)

    def from_lon_lat(self, lon_lat_deg: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
        """Places on the tile, shape (N, 2). [px]"""
        lat = np.clip(lon_lat_deg[:, 1], -_SOUTHERNMOST_DEG, _SOUTHERNMOST_DEG)
        right = (lon_lat_deg[:, 0] + 180.0) / 360.0
        down = 0.5 - np.arcsinh(np.tan(np.radians(lat))) / (2 * np.pi)
        world = np.column_stack((right, down)) * 2**self.zoom - (self.column, self.row)
        return np.asarray(np.rint(world * EXTENT), dtype=np.int64)


def _lat_deg(down: float) -> float:
    return math.degrees(math.atan(math.sinh(math.pi * (1 - 2 * min(max(down, 0.0), 1.0)))))


def marker_tile(connection: sa.Connection, agency_id: str, tile: Tile, *, retired: bool, layer: str) -> bytes:
    """The agency's markers on a tile, at most `MAX_FEATURES`; empty without any."""
    box = tile.box()
    values = {"w0": box.west_deg, "s0": box.south_deg, "e0": box.east_deg, "n0": box.north_deg, "most": MAX_FEATURES}
    rows = connection.execute(_statement(retired, tile.zoom < 3), {"agency": agency_id, **values}).all()
    places = np.array([row[:2] for row in rows], dtype=np.float64).reshape(-1, 2)
    return write_layer(layer, ("id", *TILE_FIELDS), tile.from_lon_lat(places), (row[2:] for row in rows))


@lru_cache(maxsize=4)
def _statement(retired: bool, wide: bool) -> sa.Select[Any]:
    columns = (
        markers.c.lon_deg,
        markers.c.lat_deg,
        markers.c.id,
        *(FIELDS_BY_NAME[name].column for name in TILE_FIELDS),
    )
    most = sa.bindparam("most", type_=sa.Integer)
    return sa.select(*columns).where(*owned(retired), in_box(0, wide)).order_by(markers.c.id).limit(most)
