"""The lane as the CERPM paper fits it: a cubic spline through the markers of each side, and midpoints.

Source: Kadav et al., Sensors 2024, 24, 2327, section 2.2 (Data Processing) with equation 1. Every marker is believed,
and every spline runs through all of its markers; what is missing on a side is what the spline makes of it. The paper
does not say how markers are ordered: here by their place along the track, or along the other markers.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from app.decoders.cerpm.lane_line import STEP_M, Line, lengths_along
from app.decoders.cerpm.lane_types import LEFT, RIGHT, UNKNOWN, Bools, Floats, Ints


def boundaries_by_splines(points_m: Floats, side: Ints, taken: Bools, line: Line) -> tuple[Floats, Floats, Ints] | None:
    """Left and right boundary at as many points each, and each marker's side; None where a side has no two markers.

    Parameters
    ----------
    points_m : ndarray, shape (M, 2)
        Markers in the plane. [m]
    side : ndarray of int, shape (M,)
        `LaneSide`; where it is not named, the side of the line on which the marker lies.
    taken : ndarray of bool, shape (M,)
        Markers no two of which share a place.
    line : Line
        Along the lane, in the direction of travel.
    """
    station, left = line.find(points_m, side, 1.65)
    found = np.where(side != UNKNOWN, side, np.where(left > 0, LEFT, RIGHT))
    chains = [_chain(points_m, station, taken & (found == which)) for which in (LEFT, RIGHT)]
    if min(len(chain) for chain in chains) < 2:
        return None
    count = max(int(max(lengths_along(chain)[-1] for chain in chains) / STEP_M), 2) + 1
    left_m, right_m = (_spline(chain, count) for chain in chains)
    return left_m, right_m, np.where(taken, found, UNKNOWN)


def _chain(points_m: Floats, station_m: Floats, which: Bools) -> Floats:
    rows = np.flatnonzero(which)
    return points_m[rows[np.argsort(station_m[rows], kind="stable")]]


def _spline(chain_m: Floats, count: int) -> Floats:
    """Equation 1 over the length of the chain, at even steps."""
    along = lengths_along(chain_m)
    return np.asarray(CubicSpline(along, chain_m, axis=0)(np.linspace(0, along[-1], count)))
