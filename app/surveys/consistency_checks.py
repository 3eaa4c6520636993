"""Checks of a survey's rows against each other: rows off the line, repeated rows, steps in the heights.

Thresholds without another source were chosen by hand and are checked by `python -m benchmarks.imports`: planted faults
must be found, clean surveys must not be refused.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from app.formats.surveys.table import Change, Fault, Severity, warn
from app.surveys.georeference import GeoreferencedSurvey
from app.values import Bools, Floats

_STRIDES = (1, 2, 3, 4)  # rows to the next of the same line: 2 where left and right boundaries alternate
_OFF_M = 9.0  # [m] a row farther off the line than this is reported whatever the scatter
_MIN_OFF_M = 2.5  # [m] a row nearer than this is never reported
_END_OFF_M = 9.5  # [m] the same for the first and last rows, which are only extrapolated
_REGULAR = 0.35  # [1] steps that differ less from their median are evenly spaced
_STRAIGHT_COS = np.cos(np.radians(25.0))  # a line that turns less from step to step is straight
_EVEN = 0.03  # [1] steps that differ less were measured along one line, even where it turns
_BEND_COS = np.cos(np.radians(40.0))  # sharpest turn of such a line
_ISOLATED_M = 150.0  # [m] a row this far from all others is reported, or at 8 times the usual distance
_SAME_PLACE_M = 0.3  # [m] two rows within this distance are one marker
_HEIGHTS_M = (-500.0, 9000.0)  # [m] beyond the Dead Sea's shore (-430 m) and Mount Everest (8849 m)
_GRADE = 0.15  # [m/m] steepest road that is allowed for
_ROUNDED_ROWS = 5  # rows from which on whole metres are no coincidence
_HEIGHT_STEP_M = 2.0  # [m] step of height that is allowed besides the grade
_PART = 100_000  # rows that are worked on at a time, to bound memory
_COARSE_M = 1.0  # [m] an RMSE above it is graded m or unfit, and is more often one in millimetres
_NO_DATA = (-9999.0, -99999.0, -32768.0, 9999.0, 99999.0)  # values that GIS programs write for "no data"


def check_consistency(survey: GeoreferencedSurvey) -> Iterator[Fault]:
    """Faults that the rows of a survey reveal without any other data."""
    rows = np.flatnonzero(survey.placed.placed)
    points = np.column_stack([survey.east_m[rows], survey.north_m[rows]])
    yield from _check_zeros(survey)
    yield from _check_rounding(survey)
    if len(rows) >= 2:
        distance_m, nearest = nearest_others(points)
        yield from _check_pairs(distance_m, nearest, rows)
        if len(rows) >= 6:
            order = _order(points, float(np.median(distance_m)))
            yield from _check_line(points[order], rows[order])
    yield from check_heights(survey)


def check_accuracy(horizontal_rmse_m: float | None, vertical_rmse_m: float | None) -> Iterator[Fault]:
    """Stated accuracies that are no survey's. [m]"""
    for field, rmse_m in (("horizontal_rmse_m", horizontal_rmse_m), ("vertical_rmse_m", vertical_rmse_m)):
        if rmse_m is not None and rmse_m > _COARSE_M:
            yield warn(
                None,
                field,
                "coarse_accuracy",
                f"the stated accuracy is {rmse_m:g} m",
                f"state it in metres ({rmse_m:g} mm are {rmse_m / 1000:g} m), or survey again: for vehicles",
                (Change(f"survey.{field}", rmse_m / 1000),),
            )


def _check_zeros(survey: GeoreferencedSurvey) -> Iterator[Fault]:
    zero = (survey.table.first == 0) | (survey.table.second == 0)
    yield from (zero_coordinate(int(row) + 1) for row in np.flatnonzero(zero))


def zero_coordinate(row: int | None) -> Fault:
    """The fault of a row, or of a single position, that has a coordinate of 0."""
    cure = "fill it in or leave it out"
    return Fault(row, "position", "zero_coordinate", "a coordinate is exactly 0", cure)


