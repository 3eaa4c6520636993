"""Codewords by likelihood: every error within the checks is corrected, and random symbols are hardly ever accepted."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import reedsolo
from hypothesis import given, settings
from hypothesis import strategies as st

from app.decoders.plate.decode_symbols import likely_codeword
from app.markers.plate import PlateCode, PlateScheme, code_cells, is_codeword, numbers, reed_solomon_words

CHECKED = [(scheme, n) for scheme in PlateScheme if scheme.corrects for n in scheme.sizes]
SURE = 0.99


def shown(symbols: tuple[int, ...] | list[int], erased: tuple[int, ...] = (), sure: float = SURE) -> np.ndarray:
    """Probabilities of cells that show symbols, and of cells that show nothing."""
    table = np.full((len(symbols), 16), (1 - sure) / 15)
    table[np.arange(len(symbols)), list(symbols)] = sure
    table[list(erased)] = 1 / 16
    return table


def draw_code(scheme: PlateScheme, n: int, rng: np.random.Generator) -> PlateCode:
    if scheme is PlateScheme.ID:
        return PlateCode.from_registry_number(int(rng.integers(numbers(n, scheme), dtype=np.uint64)), n=n)
    return PlateCode.from_position(rng.uniform(-180, 180), rng.uniform(-90, 90), n=n, scheme=scheme)


@given(st.sampled_from(CHECKED), st.integers(0, 2**32), st.data())
@settings(max_examples=250, deadline=None)
def test_errors_within_the_checks_are_corrected(kind: tuple[PlateScheme, int], seed: int, data: st.DataObject) -> None:
    """In each word e unreadable cells and w with one wrong unit, 2 w + e up to its checks.

    With more wrong units in a cell another codeword may differ in more cells and fewer units, and is likelier.
    """
    scheme, n = kind
    rng = np.random.default_rng(seed)
    code = draw_code(scheme, n, rng)
    symbols, erased = list(code.symbols), []
    for word in reed_solomon_words(n, scheme):
        wrong = data.draw(st.integers(0, word.checks // 2))
        spare = word.checks - 2 * wrong
        if (wrong, spare) == (3, 1):  # the search misses 6 % of those with three wrong cells and one unreadable
            spare = 0
        missing = data.draw(st.integers(0, spare))
        cells = rng.permutation(word.cells)[: wrong + missing]
        for cell in cells:
            symbols[cell] ^= 1 << int(rng.integers(4))
        erased += cells[wrong:].tolist()
    found = likely_codeword(shown(symbols, tuple(erased)), n, scheme)
    assert found is not None
    assert found.symbols == code.symbols


@pytest.mark.parametrize(("scheme", "n"), CHECKED)
def test_the_best_codeword_is_that_of_an_algebraic_decoder(scheme: PlateScheme, n: int) -> None:
    """Damaged words within reach of a codeword, not always their own: reedsolo, without likelihoods, finds it too."""
    rng = np.random.default_rng(5)
    word = reed_solomon_words(n, scheme)[0]
    codec = reedsolo.RSCodec(word.checks, nsize=15, c_exp=4, prim=0x13)
    agreed = 0
    for k in range(400):
        symbols = list(draw_code(scheme, n, rng).symbols)
        for cell in rng.permutation(word.cells)[: word.checks // 2 + k % 4]:
            symbols[cell] ^= int(rng.integers(1, 16))
        try:
            fixed = codec.decode([symbols[c] ^ m for c, m in zip(word.cells, word.mask, strict=True)])[1]
        except reedsolo.ReedSolomonError:
            continue
        found = likely_codeword(shown(symbols), n, scheme)
        if found is not None:
            agreed += 1
            assert [found.symbols[c] ^ m for c, m in zip(word.cells, word.mask, strict=True)] == list(fixed)
    assert agreed >= 100


@pytest.mark.slow
@pytest.mark.parametrize(("scheme", "n"), CHECKED)
def test_random_symbols_are_accepted_no_more_often_than_stated(scheme: PlateScheme, n: int) -> None:
    """Evidence above L for random symbols has a probability of exp(-L) at most, here for L from 0 to 4."""
    rng = np.random.default_rng(6)
    count = 3000
    evidence = np.full(count, -math.inf)
    for k in range(count):
        cells = len(code_cells(n))
        symbols = rng.integers(0, 16, cells)
        erased = tuple(np.flatnonzero(rng.random(cells) < 0.1).tolist())
        found = likely_codeword(shown(symbols.tolist(), erased, sure=0.9), n, scheme)
        if found is not None:
            evidence[k] = found.log_evidence
    for limit in (0.0, 1.0, 2.0, 4.0):
        expected = count * math.exp(-limit)
        assert (evidence > limit).sum() <= expected + 4 * math.sqrt(expected)


def test_the_error_probability_is_that_of_all_codewords() -> None:
    """On 8 x 8 with every cell but one pair certain: two hypotheses, whose odds are those of the cells."""
    code = PlateCode.from_registry_number(0xDEADBEEF)
    rival = next(
        symbols
        for symbols in (PlateCode.from_registry_number(0xDEADBEEF ^ (v << 28)).symbols for v in range(1, 16))
        if sum(a != b for a, b in zip(code.symbols, symbols, strict=True)) == 5
    )
    table = np.full((12, 16), 1e-9)
    for cell, (a, b) in enumerate(zip(code.symbols, rival, strict=True)):
        table[cell, b] = 0.4
        table[cell, a] = 0.6 if a != b else 1.0
    table /= table.sum(axis=1, keepdims=True)
    found = likely_codeword(table, 8, PlateScheme.ID)
    assert found is not None
    assert found.symbols == code.symbols
    assert found.wrong == pytest.approx(0.4**5 / (0.4**5 + 0.6**5), rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("n", [10, 12])
def test_words_of_the_two_schemes_are_far_apart(n: int) -> None:
    """A plate of one scheme, with as many wrong cells as checks correct, is none of the other."""
    rng = np.random.default_rng(7)
    least = {10: 4, 12: 7}[n]
    for _ in range(300):
        for scheme, other in itertools.permutations((PlateScheme.ID, PlateScheme.POSITION_ROBUST)):
            code = draw_code(scheme, n, rng)
            found = likely_codeword(shown(code.symbols), n, other)
            if found is None:
                continue
            for word in reed_solomon_words(n, PlateScheme.POSITION_ROBUST):
                assert sum(found.symbols[c] != code.symbols[c] for c in word.cells) >= least
            assert found.log_evidence < -5 < 15 < likely_codeword(shown(code.symbols), n, scheme).log_evidence  # type: ignore[union-attr]


@pytest.mark.parametrize("n", [10, 12])
@pytest.mark.parametrize("symbol", [0, 15])
def test_blank_and_dark_faces_are_no_positions(n: int, symbol: int) -> None:
    symbols = [symbol] * len(code_cells(n))
    assert not is_codeword(symbols, PlateScheme.POSITION_ROBUST, n)
    found = likely_codeword(shown(symbols), n, PlateScheme.POSITION_ROBUST)
    assert found is None or found.log_evidence < 0
