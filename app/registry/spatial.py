"""Where markers are: boxes, circles and the index that finds them.

SQLite has an R*Tree, kept by triggers (migrations 0001 and 0002); PostgreSQL a GiST index over PostGIS points, kept by
generated columns (migration 0004). Both keep 32-bit floats rounded outward, so they only propose; the exact columns and
the geodesic distance decide.
"""

from __future__ import annotations

import hashlib
import math
import sqlite3
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
import numpy.typing as npt
import shapely
import sqlalchemy as sa
from pyproj import Geod
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.compiler import SQLCompiler
from sqlalchemy.sql.functions import FunctionElement

from app.registry.tables import markers

FloatArray = npt.NDArray[np.float64]
_CONTINENT_DEG2 = 2_500.0
_M_PER_DEG = 110_574.0  # [m/deg] shortest degree of latitude on WGS 84, at the equator


def _rtree(table: str) -> sa.TableClause:
    names = ("row", "min_lon", "max_lon", "min_lat", "max_lat")
    return sa.table(f"{table}_rtree", *(sa.column(name, sa.Double) for name in names))


_RTREES = {table: _rtree(table) for table in ("markers", "magnets", "planned_markers", "maintenance_items")}


@dataclass(frozen=True, slots=True)
class Box:
    """A box in degrees. West may exceed east: then it spans the antimeridian."""

    west_deg: float
    south_deg: float
    east_deg: float
    north_deg: float

    @property
    def parts(self) -> tuple[Box, ...]:
        """The box cut at the antimeridian."""
        if self.west_deg <= self.east_deg:
            return (self,)
        return (
            Box(self.west_deg, self.south_deg, 180.0, self.north_deg),
            Box(-180.0, self.south_deg, self.east_deg, self.north_deg),
        )

    def widened(self, margin_m: float) -> Box:
        """The box with at least this margin on each side."""
        margin_deg = margin_m / _M_PER_DEG
        south, north = max(self.south_deg - margin_deg, -90.0), min(self.north_deg + margin_deg, 90.0)
        shortest = math.cos(math.radians(max(abs(south), abs(north))))
        across_deg = margin_deg / shortest * 1.01 if shortest > margin_deg / 180.0 else 180.0
        width_deg = self.east_deg - self.west_deg + (360.0 if self.west_deg > self.east_deg else 0.0)
        if width_deg + 2 * across_deg >= 360.0:
            return Box(-180.0, south, 180.0, north)
        return Box(_wrapped(self.west_deg - across_deg), south, _wrapped(self.east_deg + across_deg), north)


class _PreparedArea:
    """Polygons that points are compared with."""

    def __init__(self, wkb: bytes) -> None:
        self._wkb = wkb

    @cached_property
    def shape(self) -> shapely.Geometry:
        """The polygons, prepared when the first point is compared."""
        shape = shapely.from_wkb(self._wkb)
        shapely.prepare(shape)
        return shape


_PREPARED: WeakValueDictionary[bytes, _PreparedArea] = WeakValueDictionary()
"""Polygons of all areas that are in use, by `Area.key`."""


