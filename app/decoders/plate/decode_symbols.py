"""Evidence of units to a code: the most likely digits and their probabilities."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from app.decoders.plate.unit_likelihoods import MAX_LEVEL_RESIDUAL, UnitEvidence, pattern_cost
from app.decoders.plate.unit_verification import UnitVerification
from app.markers.plate import PlateCode, PlateScheme, correct_symbols, is_codeword

Array = npt.NDArray[Any]

TEMPER = 0.35
"""[1] exponent of the tempered likelihood exp(-cost / 2): the model's errors are not independent. Source: chosen by
hand; effect: `python -m benchmarks.plates.thresholds`."""
REGISTERED_CONFIDENCE = 0.9999
"""[probability] of a registered plate that corrections reach. Source: chosen by hand, above `MIN_CONFIDENCE`."""
MAX_CODEBOOK_CHANGES, RIVAL_CELLS = 3, 3
"""[cells] by which a registered position plate may differ from what was read, and by how many more every other one
must. Source: chosen by hand; plates within 500 m share most of their digits."""
MAX_SPENT_ALONE = 2
"""[check symbols] that a correction may use without a registry: the others still check the digits. Source: the edge of
a deep shadow that was taken for dark units became another plate's digits by four corrected cells, with none left."""
MAX_SPENT_CHECKS = 4
"""[check symbols] that a correction may use. Source: the id scheme's Reed-Solomon code on 8 x 8 has four, two for a
wrong cell and one for an erased cell."""
OUTLIER_CONFIDENCE = 0.97
"""[probability] factor on a cell with an outlier among its units. Source: chosen by hand, so that one such cell alone
falls below `MIN_CONFIDENCE`."""
MAX_DAMAGE = 0.25
"""[contrast x ratio] `UnitEvidence.damage` up to which digits without a check are returned. Source: chosen by hand;
effect: `python -m benchmarks.plates.thresholds`."""
MIN_CODEWORD = 0.05
"""[probability] of the symbols as read, from which a check that holds is no accident. Source: a check of 16 bits holds
by accident once in 65,536 times; chosen by hand."""
MIN_CHECKED = 0.99
"""[probability] of each cell from which a check confirms digits beside a stain. Source: chosen by hand."""
ACCIDENTS, CHECK_FACTOR = 65_536, 10
"""[words, 1] of which a check of 16 bits holds for one by accident, and the factor by which that is discounted, as
errors of neighbouring cells are not independent. Source: the id scheme on 8 x 8; chosen by hand."""
MAX_DECIMAL_COST = 12.0
"""[cost] of reading letters as digits up to which a plate may be a decimal one. Source: chosen by hand."""
CHANCE_LOG_ODDS = math.log(1e6)
"""[log] number of look-alikes that a match with the codebook must beat. Source: decision record 0005, rule 5."""
UNCERTAIN_CELL, CLEAR_CELL, ERASABLE_CELL = 0.99, 0.999, 0.9999
"""[probability] of a cell below which it is uncertain, above which it is clear, and below which it may be erased.
Source: chosen by hand."""
CORRECTED_CONFIDENCE = 0.9999
"""[probability] factor on digits after a correction. Source: chosen by hand; any word is within two symbols of a
codeword with probability 0.23 (decision record 0005, rule 4), letters exclude most of them."""


@dataclass(frozen=True, slots=True)
class DecodedSymbols:
    """A code with its probabilities, or the reason why there is none.

    Attributes
    ----------
    code : PlateCode or None
    confidence : float
        Probability that the code, or the likely one, is right.
    cell_confidence : tuple of float
    corrected : tuple of int
        Cells that a check or the codebook corrected.
    from_codebook : bool
        The codebook decided.
    confirmed : bool
        A plate with this code is in the codebook.
    reason : str
        Why there is no code.
    likely : PlateCode or None
        The most likely code where none is sure enough to be returned.
    verification : UnitVerification or None
        Of the code or the likely one, where its pixels were compared.
    """

    code: PlateCode | None
    confidence: float
    cell_confidence: tuple[float, ...]
    corrected: tuple[int, ...] = ()
    from_codebook: bool = False
    confirmed: bool = False
    reason: str = ""
    likely: PlateCode | None = None
    verification: UnitVerification | None = None


