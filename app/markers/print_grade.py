"""Print grade of a plate: parameters, thresholds and grades, after ISO/IEC 15415 without claiming conformance.

The grade of a plate that a vehicle read in traffic is another thing: `PlateGrade` of app/markers/reading.py.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field

from app.markers.plate import PlateCode, PlateGeometry
from app.markers.reading import PlateOutcome
from app.values import Floats

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
    """Values at which the grades of a parameter end."""

    # values at which the grades A, B, C and D end, in the unit of the parameter
    limits: tuple[float, float, float, float]
    unit: str  # ``%`` or ``1``
    higher_is_better: bool
    source: str

    def grade(self, value: float) -> float:
        """4 to 0: the best grade whose limit the value meets."""
        met = [value >= limit if self.higher_is_better else value <= limit for limit in self.limits]
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
    """A graded parameter."""

    name: PrintParameterName
    value: float
    unit: str
    grade: float  # 4 (A) to 0 (F)
    letter: str  # A, B, C, D or F
    thresholds: PrintThresholds
    finding: str  # what was measured, in words
    cure: str | None  # what the printer can do about it; None where the grade is A
    unit_at: Annotated[
        tuple[int, int] | None,
        Field(description="Row and column of the unit that limits the grade, from 1, from the triangle's corner."),
    ]


@dataclass(frozen=True, slots=True)
class PrintView:
    """How a photo shows a plate."""

    side_px: float  # [px] mean side of the plate
    tilt_deg: float  # [deg] between the camera's axis and the plate's normal
    edge_mm: float  # [mm] width of edges, from 10 to 90 %
    light_ratio: float  # brightest over darkest light on the plate
    white_level: float  # brightest channel of the light units as the photo stores it, 0 to 255
    focal_length_source: Literal["exif", "assumed"]


@dataclass(frozen=True, slots=True, eq=False)
class PrintGrade:
    """Grade of a printed plate by a photo."""

    code: PlateCode  # what the plate should be: as expected, or as read
    geometry: PlateGeometry  # of the drawing
    expected: bool  # whether the code was given, not read
    outcome: PlateOutcome  # of reading the photo without a registry
    read: str | None  # digits that were read
    view: PrintView
    parameters: tuple[PrintParameter, ...]
    modulation: Floats = field(repr=False)  # shape (n, n): [1] reflectance margin of each unit, NaN in the corner cells
    # shape (n, n): units that are dark in place of light, or light in place of dark
    wrong: npt.NDArray[np.bool_] = field(repr=False)
    # shape (H, W, 3): the plate rectified, in even light, as sRGB in the order blue, green, red
    face: npt.NDArray[np.uint8] = field(repr=False)
    # shape (H, W, 3): the same, linear, relative to the light units
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


@dataclass(frozen=True, slots=True)
class PrintPrediction:
    """Whether vehicles that know the registry will read a printed plate."""

    speed_kmh: float  # design speed
    camera: str  # its name
    condition: str
    readable_frames_per_pass: float  # mean frames of a pass in which a unit is a pixel high or more
    # `simulated_frames`, `frames_read`: frames that were simulated with the plate's measured face, and those read with
    # the registry
    simulated_frames: int
    frames_read: int
    frames_read_alone: int  # without the registry
    frames_wrong: int  # in which other digits were read
    unit_height_ratio: float  # how much higher a unit's image must be than a faultless plate's
    # `read_rate`, `faultless_read_rate`: probability that a pass reads this plate, and a faultless one
    read_rate: float
    faultless_read_rate: float
    will_be_read: bool  # whether the rate reaches the rate below which plans report a marker
    basis: str  # what the prediction rests on
