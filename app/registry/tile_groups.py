"""Groups of features for maps of many: how many there are of each family and status, by cells of a grid."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
import sqlalchemy as sa

from app.registry.features import FeatureTable, in_box
from app.registry.mvt import EXTENT, write_layer
from app.registry.tiles import Tile

COARSE_ZOOM = 7
"""The last zoom level whose tiles are made of one count of all features; a tile is then 310 km wide at the equator."""
GROUPED_ZOOM = 11
"""The last zoom level at which tiles have groups; a tile is then 20 km wide at the equator."""
MAX_SINGLE = 2_000
"""Features from which on a tile has groups: a browser draws as many at once without delay."""
_OUTERMOST_DEG = 85.05112  # just inside the tiles of a zoom level
_CELLS = 32  # across a tile; by hand: 16 px of a map that shows tiles 512 px wide


@dataclass(frozen=True, slots=True, eq=False)
class FeatureGrid:
    """An agency's features of a table, counted by cell, family and status.

    Attributes
    ----------
    lon_lat_deg : ndarray of float, shape (N, 2)
        Mean position of the features of a row. [deg]
    count : ndarray of int, shape (N,)
    kind : ndarray of int, shape (N,)
        Index into `kinds`.
    kinds : tuple of str
        ``{family}_{status}``, "other" in place of a family that is not known.
    """

    lon_lat_deg: npt.NDArray[np.float64]
    count: npt.NDArray[np.int64]
    kind: npt.NDArray[np.int64]
    kinds: tuple[str, ...]

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
def _counts(table: FeatureTable, on_tile: bool) -> sa.Select[Any]:
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
