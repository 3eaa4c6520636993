"""Heights along an alignment: grades between points of intersection, rounded by parabolas and circles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from app.errors import UnreadableUpload
from app.formats.alignments.curves import GAP_WARNING_M
from app.formats.alignments.geometry import Floats


class VerticalPoint(NamedTuple):
    """A point of vertical intersection, and how it is rounded.

    Attributes
    ----------
    place : str
        Where it is in the file, for errors.
    s, height : float
        Distance along the line, and height. [m]
    before, after : float
        Lengths of the parabola before and after the point, zero without one. [m]
    radius : float or None
        Of a circle instead of a parabola. [m]
    """

    place: str
    s: float
    height: float
    before: float = 0.0
    after: float = 0.0
    radius: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Profile:
    """Heights along a line.

    Attributes
    ----------
    s, heights : ndarray, shape (N,)
        Points of intersection. [m]
    rounding : tuple of (point, change of grade)
        The rounded ones, with the lengths of the rounding along the line.
    breaks : ndarray
        Where grade or curvature change. [m]
    """

    s: Floats
    heights: Floats
    rounding: tuple[tuple[VerticalPoint, float], ...]
    breaks: Floats

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
