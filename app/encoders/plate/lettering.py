"""Text as outlines: no file needs a font where it is opened.

Glyph coordinates are font units, y up; a run of text is a path per character, cached both per character and per text.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from fontTools.pens.basePen import BasePen
from fontTools.pens.transformPen import TransformPen

from app.encoders.plate.drawing import FloatArray, Text
from app.encoders.typeface import load_typeface

_SHRINK = 1 / 8  # 256 units to the em: 0.02 mm on a 2.4 mm capital, and files a third smaller
CAPITAL_UNITS = 1493.0 * _SHRINK
_CURVE_STEPS = 4


@dataclass(frozen=True, slots=True)
class _Glyph:
    """One character: `svg` relative to the current point, `pdf` from the origin, `contours` flattened."""

    advance: int
    svg: str
    pdf: str
    contours: tuple[FloatArray, ...]


class _OutlinePen(BasePen):  # type: ignore[misc]
    """Collects a glyph's outline in the three forms that writers use."""

    def __init__(self, glyphs: Any) -> None:
        super().__init__(glyphs)
        self.svg: list[str] = []
        self.pdf: list[str] = []
        self.contours: list[list[tuple[float, float]]] = []
        self._at = (0, 0)

    def _relative(self, *points: tuple[float, float]) -> str:
        x, y = self._at
        text = " ".join(f"{round(px) - x} {round(py) - y}" for px, py in points)
        self._at = (round(points[-1][0]), round(points[-1][1]))
        return text

    def _moveTo(self, pt: tuple[float, float]) -> None:
        self.pdf.append(f"{pt[0]:.0f} {pt[1]:.0f} m")
        self.svg.append(f"m{self._relative(pt)}")
        self.contours.append([pt])

    def _lineTo(self, pt: tuple[float, float]) -> None:
        self.pdf.append(f"{pt[0]:.0f} {pt[1]:.0f} l")
        self.svg.append(f"l{self._relative(pt)}")
        self.contours[-1].append(pt)

    def _qCurveToOne(self, pt1: tuple[float, float], pt2: tuple[float, float]) -> None:
        start, control, end = (np.array(point) for point in (self.contours[-1][-1], pt1, pt2))
        for t in np.arange(1, _CURVE_STEPS + 1) / _CURVE_STEPS:
            point = (1 - t) ** 2 * start + 2 * (1 - t) * t * control + t**2 * end
            self.contours[-1].append((float(point[0]), float(point[1])))
        cubic = (start + 2 * (control - start) / 3, end + 2 * (control - end) / 3, end)  # PDF has no quadratic curves
        self.pdf.append(" ".join(f"{x:.0f} {y:.0f}" for x, y in cubic) + " c")
        self.svg.append(f"q{self._relative(pt1, pt2)}")

    def _closePath(self) -> None:
        self.pdf.append("h")
        self.svg.append("z")
        self._at = (round(self.contours[-1][0][0]), round(self.contours[-1][0][1]))


@lru_cache(maxsize=1024)
def _glyph(character: str) -> _Glyph:
    face = load_typeface()
    glyphs, name = face.glyphs, face.glyph_name(character, ".notdef")
    pen = _OutlinePen(glyphs)
    glyphs[name].draw(TransformPen(pen, (_SHRINK, 0, 0, _SHRINK, 0, 0)))
    contours = tuple(np.array(contour) for contour in pen.contours)
    return _Glyph(round(glyphs[name].width * _SHRINK), "".join(pen.svg), " ".join(pen.pdf), contours)


@lru_cache(maxsize=4096)
def run_units(text: str) -> int:
    """Width of a text in font units."""
    return sum(_glyph(c).advance for c in text)


@lru_cache(maxsize=4096)
def svg_run(text: str) -> str:
    """SVG path data of a text in font units, y up."""
    pen, pieces = 0, []
    for glyph in map(_glyph, text):
        if glyph.svg:
            pieces.append(f"M{pen} 0{glyph.svg}")
        pen += glyph.advance
    return "".join(pieces)


@lru_cache(maxsize=4096)
def pdf_run(text: str) -> str:
    """PDF operators that fill a text in font units, y up; moves the origin along."""
    pen, pieces = 0, []
    for glyph in map(_glyph, text):
        if glyph.pdf:
            pieces.append(f"1 0 0 1 {pen} 0 cm {glyph.pdf} f")
            pen = 0
        pen += glyph.advance
    return "\n".join(pieces)


@lru_cache(maxsize=1024)
def _run_contours(text: str) -> tuple[FloatArray, ...]:
    pen, contours = 0, []
    for glyph in map(_glyph, text):
        contours += [contour + np.array([pen, 0.0]) for contour in glyph.contours]
        pen += glyph.advance
    return tuple(contours)


def scale_mm(text: Text) -> float:
    """Millimetres per font unit."""
    return text.height_mm / CAPITAL_UNITS


def origin_mm(text: Text) -> tuple[float, float]:
    """Where the first character stands, after the anchor. [mm]"""
    share = {"start": 0.0, "middle": 0.5, "end": 1.0}[text.anchor]
    return text.x_mm - share * run_units(text.text) * scale_mm(text), text.y_mm


def contours_mm(text: Text) -> list[FloatArray]:
    """Flattened outlines of a text on its sheet; holes are contours of their own. [mm]"""
    return [contour * scale_mm(text) + np.array(origin_mm(text)) for contour in _run_contours(text.text)]


def fitted_height_mm(text: str, height_mm: float, width_mm: float) -> float:
    """Height at which a text is no wider than `width_mm`, at most `height_mm`. [mm]"""
    units = run_units(text)
    return height_mm if units == 0 else min(height_mm, width_mm * CAPITAL_UNITS / units)


def text_width_mm(text: str, height_mm: float) -> float:
    """Width of a text. [mm]"""
    return run_units(text) * height_mm / CAPITAL_UNITS
