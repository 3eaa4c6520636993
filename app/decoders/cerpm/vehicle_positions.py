"""Positions of the vehicle at given times, and distances from them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from app.geodesy.ellipsoid import metres_per_radian
from app.sensors.pose_track import PoseTrack

Floats = npt.NDArray[np.float64]

MAX_GAP_S = 5.0  # [s] between poses further apart the position is unknown; source: by hand, 100 m at 72 km/h


def vehicle_positions(track: PoseTrack, time_s: npt.ArrayLike, max_gap_s: float = MAX_GAP_S) -> Floats:
    """Longitude and latitude of the vehicle at given times.

    Parameters
    ----------
    track : PoseTrack
    time_s : array_like, shape (N,)
        NaN where it is not known. [s]
    max_gap_s : float
        [s]

    Returns
    -------
    ndarray, shape (N, 2)
        Longitude, latitude; NaN before, after and in gaps of the track. [deg]
    """
    at = np.asarray(time_s, float)
    positions = np.full((len(at), 2), np.nan)
    if not len(track.time_s):
        return positions
    after = np.searchsorted(track.time_s, at, side="left").clip(0, len(track.time_s) - 1)
    before = np.maximum(np.where(track.time_s[after] == at, after, after - 1), 0)
    with np.errstate(invalid="ignore"):
        known = (at >= track.time_s[0]) & (at <= track.time_s[-1])
        known &= track.time_s[after] - track.time_s[before] <= max_gap_s
    lon = np.interp(at[known], track.time_s, np.unwrap(track.lon_deg, period=360.0))
    positions[known, 0] = (lon + 180.0) % 360.0 - 180.0
    positions[known, 1] = np.interp(at[known], track.time_s, track.lat_deg)
    return positions


def offsets_m(from_deg: npt.ArrayLike, to_deg: npt.ArrayLike) -> Floats:
    """East and north from places to others near them, on the ellipsoid; NaN where either is unknown.

    Parameters
    ----------
    from_deg, to_deg : array_like, shape (N, 2)
        Longitude, latitude. [deg]

    Returns
    -------
    ndarray, shape (N, 2)
        Accurate to 1e-5 over kilometres; of places far apart only the order of magnitude is correct. [m]
    """
    start, end = np.atleast_2d(np.asarray(from_deg, float)), np.atleast_2d(np.asarray(to_deg, float))
    lon = np.radians((end[:, 0] - start[:, 0] + 180.0) % 360.0 - 180.0)
    lat = np.radians(end[:, 1] - start[:, 1])
    middle = np.radians((end[:, 1] + start[:, 1]) / 2)
    east_per_rad, north_per_rad = metres_per_radian(middle)
    return np.stack([lon * east_per_rad, lat * north_per_rad], axis=1)


def distances_m(from_deg: npt.ArrayLike, to_deg: npt.ArrayLike) -> Floats:
    """Distances of `offsets_m`, shape (N,). [m]"""
    return np.asarray(np.hypot(*offsets_m(from_deg, to_deg).T))
