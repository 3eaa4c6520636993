"""The axis of a road: positions to chainages and offsets, and back.

The axis is made of parts, each a line of geodesics on WGS 84. Offset lines are parallel to the axis: between two
vertices the direction of an offset turns from one bisector to the next, as on a plotted offset line. So every place
near the axis has one chainage and one offset, from which it can be computed again; with plain perpendiculars, places in
wedges outside of bends would have none. Farther than 25 m from a vertex the foot is the plain perpendicular. Kinks
above 90 degrees are corners: outside of them the corner itself is the foot.

Pure: arrays in, arrays out. Chainages are true lengths on the ellipsoid from the start of the first part; they run on
from the end of one part to the start of the next.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import scipy
from pyproj import Geod

from app.errors import InvalidParameter
from app.geodesy.frames import ecef_from_wgs84
from app.values import Floats

IntArray = npt.NDArray[np.intp]

MAX_VERTICES = 100_000  # bounds the memory of an axis
MAX_EDGE_M = 20_000.0  # [m] longer edges are swapped or missing vertices
MAX_LENGTH_M = 5_000_000.0  # [m] bounds the memory of an axis
MAX_PARTS = 2_000  # bounds the time to make an axis to half a second
MAX_OFFSET_M = 10_000.0  # [m] bounds the time of a search
MAX_FEET = 20  # of a place; bounds an answer; roads that cross themselves have two
MAX_PAIRS = 10_000_000  # of places and pieces of an axis in one search; bounds its time to 3 s
_GEOD = Geod(ellps="WGS84")
_PIECE_M = 250.0  # [m] edges are cut into pieces on which a plane is accurate to 0.1 mm (`_plane`)
_BEND_M = 25.0  # [m] farther from a vertex, offsets are square to the edge; source: docs/roads.md
_SAME_PLACE_M = 1e-4  # [m] shorter edges are dropped; source: a tenth of a millimetre, below every survey
_CORNER_RAD = np.radians(90.0)  # [rad] sharper kinks are corners; source: docs/roads.md
_ON_BISECTOR = 1e-9  # share of a piece by which two strips overlap, so that there is no gap; source: above rounding
_SAME_FOOT_M = 1e-4  # [m] source: `_SAME_PLACE_M`
_PAIRS = 300_000  # of places and pieces in memory at the same time; about 50 MB
_REFINEMENTS = 3  # of a foot on a geodesic; source: to the nanometre (`_exact`)
_MAX_DETOUR = 1.01  # of a strip's foot against the nearest place on the axis


@dataclass(frozen=True, slots=True)
class Foot:
    """Foot of a place on an axis."""

    part: int  # part of the axis, from 0
    chainage_m: float  # [m] along the axis
    offset_m: float  # [m] from the axis, left positive
    beyond_m: float = 0.0  # [m] distance of the place before the start (negative) or after the end of its part
    # whether the place can be computed from chainage and offset: not beyond an end, outside of a corner, or beyond the
    # centre of a bend
    exact: bool = True

    @property
    def distance_m(self) -> float:
        """From the foot to the place. [m]"""
        return float(np.hypot(self.offset_m, self.beyond_m))


class Axis:
    """One or more lines on the ellipsoid.

    Parameters
    ----------
    parts : sequence of sequences of (lon_deg, lat_deg)
        Vertices of each line in the direction of increasing chainage; further coordinates are left out. [deg]
    max_length_m : float
        Of all parts together. [m]

    Raises
    ------
    InvalidParameter
        A part with fewer than two different vertices, an edge above 20 km, more than 100 000 vertices, 2 000 parts or
        `max_length_m`.
    """

    def __init__(self, parts: Sequence[Sequence[Sequence[float]]], max_length_m: float = MAX_LENGTH_M) -> None:
        _check_count(parts)
        edges = [_edges(np.array([p[:2] for p in part], dtype=np.float64), number) for number, part in enumerate(parts)]
        _check_length(sum(float(lengths_m.sum()) for _, _, lengths_m in edges), max_length_m)
        pieces = []
        self.vertex_chainages_m: list[Floats] = []
        chainage_m = 0.0
        for number, part_edges in enumerate(edges):
            made, vertices_m = _pieces(*part_edges)
            made["chainage"] += chainage_m
            made["part"] = np.full(len(made["length"]), number, dtype=np.intp)
            self.vertex_chainages_m.append(vertices_m + chainage_m)
            chainage_m = float(self.vertex_chainages_m[-1][-1])
            pieces.append(made)
        joined = {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}
        self._lon, self._lat, self._azimuth = joined["lon"], joined["lat"], joined["azimuth"]
        self._length, self._chainage, self._part = joined["length"], joined["chainage"], joined["part"].astype(np.intp)
        self._shear_start, self._shear_end = joined["shear_start"], joined["shear_end"]
        self._first = np.flatnonzero(np.diff(self._part, prepend=-1))
        self._last = np.append(self._first[1:], len(self._part)) - 1
        self._start_ecef, self._forward, self._left = _frames(self._lon, self._lat, self._azimuth)
        self._reach = float(self._length.max()) / 2
        self._tree = scipy.spatial.cKDTree(self._start_ecef + self._forward * (self._length / 2)[:, None])

    @property
    def length_m(self) -> float:
        """Of all parts together. [m]"""
        return float(self._chainage[-1] + self._length[-1])

    @property
    def part_ranges_m(self) -> list[tuple[float, float]]:
        """Chainages of each part's start and end. [m]"""
        return [(float(v[0]), float(v[-1])) for v in self.vertex_chainages_m]

    def locate(
        self, lon_deg: Floats, lat_deg: Floats, max_offset_m: float, *, max_feet: int = MAX_FEET
    ) -> list[list[Foot]]:
        """Feet of places on the axis, for each place the nearest first; none where it is farther than `max_offset_m`.

        Parameters
        ----------
        lon_deg, lat_deg : ndarray, shape (N,)
        max_offset_m : float
            Up to 10 000. [m]
        max_feet : int
            Nearest feet of each place that are computed.

        Returns
        -------
        list of list of Foot
            More than one foot: a loop, a hairpin, a road that crosses itself, or parts side by side.

        Raises
        ------
        InvalidParameter
            More than 10 million pairs of a place and a piece of the axis near it.
        """
        lon, lat = np.atleast_1d(lon_deg).astype(np.float64), np.atleast_1d(lat_deg).astype(np.float64)
        feet: list[list[Foot]] = [[] for _ in range(len(lon))]
        for places, pieces in self._pairs(lon, lat, max_offset_m):
            x, y, share = self._plane(places, pieces, lon, lat)
            length = self._length[pieces]
            inside = (share >= -_ON_BISECTOR) & (share <= 1 + _ON_BISECTOR) & (np.abs(y) <= max_offset_m * _MAX_DETOUR)
            inside[inside] = _is_among_nearest(places[inside], np.abs(y[inside]), max_feet)
            self._add_strips(feet, places[inside], pieces[inside], lon, lat)
            away = np.hypot(x - np.clip(x, 0.0, length), y)
            self._add_nearest(feet, places, pieces, away, lon, lat)
        return [_sorted(found, max_offset_m) for found in feet]

    def place(
        self, part: IntArray, chainage_m: Floats, offset_m: Floats
    ) -> tuple[Floats, Floats, npt.NDArray[np.bool_]]:
        """Positions by chainage and offset.

        Parameters
        ----------
        part : ndarray of int, shape (N,)
        chainage_m : ndarray, shape (N,)
            Within the part; outside it, its ends. [m]
        offset_m : ndarray, shape (N,)
            Left positive. [m]

        Returns
        -------
        lon_deg, lat_deg : ndarray, shape (N,)
        folded : ndarray of bool, shape (N,)
            The offset reaches beyond the centre of a bend: other chainages lead to the same place.
        """
        pieces = np.clip(
            np.searchsorted(self._chainage, chainage_m, side="right") - 1, self._first[part], self._last[part]
        )
        length, start, end = self._length[pieces], self._shear_start[pieces], self._shear_end[pieces]
        share = np.clip((chainage_m - self._chainage[pieces]) / length, 0.0, 1.0)
        along = share * length + offset_m * ((1 - share) * start + share * end)
        lon, lat, back = _GEOD.fwd(self._lon[pieces], self._lat[pieces], self._azimuth[pieces], along)
        lon, lat, _ = _GEOD.fwd(lon, lat, np.asarray(back) + 180.0 - 90.0, offset_m)
        return np.asarray(lon), np.asarray(lat), length + offset_m * (end - start) <= 0

    def heading_deg(self, part: IntArray, chainage_m: Floats) -> Floats:
        """Direction of increasing chainage, clockwise from true north, 0 to 360. [deg]"""
        pieces = np.clip(
            np.searchsorted(self._chainage, chainage_m, side="right") - 1, self._first[part], self._last[part]
        )
        heading: Floats = self._azimuth[pieces] % 360.0
        return heading

    def list_circles(self, step_m: float) -> Iterator[tuple[float, float, float]]:
        """Circles (lon_deg, lat_deg, radius_m) that cover the axis, in its order, each over about `step_m` of it."""
        for first, last in zip(self._first.tolist(), self._last.tolist(), strict=True):
            ends: list[float] = (self._chainage + self._length)[first : last + 1].tolist()
            start = first
            while start <= last:
                end = min(first + bisect_left(ends, float(self._chainage[start]) + step_m), last)
                middle = (self._chainage[start] + ends[end - first]) / 2
                lon, lat, _ = self.place(np.array([self._part[start]]), np.array([middle]), np.zeros(1))
                yield float(lon[0]), float(lat[0]), float(ends[end - first] - middle) + 1.0
                start = end + 1

    # --- pieces and places --------------------------------------------------------------------------------------------

    def _pairs(self, lon: Floats, lat: Floats, max_offset_m: float) -> Iterator[tuple[IntArray, IntArray]]:
        """Places and pieces that may belong together, some places at a time; all pieces of a place come together."""
        radius = self._reach + 2 * max_offset_m + 1.0
        places = ecef_from_wgs84(lon, lat)
        counts = np.asarray(self._tree.query_ball_point(places, radius, return_length=True), dtype=np.intp)
        _check_pairs(int(counts.sum()), len(places))
        start = 0
        while start < len(places):
            end = start + max(1, int(np.searchsorted(np.cumsum(counts[start:]), _PAIRS, side="right")))
            near = scipy.spatial.cKDTree(places[start:end]).sparse_distance_matrix(
                self._tree, radius, output_type="ndarray"
            )
            if len(near):
                yield near["i"] + start, near["j"]
            start = end

    def _plane(self, places: IntArray, pieces: IntArray, lon: Floats, lat: Floats) -> tuple[Floats, Floats, Floats]:
        """Coordinates along and left of pieces, good to a tenth of a millimetre within a kilometre, and shares."""
        away = ecef_from_wgs84(lon, lat)[places] - self._start_ecef[pieces]
        x = np.einsum("ij,ij->i", away, self._forward[pieces])
        y = np.einsum("ij,ij->i", away, self._left[pieces])
        return x, y, self._share(pieces, x, y)

    def _share(self, pieces: IntArray, x: Floats, y: Floats) -> Floats:
        """How far along a piece, 0 to 1 inside its strip; NaN where the strip is folded."""
        start, end = self._shear_start[pieces], self._shear_end[pieces]
        width = self._length[pieces] + y * (end - start)
        return np.where(width > 0, (x - y * start) / np.where(width > 0, width, 1.0), np.nan)

    def _exact(self, places: IntArray, pieces: IntArray, lon: Floats, lat: Floats) -> tuple[Floats, Floats]:
        """Along and left of the geodesics of pieces, to the nanometre: the foot is moved until it is square."""
        lon_p, lat_p = lon[places], lat[places]
        lon_a, lat_a, azimuth = self._lon[pieces], self._lat[pieces], self._azimuth[pieces]
        to, _, far = _GEOD.inv(lon_a, lat_a, lon_p, lat_p)
        angle = np.radians(to - azimuth)
        x, y = far * np.cos(angle), -far * np.sin(angle)
        for _ in range(_REFINEMENTS):
            lon_f, lat_f, back = _GEOD.fwd(lon_a, lat_a, azimuth, x)
            to, _, far = _GEOD.inv(lon_f, lat_f, lon_p, lat_p)
            angle = np.radians(to - (np.asarray(back) + 180.0))
            x, y = x + far * np.cos(angle), -far * np.sin(angle)
        return x, y

    def _add_strips(self, feet: list[list[Foot]], places: IntArray, pieces: IntArray, lon: Floats, lat: Floats) -> None:
        if not len(places):
            return
        x, y = self._exact(places, pieces, lon, lat)
        share = np.clip(self._share(pieces, x, y), 0.0, 1.0)
        chainages = self._chainage[pieces] + share * self._length[pieces]
        for place, part, chainage, offset in zip(
            places.tolist(), self._part[pieces].tolist(), chainages.tolist(), y.tolist(), strict=True
        ):
            feet[place].append(Foot(part, chainage, offset))

    def _add_nearest(
        self,
        feet: list[list[Foot]],
        places: IntArray,
        pieces: IntArray,
        away: Floats,
        lon: Floats,
        lat: Floats,
    ) -> None:
        """The nearest place on the axis if it is nearer than the strips give: at ends, corners and tight bends."""
        order = np.lexsort((away, places))
        firsts = order[np.unique(places[order], return_index=True)[1]]
        best = np.array([min((abs(f.offset_m) for f in feet[p]), default=np.inf) for p in places[firsts]])
        firsts = firsts[best > away[firsts] * _MAX_DETOUR + 0.01]
        if not len(firsts):
            return
        places, pieces = places[firsts], pieces[firsts]
        x, y = self._exact(places, pieces, lon, lat)
        on = np.clip(x, 0.0, self._length[pieces])
        before_start = (x < 0) & (pieces == self._first[self._part[pieces]])
        after_end = (x > on) & (pieces == self._last[self._part[pieces]])
        beyond = np.where(before_start | after_end, x - on, 0.0)
        offset = np.where(beyond != 0, y, np.copysign(np.hypot(x - on, y), y))
        for k, place in enumerate(places.tolist()):
            chainage = float(self._chainage[pieces[k]] + on[k])
            feet[place].append(Foot(int(self._part[pieces[k]]), chainage, float(offset[k]), float(beyond[k]), False))


