"""Waymark grade of a read plate, modelled on ISO/IEC 15415 without claiming conformance."""

from __future__ import annotations

import numpy as np

from app.decoders.plate.decode import DecodedSymbols
from app.decoders.plate.fit import PlateFit
from app.decoders.plate.weighing import UnitEvidence
from app.markers.plate import PlateScheme, plate_capacity
from app.markers.reading import PlateGrade

# least value for grades 1, 2, 3, 4 (ISO/IEC 15415, section 7.8)
_CONTRAST = (0.20, 0.40, 0.55, 0.70)
_MODULATION = (0.20, 0.30, 0.40, 0.50)
_UNUSED = (0.25, 0.37, 0.50, 0.62)
_MARKERS = (2.0, 3.0, 4.5, 6.0)  # colour margins, in spreads
_AXES = (0.15, 0.25, 0.40, 0.60)  # shorter over longer side of a unit in the image
_GRID = (0.60, 0.75, 0.85, 0.93)  # share of the pixels' variance that the ideal grid explains


def _step(value: float, limits: tuple[float, float, float, float]) -> float:
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
    if decoded.code is not None and decoded.code.scheme is PlateScheme.ID:
        capacity = plate_capacity(decoded.code.n, PlateScheme.ID).correctable_cells
        unused = max(0.0, 1 - len(decoded.corrected) / capacity)
    elif decoded.corrected:
        unused = 0.0
    parts = (
        _step(contrast, _CONTRAST), _step(modulation, _MODULATION), _step(weakest_marker, _MARKERS),
        _step(axial, _AXES), _step(fit.explained, _GRID), _step(unused, _UNUSED),
    )  # fmt: skip
    return PlateGrade(min(parts), *parts)


MODULATION_FULL = 20.0  # square root of the weakest cell's cost margin on a plate without any doubt
