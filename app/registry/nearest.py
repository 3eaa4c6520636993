"""The markers nearest to a position, by geodesic distance, from the spatial index of either database.

Both look for a radius that holds enough markers, and then take the nearest of all inside it. PostGIS has an order of
nearness on its GiST index, though one of degrees: what comes first in it is enough where it holds a whole box round the
farthest that is taken. SQLite's R*Tree has no order: a circle grows until it holds enough. A few nearby, which is what
vehicles and crews ask for, are mostly found by one statement; `list_nearest` finds any number anywhere.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from functools import lru_cache

import numpy as np
import sqlalchemy as sa

from app.markers.reading import MarkerRow
from app.registry.column_types import AnySelect, row_maker
from app.registry.features import in_box
from app.registry.marker_rows import PUBLIC, markers
from app.registry.markers import MarkerFilter, conditions_of
from app.registry.spatial import Box, box_around, distances_m, within_box
from app.values import Floats, Ints, JsonObject

# === Places of markers in many circles.


def list_places(
    connection: sa.Connection,
    agency_id: str,
    filtered: MarkerFilter,
    circles: Iterable[tuple[float, float, float]],
    *,
    limit: int,
) -> list[tuple[str, float, float]]:
    """Id, longitude and latitude of the markers in the boxes of circles (lon_deg, lat_deg, radius_m), each once.

    No more than about `limit` are read.
    """
    places = sa.select(markers.c.id, markers.c.lon_deg, markers.c.lat_deg).where(
        markers.c.agency_id == agency_id, *conditions_of(filtered)
    )
    found: dict[str, tuple[str, float, float]] = {}
    for circle in circles:
        query = places.where(within_box(box_around(*circle))).limit(limit)
        found.update({row[0]: (row[0], row[1], row[2]) for row in connection.execute(query)})
        if len(found) >= limit:
            break
    return list(found.values())


# === The markers nearest to a position, by geodesic distance, from the spatial index of either database.


Found = list[tuple[MarkerRow, float]]

AT_ONCE = 30
_FIRST_M = 250.0
_FAR_M = 5_000.0
_WORLD_M = 20_038_000.0  # [m] a little more than half a meridian or equator: no two positions are farther apart
_WIDE_DEG2 = 2_500.0  # [deg^2] for larger boxes reading all rows is faster than the index
_FEW = 2_000
_MANY = 4_000
_ALL = 2**31 - 1
_SHRINKS = 0.9
"""Share of its radius to which a circle has to shrink; else all in it are read."""
_CHUNK = 500
_C = markers.c
_PLACES = (_C.row, _C.lon_deg, _C.lat_deg)
_PLACE = [1 + MarkerRow._fields.index(name) for name in ("lon_deg", "lat_deg")]  # behind the integer key
_make = row_maker(MarkerRow)


def find_nearest_at_once(
    connection: sa.Connection,
    agency_id: str,
    filtered: MarkerFilter,
    lon_deg: float,
    lat_deg: float,
    count: int,
    within_m: float | None = None,
) -> Found | None:
    """As `list_nearest`, by one statement; None if one statement cannot find them."""
    max_m = _WORLD_M if within_m is None else within_m
    if count > AT_ONCE:
        return None
    limit = 10 + math.ceil(3 * count / max(math.cos(math.radians(lat_deg)), 0.1))
    filtered = replace(filtered, near=None)
    if connection.dialect.name == "postgresql":
        values: dict[str, object] = {"agency": agency_id, "most": limit, "lon": lon_deg, "lat": lat_deg}
        rows = connection.execute(_in_order(filtered, True), values).all()
    else:
        parts = box_around(lon_deg, lat_deg, min(_FIRST_M, max_m)).parts
        values = {"agency": agency_id, "most": 3 * limit, **_sides(parts)}
        rows = connection.execute(_inside(filtered, _wide(parts), True), values).all()
        if len(rows) == 3 * limit:
            return None
    lon, lat = (np.array([row[k] for row in rows], dtype=np.float64) for k in _PLACE)
    distances = distances_m(lon_deg, lat_deg, lon, lat)
    chosen = sorted((d, row[0], k) for k, (d, row) in enumerate(zip(distances.tolist(), rows, strict=True)))
    chosen = [item for item in chosen[:count] if item[0] <= max_m]
    far_m = chosen[-1][0] if len(chosen) == count else max_m
    if connection.dialect.name == "postgresql":
        enough = len(rows) < limit or _holds_box(lon_deg, lat_deg, far_m, float(lon[-1]), float(lat[-1]))
    else:
        enough = far_m <= min(_FIRST_M, max_m)
    return [(_make(rows[k][1:]), distance) for distance, _, k in chosen] if enough else None


def _holds_box(lon_deg: float, lat_deg: float, radius_m: float, last_lon_deg: float, last_lat_deg: float) -> bool:
    """Whether the whole box around a circle is nearer, in degrees, than the last row in the order of degrees."""
    (box, *more) = box_around(lon_deg, lat_deg, radius_m).parts
    half_lon, half_lat = (box.east_deg - box.west_deg) / 2, (box.north_deg - box.south_deg) / 2
    far_deg = math.hypot(last_lon_deg - lon_deg, last_lat_deg - lat_deg)
    return not more and half_lon < 90.0 and math.hypot(half_lon, half_lat) < far_deg


def list_nearest(
    connection: sa.Connection,
    agency_id: str,
    filtered: MarkerFilter,
    lon_deg: float,
    lat_deg: float,
    count: int,
    within_m: float | None = None,
) -> Found:
    """The agency's nearest markers that pass a filter, with their distances in metres, nearest first.

    Parameters
    ----------
    filtered : MarkerFilter
        Its `near` is left out.
    within_m : float, optional
        No farther than this. [m]
    """
    search = _Search(connection, agency_id, replace(filtered, near=None), lon_deg, lat_deg)
    max_m = _WORLD_M if within_m is None else within_m
    has_order = connection.dialect.name == "postgresql"
    rows, distances = search.by_order(count, max_m) if has_order else search.by_radius(count, max_m)
    chosen = sorted(zip(distances.tolist(), rows.tolist(), strict=True))[:count]
    by_row = search.rows_of([row for _, row in chosen])
    return [(by_row[row], distance) for distance, row in chosen]


class _Search:
    def __init__(
        self, connection: sa.Connection, agency_id: str, filtered: MarkerFilter, lon_deg: float, lat_deg: float
    ) -> None:
        self._connection, self._agency_id, self._narrowed = connection, agency_id, filtered
        self._lon, self._lat = lon_deg, lat_deg

    def by_order(self, count: int, max_m: float) -> tuple[Ints, Floats]:
        """Rows and distances inside a radius that the order of the index bounds."""
        values = {"lon": self._lon, "lat": self._lat, "most": count}
        rows, distances = self._measured(_in_order(self._narrowed, False), values)
        if len(rows) < count:  # these are all
            return rows[distances <= max_m], distances[distances <= max_m]
        return self._circle(min(float(distances.max()), max_m))

    def by_radius(self, count: int, max_m: float) -> tuple[Ints, Floats]:
        """Rows and distances inside a radius that grows until it holds enough, and shrinks where it holds too many."""
        radius_m, limit, counted = min(_FIRST_M, max_m), _MANY + 4 * count, False
        while True:
            rows, distances = self._circle(radius_m, limit if radius_m > _FIRST_M else _ALL)
            if len(rows) == limit and radius_m > _FIRST_M:
                # too many to read; but whichever of them were read, the nearest are no farther than these
                bound_m = float(np.partition(distances, count - 1)[count - 1])
                if bound_m > _SHRINKS * radius_m:
                    limit = _ALL
                radius_m = min(radius_m, bound_m)
                continue
            if len(rows) >= count or radius_m >= max_m:
                return rows, distances
            if radius_m > _FAR_M and not counted:
                counted = True
                rows, distances = self._measured(_anywhere(self._narrowed), {"most": _FEW + 1})
                if len(rows) <= _FEW:
                    return rows[distances <= max_m], distances[distances <= max_m]
            radius_m = min(radius_m * 4.0, max_m)

    def rows_of(self, rows: list[int]) -> dict[int, MarkerRow]:
        """Markers by their integer keys."""
        found = {}
        for start in range(0, len(rows), _CHUNK):
            query = sa.select(_C.row, *PUBLIC).where(_C.row.in_(rows[start : start + _CHUNK]))
            found.update({row[0]: _make(row[1:]) for row in self._connection.execute(query)})
        return found

    def _circle(self, radius_m: float, limit: int = _ALL) -> tuple[Ints, Floats]:
        parts = box_around(self._lon, self._lat, radius_m).parts
        statement = _inside(self._narrowed, _wide(parts), False)
        rows, distances = self._measured(statement, {**_sides(parts), "most": limit})
        if len(rows) == limit:
            return rows, distances
        near = distances <= radius_m
        return rows[near], distances[near]

    def _measured(self, statement: AnySelect, values: JsonObject) -> tuple[Ints, Floats]:
        found = self._connection.execute(statement, {**values, "agency": self._agency_id}).all()
        places = np.array([tuple(row) for row in found], dtype=np.float64).reshape(-1, 3)
        return places[:, 0].astype(np.int64), distances_m(self._lon, self._lat, places[:, 1], places[:, 2])


# --- statements: built once for each filter, which costs more than running them -----------------------------------


def _wide(parts: tuple[Box, ...]) -> tuple[bool, ...]:
    return tuple((p.east_deg - p.west_deg) * (p.north_deg - p.south_deg) >= _WIDE_DEG2 for p in parts)


def _sides(parts: tuple[Box, ...]) -> dict[str, float]:
    return {
        f"{side}{k}": value
        for k, p in enumerate(parts)
        for side, value in zip("wsen", (p.west_deg, p.south_deg, p.east_deg, p.north_deg), strict=True)
    }


@lru_cache(maxsize=256)
def _inside(filtered: MarkerFilter, wide: tuple[bool, ...], whole: bool) -> AnySelect:
    """Markers in the boxes of `_sides`."""
    return _owned(filtered, whole).where(sa.or_(*(in_box(k, is_wide) for k, is_wide in enumerate(wide))))


@lru_cache(maxsize=256)
def _in_order(filtered: MarkerFilter, whole: bool) -> AnySelect:
    """Markers in the order of their distance in degrees (PostGIS)."""
    geom = sa.table("markers", sa.column("geom")).c.geom
    point = sa.func.ST_MakePoint(sa.bindparam("lon", type_=sa.Double), sa.bindparam("lat", type_=sa.Double))
    return _owned(filtered, whole).order_by(geom.op("<->")(sa.func.ST_SetSRID(point, sa.literal_column("4326"))))


@lru_cache(maxsize=256)
def _anywhere(filtered: MarkerFilter) -> AnySelect:
    return _owned(filtered, False)


def _owned(filtered: MarkerFilter, whole: bool) -> AnySelect:
    columns = (_C.row, *PUBLIC) if whole else _PLACES
    most = sa.bindparam("most", type_=sa.Integer)
    return sa.select(*columns).where(_C.agency_id == sa.bindparam("agency"), *conditions_of(filtered)).limit(most)