def _is_among_nearest(places: IntArray, distance_m: Floats, count: int) -> npt.NDArray[np.bool_]:
    """Which of these candidates are among the `count` nearest ones of their place, shape (N,)."""
    order = np.lexsort((distance_m, places))
    ordered = places[order]
    rank = np.arange(len(order)) - np.searchsorted(ordered, ordered)
    nearest = np.empty(len(order), dtype=np.bool_)
    nearest[order] = rank < count
    return nearest


def _sorted(feet: list[Foot], max_offset_m: float) -> list[Foot]:
    """Nearest first, each once."""
    kept: list[Foot] = []
    for foot in sorted(feet, key=lambda foot: (foot.distance_m, foot.chainage_m)):
        if foot.distance_m > max_offset_m:
            break
        if all(k.part != foot.part or abs(k.chainage_m - foot.chainage_m) > _SAME_FOOT_M for k in kept):
            kept.append(foot)
    return kept


def _check_pairs(pairs: int, places: int) -> None:
    if pairs > MAX_PAIRS:
        raise InvalidParameter(
            f"{places} positions have {pairs} edges of the line near them",
            field="geometry",
            limit=f"{MAX_PAIRS} pairs of a position and an edge",
            cure="ask for fewer positions or a smaller offset, or leave out vertices of the line",
        )


