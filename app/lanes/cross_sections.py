"""A lane between two surveyed boundaries: its cross-sections, centre line and curvature.

Boundaries are polylines as surveys and maps give them: vertices from millimetres to more than a hundred metres apart,
kinks, ends that are not opposite each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from app.errors import InvalidParameter
from app.values import Floats

WIDTH_M = (1.5, 12.0)  # [m] narrowest and widest lane; a cycle lane and a wide ramp
MAX_LENGTH_M = 200_000.0  # [m] bounds the time of a cut
MAX_POINTS = 1_000_000  # bounds the memory of a cut
_STEPS = 12  # of the search for a normal's intersection
_MET_M = 1e-9  # [m] step with which the search has converged; source: far below a survey's accuracy
_ROUNDS = 3  # source: below a millimetre on lanes with radii of 10 m and more (`cut_lane`)


@dataclass(frozen=True, slots=True, eq=False)
class CrossSections:
    """A lane cut square to its centre line at even steps."""

    chainage_m: Floats  # shape (N,): [m] along the centre line from the first cut that meets both boundaries
    # `centre_m`, `left_m`, `right_m`: shape (N, 2): [m] east and north where a cut meets the centre line and the
    # boundaries; the centre is halfway between the two
    centre_m: Floats
    left_m: Floats
    right_m: Floats
    yaw_rad: Floats  # shape (N,): [rad] direction of the smoothed centre line, anticlockwise from east, unwrapped
    curvature_per_m: Floats  # shape (N,): [1/m] of the smoothed centre line, positive to the left
    # `along_left_m`, `along_right_m`: shape (N,): [m] chainages on the boundaries where the cut meets them
    along_left_m: Floats
    along_right_m: Floats

    @property
    def width_m(self) -> Floats:
        """Of the lane, shape (N,). [m]"""
        return np.asarray(np.linalg.norm(self.left_m - self.right_m, axis=1))

    @property
    def length_m(self) -> float:
        """Of the centre line. [m]"""
        return float(self.chainage_m[-1])


def cut_lane(
    left_m: npt.ArrayLike, right_m: npt.ArrayLike, *, step_m: float = 0.5, smoothing_m: float = 2.2
) -> CrossSections:
    """Cut a lane square to its centre line.

    Parameters
    ----------
    left_m, right_m : array_like, shape (L, 2) and (R, 2)
        East and north of the boundaries' vertices in direction of travel, in one local frame. [m]
    step_m : float
        Between cuts. [m]
    smoothing_m : float
        Standard deviation of the Gaussian that smooths direction and curvature along the lane: a polyline has
        curvature only at its kinks. [m]

    Raises
    ------
    InvalidParameter
        A boundary has fewer than two distinct points or one that is not finite; they cross, run in opposite directions,
        or are nowhere a lane width apart; the lane is longer than 200 km or has over a million cuts.

    Notes
    -----
    A cut is where the normal of the centre line meets the boundaries; the centre line is halfway, which moves the
    normals: after three rounds both change by less than a millimetre on lanes with radii of 10 m and more.
    """
    left, right = read_polyline(left_m, "left_m"), read_polyline(right_m, "right_m")
    along_left, along_right = chainages_m(left), chainages_m(right)
    length = max(along_left[-1], along_right[-1])
    if not step_m > 0 or length > MAX_LENGTH_M or length / step_m > MAX_POINTS:
        raise InvalidParameter(
            f"a lane of {length:.0f} m in steps of {step_m:g} m",
            field="step_m",
            limit=f"steps above zero, at most {MAX_LENGTH_M / 1000:g} km and {MAX_POINTS} steps",
            cure="give the lane in parts",
        )
    _check_direction(left, right)
    shares = np.linspace(0.0, 1.0, max(int(length / step_m), 8) + 1)
    at_left, at_right = shares * along_left[-1], shares * along_right[-1]
    for _ in range(_ROUNDS):
        centre = (point_at(left, along_left, at_left) + point_at(right, along_right, at_right)) / 2
        along = chainages_m(centre)
        even = np.linspace(0.0, along[-1], len(shares))
        centre = point_at(centre, along, even)
        yaw = direction_rad(centre, even[1], smoothing_m)
        at_left = _meet(left, along_left, np.interp(even, along, at_left), centre, yaw)
        at_right = _meet(right, along_right, np.interp(even, along, at_right), centre, yaw)
    met = _between_ends(at_left, along_left[-1]) & _between_ends(at_right, along_right[-1])
    cut_left, cut_right = point_at(left, along_left, at_left)[met], point_at(right, along_right, at_right)[met]
    _check_width(cut_left, cut_right, yaw[met])
    return _sections(cut_left, cut_right, at_left[met], at_right[met], smoothing_m)


def read_polyline(line_m: npt.ArrayLike, field: str) -> Floats:
    """Vertices of a polyline without repeated ones, shape (N, 2), N >= 2. [m]

    Raises
    ------
    InvalidParameter
        It has another shape, a value that is not finite, or less than two distinct points.
    """
    line = np.asarray(line_m, float)
    if line.ndim != 2 or line.shape[1] != 2 or len(line) < 2 or not np.isfinite(line).all():
        raise InvalidParameter(
            f"{field} is not a line of finite points", field=field, limit="east and north of at least two points"
        )
    distinct = np.concatenate([[True], np.linalg.norm(np.diff(line, axis=0), axis=1) > 1e-6])
    line = line[distinct]
    if len(line) < 2:
        raise InvalidParameter(f"{field} is one point", field=field, limit="at least two distinct points")
    return np.asarray(line)


def chainages_m(line_m: Floats) -> Floats:
    """Along a polyline at its vertices, shape (N,). [m]"""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line_m, axis=0), axis=1))])


def point_at(line_m: Floats, along_m: Floats, chainage_m: Floats) -> Floats:
    """Points of a polyline at chainages, shape (K, 2); straight beyond its ends. [m]"""
    points = np.stack([np.interp(chainage_m, along_m, line_m[:, k]) for k in range(2)], axis=1)
    for outside, end, inner in ((chainage_m < along_m[0], 0, 1), (chainage_m > along_m[-1], -1, -2)):
        if outside.any():
            slope = (line_m[end] - line_m[inner]) / (along_m[end] - along_m[inner])
            points[outside] = line_m[end] + (chainage_m[outside] - along_m[end])[:, None] * slope
    return points


def direction_rad(points_m: Floats, step_m: float, smoothing_m: float) -> Floats:
    """Direction of evenly spaced points, Gaussian-smoothed along the line, unwrapped, shape (N,). [rad]"""
    delta = np.diff(points_m, axis=0)
    turn = np.unwrap(np.arctan2(delta[:, 1], delta[:, 0]))
    reach = int(4 * smoothing_m / step_m) + 1
    extended = np.concatenate([_extrapolated(turn[::-1], reach)[::-1], turn, _extrapolated(turn, reach)])
    smooth = scipy.ndimage.gaussian_filter1d(extended, smoothing_m / step_m)[reach - 1 : len(turn) + reach + 1]
    return np.asarray((smooth[:-1] + smooth[1:]) / 2)


def _extrapolated(turn: Floats, count: int) -> Floats:
    """Directions after the last one, with the same rate of turn."""
    known = turn[-count:]
    if len(known) < 2:
        return np.full(count, known[-1])
    slope, start = np.polyfit(np.arange(len(known)), known, 1)
    return np.asarray(start + slope * np.arange(len(known), len(known) + count))


def _meet(line: Floats, along: Floats, start: Floats, centre: Floats, yaw: Floats) -> Floats:
    """Chainages at which a boundary meets the normals of the centre line, by fixed-point iteration."""
    ahead = np.stack([np.cos(yaw), np.sin(yaw)], 1)
    at = start
    for _ in range(_STEPS):
        step = np.einsum("ij,ij->i", point_at(line, along, at) - centre, ahead)
        at = at - step
        if np.abs(step).max() < _MET_M:
            break
    return np.maximum.accumulate(at)


def _between_ends(at: Floats, length: float) -> npt.NDArray[np.bool_]:
    return np.asarray((at > -1e-3) & (at < length + 1e-3))


def _sections(
    left: Floats, right: Floats, along_left: Floats, along_right: Floats, smoothing_m: float
) -> CrossSections:
    centre = (left + right) / 2
    along = chainages_m(centre)
    even = np.linspace(0.0, along[-1], len(along))
    left, right = (np.stack([np.interp(even, along, side[:, k]) for k in range(2)], 1) for side in (left, right))
    along_left, along_right = np.interp(even, along, along_left), np.interp(even, along, along_right)
    centre = (left + right) / 2
    yaw = direction_rad(centre, even[1], smoothing_m)
    return CrossSections(even, centre, left, right, yaw, np.gradient(yaw, even), along_left, along_right)


def _check_direction(left: Floats, right: Floats) -> None:
    same = np.linalg.norm(left[0] - right[0]) + np.linalg.norm(left[-1] - right[-1])
    swapped = np.linalg.norm(left[0] - right[-1]) + np.linalg.norm(left[-1] - right[0])
    if swapped < same:
        raise InvalidParameter(
            "the boundaries run in opposite directions",
            field="right_m",
            limit="both in direction of travel",
            cure="turn one of them round",
        )


def _check_width(left: Floats, right: Floats, yaw: Floats) -> None:
    across = left - right
    width = across[:, 1] * np.cos(yaw) - across[:, 0] * np.sin(yaw)
    if len(width) < 8 or not ((width >= WIDTH_M[0]) & (width <= WIDTH_M[1])).all():
        found = f"{width.min():.2f} to {width.max():.2f} m apart" if len(width) else "nowhere opposite each other"
        raise InvalidParameter(
            f"the boundaries are {found}",
            field="left_m",
            limit=f"{WIDTH_M[0]:g} to {WIDTH_M[1]:g} m, the left one on the left",
            cure="check which boundary is the left one, and that both belong to one lane",
        )
