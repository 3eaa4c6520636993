"""Strokes that the pictures of lanes are drawn with, as SVG."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

WIDTH, LEFT, RIGHT = 1200, 80, 1138
"""Width of a picture, left and right edge of its panels. [px]"""
_POINTS = 1100
_AREA = "#edf3ee"
_INK = "#555"


def nice_step(value: float, *, up: bool = False) -> float:
    """1, 2 or 5 times a power of ten: the nearest below, or above."""
    power = 10.0 ** math.floor(math.log10(max(value, 1e-9)))
    steps = [power * k for k in (1, 2, 5, 10)]
    return next(s for s in steps if s >= value) if up else max(s for s in steps if s <= value * (1 + 1e-9))


def thin(points: Floats) -> Floats:
    """No more points than a picture can show."""
    step = math.ceil(len(points) / _POINTS)
    return points if step <= 1 else np.vstack([points[::step], points[-1:]])


def unbroken(points: Floats) -> list[Floats]:
    """Stretches of points without NaN."""
    kept = np.isfinite(points).all(axis=1)
    edges = np.flatnonzero(np.diff(np.r_[False, kept, False].astype(np.int8)))
    return [thin(points[a:b]) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a > 1]


def polylines(points: Floats, colour: str, width: float, dash: str = "") -> list[str]:
    """A line, broken where its points are NaN."""
    dashed = f' stroke-dasharray="{dash}"' if dash else ""
    return [
        f'<polyline points="{points_list(run)}" fill="none" stroke="{colour}" stroke-width="{width}"{dashed}/>'
        for run in unbroken(points)
    ]


def area(left: Floats, right: Floats) -> list[str]:
    """What lies between two lines with as many points, where both are known."""
    runs = unbroken(np.hstack([left, right]))
    return [f'<polygon points="{points_list(np.vstack([r[:, :2], r[::-1, 2:]]))}" fill="{_AREA}"/>' for r in runs]


def points_list(points: Floats) -> str:
    """As SVG writes points."""
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in points.tolist())


def frame(top: int, height: int) -> str:
    """Border of a panel."""
    return f'<rect x="{LEFT}" y="{top}" width="{RIGHT - LEFT}" height="{height}" fill="none" stroke="#bbb"/>'


def label(x: float, y: float, text: str) -> str:
    """Text to the left of an axis."""
    return f'<text x="{x}" y="{y:.1f}" text-anchor="end" fill="{_INK}">{text}</text>'


def outlined(x: float, y: float, text: str, colour: str, anchor: str = "start") -> str:
    """Small text that can be read over lines."""
    place = f'x="{x:.1f}" y="{y:.1f}" font-size="11" text-anchor="{anchor}"'
    return (
        f'<text {place} fill="white" stroke="white" stroke-width="3" stroke-linejoin="round">{text}</text>'
        f'<text {place} fill="{colour}">{text}</text>'
    )


def dots(points: Floats, colour: str, size: float, opacity: float = 1.0) -> str:
    """Many round dots as one path."""
    if not len(points):
        return ""
    marks = "".join(f"M{x:.1f} {y:.1f}h.01" for x, y in points.tolist())
    return f'<path d="{marks}" stroke="{colour}" stroke-width="{size}" stroke-linecap="round" opacity="{opacity}"/>'
