"""Reference lines of roads: lines, arcs, clothoids and parametric cubics, and the distances at which to sample them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from app.errors import UnreadableUpload
from app.formats.alignments.geometry import CHORD_ERROR_M, MAX_VERTICES
from app.values import Floats, Ints

MAX_STEP_M = 2.0
"""Greatest distance between vertices along the reference line. [m] Values that the file gives as polynomials, such as
widths, are linear between vertices."""
GAP_WARNING_M, GAP_ERROR_M = 0.01, 0.10
"""Distance between the end of an element and the start of the next one. [m] The accuracy of a good survey, and the
accuracy at which a marker still lies in its lane."""
NO_LENGTH_M = 1e-4
"""Shorter elements have no direction and are left out. [m] The last digit in which most programs write coordinates."""
MAX_SPIRAL_TURN_RAD = 4.0 * np.pi
"""A clothoid turns by less. [rad] The quadrature is exact to 1e-12 of its length."""
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(24)
_NODES, _WEIGHTS = (_NODES + 1.0) / 2.0, _WEIGHTS / 2.0  # on 0 to 1
_CELL_NODES, _CELL_WEIGHTS = np.polynomial.legendre.leggauss(5)
_CELL_NODES, _CELL_WEIGHTS = (_CELL_NODES + 1.0) / 2.0, _CELL_WEIGHTS / 2.0
_CELLS = 32
"""Cells of the table of arc lengths of a cubic. A cubic of 100 m is off by less than 1 um along it."""
_NEWTON = 6
"""Steps to the end of a cubic across its chord. Each doubles the digits that are right."""
_PROBES = np.linspace(0.0, 1.0, 5)
"""Where the curvature of a step is looked at."""


class Piece(NamedTuple):
    """One element of a reference line."""

    place: str  # where it is in the file, for errors
    # `s`, `length`: [m] distance of its start along the line, and its length
    s: float
    length: float
    # `x`, `y`, `hdg`: start [m] and direction there, counter-clockwise from x [rad]
    x: float
    y: float
    hdg: float
    # `k0`, `k1`: [1/m] curvature at start and end, left positive, linear between them
    k0: float = 0.0
    k1: float = 0.0
    # `u`, `v`: cubics of a parameter from 0 to 1, along and across the direction at the start; then k0 and k1 have no
    # meaning
    u: tuple[float, ...] | None = None
    v: tuple[float, ...] | None = None
    by_length: bool = False  # the cubics go on until `length` instead of to 1; u is the parameter itself


class Frame(NamedTuple):
    """Points of a reference line, each shape (N,): x, y [m], heading [rad], curvature [1/m], its rate [1/m2]."""

    x: Floats
    y: Floats
    hdg: Floats
    k: Floats
    dk: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """A reference line of n pieces, m of which are cubics."""

    # `s`, `length`, `x`, `y`, `hdg`, `k0`, `k1`: shape (n,): as in `Piece`
    s: Floats
    length: Floats
    x: Floats
    y: Floats
    hdg: Floats
    k0: Floats
    k1: Floats
    cubic: Ints  # shape (n,): row of the piece in `u`, `v`, `table`; -1 for lines, arcs and clothoids
    # `u`, `v`: shape (m, 4)
    u: Floats
    v: Floats
    table: Floats  # shape (m, 33): [m] distance along the piece at even steps of the parameter
    warnings: tuple[str, ...]

    @property
    def end_s(self) -> float:
        """Distance of the end along the line. [m]"""
        return float(self.s[-1] + self.length[-1])

    def piece_at(self, s: Floats) -> Ints:
        """Which piece a distance along the line lies in."""
        return np.asarray(np.clip(np.searchsorted(self.s, s, side="right") - 1, 0, len(self.s) - 1), dtype=np.int64)

    def evaluate(self, s: Floats, piece: Ints) -> Frame:
        """Points at distances along the line, in the pieces named, beyond whose ends nothing is extrapolated."""
        d = np.clip(s - self.s[piece], 0.0, self.length[piece])
        with np.errstate(all="ignore"):
            u, v, turn, k, dk = clothoid(d, self.k0[piece], self.k1[piece], self.length[piece])
            row = self.cubic[piece]
            if len(self.u) and (on := row >= 0).any():
                u[on], v[on], turn[on], k[on], dk[on] = self._cubics(d[on], row[on])
        hdg = self.hdg[piece]
        cos, sin = np.cos(hdg), np.sin(hdg)
        return Frame(self.x[piece] + u * cos - v * sin, self.y[piece] + u * sin + v * cos, hdg + turn, k, dk)

    def _cubics(self, d: Floats, row: Ints) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        p = _parameter(self.table, self.u, self.v, d, row)
        powers = np.stack([np.ones_like(p), p, p * p, p * p * p], axis=-1)
        cu, cv = self.u[row], self.v[row]
        u, v = (cu * powers).sum(-1), (cv * powers).sum(-1)
        (u1, u2, u3), (v1, v2, v3) = _derivatives(cu, p), _derivatives(cv, p)
        q = np.hypot(u1, v1)
        k = (u1 * v2 - v1 * u2) / q**3
        dk = ((u1 * v3 - v1 * u3) / q**3 - 3.0 * k * (u1 * u2 + v1 * v2) / q**2) / q
        return u, v, np.arctan2(v1, u1), k, dk


def build_curve(pieces: Sequence[Piece]) -> Curve:
    """A reference line of pieces in their order.

    Raises
    ------
    UnreadableUpload
        A length is not positive, a cubic stands still, a clothoid turns too far, or there is a gap above 10 cm.
    """
    for piece in pieces:
        _check_piece(piece)
    s, length, x, y, hdg, k0, k1 = np.array([piece[1:8] for piece in pieces], dtype=np.float64).T
    cubics = [piece for piece in pieces if piece.u is not None]
    cubic = np.full(len(pieces), -1, dtype=np.int64)
    cubic[[i for i, piece in enumerate(pieces) if piece.u is not None]] = np.arange(len(cubics))
    with np.errstate(all="ignore"):  # what overflows is found below
        u, v, table, warnings = _cubic_tables(cubics)
        curve = Curve(s, length, x, y, hdg, k0, k1, cubic, u, v, table, ())
        warnings += _check_joints(curve, pieces)
    return replace(curve, warnings=tuple(warnings))


def sample(breaks: Floats, bend: Callable[[Floats, Ints], Floats], place: str, lines: int = 1) -> tuple[Floats, Ints]:
    """Distances at which chords stay within 1 mm of a curve, at most 2 m apart.

    Parameters
    ----------
    breaks : ndarray, shape (m + 1,)
        Ends of the intervals within which the curve is smooth, increasing. [m]
    bend : function
        Of distances (N,) and their intervals (N,): curvature in the distances' measure. [1/m]
    place : str
        For errors.
    lines : int
        Number of lines with these vertices.

    Returns
    -------
    s : ndarray, shape (N,)
        Both ends of every interval are vertices, so every inner break stands twice. [m]
    interval : ndarray of int, shape (N,)

    Raises
    ------
    UnreadableUpload
        There would be more than `MAX_VERTICES`.
    """
    lengths = np.diff(breaks)
    cells = np.maximum(np.ceil(lengths / MAX_STEP_M - 1e-9), 1.0)
    _check_count(lines * cells.sum(), place)
    first = np.concatenate([[0], np.cumsum(cells)]).astype(np.int64)
    interval = np.repeat(np.arange(len(lengths)), np.diff(first))
    width = (lengths / cells)[interval]
    start = breaks[interval] + (np.arange(len(interval)) - first[interval]) * width
    probes = start[:, None] + width[:, None] * _PROBES
    with np.errstate(all="ignore"):
        bends = np.abs(bend(probes.ravel(), np.repeat(interval, len(_PROBES)))).reshape(probes.shape).max(axis=1)
        steps = width * np.maximum(np.sqrt(bends / (8.0 * CHORD_ERROR_M)), 1.0 / MAX_STEP_M)
    if not np.isfinite(steps).all():
        at = start[int(np.argmin(np.isfinite(steps)))]
        raise UnreadableUpload(
            f"{place}: the curvature at s {at:.3f} m is not finite",
            field="file",
            limit="a finite curvature",
            cure="correct the geometry at this place, or export it again",
        )
    # A step is a share of what the chord allows; every interval gets a whole number of them, evenly.
    needed = np.add.reduceat(steps, first[:-1])
    whole = np.maximum(np.ceil(needed - 1e-9), 1.0)
    _check_count(lines * whole.sum(), place)
    ends = np.concatenate([[0.0], np.cumsum(whole)])
    taken = np.cumsum(steps * (whole / needed)[interval])
    taken[first[1:] - 1] = ends[1:]
    s = np.interp(np.arange(ends[-1] + 1.0), np.concatenate([[0.0], taken]), np.append(start, breaks[-1]))
    s[ends.astype(np.int64)] = breaks
    row = np.repeat(np.arange(len(lengths)), (whole + 1.0).astype(np.int64))
    return s[np.arange(len(row)) - row], row


def report_gap(place: str, gap_m: float, what: str) -> str:
    """The warning of a gap.

    Raises
    ------
    UnreadableUpload
        It is wider than `GAP_ERROR_M`, or not finite.
    """
    message = f"{place}: {what} {gap_m:.3f} m"
    if gap_m <= GAP_ERROR_M:
        return f"{message}."
    raise UnreadableUpload(
        message, field="file", limit=f"{GAP_ERROR_M:g} m", cure="close the gap at this place, or export the file again"
    )


def _check_piece(piece: Piece) -> None:
    wrong = None
    if piece.length <= 0.0:
        wrong, limit = f"the length is {piece.length:g} m", "a length above 0 m"
    elif piece.k0 != piece.k1 and max(abs(piece.k0), abs(piece.k1)) * piece.length > MAX_SPIRAL_TURN_RAD:
        wrong, limit = "the spiral turns more than twice around", f"{MAX_SPIRAL_TURN_RAD:.2f} rad"
    if wrong is not None:
        raise UnreadableUpload(
            f"{piece.place}: {wrong}", field="file", limit=limit, cure="correct or remove the element at this place"
        )


def _check_count(count: float, place: str) -> None:
    if not count <= MAX_VERTICES:
        raise UnreadableUpload(
            f"{place}: the road needs {count:.3g} vertices",
            field="file",
            limit=f"{MAX_VERTICES} vertices",
            cure="check lengths and curvatures at this place, or cut the road into parts",
        )


def _check_joints(curve: Curve, pieces: Sequence[Piece]) -> list[str]:
    ends = curve.evaluate(curve.s + curve.length, np.arange(len(pieces)))
    gaps = np.hypot(ends.x[:-1] - curve.x[1:], ends.y[:-1] - curve.y[1:])
    jumps = np.abs(curve.s[:-1] + curve.length[:-1] - curve.s[1:])
    found: list[str] = []
    for i in np.flatnonzero(~(gaps <= GAP_WARNING_M)).tolist():
        found.append(report_gap(pieces[i + 1].place, float(gaps[i]), "the element before ends away from its start by"))
    for i in np.flatnonzero(~(jumps <= GAP_WARNING_M)).tolist():
        found.append(
            report_gap(pieces[i + 1].place, float(jumps[i]), "s differs from the end of the element before by")
        )
    return found


def clothoid(d: Floats, k0: Floats, k1: Floats, length: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Along, across, turn, curvature and its rate at distances d from the start; a line or arc where k0 = k1."""
    dk = (k1 - k0) / length
    turn = d * (k0 + 0.5 * dk * d)
    half = 0.5 * k0 * d
    chord = d * np.sinc(half / np.pi)
    u, v = chord * np.cos(half), chord * np.sin(half)
    spiral = dk != 0.0
    if spiral.any():
        at = d[spiral][:, None] * _NODES
        theta = at * (k0[spiral][:, None] + 0.5 * dk[spiral][:, None] * at)
        u[spiral], v[spiral] = d[spiral] * (np.cos(theta) @ _WEIGHTS), d[spiral] * (np.sin(theta) @ _WEIGHTS)
    return u, v, turn, k0 + dk * d, dk


