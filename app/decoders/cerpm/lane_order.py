"""A first line along markers when there is no track: their spanning tree's longest way, smoothed."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components, dijkstra, minimum_spanning_tree
from scipy.spatial import cKDTree

from app.decoders.cerpm.lane_banded import factor, gram, solve
from app.decoders.cerpm.lane_line import Line, lengths_along
from app.decoders.cerpm.lane_types import LEFT, RIGHT, UNKNOWN, Bools, Floats, Ints

_NEIGHBOURS = 10
_BEND = 0.002  # change of curvature over a metre that the first line is given, 1/m^2 sqrt(m)
_FIRST_SIGMA_M, _SIDED_SIGMA_M = 1.6, 0.3
_BESIDE_M = 8.0
_ROUNDS = 3
_ROW_M = 0.4


def connected(points_m: Floats, bridge_m: float) -> Bools:
    """Which markers belong to the largest group that steps of at most `bridge_m` hold together, shape (K,)."""
    tree = _spanning(points_m)
    tree.data[tree.data > bridge_m] = 0
    tree.eliminate_zeros()
    _, group = connected_components(tree, directed=False)
    return np.asarray(group == np.argmax(np.bincount(group)))


def line_through(points_m: Floats, side: Ints, half_width_m: float) -> Line | None:
    """A line near the lane's centre through markers in no order; None where they have no length, or
    are one row without sides.

    Parameters
    ----------
    points_m : ndarray, shape (K, 2)
        No two alike. [m]
    side : ndarray of int, shape (K,)
        `LaneSide` where it is named. The line runs so that left is left.
    half_width_m : float
        [m]
    """
    way = _longest_way(points_m)
    if len(way) < 2 or lengths_along(points_m[way])[-1] < 2 * half_width_m:
        return None
    spine = points_m[way]
    along = lengths_along(spine)
    far, nearest = (np.asarray(found) for found in cKDTree(spine).query(points_m))
    near = far < _BESIDE_M
    sided = side if (side != UNKNOWN).sum() > 1 else np.zeros_like(side)
    line = _smooth(points_m[near], along[nearest[near]], _FIRST_SIGMA_M)
    if line is None or (not sided.any() and _one_row(points_m[near], along[nearest[near]])):
        return None
    for _ in range(_ROUNDS):
        station, left = line.find(points_m, sided, half_width_m)
        known = sided != UNKNOWN
        if known.any() and np.sum(np.where(sided == LEFT, left, -left)[known & near] > 0) * 2 < np.sum(known & near):
            line = Line(line.points_m[::-1])
            station, left = line.find(points_m, sided, half_width_m)
        sign = np.where(sided == LEFT, 1.0, np.where(sided == RIGHT, -1.0, 0.0 if known.any() else np.sign(left)))
        _, tangent = line.at(station)
        normal = np.stack([-tangent[:, 1], tangent[:, 0]], 1)
        centred = points_m - normal * (sign * half_width_m)[:, None]
        near = np.abs(left - sign * half_width_m) < _BESIDE_M
        if near.sum() < 2:
            break
        better = _smooth(centred[near], station[near], _SIDED_SIGMA_M if known.any() else _FIRST_SIGMA_M / 2)
        if better is None:
            break
        line = better
    return line


def _one_row(points_m: Floats, station_m: Floats) -> bool:
    """Whether one smooth line runs through all markers: nothing tells on which side of it the lane is."""
    line = _smooth(points_m, station_m, _SIDED_SIGMA_M)
    return line is None or float(np.median(np.abs(line.nearest(points_m)[1]))) < _ROW_M


def _spanning(points_m: Floats) -> csr_array:
    k = min(_NEIGHBOURS, len(points_m) - 1)
    far, index = (np.asarray(found) for found in cKDTree(points_m).query(points_m, k=k + 1))
    rows = np.repeat(np.arange(len(points_m)), k)
    graph = coo_array((np.maximum(far[:, 1:], 1e-6).ravel(), (rows, index[:, 1:].ravel())), (len(points_m),) * 2)
    return minimum_spanning_tree(graph.tocsr())


def _longest_way(points_m: Floats) -> Ints:
    """Markers along the longest way through the spanning tree of the largest group."""
    tree = _spanning(points_m)
    _, group = connected_components(tree, directed=False)
    start = int(np.flatnonzero(group == np.argmax(np.bincount(group)))[0])
    reach = dijkstra(tree, directed=False, indices=[start])[0]
    end = int(np.argmax(np.where(np.isfinite(reach), reach, -1)))
    reach, before = (found[0] for found in dijkstra(tree, directed=False, indices=[end], return_predecessors=True))
    at = int(np.argmax(np.where(np.isfinite(reach), reach, -1)))
    way = [at]
    while at != end and before[at] >= 0:
        at = int(before[at])
        way.append(at)
    return np.array(way)


def _smooth(points_m: Floats, station_m: Floats, sigma_m: float) -> Line | None:
    """The line of least change of curvature near points at stations."""
    start, end = float(station_m.min()), float(station_m.max())
    if end - start < 2.0:
        return None
    count = max(int((end - start) / 3.0) + 1, 5)
    knot = (end - start) / (count - 1)
    place = np.clip((station_m - start) / knot, 0, count - 1 - 1e-9)
    i = place.astype(np.int64)
    share = place - i
    index, value = np.stack([i, i + 1], 1), np.stack([1 - share, share], 1)
    weight = np.full(len(points_m), sigma_m**-2.0)
    k = np.arange(count - 3)[:, None] + np.arange(4)
    third = np.broadcast_to(np.array([-1.0, 3.0, -3.0, 1.0]), k.shape)
    matrix = gram(index, value, weight, count, 3) + gram(k, third, np.ones(len(k)), count, 3) / knot**5 / _BEND**2
    k = np.arange(count - 2)[:, None] + np.arange(3)  # keeps few markers solvable
    second = np.broadcast_to(np.array([1.0, -2.0, 1.0]), k.shape)
    matrix += gram(k, second, np.full(len(k), 1e-2), count, 3)
    matrix[0] += 1e-9 * matrix[0].max()
    right = np.zeros((count, 2))
    for axis in range(2):
        right[:, axis] = np.bincount(
            index.ravel(), (value * (weight * points_m[:, axis])[:, None]).ravel(), minlength=count
        )
    course = solve(factor(matrix), right)
    if lengths_along(course)[-1] < 2.0 or (np.hypot(*np.diff(course, axis=0).T) < 1e-3).any():
        return None
    return Line(course)
