"""Lines parallel to a road's axis."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from pyproj import Geod

FloatArray = npt.NDArray[np.float64]

MAX_EDGE_M = 500.0
"""Longest edge of a line after `cut_edges`. [m] Source: a geodesic of this length is within 5 mm times the tangent of
the latitude of the straight line in longitude and latitude, by its sagitta."""
_MAX_MITRE_RAD = np.radians(170.0)  # [rad] of turn at a vertex; source: chosen by hand, a mitre of 11 offsets
_SAME_PLACE_M = 1e-4  # [m] source: as `app.roads.axis`
_GEOD = Geod(ellps="WGS84")


def cut_edges(points_deg: FloatArray) -> FloatArray:
    """A line of geodesics with vertices on them, so that no edge is longer than 500 m.

    Parameters
    ----------
    points_deg : ndarray, shape (N, 2)
        Longitude, latitude.

    Returns
    -------
    ndarray, shape (K, 2)
        The vertices, and those between them; without those at the place of the one before.
    """
    cut = [points_deg[:1]]
    lon_a, lat_a = points_deg[0].tolist()
    for lon_b, lat_b in points_deg[1:].tolist():
        length_m = _GEOD.inv(lon_a, lat_a, lon_b, lat_b)[2]
        if length_m < _SAME_PLACE_M:
            continue
        pieces = int(np.ceil(length_m / MAX_EDGE_M))
        if pieces > 1:
            cut.append(np.array(_GEOD.npts(lon_a, lat_a, lon_b, lat_b, pieces - 1)))
        cut.append(np.array([[lon_b, lat_b]]))
        lon_a, lat_a = lon_b, lat_b
    return np.concatenate(cut)


def parallel_line(points_deg: FloatArray, offset_m: float) -> FloatArray:
    """The line at an offset from another: one vertex for each, where the neighbouring edges' parallels meet.

    Parameters
    ----------
    points_deg : ndarray, shape (N, 2)
        Longitude, latitude; no two vertices at one place.
    offset_m : float
        Left positive. [m]

    Returns
    -------
    ndarray, shape (N, 2)
        Inside of bends that are tighter than the offset it crosses itself.
    """
    lon, lat = points_deg.T
    ahead, back, _ = _GEOD.inv(lon[:-1], lat[:-1], lon[1:], lat[1:])
    leaving = np.radians(np.append(ahead, np.asarray(back[-1]) + 180.0))
    arriving = np.radians(np.insert(np.asarray(back) + 180.0, 0, ahead[0]))
    turn = (leaving - arriving + np.pi) % (2 * np.pi) - np.pi
    direction = np.degrees(arriving + turn / 2)
    reach = offset_m / np.cos(np.clip(turn, -_MAX_MITRE_RAD, _MAX_MITRE_RAD) / 2)
    lon, lat, _ = _GEOD.fwd(lon, lat, direction - 90.0, reach)
    return np.column_stack([lon, lat])