def _derivatives(c: Floats, p: Floats) -> tuple[Floats, Floats, Floats]:
    return (
        c[..., 1] + p * (2.0 * c[..., 2] + 3.0 * p * c[..., 3]),
        2.0 * c[..., 2] + 6.0 * p * c[..., 3],
        6.0 * c[..., 3] + 0.0 * p,
    )


def _speed(u: Floats, v: Floats, p: Floats) -> Floats:
    """Distance per parameter of cubics with coefficients (m, 4), at parameters (..., m)."""
    return np.asarray(np.hypot(_derivatives(u, p)[0], _derivatives(v, p)[0]))


def _arc_lengths(u: Floats, v: Floats) -> Floats:
    """Distance at even steps of the parameter from 0 to 1, shape (m, 33)."""
    p = (np.arange(_CELLS)[:, None] + _CELL_NODES) / _CELLS
    speeds = _speed(u, v, p.reshape(-1, 1)).reshape(_CELLS, len(_CELL_NODES), len(u))
    cells = np.einsum("cgm,g->mc", speeds, _CELL_WEIGHTS) / _CELLS
    return np.concatenate([np.zeros((len(u), 1)), np.cumsum(cells, axis=1)], axis=1)


def _parameter(table: Floats, u: Floats, v: Floats, d: Floats, row: Ints) -> Floats:
    """Parameters at distances d along cubics: cubic Hermite interpolation in the table of arc lengths."""
    starts = np.concatenate([[0.0], np.cumsum(table[:, -1] + 1.0)])[:-1]
    flat = (table + starts[:, None]).ravel()
    cell = np.clip(np.searchsorted(flat, d + starts[row], side="right") - 1 - row * (_CELLS + 1), 0, _CELLS - 1)
    s0, s1 = table[row, cell], table[row, cell + 1]
    h = s1 - s0
    t = np.clip((d - s0) / h, 0.0, 1.0)
    p0 = cell / _CELLS
    slope0 = h / _speed(u[row], v[row], p0)
    slope1 = h / _speed(u[row], v[row], p0 + 1.0 / _CELLS)
    rise = 1.0 / _CELLS
    p = p0 + t * (slope0 + t * ((3.0 * rise - 2.0 * slope0 - slope1) + t * (slope0 + slope1 - 2.0 * rise)))
    return np.asarray(np.clip(p, 0.0, 1.0))


