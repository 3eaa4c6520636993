"""A smooth line in the plane: places along and across it."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from app.decoders.cerpm.lane_types import LEFT, RIGHT, Floats, Ints

STEP_M = 1.0
_LEG_M = 20.0  # places on the line further apart than this are on two legs of it
_NEWTON_STEPS = 4
_SURE_M = 1e-4


def lengths_along(points_m: Floats) -> Floats:
    """Length along a polyline up to each of its points, shape (N,). [m]"""
    step = np.diff(points_m, axis=0)
    return np.concatenate([np.zeros(1), np.cumsum(np.hypot(step[:, 0], step[:, 1]))])


class Line:
    """A cubic spline through points in order, with a station each metre.

    Parameters
    ----------
    points_m : ndarray, shape (N, 2)
        At least two, each apart from the one before. [m]
    """

    def __init__(self, points_m: Floats) -> None:
        along = lengths_along(points_m)
        if len(points_m) > 2:
            spline = CubicSpline(along, points_m, axis=0, bc_type="natural")
        else:
            slope = (points_m[1] - points_m[0]) / along[1]
            spline = CubicSpline(along, points_m, axis=0, bc_type=((1, slope), (1, slope)))
        count = max(round(along[-1] / STEP_M), 2) + 1
        knots = np.linspace(0.0, along[-1], count)
        self.points_m: Floats = spline(knots)
        self.station_m: Floats = lengths_along(self.points_m)
        slope = spline(knots, 1)
        self.tangent = slope / np.maximum(np.hypot(slope[:, 0], slope[:, 1]), 1e-9)[:, None]
        bend = spline(knots, 2)
        speed = np.maximum(np.hypot(slope[:, 0], slope[:, 1]), 1e-3)
        self.curvature_1pm: Floats = (slope[:, 0] * bend[:, 1] - slope[:, 1] * bend[:, 0]) / speed**3
        self._even_m = float(self.station_m[-1]) / (count - 1)

    @property
    def length_m(self) -> float:
        """[m]"""
        return float(self.station_m[-1])

    def at(self, station_m: Floats) -> tuple[Floats, Floats]:
        """Places and unit tangents at stations; straight on past the ends. Shapes (N, 2). [m]"""
        place = np.clip(station_m / self._even_m, 0, len(self.station_m) - 1 - 1e-9)
        i = place.astype(np.int64)
        share = (place - i)[:, None]
        p, t = self.points_m, self.tangent
        tangent = t[i] * (1 - share) + t[i + 1] * share
        # cubic Hermite between stations
        a, b, h = p[i], p[i + 1], self._even_m
        u = share
        point = (
            a * ((1 + 2 * u) * (1 - u) ** 2) + b * (u * u * (3 - 2 * u))
            + h * (t[i] * (u * (1 - u) ** 2) + t[i + 1] * (u * u * (u - 1)))
        )  # fmt: skip
        beyond = station_m - np.clip(station_m, 0, self.length_m)
        return point + tangent * beyond[:, None], tangent

    def offset(self, station_m: Floats, left_m: Floats) -> Floats:
        """Places so far to the left of stations, shape (N, 2). [m]"""
        point, tangent = self.at(station_m)
        return point + np.stack([-tangent[:, 1], tangent[:, 0]], 1) * left_m[:, None]

    def follow(self, points_m: Floats, station_m: Floats) -> tuple[Floats, Floats]:
        """Station and left offset of points, from stations that are nearly right. [m]"""
        station = station_m.copy()
        for _ in range(_NEWTON_STEPS):
            point, tangent = self.at(station)
            step = np.sum((points_m - point) * tangent, 1)
            station = station + np.clip(step, -5, 5)
            if not len(step) or np.abs(step).max() < _SURE_M:
                break
        off = points_m - point
        return station, tangent[:, 0] * off[:, 1] - tangent[:, 1] * off[:, 0]

    def nearest(self, points_m: Floats) -> tuple[Floats, Floats]:
        """Station and left offset of points that lie near the line or anywhere, from the nearest leg of it. [m]"""
        _, index = cKDTree(self.points_m).query(points_m)
        return self.follow(points_m, self.station_m[index])

    def find(self, points_m: Floats, side: Ints, half_width_m: float) -> tuple[Floats, Floats]:
        """Station and left offset of points on the boundaries. [m]

        Where the line passes a point twice, the leg is taken from which the point lies about half a width, on its side.
        """
        tree = cKDTree(self.points_m)
        near = min(24, len(self.points_m))
        far, index = (np.asarray(found) for found in tree.query(points_m, k=near))
        first = index[:, :1]
        other = (np.abs(self.station_m[index] - self.station_m[first]) > _LEG_M) & (far < far[:, :1] + 3 * half_width_m)
        station, left = self.follow(points_m, self.station_m[first[:, 0]])
        rows = np.flatnonzero(other.any(1))
        if len(rows):
            second = index[rows, np.argmax(other[rows], 1)]
            station_2, left_2 = self.follow(points_m[rows], self.station_m[second])
            strange = [_strangeness(value, side[rows], half_width_m) for value in (left_2, left[rows])]
            better = strange[0] < strange[1]
            station[rows[better]], left[rows[better]] = station_2[better], left_2[better]
        return station, left


def _strangeness(left_m: Floats, side: Ints, half_width_m: float) -> Floats:
    """How far offsets are from those of a boundary of the side, or of either where it is not known."""
    to_left, to_right = np.abs(left_m - half_width_m), np.abs(left_m + half_width_m)
    return np.where(side == LEFT, to_left, np.where(side == RIGHT, to_right, np.minimum(to_left, to_right)))
