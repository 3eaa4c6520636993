"""A line along a lane in a local frame: chainage to place and back."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from pyproj import Geod

from app.errors import InvalidParameter
from app.geodesy import check_lon_lat, enu_from_wgs84, lon_lat_from_enu
from app.values import Floats

MAX_LENGTH_M = 20_000.0
"""Longest line. [m] In a longer one the plane frame turns bearings by more than a magnet's tolerance."""
_MAX_POINTS = 100_000  # of a line; bounds the time
_SAME_PLACE_M = 1e-4  # [m] points nearer than this are one; the step of a tag's lengths


@dataclass(frozen=True, slots=True, eq=False)
class LaneLine:
    """A line in the direction of travel, e.g. a lane's centre line or a painted line."""

    origin: tuple[float, float, float]  # of the local east, north, up frame: the line's first point
    points_enu_m: Floats  # shape (K, 3): [m] vertices; up follows the ellipsoid away from the origin
    chainages_m: Floats  # shape (K,): [m] of the vertices, from 0

    @classmethod
    def from_lon_lat(cls, points_deg: Sequence[Sequence[float]], height_m: float = 0.0) -> LaneLine:
        """Line through positions, e.g. the coordinates of a GeoJSON LineString.

        Parameters
        ----------
        points_deg : sequence of (lon, lat), or (lon, lat, height); heights are left out
            In WGS 84, in the direction of travel. [deg]
        height_m : float
            Ellipsoidal height of the road, at which distances are true. [m]

        Raises
        ------
        InvalidParameter
            Fewer than two different points, one that is out of range, or a line longer than 20 km.
        """
        if not 2 <= len(points_deg) <= _MAX_POINTS or any(len(p) < 2 for p in points_deg):
            raise InvalidParameter(
                f"a line has {len(points_deg)} points", field="lane", limit=f"2 to {_MAX_POINTS} positions lon, lat"
            )
        if not -500.0 <= height_m <= 9000.0:
            raise InvalidParameter(f"height_m is {height_m}", field="height_m", limit="-500 to 9000 m")
        for i, (lon_deg, lat_deg, *_) in enumerate(points_deg):
            check_lon_lat(lon_deg, lat_deg, f"lane[{i}]")
        origin = (float(points_deg[0][0]), float(points_deg[0][1]), float(height_m))
        lon_lat = np.array([(lon_deg, lat_deg) for lon_deg, lat_deg, *_ in points_deg], dtype=np.float64)
        points = enu_from_wgs84(lon_lat[:, 0], lon_lat[:, 1], height_m, origin).T
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        points = points[np.concatenate([[True], steps > _SAME_PLACE_M])]
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        if not len(steps) or steps.sum() > MAX_LENGTH_M:
            raise InvalidParameter(
                f"the line is {steps.sum():.0f} m long",
                field="lane",
                limit=f"above 0, at most {MAX_LENGTH_M:.0f} m",
                cure="cut the road into sections",
            )
        return cls(origin, points, np.concatenate([[0.0], np.cumsum(steps)]))

    @property
    def length_m(self) -> float:
        """Chainage of its end. [m]"""
        return float(self.chainages_m[-1])

    def at(self, chainage_m: float | Floats) -> Floats:
        """Places on the line, shape (..., 3), east, north, up; outside it, its ends. [m]"""
        return np.stack([np.interp(chainage_m, self.chainages_m, self.points_enu_m[:, k]) for k in range(3)], axis=-1)

    def direction_at(self, chainage_m: float) -> Floats:
        """Unit vector of travel, shape (3,): east, north, up."""
        last = len(self.chainages_m) - 2
        i = min(max(int(np.searchsorted(self.chainages_m, chainage_m, side="right")) - 1, 0), last)
        step: Floats = self.points_enu_m[i + 1] - self.points_enu_m[i]
        return step / float(np.linalg.norm(step))

    def locate(self, point_enu_m: Floats) -> tuple[float, float]:
        """Chainage of the nearest place on the line and the offset from it, left positive. [m]"""
        starts, steps = self.points_enu_m[:-1, :2], np.diff(self.points_enu_m[:, :2], axis=0)
        squared = np.sum(steps**2, axis=1)
        share = np.clip(np.sum((point_enu_m[:2] - starts) * steps, axis=1) / squared, 0.0, 1.0)
        away = point_enu_m[:2] - (starts + share[:, None] * steps)
        i = int(np.argmin(np.sum(away**2, axis=1)))
        left = steps[i, 0] * away[i, 1] - steps[i, 1] * away[i, 0]
        chainage = self.chainages_m[i] + share[i] * (self.chainages_m[i + 1] - self.chainages_m[i])
        return float(chainage), math.copysign(float(np.linalg.norm(away[i])), left)

    def lon_lat(self, points_enu_m: Floats) -> tuple[Floats, Floats]:
        """Longitudes and latitudes of points of the local frame, shape (..., 3). [deg]"""
        return lon_lat_from_enu(points_enu_m, self.origin)

    def from_position(self, lon_deg: float, lat_deg: float) -> Floats:
        """A position in the local frame, shape (3,). [m]"""
        return enu_from_wgs84(lon_deg, lat_deg, self.origin[2], self.origin)


