"""Lines of known shape for the grammars of roads: the integral of their curvature, and what a reader made of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from app.values import Floats

STEP_M = 0.25
"""Distance of the nodes. [m] Cubics between them are off by less than 1e-7 m at a radius of 10 m."""
CHORD_M = 0.0011
"""Greatest distance of a chord from its curve. [m] The readers promise 1 mm; the rest is how it is measured here."""


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """A smooth part of a line at n nodes, each shape (n,)."""

    # `s`, `x`, `y`: [m] distance along the line, and place
    s: Floats
    x: Floats
    y: Floats
    hdg: Floats  # [rad] counter-clockwise from x
    k: Floats  # [1/m] left positive

    @property
    def end(self) -> tuple[float, float, float]:
        """Place and direction of the last node."""
        return float(self.x[-1]), float(self.y[-1]), float(self.hdg[-1])


def integrate(start: tuple[float, float, float], s: float, length: float, k0: float, k1: float) -> Stretch:
    """A line, arc or clothoid from a place and direction, by Simpson's rule over the direction."""
    cells = max(math.ceil(length / STEP_M), 1)
    d = np.linspace(0.0, length, 2 * cells + 1)
    hdg = start[2] + k0 * d + (k1 - k0) * d * d / (2.0 * length)
    place = []
    for first, speed in ((start[0], np.cos(hdg)), (start[1], np.sin(hdg))):
        steps = (speed[:-1:2] + 4.0 * speed[1::2] + speed[2::2]) * (length / cells / 6.0)
        place.append(first + np.concatenate([[0.0], np.cumsum(steps)]))
    d, hdg = d[::2], hdg[::2]
    return Stretch(s + d, place[0], place[1], hdg, k0 + (k1 - k0) * d / length)


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """Stretches that follow each other."""

    parts: Sequence[Stretch]

    @property
    def end_s(self) -> float:
        """Distance of the end along the line. [m]"""
        return float(self.parts[-1].s[-1])

    @property
    def joints(self) -> Floats:
        """Distances at which stretches begin, and the end. [m]"""
        return np.array([float(part.s[0]) for part in self.parts] + [self.end_s])

    def at(self, s: Floats, lookup: Floats | None = None) -> tuple[Floats, Floats, Floats, Floats]:
        """x, y [m], direction [rad] and curvature [1/m] at distances, by the stretches in which `lookup` lies."""
        starts = self.joints[:-1]
        row = np.clip(np.searchsorted(starts, s if lookup is None else lookup, side="right") - 1, 0, len(starts) - 1)
        found = np.zeros((4, len(s)))
        for number in np.unique(row):
            part, on = self.parts[number], row == number
            found[:, on] = _between(part, s[on])
        return found[0], found[1], found[2], found[3]


def _between(part: Stretch, s: Floats) -> Floats:
    i = np.clip(np.searchsorted(part.s, s, side="right") - 1, 0, len(part.s) - 2)
    h = part.s[i + 1] - part.s[i]
    t = (s - part.s[i]) / h
    places = []
    for values, slope in ((part.x, np.cos(part.hdg)), (part.y, np.sin(part.hdg))):
        a, b, m0, m1 = values[i], values[i + 1], slope[i] * h, slope[i + 1] * h
        places.append(a + t * (m0 + t * ((3 * (b - a) - 2 * m0 - m1) + t * (m0 + m1 - 2 * (b - a)))))
    d, rate = s - part.s[i], (part.k[i + 1] - part.k[i]) / h
    return np.stack([*places, part.hdg[i] + d * (part.k[i] + d * rate / 2.0), part.k[i] + d * rate])


def compare_plan(
    course: Course, s: Floats, xy: Floats, curvature: Floats | None, tolerance_m: float, curvature_tolerance: float
) -> str:
    """The difference of a reader's vertices from a line, empty for none.

    Parameters
    ----------
    s : ndarray, shape (N,)
        Distances of the vertices along the line, in its order. [m]
    xy : ndarray, shape (N, 2)
        Their places. [m]
    curvature : ndarray, shape (N,), or None
        [1/m]
    tolerance_m, curvature_tolerance : float
        Greatest difference. [m], [1/m]
    """
    if len(s) < 2 or (np.diff(s) < 0.0).any():
        return "stations do not increase"
    if max(abs(s[0]), abs(s[-1] - course.end_s)) > tolerance_m:
        return f"it is from {s[0]:.4f} to {s[-1]:.4f} of {course.end_s:.4f} m"
    x, y, _hdg, k = course.at(s)
    off = np.hypot(xy[:, 0] - x, xy[:, 1] - y)
    if off.max() > tolerance_m:
        return f"{off.max():.4f} m off (limit {tolerance_m:.5f} m) at s {s[int(off.argmax())]:.2f} of {s[-1]:.2f} m"
    middle, between = (s[1:] + s[:-1]) / 2.0, (xy[1:] + xy[:-1]) / 2.0
    away = chord_errors(between, xy, np.stack(course.at(middle)[:2], axis=1))
    if away.max() > CHORD_M + tolerance_m:
        return f"a chord is {away.max():.4f} m off at s {middle[int(away.argmax())]:.2f}"
    if curvature is not None:
        near = np.abs(s[:, None] - course.joints).min(axis=1) < 2 * tolerance_m
        bent = np.where(near, 0.0, np.abs(curvature - k))
        if bent.max() > curvature_tolerance:
            return f"the curvature is {bent.max():.6f} 1/m off at s {s[int(bent.argmax())]:.2f}"
    return ""


def chord_errors(between: Floats, xy: Floats, wanted: Floats) -> Floats:
    """Distances of wanted places from the chords whose middles are given. [m]"""
    along = np.diff(xy, axis=0)
    length = np.hypot(*along.T)
    rest = wanted - between
    across = np.abs(along[:, 0] * rest[:, 1] - along[:, 1] * rest[:, 0])
    return np.asarray(np.where(length > 1e-3, across / np.maximum(length, 1e-3), np.hypot(*rest.T)))


def compare_warnings(found: Sequence[str], wanted: Sequence[str], allowed: Sequence[str] = ()) -> str:
    """What warnings are missing or not expected; each is named by a part of it."""
    missing = [part for part in wanted if not any(part in warning for warning in found)]
    other = [warning for warning in found if not any(part in warning for part in (*wanted, *allowed))]
    return f"no warning of {missing}" if missing else f"a warning without a reason: {other[0]}" if other else ""
