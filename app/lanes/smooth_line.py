"""A smooth line in the plane, with positions along it (stations) and across it (left offsets)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pymap3d
import scipy

from app.geodesy.frames import WGS84_A_M, metres_per_radian
from app.lanes.types import LEFT, RIGHT, UNKNOWN
from app.values import Bools, Floats, Ints

_DENSE_S, _WILD_M = 0.25, 1.0  # [s] between fixes, and [m] of a wild one from those before and after it

# === WGS 84 positions in a local plane, and back.


def median_place(lon_deg: Floats, lat_deg: Floats) -> tuple[float, float]:
    """Longitude and latitude of the coordinate-wise median of places, which a few outliers do not move. [deg]"""
    x, y, z = pymap3d.geodetic2ecef(lat_deg, lon_deg, np.zeros_like(lon_deg))
    lat, lon, _ = pymap3d.ecef2geodetic(float(np.median(x)), float(np.median(y)), float(np.median(z)))
    return float(lon), float(lat)


def plane_from_wgs84(lon_deg: Floats, lat_deg: Floats, origin: tuple[float, float]) -> Floats:
    """East and north of places on the ellipsoid from an origin (lon_deg, lat_deg), shape (N, 2). [m]"""
    east, north, _ = pymap3d.geodetic2enu(lat_deg, lon_deg, np.zeros_like(lon_deg), origin[1], origin[0], 0.0)
    return np.stack([np.asarray(east, float), np.asarray(north, float)], 1)


def wgs84_from_plane(position_m: Floats, origin: tuple[float, float]) -> tuple[Floats, Floats]:
    """Longitude and latitude of the places on the ellipsoid below points of the plane. [deg]"""
    east, north = position_m[:, 0], position_m[:, 1]
    up = -(east**2 + north**2) / (2 * WGS84_A_M)
    for _ in range(8):
        lat, lon, height = pymap3d.enu2geodetic(east, north, up, origin[1], origin[0], 0.0)
        if not len(up) or np.abs(height).max() < 1e-3:
            break
        up = up - height
    lon = (np.asarray(lon, float) + 180.0) % 360.0 - 180.0
    return lon, np.asarray(lat, float)


def headings_deg(lon_deg: Floats, lat_deg: Floats) -> Floats:
    """Heading along ordered places, clockwise from true north at each, shape (N,). [deg]"""
    lon = np.unwrap(lon_deg, period=360.0)
    east_per_rad, north_per_rad = metres_per_radian(np.radians(lat_deg))
    east, north = np.gradient(lon) * east_per_rad, np.gradient(lat_deg) * north_per_rad
    return np.asarray(np.degrees(np.arctan2(east, north)) % 360.0)


# === A smooth line in the plane, with positions along it (stations) and across it (left offsets).


STEP_M = 1.0  # [m] between stations; source: the published path has a station each metre (docs/cerpms.md)
_SEPARATE_LEG_M = 20.0  # [m] along the line between two legs; sensitivity 1.00, 1.00
_MAX_NEWTON_STEPS = 4  # source: Newton's method converges quadratically; from 1 m it needs three steps to a nanometre
_NEWTON_TOLERANCE_M = 1e-4  # [m] source: a 50th of the smallest survey error, `observations._MIN_SIGMA_M`
_MAX_NEWTON_STEP_M = 5.0  # [m] a fifth of the tightest radius of 25 m
_NEAREST_STATIONS = 24  # source: 24 m of one leg, so a second leg within about 12 m is among them


def lengths_along(points_m: Floats) -> Floats:
    """Length along a polyline up to each of its points, shape (N,). [m]"""
    step = np.diff(points_m, axis=0)
    return np.concatenate([np.zeros(1), np.cumsum(np.hypot(step[:, 0], step[:, 1]))])


def without_wild_fixes(time_s: Floats, fixes_m: Floats) -> Floats:
    """Fixes of a track, single wild ones replaced by the middle of those before and after, shape (T, 2). [m]

    Where fixes are too far apart to show which ones are wild, none is replaced.
    """
    if len(fixes_m) < 3 or np.median(np.diff(time_s)) > _DENSE_S:
        return fixes_m
    off = np.hypot(*(fixes_m - scipy.ndimage.median_filter(fixes_m, (3, 1))).T)
    wild = np.flatnonzero(off[1:-1] > _WILD_M) + 1
    fixes_m = fixes_m.copy()
    fixes_m[wild] = (fixes_m[wild - 1] + fixes_m[wild + 1]) / 2
    return fixes_m


def mean_fixes(fixes_m: Floats, step_m: float) -> Floats:
    """Mean fixes of steps along a track, so that a vehicle that stands counts once, shape (S, 2). [m]"""
    if len(fixes_m) < 2:
        return fixes_m
    _, which, count = np.unique(
        (lengths_along(fixes_m) / step_m).astype(np.int64), return_inverse=True, return_counts=True
    )
    return np.stack([np.bincount(which, fixes_m[:, k]) / count for k in range(2)], 1)


def left_normals(tangent: Floats) -> Floats:
    """Unit vectors to the left of unit tangents, shape (N, 2)."""
    return np.stack([-tangent[:, 1], tangent[:, 0]], 1)


class SmoothLine:
    """A cubic spline through ordered points, with a station each metre.

    Parameters
    ----------
    points_m : ndarray, shape (N, 2)
        At least two, no two neighbours alike. [m]
    """

    def __init__(self, points_m: Floats) -> None:
        along = lengths_along(points_m)
        if len(points_m) > 2:
            spline = scipy.interpolate.CubicSpline(along, points_m, axis=0, bc_type="natural")
        else:
            slope = (points_m[1] - points_m[0]) / along[1]
            spline = scipy.interpolate.CubicSpline(along, points_m, axis=0, bc_type=((1, slope), (1, slope)))
        count = max(round(along[-1] / STEP_M), 2) + 1
        knots = np.linspace(0.0, along[-1], count)
        self.points_m: Floats = spline(knots)
        self.station_m: Floats = lengths_along(self.points_m)
        slope = spline(knots, 1)
        self.tangent = slope / np.maximum(np.hypot(slope[:, 0], slope[:, 1]), 1e-9)[:, None]
        bend = spline(knots, 2)
        speed = np.maximum(np.hypot(slope[:, 0], slope[:, 1]), 1e-3)
        self.curvature_per_m: Floats = (slope[:, 0] * bend[:, 1] - slope[:, 1] * bend[:, 0]) / speed**3
        self._step_m = float(self.station_m[-1]) / (count - 1)

    @property
    def length_m(self) -> float:
        """[m]"""
        return float(self.station_m[-1])

    def points_at(self, station_m: Floats) -> tuple[Floats, Floats]:
        """Points and unit tangents at stations; straight beyond the ends. Shapes (N, 2). [m]"""
        place = np.clip(station_m / self._step_m, 0, len(self.station_m) - 1 - 1e-9)
        i = place.astype(np.int64)
        u = (place - i)[:, None]
        p, t = self.points_m, self.tangent
        tangent = t[i] * (1 - u) + t[i + 1] * u
        # cubic Hermite interpolation between stations
        a, b, h = p[i], p[i + 1], self._step_m
        point = (
            a * ((1 + 2 * u) * (1 - u) ** 2)
            + b * (u * u * (3 - 2 * u))
            + h * (t[i] * (u * (1 - u) ** 2) + t[i + 1] * (u * u * (u - 1)))
        )
        beyond = station_m - np.clip(station_m, 0, self.length_m)
        return point + tangent * beyond[:, None], tangent

    def offset_points(self, station_m: Floats, left_m: Floats) -> Floats:
        """Points at offsets to the left of stations, shape (N, 2). [m]"""
        point, tangent = self.points_at(station_m)
        return point + left_normals(tangent) * left_m[:, None]

    def refine_stations(self, points_m: Floats, station_m: Floats) -> tuple[Floats, Floats]:
        """Station and left offset of points, by Newton's method from approximate stations. [m]"""
        station = station_m.copy()
        for _ in range(_MAX_NEWTON_STEPS):
            point, tangent = self.points_at(station)
            step = np.sum((points_m - point) * tangent, 1)
            station = station + np.clip(step, -_MAX_NEWTON_STEP_M, _MAX_NEWTON_STEP_M)
            if not len(step) or np.abs(step).max() < _NEWTON_TOLERANCE_M:
                break
        off = points_m - point
        return station, tangent[:, 0] * off[:, 1] - tangent[:, 1] * off[:, 0]

    def project(self, points_m: Floats) -> tuple[Floats, Floats]:
        """Station and left offset of points, on the nearest leg of the line. [m]"""
        _, index = scipy.spatial.cKDTree(self.points_m).query(points_m)
        return self.refine_stations(points_m, self.station_m[index])

    def project_markers(self, points_m: Floats, side: Ints, half_width_m: float) -> tuple[Floats, Floats]:
        """Station and left offset of markers on the lane's boundaries. [m]

        Where the line passes a marker twice, the leg is chosen whose offset is closest to half a lane width on the
        marker's side.
        """
        tree = scipy.spatial.cKDTree(self.points_m)
        near = min(_NEAREST_STATIONS, len(self.points_m))
        far, index = (np.asarray(found) for found in tree.query(points_m, k=near))
        first = index[:, :1]
        other = np.abs(self.station_m[index] - self.station_m[first]) > _SEPARATE_LEG_M
        other &= far < far[:, :1] + 3 * half_width_m
        station, left = self.refine_stations(points_m, self.station_m[first[:, 0]])
        rows = np.flatnonzero(other.any(1))
        if len(rows):
            second = index[rows, np.argmax(other[rows], 1)]
            station_2, left_2 = self.refine_stations(points_m[rows], self.station_m[second])
            errors = [_boundary_error(value, side[rows], half_width_m) for value in (left_2, left[rows])]
            better = errors[0] < errors[1]
            station[rows[better]], left[rows[better]] = station_2[better], left_2[better]
        return station, left


