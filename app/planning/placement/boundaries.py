"""Boundaries of lanes as lines on the road: one that two lanes share is found, so that it is marked once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from app.geodesy.ellipsoid import ecef_from_wgs84
from app.markers.cerpm import LaneSide
from app.planning.alignment import Floats, Lane

SAME_LINE_M = 0.6
"""Boundaries nearer than this are one line. [m] Source: chosen by hand, above the width of a double line."""


class Stretch(NamedTuple):
    """Part of a boundary that no lane before it has: samples of the lane, and distances along it. [m]"""

    lane: Lane
    side: LaneSide
    offset_m: Floats
    first: int
    last: int
    along_m: Floats

    @property
    def length_m(self) -> float:
        """Along the boundary, which is longer than the lane outside of bends. [m]"""
        return float(self.along_m[self.last] - self.along_m[self.first])

    def chainages_m(self, spacing_m: float) -> Floats:
        """Chainages of the fewest points at even distances along the boundary, both ends among them, shape (K,). [m]"""
        count = max(int(np.ceil(self.length_m / spacing_m - 1e-9)) + 1, 2)
        at = self.along_m[self.first] + np.linspace(0.0, self.length_m, count)
        part = slice(self.first, self.last + 1)
        return np.asarray(np.interp(at, self.along_m[part], self.lane.chainage_m[part]))


class Boundaries:
    """Boundaries that are known so far."""

    def __init__(self) -> None:
        self._trees: list[scipy.spatial.cKDTree] = []
        self._sides: list[tuple[str, LaneSide]] = []
        self.shared_as_other_side: set[tuple[str, LaneSide]] = set()
        """Boundaries (lane, side) that are the other side of another lane."""

    def add(self, lane: Lane, side: LaneSide, shift_m: float = 0.0) -> list[Stretch]:
        """Stretches of a lane's boundary, shifted to the left by `shift_m`, that no earlier boundary covers."""
        sign = 1.0 if side is LaneSide.LEFT else -1.0
        offset = sign * lane.width_m / 2 + shift_m
        points = ecef_from_wgs84(*lane.position_at(lane.chainage_m, offset))
        reach_m = float(np.hypot(SAME_LINE_M, lane.step_m))
        covered = np.zeros(len(points), dtype=bool)
        for tree, (other, other_side) in zip(self._trees, self._sides, strict=True):
            near = np.isfinite(tree.query(points, distance_upper_bound=reach_m)[0])
            covered |= near
            if near.mean() > 0.5 and other_side is not side:
                self.shared_as_other_side.add((other, other_side))
        self._trees.append(scipy.spatial.cKDTree(points))
        self._sides.append((lane.name, side))
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        return [Stretch(lane, side, offset, first, last, along) for first, last in _runs(~covered)]


def _runs(flags: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last index of each run of flags that are set."""
    edges = np.flatnonzero(np.diff(flags.astype(np.int8), prepend=0, append=0))
    return [(int(start), int(end) - 1) for start, end in zip(edges[::2], edges[1::2], strict=True)]
