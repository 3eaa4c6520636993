"""Reed-Solomon words over GF(16) on the cells of a plate.

Source: I.S. Reed and G. Solomon, "Polynomial codes over certain finite fields", J. SIAM 8 (1960), with the field
x^4 + x + 1 and the roots alpha^0, alpha^1, ... A word holds at most 15 symbols, so that larger plates interleave two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
import reedsolo

Array = npt.NDArray[Any]

FIELD = 0x13
"""[1] x^4 + x + 1, the polynomial of the field. Source: the id scheme's first plates."""
MAX_SYMBOLS = 15
"""[symbols] of one word. Source: a Reed-Solomon word over GF(q) has q - 1 symbols at most."""


@dataclass(frozen=True, slots=True)
class ReedSolomonWord:
    """One word of a plate: where its symbols stand and how many are data.

    Attributes
    ----------
    cells : tuple of int
        Indices of the cells in reading order, data first.
    digits : tuple of int
        Places of its data among the hexadecimal digits of the plate's number; the other symbols are checks.
    mask : tuple of int
        XORed on the symbols, so that words of another scheme, and blank faces, are far from those of this one.
    """

    cells: tuple[int, ...]
    digits: tuple[int, ...]
    mask: tuple[int, ...]

    @property
    def data(self) -> int:
        """Symbols of data."""
        return len(self.digits)

    @property
    def checks(self) -> int:
        """Check symbols: half as many wrong cells, or as many unreadable ones, can be corrected."""
        return len(self.cells) - self.data

    def encode(self, data: Sequence[int]) -> list[int]:
        """Symbols of the word in the order of its cells, shape (cells,)."""
        return [s ^ m for s, m in zip(_codec(self.checks).encode(list(data)), self.mask, strict=True)]

    def decode(self, symbols: Sequence[int]) -> list[int]:
        """Data of a plate's symbols, which must satisfy the checks, shape (data,)."""
        return [symbols[cell] ^ mask for cell, mask in zip(self.cells[: self.data], self.mask, strict=False)]

    def holds(self, symbols: Sequence[int]) -> bool:
        """Whether a plate's symbols satisfy the checks of the word."""
        word = [symbols[cell] ^ mask for cell, mask in zip(self.cells, self.mask, strict=True)]
        return all(_codec(self.checks).check(word))

    @property
    def generator(self) -> Array:
        """Generator matrix of the word without its mask, shape (data, cells)."""
        return _generator(len(self.cells), self.data)


def coset_mask(length: int, checks: int) -> tuple[int, ...]:
    """A mask that no word of the code with `checks` check symbols comes near.

    Notes
    -----
    It is the generator polynomial of the code with one check symbol less: a word of that code, and none of the code
    itself. The difference of masked and plain words is then a nonzero word of the code with one check less, and differs
    from zero in at least `checks` symbols, the distance of that code.
    """
    generator = [int(c) for c in _codec(checks - 1).encode([1])]
    return (*[0] * (length - len(generator)), *generator)


@lru_cache
def _codec(checks: int) -> reedsolo.RSCodec:
    return reedsolo.RSCodec(checks, nsize=MAX_SYMBOLS, c_exp=4, prim=FIELD)


@lru_cache
def _generator(length: int, data: int) -> Array:
    rows = [list(_codec(length - data).encode([int(k == i) for k in range(data)])) for i in range(data)]
    return np.array(rows, dtype=np.uint8)


@lru_cache
def gf16_products() -> Array:
    """Products in the field, shape (16, 16)."""
    table = np.zeros((16, 16), dtype=np.uint8)
    power = 1
    powers = []
    for _ in range(15):
        powers.append(power)
        power = power << 1 ^ (FIELD if power & 8 else 0)
    for i, a in enumerate(powers):
        for k, b in enumerate(powers):
            table[a, b] = powers[(i + k) % 15]
    return table
