"""Markers across from each other: where a lane's markers stand in pairs, each pair tells the direction of the lane.

Source: the CERPM paper, section 3.2, lays markers in pairs, and so do the practices of raised markers. Whether these
markers do is found from where they lie; nothing is concluded from a pair alone.
"""

from __future__ import annotations

import numpy as np

from app.decoders.cerpm.lane_types import LEFT, RIGHT, Floats, Ints

Pairs = tuple[Floats, Floats, Floats]
"""Stations of pairs, the slope of the lane's centre against the line there, and its standard deviation."""

_FEWEST = 4
_SHARE = 0.7
_CLOSE = 0.12  # of the spacing: pairs by chance are so close in one of four
_LAID_M = 0.012
_FARTHEST_M = 4.0
_LEAST_STAGGER_M, _STAGGER_Z = 0.1, 3.0


def abreast(station_m: Floats, left_m: Floats, side: Ints, sigma_m: Floats) -> Pairs:
    """The pairs among markers beside a line; none where the markers do not stand in pairs.

    Parameters
    ----------
    station_m, left_m : ndarray, shape (M,)
        [m]
    side : ndarray of int, shape (M,)
        `LaneSide`; those of unknown side are not looked at.
    sigma_m : ndarray, shape (M,)
        Of the survey. [m]
    """
    none = (np.empty(0), np.empty(0), np.empty(0))
    left, right = (np.flatnonzero(side == which) for which in (LEFT, RIGHT))
    if min(len(left), len(right)) < 2:
        return none
    left, right = left[np.argsort(station_m[left])], right[np.argsort(station_m[right])]
    across = right[_nearest(station_m[right], station_m[left])]
    back = left[_nearest(station_m[left], station_m[across])]
    mutual = back == left
    spacing = min(float(np.median(np.diff(station_m[chain]))) for chain in (left, right))
    apart = station_m[left] - station_m[across]
    close = mutual & (np.abs(apart) < min(_CLOSE * spacing, _FARTHEST_M))
    if close.sum() < max(_FEWEST, _SHARE * mutual.sum()):
        return none
    if _is_staggered(apart[close]):
        return none
    a, b = left[close], across[close]
    width = np.maximum(left_m[a] - left_m[b], 1.0)
    laid_m = max(np.sqrt(2) * _LAID_M, _spread_m(apart[close]))
    sigma = np.sqrt(sigma_m[a] ** 2 + sigma_m[b] ** 2 + laid_m**2) / width
    return (station_m[a] + station_m[b]) / 2, -apart[close] / width, sigma


def _is_staggered(apart_m: Floats) -> bool:
    """Whether one row as a whole stands ahead of the other: then a line across a pair is not square to the lane."""
    error_m = 1.25 * _spread_m(apart_m) / np.sqrt(len(apart_m))
    return abs(float(np.median(apart_m))) > max(_LEAST_STAGGER_M, float(_STAGGER_Z * error_m))


def _spread_m(apart_m: Floats) -> float:
    """Robust standard deviation of how far the markers of a pair stand apart along the line: pairs are laid by hand."""
    return 1.4826 * float(np.median(np.abs(apart_m - np.median(apart_m))))


def _nearest(sorted_m: Floats, wanted_m: Floats) -> Ints:
    """Index of the nearest of sorted values for each wanted one."""
    above = np.clip(np.searchsorted(sorted_m, wanted_m), 1, len(sorted_m) - 1)
    return np.where(wanted_m - sorted_m[above - 1] <= sorted_m[above] - wanted_m, above - 1, above)