def decode_symbols(
    evidence: UnitEvidence,
    n: int,
    codebook: Sequence[PlateCode],
    min_confidence: float,
    *,
    clean: bool = True,
    max_damage: float = MAX_DAMAGE,
    min_checked: float = MIN_CHECKED,
) -> DecodedSymbols:
    """Most likely code: read as it is, corrected, or taken from the codebook, in this order.

    Parameters
    ----------
    evidence : UnitEvidence
    n : int
        Units along a side.
    codebook : sequence of PlateCode
        Codes of the plates registered near by.
    min_confidence : float
        Probability from which digits are returned.
    clean : bool
        The image looks so much like a plate that wrong cells may be corrected without a registry.
    max_damage : float
        Of digits that neither a check nor the registry confirms.
    min_checked : float
        Probability of each cell from which a check confirms digits beside a stain.
    """
    read = _decode_alone(evidence, n, min_confidence, clean=clean)
    known = [code for code in codebook if code.n == n]
    if not known:
        return _refuse_damaged(read, evidence, max_damage, min_checked)
    same = next((code for code in known if read.code is not None and code.digits == read.code.digits), None)
    if same is not None:
        return replace(read, code=same, confirmed=True)
    chosen = _decode_with_codebook(evidence, known, min_confidence) or _correct_to_registered(evidence, known)
    if chosen is not None:
        return chosen
    if read.corrected:
        return replace(read, code=None, likely=None, reason="corrected digits of no registered plate near by")
    near = min(known, key=lambda code: pattern_cost(evidence, code))
    shown = read.code or read.likely
    if shown is not None and sum(a != b for a, b in zip(near.digits, shown.digits, strict=True)) <= n // 2:
        reason = f"close to the registered {near.digits}, but not the same" if read.code is not None else read.reason
        return replace(read, code=None, likely=None, reason=reason)
    return _refuse_damaged(read, evidence, max_damage, min_checked)


def _refuse_damaged(
    read: DecodedSymbols, evidence: UnitEvidence, max_damage: float, min_checked: float
) -> DecodedSymbols:
    """Refuse digits that neither a check nor the registry confirms where a unit looks stained.

    A check confirms only cells that are certain: damaged position plates come near words of the id scheme.
    """
    if read.code is None or evidence.damage <= max_damage:
        return read
    reason = "a unit looks stained, and these digits have no check"
    if read.code.scheme is PlateScheme.ID:
        if not read.corrected and min(read.cell_confidence) >= min_checked:
            return read
        reason = "a unit looks stained, and the check was used up on uncertain cells"
    return replace(read, code=None, likely=read.code, reason=reason)


def _correct_to_registered(evidence: UnitEvidence, known: list[PlateCode]) -> DecodedSymbols | None:
    """The registered plate that differs from what was read only where the plate is damaged.

    An id plate may differ within its correction capacity, in two wrong cells or four uncertain ones. On 8 x 8, with 12
    cells of 16 values, a random word comes so near to one plate with probability 5.3e-11 by two cells, 2.3e-10 by four
    given cells that are uncertain, and 9.2e-8 by any four; among K id plates near by with K times that. A position
    plate's neighbours share most of its digits: it may differ in three cells, each of which is uncertain or shows what
    no digit looks like, and no other registered plate may be nearly as near.
    """
    cells = _softmax_confidence(evidence.cell_costs, evidence.best.tolist())
    uncertain = (cells < UNCERTAIN_CELL) | (evidence.level_residual > MAX_LEVEL_RESIDUAL) | evidence.disputed
    changes = np.array([np.asarray(code.symbols) != evidence.best for code in known])
    for code, changed in zip(known, changes, strict=True):
        if code.scheme is PlateScheme.ID:
            near = 2 * int((changed & ~uncertain).sum()) + int((changed & uncertain).sum()) <= MAX_SPENT_CHECKS
        else:
            damaged = uncertain | (evidence.best > 9)
            rivals = int((changes.sum(axis=1) < changed.sum() + RIVAL_CELLS).sum()) - 1
            near = changed.sum() <= MAX_CODEBOOK_CHANGES and not (changed & ~damaged).any() and rivals == 0
        if near:
            shown = np.where(changed, REGISTERED_CONFIDENCE, cells)
            corrected = tuple(int(i) for i in np.flatnonzero(changed))
            return DecodedSymbols(
                code, REGISTERED_CONFIDENCE, _floats(shown), corrected, from_codebook=True, confirmed=True
            )  # fmt: skip
    return None


def _softmax_confidence(costs: Array, chosen: Sequence[int]) -> Array:
    likelihood = np.exp(-0.5 * TEMPER * (costs - costs.min(axis=1, keepdims=True)))
    share: Array = likelihood[np.arange(len(costs)), np.asarray(chosen)] / likelihood.sum(axis=1)
    return share


