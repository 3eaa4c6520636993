"""Evidence of a fitted plate about its code, from one frame or from several, and the reading that follows from it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from app.decoders.plate import Array
from app.decoders.plate.confirm import UnitVerification, with_unseen_damage
from app.decoders.plate.decode_symbols import MAX_DAMAGE, DecodedSymbols, decode_symbols, symbol_probabilities
from app.decoders.plate.marker_colours import MarkerColours, count_clear
from app.decoders.plate.unit_likelihoods import UnitEvidence
from app.markers.plate import PlateCode, PlateGeometry
from app.markers.reading import PlateOutcome, PlateReading, SymbolEvidence

MIN_CONFIDENCE = 0.9995
"""[probability] from which digits are returned. Source: no wrong digits (decision record 0010, rule 5)."""
MIN_EXPLAINED_ALONE = 0.83
"""[1] the same for digits that no registry confirms. Effect: `python -m benchmarks.plates.thresholds`."""
MIN_EXPLAINED_SMALL, SMALL_UNIT_PX = 0.9, 2.5
"""[1, px] the same on units below this size, where a misplaced grid explains nearly as much. Effect: `python -m
benchmarks.plates.thresholds`."""
MIN_ROWS_ALONE = 1.25
"""[px] height of a unit in the image for digits that neither a check of 16 bits nor a registry confirms. Source: frames
of `python -m benchmarks.plates trials` of 10 to 12 rows: below it the units are rarely sure."""
CLEAN_EXPLAINED = 0.93
"""[1] share of variance from which a word may be corrected without a registry. Effect: `python -m
benchmarks.plates.thresholds`."""
CLEAR_MARKERS, CLEAR_LOOK_ALIKES = 3, 0.1
"""[markers, 1] clear markers from which on one may be hidden, and share of the look-alikes that have as many. Effect:
`python -m benchmarks.plates false --sets look-alikes`."""
MAX_ERROR = 1e-4
"""[probability] of an error by the pixels, below which digits are returned. Source: trials in shade, under painted
stains and in fair light (decision record 0011)."""
MAX_SMALL_ERROR = 1e-3
"""[probability] the same on units below `VERIFIED_UNIT_PX` that look usual; others have `MAX_ERROR`. Source: the same
trials, and plates under painted stains (decision record 0011)."""
MAX_VEILED_ERROR = 2e-5
"""[probability] the same under a veil of glare, which is one unknown field more. Source: a
tenth of `MAX_ERROR`, with which test plates in glare with paint over one whole unit are misread no more often than
without the veil (decision record 0011)."""
PLAIN_OUTLIER, PLAIN_RESIDUAL = 3.0, 0.08
"""[1, contrast] `UnitEvidence.outlier_ratio` and `level_residual` below which nothing on a plate is unusual, and its
pixels are not compared. Source: the same trials; the wrong readings had a residual of 0.063 to 0.127."""
PLAIN_GAP, GAP_UNIT_PX = 0.8, 3.0
"""[light units, px] light of gaps above which light paint does not show on them, so that pixels are compared, and size
of a unit from which on they are: on smaller ones they show too little to confirm anything. Source: the same trials."""
MIN_CHECKED_CELL = 0.5
"""[probability] of a cell by the pixels below which a check that holds does not count."""
VERIFIED_UNIT_PX, PLAIN_SMALL_RESIDUAL = 2.0, 0.12
"""[px, contrast] size of a unit below which pixels show few stains, and the residual that is usual there. Source: the
same trials: with the residual of larger units 36 of 49 plates of 11 to 24 rows are left, with this one 47."""
MAX_TENTATIVE_ERROR, TENTATIVE_CONFIDENCE, TENTATIVE_EXPONENT = 0.1, 0.9, 2.0
"""[probability, probability, 1] of an error by the pixels up to which a refused code is returned as tentative, the most
that its confidence is, and how often the probability of no error by the pixels counts. Source: of 125 tentative
readings 94, 89, 92 and 78 % are right at an error of up to 1e-3, 0.01, 0.03 and 0.1 by the pixels (record 0011)."""
SURE_CELL = 0.9
"""[probability] of each cell above which a refusal is `unsure`, below it `cells-undecodable`."""
Verify = Callable[[PlateCode], UnitVerification | None]
"""Compares the pixels of a plate with a code; None where it has too few."""


@dataclass(frozen=True, slots=True, eq=False)
class PlateEvidence:
    """What one frame, or several together, show of a plate."""

    units: UnitEvidence  # costs of the symbols
    geometry: PlateGeometry
    # `corners_px`, `corners_covariance_px2`: in the frame; of several frames, in the one that shows the plate largest.
    # [px, px2]
    corners_px: Array
    corners_covariance_px2: Array
    explained: float  # share of the pixels' variance that the plate's pattern explains
    # `unit_px`, `extent_px`: [px] size of a unit, and the shorter extent of the plate, in the image
    unit_px: float
    extent_px: float
    weakest_marker: float = math.inf  # colour margin of the marker that stands out least
    thermal: bool = False
    missing: tuple[PlateOutcome, str] | None = None  # what the plate lacks without a registry that confirms it
    frames: int = 1  # that the evidence is of
    # of the markers; None of thermal frames, and of views that were found by following a plate
    colours: MarkerColours | None = None
    agreeing: int = 1  # frames of these whose units are about the same
    # of the code that the units show, where the frame's pixels were compared
    verification: UnitVerification | None = None
    tries: int = 1  # places of which this is the one that is most like a pattern of the registry


def read_evidence(
    reading: PlateReading, evidence: PlateEvidence, codebook: Sequence[PlateCode], verify: Verify | None = None
) -> tuple[PlateReading, DecodedSymbols]:
    """Complete a reading by the code that evidence shows, or by the reason why it shows none.

    Parameters
    ----------
    reading : PlateReading
        Where the plate is.
    codebook : sequence of PlateCode
        Codes of the plates registered nearby.
    verify : callable, optional
        Compares the pixels with a code that the registry does not confirm, where something on the plate is unusual;
        where it cannot, the units decide.
    """
    thermal, look_alikes = evidence.thermal, _look_alikes(evidence)
    decoded = decode_symbols(
        evidence.units, evidence.geometry.n, codebook, MIN_CONFIDENCE,
        clean=evidence.explained > CLEAN_EXPLAINED and not thermal,  # no colours confirm its orientation
        look_alikes=look_alikes,
        max_damage=math.inf if thermal else MAX_DAMAGE,  # a stain does not hide a heater
    )  # fmt: skip
    lacking = _find_lacking(evidence)
    refusal = lacking or _is_small(evidence, decoded) or _is_regular(decoded)
    usual, settled = _is_usual(evidence, decoded), decoded.confirmed or decoded.checked
    if refusal is None and not settled and verify is not None and not (usual and _shows_paint(evidence, decoded)):
        decoded = _verified(decoded, verify, _max_error(evidence, usual))
    has_check = decoded.code is not None and decoded.code.scheme.corrects
    is_unsure_alone = refusal is not None or not (usual or has_check)
    found = decoded.verification
    reading = replace(
        reading,
        confidence=decoded.confidence,
        cell_confidence=decoded.cell_confidence,
        corrected_cells=decoded.corrected,
        from_codebook=decoded.from_codebook or (decoded.confirmed and not decoded.checked and is_unsure_alone),
        unit_log_likelihoods=found.log_likelihoods if found is not None else None,
        symbols=None if thermal else SymbolEvidence(np.log(16 * symbol_probabilities(evidence.units)), look_alikes),
    )
    if decoded.code is not None and (settled or refusal is None):
        read = replace(
            reading, outcome=PlateOutcome.READ, code=decoded.code, reason="", is_registered=decoded.confirmed
        )
        return with_unseen_damage(read), decoded
    if lacking is None and not thermal:
        reading = _tentative(reading, decoded)
    if decoded.code is None or refusal is None:
        refusal = evidence.missing or _undecoded(decoded)
    outcome, reason = refusal
    confidence = 0.0 if reading.likely_code is None else reading.confidence  # of no digits, none are right
    return replace(reading, outcome=outcome, reason=reason, confidence=confidence), decoded


def _tentative(reading: PlateReading, decoded: DecodedSymbols) -> PlateReading:
    """The reading with the likely code, if that is as likely as a tentative one must be."""
    code, cells = decoded.code or decoded.likely, decoded.cell_confidence
    if code is None or decoded.confidence < 1 - MAX_TENTATIVE_ERROR:
        return reading
    share = (1 - decoded.confidence) / len(cells)  # as if the error was spread evenly
    doubtful = tuple(i for i, cell in enumerate(cells) if 1 - cell >= share) or (int(np.argmin(cells)),)
    confidence = TENTATIVE_CONFIDENCE * decoded.confidence**TENTATIVE_EXPONENT
    return replace(reading, likely_code=code, doubtful_cells=doubtful, confidence=confidence)


def _find_lacking(evidence: PlateEvidence) -> tuple[PlateOutcome, str] | None:
    """What a plate lacks whose digits no registry confirms."""
    if evidence.missing is not None:
        return evidence.missing
    if evidence.explained < (MIN_EXPLAINED_SMALL if evidence.unit_px < SMALL_UNIT_PX else MIN_EXPLAINED_ALONE):
        return PlateOutcome.UNSURE, "the plate's pattern explains too little of the image"
    return None


def _look_alikes(evidence: PlateEvidence) -> float:
    """Look-alikes over those of one place whose grid and markers show as much of a plate."""
    has_markers = evidence.colours is not None and count_clear(evidence.colours) >= CLEAR_MARKERS
    share = CLEAR_LOOK_ALIKES if has_markers and evidence.explained >= MIN_EXPLAINED_ALONE else 1.0
    return share * evidence.tries


def _is_small(evidence: PlateEvidence, decoded: DecodedSymbols) -> tuple[PlateOutcome, str] | None:
    """The refusal of digits without a check where a plate is too small for them."""
    code, min_rows = decoded.code or decoded.likely, MIN_ROWS_ALONE * evidence.geometry.n
    if code is not None and not code.scheme.corrects and evidence.extent_px < min_rows:
        return PlateOutcome.UNSURE, f"a plate of less than {min_rows:g} rows, and these digits have no check"
    return None


def _is_regular(decoded: DecodedSymbols) -> tuple[PlateOutcome, str] | None:
    """The refusal of one symbol in all cells without a check: tiles and grids with coloured corners show it too."""
    code = decoded.code or decoded.likely
    if code is not None and not code.scheme.corrects and len(set(code.symbols)) == 1:
        return PlateOutcome.UNSURE, "the same symbol in all cells, as a pattern of tiles shows it, and no check"
    return None


def _is_usual(evidence: PlateEvidence, decoded: DecodedSymbols) -> bool:
    """Whether the units show digits surely, and none of them is unusual."""
    if decoded.code is None:
        return False
    units, small = evidence.units, evidence.unit_px < VERIFIED_UNIT_PX
    if not units.veils[0].is_even:
        return False
    if small and decoded.code.scheme.corrects:
        return True
    residual = float(units.level_residual.max())
    return residual < (PLAIN_SMALL_RESIDUAL if small else PLAIN_RESIDUAL) and units.outlier_ratio < PLAIN_OUTLIER


def _shows_paint(evidence: PlateEvidence, decoded: DecodedSymbols) -> bool:
    """Whether paint over a unit would make it unusual, or where it does not, a check would show it."""
    if evidence.unit_px < VERIFIED_UNIT_PX:
        return decoded.code is not None and decoded.code.scheme.corrects
    return evidence.units.gap <= PLAIN_GAP or evidence.unit_px < GAP_UNIT_PX


def _max_error(evidence: PlateEvidence, usual: bool) -> float:
    """Error probability by the pixels from which on digits are refused."""
    if not evidence.units.veils[0].is_even:
        return MAX_VEILED_ERROR
    return MAX_SMALL_ERROR if usual and evidence.unit_px < VERIFIED_UNIT_PX else MAX_ERROR


def _verified(decoded: DecodedSymbols, verify: Verify, max_error: float) -> DecodedSymbols:
    """The code where the pixels agree with it, or the refusal with the cells that may be wrong.

    An error probability of `max_error` or more refuses.
    """
    code = decoded.code or decoded.likely
    found = verify(code) if code is not None else None
    if code is None or found is None:
        return decoded
    decoded = replace(decoded, verification=found)
    cells, confidence = found.cell_confidence, 1 - found.error_probability
    if decoded.code is not None and code.scheme.corrects:
        # a check holds by accident in deep shade, which looks like dark units: what it did not correct must be there
        against = [i for i, cell in enumerate(cells) if cell < MIN_CHECKED_CELL and i not in decoded.corrected]
        if not against:
            return decoded
        reason = f"the pixels contradict the cells {', '.join(map(str, against))}, though the check holds"
        return replace(decoded, code=None, confidence=0.0, cell_confidence=cells, reason=reason)
    if found.error_probability < max_error:
        return replace(decoded, code=code, likely=None, confidence=confidence, cell_confidence=cells, reason="")
    unsure = ", ".join(str(i) for i, cell in enumerate(cells) if 1 - cell > max_error / len(cells))
    check = "the checks do not settle them" if code.scheme.corrects else "these digits have no check"
    reason = f"a stain may hide units of the cells {unsure}, and {check}"
    return replace(decoded, code=None, likely=code, confidence=confidence, cell_confidence=cells, reason=reason)


def _undecoded(decoded: DecodedSymbols) -> tuple[PlateOutcome, str]:
    if decoded.likely is not None:
        return PlateOutcome.UNSURE, decoded.reason
    sure_cells = bool(decoded.cell_confidence) and min(decoded.cell_confidence) > SURE_CELL
    return (PlateOutcome.UNSURE if sure_cells else PlateOutcome.CELLS_UNDECODABLE), decoded.reason
