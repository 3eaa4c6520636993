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
from functools import cached_property
from weakref import WeakValueDictionary

import numpy as np
import numpy.typing as npt
import shapely
import sqlalchemy as sa
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.compiler import SQLCompiler
from sqlalchemy.sql.functions import FunctionElement

from app.geodesy.frames import distance_m, ellipsoid
from app.registry.marker_rows import markers
from app.values import Floats, Floats32, Ints

# === Fills an empty R*Tree of SQLite in one pass: points are sorted into full nodes instead of inserted one by one.
#
# SQLite keeps an R*Tree in three ordinary tables (https://www.sqlite.org/rtree.html, "Shadow Tables"). A node is a
# blob: its depth (of the root, else zero) and its number of cells as two big-endian 16-bit numbers, then cells of a
# 64-bit id (of a row, or of the node below) and the box as 32-bit floats: minimum and maximum of each axis, rounded
# outward. Packing: Leutenegger, Lopez, Edgington, "STR: a simple and efficient algorithm for R-tree packing", ICDE
# 1997. What it gains is in docs/decisions/0002-registry-store.md.


_CELL = np.dtype([("id", ">i8"), ("box", ">f4", (4,))])
_HEADER = np.dtype([("depth", ">u2"), ("cells", ">u2")])
_ROOT = 1
_PART = 20_000  # rows read or written at a time


def fill_rtree(connection: sa.Connection, table: str) -> None:
    """Fill the empty R*Tree of a table with the positions of all its rows."""
    rtree = f"{table}_rtree"
    ids, boxes = _read_boxes(connection, table)
    if not len(ids):
        return
    size = connection.exec_driver_sql(f"SELECT length(data) FROM {rtree}_node WHERE nodeno = 1").scalar_one()
    depth, next_node = 0, _ROOT + 1
    max_cells = (int(size) - _HEADER.itemsize) // _CELL.itemsize
    while len(ids) > max_cells:
        order, starts = _packed(boxes, max_cells)
        ids, boxes = ids[order], boxes[order]
        nodes = np.arange(next_node, next_node + len(starts), dtype=np.int64)
        _store(connection, rtree, ids, boxes, nodes, starts, size=size, is_leaf=depth == 0)
        low, high = (f.reduceat(boxes, starts) for f in (np.minimum, np.maximum))
        boxes = np.stack([low[:, 0], high[:, 1], low[:, 2], high[:, 3]], axis=1)
        ids, depth, next_node = nodes, depth + 1, next_node + len(nodes)
    root = np.array([_ROOT], dtype=np.int64)
    _store(connection, rtree, ids, boxes, root, np.zeros(1, dtype=np.intp), size=size, is_leaf=depth == 0, depth=depth)


def _read_boxes(connection: sa.Connection, table: str) -> tuple[Ints, Floats32]:
    """Rows, shape (N,), and the boxes of their positions, shape (N, 4)."""
    driver = connection.connection.driver_connection
    assert driver is not None
    cursor = driver.execute(f"SELECT row, lon_deg, lat_deg FROM {table}")
    ids, boxes = [np.empty(0, dtype=np.int64)], [np.empty((0, 4), dtype=np.float32)]
    while rows := cursor.fetchmany(_PART):
        part = np.array(rows, dtype=np.float64)
        ids.append(part[:, 0].astype(np.int64))
        boxes.append(_outward(part[:, 1:]))
    return np.concatenate(ids), np.concatenate(boxes)


def _outward(positions: npt.NDArray[np.float64]) -> Floats32:
    """Boxes of points, shape (N, 4): each side the next 32-bit float that is not inside."""
    near = positions.astype(np.float32)
    low = np.where(near > positions, np.nextafter(near, np.float32(-np.inf)), near)
    high = np.where(near < positions, np.nextafter(near, np.float32(np.inf)), near)
    return np.stack([low[:, 0], high[:, 0], low[:, 1], high[:, 1]], axis=1).astype(np.float32)


