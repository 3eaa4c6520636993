"""The likeliest Reed-Solomon codeword of a plate, and the probability that it is wrong.

The probability of each symbol of each cell gives that of each codeword, the product over its cells. The best codewords
are found by ordered statistics: any `data` cells of a Reed-Solomon word determine the others, so the most certain ones
are taken as they are read, or with one or two of them changed, and the rest follows. The next most certain ones are
taken as well, with one of them changed: where more than two cells of the first are wrong, and the checks can correct
them, at most one of the second is.

Source: M.P.C. Fossorier and S. Lin, "Soft-decision decoding of linear block codes based on ordered statistics", IEEE
Trans. Inf. Theory 41 (1995), here of order 2 and over GF(16).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from app.compiled import ieee_kernel
from app.markers.plate import PlateScheme, code_cells, is_codeword, numbers, reed_solomon_words
from app.markers.reed_solomon import ReedSolomonWord, gf16_products

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float64]
Symbols = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class LikelyCodeword:
    """The likeliest codeword of a scheme.

    Attributes
    ----------
    symbols : tuple of int
        One value from 0 to 15 a cell.
    log_evidence : float
        Of the codewords of the scheme together against random symbols: log of the mean, over all codewords, of the
        product of 16 times the probability of each cell's symbol. Random symbols exceed L with a probability of
        exp(-L) at most, because the mean over all symbols is 1 (Markov's inequality).
    wrong : float
        Probability that another codeword of the scheme is on the plate, given that one is. [probability]
    """

    symbols: tuple[int, ...]
    log_evidence: float
    wrong: float


def likely_codeword(probabilities: Array, n: int, scheme: PlateScheme) -> LikelyCodeword | None:
    """The likeliest codeword of a scheme with Reed-Solomon words.

    Parameters
    ----------
    probabilities : ndarray, shape (cells, 16)
        Of the symbols of each cell, all above 0; each row sums to 1.
    n : int
        Units along a side.
    scheme : PlateScheme

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
    """Words to list.

    Attributes
    ----------
    rows : ndarray of uint8, shape (data, 16, length)
        What each value of the cells that determine the others adds to a word.
    base : ndarray of uint8, shape (length,)
        The word whose symbols in these cells are the likeliest.
    certain : ndarray of int, shape (data,)
        The most certain cells.
    likeliest : ndarray of int, shape (length,)
        Likeliest symbol of each cell.
    is_second : bool
        One of the cells is changed, not two, and words that differ in at most two of the certain cells are left out:
        they were listed before.
    """

    rows: Symbols
    base: Symbols
    certain: npt.NDArray[np.intp]
    likeliest: npt.NDArray[np.intp]
    is_second: bool


@ieee_kernel
def _list_words(scores: Floats, words: _Listing, best: Symbols, top: float, total: float) -> tuple[float, float]:
    """Set the best word with none, one or two of its information symbols changed.

    Parameters
    ----------
    scores : ndarray, shape (length, 16)
    words : _Listing
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
