"""The WGS 84 ellipsoid: its size, and lengths of small angles on it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

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
