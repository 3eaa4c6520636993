"""The ellipsoid, local frames, bearings, and checks of longitudes and latitudes."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import numpy.typing as npt
import pymap3d
from pyproj import Geod

from app.errors import InvalidParameter
from app.values import Floats

# === The WGS 84 ellipsoid: its size, and lengths of small angles on it.


WGS84_A_M = 6378137.0  # [m] semi-major axis; source: NGA.STND.0036 (WGS 84), table 3.1
WGS84_E2 = 0.0066943799901413165  # first eccentricity squared; source: NGA.STND.0036, table 3.3, from 1/298.257223563


def metres_per_radian(lat_rad: Floats) -> tuple[Floats, Floats]:
    """East and north lengths of a radian of longitude and latitude at latitudes, each of the same shape. [m]

    Notes
    -----
    Radii of curvature in the prime vertical (times the cosine of the latitude) and in the meridian.
    """
    curve = 1 - WGS84_E2 * np.sin(lat_rad) ** 2
    return np.cos(lat_rad) * WGS84_A_M / np.sqrt(curve), WGS84_A_M * (1 - WGS84_E2) / curve**1.5


def ecef_from_wgs84(lon_deg: Floats, lat_deg: Floats) -> Floats:
    """Earth-centred coordinates of places on the ellipsoid, shape (N, 3). [m]"""
    lon, lat = np.radians(lon_deg), np.radians(lat_deg)
    normal = WGS84_A_M / np.sqrt(1 - WGS84_E2 * np.sin(lat) ** 2)
    east, north = normal * np.cos(lat) * np.cos(lon), normal * np.cos(lat) * np.sin(lon)
    return np.stack([east, north, normal * (1 - WGS84_E2) * np.sin(lat)], axis=-1)


# === Local frames, bearings, and checks of longitudes and latitudes.


def enu_from_wgs84(
    lon_deg: npt.ArrayLike, lat_deg: npt.ArrayLike, height_m: npt.ArrayLike, origin: tuple[float, float, float]
) -> npt.NDArray[np.float64]:
    """East, north, up from an origin (lon_deg, lat_deg, ellipsoidal height_m), shape (3,) or (3, K). [m]"""
    return np.array(pymap3d.geodetic2enu(lat_deg, lon_deg, height_m, origin[1], origin[0], origin[2]), dtype=float)


def wgs84_from_enu(
    position_enu_m: npt.NDArray[np.float64], origin: tuple[float, float, float]
) -> tuple[float, float, float]:
    """Longitude [deg], latitude [deg], ellipsoidal height [m] of a point in a local east, north, up frame."""
    east, north, up = (float(v) for v in position_enu_m)
    lat, lon, height = pymap3d.enu2geodetic(east, north, up, origin[1], origin[0], origin[2])
    return (float(lon) + 180.0) % 360.0 - 180.0, float(lat), float(height)


def lon_lat_from_enu(
    points_enu_m: npt.NDArray[np.float64], origin: tuple[float, float, float]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Longitudes and latitudes of points of a local frame, shape (..., 3), east, north, up. [deg]"""
    east, north, up = np.moveaxis(points_enu_m, -1, 0)
    lat, lon, _height = pymap3d.enu2geodetic(east, north, up, origin[1], origin[0], origin[2])
    return (np.asarray(lon) + 180.0) % 360.0 - 180.0, np.asarray(lat)


def enu_from_heading(heading_deg: float) -> npt.NDArray[np.float64]:
    """Rotation from (right, forward, up) of a body with this heading to (east, north, up), shape (3, 3)."""
    h = math.radians(heading_deg)
    return np.array([[math.cos(h), math.sin(h), 0], [-math.sin(h), math.cos(h), 0], [0, 0, 1.0]])


def check_lon_lat(lon_deg: float, lat_deg: float, field: str = "position") -> None:
    """Raises InvalidParameter if a longitude or latitude is out of range or not finite."""
    for name, value, bound in (("lon_deg", lon_deg, 180.0), ("lat_deg", lat_deg, 90.0)):
        if not math.isfinite(value) or not -bound <= value <= bound:
            raise InvalidParameter(
                f"{name} is {value}, outside -{bound:g} to {bound:g} degrees",
                field=f"{field}.{name}",
                limit=f"-{bound:g} to {bound:g} deg",
                cure="positions are longitude, latitude in degrees; check for swapped axes or another CRS",
            )


def distance_m(lon_a_deg: float, lat_a_deg: float, lon_b_deg: float, lat_b_deg: float) -> float:
    """Geodesic distance on WGS 84. [m]"""
    return float(ellipsoid().inv(lon_a_deg, lat_a_deg, lon_b_deg, lat_b_deg)[2])


@lru_cache
def ellipsoid() -> Geod:
    """WGS 84, for geodesics."""
    return Geod(ellps="WGS84")
