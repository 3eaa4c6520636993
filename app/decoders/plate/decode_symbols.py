"""Evidence of units to a code: the most likely digits and their probabilities."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from app.compiled import ieee_kernel
from app.decoders.plate import Array
from app.decoders.plate.confirm import UnitVerification
from app.decoders.plate.unit_likelihoods import MAX_LEVEL_RESIDUAL, UnitEvidence, pattern_cost
from app.markers.plate import (
    PlateCode,
    PlateScheme,
    ReedSolomonWord,
    code_cells,
    decimal_codes,
    gf16_products,
    is_codeword,
    numbers,
    position_decimals,
    reed_solomon_words,
)
from app.values import Floats

# === The likeliest Reed-Solomon codeword of a plate, and the probability that it is wrong.
#
# The probability of each symbol of each cell gives that of each codeword, the product over its cells. The best
# codewords are found by ordered statistics: any `data` cells of a Reed-Solomon word determine the others, so the most
# certain ones are taken as they are read, or with one or two of them changed, and the rest follows. The next most
# certain ones are taken as well, with one of them changed: where more than two cells of the first are wrong, and the
# checks can correct them, at most one of the second is.
#
# Source: M.P.C. Fossorier and S. Lin, "Soft-decision decoding of linear block codes based on ordered statistics", IEEE
# Trans. Inf. Theory 41 (1995), here of order 2 and over GF(16).


Symbols = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class LikelyCodeword:
    """The likeliest codeword of a scheme."""

    symbols: tuple[int, ...]  # one value from 0 to 15 a cell
    # of the codewords of the scheme together against random symbols: log of the mean, over all codewords, of the
    # product of 16 times the probability of each cell's symbol. Random symbols exceed L with a probability of exp(-L)
    # at most, because the mean over all symbols is 1 (Markov's inequality).
    log_evidence: float
    wrong: float  # [probability] probability that another codeword of the scheme is on the plate, given that one is


def likely_codeword(probabilities: Array, n: int, scheme: PlateScheme) -> LikelyCodeword | None:
    """The likeliest codeword of a scheme with Reed-Solomon words.

    Parameters
    ----------
    probabilities : ndarray, shape (cells, 16)
        Of the symbols of each cell, all above 0; each row sums to 1.
    n : int
        Units along a side.

    Returns
    -------
    LikelyCodeword or None
        None if the scheme has no words on this size, or the likeliest words hold no number of the scheme.
    """
    words = reed_solomon_words(n, scheme)
    if not words:
        return None
    scores = np.log(16 * probabilities)
    symbols = np.zeros(len(code_cells(n)), dtype=np.intp)
    spare = np.ones(len(symbols), dtype=bool)
    log_sum, right = 0.0, 1.0
    for word in words:
        cells = list(word.cells)
        best, best_score, log_total = _best_word(scores[cells], word)
        symbols[cells], spare[cells] = best, False
        log_sum += log_total
        right *= math.exp(min(best_score - log_total, 0.0))
    log_sum += float(scores[spare, 0].sum())
    found = tuple(int(s) for s in symbols)
    if not is_codeword(found, scheme, n):
        return None
    return LikelyCodeword(found, log_sum - math.log(numbers(n, scheme)), 1 - right)


def _best_word(scores: Array, word: ReedSolomonWord) -> tuple[Array, float, float]:
    """Likeliest symbols of a word, their score, and the log of the sum of all codewords' exponentials.

    Parameters
    ----------
    scores : ndarray, shape (length, 16)
        Log of 16 times the probability of each symbol.
    """
    mask = np.array(word.mask, dtype=np.uint8)
    length, data = len(mask), word.data
    plain = scores[np.arange(length)[:, None], np.arange(16) ^ mask[:, None]]
    order = np.argsort(-plain.max(axis=1), kind="stable")
    likeliest = plain.argmax(axis=1)
    certain = _Listing(*_information(plain, word, order[:data]), order[:data], likeliest, is_second=False)
    best = np.empty(length, np.uint8)
    score, listed = _list_words(plain, certain, best, -np.inf, 0.0)
    second = np.roll(order, -data)[:data]
    others = _Listing(*_information(plain, word, second), order[:data], likeliest, is_second=True)
    score, listed = _list_words(plain, others, best, score, listed)
    missed = _log_unlisted(plain[order[:data]])
    return best ^ mask, score, float(np.logaddexp(score + math.log(listed), missed))


def _information(scores: Array, word: ReedSolomonWord, cells: Array) -> tuple[Array, Array]:
    """What each value of each of these cells adds to a word, and the word whose symbols there are the likeliest."""
    information = tuple(sorted(cells.tolist()))
    rows = _systematic(word, information)
    start = scores[list(information)].argmax(axis=1)
    return rows, np.bitwise_xor.reduce(rows[np.arange(len(rows)), start], axis=0)


class _Listing(NamedTuple):
    """Words to list."""

    # uint8, shape (data, 16, length): what each value of the cells that determine the others adds to a word
    rows: Symbols
    base: Symbols  # uint8, shape (length,): the word whose symbols in these cells are the likeliest
    certain: npt.NDArray[np.intp]  # shape (data,): the most certain cells
    likeliest: npt.NDArray[np.intp]  # shape (length,): likeliest symbol of each cell
    # one of the cells is changed, not two, and words that differ in at most two of the certain cells are left out: they
    # were listed before
    is_second: bool


@ieee_kernel
def _list_words(scores: Floats, words: _Listing, best: Symbols, top: float, total: float) -> tuple[float, float]:
    """Set the best word with none, one or two of its information symbols changed.

    Parameters
    ----------
    scores : ndarray, shape (length, 16)
    best : ndarray of uint8, shape (length,)
        The best word so far.
    top, total : float
        Its score, and the sum of all words' exponentials over that of the best; the new ones are returned.
    """
    rows, base, certain, likeliest = words.rows, words.base, words.certain, words.likeliest
    data, values, length = rows.shape
    word = np.empty(length, np.uint8)
    for a in range(data):
        for first in range(values if a == 0 else values - 1):
            u = first if a == 0 else first + 1  # no change, which is a value of 0, once
            for b in range(a, data if u > 0 and not words.is_second else a + 1):
                for second in range(1 if b == a else values - 1):
                    v = 0 if b == a else second + 1
                    score = 0.0
                    for k in range(length):
                        word[k] = base[k] ^ rows[a, u, k] ^ rows[b, v, k]
                        score += scores[k, word[k]]
                    if words.is_second:
                        changed = 0
                        for k in certain:
                            changed += word[k] != likeliest[k]
                        if changed <= 2:
                            continue
                    if score > top:
                        total = total * math.exp(top - score) + 1.0
                        top = score
                        best[:] = word
                    else:
                        total += math.exp(score - top)
    return top, total


def _log_unlisted(scores: Array) -> float:
    """Log of the expected sum over the words in which more than two symbols of the most certain cells are changed.

    The other cells of such a word are as good as random: their exponentials have a mean of 1. What remains is the
    probability that more than two of the certain cells are wrong (Poisson's binomial), times 16 to their number.
    """
    count = np.array([1.0, 0.0, 0.0, 0.0])  # probability of 0, 1, 2, more wrong cells
    for wrong in np.clip(1 - np.exp(scores.max(axis=1)) / 16, 0.0, 1.0):
        moved = count * wrong
        count = count - moved + np.array([0.0, moved[0], moved[1], moved[2]])
        count[3] += moved[3]
    return math.log(max(float(count[3]), 1e-300)) + len(scores) * math.log(16)


@lru_cache(maxsize=512)
def _systematic(word: ReedSolomonWord, information: tuple[int, ...]) -> Array:
    """What each value of each information symbol adds to the word, shape (data, 16, length).

    Notes
    -----
    Gauss-Jordan elimination of the generator matrix over GF(16); any `data` columns of it are independent.
    """
    products = gf16_products()
    inverse = np.array([0, *(int(np.flatnonzero(products[a] == 1)[0]) for a in range(1, 16))], dtype=np.uint8)
    matrix = word.generator.copy()
    for row, column in enumerate(information):
        pivot = row + int(np.flatnonzero(matrix[row:, column])[0])
        matrix[[row, pivot]] = matrix[[pivot, row]]
        matrix[row] = products[inverse[matrix[row, column]], matrix[row]]
        for other in range(word.data):
            if other != row:
                matrix[other] ^= products[matrix[other, column], matrix[row]]
    result: Array = products[np.arange(16)[None, :, None], matrix[:, None, :]]
    return result


# === Evidence of units to a code.


TEMPER = 0.35
"""[1] exponent of the tempered likelihood exp(-cost / 2): the model's errors are not independent. Effect: `python -m
benchmarks.plates.thresholds`."""
REGISTERED_CONFIDENCE = 0.9999
"""[probability] of a registered plate that corrections reach. Above `MIN_CONFIDENCE`."""
MAX_CODEBOOK_CHANGES, RIVAL_CELLS = 3, 3
"""[cells] by which a registered position plate may differ from what was read, and by how many more every other one
must. Plates within 500 m share most of their digits."""
RANDOM_PRIOR, UNCLEAN_RANDOM_PRIOR = 0.01, 1.0
"""[1] odds that a plate's symbols are random against that they are a codeword of a given scheme: on a plate whose image
looks clean, and on others. No wrong reading in the same frames up to a confidence of 0.98."""
MAX_CHECKED_ERROR = 1e-4
"""[probability] of an error, random symbols being as likely as a codeword, below which checks confirm the digits
whatever else the plate lacks. Source: the same frames, without a wrong reading up to 0.02."""
OUTLIER_CONFIDENCE = 0.97
"""[probability] factor on a cell with an outlier among its units, so that one such cell alone falls below
`MIN_CONFIDENCE`."""
MAX_DAMAGE = 0.25
"""[contrast x ratio] `UnitEvidence.damage` up to which digits without a check are returned. Effect: `python -m
benchmarks.plates.thresholds`."""
MAX_DECIMAL_COST = 12.0
"""[cost] of reading letters as digits up to which a plate may be a decimal one."""
CHANCE_LOG_ODDS = math.log(1e6)
"""[log] number of look-alikes that a match with the codebook must beat. Source: decision record 0010, rule 6."""
MIN_LIKELY = 0.5
"""[probability] from which an unsure codeword is the likely one. Source: it is likelier than all others together."""
UNCERTAIN_CELL = 0.99
"""[probability] of a cell below which it is uncertain."""


@dataclass(frozen=True, slots=True)
class DecodedSymbols:
    """A code with its probabilities, or the reason why there is none."""

    code: PlateCode | None
    confidence: float  # probability that the code, or the likely one, is right
    cell_confidence: tuple[float, ...]
    corrected: tuple[int, ...] = ()  # cells that a check or the codebook corrected
    from_codebook: bool = False  # the codebook decided
    confirmed: bool = False  # a plate with this code is in the codebook
    checked: bool = False  # Reed-Solomon checks confirm the code by themselves, whatever else the plate lacks
    reason: str = ""  # why there is no code
    likely: PlateCode | None = None  # the most likely code where none is sure enough to be returned
    verification: UnitVerification | None = None  # of the code or the likely one, where its pixels were compared


def decode_symbols(
    evidence: UnitEvidence,
    n: int,
    codebook: Sequence[PlateCode],
    min_confidence: float,
    *,
    clean: bool = True,
    look_alikes: float = 1.0,
    max_damage: float = MAX_DAMAGE,
) -> DecodedSymbols:
    """Most likely code: read as it is, corrected, or taken from the codebook, in this order.

    Parameters
    ----------
    n : int
        Units along a side.
    codebook : sequence of PlateCode
        Codes of the plates registered nearby.
    min_confidence : float
        Probability from which digits are returned.
    clean : bool
        The image looks so much like a plate that wrong cells may be corrected without a registry.
    look_alikes : float
        Share of the look-alikes that show as much of a plate's markers.
    max_damage : float
        Of digits that neither Reed-Solomon checks nor the registry confirm.
    """
    read = _decode_alone(evidence, n, min_confidence, clean, look_alikes)
    known = [code for code in codebook if code.n == n]
    if not known:
        return _refuse_damaged(read, evidence, max_damage)
    same = next((code for code in known if read.code is not None and code.digits == read.code.digits), None)
    if same is not None:
        return replace(read, code=same, confirmed=True)
    if read.checked:
        return read
    chance = CHANCE_LOG_ODDS + math.log(look_alikes)
    chosen = _decode_with_codebook(evidence, known, min_confidence) or _correct_to_registered(evidence, known, chance)
    if chosen is not None:
        return chosen
    if read.corrected:
        return replace(read, code=None, likely=None, reason="corrected digits of no registered plate nearby")
    near = min(known, key=lambda code: pattern_cost(evidence, code))
    shown = read.code or read.likely
    if shown is not None and sum(a != b for a, b in zip(near.digits, shown.digits, strict=True)) <= n // 2:
        reason = f"close to the registered {near.digits}, but not the same" if read.code is not None else read.reason
        return replace(read, code=None, likely=None, reason=reason)
    return _refuse_damaged(read, evidence, max_damage)


def _refuse_damaged(read: DecodedSymbols, evidence: UnitEvidence, max_damage: float) -> DecodedSymbols:
    """Refuse digits that neither Reed-Solomon checks nor the registry confirm where a unit looks stained."""
    if read.code is None or read.code.scheme.corrects or evidence.damage <= max_damage:
        return read
    reason = "a unit looks stained, and these digits have no check"
    return replace(read, code=None, likely=read.code, reason=reason)


def _correct_to_registered(
    evidence: UnitEvidence, known: list[PlateCode], chance_log_odds: float
) -> DecodedSymbols | None:
    """The registered plate that differs from what was read only where the plate is damaged.

    A plate with Reed-Solomon checks differs from others in many cells, so its symbols need only be likelier than random
    ones, by `chance_log_odds` and the number of registered plates. A plain position plate's neighbours share most of
    its digits: it may differ in three cells, each of which is uncertain or shows what no digit looks like, and no other
    registered plate may be nearly as near.
    """
    cells = _softmax_confidence(evidence.cell_costs, evidence.best.tolist())
    damaged = (cells < UNCERTAIN_CELL) | _outliers(evidence) | (evidence.best > 9)
    scores = np.log(16 * symbol_probabilities(evidence))
    changes = np.array([np.asarray(code.symbols) != evidence.best for code in known])
    for code, changed in zip(known, changes, strict=True):
        if code.scheme.corrects:
            score = float(scores[np.arange(len(scores)), code.symbols].sum())
            near = score - math.log(len(known)) >= chance_log_odds
        else:
            rivals = int((changes.sum(axis=1) < changed.sum() + RIVAL_CELLS).sum()) - 1
            near = changed.sum() <= MAX_CODEBOOK_CHANGES and not (changed & ~damaged).any() and rivals == 0
        if near:
            shown = np.where(changed, REGISTERED_CONFIDENCE, cells)
            corrected = tuple(int(i) for i in np.flatnonzero(changed))
            return DecodedSymbols(
                code, REGISTERED_CONFIDENCE, _floats(shown), corrected, from_codebook=True, confirmed=True
            )
    return None


def _softmax_confidence(costs: Array, chosen: Sequence[int]) -> Array:
    likelihood = np.exp(-0.5 * TEMPER * (costs - costs.min(axis=1, keepdims=True)))
    share: Array = likelihood[np.arange(len(costs)), np.asarray(chosen)] / likelihood.sum(axis=1)
    return share


def _decode_alone(
    evidence: UnitEvidence, n: int, min_confidence: float, clean: bool, look_alikes: float
) -> DecodedSymbols:
    costs = evidence.cell_costs
    checked = _decode_checked(evidence, n, clean, look_alikes)
    if checked.code is not None and checked.confidence >= min_confidence:
        return checked
    factor = np.where(_outliers(evidence), OUTLIER_CONFIDENCE, 1.0)
    decimal = np.argmin(costs[:, :10], axis=1)
    if float(costs[np.arange(len(costs)), decimal].sum()) < MAX_DECIMAL_COST:
        cells = _softmax_confidence(costs[:, :10], decimal) * factor
        confidence = float(np.prod(cells))
        digits = next(iter(decimal_codes(tuple(int(s) for s in decimal), n)), None)
        if digits is not None and confidence >= min_confidence:
            return DecodedSymbols(digits, confidence, _floats(cells))
        uncertain = ", ".join(str(i) for i in np.flatnonzero(cells < 1 - (1 - min_confidence) / len(cells)))
        return DecodedSymbols(None, confidence, _floats(cells), reason=f"uncertain cells: {uncertain}", likely=digits)
    if checked.code is not None and checked.confidence >= MIN_LIKELY:
        reason = f"the checks leave an error probability of {1 - checked.confidence:.1e}"
        return replace(checked, code=None, likely=checked.code, reason=reason)
    cells = _softmax_confidence(costs, evidence.best.tolist()) * factor
    return DecodedSymbols(None, float(np.prod(cells)), _floats(cells), reason="no scheme has these symbols")


def _floats(values: Array) -> tuple[float, ...]:
    return tuple(float(v) for v in values)


def _outliers(evidence: UnitEvidence) -> npt.NDArray[np.bool_]:
    """Cells with an outlier among their units, shape (cells,)."""
    found: npt.NDArray[np.bool_] = (evidence.level_residual > MAX_LEVEL_RESIDUAL) | evidence.disputed
    return found


def symbol_probabilities(evidence: UnitEvidence) -> Array:
    """Probability of each symbol of each cell, shape (cells, 16): by its units, unless damage hides what was built."""
    likelihood = np.exp(-0.5 * TEMPER * evidence.cell_costs)
    risk = 1 / (1 + np.exp(-evidence.risk_log_odds[:, None]))
    probabilities: Array = (1 - risk) * likelihood / likelihood.sum(axis=1, keepdims=True) + risk / 16
    return probabilities


def _decode_checked(evidence: UnitEvidence, n: int, clean: bool, look_alikes: float) -> DecodedSymbols:
    """The likeliest codeword of a scheme with Reed-Solomon checks, and its probability."""
    found = decode_word(symbol_probabilities(evidence), n)
    if found is None:
        return DecodedSymbols(None, 0.0, ())
    confidence = found.confidence(RANDOM_PRIOR if clean else UNCLEAN_RANDOM_PRIOR * look_alikes)
    is_checked = found.confidence(look_alikes) > 1 - MAX_CHECKED_ERROR
    symbols = found.code.symbols
    changed = tuple(i for i, (a, b) in enumerate(zip(evidence.best, symbols, strict=True)) if a != b)
    cells = _softmax_confidence(evidence.cell_costs, symbols)
    cells[list(changed)] = confidence
    return DecodedSymbols(found.code, confidence, _floats(cells), changed, checked=is_checked)


class CheckedWord(NamedTuple):
    """The likeliest codeword of all schemes with Reed-Solomon checks."""

    code: PlateCode
    wrong: float  # [probability] that another codeword of its scheme is on the plate
    log_evidence: float  # as of `LikelyCodeword`
    log_rivals: float  # the same of the other schemes together

    def confidence(self, random_prior: float) -> float:
        """Probability of the code, where random symbols have these odds against a codeword of a scheme.

        Such are those of a plate that is stained all over. They get a confidence of c with a probability of (1 - c) /
        c / `random_prior` at most (`LikelyCodeword.log_evidence`): 1/20 at `MIN_CONFIDENCE` and `RANDOM_PRIOR`.
        """
        rival = float(np.logaddexp(self.log_rivals, math.log(random_prior)))
        return (1 - self.wrong) / (1 + math.exp(min(rival - self.log_evidence, 700.0)))


def decode_word(probabilities: Array, n: int) -> CheckedWord | None:
    """The likeliest codeword of a scheme with Reed-Solomon checks; None where no scheme has any.

    Parameters
    ----------
    probabilities : ndarray, shape (cells, 16)
        Of the symbols of each cell.
    """
    found = [(scheme, likely_codeword(probabilities, n, scheme)) for scheme in PlateScheme if scheme.corrects]
    rivals: list[tuple[PlateScheme, LikelyCodeword]] = [(s, word) for s, word in found if word is not None]
    if not rivals:
        return None
    scheme, best = max(rivals, key=lambda rival: rival[1].log_evidence)
    others = [word.log_evidence for _, word in rivals if word is not best]
    others.append(_decimal_evidence(probabilities, n))
    code = PlateCode.from_symbols(best.symbols, scheme, n)
    return CheckedWord(code, best.wrong, best.log_evidence, float(np.logaddexp.reduce(others)))


def _decimal_evidence(probabilities: Array, n: int) -> float:
    """Log evidence of the scheme `position` against random symbols, as `LikelyCodeword.log_evidence`."""
    decimals = sum(position_decimals(n, PlateScheme.POSITION))
    digits = np.log(1.6 * probabilities[:decimals, :10].sum(axis=1)).sum()
    return float(digits + np.log(16 * probabilities[decimals:, 0]).sum())


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
