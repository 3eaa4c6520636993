"""Where markers are: boxes, circles and the R*Tree that finds them on SQLite (migration 0001 keeps it by triggers).

The R*Tree keeps 32-bit floats rounded outward, so it only proposes; the exact columns decide.
"""

from __future__ import annotations

import math
import sqlite3
from dataclasses import dataclass
from functools import lru_cache

import sqlalchemy as sa
from pyproj import Geod

from app.registry.tables import markers

_CONTINENT_DEG2 = 2_500.0
_M_PER_DEG = 110_574.0  # least length of a degree of latitude on WGS 84

rtree = sa.table(
    "markers_rtree",
    *(sa.column(name, sa.Double) for name in ("row", "min_lon", "max_lon", "min_lat", "max_lat")),
)


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


def box_around(lon_deg: float, lat_deg: float, radius_m: float) -> Box:
    """Smallest handy box that holds a circle, over the poles and the antimeridian too."""
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


def within_box(box: Box) -> sa.ColumnElement[bool]:
    """Markers inside a box: the index proposes, the exact columns decide."""
    return sa.or_(*(_within_part(part) for part in box.parts))


def _within_part(box: Box) -> sa.ColumnElement[bool]:
    exact = sa.and_(
        markers.c.lon_deg.between(box.west_deg, box.east_deg),
        markers.c.lat_deg.between(box.south_deg, box.north_deg),
    )
    if (box.east_deg - box.west_deg) * (box.north_deg - box.south_deg) >= _CONTINENT_DEG2:
        return exact  # most markers are inside: reading them in the order of the page finds it sooner
    proposed = sa.select(rtree.c.row).where(
        rtree.c.max_lon >= box.west_deg,
        rtree.c.min_lon <= box.east_deg,
        rtree.c.max_lat >= box.south_deg,
        rtree.c.min_lat <= box.north_deg,
    )
    return sa.and_(markers.c.row.in_(proposed), exact)


def within_radius(lon_deg: float, lat_deg: float, radius_m: float) -> sa.ColumnElement[bool]:
    """Markers within a geodesic distance."""
    distance = sa.func.waymark_distance_m(markers.c.lon_deg, markers.c.lat_deg, lon_deg, lat_deg, type_=sa.Double)
    return sa.and_(within_box(box_around(lon_deg, lat_deg, radius_m)), distance <= radius_m)


def distance_m(lon_a_deg: float, lat_a_deg: float, lon_b_deg: float, lat_b_deg: float) -> float:
    """Geodesic distance on WGS 84. [m]"""
    return float(_ellipsoid().inv(lon_a_deg, lat_a_deg, lon_b_deg, lat_b_deg)[2])


@lru_cache
def _ellipsoid() -> Geod:
    return Geod(ellps="WGS84")


def register_functions(connection: sqlite3.Connection) -> None:
    """Give a SQLite connection the functions that the queries use."""
    connection.create_function("waymark_distance_m", 4, distance_m, deterministic=True)