def _cubic_tables(cubics: Sequence[Piece]) -> tuple[Floats, Floats, Floats, list[str]]:
    """Coefficients, tables of distances scaled to the stated lengths, and warnings."""
    u = np.array([piece.u for piece in cubics], dtype=np.float64).reshape(-1, 4)
    v = np.array([piece.v for piece in cubics], dtype=np.float64).reshape(-1, 4)
    length = np.array([piece.length for piece in cubics], dtype=np.float64)
    if not cubics:
        return u, v, np.zeros((0, _CELLS + 1)), []
    if (cut := np.array([piece.by_length for piece in cubics])).any():
        # The parameter is u, at most the length. The cubic ends where its arc has the stated length (Newton's method).
        u[cut, 1], v[cut] = length[cut], v[cut] * length[cut, None] ** np.arange(4)
        end = np.ones(int(cut.sum()))
        for _ in range(_NEWTON):
            scale = end[:, None] ** np.arange(4)
            cu, cv = u[cut] * scale, v[cut] * scale
            over = _arc_lengths(cu, cv)[:, -1] - length[cut]
            end = np.clip(end * (1.0 - over / _speed(cu, cv, np.ones(len(end)))), 0.01, 1.0)
        u[cut], v[cut] = u[cut] * end[:, None] ** np.arange(4), v[cut] * end[:, None] ** np.arange(4)
    table = _arc_lengths(u, v)
    slowest = _speed(u, v, np.linspace(0.0, 1.0, _CELLS + 1)[:, None]).min(axis=0)
    warnings = []
    for piece, total, least in zip(cubics, table[:, -1], slowest, strict=True):
        off = abs(total - piece.length)
        if not (least > 1e-6 * piece.length and off <= 0.1 * piece.length):
            raise UnreadableUpload(
                f"{piece.place}: the curve of the polynomials is {total:.3f} m long, or stands still",
                field="file",
                limit=f"the stated length, {piece.length:.3f} m, within 10 %",
                cure="correct the length or the polynomials (check pRange), or export the file again",
            )
        if off > GAP_WARNING_M:
            warnings.append(f"{piece.place}: the curve is {total:.3f} m long, not {piece.length:.3f} m as stated.")
    return u, v, table * (length / table[:, -1])[:, None], warnings


