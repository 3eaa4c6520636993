"""A lane's centre line as cubic curves, with profiles along it: what OpenDRIVE calls a road's reference line."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from app.planning.alignment import Floats, Lane
from app.planning.outputs.hd_map import refine_breaks

CURVE_ERROR_M = 0.002
"""Greatest distance of the curves from the lane's samples, and of heights and widths from theirs. [m] Source: chosen by
hand, a fifth of the centimetre that maps may be off."""
_TILT_ERROR_RAD = 0.0002  # [rad] of superelevation; source: 2 mm at 10 m beside the line
_ROUNDS = 12  # of Newton's method; source: converges to a nanometre in 5 from a sample half a metre away
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(7)


@dataclass(frozen=True, slots=True, eq=False)
class Profile:
    """Cubic polynomials along a line, each in the distance from its start.

    Attributes
    ----------
    s : ndarray, shape (P,)
        Starts. [m]
    coefficients : ndarray, shape (P, 4)
        a, b, c, d of a + b x + c x^2 + d x^3.
    """

    s: Floats
    coefficients: Floats

    def at(self, s: Floats) -> Floats:
        """Values at distances, shape (K,)."""
        piece = np.clip(np.searchsorted(self.s, s, side="right") - 1, 0, len(self.s) - 1)
        a, b, c, d = self.coefficients[piece].T
        x = s - self.s[piece]
        return np.asarray(a + x * (b + x * (c + x * d)))


class Foot(NamedTuple):
    """Points by the line: s, t (left positive), what s and t leave of the distance [m], and the line's direction."""

    s: Floats
    t: Floats
    residual_m: Floats
    heading_rad: Floats


class ReferenceLine:
    """The centre line of a lane in a plane.

    Attributes
    ----------
    lane : Lane
    xy : ndarray, shape (N, 2)
        The lane's samples. [m]
    breaks : ndarray of int, shape (P + 1,)
        Samples at which the curves begin and end.
    start_xy, start_heading, start_s, lengths : ndarray, shape (P, 2), (P,), (P,), (P,)
        Of the curves; headings counter-clockwise from x. [m, rad, m, m]
    local : ndarray, shape (P, 3, 2)
        Coefficients b, c, d of each curve in its own frame, p from 0 to 1; b has no v.
    width, elevation, superelevation : Profile or None
        None where heights are unknown, and where the road is nowhere tilted.
    """

    def __init__(self, lane: Lane, x: Floats, y: Floats) -> None:
        self.lane = lane
        self.xy = np.column_stack([x, y])
        chainage = lane.chainage_m
        self._slope = np.asarray(scipy.interpolate.CubicSpline(chainage, self.xy)(chainage, 1))
        whole = np.array([0, len(chainage) - 1])
        self.breaks = refine_breaks(whole, self._error, CURVE_ERROR_M)
        self._b, self._c, self._d = _hermite(chainage, self.xy, self._slope, self.breaks)
        self.start_xy = self.xy[self.breaks[:-1]]
        self.start_heading = np.arctan2(self._b[:, 1], self._b[:, 0])
        cos, sin = np.cos(self.start_heading), np.sin(self.start_heading)
        turn = np.stack([np.stack([cos, sin], 1), np.stack([-sin, cos], 1)], 1)
        self.local = np.einsum("pij,pkj->pki", turn, np.stack([self._b, self._c, self._d], 1))
        p = ((_NODES + 1) / 2)[:, None]
        tangent = self._b[:, None] + p * (2 * self._c[:, None] + 3 * p * self._d[:, None])
        self.lengths = np.asarray(np.linalg.norm(tangent, axis=2) @ _WEIGHTS / 2)
        ends = np.concatenate([[0.0], np.cumsum(self.lengths)])
        self.start_s, self.length = ends[:-1], float(ends[-1])
        s = np.interp(chainage, chainage[self.breaks], ends)
        self._s = s
        self.width = _profile(s, lane.width_m, CURVE_ERROR_M)
        known = bool(np.isfinite(lane.height_m).all())
        self.elevation = _profile(s, lane.height_m, CURVE_ERROR_M) if known else None
        tilted = bool(np.any(lane.superelevation_rad != 0))
        self.superelevation = _profile(s, lane.superelevation_rad, _TILT_ERROR_RAD) if tilted else None

    @property
    def ends(self) -> tuple[Floats, Floats]:
        """Start and end with their heights, 0 where unknown, each of shape (3,). [m]"""
        points = np.column_stack([self.xy, np.nan_to_num(self.lane.height_m)])
        return points[0], points[-1]

    def speeds_kmh(self) -> list[tuple[float, float]]:
        """s from which a design speed holds, and the speed; none where a part of the lane has none. [m, km/h]"""
        if not np.isfinite(self.lane.design_speed_mps).all():
            return []  # a speed of OpenDRIVE holds until the next one
        speed = np.round(self.lane.design_speed_mps * 3.6)
        first = np.flatnonzero(np.concatenate([[True], np.diff(speed) != 0]))
        return list(zip(self._s[first].tolist(), speed[first].tolist(), strict=True))

    def project(self, points_m: Floats, chainage_m: Floats) -> Foot:
        """Points beside the line, from the chainages of samples near them.

        Parameters
        ----------
        points_m : ndarray, shape (K, 2)
        chainage_m : ndarray, shape (K,)
        """
        starts = self.lane.chainage_m[self.breaks]
        chainage = np.array(chainage_m)
        for _ in range(_ROUNDS):
            piece, p = self._piece(starts, chainage)
            away, first, second = self._away(points_m, piece, p)
            slope = np.einsum("ij,ij->i", first, first) + np.einsum("ij,ij->i", away, second)
            step = np.einsum("ij,ij->i", away, first) / np.where(slope > 0, slope, np.inf)
            chainage = np.clip(chainage - step * np.diff(starts)[piece], starts[0], starts[-1])
        piece, p = self._piece(starts, chainage)
        away, first, _second = self._away(points_m, piece, p)
        tangent = first / np.linalg.norm(first, axis=1)[:, None]
        t = tangent[:, 1] * away[:, 0] - tangent[:, 0] * away[:, 1]
        residual = np.abs(np.einsum("ij,ij->i", away, tangent))
        s = self.start_s[piece] + p * self.lengths[piece]
        return Foot(s, t, residual, np.arctan2(tangent[:, 1], tangent[:, 0]))

    def _piece(self, starts: Floats, chainage_m: Floats) -> tuple[npt.NDArray[np.intp], Floats]:
        piece = np.clip(np.searchsorted(starts, chainage_m, side="right") - 1, 0, len(starts) - 2)
        return piece, (chainage_m - starts[piece]) / np.diff(starts)[piece]

    def _away(self, points_m: Floats, piece: npt.NDArray[np.intp], p: Floats) -> tuple[Floats, Floats, Floats]:
        """From points to the curves, and the curves' derivatives, each of shape (K, 2)."""
        b, c, d, q = self._b[piece], self._c[piece], self._d[piece], p[:, None]
        on_curve = self.start_xy[piece] + q * (b + q * (c + q * d))
        return on_curve - points_m, b + q * (2 * c + 3 * q * d), 2 * c + 6 * q * d

    def _error(self, breaks: npt.NDArray[np.intp]) -> Floats:
        return np.asarray(np.linalg.norm(_hermite_error(self.lane.chainage_m, self.xy, self._slope, breaks), axis=1))


