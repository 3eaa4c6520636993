"""Positions of the vehicle's own receiver beside markers.

Markers are surveyed and a receiver is not: positions of a receiver never decide which markers are used. The drive is
estimated by its markers first; where that track shows that positions are further off than their stated accuracy, the
accuracy is enlarged until they fit. Only then the positions take part, each gated by its distance from the track.

A receiver's error changes slowly: all positions of a minute share it, as frames of one marker share that of its survey.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import scipy

from app.tracks.measure import FixArrays
from app.tracks.types import Bools, Floats, PositionFix, ReceiverResult

if TYPE_CHECKING:
    from app.tracks.estimate import Smoothed

_MAX_DOUBLINGS = 60  # of the variance; any position on earth fits then
_NEAREST_SHARE = 0.5  # of the positions, where the track by markers is best, show how good they are; source: by hand


def is_receiver(fixes: tuple[PositionFix, ...]) -> Bools:
    """Which fixes are positions of a receiver, shape (K,)."""
    return np.array([fix.marker_id is None for fix in fixes], bool)


def with_estimated_accuracy(
    fixes: tuple[PositionFix, ...], arrays: FixArrays, by_markers: Smoothed
) -> tuple[FixArrays, Floats]:
    """Fixes with the covariance of the receivers' positions enlarged to what markers show, and the factors (K,).

    Notes
    -----
    For each source, the least power of two by which its covariances R are to be multiplied so that the median of
    r' (S + f R)^-1 r does not exceed that of the chi-square distribution with two degrees of freedom. r is the distance
    from the track by markers and S the covariance of that track, of the receiver's clock with it.
    """
    factor = np.ones(len(fixes))
    limit = float(scipy.stats.chi2.ppf(0.5, 2))
    upper = np.array([[0, 1], [1, 2]])
    own = arrays.cov_m2[:, upper]
    off, spread = by_markers.offset_m[:, :2], by_markers.spread[:, :2, :2]
    sources = np.array([fix.source if fix.marker_id is None else "" for fix in fixes])
    receiver = is_receiver(fixes)
    for source in dict.fromkeys(sources[receiver].tolist()):
        members = np.flatnonzero(receiver & (sources == source))
        size = np.linalg.det(spread[members])
        near = members[size <= np.quantile(size, _NEAREST_SHARE)]
        for doubling in range(_MAX_DOUBLINGS):
            factor[members] = 2.0**doubling
            whole = spread[near] + factor[near, None, None] * own[near]
            if np.median(np.einsum("ki,ki->k", off[near], np.linalg.solve(whole, off[near, :, None])[..., 0])) <= limit:
                break
    cov = arrays.cov_m2 * factor[:, None]
    common = np.where(receiver, (cov[:, 0] + cov[:, 2]) / 2, arrays.common_m2)
    return replace(arrays, cov_m2=cov, common_m2=common), factor


def receiver_results(fixes: tuple[PositionFix, ...], factor: Floats, used: Bools) -> tuple[ReceiverResult, ...]:
    """What became of the positions of each source."""
    found = []
    for source in dict.fromkeys(fix.source for fix in fixes if fix.marker_id is None):
        members = [k for k, fix in enumerate(fixes) if fix.marker_id is None and fix.source == source]
        stated = float(np.median([math.sqrt(fixes[k].covariance_m2[0] + fixes[k].covariance_m2[2]) for k in members]))
        count = int(used[members].sum())
        widened = math.sqrt(float(factor[members[0]]))
        found.append(
            ReceiverResult(source, fixes[members[0]].clock, count, len(members) - count, stated, stated * widened)
        )
    return tuple(found)