def left_of(direction: Floats) -> Floats:
    """Level unit vector to the left of a direction, shape (3,)."""
    left = np.array([-direction[1], direction[0], 0.0])
    return left / float(np.linalg.norm(left))


def bearing_deg(direction: Floats) -> float:
    """Clockwise from true north, 0 to 360. [deg]"""
    return math.degrees(math.atan2(direction[0], direction[1])) % 360.0


# === Lines parallel to a road's axis.


MAX_EDGE_M = 500.0
"""Longest edge of a line after `cut_edges`. [m] Source: a geodesic of this length is within 5 mm times the tangent of
the latitude of the straight line in longitude and latitude, by its sagitta."""
_MAX_MITRE_RAD = np.radians(170.0)  # [rad] of turn at a vertex; a mitre of 11 offsets
_GEOD = Geod(ellps="WGS84")


def cut_edges(points_deg: Floats) -> Floats:
    """A line of geodesics with vertices on them, so that no edge is longer than 500 m.

    Parameters
    ----------
    points_deg : ndarray, shape (N, 2)
        Longitude, latitude.

    Returns
    -------
    ndarray, shape (K, 2)
        The vertices, and those between them; without those at the place of the one before.
    """
    cut = [points_deg[:1]]
    lon_a, lat_a = points_deg[0].tolist()
    for lon_b, lat_b in points_deg[1:].tolist():
        length_m = _GEOD.inv(lon_a, lat_a, lon_b, lat_b)[2]
        if length_m < _SAME_PLACE_M:
            continue
        pieces = int(np.ceil(length_m / MAX_EDGE_M))
        if pieces > 1:
            cut.append(np.array(_GEOD.npts(lon_a, lat_a, lon_b, lat_b, pieces - 1)))
        cut.append(np.array([[lon_b, lat_b]]))
        lon_a, lat_a = lon_b, lat_b
    return np.concatenate(cut)


def parallel_line(points_deg: Floats, offset_m: float) -> Floats:
    """The line at an offset from another: one vertex for each, where the neighbouring edges' parallels meet.

    Parameters
    ----------
    points_deg : ndarray, shape (N, 2)
        Longitude, latitude; no two vertices at one place.
    offset_m : float
        Left positive. [m]

    Returns
    -------
    ndarray, shape (N, 2)
        Inside of bends that are tighter than the offset it crosses itself.
    """
    lon, lat = points_deg.T
    ahead, back, _ = _GEOD.inv(lon[:-1], lat[:-1], lon[1:], lat[1:])
    leaving = np.radians(np.append(ahead, np.asarray(back[-1]) + 180.0))
    arriving = np.radians(np.insert(np.asarray(back) + 180.0, 0, ahead[0]))
    turn = (leaving - arriving + np.pi) % (2 * np.pi) - np.pi
    direction = np.degrees(arriving + turn / 2)
    reach = offset_m / np.cos(np.clip(turn, -_MAX_MITRE_RAD, _MAX_MITRE_RAD) / 2)
    lon, lat, _ = _GEOD.fwd(lon, lat, direction - 90.0, reach)
    return np.column_stack([lon, lat])


# === Measures of a road: the distances on its signs, as a function of the chainage of its axis.
#
# Measures increase along the axis, linearly between calibration points and in true metres beyond them. At an equation
# of stationing they jump, from `measure_m` before it to `ahead_m` after it. After a jump forward, the measures between
# the two do not exist on the road. After a jump back, or where parts overlap, one measure exists at several places.
# Within a section, between jumps and ends of parts, measures are unique.


MAX_PLACES = 20  # of a measure; bounds an answer; measures of a road occur twice
SCALES = (0.5, 2.0)  # lowest and highest metres of measure to a metre of road
_SAME_M = 1e-6  # [m] source: a micrometre, above rounding
_ON_END_M = 1e-6  # [m] source: `_SAME_M`
_MIN_APART_M = 1e-3  # [m] between calibration points; source: a millimetre, below every survey


@dataclass(frozen=True, slots=True)
class CalibrationPoint:
    """A place whose measure is known."""

    part: int  # part of the axis, from 0
    chainage_m: float  # [m] along the axis
    measure_m: float  # [m] measure signed there
    ahead_m: float | None = None  # [m] at an equation of stationing, the measure after it


@dataclass(frozen=True, slots=True, eq=False)
class Section:
    """A stretch of one part with rising measures; both arrays have the shape (K,) and rise. [m]"""

    part: int
    chainages_m: Floats
    measures_m: Floats


