"""Evidence of a fitted plate about its code, from one frame or from several, and the reading that follows from it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy.typing as npt

from app.decoders.plate.decode_symbols import MAX_DAMAGE, MIN_CHECKED, DecodedSymbols, decode_symbols
from app.decoders.plate.judge import Judgement
from app.decoders.plate.marker_colours import MarkerColours
from app.decoders.plate.unit_likelihoods import UnitEvidence
from app.markers.plate import PlateCode, PlateGeometry, PlateScheme
from app.markers.reading import PlateOutcome, PlateReading

MIN_CONFIDENCE = 0.9995
"""[probability] from which digits are returned. Source: no wrong digits (decision record 0005, rule 4)."""
MIN_EXPLAINED_ALONE = 0.83
"""[1] the same for digits that no registry confirms. Source: chosen by hand; effect: `python -m
benchmarks.plates.thresholds`."""
MIN_EXPLAINED_SMALL, SMALL_UNIT_PX = 0.9, 2.5
"""[1, px] the same on units below this size, where a misplaced grid explains nearly as much. Source: chosen by hand;
effect: `python -m benchmarks.plates.thresholds`."""
MIN_ROWS_ALONE = 1.5
"""[px] height of a unit in the image for digits that neither a check of 16 bits nor a registry confirms. Source: one
wrong frame of 5,192 in the trials of `python -m benchmarks.plates trials`, seeds 71 and 72."""
CLEAN_EXPLAINED = 0.93
"""[1] share of variance from which a word may be corrected without a registry. Source: chosen by hand; effect: `python
-m benchmarks.plates.thresholds`."""
MAX_WRONG, MAX_WRONG_REFUSED = 1e-3, 2e-4
"""[probability] that a unit is wrong, by the pixels, below which digits are returned that the units show surely, and
that they refuse. Source: trials in shade, under painted stains and in fair light, 690 frames (decision record 0029)."""
PLAIN_OUTLIER, PLAIN_RESIDUAL = 3.0, 0.08
"""[1, contrast] `UnitEvidence.outlier_ratio` and `level_residual` below which nothing on a plate is unusual, and its
pixels are not judged. Source: the same trials; the wrong readings had a residual of 0.096 to 0.127."""
MIN_CHECKED_CELL = 0.5
"""[probability] of a cell by the pixels below which a check that holds does not count. Source: chosen by hand."""
JUDGED_UNIT_PX = 2.0
"""[px] size of a unit from which on pixels can refuse digits that the units show surely: smaller ones show no stains.
Source: the same trials, of 49 plates of 11 to 24 rows that are read without it 36 are left with it; chosen by hand."""
SURE_CELL = 0.9
"""[probability] of each cell above which a refusal is `unsure`, below it `cells-undecodable`. Source: chosen by
hand."""
Array = npt.NDArray[Any]


@dataclass(frozen=True, slots=True, eq=False)
class PlateEvidence:
    """What one frame, or several together, show of a plate.

    Attributes
    ----------
    units : UnitEvidence
        Costs of the symbols.
    geometry : PlateGeometry
    corners_px, corners_covariance_px2 : ndarray, shapes (4, 2) and (8, 8)
        In the frame; of several frames, in the one that shows the plate largest. [px, px2]
    explained : float
        Share of the pixels' variance that the plate's pattern explains.
    unit_px, extent_px : float
        Size of a unit, and the shorter extent of the plate, in the image. [px]
    weakest_marker : float
        Colour margin of the marker that stands out least.
    thermal : bool
    missing : (PlateOutcome, str) or None
        What the plate lacks without a registry that confirms it.
    frames : int
        That the evidence is of.
    colours : MarkerColours or None
        Of the markers; None of thermal frames, and of views that were found by following a plate.
    agreeing : int
        Frames of these whose units are about the same.
    judged : bool
        The pixels of the frame have confirmed the code, see `judge`.
    """

    units: UnitEvidence
    geometry: PlateGeometry
    corners_px: Array
    corners_covariance_px2: Array
    explained: float
    unit_px: float
    extent_px: float
    weakest_marker: float = math.inf
    thermal: bool = False
    missing: tuple[PlateOutcome, str] | None = None
    frames: int = 1
    colours: MarkerColours | None = None
    agreeing: int = 1
    judged: bool = False


def read_evidence(
    reading: PlateReading, evidence: PlateEvidence, codebook: Sequence[PlateCode],
    judge: Callable[[PlateCode], Judgement | None] | None = None,
) -> tuple[PlateReading, DecodedSymbols]:  # fmt: skip
    """Complete a reading by the code that evidence shows, or by the reason why it shows none.

    Parameters
    ----------
    reading : PlateReading
        Where the plate is.
    evidence : PlateEvidence
    codebook : sequence of PlateCode
        Codes of the plates registered near by.
    judge : callable, optional
        Judges digits that neither a check nor the registry confirms by the frame's pixels, where the units alone leave
        a doubt.
    """
    geometry, thermal = evidence.geometry, evidence.thermal
    decoded = decode_symbols(
        evidence.units, geometry.n, codebook, MIN_CONFIDENCE,
        clean=evidence.explained > CLEAN_EXPLAINED and not thermal,  # no colours confirm its orientation
        max_damage=math.inf if thermal else MAX_DAMAGE,  # a stain does not hide a heater
        min_checked=MIN_CHECKED if evidence.agreeing < 2 else 0.0,
    )  # fmt: skip
    if judge is not None and _is_to_be_judged(evidence, decoded):
        decoded = _judged(decoded, judge)
    reading = replace(
        reading,
        confidence=decoded.confidence,
        cell_confidence=decoded.cell_confidence,
        corrected_cells=decoded.corrected,
        from_codebook=decoded.from_codebook,
    )
    missing = evidence.missing
    if decoded.code is None:
        outcome, reason = missing or _undecoded(decoded)
        return replace(reading, outcome=outcome, reason=reason), decoded
    min_explained = MIN_EXPLAINED_SMALL if evidence.unit_px < SMALL_UNIT_PX else MIN_EXPLAINED_ALONE
    weak = missing is not None or evidence.explained < min_explained
    small = decoded.code.scheme is not PlateScheme.ID and evidence.extent_px < MIN_ROWS_ALONE * geometry.n
    if small and not weak and not decoded.confirmed:
        reason = f"a plate of less than {MIN_ROWS_ALONE * geometry.n:g} rows, and these digits have no check"
        return replace(reading, outcome=PlateOutcome.UNSURE, reason=reason), decoded
    if weak and not decoded.confirmed:
        outcome, reason = missing or (PlateOutcome.UNSURE, "the plate's pattern explains too little of the image")
        return replace(reading, outcome=outcome, reason=reason), decoded
    read = replace(
        reading, outcome=PlateOutcome.READ, code=decoded.code, from_codebook=decoded.from_codebook or weak, reason=""
    )
    return read, decoded


def _is_to_be_judged(evidence: PlateEvidence, decoded: DecodedSymbols) -> bool:
    """Whether the pixels decide: nothing else confirms or refuses the digits, and the units leave a doubt."""
    code = decoded.code or decoded.likely
    if code is None or decoded.confirmed or evidence.missing is not None:
        return False
    small = code.scheme is not PlateScheme.ID and evidence.extent_px < MIN_ROWS_ALONE * evidence.geometry.n
    min_explained = MIN_EXPLAINED_SMALL if evidence.unit_px < SMALL_UNIT_PX else MIN_EXPLAINED_ALONE
    if small or evidence.explained < min_explained:
        return False
    units = evidence.units
    is_plain = units.outlier_ratio < PLAIN_OUTLIER and float(units.level_residual.max()) < PLAIN_RESIDUAL
    return decoded.code is None or (evidence.unit_px >= JUDGED_UNIT_PX and not is_plain)


def _judged(decoded: DecodedSymbols, judge: Callable[[PlateCode], Judgement | None]) -> DecodedSymbols:
    """The code where the pixels leave no doubt, or the refusal with the cells that may be wrong."""
    code = decoded.code or decoded.likely
    assert code is not None
    found = judge(code)
    if found is None:
        return replace(decoded, code=None)
    cells, confidence = found.cell_confidence, 1 - found.wrong
    if code.scheme is PlateScheme.ID:
        # a check holds by accident in deep shade, which looks like dark units: what it did not correct must be there
        against = [i for i, cell in enumerate(cells) if cell < MIN_CHECKED_CELL and i not in decoded.corrected]
        if not against:
            return decoded
        reason = f"the pixels speak against the cells {', '.join(map(str, against))}, though the check holds"
        return replace(decoded, code=None, confidence=0.0, cell_confidence=cells, reason=reason)
    limit = MAX_WRONG if decoded.code is not None else MAX_WRONG_REFUSED
    if found.wrong < limit:
        return replace(decoded, code=code, likely=None, confidence=confidence, cell_confidence=cells, reason="")
    doubtful = ", ".join(str(i) for i, cell in enumerate(cells) if 1 - cell > limit / len(cells))
    reason = f"a stain may hide units of the cells {doubtful}, and these digits have no check"
    return replace(decoded, code=None, likely=code, confidence=confidence, cell_confidence=cells, reason=reason)


def _undecoded(decoded: DecodedSymbols) -> tuple[PlateOutcome, str]:
    if decoded.likely is not None:
        return PlateOutcome.UNSURE, decoded.reason
    sure_cells = bool(decoded.cell_confidence) and min(decoded.cell_confidence) > SURE_CELL
    return (PlateOutcome.UNSURE if sure_cells else PlateOutcome.CELLS_UNDECODABLE), decoded.reason
