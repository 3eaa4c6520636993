"""An initial line along markers when there is no track: the longest path through their spanning tree, smoothed."""

from __future__ import annotations

import numpy as np
import scipy

from app.lanes.banded_matrix import difference_gram, factor, gather, gram, solve
from app.lanes.smooth_line import SmoothLine, left_normals, lengths_along
from app.lanes.types import LEFT, RIGHT, UNKNOWN, Bools, Floats, Ints

_NEIGHBOURS = 10  # of each marker in the graph; source: by hand, sensitivity 1.00, 1.00
_BEND = 0.002  # [1/(m^2 sqrt(m))] change of curvature over a metre; source: by hand, sensitivity 1.01, 0.97
_UNSIDED_SIGMA_M = 1.6  # [m] of markers about the centre before sides are known; source: half the usual width of 3.3 m
_SIDED_SIGMA_M = 0.3  # [m] of markers moved to the centre; source: by hand, sensitivity 0.98, 1.01
_MAX_BESIDE_M = 8.0  # [m] markers further from the line are not of this lane; source: by hand, sensitivity 1.00, 1.00
_ROUNDS = 3  # of moving markers to the centre; source: by hand, sensitivity 1.00, 1.00
_SINGLE_ROW_M = 0.4  # [m] median distance below which all markers are one row; source: by hand, sensitivity 1.00, 1.00
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