def _check_length(length_m: float, limit_m: float) -> None:
    if length_m > limit_m:
        raise InvalidParameter(
            f"the line is {length_m / 1000:.0f} km long",
            field="geometry",
            limit=f"{limit_m / 1000:.0f} km",
            cure="divide it into sections, each a line of its own",
        )


def _check_count(parts: Sequence[Sequence[Sequence[float]]]) -> None:
    total = sum(len(part) for part in parts)
    if not parts or total > MAX_VERTICES or len(parts) > MAX_PARTS:
        raise InvalidParameter(
            f"the line has {total} vertices in {len(parts)} parts",
            field="geometry",
            limit=f"2 to {MAX_VERTICES} vertices in at most {MAX_PARTS} parts",
            cure="leave out vertices that lie on straight lines, and join parts end to end",
        )


def _edges(points: Floats, number: int) -> tuple[Floats, Floats, Floats]:
    """Vertices of a part, and azimuth [deg] and length [m] of the edge from each to the next."""
    if len(points) > 1:
        azimuth, _, length = _GEOD.inv(points[:-1, 0], points[:-1, 1], points[1:, 0], points[1:, 1])
    else:
        azimuth = length = np.zeros(0)
    if not (length > _SAME_PLACE_M).any():
        raise InvalidParameter(
            f"line {number} has fewer than two different vertices",
            field=f"geometry.coordinates[{number}]",
            limit="two different vertices at least",
            cure="leave the line out, or give the vertices along the road",
        )
    if length.max() > MAX_EDGE_M:
        k = int(np.argmax(length))
        raise InvalidParameter(
            f"line {number} has {length[k] / 1000:.1f} km from vertex {k} to the next",
            field=f"geometry.coordinates[{number}]",
            limit=f"{MAX_EDGE_M / 1000:.0f} km",
            cure="give vertices along the road; check the coordinates for swapped axes",
        )
    return points, azimuth, length


