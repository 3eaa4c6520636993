"""An initial line: along the vehicle's track, or through the longest path of the markers' spanning tree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from app.lanes.least_squares import difference_gram, factor, gather, gram, solve
from app.lanes.smooth_line import SmoothLine, left_normals, lengths_along, plane_from_wgs84, without_wild_fixes
from app.lanes.types import LEFT, RIGHT, UNKNOWN
from app.sensors.pose_track import PoseTrack
from app.values import Bools, Floats, Ints

_NEIGHBOURS = 10  # of each marker in the graph; sensitivity 1.00, 1.00
_BEND = 0.002  # [1/(m^2 sqrt(m))] change of curvature over a metre; sensitivity 1.01, 0.97
_UNSIDED_SIGMA_M = 1.6  # [m] of markers about the centre before sides are known; source: half the usual width of 3.3 m
_SIDED_SIGMA_M = 0.3  # [m] of markers moved to the centre; sensitivity 0.98, 1.01
_MAX_BESIDE_M = 8.0  # [m] markers further from the line are not of this lane; sensitivity 1.00, 1.00
_ROUNDS = 3  # of moving markers to the centre; sensitivity 1.00, 1.00
_SINGLE_ROW_M = 0.4  # [m] median distance below which all markers are one row; sensitivity 1.00, 1.00
_KNOT_M = 3.0  # [m] source: `least_squares.KNOT_M`
_MIN_LENGTH_M = 2.0  # [m] source: shorter lines have fewer than two knots


def largest_group(points_m: Floats, bridge_m: float) -> Bools:
    """Which markers belong to the largest group that steps of at most `bridge_m` connect, shape (K,)."""
    tree = _spanning_tree(points_m)
    tree.data[tree.data > bridge_m] = 0
    tree.eliminate_zeros()
    _, group = scipy.sparse.csgraph.connected_components(tree, directed=False)
    return np.asarray(group == np.argmax(np.bincount(group)))


def fit_initial_line(points_m: Floats, side: Ints, half_width_m: float) -> SmoothLine | None:
    """A line near the lane's centre through markers in no order.

    Parameters
    ----------
    points_m : ndarray, shape (K, 2)
        No two alike. [m]
    side : ndarray of int, shape (K,)
        `LaneSide` as sent by the markers. The line runs in the direction in which left is left.
    half_width_m : float
        [m]

    Returns
    -------
    SmoothLine or None
        None where the markers have no length, or are one row without sides.
    """
    path = _longest_path(points_m)
    if len(path) < 2 or lengths_along(points_m[path])[-1] < 2 * half_width_m:
        return None
    spine = points_m[path]
    along = lengths_along(spine)
    far, nearest = (np.asarray(found) for found in scipy.spatial.cKDTree(spine).query(points_m))
    near = far < _MAX_BESIDE_M
    sided = side if (side != UNKNOWN).sum() > 1 else np.zeros_like(side)
    line = _smooth(points_m[near], along[nearest[near]], _UNSIDED_SIGMA_M)
    if line is None or (not sided.any() and is_single_row(points_m[near], along[nearest[near]])):
        return None
    return _centred(line, points_m, sided, near, half_width_m)


def _centred(line: SmoothLine, points_m: Floats, side: Ints, near: Bools, half_width_m: float) -> SmoothLine:
    """The line moved to the lane's centre: markers are moved by half a width towards it, and smoothed again."""
    known = side != UNKNOWN
    sigma_m = _SIDED_SIGMA_M if known.any() else _UNSIDED_SIGMA_M / 2
    for _ in range(_ROUNDS):
        station, left = line.project_markers(points_m, side, half_width_m)
        if known.any() and np.sum(np.where(side == LEFT, left, -left)[known & near] > 0) * 2 < np.sum(known & near):
            line = SmoothLine(line.points_m[::-1])
            station, left = line.project_markers(points_m, side, half_width_m)
        sign = np.where(side == LEFT, 1.0, np.where(side == RIGHT, -1.0, 0.0 if known.any() else np.sign(left)))
        normal = left_normals(line.points_at(station)[1])
        centred = points_m - normal * (sign * half_width_m)[:, None]
        near = np.abs(left - sign * half_width_m) < _MAX_BESIDE_M
        if near.sum() < 2:
            break
        better = _smooth(centred[near], station[near], sigma_m)
        if better is None:
            break
        line = better
    return line


def is_single_row(points_m: Floats, station_m: Floats) -> bool:
    """Whether one smooth line runs through all markers: nothing shows on which side of it the lane is."""
    line = _smooth(points_m, station_m, _SIDED_SIGMA_M)
    return line is None or float(np.median(np.abs(line.project(points_m)[1]))) < _SINGLE_ROW_M


def _spanning_tree(points_m: Floats) -> scipy.sparse.csr_array:
    k = min(_NEIGHBOURS, len(points_m) - 1)
    far, index = (np.asarray(found) for found in scipy.spatial.cKDTree(points_m).query(points_m, k=k + 1))
    rows = np.repeat(np.arange(len(points_m)), k)
    graph = scipy.sparse.coo_array(
        (np.maximum(far[:, 1:], 1e-6).ravel(), (rows, index[:, 1:].ravel())), (len(points_m),) * 2
    )
    return scipy.sparse.csgraph.minimum_spanning_tree(graph.tocsr())


