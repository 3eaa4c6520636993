"""Waymark grade of a read plate, modelled on ISO/IEC 15415 without claiming conformance.

The grade of a print by a photo is another thing: app/decoders/plate/print_grade.py.
"""

from __future__ import annotations

import numpy as np

from app.decoders.plate.decode_symbols import DecodedSymbols
from app.decoders.plate.fit import PlateFit
from app.decoders.plate.unit_likelihoods import UnitEvidence
from app.markers.plate import plate_capacity
from app.markers.reading import PlateGrade

_CONTRAST = (0.20, 0.40, 0.55, 0.70)
"""[light units] span of the levels for grades 1, 2, 3, 4. Source: symbol contrast of ISO/IEC 15415, section 7.8."""
_MODULATION = (0.20, 0.30, 0.40, 0.50)
"""[1] margin of the weakest cell for grades 1 to 4. Source: modulation of ISO/IEC 15415, section 7.8."""
_UNUSED = (0.25, 0.37, 0.50, 0.62)
"""[1] unused error correction for grades 1 to 4. Source: ISO/IEC 15415, section 7.8."""
_MARKERS = (2.0, 3.0, 4.5, 6.0)
"""[standard deviations] colour margin of the weakest marker for grades 1 to 4. Source: chosen by hand."""
_AXES = (0.15, 0.25, 0.40, 0.60)
"""[1] shorter over longer side of a unit in the image for grades 1 to 4. Source: chosen by hand."""
_GRID = (0.60, 0.75, 0.85, 0.93)
"""[1] share of the pixels' variance that the grid explains for grades 1 to 4. Source: chosen by hand."""
MODULATION_FULL = 20.0
"""[root of cost] margin of the weakest cell on a sharp, clean plate, which counts as 1. Source: chosen by hand."""


def _grade(value: float, limits: tuple[float, float, float, float]) -> float:
    """Grade from 0 to 4: the number of limits that are reached."""
    return float(np.searchsorted(limits, value, side="right"))


def grade_plate(fit: PlateFit, evidence: UnitEvidence, decoded: DecodedSymbols, weakest_marker: float) -> PlateGrade:
    """Grade of a plate that was read.

    Parameters
    ----------
    fit : PlateFit
    evidence : UnitEvidence
    decoded : DecodedSymbols
    weakest_marker : float
        Colour margin of the marker that stands out least.
    """
    values = fit.units[~np.isnan(fit.units)]
    light = max(float(np.percentile(values, 95)), 1e-6)
    contrast = evidence.span / light
    modulation = min(1.0, float(np.sqrt(max(evidence.cell_margin.min(), 0.0))) / MODULATION_FULL)
    sides = np.linalg.norm(np.roll(fit.corners_px, -1, axis=0) - fit.corners_px, axis=1)
    axial = float(min(sides[0] + sides[2], sides[1] + sides[3]) / max(sides[0] + sides[2], sides[1] + sides[3]))
    unused = 1.0
    if decoded.code is not None and decoded.code.scheme.corrects:
        capacity = plate_capacity(decoded.code.n, decoded.code.scheme).correctable_cells
        unused = max(0.0, 1 - len(decoded.corrected) / capacity)
    elif decoded.corrected:
        unused = 0.0
    parts = (
        _grade(contrast, _CONTRAST), _grade(modulation, _MODULATION), _grade(weakest_marker, _MARKERS),
        _grade(axial, _AXES), _grade(fit.explained, _GRID), _grade(unused, _UNUSED),
    )  # fmt: skip
    return PlateGrade(min(parts), *parts)
