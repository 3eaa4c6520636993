"""The lane as the CERPM paper fits it: a cubic spline through the markers of each side, and midpoints.

Source: Kadav et al., Sensors 2024, 24, 2327, section 2.2 (Data Processing) with equation 1. Every marker is
used, and every spline runs through all markers of its side; where markers are missing, the spline interpolates. The
paper does not define the order of markers: here it is their station along the track, or along the other markers.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

from app.lanes.smooth_line import STEP_M, SmoothLine, lengths_along
from app.lanes.types import LEFT, RIGHT, UNKNOWN, Bools, Floats, Ints

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
