"""Print grade of a plate: parameters, thresholds and grades, after ISO/IEC 15415 without claiming conformance.

The grade of a plate that a vehicle read in traffic is another thing: `PlateGrade` of app/markers/reading.py.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from app.markers.plate import PlateCode, PlateGeometry
from app.markers.reading import PlateOutcome

Floats = npt.NDArray[np.float64]
LETTERS = "FDCBA"
"""Letters of the grades 0 to 4. Source: ISO/IEC 15415, as ANSI X3.182 writes them."""


class PrintParameterName(StrEnum):
    """What is graded."""

    SYMBOL_CONTRAST = "symbol-contrast"
    MODULATION = "modulation"
    REFLECTANCE_MARGIN = "reflectance-margin"
    AXIAL_NONUNIFORMITY = "axial-nonuniformity"
    GRID_NONUNIFORMITY = "grid-nonuniformity"
    PRINT_GROWTH = "print-growth"
    COLOUR = "colour"
    DAMAGE = "damage"
    UNUSED_ERROR_CORRECTION = "unused-error-correction"
    DECODE = "decode"


@dataclass(frozen=True, slots=True)
class PrintThresholds:
    """Limits of a parameter.

    Attributes
    ----------
    limits : tuple of float
        Values at which the grades A, B, C and D end, in the unit of the parameter.
    unit : str
        ``%`` or ``1``.
    rising : bool
        Whether a higher value is better.
    source : str
    """

    limits: tuple[float, float, float, float]
    unit: str
    rising: bool
    source: str

    def grade(self, value: float) -> float:
        """4 to 0: the best grade whose limit the value meets."""
        met = [value >= limit if self.rising else value <= limit for limit in self.limits]
        return float(4 - met.index(True)) if any(met) else 0.0


_ISO = "ISO/IEC 15415"
_OWN = "chosen by hand: at 1 the gap is closed; ISO/IEC 15415 gives none"
_TRIAL = "trial: python -m benchmarks.plates print"
THRESHOLDS = {
    PrintParameterName.SYMBOL_CONTRAST: PrintThresholds((70, 55, 40, 20), "%", True, _ISO),
    PrintParameterName.MODULATION: PrintThresholds((50, 40, 30, 20), "%", True, _ISO),
    PrintParameterName.REFLECTANCE_MARGIN: PrintThresholds((50, 40, 30, 20), "%", True, _ISO),
    PrintParameterName.AXIAL_NONUNIFORMITY: PrintThresholds((0.06, 0.08, 0.10, 0.12), "1", False, _ISO),
    PrintParameterName.GRID_NONUNIFORMITY: PrintThresholds((0.38, 0.50, 0.63, 0.75), "1", False, _ISO),
    PrintParameterName.PRINT_GROWTH: PrintThresholds((0.50, 0.70, 0.85, 0.99), "1", False, _OWN),
    PrintParameterName.COLOUR: PrintThresholds((0.12, 0.09, 0.06, 0.04), "1", True, _TRIAL),
    PrintParameterName.DAMAGE: PrintThresholds((1.0, 2.0, 4.0, 7.0), "%", False, _TRIAL),
    PrintParameterName.UNUSED_ERROR_CORRECTION: PrintThresholds((0.62, 0.50, 0.37, 0.25), "1", True, _ISO),
    PrintParameterName.DECODE: PrintThresholds((1, 1, 1, 1), "1", True, _ISO),
}
"""Thresholds of all parameters. Sources: docs/decisions/0009-plate-artwork.md."""


@dataclass(frozen=True, slots=True)
class PrintParameter:
    """A graded parameter.

    Attributes
    ----------
    name : PrintParameterName
    value : float
        In the unit of its thresholds.
    grade : float
        4 (A) to 0 (F).
    finding : str
        What was measured, in words.
    cure : str
        What the printer can do about it; empty where the grade is A.
    unit_at : (int, int) or None
        Row and column of the unit that limits, from 1, of the triangle's corner.
    """

    name: PrintParameterName
    value: float
    grade: float
    finding: str
    cure: str = ""
    unit_at: tuple[int, int] | None = None

    @property
    def letter(self) -> str:
        """A, B, C, D or F."""
        return LETTERS[int(self.grade)]


@dataclass(frozen=True, slots=True)
class PrintView:
    """How the photo shows the plate.

    Attributes
    ----------
    side_px : float
        Mean side of the plate. [px]
    tilt_deg : float
        Between the camera's axis and the plate's normal. [deg]
    edge_mm : float
        Width of edges, from 10 to 90 %. [mm]
    light_ratio : float
        Brightest over darkest light on the plate.
    white_level : float
        Brightest channel of the light units as the photo stores it, 0 to 255.
    focal_known : bool
        Whether the focal length is that of the photo's EXIF.
    """

    side_px: float
    tilt_deg: float
    edge_mm: float
    light_ratio: float
    white_level: float
    focal_known: bool


@dataclass(frozen=True, slots=True, eq=False)
class PrintGrade:
    """Grade of a printed plate by a photo.

    Attributes
    ----------
    code : PlateCode
        What the plate should be: as expected, or as read.
    geometry : PlateGeometry
        Of the drawing.
    expected : bool
        Whether the code was given, not read.
    outcome : PlateOutcome
        Of reading the photo without a registry.
    read : str or None
        Digits that were read.
    view : PrintView
    parameters : tuple of PrintParameter
    modulation : ndarray, shape (n, n)
        Reflectance margin of each unit, NaN in the corner cells. [1]
    wrong : ndarray of bool, shape (n, n)
        Units that are dark in place of light, or light in place of dark.
    face : ndarray of uint8, shape (H, W, 3)
        The plate rectified, in even light, as sRGB in the order blue, green, red.
    reflectance : ndarray of float32, shape (H, W, 3)
        The same, linear, relative to the light units.
    """

    code: PlateCode
    geometry: PlateGeometry
    expected: bool
    outcome: PlateOutcome
    read: str | None
    view: PrintView
    parameters: tuple[PrintParameter, ...]
    modulation: Floats = field(repr=False)
    wrong: npt.NDArray[np.bool_] = field(repr=False)
    face: npt.NDArray[np.uint8] = field(repr=False)
    reflectance: npt.NDArray[np.float32] = field(repr=False)

    @property
    def overall(self) -> float:
        """The lowest of the parameters' grades."""
        return min(parameter.grade for parameter in self.parameters)

    @property
    def letter(self) -> str:
        """A, B, C, D or F."""
        return LETTERS[int(self.overall)]

    @property
    def limited_by(self) -> tuple[PrintParameterName, ...]:
        """The parameters that have the overall grade."""
        return tuple(parameter.name for parameter in self.parameters if parameter.grade == self.overall)
