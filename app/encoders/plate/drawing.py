"""The drawing of a plate: closed shapes in millimetres, each on a layer that has one meaning in the workshop.

Writers (svg, pdf, dxf, png) and the proof know this model and nothing of the code. Sheet frame: millimetres from the
sheet's lower left corner, x to the right, y up (the direction of travel).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import lru_cache
from typing import Literal

import numpy as np
from fontTools.pens.basePen import BasePen
from fontTools.pens.transformPen import TransformPen

from app.encoders.pdf import load_typeface
from app.values import Floats

Anchor = Literal["start", "middle", "end"]


class Layer(StrEnum):
    """What a shape stands for. The names are those of the DXF layers and of the PDF's spot inks."""

    BLEED = "BLEED"
    BASE = "BASE"
    CODE_LIGHT = "CODE_LIGHT"
    CODE_DARK = "CODE_DARK"
    MARK_RED = "MARK_RED"
    MARK_GREEN = "MARK_GREEN"
    HEATER = "HEATER"
    LED = "LED"
    ENGRAVE = "ENGRAVE"
    NOTE = "NOTE"
    CROP = "CROP"
    CUT = "CUT"


FACE_LAYERS = (Layer.BASE, Layer.CODE_LIGHT, Layer.CODE_DARK, Layer.MARK_RED, Layer.MARK_GREEN)
"""What a camera sees, bottom to top."""

UNDER_LAYERS = (Layer.HEATER, Layer.LED)
"""What lies between the base plate and the face."""

SHEET_LAYERS = (Layer.ENGRAVE, Layer.NOTE, Layer.CROP, Layer.CUT)
"""What the sheet shows round the face."""


@dataclass(frozen=True, slots=True, eq=False)
class Boxes:
    """Filled rectangles along the axes, shape (K, 4): left, bottom, right, top. [mm]"""

    layer: Layer
    boxes_mm: Floats

    def moved(self, x_mm: float, y_mm: float) -> Boxes:
        """The same rectangles elsewhere."""
        return replace(self, boxes_mm=self.boxes_mm + np.array([x_mm, y_mm, x_mm, y_mm]))


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """A filled polygon without holes, shape (K, 2); its last point joins its first. [mm]"""

    layer: Layer
    points_mm: Floats

    def moved(self, x_mm: float, y_mm: float) -> Shape:
        """The same polygon elsewhere."""
        return replace(self, points_mm=self.points_mm + np.array([x_mm, y_mm]))


@dataclass(frozen=True, slots=True, eq=False)
class Stroke:
    """A drawn line of a width, open or closed, shape (K, 2). [mm]"""

    layer: Layer
    points_mm: Floats
    width_mm: float
    closed: bool = False

    def moved(self, x_mm: float, y_mm: float) -> Stroke:
        """The same line elsewhere."""
        return replace(self, points_mm=self.points_mm + np.array([x_mm, y_mm]))


@dataclass(frozen=True, slots=True, eq=False)
class Text:
    """A line of text on its baseline; `height_mm` is that of a capital letter. [mm]"""

    layer: Layer
    text: str
    x_mm: float
    y_mm: float
    height_mm: float
    anchor: Anchor = "start"

    def moved(self, x_mm: float, y_mm: float) -> Text:
        """The same text elsewhere."""
        return replace(self, x_mm=self.x_mm + x_mm, y_mm=self.y_mm + y_mm)


@dataclass(frozen=True, slots=True, eq=False)
class Modules:
    """Filled squares of a grid, as runs along its rows; rows go down from the upper left corner.

    ``runs`` are (row, first column, number of squares), ``module_mm`` the side of a square, (x, y) the corner. [mm]
    """

    layer: Layer
    runs: tuple[tuple[int, int, int], ...]
    module_mm: float
    x_mm: float
    y_mm: float

    def moved(self, x_mm: float, y_mm: float) -> Modules:
        """The same squares elsewhere."""
        return replace(self, x_mm=self.x_mm + x_mm, y_mm=self.y_mm + y_mm)

    @property
    def boxes_mm(self) -> Floats:
        """The runs as left, bottom, right, top, shape (K, 4). [mm]"""
        row, start, count = np.array(self.runs, dtype=np.float64).reshape(-1, 3).T
        boxes: Floats = np.stack([start, -row - 1, start + count, -row], axis=1) * self.module_mm
        boxes += np.array([self.x_mm, self.y_mm, self.x_mm, self.y_mm])
        return boxes


Part = Boxes | Modules | Shape | Stroke | Text


@dataclass(frozen=True, slots=True, eq=False)
class Drawing:
    """A sheet in millimetres."""

    title: str  # for the document's properties
    # `width_mm`, `height_mm`: [mm] the sheet
    width_mm: float
    height_mm: float
    # everything on it; a writer paints the layers in its own order, the parts of a layer in this one
    parts: tuple[Part, ...]
    trim_mm: tuple[tuple[float, float, float, float], ...] = ()  # [mm] outer edge of each plate
    bleed_mm: float = 5.0  # [mm] how far the base's ink runs over the trim

    def by_layer(self) -> dict[Layer, list[Part]]:
        """Parts of every layer that is in use."""
        layers: dict[Layer, list[Part]] = {}
        for part in self.parts:
            layers.setdefault(part.layer, []).append(part)
        return layers


def moved(parts: Iterable[Part], x_mm: float, y_mm: float) -> tuple[Part, ...]:
    """The same parts elsewhere on a sheet."""
    return tuple(part.moved(x_mm, y_mm) for part in parts)


