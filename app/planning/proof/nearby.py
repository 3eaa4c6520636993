"""Markers of a plan beside a lane, whatever lane they were placed for."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import scipy

from app.geodesy.ellipsoid import ecef_from_wgs84
from app.planning.alignment import Floats, Lane
from app.planning.plan import PlannedMarker

BesideLane = tuple[PlannedMarker, float, float]
"""A marker with its chainage and its offset on a lane, left positive. [m]"""


class LaneFrame:
    """A lane's samples with directions along and to the left, to find chainage and offset of positions."""

    def __init__(self, lane: Lane) -> None:
        self.lane = lane
        self._points = ecef_from_wgs84(lane.lon_deg, lane.lat_deg)
        along = np.gradient(self._points, axis=0)
        self._along = along / np.linalg.norm(along, axis=1)[:, None]
        up = self._points / np.linalg.norm(self._points, axis=1)[:, None]  # to 0.2 deg, no matter over some metres
        self._left = np.cross(up, self._along)

    @cached_property
    def _tree(self) -> scipy.spatial.cKDTree:
        return scipy.spatial.cKDTree(self._points)

    def project(self, lon_deg: Floats, lat_deg: Floats, reach_m: float) -> tuple[Floats, Floats]:
        """Chainage and offset, left positive, each shape (K,); NaN farther than a reach from the centre line. [m]"""
        places = ecef_from_wgs84(lon_deg, lat_deg)
        away, nearest = self._tree.query(places, distance_upper_bound=reach_m + self.lane.step_m)
        found = np.isfinite(away)
        at = np.where(found, nearest, 0)
        off = places - self._points[at]
        chainage = self.lane.chainage_m[at] + np.einsum("ij,ij->i", off, self._along[at])
        left = np.einsum("ij,ij->i", off, self._left[at])
        return np.where(found, chainage, np.nan), np.where(found, left, np.nan)


def markers_beside(frame: LaneFrame, markers: Sequence[PlannedMarker], reach_m: float) -> list[BesideLane]:
    """Markers within a reach of a lane with their chainage and offset on it, by chainage. [m]"""
    if not markers:
        return []
    chainage, left = frame.project(
        np.array([marker.lon_deg for marker in markers]), np.array([marker.lat_deg for marker in markers]), reach_m
    )
    found = [(markers[k], float(chainage[k]), float(left[k])) for k in np.flatnonzero(np.isfinite(chainage)).tolist()]
    return sorted(found, key=lambda one: (one[1], one[0].number))
