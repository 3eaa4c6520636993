"""Measures of a road: the distances on its signs, as a function of the chainage of its axis.

Measures increase along the axis, linearly between calibration points and in true metres beyond them. At an equation of
stationing they jump, from `measure_m` before it to `ahead_m` after it. After a jump forward, the measures between
the two do not exist on the road. After a jump back, or where parts overlap, one measure exists at several places.
Within a section, between jumps and ends of parts, measures are unique.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter

FloatArray = npt.NDArray[np.float64]
MAX_PLACES = 20  # of a measure; source: by hand, bounds an answer; measures of a road occur twice
SCALES = (0.5, 2.0)  # lowest and highest metres of measure to a metre of road; source: by hand
_SAME_M = 1e-6  # [m] source: a micrometre, above rounding
_ON_END_M = 1e-6  # [m] source: `_SAME_M`
_MIN_APART_M = 1e-3  # [m] between calibration points; source: a millimetre, below every survey


@dataclass(frozen=True, slots=True)
class CalibrationPoint:
    """A place whose measure is known.

    Attributes
    ----------
    part : int
        Part of the axis, from 0.
    chainage_m : float
        Along the axis. [m]
    measure_m : float
        Measure signed there. [m]
    ahead_m : float or None
        At an equation of stationing, the measure after it. [m]
    """

    part: int
    chainage_m: float
    measure_m: float
    ahead_m: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Section:
    """A stretch of one part with rising measures; both arrays have the shape (K,) and rise. [m]"""

    part: int
    chainages_m: FloatArray
    measures_m: FloatArray


@dataclass(frozen=True, slots=True)
class Measures:
    """Measures of a whole axis, by sections in the order of their chainages."""

    sections: tuple[Section, ...]
    _starts: list[tuple[int, float]] = field(init=False, repr=False, compare=False)  # part and chainage of each section
    _ends_m: FloatArray = field(init=False, repr=False, compare=False)  # lowest and highest measure, shape (2, S)

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


def _check_rising(knots_m: FloatArray) -> None:
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