@dataclass(frozen=True, slots=True)
class Measures:
    """Measures of a whole axis, by sections in the order of their chainages."""

    sections: tuple[Section, ...]
    _starts: list[tuple[int, float]] = field(init=False, repr=False, compare=False)  # part and chainage of each section
    _ends_m: Floats = field(init=False, repr=False, compare=False)  # lowest and highest measure, shape (2, S)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_starts", [(s.part, float(s.chainages_m[0])) for s in self.sections])
        ends_m = [(s.measures_m[0], s.measures_m[-1]) for s in self.sections]
        object.__setattr__(self, "_ends_m", np.array(ends_m, float).reshape(-1, 2).T)

    def measure_at(self, part: int, chainage_m: float) -> float:
        """Measure of a place on the axis; at an equation of stationing the one after it. [m]"""
        found = self.sections[self.section_at(part, chainage_m)]
        return float(np.interp(chainage_m, found.chainages_m, found.measures_m))

    def section_at(self, part: int, chainage_m: float) -> int:
        """Number of the section of a place on the axis."""
        number = bisect_right(self._starts, (part, chainage_m)) - 1
        return number if number >= 0 and self.sections[number].part == part else number + 1

    def places_of(self, measure_m: float) -> list[tuple[int, int, float]]:
        """Section, part and chainage of each place with a measure, the first 20; none if it is not on the road."""
        low_m, high_m = self._ends_m
        places = []
        for number in np.flatnonzero((low_m - _ON_END_M <= measure_m) & (measure_m <= high_m + _ON_END_M))[:MAX_PLACES]:
            section = self.sections[number]
            chainage_m = float(np.interp(measure_m, section.measures_m, section.chainages_m))
            places.append((int(number), section.part, chainage_m))
        return places


def calibrate(part_ranges_m: Sequence[tuple[float, float]], points: Sequence[CalibrationPoint]) -> Measures:
    """Measures of an axis.

    Parameters
    ----------
    part_ranges_m : sequence of (start_m, end_m)
        Chainages of each part's ends. [m]
    points : sequence of CalibrationPoint
        In any order. A part without any continues from the end of the part before it, the first from 0.

    Raises
    ------
    InvalidParameter
        Two points at one place, measures that do not rise, or metres of measure beyond 0.5 to 2 metres of road.
    """
    sections: list[Section] = []
    by_part: dict[int, list[CalibrationPoint]] = {}
    for point in sorted(points, key=lambda p: p.chainage_m):
        by_part.setdefault(point.part, []).append(point)
    for part, (start_m, end_m) in enumerate(part_ranges_m):
        own = by_part.get(part, [])
        _check_places(own)
        if not own:
            ahead_m = float(sections[-1].measures_m[-1]) if sections else 0.0
            own = [CalibrationPoint(part, start_m, ahead_m)]
        sections += _sections(part, start_m, end_m, own)
    return Measures(tuple(sections))


def _sections(part: int, start_m: float, end_m: float, points: list[CalibrationPoint]) -> list[Section]:
    first, sections = points[0], []
    knots = [(start_m, first.measure_m - (first.chainage_m - start_m))]
    for point in points:
        _add_knot(knots, point.chainage_m, point.measure_m)
        if point.ahead_m is not None:
            sections.append(knots)
            knots = [(point.chainage_m, point.ahead_m)]
    _add_knot(knots, end_m, knots[-1][1] + (end_m - knots[-1][0]))
    sections.append(knots)
    made = [np.array(knots) for knots in sections if knots[-1][0] - knots[0][0] > _SAME_M]
    for knots_m in made:
        _check_rising(knots_m)
    return [Section(part, knots_m[:, 0], knots_m[:, 1]) for knots_m in made]


def _add_knot(knots: list[tuple[float, float]], chainage_m: float, measure_m: float) -> None:
    if chainage_m - knots[-1][0] > _SAME_M:
        knots.append((chainage_m, measure_m))
    else:
        knots[-1] = (knots[-1][0], measure_m) if len(knots) == 1 else knots[-1]


def _check_places(points: list[CalibrationPoint]) -> None:
    for one, other in pairwise(points):
        if other.chainage_m - one.chainage_m < _MIN_APART_M:
            raise InvalidParameter(
                f"two calibration points lie at one place, with {one.measure_m:g} m and {other.measure_m:g} m",
                field="calibration",
                limit="a millimetre apart",
                cure="leave one out; an equation of stationing is one point with measure_m and ahead_m",
            )


def _check_rising(knots_m: Floats) -> None:
    scales = np.diff(knots_m[:, 1]) / np.diff(knots_m[:, 0])
    wrong = np.flatnonzero((scales < SCALES[0]) | (scales > SCALES[1]))
    if len(wrong):
        k = int(wrong[0])
        (start_m, from_m), (end_m, to_m) = knots_m[k].tolist(), knots_m[k + 1].tolist()
        raise InvalidParameter(
            f"from measure {from_m:g} m to {to_m:g} m there are {end_m - start_m:.3f} m of road",
            field="calibration",
            limit=f"{SCALES[0]:g} to {SCALES[1]:g} m of measure to a metre of road, rising",
            cure="give measures in metres along the line; where signs jump, give measure_m and ahead_m at one point",
        )