def _pieces(points: Floats, azimuth: Floats, length: Floats) -> tuple[dict[str, npt.NDArray[np.float64]], Floats]:
    """Pieces of a part, and the chainages of its vertices."""
    kept = np.flatnonzero(length > _SAME_PLACE_M)
    vertices_m = np.concatenate([[0.0], np.cumsum(np.where(length > _SAME_PLACE_M, length, 0.0))])
    starts, azimuth, length = points[:-1][kept], azimuth[kept], length[kept]
    turns = _turns(starts, azimuth, length, points)
    edge, step, size = _cuts(length)
    lon, lat, back = _GEOD.fwd(starts[edge, 0], starts[edge, 1], azimuth[edge], step)
    first, last = np.diff(edge, prepend=-1) > 0, np.diff(edge, append=len(length)) > 0
    shear_start, shear_end = np.zeros(len(edge)), np.zeros(len(edge))
    shear_start[first] = turns[:-1]
    shear_end[last] = -turns[1:]
    offsets = np.concatenate([[0.0], np.cumsum(length)])[:-1]
    return {
        "lon": np.asarray(lon),
        "lat": np.asarray(lat),
        "azimuth": np.where(first, azimuth[edge], np.asarray(back) + 180.0),
        "length": size,
        "chainage": offsets[edge] + step,
        "shear_start": shear_start,
        "shear_end": shear_end,
    }, vertices_m