@dataclass(frozen=True, slots=True)
class Area:
    """One polygon or several, with straight edges in longitude and latitude; none spans the antimeridian.

    Attributes
    ----------
    wkb : bytes
        Well-known binary, little-endian.
    boxes : tuple of Box
        One around each polygon.
    key : bytes
        Names the area in statements of SQLite, for which a call of a function with 10,000 vertices takes 0.3 ms.
    """

    wkb: bytes
    boxes: tuple[Box, ...]
    key: bytes = field(init=False, compare=False, repr=False)
    _prepared: _PreparedArea = field(init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        """Share the prepared polygons with equal areas; they are kept as long as one of these is."""
        key = hashlib.blake2b(self.wkb, digest_size=16).digest()
        object.__setattr__(self, "key", key)
        object.__setattr__(self, "_prepared", _PREPARED.setdefault(key, _PreparedArea(self.wkb)))


def box_around(lon_deg: float, lat_deg: float, radius_m: float) -> Box:
    """A box around a circle, also over the poles and the antimeridian; up to 1 % larger than needed."""
    reach_deg = radius_m / _M_PER_DEG * 1.001
    south, north = lat_deg - reach_deg, lat_deg + reach_deg
    if south <= -90.0 or north >= 90.0:
        return Box(-180.0, max(south, -90.0), 180.0, min(north, 90.0))
    spread = math.sin(math.radians(reach_deg)) / math.cos(math.radians(lat_deg))
    if spread >= 1.0:
        return Box(-180.0, south, 180.0, north)
    half_deg = math.degrees(math.asin(spread)) * 1.01
    if half_deg >= 180.0:
        return Box(-180.0, south, 180.0, north)
    return Box(_wrapped(lon_deg - half_deg), south, _wrapped(lon_deg + half_deg), north)


def _wrapped(lon_deg: float) -> float:
    return lon_deg - 360.0 if lon_deg > 180.0 else lon_deg + 360.0 if lon_deg < -180.0 else lon_deg


class _Proposed(FunctionElement[bool]):
    """Rows that the spatial index of their table finds for a box: row column, west, south, east, north."""

    name = "waymark_proposed"
    type = sa.Boolean()
    inherit_cache = True

    def self_group(self, against: Any = None) -> _Proposed:
        """Itself: SQLAlchemy would write `... IN (...) = 1` for SQLite, which then ignores the index."""
        return self


def proposed_by_index(
    table: sa.Table,
    west_deg: sa.ColumnElement[float],
    south_deg: sa.ColumnElement[float],
    east_deg: sa.ColumnElement[float],
    north_deg: sa.ColumnElement[float],
) -> sa.ColumnElement[bool]:
    """Rows of a table with a spatial index whose position may be inside a box that does not span the antimeridian."""
    return _Proposed(table.c.row, west_deg, south_deg, east_deg, north_deg)


@compiles(_Proposed, "sqlite")
def _by_rtree(element: _Proposed, compiler: SQLCompiler, **how: Any) -> str:
    row, west, south, east, north = element.clauses
    index = _RTREES[row.table.name]
    rows = sa.select(index.c.row).where(
        index.c.max_lon >= west, index.c.min_lon <= east, index.c.max_lat >= south, index.c.min_lat <= north
    )
    return compiler.process(row.in_(rows), **how)


@compiles(_Proposed, "postgresql")
def _by_gist(element: _Proposed, compiler: SQLCompiler, **how: Any) -> str:
    row, *sides = element.clauses
    point = sa.table(row.table.name, sa.column("geom")).c.geom
    box = sa.func.ST_MakeEnvelope(*sides, sa.literal_column("4326"))
    return compiler.process(point.op("&&", is_comparison=True)(box), **how)


def within_box(box: Box, table: sa.Table = markers) -> sa.ColumnElement[bool]:
    """Rows of `markers` or `magnets` inside a box: the index finds candidates, the exact columns decide."""
    return sa.or_(*(_within_part(part, table) for part in box.parts))


def _within_part(box: Box, table: sa.Table) -> sa.ColumnElement[bool]:
    exact = sa.and_(
        table.c.lon_deg.between(box.west_deg, box.east_deg),
        table.c.lat_deg.between(box.south_deg, box.north_deg),
    )
    if (box.east_deg - box.west_deg) * (box.north_deg - box.south_deg) >= _CONTINENT_DEG2:
        return exact  # most markers are inside: reading them in the order of the page finds it sooner
    west, south, east, north = (
        sa.literal(side, sa.Double) for side in (box.west_deg, box.south_deg, box.east_deg, box.north_deg)
    )
    return sa.and_(proposed_by_index(table, west, south, east, north), exact)


def within_area(area: Area) -> sa.ColumnElement[bool]:
    """Markers inside an area or on its edge; both databases use GEOS."""
    shape = (sa.literal(area.wkb, sa.LargeBinary), sa.literal(area.key, sa.LargeBinary))
    return sa.and_(sa.or_(*(within_box(box) for box in area.boxes)), _Covered(*shape))


class _Covered(FunctionElement[bool]):
    """Markers that an area covers: its well-known binary, its key."""

    name = "waymark_covered"
    type = sa.Boolean()
    inherit_cache = True

    def self_group(self, against: Any = None) -> _Covered:
        """Itself; see `_Proposed`."""
        return self


@compiles(_Covered, "sqlite")
def _by_function(element: _Covered, compiler: SQLCompiler, **how: Any) -> str:
    _wkb, key = element.clauses
    return compiler.process(sa.func.waymark_covers(key, markers.c.lon_deg, markers.c.lat_deg), **how)


@compiles(_Covered, "postgresql")
def _by_postgis(element: _Covered, compiler: SQLCompiler, **how: Any) -> str:
    wkb, _key = element.clauses
    area = sa.func.ST_GeomFromWKB(wkb, sa.literal_column("4326"))
    point = sa.table("markers", sa.column("geom")).c.geom
    return compiler.process(sa.func.ST_Covers(area, point), **how)


def covers(area: Area, lon_deg: float, lat_deg: float) -> bool:
    """Whether a position is inside an area or on its edge."""
    return _covers(area.key, lon_deg, lat_deg)


def _covers(key: bytes, lon_deg: float, lat_deg: float) -> bool:
    return bool(shapely.intersects_xy(_PREPARED[key].shape, lon_deg, lat_deg))


def within_radius(lon_deg: float, lat_deg: float, radius_m: float) -> sa.ColumnElement[bool]:
    """Markers within a geodesic distance."""
    place = (sa.literal(lon_deg, sa.Double), sa.literal(lat_deg, sa.Double))
    return sa.and_(within_box(box_around(lon_deg, lat_deg, radius_m)), distance_to(*place) <= radius_m)


def distance_to(lon_deg: sa.ColumnElement[float], lat_deg: sa.ColumnElement[float]) -> sa.ColumnElement[float]:
    """Geodesic distance of a marker from a position, as SQL. [m]

    SQLite calls `distance_m`, PostgreSQL a function of migration 0004; the two agree within 2e-8 m.
    """
    return sa.func.waymark_distance_m(markers.c.lon_deg, markers.c.lat_deg, lon_deg, lat_deg, type_=sa.Double)


def distances_m(lon_deg: float, lat_deg: float, lons_deg: FloatArray, lats_deg: FloatArray) -> FloatArray:
    """Geodesic distances of positions from one position, shape (N,). [m]"""
    same = np.ones(len(lons_deg))
    return np.asarray(_ellipsoid().inv(lon_deg * same, lat_deg * same, lons_deg, lats_deg)[2], dtype=np.float64)


def distance_m(lon_a_deg: float, lat_a_deg: float, lon_b_deg: float, lat_b_deg: float) -> float:
    """Geodesic distance on WGS 84. [m]"""
    return float(_ellipsoid().inv(lon_a_deg, lat_a_deg, lon_b_deg, lat_b_deg)[2])


@lru_cache
def _ellipsoid() -> Geod:
    return Geod(ellps="WGS84")


def register_functions(connection: sqlite3.Connection) -> None:
    """Give a SQLite connection the functions that the queries use."""
    connection.create_function("waymark_distance_m", 4, distance_m, deterministic=True)
    connection.create_function("waymark_covers", 3, _covers, deterministic=True)