def _check_rounding(survey: GeoreferencedSurvey) -> list[Fault]:
    """All coordinates are multiples of a metre or more, as spreadsheets leave them."""
    table = survey.table
    finest = 1.0 if table.projected else 1e-5
    faults = []
    for name, values in (("first", table.first), ("second", table.second)):
        steps = values[np.isfinite(values)] / finest
        if len(steps) >= _ROUNDED_ROWS and np.abs(steps - np.round(steps)).max() < 1e-6 * max(1.0, 1 / finest / 1e5):
            where = {"first": "easting or longitude", "second": "northing or latitude"}[name]
            message = f"every {where} is a multiple of {finest:g} {table.unit}"
            faults.append(warn(None, "position", "rounded_coordinates", message, "export it with all its decimals"))
    return faults


def _check_pairs(nearest_m: Floats, index: npt.NDArray[np.intp], rows: npt.NDArray[np.intp]) -> Iterator[Fault]:
    """Rows at the same place, and rows far from all others."""
    for k in np.flatnonzero(nearest_m <= _SAME_PLACE_M):
        other = index[k]
        if k > other or index[other] != k:
            message = f"the row lies within {_SAME_PLACE_M:g} m of row {rows[other] + 1}"
            yield warn(int(rows[k]) + 1, "position", "same_place", message, "leave one of the two out")
    usual = float(np.median(nearest_m))
    for lone in np.flatnonzero(nearest_m > max(_ISOLATED_M, 8 * usual)):
        message = f"the nearest other row is {nearest_m[lone]:.0f} m away, usually {usual:.1f} m"
        proposal = "compare the digits of its coordinates with those of the rows beside it"
        far = nearest_m[lone] > max(20_000.0, 200 * usual)
        severity = Severity.REFUSED if far else Severity.WARNING
        yield Fault(int(rows[lone]) + 1, "position", "isolated", message, proposal, severity)


def _order(points: Floats, nearest_m: float) -> npt.NDArray[np.intp]:
    """The order of the file if it follows a line, else an order from neighbour to neighbour."""
    steps = np.hypot(*np.diff(points, axis=0).T)
    if np.median(steps) <= 4 * max(nearest_m, 1.0) or len(points) > 20_000:
        return np.arange(len(points))
    around = nearest_of(points, points, min(16, len(points)))[1]
    left = np.ones(len(points), dtype=bool)
    current, order = int(np.argmin(points @ np.array([1.0, 0.1]))), []
    for _ in range(len(points)):
        order.append(current)
        left[current] = False
        free = [int(k) for k in around[current] if left[k]]
        if not free:
            if not left.any():
                break
            rest = np.flatnonzero(left)
            free = [int(rest[np.argmin(np.hypot(*(points[rest] - points[current]).T))])]
        current = free[0]
    return np.array(order, dtype=np.intp)


@dataclass(frozen=True, slots=True)
class _Around:
    """The rows around each: two before and two after, `stride` apart."""

    a: Floats
    b: Floats
    c: Floats
    d: Floats
    at: Floats

    @classmethod
    def of(cls, points: Floats, stride: int) -> _Around:
        n, s = len(points), stride
        return cls(
            points[: n - 4 * s],
            points[s : n - 3 * s],
            points[3 * s : n - s],
            points[4 * s :],
            points[2 * s : n - 2 * s],
        )

    @classmethod
    def pieces(cls, points: Floats, stride: int) -> Iterator[_Around]:
        """A hundred thousand rows at a time: intermediate arrays take many times their memory."""
        for start in range(0, len(points) - 4 * stride, _PART):
            yield cls.of(points[start : start + _PART + 4 * stride], stride)

    def is_off(self, threshold_m: float) -> Bools:
        """Rows that are not where the four rows around them lead."""
        off: Bools = self.regular & (self.off_m > threshold_m) | ~self.regular & self.straight & self.spike
        return off

    @property
    def off_m(self) -> Floats:
        """Distance from the place that a cubic through the four would give. [m]"""
        return _length(self.at - (4 * (self.b + self.c) - self.a - self.d) / 6)

    @property
    def regular(self) -> Bools:
        """The four are evenly spaced, but for the row between them."""
        steps = np.stack([_length(self.b - self.a), _length(self.c - self.b) / 2, _length(self.d - self.c)])
        middle = np.median(steps, axis=0)
        return np.all(np.abs(steps - middle) <= _REGULAR * middle + 0.5, axis=0)  # type: ignore[no-any-return]

    @property
    def straight(self) -> Bools:
        """The four turn by less than 25 degrees."""
        first, chord, last = self.b - self.a, self.c - self.b, self.d - self.c
        straight: Bools = (_cosine(first, chord) > _STRAIGHT_COS) & (_cosine(chord, last) > _STRAIGHT_COS)
        return straight

    @property
    def spike(self) -> Bools:
        """The row lies far beside, before or behind the two beside it, which it should be between."""
        chord = self.c - self.b
        length = np.maximum(_length(chord), 1e-6)
        offset = self.at - self.b
        across = np.abs(chord[:, 0] * offset[:, 1] - chord[:, 1] * offset[:, 0]) / length
        along = (chord * offset).sum(axis=1) / length
        beyond = np.maximum(-along, along - length)
        spike: Bools = (across > np.maximum(5.0, 0.3 * length)) | (across > _OFF_M) | (beyond > 3.0)
        return spike