# === Heights along an alignment: grades between points of intersection, rounded by parabolas and circles.


class VerticalPoint(NamedTuple):
    """A point of vertical intersection, and how it is rounded."""

    place: str  # where it is in the file, for errors
    # `s`, `height`: [m] distance along the line, and height
    s: float
    height: float
    # `before`, `after`: [m] lengths of the parabola before and after the point, zero without one
    before: float = 0.0
    after: float = 0.0
    radius: float | None = None  # [m] of a circle instead of a parabola


@dataclass(frozen=True, slots=True, eq=False)
class Profile:
    """Heights along a line."""

    # `s`, `heights`: shape (N,): [m] points of intersection
    s: Floats
    heights: Floats
    # the rounded ones, with the lengths of the rounding along the line
    rounding: tuple[tuple[VerticalPoint, float], ...]
    breaks: Floats  # [m] where grade or curvature change

    def height(self, s: Floats) -> Floats:
        """Heights at distances along the line, NaN beyond the ends of the profile. [m]"""
        # Ends of line and profile are computed in different ways; a centimetre is no end.
        near = np.clip(s, self.s[0], self.s[-1])
        height = np.interp(near, self.s, self.heights)
        for point, change in self.rounding:
            for sign, length in ((-1.0, point.before), (1.0, point.after)):
                along = (near - point.s) * sign
                rows = (along < length) & ((along > 0.0) | ((along == 0.0) & (sign < 0.0)))
                if point.radius is None:
                    middle = point.before * point.after * change / (2.0 * (point.before + point.after))
                    height[rows] += middle * (1.0 - along[rows] / length) ** 2
                else:
                    height[rows] = self._circle(point, change, near[rows])
        return np.where(np.abs(near - s) <= GAP_WARNING_M, height, np.nan)

    def bend(self, s: Floats) -> Floats:
        """Greatest second derivative of the height. [1/m]"""
        bend = np.zeros_like(s)
        for point, change in self.rounding:
            rows = (s > point.s - point.before) & (s < point.s + point.after)
            if point.radius is None:  # of unequal parabolas the shorter one is bent more, by their ratio
                short, long = sorted((point.before, point.after))
                bend[rows] = abs(change) / (short + long) * long / short
            else:
                bend[rows] = _steepest(point, self) ** 3 / point.radius
        return bend

    def _circle(self, point: VerticalPoint, change: float, s: Floats) -> Floats:
        assert point.radius is not None
        i = int(np.searchsorted(self.s, point.s))
        grade = (self.heights[i] - self.heights[i - 1]) / (self.s[i] - self.s[i - 1])
        angle, side = math.atan(grade), math.copysign(1.0, change)
        middle = point.s - point.before - side * point.radius * math.sin(angle)
        bottom = point.height - grade * point.before + side * point.radius * math.cos(angle)
        return np.asarray(bottom - side * np.sqrt(np.maximum(point.radius**2 - (s - middle) ** 2, 0.0)))


