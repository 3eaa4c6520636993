"""What a survey says against itself: rows off the line of the others, rows twice, heights that jump."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from app.registry.exchange.place import PlacedSurvey
from app.registry.exchange.read import warn
from app.registry.exchange.table import Fault, Floats, Severity

Flags = npt.NDArray[np.bool_]

_STRIDES = (1, 2, 3, 4)
_OFF_M = 9.0
_LEAST_OFF_M = 2.5
_END_OFF_M = 9.5
_REGULAR = 0.35
_STRAIGHT_COS = np.cos(np.radians(25.0))
_ISOLATED_M = 150.0
_SAME_PLACE_M = 0.3
_HEIGHTS_M = (-500.0, 9000.0)
_GRADE = 0.15
_ROUNDED_ROWS = 5
_HEIGHT_STEP_M = 2.0
_NO_DATA = (-9999.0, -99999.0, -32768.0, 9999.0, 99999.0)


def check_shape(survey: PlacedSurvey) -> list[Fault]:
    """Faults that the rows of a survey show by themselves."""
    rows = np.flatnonzero(survey.placed.placed)
    points = np.column_stack([survey.east_m[rows], survey.north_m[rows]])
    faults = [*_check_zeros(survey), *_check_rounding(survey)]
    if len(rows) >= 2:
        faults += _check_pairs(points, rows)
    if len(rows) >= 6:
        order = _order(points)
        faults += _check_line(points[order], rows[order])
    return faults + check_heights(survey)


def _check_zeros(survey: PlacedSurvey) -> list[Fault]:
    zero = (survey.table.first == 0) | (survey.table.second == 0)
    return [
        Fault(int(row) + 1, "position", "zero_coordinate", "a coordinate is exactly 0", "fill it in or leave it out")
        for row in np.flatnonzero(zero)
    ]


def _check_rounding(survey: PlacedSurvey) -> list[Fault]:
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


def _check_pairs(points: Floats, rows: npt.NDArray[np.intp]) -> list[Fault]:
    """Rows at the same place, and rows far from all others."""
    distance, index = nearest_of(points, points, 2)
    nearest = distance[:, 1]
    faults = []
    for k in np.flatnonzero(nearest <= _SAME_PLACE_M):
        other = index[k, 1] if index[k, 1] != k else index[k, 0]
        if k > other or index[other, 1] != k:
            message = f"the row lies within {_SAME_PLACE_M:g} m of row {rows[other] + 1}"
            faults.append(warn(int(rows[k]) + 1, "position", "same_place", message, "leave one of the two out"))
    usual = float(np.median(nearest))
    for lone in np.flatnonzero(nearest > max(_ISOLATED_M, 8 * usual)):
        message = f"the nearest other row is {nearest[lone]:.0f} m away, usually {usual:.1f} m"
        proposal = "compare the digits of its coordinates with those of the rows beside it"
        far = nearest[lone] > max(20_000.0, 200 * usual)
        severity = Severity.REFUSED if far else Severity.WARNING
        faults.append(Fault(int(rows[lone]) + 1, "position", "isolated", message, proposal, severity))
    return faults


def _order(points: Floats) -> npt.NDArray[np.intp]:
    """The order of the file where it follows a line, else one from neighbour to neighbour."""
    steps = np.hypot(*np.diff(points, axis=0).T)
    nearest = float(np.median(nearest_of(points, points, 2)[0][:, 1]))
    if np.median(steps) <= 4 * max(nearest, 1.0) or len(points) > 20_000:
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
    first: int

    @classmethod
    def of(cls, points: Floats, stride: int) -> _Around:
        n, s = len(points), stride
        return cls(
            points[: n - 4 * s],
            points[s : n - 3 * s],
            points[3 * s : n - s],
            points[4 * s :],
            points[2 * s : n - 2 * s],
            2 * s,
        )

    @property
    def off_m(self) -> Floats:
        """Distance from the place that a cubic through the four would give. [m]"""
        return _length(self.at - (4 * (self.b + self.c) - self.a - self.d) / 6)

    @property
    def regular(self) -> Flags:
        """The four are evenly spaced, but for the row between them."""
        steps = np.stack([_length(self.b - self.a), _length(self.c - self.b) / 2, _length(self.d - self.c)])
        middle = np.median(steps, axis=0)
        return np.all(np.abs(steps - middle) <= _REGULAR * middle + 0.5, axis=0)  # type: ignore[no-any-return]

    @property
    def straight(self) -> Flags:
        """The four turn by less than 25 degrees."""
        first, chord, last = self.b - self.a, self.c - self.b, self.d - self.c
        straight: Flags = (_cosine(first, chord) > _STRAIGHT_COS) & (_cosine(chord, last) > _STRAIGHT_COS)
        return straight

    @property
    def spike(self) -> Flags:
        """The row lies far beside, before or behind the two beside it, which it should be between."""
        chord = self.c - self.b
        length = np.maximum(_length(chord), 1e-6)
        offset = self.at - self.b
        across = np.abs(chord[:, 0] * offset[:, 1] - chord[:, 1] * offset[:, 0]) / length
        along = (chord * offset).sum(axis=1) / length
        beyond = np.maximum(-along, along - length)
        spike: Flags = (across > np.maximum(5.0, 0.3 * length)) | (across > _OFF_M) | (beyond > 3.0)
        return spike


def _check_line(points: Floats, rows: npt.NDArray[np.intp]) -> list[Fault]:
    stride = min(
        (s for s in _STRIDES if len(points) >= 5 * s + 1),
        key=lambda s: float(np.median(_Around.of(points, s).off_m)) + 0.2 * s,
    )
    around = _Around.of(points, stride)
    off_m, usual = around.off_m, float(np.median(around.off_m))
    step_m = float(np.median(_length(np.diff(points[::stride], axis=0))))
    if usual > 0.5 * step_m or step_m == 0:
        return []  # no line that a row could be off
    regular = around.regular
    threshold = min(max(_LEAST_OFF_M, 6 * usual), _OFF_M)
    flagged = regular & (off_m > threshold) | ~regular & around.straight & around.spike
    found = {int(k) + around.first: float(off_m[k]) for k in np.flatnonzero(flagged)}
    found |= _check_ends(points, stride, found)
    return [
        warn(
            int(rows[k]) + 1, "position", "off_the_line",
            f"the row is about {off_m:.1f} m from where the rows around it lead",
            "compare the digits of its coordinates with those of the rows beside it",
        )
        for k, off_m in sorted(found.items())
    ]  # fmt: skip


def _check_ends(points: Floats, stride: int, known: dict[int, float]) -> dict[int, float]:
    """Rows that neither what comes after nor what came before leads to."""
    n, s = len(points), stride
    offs = np.full((2, n), np.nan)
    for side, sign in ((0, 1), (1, -1)):
        line = points[::sign]
        b, c, d = line[s : n - 2 * s], line[2 * s : n - s], line[3 * s :]
        here = line[: n - 3 * s]
        first, second = _length(c - b), _length(d - c)
        fits = (np.abs(first - second) <= _REGULAR * second + 0.5) & (_cosine(c - b, d - c) > _STRAIGHT_COS)
        ahead = (b - here) * np.sign(1.0)
        unit = (c - b) / np.maximum(first, 1e-6)[:, None]
        along = (ahead * unit).sum(axis=1)
        across = np.abs(ahead[:, 0] * unit[:, 1] - ahead[:, 1] * unit[:, 0])
        off = np.where((across > 0.6 * first) | (along < -1.0), _length(here - (2 * b - c)), across)
        values = np.where(fits, off, np.nan)
        offs[side, : n - 3 * s] = values
        offs[side] = offs[side][::sign]
    both = np.nanmin(np.where(np.isnan(offs), np.inf, offs), axis=0)
    ends = [*range(2 * s), *range(n - 2 * s, n)]
    return {k: float(both[k]) for k in ends if np.isfinite(both[k]) and both[k] > _END_OFF_M and k not in known}


def check_heights(survey: PlacedSurvey) -> list[Fault]:
    """Heights against each other."""
    if survey.table.height is None:
        return []
    height, given = survey.height_m, survey.table.height
    faults = []
    no_data = np.isin(given, _NO_DATA)
    outside = ~no_data & ((height < _HEIGHTS_M[0]) | (height > _HEIGHTS_M[1]))
    zero = (given == 0) & (abs(float(np.nanmedian(height))) > 5)
    for row in np.flatnonzero(no_data | outside | zero):
        code = "height_out_of_range" if outside[row] else "no_height"
        message = f"the height is {given[row]:g} {survey.table.height_unit}"
        faults.append(Fault(int(row) + 1, "height", code, message, "leave the cell empty where there is no height"))
    usable = np.flatnonzero(np.isfinite(height) & survey.placed.placed & ~(no_data | outside | zero))
    return faults + _check_steps(survey, usable)


def _check_steps(survey: PlacedSurvey, rows: npt.NDArray[np.intp]) -> list[Fault]:
    if len(rows) < 3:
        return []
    points = np.column_stack([survey.east_m[rows], survey.north_m[rows]])
    distance, near = nearest_of(points, points, min(5, len(rows)))
    height = survey.height_m[rows]
    rise = np.abs(height[:, None] - height[near])[:, 1:]
    steep = rise > _GRADE * distance[:, 1:] + _HEIGHT_STEP_M
    odd = np.flatnonzero(steep.mean(axis=1) >= 0.5)
    faults = [_height_fault(int(rows[k]), float(np.median(rise[k]))) for k in odd]
    if not len(odd) and steep.any():
        faults.append(_height_fault(int(rows[int(np.argmax(steep.any(axis=1)))]), float(rise[steep].max())))
    return faults


def _height_fault(row: int, rise_m: float) -> Fault:
    return warn(
        row + 1, "height", "height_step", f"the height differs by {rise_m:.1f} m from those of the rows beside it",
        "check the unit and the vertical datum (geoid or ellipsoid) of these rows",
    )  # fmt: skip


def nearest_of(points: Floats, among: Floats, k: int) -> tuple[Floats, npt.NDArray[np.intp]]:
    """Distances [m] and indices of the k nearest of `among`, each of shape (N, k)."""
    distance, index = cKDTree(among).query(points, k=k)
    return np.asarray(distance).reshape(len(points), k), np.asarray(index, dtype=np.intp).reshape(len(points), k)


def _length(vectors: Floats) -> Floats:
    return np.hypot(vectors[:, 0], vectors[:, 1])


def _cosine(one: Floats, other: Floats) -> Any:
    return (one * other).sum(axis=1) / np.maximum(_length(one) * _length(other), 1e-9)