def _off_m(points: Floats, stride: int) -> Floats:
    return np.concatenate([around.off_m for around in _Around.pieces(points, stride)])


def _check_line(points: Floats, rows: npt.NDArray[np.intp]) -> Iterator[Fault]:
    stride = min(
        (s for s in _STRIDES if len(points) >= 5 * s + 1),
        key=lambda s: float(np.median(_off_m(points, s))) + 0.2 * s,
    )
    off_m = _off_m(points, stride)
    usual = float(np.median(off_m))
    step_m = float(np.median(_length(np.diff(points[::stride], axis=0))))
    if usual > 0.5 * step_m or step_m == 0:
        return  # the rows form no line
    threshold = min(max(_MIN_OFF_M, 6 * usual), _OFF_M)
    flagged = np.concatenate([around.is_off(threshold) for around in _Around.pieces(points, stride)])
    found = {int(k) + 2 * stride: float(off_m[k]) for k in np.flatnonzero(flagged)}
    found |= _check_ends(points, stride, found)
    for k, off in sorted(found.items()):
        message = f"the row is about {off:.1f} m from where the rows around it lead"
        proposal = "compare the digits of its coordinates with those of the rows beside it"
        yield warn(int(rows[k]) + 1, "position", "off_the_line", message, proposal)


def _check_ends(points: Floats, stride: int, known: dict[int, float]) -> dict[int, float]:
    """Rows at both ends that are not where the neighbouring rows lead, by their distance from there."""
    s, found = stride, {}
    for sign in (1, -1):
        line = points[::sign][: 5 * s]
        here, b, c, d = line[: 2 * s], line[s : 3 * s], line[2 * s : 4 * s], line[3 * s :]
        first, second = _length(c - b), _length(d - c)
        fits = (np.abs(first - second) <= _REGULAR * second + 0.5) & (_cosine(c - b, d - c) > _STRAIGHT_COS)
        ahead = b - here
        unit = (c - b) / np.maximum(first, 1e-6)[:, None]
        along = (ahead * unit).sum(axis=1)
        across = np.abs(ahead[:, 0] * unit[:, 1] - ahead[:, 1] * unit[:, 0])
        off = np.where((across > 0.6 * first) | (along < -1.0), _length(here - (2 * b - c)), across)
        even = (np.abs(_length(ahead) - first) <= _EVEN * first) & (np.abs(first - second) <= _EVEN * second)
        bend = even & (_cosine(ahead, c - b) > _BEND_COS)  # a row moved by mistake rarely keeps its distance
        for k in np.flatnonzero(fits & (off > _END_OFF_M) & ~bend).tolist():
            row = k if sign == 1 else len(points) - 1 - k
            if row not in known:
                found[row] = float(off[k])
    return found


def check_heights(survey: GeoreferencedSurvey) -> Iterator[Fault]:
    """Faults of the heights: missing values written as numbers, impossible values, steps."""
    if survey.table.height is None:
        return
    height, written = survey.height_m, survey.table.height
    no_data = np.isin(written, _NO_DATA)
    outside = ~no_data & ((height < _HEIGHTS_M[0]) | (height > _HEIGHTS_M[1]))
    zero = (written == 0) & (abs(float(np.nanmedian(height))) > 5)
    for row in np.flatnonzero(no_data | outside | zero):
        yield _no_height(int(row) + 1, written[row], survey.table.height_unit, is_outside=bool(outside[row]))
    usable = np.flatnonzero(np.isfinite(height) & survey.placed.placed & ~(no_data | outside | zero))
    yield from _check_steps(survey, usable)