def build_profile(points: Sequence[VerticalPoint]) -> Profile:
    """Heights between points of intersection.

    Raises
    ------
    UnreadableUpload
        Stations do not increase, or roundings overlap; the message names the place.
    """
    for one, two in pairwise(points):
        if two.s <= one.s:
            raise _wrong(f"{two.place}: the station does not increase", "stations in the order of the line")
    s, heights = np.array([point.s for point in points]), np.array([point.height for point in points])
    grades = np.diff(heights) / np.diff(s)
    rounding = []
    for point, grade, after in zip(points[1:-1], grades, grades[1:], strict=False):
        change = float(after - grade)
        if point.radius is not None and change:
            turn = math.atan(after) - math.atan(grade)
            tangent = point.radius * math.tan(abs(turn) / 2.0)
            point = point._replace(
                before=tangent * math.cos(math.atan(grade)), after=tangent * math.cos(math.atan(after))
            )
        if min(point.before, point.after) < 0.0 or (min(point.before, point.after) == 0.0 < point.before + point.after):
            raise _wrong(f"{point.place}: a length of the curve is not positive", "lengths above 0 m")
        if point.before > 0.0:
            rounding.append((point, change))
    ends = [(points[0].place, points[0].s, points[0].s)]
    ends += [(point.place, point.s - point.before, point.s + point.after) for point, _ in rounding]
    ends.append((points[-1].place, points[-1].s, points[-1].s))
    for last, first in pairwise(ends):
        if first[1] < last[2] - GAP_WARNING_M:
            raise _wrong(
                f"{first[0]}: the curve begins {last[2] - first[1]:.3f} m before the end of the one before",
                "curves that do not overlap",
            )
    breaks = np.unique(np.concatenate([s, *[[p.s - p.before, p.s + p.after] for p, _ in rounding]]))
    return Profile(s, heights, tuple(rounding), breaks)


def _wrong(message: str, limit: str) -> UnreadableUpload:
    return UnreadableUpload(
        message, field="file", limit=limit, cure="correct the profile at this place, or export it again"
    )


def _steepest(point: VerticalPoint, profile: Profile) -> float:
    """Length along the steepest grade at a point, per distance along the line."""
    i = int(np.searchsorted(profile.s, point.s))
    rises = np.diff(profile.heights[i - 1 : i + 2]) / np.diff(profile.s[i - 1 : i + 2])
    return float(np.hypot(1.0, np.abs(rises).max()))
