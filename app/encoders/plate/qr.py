"""QR codes of many addresses that differ in a few characters.

For one length and one mask a QR symbol is an affine function of its message's bits over GF(2): Reed-Solomon codes are
linear and the mask is a constant. So a symbol whose message is a sum of known messages is the sum of their symbols, and
after a few dozen plates of a selection segno, which takes about a millisecond a symbol, is hardly called any more.
"""

from __future__ import annotations

from functools import lru_cache
from threading import Lock

import numpy as np
import numpy.typing as npt
import segno

_MASK = 2  # any mask reads; a fixed one keeps the function affine and saves the eightfold trial


def qr_modules(text: str) -> npt.NDArray[np.uint8]:
    """Modules of the QR code (level M) of an ASCII text, dark = 1, without quiet zone, shape (K, K)."""
    return _book(len(text)).modules(text)


class _Book:
    """Basis of the messages of one length seen so far, each with its symbol, in echelon form."""

    def __init__(self, length: int) -> None:
        self._constant = 1 << (8 * length)  # makes the affine function a linear one
        self._basis: dict[int, tuple[int, int]] = {}
        self._side = 0
        self._lock = Lock()

    def modules(self, text: str) -> npt.NDArray[np.uint8]:
        with self._lock:
            symbol = self._symbol(text)
        packed = np.frombuffer(symbol.to_bytes(-(-(self._side**2) // 8), "big"), dtype=np.uint8)
        return np.unpackbits(packed)[-(self._side**2) :].reshape(self._side, self._side)

    def _symbol(self, text: str) -> int:
        message, symbol = self._constant | int.from_bytes(text.encode("ascii"), "big"), 0
        while message:
            leading = message.bit_length()
            if leading not in self._basis:
                full = self._encode(text)
                self._basis[leading] = (message, symbol ^ full)
                return full
            known, change = self._basis[leading]
            message ^= known
            symbol ^= change
        return symbol

    def _encode(self, text: str) -> int:
        code = segno.make(text, error="m", mode="byte", micro=False, mask=_MASK, boost_error=False)
        modules = np.array(code.matrix, dtype=np.uint8)
        self._side = len(modules)
        bits = np.packbits(np.pad(modules.reshape(-1), (-modules.size % 8, 0)))
        return int.from_bytes(bits.tobytes(), "big")


@lru_cache(maxsize=16)
def _book(length: int) -> _Book:
    return _Book(length)
