"""WGS 84 positions in a local plane, and back."""

from __future__ import annotations

import numpy as np
import pymap3d

from app.geodesy.ellipsoid import WGS84_A_M, metres_per_radian
from app.lanes.types import Floats


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
