"""The markers nearest to a place, by geodesic distance, from the spatial index of either database.

Both look for a radius that holds enough markers, and then take the nearest of all inside it. PostGIS has an order of
nearness on its GiST index; it is one of degrees, so the distance of its last row bounds the radius, no more. SQLite's
R*Tree has none: a circle grows until it holds enough.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import sqlalchemy as sa

from app.registry.markers import PUBLIC, MarkerFilter, Row, conditions_of
from app.registry.spatial import FloatArray, box_around, distances_m, within_box
from app.registry.tables import markers

_FIRST_M = 100.0
_FAR_M = 5_000.0
_WORLD_M = 20_038_000.0  # no two places are farther apart
_FEW = 2_000
_MANY = 4_000
_HALVINGS = 16
_CHUNK = 500
_C = markers.c


def list_nearest(
    connection: sa.Connection,
    agency_id: str,
    narrowed: MarkerFilter,
    lon_deg: float,
    lat_deg: float,
    count: int,
    within_m: float | None = None,
) -> list[tuple[Row, float]]:
    """The agency's nearest markers that a filter leaves, with their distances in metres, nearest first.

    Parameters
    ----------
    narrowed : MarkerFilter
        Its `near` is left out.
    within_m : float, optional
        No farther than this. [m]
    """
    search = _Search(connection, agency_id, replace(narrowed, near=None), lon_deg, lat_deg)
    most_m = _WORLD_M if within_m is None else within_m
    found = (
        search.by_order(count, most_m) if connection.dialect.name == "postgresql" else search.by_radius(count, most_m)
    )
    rows, distances = found
    chosen = sorted(zip(distances.tolist(), rows.tolist(), strict=True))[:count]
    by_row = search.rows_of([row for _, row in chosen])
    return [(by_row[row], distance) for distance, row in chosen]


class _Search:
    def __init__(
        self, connection: sa.Connection, agency_id: str, narrowed: MarkerFilter, lon_deg: float, lat_deg: float
    ) -> None:
        self._connection, self._lon, self._lat = connection, lon_deg, lat_deg
        self._agency_id = agency_id
        self._places = sa.select(_C.row, _C.lon_deg, _C.lat_deg).where(
            _C.agency_id == agency_id, *conditions_of(narrowed)
        )

    def by_order(self, count: int, most_m: float) -> tuple[FloatArray, FloatArray]:
        """Rows and distances inside a radius that the order of the index bounds."""
        geom = sa.table("markers", sa.column("geom")).c.geom
        place = sa.func.ST_SetSRID(sa.func.ST_MakePoint(self._lon, self._lat), sa.literal_column("4326"))
        rows, distances = self._measured(self._places.order_by(geom.op("<->")(place)).limit(count))
        if len(rows) < count:  # that is all of them
            return rows[distances <= most_m], distances[distances <= most_m]
        return self._inside(min(float(distances.max()), most_m))

    def by_radius(self, count: int, most_m: float) -> tuple[FloatArray, FloatArray]:
        """Rows and distances inside a radius that grew until it held enough."""
        radius_m, below_m, halvings, counted = min(_FIRST_M, most_m), 0.0, 0, False
        while True:
            limit = _MANY + 4 * count if halvings < _HALVINGS and radius_m > _FIRST_M else None
            rows, distances = self._inside(radius_m, limit)
            if limit is not None and len(rows) == limit:  # more than are worth reading: between the two radii
                radius_m, halvings = math.sqrt(max(below_m, 1.0) * radius_m), halvings + 1
                continue
            if len(rows) >= count or radius_m >= most_m:
                return rows, distances
            below_m = radius_m
            if radius_m > _FAR_M and not counted:
                counted = True
                rows, distances = self._measured(self._places.limit(_FEW + 1))
                if len(rows) <= _FEW:
                    return rows[distances <= most_m], distances[distances <= most_m]
            radius_m = min(radius_m * (4.0 if halvings == 0 else 1.4), most_m)

    def rows_of(self, rows: list[int]) -> dict[int, Row]:
        """Markers by their integer keys."""
        found = {}
        for start in range(0, len(rows), _CHUNK):
            query = sa.select(_C.row, *PUBLIC).where(_C.row.in_(rows[start : start + _CHUNK]))
            found.update({row["row"]: row for row in self._connection.execute(query).mappings()})
        return found

    def _inside(self, radius_m: float, limit: int | None = None) -> tuple[FloatArray, FloatArray]:
        query = self._places.where(within_box(box_around(self._lon, self._lat, radius_m)))
        rows, distances = self._measured(query.limit(limit) if limit is not None else query)
        if limit is not None and len(rows) == limit:
            return rows, distances
        near = distances <= radius_m
        return rows[near], distances[near]

    def _measured(self, query: sa.Select[tuple[int, float, float]]) -> tuple[FloatArray, FloatArray]:
        found = self._connection.execute(query).all()
        places = np.array([tuple(row) for row in found], dtype=np.float64).reshape(-1, 3)
        return places[:, 0].astype(np.int64), distances_m(self._lon, self._lat, places[:, 1], places[:, 2])
