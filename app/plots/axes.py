"""The axis kit that all SVG pictures are drawn with: scales, panels, ticks, lines, dots and text.

Coordinates are pixels, x to the right and y down. Every function returns SVG elements as text.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from html import escape

import numpy as np
import numpy.typing as npt

from app.values import Floats

INK, GREY, FRAME, GRID = "#1c1f23", "#555", "#bbb", "#eee"
"""Colours of strong text, of labels and ticks, of a panel's border, of lines across a panel."""
RED, BLUE, GREEN, ORANGE = "#c0392b", "#1f5fa8", "#1e8449", "#d68910"
_AREA = "#edf3ee"
_MAX_POINTS = 1100  # of a line; a little less than a picture has columns


# --- the picture --------------------------------------------------------------------------------------------------


def picture(width: float, height: float, body: Iterable[str], fill: str = "") -> str:
    """A whole SVG document on white."""
    size = f'width="{width:.0f}" height="{height:.0f}"'
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" {size} '
        f'font-family="sans-serif" font-size="12"{_fill(fill)}>'
    )
    return "\n".join([head, f'<rect {size} fill="white"/>', *body, "</svg>\n"])


def heading(x: float, y: float, content: str) -> str:
    """The title of a picture."""
    return text(x, y, content, size=15, bold=True)


def text(
    x: float, y: float, content: str, *, colour: str = "", anchor: str = "start", size: int = 0, bold: bool = False
) -> str:
    """A line of text; `content` is escaped here."""
    return f"<text {_text_place(x, y, colour, anchor, size, bold)}>{escape(content)}</text>"


def spans(
    x: float, y: float, parts: Iterable[tuple[str, str, bool]], *, colour: str = "", anchor: str = "start"
) -> str:
    """A line of text in several colours: content, colour and weight of each part."""
    pieces = "".join(f"<tspan{_fill(ink)}{_bold(bold)}>{escape(content)}</tspan>" for content, ink, bold in parts)
    return f'<text {_text_place(x, y, colour, anchor, 0, False)} xml:space="preserve">{pieces}</text>'


def outlined(x: float, y: float, content: str, colour: str, anchor: str = "start") -> str:
    """Small text that can be read over lines."""
    place, safe = f'x="{x:.1f}" y="{y:.1f}" font-size="11" text-anchor="{anchor}"', escape(content)
    return (
        f'<text {place} fill="white" stroke="white" stroke-width="3" stroke-linejoin="round">{safe}</text>'
        f'<text {place} fill="{colour}">{safe}</text>'
    )


def _text_place(x: float, y: float, colour: str, anchor: str, size: int, bold: bool) -> str:
    place = f'x="{x:.1f}" y="{y:.1f}"'
    if anchor != "start":
        place += f' text-anchor="{anchor}"'
    return place + _fill(colour) + (f' font-size="{size}"' if size else "") + _bold(bold)


def _fill(colour: str) -> str:
    return f' fill="{colour}"' if colour else ""


def _bold(bold: bool) -> str:
    return ' font-weight="bold"' if bold else ""


# --- scales and panels --------------------------------------------------------------------------------------------