def _longest_path(points_m: Floats) -> Ints:
    """Markers along the longest path through the spanning tree of the largest group."""
    tree = _spanning_tree(points_m)
    _, group = scipy.sparse.csgraph.connected_components(tree, directed=False)
    start = int(np.flatnonzero(group == np.argmax(np.bincount(group)))[0])
    reach = scipy.sparse.csgraph.dijkstra(tree, directed=False, indices=[start])[0]
    end = int(np.argmax(np.where(np.isfinite(reach), reach, -1)))
    reach, before = (
        found[0]
        for found in scipy.sparse.csgraph.dijkstra(tree, directed=False, indices=[end], return_predecessors=True)
    )
    at = int(np.argmax(np.where(np.isfinite(reach), reach, -1)))
    path = [at]
    while at != end and before[at] >= 0:
        at = int(before[at])
        path.append(at)
    return np.array(path)


def _smooth(points_m: Floats, station_m: Floats, sigma_m: float) -> SmoothLine | None:
    """The line of least change of curvature near points at approximate stations; None where it has no length."""
    start, end = float(station_m.min()), float(station_m.max())
    if end - start < _MIN_LENGTH_M:
        return None
    count = max(int((end - start) / _KNOT_M) + 1, 5)
    knot = (end - start) / (count - 1)
    place = np.clip((station_m - start) / knot, 0, count - 1 - 1e-9)
    i = place.astype(np.int64)
    share = place - i
    index, value = np.stack([i, i + 1], 1), np.stack([1 - share, share], 1)
    weight = np.full(len(points_m), sigma_m**-2.0)
    matrix = gram(index, value, weight, count, 3) + difference_gram(3, count, 3) / knot**5 / _BEND**2
    matrix += difference_gram(2, count, 3) * 1e-2  # keeps few markers solvable
    matrix[0] += 1e-9 * matrix[0].max()
    right = np.stack([gather(index, value, weight * points_m[:, axis], count) for axis in range(2)], 1)
    course = solve(factor(matrix), right)
    if lengths_along(course)[-1] < _MIN_LENGTH_M or (np.hypot(*np.diff(course, axis=0).T) < 1e-3).any():
        return None
    return SmoothLine(course)


# === The vehicle's own track: an initial line along the lane, and measurements beside a line.


_JERK_M_S3 = 1.5  # [m/s^3] of a car in a bend, over a second; sensitivity 1.00, 0.99
_POINT_SPACING_M = 3.0  # [m] between points of the line; source: the knots of `least_squares.KNOT_M`
_MAX_PAUSE_S = 5.0  # [s] longer pauses are shortened to this; no effect on moving vehicles
_BIN_S = 0.2  # [s] fixes are averaged over this; source: 2.8 m at 50 km/h, about one bin a knot
_WILD_SIGMAS = 6.0  # fixes further off are left out; source: six sigma, never by chance in a drive
_MAX_WILD_SHARE = 0.3  # more wild fixes are not wild but the track's usual error
_JUMP_WITHIN_S = 1.0  # [s] a step between fixes farther apart may be the vehicle's
_HARDEST_M_S2 = 20.0  # [m/s2] twice a full braking, since fixes are not evenly spaced
_MIN_SIGMA_M = 0.02  # [m] source: RTK receivers, CERPM paper, section 2.2
_NEAR_MARKERS_M = (
    1000.0  # [m] the track beyond is not used; source: several times the radio range of 340 m (paper, 4.1)
)
_FINE_TRACK_M = 0.25  # [m] below this noise, one fix a metre is enough; sensitivity 1.00, 1.00
_SLOW_TO_WHITE = 0.1  # minimum noise over reported accuracy; sensitivity 1.00, 1.00
_MAX_ACCURACY_M = 10.0  # [m] larger reported accuracies count as this
TRUSTED_TRACK_M = 0.5  # [m] reported accuracy below which a track shows the side of a single row; a third of
# the 1.65 m from the centre to a boundary
_MAD_TO_SIGMA = 1.4826  # source: normal distribution, 1 / 0.6745


@dataclass(frozen=True, slots=True, eq=False)
class DrivenLine:
    """A track in the plane."""

    line: SmoothLine  # along the fixes, smoothed
    fix_m: Floats  # shape (F, 2): [m] fixes without outliers, at most one each metre
    sigma_m: float  # [m] standard deviation from one fix to the next
    accuracy_m: float  # [m] as reported by the receiver; NaN if it reports none
    speed_m_s: float  # [m/s] mean
    jump_m: float  # [m] largest step that no vehicle makes, as where a reflected signal appears; 0 without one


def driven_line_from_track(track: PoseTrack, origin: tuple[float, float], markers_m: Floats) -> DrivenLine | None:
    """The part of a track near the markers; None if it does not move or is nowhere near them.

    Parameters
    ----------
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
    line = SmoothLine(kept)
    speed = line.length_m / max(float(np.ptp(time_binned)), _BIN_S)
    return DrivenLine(line, fine, max(sigma, _MIN_SIGMA_M), accuracy, speed, _largest_jump_m(time, fixes, sigma))


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


def _largest_jump_m(time_s: Floats, fixes_m: Floats, sigma_m: float) -> float:
    """The largest step between fixes that neither their noise nor a vehicle's acceleration explains. [m]"""
    step_s = np.maximum(np.diff(time_s), 1e-3)
    fixes_m = without_wild_fixes(time_s, fixes_m)
    velocity = np.diff(fixes_m, axis=0) / step_s[:, None]
    off = np.hypot(*(np.diff(velocity, axis=0) * step_s[1:, None]).T)
    near = np.maximum(step_s[1:], step_s[:-1]) < _JUMP_WITHIN_S
    jump = off > _WILD_SIGMAS * sigma_m * np.sqrt(6.0) + _HARDEST_M_S2 * step_s[1:] ** 2
    return float(off[near & jump].max(initial=0.0))


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