def check_height(height_m: float) -> list[Fault]:
    """The fault of a single position's height, if it has one."""
    no_data, is_outside = height_m in _NO_DATA, not _HEIGHTS_M[0] <= height_m <= _HEIGHTS_M[1]
    return [_no_height(None, height_m, "m", is_outside=is_outside and not no_data)] if no_data or is_outside else []


def _no_height(row: int | None, written: float, unit: str, *, is_outside: bool) -> Fault:
    code = "height_out_of_range" if is_outside else "no_height"
    message = f"the height is {written:g} {unit}"
    return Fault(row, "height", code, message, "leave the cell empty where there is no height")


def _check_steps(survey: GeoreferencedSurvey, rows: npt.NDArray[np.intp]) -> Iterator[Fault]:
    if len(rows) < 3:
        return
    points = np.column_stack([survey.east_m[rows], survey.north_m[rows]])
    height = survey.height_m[rows]
    tree: Any = scipy.spatial.cKDTree(points)
    odd, steepest = [], (0.0, -1)
    for start in range(0, len(rows), _PART):
        part = slice(start, start + _PART)
        distance, near = tree.query(points[part], k=min(5, len(rows)))
        rise = np.abs(height[part, None] - height[near])[:, 1:]
        steep = rise > _GRADE * distance[:, 1:] + _HEIGHT_STEP_M
        odd += [(start + int(k), float(np.median(rise[k]))) for k in np.flatnonzero(steep.mean(axis=1) >= 0.5)]
        if steep.any() and float(rise[steep].max()) > steepest[0]:
            steepest = (float(rise[steep].max()), start + int(np.argmax(steep.any(axis=1))))
    for k, rise_m in odd:
        yield _height_fault(int(rows[k]), rise_m)
    if not odd and steepest[1] >= 0:
        yield _height_fault(int(rows[steepest[1]]), steepest[0])


def _height_fault(row: int, rise_m: float) -> Fault:
    return warn(
        row + 1,
        "height",
        "height_step",
        f"the height differs by {rise_m:.1f} m from those of the rows beside it",
        "check the unit and the vertical datum (geoid or ellipsoid) of these rows",
    )


def nearest_others(points: Floats) -> tuple[Floats, npt.NDArray[np.intp]]:
    """Distance [m] and index of the nearest other point of each, shape (N,).

    Points at one place are found first: a tree with many of them takes quadratic time.
    """
    places, first, place, count = np.unique(points, axis=0, return_index=True, return_inverse=True, return_counts=True)
    order = np.argsort(place, kind="stable")  # points at one place follow each other, the first one ahead
    second = order[np.minimum(np.cumsum(count) - count + 1, len(points) - 1)]
    nearest = np.where(first[place] == np.arange(len(points)), second[place], first[place])
    nearest_m = np.zeros(len(points))
    tree: Any = scipy.spatial.cKDTree(places)
    alone = np.flatnonzero(count[place] == 1)
    for start in range(0, len(alone), _PART):
        part = alone[start : start + _PART]
        distance, index = tree.query(points[part], k=2)
        nearest_m[part], nearest[part] = distance[:, 1], np.append(first, len(points))[index[:, 1]]
    return nearest_m, nearest


def nearest_of(points: Floats, among: Floats, k: int) -> tuple[Floats, npt.NDArray[np.intp]]:
    """Distances [m] and indices of the k nearest of `among`, each of shape (N, k)."""
    distance, index = scipy.spatial.cKDTree(among).query(points, k=k)
    return np.asarray(distance).reshape(len(points), k), np.asarray(index, dtype=np.intp).reshape(len(points), k)


def _length(vectors: Floats) -> Floats:
    return np.hypot(vectors[:, 0], vectors[:, 1])


def _cosine(one: Floats, other: Floats) -> object:
    return (one * other).sum(axis=1) / np.maximum(_length(one) * _length(other), 1e-9)