def box_points(left: float, bottom: float, right: float, top: float) -> Floats:
    """Corners of a rectangle, clockwise from the upper left, shape (4, 2)."""
    return np.array([(left, top), (right, top), (right, bottom), (left, bottom)])


# === Colours of a plate as data: what the fabricator buys, the inspector measures and the files show.
#
# Sources: ASTM D4956 (retroreflective sheeting) and its daytime chromaticity limits as printed in 23 CFR 655, subpart
# F, appendix, table 1; ASTM D6628 (colour of retroreflective pavement marking); RAL Classic "traffic" colours.


Chromaticity = tuple[tuple[float, float], ...]

_WHITE: Chromaticity = ((0.303, 0.300), (0.368, 0.366), (0.340, 0.393), (0.274, 0.329))
_RED: Chromaticity = ((0.648, 0.351), (0.735, 0.265), (0.629, 0.281), (0.565, 0.346))
_GREEN: Chromaticity = ((0.026, 0.399), (0.166, 0.364), (0.286, 0.446), (0.207, 0.771))


@dataclass(frozen=True, slots=True)
class ColourSpec:
    """What one area of the plate must look like."""

    layer: Layer
    area: str  # part of the plate, in words
    ral: str  # nearest RAL Classic colour
    sheeting: str  # ASTM D4956 colour, or why there is none
    marking: str  # ASTM D6628 colour, or why there is none
    # corners of the permitted daytime region, CIE 1931, illuminant D65, 45/0; empty where none is specified
    chromaticity_xy: Chromaticity = ()


COLOURS = (
    ColourSpec(Layer.BASE, "base and gaps", "RAL 7035 light grey", "none: matt, not retroreflective", "none"),
    ColourSpec(Layer.CODE_LIGHT, "light units", "RAL 9016 traffic white", "D4956 white", "D6628 white", _WHITE),
    ColourSpec(Layer.CODE_DARK, "dark units", "RAL 9017 traffic black", "none: matt, not retroreflective", "none"),
    ColourSpec(Layer.MARK_RED, "triangle", "RAL 3020 traffic red", "D4956 red", "none: a sheeting colour", _RED),
    ColourSpec(Layer.MARK_GREEN, "squares", "RAL 6024 traffic green", "D4956 green", "none: a sheeting colour", _GREEN),
)


@dataclass(frozen=True, slots=True)
class Ink:
    """How the files show a layer: sRGB on screens, CMYK as the alternate of the spot ink, an AutoCAD colour index."""

    rgb: tuple[int, int, int]
    cmyk: tuple[float, float, float, float]
    aci: int

    @property
    def hex(self) -> str:
        """sRGB as #rrggbb."""
        return "#{:02x}{:02x}{:02x}".format(*self.rgb)


_BASE = Ink((203, 208, 204), (0.03, 0.0, 0.02, 0.18), 9)
INKS: dict[Layer, Ink] = {
    Layer.BLEED: _BASE,
    Layer.BASE: _BASE,
    Layer.CODE_LIGHT: Ink((241, 240, 234), (0.0, 0.0, 0.02, 0.04), 254),
    Layer.CODE_DARK: Ink((30, 30, 32), (0.1, 0.05, 0.0, 0.95), 250),
    Layer.MARK_RED: Ink((187, 30, 16), (0.0, 0.95, 0.95, 0.15), 1),
    Layer.MARK_GREEN: Ink((0, 125, 75), (0.95, 0.0, 0.75, 0.35), 3),
    Layer.HEATER: Ink((214, 110, 0), (0.0, 0.55, 1.0, 0.1), 30),
    Layer.LED: Ink((0, 130, 200), (0.9, 0.3, 0.0, 0.0), 5),
    Layer.ENGRAVE: Ink((70, 40, 120), (0.7, 0.9, 0.0, 0.2), 6),
    Layer.NOTE: Ink((60, 60, 60), (0.0, 0.0, 0.0, 0.8), 8),
    Layer.CROP: Ink((0, 0, 0), (1.0, 1.0, 1.0, 1.0), 7),
    Layer.CUT: Ink((230, 0, 126), (0.0, 1.0, 0.0, 0.0), 2),
}


# === Text as outlines: no file needs a font where it is opened.
#
# Glyph coordinates are font units, y up; a run of text is a path per character, cached both per character and per text.


_SHRINK = 1 / 8  # 256 units to the em: 0.02 mm on a 2.4 mm capital, and files a third smaller
CAPITAL_UNITS = 1493.0 * _SHRINK
_CURVE_STEPS = 4


@dataclass(frozen=True, slots=True)
class _Glyph:
    """One character: `svg` relative to the current point, `pdf` from the origin, `contours` flattened."""

    advance: int
    svg: str
    pdf: str
    contours: tuple[Floats, ...]


class _OutlinePen(BasePen):  # type: ignore[misc]
    """Collects a glyph's outline in the three forms that writers use."""

    def __init__(self, glyphs: object) -> None:
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
def _run_contours(text: str) -> tuple[Floats, ...]:
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


def contours_mm(text: Text) -> list[Floats]:
    """Flattened outlines of a text on its sheet; holes are contours of their own. [mm]"""
    return [contour * scale_mm(text) + np.array(origin_mm(text)) for contour in _run_contours(text.text)]


def fitted_height_mm(text: str, height_mm: float, width_mm: float) -> float:
    """Height at which a text is no wider than `width_mm`, at most `height_mm`. [mm]"""
    units = run_units(text)
    return height_mm if units == 0 else min(height_mm, width_mm * CAPITAL_UNITS / units)


def text_width_mm(text: str, height_mm: float) -> float:
    """Width of a text. [mm]"""
    return run_units(text) * height_mm / CAPITAL_UNITS