def _packed(boxes: Floats32, max_cells: int) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Order of the entries and the first of each node: slices of longitude, in each runs of latitude."""
    nodes = math.ceil(len(boxes) / max_cells)
    slices = math.ceil(math.sqrt(nodes))
    by_lon = np.argsort(boxes[:, 0], kind="stable")
    number = np.empty(len(boxes), dtype=np.int32)
    number[by_lon] = np.arange(len(boxes)) * slices // len(boxes)
    order = np.lexsort((boxes[:, 2], number))
    starts = []
    for first, last in zip(*_edges(number[order]), strict=True):
        parts = math.ceil((last - first) / max_cells)
        starts.append(first + np.arange(parts) * (last - first) // parts)
    return order, np.concatenate(starts)


def _edges(number: npt.NDArray[np.int32]) -> tuple[list[int], list[int]]:
    changes = (np.flatnonzero(np.diff(number)) + 1).tolist()
    return [0, *changes], [*changes, len(number)]


def _store(
    connection: sa.Connection,
    rtree: str,
    ids: Ints,
    boxes: Floats32,
    nodes: Ints,
    starts: npt.NDArray[np.intp],
    *,
    size: int,
    is_leaf: bool,
    depth: int = 0,
) -> None:
    """Write nodes, and which node each of their entries is in."""
    counts = np.diff([*starts, len(ids)])
    cells = np.empty(len(ids), dtype=_CELL)
    cells["id"], cells["box"] = ids, boxes
    blobs = (
        _node(cells[start : start + count], depth, size) for start, count in zip(starts.tolist(), counts, strict=True)
    )
    driver = connection.connection.driver_connection
    assert driver is not None
    driver.executemany(f"INSERT OR REPLACE INTO {rtree}_node VALUES (?, ?)", zip(nodes.tolist(), blobs, strict=True))
    del cells, blobs
    child = f"{rtree}_rowid" if is_leaf else f"{rtree}_parent"
    order = np.argsort(ids, kind="stable")
    parents = np.repeat(nodes, counts)[order]
    for start in range(0, len(order), _PART):
        part = slice(start, start + _PART)
        within = zip(ids[order[part]].tolist(), parents[part].tolist(), strict=True)
        driver.executemany(f"INSERT INTO {child} VALUES (?, ?)", within)


def _node(cells: npt.NDArray[np.void], depth: int, size: int) -> bytes:
    header = np.array((depth, len(cells)), dtype=_HEADER)
    return (header.tobytes() + cells.tobytes()).ljust(size, b"\x00")


# === Where markers are.


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

    def contains(self, lon_deg: float, lat_deg: float) -> bool:
        """Whether a place is in the box or on its border."""
        over = self.west_deg > self.east_deg
        is_east, is_west = lon_deg >= self.west_deg, lon_deg <= self.east_deg
        across = is_east or is_west if over else is_east and is_west
        return across and self.south_deg <= lat_deg <= self.north_deg

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
    """A shape that points are compared with."""

    def __init__(self, wkb: bytes) -> None:
        self._wkb = wkb

    @cached_property
    def shape(self) -> shapely.Geometry:
        """The shape, prepared when the first point is compared."""
        shape = shapely.from_wkb(self._wkb)
        shapely.prepare(shape)
        return shape


_PREPARED: WeakValueDictionary[bytes, _PreparedArea] = WeakValueDictionary()
"""Shapes of all areas that are in use, by `Area.key`."""


@dataclass(frozen=True, slots=True)
class Area:
    """Polygons, lines or points with straight edges in longitude and latitude; none spans the antimeridian."""

    wkb: bytes  # Well-known binary, little-endian
    boxes: tuple[Box, ...]  # one around each part
    # names the area in statements of SQLite, for which a call of a function with 10,000 vertices takes 0.3 ms
    key: bytes = field(init=False, compare=False, repr=False)
    _prepared: _PreparedArea = field(init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        """Share the prepared shape with equal areas; it is kept as long as one of these is."""
        key = hashlib.blake2b(self.wkb, digest_size=16).digest()
        object.__setattr__(self, "key", key)
        object.__setattr__(self, "_prepared", _PREPARED.setdefault(key, _PreparedArea(self.wkb)))

    @property
    def shape(self) -> shapely.Geometry:
        """All parts as one geometry, prepared for many comparisons."""
        return self._prepared.shape


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

    def self_group(self, against: object = None) -> _Proposed:
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
def _by_rtree(element: _Proposed, compiler: SQLCompiler, **how: object) -> str:
    row, west, south, east, north = element.clauses
    index = _RTREES[row.table.name]
    rows = sa.select(index.c.row).where(
        index.c.max_lon >= west, index.c.min_lon <= east, index.c.max_lat >= south, index.c.min_lat <= north
    )
    return compiler.process(row.in_(rows), **how)


@compiles(_Proposed, "postgresql")
def _by_gist(element: _Proposed, compiler: SQLCompiler, **how: object) -> str:
    row, *sides = element.clauses
    point = sa.table(row.table.name, sa.column("geom")).c.geom
    box = sa.func.ST_MakeEnvelope(*sides, sa.literal_column("4326"))
    return compiler.process(point.op("&&", is_comparison=True)(box), **how)


def within_box(box: Box, table: sa.Table = markers) -> sa.ColumnElement[bool]:
    """Rows of a table with a spatial index inside a box: the index finds candidates, the exact columns decide."""
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


def within_area(area: Area, table: sa.Table = markers, *, strictly: bool = False) -> sa.ColumnElement[bool]:
    """Rows inside an area or, unless `strictly`, on its edge; both databases use GEOS."""
    shape = (sa.literal(area.wkb, sa.LargeBinary), sa.literal(area.key, sa.LargeBinary))
    found = (_Contained if strictly else _Covered)(*shape, table.c.row, table.c.lon_deg, table.c.lat_deg)
    return sa.and_(sa.or_(*(within_box(box, table) for box in area.boxes)), found)


class _Covered(FunctionElement[bool]):
    """Rows that an area covers: its well-known binary, its key, row column, longitude, latitude."""

    name = "waymark_covered"
    type = sa.Boolean()
    inherit_cache = True

    def self_group(self, against: object = None) -> _Covered:
        """Itself; see `_Proposed`."""
        return self


class _Contained(_Covered):
    """The same without the area's edge."""

    name = "waymark_contained"
    inherit_cache = True