def _linear(values: npt.ArrayLike) -> Floats:
    return np.asarray(values, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Scale:
    """Values to pixels; values beyond the ends are drawn at the ends."""

    # `first`, `last`: values at the ends
    first: float
    last: float
    # `start_px`, `end_px`: [px] where the ends are drawn
    start_px: float
    end_px: float
    # np.log for a logarithmic scale, np.sqrt for one of roots; linear by default
    warp: Callable[[npt.ArrayLike], Floats] = _linear

    def px(self, values: npt.ArrayLike) -> Floats:
        """Where values are drawn; NaN stays NaN. [px]"""
        low, high = float(self.warp(self.first)), float(self.warp(self.last))
        share = (self.warp(_linear(values)) - low) / max(high - low, 1e-9)
        return np.asarray(self.start_px + (self.end_px - self.start_px) * np.clip(share, 0.0, 1.0))

    def at(self, value: float) -> float:
        """Where one value is drawn. [px]"""
        return float(self.px(value))


def nice_step(value: float, *, up: bool = False) -> float:
    """1, 2 or 5 times a power of ten: the nearest below, or above."""
    power = 10.0 ** math.floor(math.log10(max(value, 1e-9)))
    steps = [power * k for k in (1, 2, 5, 10)]
    return next(s for s in steps if s >= value) if up else max(s for s in steps if s <= value * (1 + 1e-9))


def ticks(first: float, last: float, step: float) -> list[float]:
    """Multiples of a step between two values."""
    return [k * step for k in range(math.ceil(first / step), math.floor(last / step) + 1)]


@dataclass(frozen=True, slots=True)
class Panel:
    """A framed area of a picture; its sides in pixels."""

    left: float
    right: float
    top: float
    bottom: float

    @property
    def height(self) -> float:
        """Of the area. [px]"""
        return self.bottom - self.top

    @property
    def middle(self) -> float:
        """Halfway down. [px]"""
        return (self.top + self.bottom) / 2

    def frame(self) -> str:
        """Border."""
        return f'<rect {self._box()} fill="none" stroke="{FRAME}"/>'

    def clipped(self, name: str, body: Iterable[str]) -> list[str]:
        """What of a drawing lies inside the area; names are unique in a picture."""
        clip = f'<clipPath id="{name}"><rect {self._box()}/></clipPath>'
        return [clip, f'<g clip-path="url(#{name})">', *body, "</g>"]

    def line_across(self, y: float, colour: str = GRID, width: float = 1.0) -> str:
        """A horizontal line through the area."""
        return stroke(f"M{self.left} {y:.1f}H{self.right}", colour, width)

    def label_left(self, y: float, content: str, *, colour: str = GREY, bold: bool = False) -> str:
        """A label of the vertical axis."""
        return text(self.left - 6, y, content, colour=colour, anchor="end", bold=bold)

    def tick_below(self, x: float, content: str, colour: str = GREY) -> list[str]:
        """A tick of the horizontal axis with its label."""
        mark = stroke(f"M{x:.1f} {self.bottom}v5", colour)
        return [mark, text(x, self.bottom + 19, content, anchor="middle")]

    def _box(self) -> str:
        return f'x="{self.left}" y="{self.top}" width="{self.right - self.left}" height="{self.height}"'


# --- lines and dots -----------------------------------------------------------------------------------------------


def stroke(path: str, colour: str, width: float = 1.0, dash: str = "", title: str = "") -> str:
    """A path that is not filled; its title is shown under the mouse."""
    return _element("path", f'd="{path}" fill="none" stroke="{colour}"{_width(width)}{_dashed(dash)}', title)


def shape(path: str, fill: str, outline: str = "", title: str = "") -> str:
    """A filled path."""
    edge = f' stroke="{outline}" stroke-width="1.5"' if outline else ""
    return _element("path", f'd="{path}" fill="{fill}"{edge}', title)


def circle(x: float, y: float, radius: float, fill: str, title: str = "") -> str:
    """A dot."""
    return _element("circle", f'cx="{x:.1f}" cy="{y:.1f}" r="{radius}" fill="{fill}"', title)


def _element(name: str, attributes: str, title: str) -> str:
    return f"<{name} {attributes}><title>{escape(title)}</title></{name}>" if title else f"<{name} {attributes}/>"


def _width(width: float) -> str:
    return "" if width == 1.0 else f' stroke-width="{width}"'


def _dashed(dash: str) -> str:
    return f' stroke-dasharray="{dash}"' if dash else ""


def polylines(points: Floats, colour: str, width: float, dash: str = "") -> list[str]:
    """A line, broken where its points are NaN."""
    return [
        f'<polyline points="{_points_list(run)}" fill="none" stroke="{colour}"{_width(width)}{_dashed(dash)}/>'
        for run in _unbroken(points)
    ]


def area(left: Floats, right: Floats) -> list[str]:
    """The area between two lines with as many points, where both are known."""
    runs = _unbroken(np.hstack([left, right]))
    return [f'<polygon points="{_points_list(np.vstack([r[:, :2], r[::-1, 2:]]))}" fill="{_AREA}"/>' for r in runs]


def dots(points: Floats, colour: str, size: float, opacity: float = 1.0) -> str:
    """Many round dots as one path."""
    if not len(points):
        return ""
    marks = "".join(f"M{x:.1f} {y:.1f}h.01" for x, y in points.tolist())
    return f'<path d="{marks}" stroke="{colour}" stroke-width="{size}" stroke-linecap="round" opacity="{opacity}"/>'


def cross(x: float, y: float, size: float, colour: str, width: float = 1.0, title: str = "") -> str:
    """A diagonal cross; `size` is half its side."""
    path = f"M{x - size:.1f} {y - size:.1f}l{2 * size:g} {2 * size:g}m0 -{2 * size:g}l-{2 * size:g} {2 * size:g}"
    return stroke(path, colour, width, title=title)


def thin(points: Floats) -> Floats:
    """No more points than a picture can show."""
    step = math.ceil(len(points) / _MAX_POINTS)
    return points if step <= 1 else np.vstack([points[::step], points[-1:]])


def _unbroken(points: Floats) -> list[Floats]:
    """Stretches of points without NaN."""
    kept = np.isfinite(points).all(axis=1)
    edges = np.flatnonzero(np.diff(np.r_[False, kept, False].astype(np.int8)))
    return [thin(points[a:b]) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a > 1]


def _points_list(points: Floats) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in points.tolist())