def _cuts(length: Floats) -> tuple[IntArray, Floats, Floats]:
    """Edges cut into pieces: the edge, the distance from its start and the length of each."""
    edge, step, size = [], [], []
    for k, metres in enumerate(length.tolist()):
        middle = metres - 2 * _BEND_M
        if middle <= 0:
            cuts = [0.0, metres]
        else:
            cuts = [0.0, *np.linspace(_BEND_M, metres - _BEND_M, 1 + math.ceil(middle / _PIECE_M)).tolist(), metres]
        edge += [k] * (len(cuts) - 1)
        step += cuts[:-1]
        size += [end - start for start, end in pairwise(cuts)]
    return np.array(edge, dtype=np.intp), np.array(step), np.array(size)


def _turns(starts: Floats, azimuth: Floats, length: Floats, points: Floats) -> Floats:
    """Tangent of half the turn at the start of each edge and at the end of the last one, left positive."""
    _, _, back = _GEOD.fwd(starts[:, 0], starts[:, 1], azimuth, length)
    arriving = np.asarray(back) + 180.0
    turn = np.zeros(len(length) + 1)
    turn[1:-1] = arriving[:-1] - azimuth[1:]
    if _GEOD.inv(*points[0], *points[-1])[2] < 1e-3:
        turn[0] = turn[-1] = arriving[-1] - azimuth[0]  # a closed loop turns at its ends too
    angle = np.radians((turn + 180.0) % 360.0 - 180.0)
    return np.where(np.abs(angle) <= _CORNER_RAD, np.tan(angle / 2), 0.0)


def _frames(lon_deg: Floats, lat_deg: Floats, azimuth_deg: Floats) -> tuple[Floats, ...]:
    """Starts of pieces and their unit vectors forward and left, earth-centred, each of shape (N, 3)."""
    lon, lat, azimuth = np.radians(lon_deg), np.radians(lat_deg), np.radians(azimuth_deg)
    east = np.stack([-np.sin(lon), np.cos(lon), np.zeros_like(lon)], axis=-1)
    north = np.stack([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)], axis=-1)
    sine, cosine = np.sin(azimuth)[:, None], np.cos(azimuth)[:, None]
    return ecef_from_wgs84(lon_deg, lat_deg), sine * east + cosine * north, sine * north - cosine * east