def _decode_alone(evidence: UnitEvidence, n: int, min_confidence: float, *, clean: bool) -> DecodedSymbols:
    costs = evidence.cell_costs
    any_symbol = tuple(int(s) for s in evidence.best)
    factor = np.where((evidence.level_residual > MAX_LEVEL_RESIDUAL) | evidence.disputed, OUTLIER_CONFIDENCE, 1.0)
    cells = _softmax_confidence(costs, any_symbol) * factor
    if is_codeword(any_symbol, PlateScheme.ID, n) and float(np.prod(cells)) >= MIN_CODEWORD:
        code = PlateCode.from_symbols(any_symbol, PlateScheme.ID, n)
        return DecodedSymbols(code, _checked(float(np.prod(cells)), min_confidence), _floats(cells))
    decimal = np.argmin(costs[:, :10], axis=1)
    if float(costs[np.arange(len(costs)), decimal].sum()) < MAX_DECIMAL_COST:
        cells = _softmax_confidence(costs[:, :10], decimal) * factor
        confidence = float(np.prod(cells))
        digits = _decimal_code(tuple(int(s) for s in decimal), n)
        if digits is not None and confidence >= min_confidence:
            return DecodedSymbols(digits, confidence, _floats(cells))
        uncertain = ", ".join(str(i) for i in np.flatnonzero(cells < 1 - (1 - min_confidence) / len(cells)))
        return DecodedSymbols(None, confidence, _floats(cells), reason=f"uncertain cells: {uncertain}", likely=digits)
    corrected = _correct(n, any_symbol, cells, evidence.level_residual > MAX_LEVEL_RESIDUAL) if clean else None
    if corrected is not None:
        return corrected
    return DecodedSymbols(None, float(np.prod(cells)), _floats(cells), reason="no scheme has these symbols")


def _decimal_code(symbols: tuple[int, ...], n: int) -> PlateCode | None:
    """The position code that has these digits; without check digits where both are possible."""
    for scheme, checks in ((PlateScheme.POSITION, 1), (PlateScheme.POSITION_CHECK, 1), (PlateScheme.POSITION_CHECK, 2)):
        if is_codeword(symbols, scheme, n, checks):
            return PlateCode.from_symbols(symbols, scheme, n, checks)
    return None


def _floats(values: Array) -> tuple[float, ...]:
    return tuple(float(v) for v in values)


def _checked(confidence: float, min_confidence: float) -> float:
    """Confidence in symbols that satisfy a check of 16 bits: wrong ones do by accident once in 65,536 times."""
    checked = 1 - (1 - confidence) * CHECK_FACTOR / ACCIDENTS
    return max(confidence, min(checked, 1.0), min_confidence)


def _correct(n: int, symbols: tuple[int, ...], cells: Array, damaged: npt.NDArray[np.bool_]) -> DecodedSymbols | None:
    """Reed-Solomon on the symbols as read, then with the most uncertain cells erased.

    Any word is within two symbols of a codeword with probability 0.23, so a correction counts only when letters remain
    among the cells that it leaves alone: a position plate has none.
    """
    uncertain = [int(i) for i in np.argsort(cells, kind="stable") if cells[i] < ERASABLE_CELL]
    for erasures in ([], *(uncertain[:k] for k in range(1, min(len(uncertain), MAX_SPENT_ALONE) + 1))):
        fixed = correct_symbols(symbols, n, erasures)
        if fixed is None:
            continue
        changed = tuple(i for i, (a, b) in enumerate(zip(symbols, fixed, strict=True)) if a != b)
        wrong = [i for i in changed if i not in erasures]
        spent = 2 * len(wrong) + len(erasures)
        kept = [i for i in range(len(symbols)) if i not in changed and i not in erasures]
        letters = sum(symbols[i] > 9 and cells[i] > CLEAR_CELL for i in kept)
        unsure = sum(cells[i] < UNCERTAIN_CELL for i in kept)
        if spent > MAX_SPENT_ALONE or letters == 0 or unsure > 0 or damaged[kept].any():
            continue
        confidence = float(np.prod(cells[kept])) * CORRECTED_CONFIDENCE
        shown = cells.copy()
        shown[list(changed)] = confidence
        return DecodedSymbols(
            PlateCode.from_symbols(fixed, PlateScheme.ID, n), confidence, tuple(float(c) for c in shown), changed
        )
    return None


def _decode_with_codebook(
    evidence: UnitEvidence, known: list[PlateCode], min_confidence: float
) -> DecodedSymbols | None:
    """The registered plate that explains the units, if it is far likelier than the others and than random codes."""
    costs = np.array([pattern_cost(evidence, code) for code in known])
    first = int(np.argmin(costs))
    others = np.delete(costs, first)
    log_chance = float(
        np.log(np.exp(-0.5 * TEMPER * evidence.cell_costs).mean(axis=1)).sum()
    )  # mean likelihood of a random code against the best pattern
    log_first = -0.5 * TEMPER * costs[first]
    share = 1 / (1 + float(np.exp(np.clip(-0.5 * TEMPER * (others - costs[first]), -700, 700)).sum()))
    chance = 1 / (1 + math.exp(min(log_chance + CHANCE_LOG_ODDS - log_first, 700)))
    confidence = share * chance
    if confidence < min_confidence:
        return None
    code = known[first]
    symbols = np.array(code.symbols)
    cells = _softmax_confidence(evidence.cell_costs, code.symbols)
    corrected = tuple(int(i) for i in np.flatnonzero(symbols != evidence.best))
    return DecodedSymbols(
        code, confidence, tuple(float(c) for c in cells), corrected, from_codebook=True, confirmed=True
    )
