"""Evidence of units -> code: the most likely digits, and how sure they are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from app.decoders.plate.weighing import STRAY, UnitEvidence, pattern_cost
from app.markers.plate import PlateCode, PlateScheme, correct_symbols, is_codeword

Array = npt.NDArray[Any]

TEMPER = 0.35  # share of a cost difference that is believed: the model is not the road
REGISTERED_TRUST = 0.9999  # in a registered plate that corrections reach
RIVAL_CELLS = 3  # by which every other registered position plate must differ more from what was read
STRAY_TRUST = 0.97  # in a cell with a unit that strays from its level
MOST_DAMAGE = 0.25  # in digits without a check
LEAST_CODEWORD = 0.05  # probability of the symbols, as read, from which a check that holds is no chance
LEAST_CHECKED = 0.99  # probability of each cell's symbol from which a check confirms digits beside a stain
LETTERS_OUT_OF_REACH = 12.0  # cost of reading letters as digits up to which a plate may be a decimal one
CHANCE_CODES = math.log(1e6)  # how many look-alikes a codebook's match must beat


@dataclass(frozen=True, slots=True)
class DecodedSymbols:
    """A code with its probabilities, or the reason why there is none.

    `confirmed` means that a plate with this code is in the codebook.
    """

    code: PlateCode | None
    confidence: float
    cell_confidence: tuple[float, ...]
    corrected: tuple[int, ...] = ()
    from_codebook: bool = False
    confirmed: bool = False
    reason: str = ""


def decode_symbols(
    evidence: UnitEvidence,
    n: int,
    codebook: Sequence[PlateCode],
    sure: float,
    *,
    clean: bool = True,
    most_damage: float = MOST_DAMAGE,
) -> DecodedSymbols:
    """Most likely code: read as it is, corrected, or taken from the codebook, in this order.

    Parameters
    ----------
    evidence : UnitEvidence
    n : int
        Units along a side.
    codebook : sequence of PlateCode
        Codes of the plates that are registered near by.
    sure : float
        Least probability at which digits are given out.
    clean : bool
        The image looks so much like a plate that wrong cells may be corrected without a registry.
    most_damage : float
        Of digits that neither a check nor the registry confirms.
    """
    read = _decode_alone(evidence, n, sure, clean=clean)
    known = [code for code in codebook if code.n == n]
    if not known:
        return _unless_damaged(read, evidence, most_damage)
    same = next((code for code in known if read.code is not None and code.digits == read.code.digits), None)
    if same is not None:
        return replace(read, code=same, confirmed=True)
    chosen = _decode_with_codebook(evidence, known, sure) or _correct_to_registered(evidence, known)
    if chosen is not None:
        return chosen
    if read.corrected:
        return replace(read, code=None, reason="corrected digits that no registered plate near by has")
    near = min(known, key=lambda code: pattern_cost(evidence, code))
    if read.code is not None and sum(a != b for a, b in zip(near.digits, read.code.digits, strict=True)) <= n // 2:
        return replace(read, code=None, reason=f"close to the registered {near.digits}, but not the same")
    return _unless_damaged(read, evidence, most_damage)


def _unless_damaged(read: DecodedSymbols, evidence: UnitEvidence, most: float) -> DecodedSymbols:
    """Digits that neither a check nor the registry confirms are no reading when a unit looks stained.

    A check confirms only what was read without doubt: damaged position plates come near words of the id scheme.
    """
    if read.code is None or evidence.damage <= most:
        return read
    if read.code.scheme is not PlateScheme.ID:
        return replace(read, code=None, reason="a unit looks stained, and nothing checks these digits")
    if read.corrected or min(read.cell_confidence) < LEAST_CHECKED:
        return replace(read, code=None, reason="a unit looks stained, and the check is spent on cells in doubt")
    return read


def _correct_to_registered(evidence: UnitEvidence, known: list[PlateCode]) -> DecodedSymbols | None:
    """The registered plate that differs from what was read only where the plate is damaged.

    An id plate may differ within its correction capacity, in two wrong cells or four in doubt: a word that is not this
    plate's comes so near with probability 5e-11 (8 x 8). A position plate's neighbours share most of its digits: it may
    differ in three cells, each of which is in doubt or shows what no digit looks like, and no other registered plate
    may be nearly as near.
    """
    cells = _softmax_confidence(evidence.cell_costs, evidence.best.tolist())
    doubtful = (cells < 0.99) | (evidence.stray > STRAY) | evidence.disputed
    changes = np.array([np.asarray(code.symbols) != evidence.best for code in known])
    for code, changed in zip(known, changes, strict=True):
        if code.scheme is PlateScheme.ID:
            near = 2 * int((changed & ~doubtful).sum()) + int((changed & doubtful).sum()) <= 4
        else:
            damaged = doubtful | (evidence.best > 9)
            rivals = int((changes.sum(axis=1) < changed.sum() + RIVAL_CELLS).sum()) - 1
            near = changed.sum() <= 3 and not (changed & ~damaged).any() and rivals == 0
        if near:
            shown = np.where(changed, REGISTERED_TRUST, cells)
            corrected = tuple(int(i) for i in np.flatnonzero(changed))
            return DecodedSymbols(
                code, REGISTERED_TRUST, _floats(shown), corrected, from_codebook=True, confirmed=True
            )  # fmt: skip
    return None


def _softmax_confidence(costs: Array, chosen: Sequence[int]) -> Array:
    likelihood = np.exp(-0.5 * TEMPER * (costs - costs.min(axis=1, keepdims=True)))
    share: Array = likelihood[np.arange(len(costs)), np.asarray(chosen)] / likelihood.sum(axis=1)
    return share


def _decode_alone(evidence: UnitEvidence, n: int, sure: float, *, clean: bool) -> DecodedSymbols:
    costs = evidence.cell_costs
    any_symbol = tuple(int(s) for s in evidence.best)
    trust = np.where((evidence.stray > STRAY) | evidence.disputed, STRAY_TRUST, 1.0)
    cells = _softmax_confidence(costs, any_symbol) * trust
    if is_codeword(any_symbol, PlateScheme.ID, n) and float(np.prod(cells)) >= LEAST_CODEWORD:
        code = PlateCode.from_symbols(any_symbol, PlateScheme.ID, n)
        return DecodedSymbols(code, _checked(float(np.prod(cells)), sure), _floats(cells))
    decimal = np.argmin(costs[:, :10], axis=1)
    if float(costs[np.arange(len(costs)), decimal].sum()) < LETTERS_OUT_OF_REACH:
        cells = _softmax_confidence(costs[:, :10], decimal) * trust
        confidence = float(np.prod(cells))
        digits = _decimal_code(tuple(int(s) for s in decimal), n)
        if digits is not None and confidence >= sure:
            return DecodedSymbols(digits, confidence, _floats(cells))
        doubtful = ", ".join(str(i) for i in np.flatnonzero(cells < 1 - (1 - sure) / len(cells)))
        return DecodedSymbols(None, confidence, _floats(cells), reason=f"cells in doubt: {doubtful}")
    corrected = _correct(n, any_symbol, cells, evidence.stray > STRAY) if clean else None
    if corrected is not None:
        return corrected
    return DecodedSymbols(None, float(np.prod(cells)), _floats(cells), reason="no scheme has these symbols")


def _decimal_code(symbols: tuple[int, ...], n: int) -> PlateCode | None:
    """The position code that has these digits; without check digits if that is possible, as the digits cannot tell."""
    for scheme, checks in ((PlateScheme.POSITION, 1), (PlateScheme.POSITION_CHECK, 1), (PlateScheme.POSITION_CHECK, 2)):
        if is_codeword(symbols, scheme, n, checks):
            return PlateCode.from_symbols(symbols, scheme, n, checks)
    return None


def _floats(values: Array) -> tuple[float, ...]:
    return tuple(float(v) for v in values)


def _checked(confidence: float, sure: float) -> float:
    """Confidence in symbols that satisfy a check of 16 bits: chance alone does that once in 65,536 times."""
    return max(confidence, min(1 - (1 - confidence) / 65536 * 10, 1.0), sure)


def _correct(n: int, symbols: tuple[int, ...], cells: Array, damaged: npt.NDArray[np.bool_]) -> DecodedSymbols | None:
    """Reed-Solomon on the symbols as read, then with the doubtful cells erased.

    Any word is within two symbols of a codeword with probability 0.23, so a correction counts only when letters remain
    among the cells that it leaves alone: a position plate has none.
    """
    doubtful = [int(i) for i in np.argsort(cells, kind="stable") if cells[i] < 0.9999]
    for erasures in ([], *(doubtful[:k] for k in range(1, min(len(doubtful), 4) + 1))):
        fixed = correct_symbols(symbols, n, erasures)
        if fixed is None:
            continue
        changed = tuple(i for i, (a, b) in enumerate(zip(symbols, fixed, strict=True)) if a != b)
        wrong = [i for i in changed if i not in erasures]
        spent = 2 * len(wrong) + len(erasures)
        kept = [i for i in range(len(symbols)) if i not in changed and i not in erasures]
        letters = sum(symbols[i] > 9 and cells[i] > 0.999 for i in kept)
        unsure = sum(cells[i] < 0.99 for i in kept)
        if letters < (1 if spent < 4 else 3) or unsure > 0 or damaged[kept].any():
            continue
        if spent > 2 and not all(damaged[i] or cells[i] < 0.99 for i in changed):
            continue  # a full correction of cells that look sound is as likely a chance as damage
        confidence = float(np.prod(cells[kept])) * (0.9999 if spent < 4 else 0.999)
        shown = cells.copy()
        shown[list(changed)] = confidence
        return DecodedSymbols(
            PlateCode.from_symbols(fixed, PlateScheme.ID, n), confidence, tuple(float(c) for c in shown), changed
        )
    return None


def _decode_with_codebook(evidence: UnitEvidence, known: list[PlateCode], sure: float) -> DecodedSymbols | None:
    """The registered plate that explains the units, if it beats the others and what chance would give."""
    costs = np.array([pattern_cost(evidence, code) for code in known])
    first = int(np.argmin(costs))
    others = np.delete(costs, first)
    log_chance = float(
        np.log(np.exp(-0.5 * TEMPER * evidence.cell_costs).mean(axis=1)).sum()
    )  # mean likelihood of a random code against the best pattern
    log_first = -0.5 * TEMPER * costs[first]
    share = 1 / (1 + float(np.exp(np.clip(-0.5 * TEMPER * (others - costs[first]), -700, 700)).sum()))
    chance = 1 / (1 + math.exp(min(log_chance + CHANCE_CODES - log_first, 700)))
    confidence = share * chance
    if confidence < sure:
        return None
    code = known[first]
    symbols = np.array(code.symbols)
    cells = _softmax_confidence(evidence.cell_costs, code.symbols)
    corrected = tuple(int(i) for i in np.flatnonzero(symbols != evidence.best))
    return DecodedSymbols(
        code, confidence, tuple(float(c) for c in cells), corrected, from_codebook=True, confirmed=True
    )
