"""A lane's boundaries -> places on its centre line."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from app.geodesy import enu_from_wgs84, wgs84_from_enu

_STEP_M = 0.5


@dataclass(frozen=True, slots=True)
class LanePlace:
    """A place on a lane's centre line.

    Attributes
    ----------
    lon_deg, lat_deg : float
        [deg]
    heading_deg : float
        Direction of travel, clockwise from true north. [deg]
    chainage_m : float
        Along the lane. [m]
    """

    lon_deg: float
    lat_deg: float
    heading_deg: float
    chainage_m: float


def list_lane_places(lane: dict[str, Any], chainages_m: npt.ArrayLike, height_m: float) -> list[LanePlace]:
    """Places along a lane.

    Parameters
    ----------
    lane : dict
        GeoJSON with one line string for the left and one for the right boundary (`side` L, R), in direction of travel.
    chainages_m : array_like
        From the lane's beginning. [m]
    height_m : float
        Ellipsoidal height of the road. [m]
    """
    sides = {feature["properties"]["side"]: feature["geometry"]["coordinates"] for feature in lane["features"]}
    lon_deg, lat_deg = sides["L"][0]
    origin = (lon_deg, lat_deg, height_m)
    left_m, right_m = (
        np.array([enu_from_wgs84(lon, lat, height_m, origin)[:2] for lon, lat in sides[side]]) for side in "LR"
    )
    centre_m = _centre_line(left_m, right_m)
    along_m = _chainages(centre_m)
    places = []
    for chainage in np.atleast_1d(np.asarray(chainages_m, float)):
        at, before, after = (_at(centre_m, along_m, chainage + d) for d in (0.0, -_STEP_M, _STEP_M))
        east, north = after - before
        lon, lat, _height = wgs84_from_enu(np.array([*at, 0.0]), origin)
        places.append(LanePlace(lon, lat, math.degrees(math.atan2(east, north)) % 360.0, float(chainage)))
    return places


def _centre_line(left_m: npt.NDArray[np.float64], right_m: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Midpoints of boundary points at the same share of the boundaries' lengths, shape (N, 2). [m]"""
    along_left, along_right = _chainages(left_m), _chainages(right_m)
    shares = np.linspace(0, 1, max(int(along_left[-1] / _STEP_M), 2))
    mean: npt.NDArray[np.float64] = (
        _at(left_m, along_left, shares * along_left[-1]) + _at(right_m, along_right, shares * along_right[-1])
    ) / 2
    return mean


def _chainages(line_m: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    lengths = np.linalg.norm(np.diff(line_m, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(lengths)])


def _at(
    line_m: npt.NDArray[np.float64], along_m: npt.NDArray[np.float64], chainage_m: float | npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    return np.stack([np.interp(chainage_m, along_m, line_m[:, k]) for k in range(2)], axis=-1)
