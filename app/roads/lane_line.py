"""A line along a lane in a local frame: chainage to place and back."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter
from app.geodesy import check_lon_lat, enu_from_wgs84, lon_lat_from_enu

FloatArray = npt.NDArray[np.float64]
MAX_LENGTH_M = 20_000.0
"""Longest line. [m] Source: chosen by hand; in a longer one the plane frame turns bearings by more than a magnet's
tolerance."""
_MAX_POINTS = 100_000  # of a line; source: by hand, bounds the time
_SAME_PLACE_M = 1e-4  # [m] points nearer than this are one; source: by hand, the step of a tag's lengths


@dataclass(frozen=True, slots=True, eq=False)
class LaneLine:
    """A line in the direction of travel, e.g. a lane's centre line or a painted line.

    Attributes
    ----------
    origin : (lon_deg, lat_deg, height_m)
        Of the local east, north, up frame: the line's first point.
    points_enu_m : ndarray, shape (K, 3)
        Vertices; up follows the ellipsoid away from the origin. [m]
    chainages_m : ndarray, shape (K,)
        Of the vertices, from 0. [m]
    """

    origin: tuple[float, float, float]
    points_enu_m: FloatArray
    chainages_m: FloatArray

    @classmethod
    def from_lon_lat(cls, points_deg: Sequence[Sequence[float]], height_m: float = 0.0) -> LaneLine:
        """Line through positions, e.g. the coordinates of a GeoJSON LineString.

        Parameters
        ----------
        points_deg : sequence of (lon, lat), or (lon, lat, height); heights are left out
            In WGS 84, in the direction of travel. [deg]
        height_m : float
            Ellipsoidal height of the road, at which distances are true. [m]

        Raises
        ------
        InvalidParameter
            Fewer than two different points, one that is out of range, or a line longer than 20 km.
        """
        if not 2 <= len(points_deg) <= _MAX_POINTS or any(len(p) < 2 for p in points_deg):
            raise InvalidParameter(
                f"a line has {len(points_deg)} points", field="lane", limit=f"2 to {_MAX_POINTS} positions lon, lat"
            )
        if not -500.0 <= height_m <= 9000.0:
            raise InvalidParameter(f"height_m is {height_m}", field="height_m", limit="-500 to 9000 m")
        for i, (lon_deg, lat_deg, *_) in enumerate(points_deg):
            check_lon_lat(lon_deg, lat_deg, f"lane[{i}]")
        origin = (float(points_deg[0][0]), float(points_deg[0][1]), float(height_m))
        lon_lat = np.array([(lon_deg, lat_deg) for lon_deg, lat_deg, *_ in points_deg], dtype=np.float64)
        points = enu_from_wgs84(lon_lat[:, 0], lon_lat[:, 1], height_m, origin).T
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        points = points[np.concatenate([[True], steps > _SAME_PLACE_M])]
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        if not len(steps) or steps.sum() > MAX_LENGTH_M:
            raise InvalidParameter(
                f"the line is {steps.sum():.0f} m long",
                field="lane",
                limit=f"above 0, at most {MAX_LENGTH_M:.0f} m",
                cure="cut the road into sections",
            )
        return cls(origin, points, np.concatenate([[0.0], np.cumsum(steps)]))

    @property
    def length_m(self) -> float:
        """Chainage of its end. [m]"""
        return float(self.chainages_m[-1])

    def at(self, chainage_m: float | FloatArray) -> FloatArray:
        """Places on the line, shape (..., 3), east, north, up; outside it, its ends. [m]"""
        return np.stack([np.interp(chainage_m, self.chainages_m, self.points_enu_m[:, k]) for k in range(3)], axis=-1)

    def direction_at(self, chainage_m: float) -> FloatArray:
        """Unit vector of travel, shape (3,): east, north, up."""
        last = len(self.chainages_m) - 2
        i = min(max(int(np.searchsorted(self.chainages_m, chainage_m, side="right")) - 1, 0), last)
        step: FloatArray = self.points_enu_m[i + 1] - self.points_enu_m[i]
        return step / float(np.linalg.norm(step))

    def locate(self, point_enu_m: FloatArray) -> tuple[float, float]:
        """Chainage of the nearest place on the line and the offset from it, left positive. [m]"""
        starts, steps = self.points_enu_m[:-1, :2], np.diff(self.points_enu_m[:, :2], axis=0)
        squared = np.sum(steps**2, axis=1)
        share = np.clip(np.sum((point_enu_m[:2] - starts) * steps, axis=1) / squared, 0.0, 1.0)
        away = point_enu_m[:2] - (starts + share[:, None] * steps)
        i = int(np.argmin(np.sum(away**2, axis=1)))
        left = steps[i, 0] * away[i, 1] - steps[i, 1] * away[i, 0]
        chainage = self.chainages_m[i] + share[i] * (self.chainages_m[i + 1] - self.chainages_m[i])
        return float(chainage), math.copysign(float(np.linalg.norm(away[i])), left)

    def lon_lat(self, points_enu_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Longitudes and latitudes of points of the local frame, shape (..., 3). [deg]"""
        return lon_lat_from_enu(points_enu_m, self.origin)

    def from_position(self, lon_deg: float, lat_deg: float) -> FloatArray:
        """A position in the local frame, shape (3,). [m]"""
        return enu_from_wgs84(lon_deg, lat_deg, self.origin[2], self.origin)


def left_of(direction: FloatArray) -> FloatArray:
    """Level unit vector to the left of a direction, shape (3,)."""
    left = np.array([-direction[1], direction[0], 0.0])
    return left / float(np.linalg.norm(left))


def bearing_deg(direction: FloatArray) -> float:
    """Clockwise from true north, 0 to 360. [deg]"""
    return math.degrees(math.atan2(direction[0], direction[1])) % 360.0
