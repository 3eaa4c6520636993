"""The vehicle's own track: an initial line along the lane, and measurements beside a line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from app.lanes.banded_matrix import factor, gram, solve
from app.lanes.local_plane import plane_from_wgs84
from app.lanes.smooth_line import SmoothLine
from app.lanes.types import Bools, Floats
from app.sensors.pose_track import PoseTrack

_JERK_M_S3 = 1.5  # [m/s^3] of a car in a bend, over a second; source: by hand, sensitivity 1.00, 0.99
_POINT_SPACING_M = 3.0  # [m] between points of the line; source: the knots of `least_squares.KNOT_M`
_MAX_PAUSE_S = 5.0  # [s] longer pauses are shortened to this; source: by hand, no effect on moving vehicles
_BIN_S = 0.2  # [s] fixes are averaged over this; source: 2.8 m at 50 km/h, about one bin a knot
_WILD_SIGMAS = 6.0  # fixes further off are left out; source: six sigma, never by chance in a drive
_MAX_WILD_SHARE = 0.3  # more wild fixes are not wild but the track's usual error; source: by hand, no measurement kept
_MIN_SIGMA_M = 0.02  # [m] source: RTK receivers, CERPM paper, section 2.2
_NEAR_MARKERS_M = (
    1000.0  # [m] the track beyond is not used; source: several times the radio range of 340 m (paper, 4.1)
)
_FINE_TRACK_M = 0.25  # [m] below this noise, one fix a metre is enough; source: by hand, sensitivity 1.00, 1.00
_SLOW_TO_WHITE = 0.1  # minimum noise over reported accuracy; source: by hand, sensitivity 1.00, 1.00
_MAX_ACCURACY_M = 10.0  # [m] larger reported accuracies count as this; source: by hand, no measurement kept
TRUSTED_TRACK_M = (
    0.5  # [m] reported accuracy below which a track shows the side of a single row; source: by hand: a third of
)
# the 1.65 m from the centre to a boundary
_MAD_TO_SIGMA = 1.4826  # source: normal distribution, 1 / 0.6745


@dataclass(frozen=True, slots=True, eq=False)
class DrivenLine:
    """A track in the plane.

    Attributes
    ----------
    line : SmoothLine
        Along the fixes, smoothed.
    fix_m : ndarray, shape (F, 2)
        Fixes without outliers, at most one each metre. [m]
    sigma_m : float
        Standard deviation from one fix to the next. [m]
    accuracy_m : float
        As reported by the receiver; NaN if it reports none. [m]
    """

    line: SmoothLine
    fix_m: Floats
    sigma_m: float
    accuracy_m: float


def driven_line_from_track(track: PoseTrack, origin: tuple[float, float], markers_m: Floats) -> DrivenLine | None:
    """The part of a track near the markers; None if it does not move or is nowhere near them.

    Parameters
    ----------
    track : PoseTrack
    origin : tuple of float
        lon_deg, lat_deg of the plane.
    markers_m : ndarray, shape (K, 2)
        In the plane. [m]
    """
    if len(track.time_s) < 3 or (np.abs(track.lat_deg) > 90).any():
        return None
    fixes = plane_from_wgs84(track.lon_deg, track.lat_deg, origin)
    low, high = markers_m.min(0) - _NEAR_MARKERS_M, markers_m.max(0) + _NEAR_MARKERS_M
    near = ((fixes > low) & (fixes < high)).all(1)
    if near.sum() < 3:
        return None
    time, fixes, stated = track.time_s[near], fixes[near], track.accuracy_m[near]
    time_binned, binned, counts = _average_bins(time, fixes)
    if len(binned) < 4:
        return None
    sigma = _noise(fixes)
    accuracy = float(np.median(stated[np.isfinite(stated)])) if np.isfinite(stated).any() else float("nan")
    slow = _SLOW_TO_WHITE * min(max(accuracy, 0.0), _MAX_ACCURACY_M)
    smoothing = max(sigma, slow) if np.isfinite(accuracy) else sigma
    smooth, wild = _smooth_without_outliers(time_binned, binned, counts, smoothing)
    kept = _thin_out(smooth[~wild], _POINT_SPACING_M)
    if len(kept) < 2:
        return None
    fine = _thin_out(fixes, 1.0) if sigma < _FINE_TRACK_M else fixes
    return DrivenLine(SmoothLine(kept), fine, max(sigma, _MIN_SIGMA_M), accuracy)


def _average_bins(time_s: Floats, fixes_m: Floats) -> tuple[Floats, Floats, Floats]:
    """Time, mean position and count of fixes in bins; long pauses are shortened, so a parked vehicle adds no bins."""
    pause = np.diff(time_s)
    clock = np.concatenate([[0.0], np.cumsum(np.minimum(pause, _MAX_PAUSE_S))])
    _, which, counts = np.unique((clock / _BIN_S).astype(np.int64), return_inverse=True, return_counts=True)
    total = np.stack([np.bincount(which, fixes_m[:, k]) for k in range(2)], 1)
    return np.bincount(which, clock) / counts, total / counts[:, None], counts.astype(float)


def _noise(fixes_m: Floats) -> float:
    """Standard deviation from one fix to the next, from third differences: 1 + 9 + 9 + 1 = 20 variances. [m]"""
    if len(fixes_m) < 8:
        return _MIN_SIGMA_M
    third = np.diff(fixes_m, 3, axis=0)
    return max(float(_MAD_TO_SIGMA * np.median(np.abs(third)) / np.sqrt(20.0)), 0.5 * _MIN_SIGMA_M)


def _smoothed(time_s: Floats, binned_m: Floats, weight: Floats, sigma_m: float) -> Floats:
    """The smoothest course near the means: its third derivative in time is limited by the jerk of a car."""
    n = len(time_s)
    k = np.arange(n - 3)[:, None] + np.arange(4)
    t = time_s[k]
    spread = np.stack(
        [1 / np.prod(np.where(np.arange(4) == j, 1.0, t[:, [j]] - t), axis=1) for j in range(4)], 1
    )  # divided differences: a sixth of the third derivative
    length = (t[:, 3] - t[:, 0]) / 3
    matrix = gram(k, 6 * spread, length / _JERK_M_S3**2, n, 3)
    matrix[0] += weight / sigma_m**2
    return solve(factor(matrix), binned_m * (weight / sigma_m**2)[:, None])


def _smooth_without_outliers(time_s: Floats, binned_m: Floats, weight: Floats, sigma_m: float) -> tuple[Floats, Bools]:
    """The smoothed course without fixes that jump out of it, and which fixes those are."""
    smooth_m = _smoothed(time_s, binned_m, weight, sigma_m)
    wild = np.zeros(len(time_s), bool)
    for _ in range(3):
        off = np.hypot(*(binned_m - smooth_m).T)
        limit = _WILD_SIGMAS * max(sigma_m, _MAD_TO_SIGMA * float(np.median(off[~wild])))
        now = off > limit
        if (now == wild).all() or now.mean() > _MAX_WILD_SHARE:
            break
        wild = now
        smooth_m = _smoothed(time_s, binned_m, np.where(wild, 1e-6, weight), sigma_m)
    return smooth_m, wild


def _thin_out(points_m: Floats, spacing_m: float) -> Floats:
    """Points that are at least this far from the one kept before."""
    kept = [0]
    x, y = points_m[:, 0].tolist(), points_m[:, 1].tolist()
    at_x, at_y, square = x[0], y[0], spacing_m**2
    for i in range(1, len(x)):
        if (x[i] - at_x) ** 2 + (y[i] - at_y) ** 2 >= square:
            kept.append(i)
            at_x, at_y = x[i], y[i]
    return points_m[kept]
