"""The drawing of a plate: closed shapes in millimetres, each on a layer that has one meaning in the workshop.

Writers (svg, pdf, dxf, png) and the proof know this model and nothing of the code. Sheet frame: millimetres from the
sheet's lower left corner, x to the right, y up (the direction of travel).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Literal

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
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
    boxes_mm: FloatArray

    def moved(self, x_mm: float, y_mm: float) -> Boxes:
        """The same rectangles elsewhere."""
        return replace(self, boxes_mm=self.boxes_mm + np.array([x_mm, y_mm, x_mm, y_mm]))


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """A filled polygon without holes, shape (K, 2); its last point joins its first. [mm]"""

    layer: Layer
    points_mm: FloatArray

    def moved(self, x_mm: float, y_mm: float) -> Shape:
        """The same polygon elsewhere."""
        return replace(self, points_mm=self.points_mm + np.array([x_mm, y_mm]))


@dataclass(frozen=True, slots=True, eq=False)
class Stroke:
    """A drawn line of a width, open or closed, shape (K, 2). [mm]"""

    layer: Layer
    points_mm: FloatArray
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
    def boxes_mm(self) -> FloatArray:
        """The runs as left, bottom, right, top, shape (K, 4). [mm]"""
        row, start, count = np.array(self.runs, dtype=np.float64).reshape(-1, 3).T
        boxes: FloatArray = np.stack([start, -row - 1, start + count, -row], axis=1) * self.module_mm
        boxes += np.array([self.x_mm, self.y_mm, self.x_mm, self.y_mm])
        return boxes


Part = Boxes | Modules | Shape | Stroke | Text


@dataclass(frozen=True, slots=True, eq=False)
class Drawing:
    """A sheet in millimetres.

    Attributes
    ----------
    title : str
        For the document's properties.
    width_mm, height_mm : float
        The sheet. [mm]
    parts : tuple of Part
        Everything on it; a writer paints the layers in its own order, the parts of a layer in this one.
    trim_mm : tuple of (left, bottom, right, top)
        Outer edge of each plate. [mm]
    bleed_mm : float
        How far the base's ink runs over the trim. [mm]
    """

    title: str
    width_mm: float
    height_mm: float
    parts: tuple[Part, ...]
    trim_mm: tuple[tuple[float, float, float, float], ...] = ()
    bleed_mm: float = 5.0

    def by_layer(self) -> dict[Layer, list[Part]]:
        """Parts of every layer that is in use."""
        layers: dict[Layer, list[Part]] = {}
        for part in self.parts:
            layers.setdefault(part.layer, []).append(part)
        return layers


def moved(parts: Iterable[Part], x_mm: float, y_mm: float) -> tuple[Part, ...]:
    """The same parts elsewhere on a sheet."""
    return tuple(part.moved(x_mm, y_mm) for part in parts)


def box_points(left: float, bottom: float, right: float, top: float) -> FloatArray:
    """Corners of a rectangle, clockwise from the upper left, shape (4, 2)."""
    return np.array([(left, top), (right, top), (right, bottom), (left, bottom)])
