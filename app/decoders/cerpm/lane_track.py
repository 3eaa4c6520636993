"""The vehicle's own track as a first line along the lane, and as measurements beside a line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from app.decoders.cerpm.lane_banded import factor, gram, solve
from app.decoders.cerpm.lane_frame import plane_from_wgs84
from app.decoders.cerpm.lane_line import Line
from app.decoders.cerpm.lane_types import Bools, Floats
from app.sensors.pose_track import PoseTrack

_JERK_M_S3 = 1.5  # of a car in a bend, over a second
_APART_M = 3.0
_PAUSE_S = 5.0
_BIN_S = 0.2
_WILD = 6.0  # standard deviations
_LEAST_SIGMA_M = 0.02
_NEAR_M = 1000.0


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """A track in the plane.

    Attributes
    ----------
    line : Line
        Along the fixes, smoothed.
    fix_m : ndarray, shape (F, 2)
        Fixes without the wild ones, at most one each metre. [m]
    sigma_m : float
        Standard deviation of a fix, from one to the next. [m]
    accuracy_m : float
        What the receiver says of itself; NaN where it says nothing. [m]
    """

    line: Line
    fix_m: Floats
    sigma_m: float
    accuracy_m: float


def drive_from_track(track: PoseTrack, origin: tuple[float, float], markers_m: Floats) -> Drive | None:
    """A track near the markers as a drive; None where it does not move, or is nowhere near them.

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
    low, high = markers_m.min(0) - _NEAR_M, markers_m.max(0) + _NEAR_M
    near = ((fixes > low) & (fixes < high)).all(1)
    if near.sum() < 3:
        return None
    time, fixes, stated = track.time_s[near], fixes[near], track.accuracy_m[near]
    time_binned, binned, counts = _binned(time, fixes)
    if len(binned) < 4:
        return None
    sigma = _noise(fixes)
    told = float(np.median(stated[np.isfinite(stated)])) if np.isfinite(stated).any() else float("nan")
    loose = max(sigma, 0.1 * min(max(told, 0.0), 10.0)) if np.isfinite(told) else sigma
    smooth = _smoothed(time_binned, binned, counts, loose)
    smooth, wild = _without_wild(time_binned, binned, counts, smooth, loose)
    kept = _advancing(smooth[~wild])
    if len(kept) < 2:
        return None
    fine = _advancing(fixes, 1.0) if sigma < 0.25 else fixes
    return Drive(Line(kept), fine, max(sigma, _LEAST_SIGMA_M), told)


def _binned(time_s: Floats, fixes_m: Floats) -> tuple[Floats, Floats, Floats]:
    """Means over fifths of a second; pauses are shortened, so that a parked vehicle costs nothing."""
    pause = np.diff(time_s)
    clock = np.concatenate([[0.0], np.cumsum(np.minimum(pause, _PAUSE_S))])
    _, which, counts = np.unique((clock / _BIN_S).astype(np.int64), return_inverse=True, return_counts=True)
    total = np.stack([np.bincount(which, fixes_m[:, k]) for k in range(2)], 1)
    return np.bincount(which, clock) / counts, total / counts[:, None], counts.astype(float)


def _noise(fixes_m: Floats) -> float:
    """Standard deviation of a fix from one to the next, by third differences."""
    if len(fixes_m) < 8:
        return _LEAST_SIGMA_M
    third = np.diff(fixes_m, 3, axis=0)
    return max(float(1.4826 * np.median(np.abs(third)) / np.sqrt(20.0)), 0.5 * _LEAST_SIGMA_M)


def _smoothed(time_s: Floats, binned_m: Floats, weight: Floats, sigma_m: float) -> Floats:
    """The smoothest course near the means: its third derivative in time is what a car can do."""
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


def _without_wild(
    time_s: Floats, binned_m: Floats, weight: Floats, smooth_m: Floats, sigma_m: float
) -> tuple[Floats, Bools]:
    """The course without fixes that jump out of it, and which those are."""
    wild = np.zeros(len(time_s), bool)
    for _ in range(3):
        off = np.hypot(*(binned_m - smooth_m).T)
        limit = _WILD * max(sigma_m, 1.4826 * float(np.median(off[~wild])))
        now = off > limit
        if (now == wild).all() or now.mean() > 0.3:
            break
        wild = now
        smooth_m = _smoothed(time_s, binned_m, np.where(wild, 1e-6, weight), sigma_m)
    return smooth_m, wild


def _advancing(points_m: Floats, apart_m: float = _APART_M) -> Floats:
    """Points that are at least so far from the one kept before."""
    kept = [0]
    x, y = points_m[:, 0].tolist(), points_m[:, 1].tolist()
    at_x, at_y, square = x[0], y[0], apart_m**2
    for i in range(1, len(x)):
        if (x[i] - at_x) ** 2 + (y[i] - at_y) ** 2 >= square:
            kept.append(i)
            at_x, at_y = x[i], y[i]
    return points_m[kept]