@compiles(_Covered, "sqlite")
def _by_function(element: _Covered, compiler: SQLCompiler, **how: object) -> str:
    _wkb, key, _row, lon_deg, lat_deg = element.clauses
    function = sa.func.waymark_contains if isinstance(element, _Contained) else sa.func.waymark_covers
    return compiler.process(function(key, lon_deg, lat_deg), **how)


@compiles(_Covered, "postgresql")
def _by_postgis(element: _Covered, compiler: SQLCompiler, **how: object) -> str:
    wkb, _key, row, _lon, _lat = element.clauses
    area = sa.func.ST_GeomFromWKB(wkb, sa.literal_column("4326"))
    point = sa.table(row.table.name, sa.column("geom")).c.geom
    function = sa.func.ST_Contains if isinstance(element, _Contained) else sa.func.ST_Intersects
    return compiler.process(function(area, point), **how)


def covers(area: Area, lon_deg: float, lat_deg: float) -> bool:
    """Whether a position is inside an area or on its edge."""
    return _covers(area.key, lon_deg, lat_deg)


def _covers(key: bytes, lon_deg: float, lat_deg: float) -> bool:
    return bool(shapely.intersects_xy(_PREPARED[key].shape, lon_deg, lat_deg))


def _contains(key: bytes, lon_deg: float, lat_deg: float) -> bool:
    return bool(shapely.contains_xy(_PREPARED[key].shape, lon_deg, lat_deg))


def within_radius(lon_deg: float, lat_deg: float, radius_m: float) -> sa.ColumnElement[bool]:
    """Markers within a geodesic distance."""
    place = (sa.literal(lon_deg, sa.Double), sa.literal(lat_deg, sa.Double))
    return sa.and_(within_box(box_around(lon_deg, lat_deg, radius_m)), distance_to(*place) <= radius_m)


def distance_to(lon_deg: sa.ColumnElement[float], lat_deg: sa.ColumnElement[float]) -> sa.ColumnElement[float]:
    """Geodesic distance of a marker from a position, as SQL. [m]

    SQLite calls `distance_m`, PostgreSQL a function of migration 0004; the two agree within 2e-8 m.
    """
    return sa.func.waymark_distance_m(markers.c.lon_deg, markers.c.lat_deg, lon_deg, lat_deg, type_=sa.Double)


def distances_m(lon_deg: float, lat_deg: float, lons_deg: Floats, lats_deg: Floats) -> Floats:
    """Geodesic distances of positions from one position, shape (N,). [m]"""
    same = np.ones(len(lons_deg))
    return np.asarray(ellipsoid().inv(lon_deg * same, lat_deg * same, lons_deg, lats_deg)[2], dtype=np.float64)


def register_functions(connection: sqlite3.Connection) -> None:
    """Give a SQLite connection the functions that the queries use."""
    connection.create_function("waymark_distance_m", 4, distance_m, deterministic=True)
    connection.create_function("waymark_covers", 3, _covers, deterministic=True)
    connection.create_function("waymark_contains", 3, _contains, deterministic=True)