def _profile(s: Floats, values: Floats, limit: float) -> Profile:
    """Values at distances as cubic polynomials, within a limit at each of them."""
    column = values[:, None]
    slope = np.gradient(values, s)[:, None] if len(s) > 1 else np.zeros((1, 1))

    def error_of(breaks: npt.NDArray[np.intp]) -> Floats:
        return np.abs(_hermite_error(s, column, slope, breaks)[:, 0])

    breaks = refine_breaks(np.array([0, len(s) - 1]), error_of, limit)
    b, c, d = _hermite(s, column, slope, breaks)
    h = np.diff(s[breaks])[:, None]
    return Profile(s[breaks[:-1]], np.hstack([column[breaks[:-1]], b / h, c / h**2, d / h**3]))


def _hermite(at: Floats, values: Floats, slopes: Floats, breaks: npt.NDArray[np.intp]) -> tuple[Floats, Floats, Floats]:
    """Coefficients b, c, d of the cubic curves between breaks in p from 0 to 1, each of shape (P, columns)."""
    h = np.diff(at[breaks])[:, None]
    rise = np.diff(values[breaks], axis=0)
    first, last = h * slopes[breaks[:-1]], h * slopes[breaks[1:]]
    return first, 3 * rise - 2 * first - last, first + last - 2 * rise


def _hermite_error(at: Floats, values: Floats, slopes: Floats, breaks: npt.NDArray[np.intp]) -> Floats:
    """Cubic curves between breaks minus the values at all samples, shape (N, columns)."""
    b, c, d = _hermite(at, values, slopes, breaks)
    piece = np.clip(np.searchsorted(breaks, np.arange(len(at)), side="right") - 1, 0, len(breaks) - 2)
    p = ((at - at[breaks[piece]]) / np.diff(at[breaks])[piece])[:, None]
    return np.asarray(values[breaks[piece]] + p * (b[piece] + p * (c[piece] + p * d[piece])) - values)
