"""Pairs of markers across from each other: each pair shows the direction of the lane.

Source: the CERPM paper, section 3.2, places markers in pairs, as raised markers usually are. Whether these markers are
placed in pairs is found from their positions; nothing is concluded from a single pair. A marker that was set a metre
along its own line lies on its boundary and is no outlier, but makes the pair oblique. Such a pair shows no
direction; it is recognised by the pairs beside it, and by the lane that the other markers
show (`LaneFit`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from app.lanes.types import LEFT, RIGHT, Floats, Ints


class Pairs(NamedTuple):
    """Pairs of markers along a line, each shape (P,).

    Attributes
    ----------
    station_m : ndarray
        [m]
    slope : ndarray
        Of the lane's centre against the line.
    sigma : ndarray
        Its standard deviation, if the pair was set as carefully as most are.
    cautious_sigma : ndarray
        Larger where the slope differs from those of the pairs beside it: the lane bends there, or the pair is oblique.
    """

    station_m: Floats
    slope: Floats
    sigma: Floats
    cautious_sigma: Floats


_MIN_PAIRS = 4  # source: by hand, sensitivity 1.00, 1.00
_MIN_PAIRED_SHARE = 0.7  # of mutual neighbours that stand close together; source: by hand, sensitivity 1.00, 3.17
_MAX_STAGGER_SHARE = 0.12  # of the spacing; source: by chance 2 x 0.12, one in four, are as close
_PLACING_SIGMA_M = 0.012  # [m] of placing by hand; source: `simulation.radio.markers._PLACING_SD_M` on two axes
_MAX_STAGGER_M = 4.0  # [m] source: a third of the paper's spacing of 12.2 m (40 ft)
_MIN_ROW_STAGGER_M = 0.1  # [m] of one row ahead of the other; source: by hand, sensitivity 1.00, 1.00
_ROW_STAGGER_Z = 3.0  # and by this many standard errors; source: three sigma, one false alarm in 370
_MAD_TO_SIGMA = 1.4826  # source: normal distribution, 1 / 0.6745
_NEIGHBOURS = 5  # pairs that a pair is compared with, itself included; source: two of five may be wrong
_NEIGHBOURS_WITHIN_M = 120.0  # [m] further apart, the lane bends between them; source: decision 0016, five at 24.4 m
_OUTLIER_SIGMAS = 3.0  # from which on a pair counts less; source: three sigma, one false alarm in 370


def find_pairs(station_m: Floats, left_m: Floats, side: Ints, sigma_m: Floats) -> Pairs:
    """The pairs among markers beside a line; none where the markers do not stand in pairs.

    Parameters
    ----------
    station_m, left_m : ndarray, shape (M,)
        [m]
    side : ndarray of int, shape (M,)
        `LaneSide`; markers of unknown side are not used.
    sigma_m : ndarray, shape (M,)
        Of the survey. [m]
    """
    none = Pairs(np.empty(0), np.empty(0), np.empty(0), np.empty(0))
    left, right = (np.flatnonzero(side == which) for which in (LEFT, RIGHT))
    if min(len(left), len(right)) < 2:
        return none
    left, right = left[np.argsort(station_m[left])], right[np.argsort(station_m[right])]
    across = right[nearest_sorted(station_m[right], station_m[left])]
    back = left[nearest_sorted(station_m[left], station_m[across])]
    mutual = back == left
    spacing = min(float(np.median(np.diff(station_m[chain]))) for chain in (left, right))
    ahead = station_m[left] - station_m[across]
    close = mutual & (np.abs(ahead) < min(_MAX_STAGGER_SHARE * spacing, _MAX_STAGGER_M))
    if close.sum() < max(_MIN_PAIRS, _MIN_PAIRED_SHARE * mutual.sum()) or _is_staggered(ahead[close]):
        return none
    a, b = left[close], across[close]
    width = np.maximum(left_m[a] - left_m[b], 1.0)
    placing_m = max(np.sqrt(2) * _PLACING_SIGMA_M, _spread_m(ahead[close]))
    sigma = np.sqrt(sigma_m[a] ** 2 + sigma_m[b] ** 2 + placing_m**2) / width
    middle, slope = (station_m[a] + station_m[b]) / 2, -ahead[close] / width
    return Pairs(middle, slope, sigma, _cautious_sigma(middle, slope, sigma))


def _cautious_sigma(station_m: Floats, slope: Floats, sigma: Floats) -> Floats:
    """Standard deviations, as large as the difference of each pair that differs from the median of those beside it."""
    order = np.argsort(station_m)
    size = min(_NEIGHBOURS, len(order))
    first = np.clip(np.arange(len(order)) - size // 2, 0, len(order) - size)
    usual = np.empty(len(order))
    usual[order] = np.median(slope[order][first[:, None] + np.arange(size)], axis=1)
    near = np.empty(len(order), bool)
    near[order] = station_m[order][first + size - 1] - station_m[order][first] < _NEIGHBOURS_WITHIN_M
    off = np.abs(slope - usual)
    return np.where(near & (off > _OUTLIER_SIGMAS * sigma), np.hypot(sigma, off), sigma)


def _is_staggered(ahead_m: Floats) -> bool:
    """Whether one row as a whole is ahead of the other: then the line across a pair is not square to the lane."""
    error_m = 1.25 * _spread_m(ahead_m) / np.sqrt(len(ahead_m))  # the median's error is 1.25 times the mean's
    return abs(float(np.median(ahead_m))) > max(_MIN_ROW_STAGGER_M, float(_ROW_STAGGER_Z * error_m))


def _spread_m(ahead_m: Floats) -> float:
    """Robust standard deviation of how far one marker of a pair is ahead of the other. [m]"""
    return _MAD_TO_SIGMA * float(np.median(np.abs(ahead_m - np.median(ahead_m))))


def nearest_sorted(sorted_m: Floats, wanted_m: Floats) -> Ints:
    """Index of the nearest of sorted values, at least two, for each wanted one."""
    above = np.clip(np.searchsorted(sorted_m, wanted_m), 1, len(sorted_m) - 1)
    return np.where(wanted_m - sorted_m[above - 1] <= sorted_m[above] - wanted_m, above - 1, above)
