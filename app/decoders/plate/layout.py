"""Where the shapes of a plate lie, in plate sides: (0, 0) is the triangle's corner, (1, 1) the opposite one."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from app.markers.plate import PlateGeometry

Array = npt.NDArray[np.float64]


@lru_cache
def unit_edges(geometry: PlateGeometry) -> Array:
    """Low and high edge of every unit along a side, in plate sides, shape (n, 2)."""
    low = (geometry.gap_mm + np.arange(geometry.n) * geometry.pitch_mm) / geometry.side_mm
    return np.stack([low, low + geometry.unit_mm / geometry.side_mm], axis=1)


@lru_cache
def marker_centroids(geometry: PlateGeometry) -> Array:
    """Centroids of the triangle and the three squares, clockwise, in plate sides, shape (4, 2)."""
    edges = unit_edges(geometry)
    low, side = edges[0, 0], edges[1, 1] - edges[0, 0]
    near, far = low + side / 2, 1 - low - side / 2
    tip = low + side / 3
    return np.array([(tip, tip), (far, near), (far, far), (near, far)])


@lru_cache
def unit_centres(geometry: PlateGeometry) -> Array:
    """Centres of the units that carry the code, in plate sides, shape (units, 2)."""
    middle = unit_edges(geometry).mean(axis=1)
    rows, columns = np.nonzero(unit_shapes(geometry.n) >= 0)
    return np.stack([middle[columns], middle[rows]], axis=1)


@lru_cache
def unit_shapes(n: int) -> npt.NDArray[np.int64]:
    """Number of every unit's shape, row by row; -1 in the corner cells, shape (n, n)."""
    corner = np.zeros((n, n), dtype=bool)
    corner[np.ix_([0, 1, n - 2, n - 1], [0, 1, n - 2, n - 1])] = True
    shapes = np.full((n, n), -1, dtype=np.int64)
    shapes[~corner] = np.arange(n * n - 16)
    return shapes