def _boundary_error(left_m: Floats, side: Ints, half_width_m: float) -> Floats:
    """Distance of offsets from the boundary of the side, or from the nearer boundary where the side is unknown. [m]"""
    to_left, to_right = np.abs(left_m - half_width_m), np.abs(left_m + half_width_m)
    return np.where(side == LEFT, to_left, np.where(side == RIGHT, to_right, np.minimum(to_left, to_right)))


# === The lane as the CERPM paper fits it: a cubic spline through the markers of each side, and midpoints.
#
# Source: Kadav et al., Sensors 2024, 24, 2327, section 2.2 (Data Processing) with equation 1. Every marker is used, and
# every spline runs through all markers of its side; where markers are missing, the spline interpolates. The paper does
# not define the order of markers: here it is their station along the track, or along the other markers.


_HALF_WIDTH_M = 1.65  # [m] source: half of `LaneRules.usual_width_m`


class SplineBoundaries(NamedTuple):
    """Left and right boundary, shape (N, 2) each [m], and the side of each marker, shape (M,)."""

    left_m: Floats
    right_m: Floats
    side: Ints


def boundaries_by_splines(points_m: Floats, side: Ints, taken: Bools, line: SmoothLine) -> SplineBoundaries | None:
    """Boundaries with equal numbers of points; None where a side has fewer than two markers.

    Parameters
    ----------
    points_m : ndarray, shape (M, 2)
        Markers in the plane. [m]
    side : ndarray of int, shape (M,)
        `LaneSide` as sent; where it is unknown, the side of the line on which the marker is.
    taken : ndarray of bool, shape (M,)
        Markers no two of which share a place.
    line : SmoothLine
        Along the lane, in the direction of travel.
    """
    station, left = line.project_markers(points_m, side, _HALF_WIDTH_M)
    found = np.where(side != UNKNOWN, side, np.where(left > 0, LEFT, RIGHT))
    chains = [_chain(points_m, station, taken & (found == which)) for which in (LEFT, RIGHT)]
    if min(len(chain) for chain in chains) < 2:
        return None
    count = max(int(max(lengths_along(chain)[-1] for chain in chains) / STEP_M), 2) + 1
    left_m, right_m = (_spline(chain, count) for chain in chains)
    return SplineBoundaries(left_m, right_m, np.where(taken, found, UNKNOWN))


def _chain(points_m: Floats, station_m: Floats, which: Bools) -> Floats:
    """Some markers, by station."""
    rows = np.flatnonzero(which)
    return points_m[rows[np.argsort(station_m[rows], kind="stable")]]


def _spline(chain_m: Floats, count: int) -> Floats:
    """Equation 1 over the length of the chain, at even steps."""
    along = lengths_along(chain_m)
    return np.asarray(scipy.interpolate.CubicSpline(along, chain_m, axis=0)(np.linspace(0, along[-1], count)))
