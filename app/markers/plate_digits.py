"""Digits of many plates in one call, the same as `PlateCode` makes one by one: for imports of a million."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from app.markers.plate import PlateCode, PlateScheme, code_cells, plate_capacity, position_decimals

Digits = npt.NDArray[np.bytes_]
_NEAR_TIE = 0.02
_ASCII = np.frombuffer(b"0123456789ABCDEF", dtype=np.uint8)


def position_digits(
    lon_deg: npt.NDArray[np.float64], lat_deg: npt.NDArray[np.float64], *, n: int = 8, check_digits: int = 0
) -> Digits:
    """Digits of position plates, each as `PlateCode.from_position` gives them, shape (N,).

    Notes
    -----
    A coordinate whose next decimal is near 5 goes through exact decimal arithmetic; all others round alike in both.
    """
    scheme = PlateScheme.POSITION_CHECK if check_digits else PlateScheme.POSITION
    places = position_decimals(n, scheme, check_digits)
    cells = len(code_cells(n))
    symbols = np.zeros((len(lon_deg), cells), dtype=np.uint8)
    exact = np.zeros(len(lon_deg), dtype=bool)
    start = 0
    for degrees, count in zip((lon_deg, lat_deg), places, strict=True):
        scaled = np.abs(degrees) * 10.0**count
        exact |= np.abs(scaled - np.floor(scaled) - 0.5) < _NEAR_TIE
        rest = np.rint(scaled).astype(np.int64)
        for k in range(count - 1, -1, -1):
            rest, symbols[:, start + k] = np.divmod(rest, 10)
        start += count
    total: npt.NDArray[np.int64] = symbols.sum(axis=1, dtype=np.int64)
    for k in range(check_digits - 1, -1, -1):
        total, symbols[:, start + k] = np.divmod(total, 10)
    digits = _joined(symbols)
    for k in np.flatnonzero(exact).tolist():
        code = PlateCode.from_position(float(lon_deg[k]), float(lat_deg[k]), n=n, check_digits=check_digits)
        digits[k] = code.digits.encode()
    return digits


def id_digits(numbers: npt.NDArray[np.uint64], *, n: int = 8) -> Digits:
    """Digits of id plates, each as `PlateCode.from_registry_number` gives them, shape (N,); every number fits."""
    bits = registry_number_bits(n)
    table = _linear(n)
    symbols = np.zeros((len(numbers), table.shape[2]), dtype=np.uint8)
    for k in range(bits // 4):
        nibble = (numbers >> np.uint64(bits - 4 - 4 * k)).astype(np.uint8) & 0xF
        symbols ^= table[k][nibble]
    return _joined(symbols)


def registry_number_bits(n: int) -> int:
    """Bits of the number that an id plate carries."""
    return round(plate_capacity(n, PlateScheme.ID).bits)


@lru_cache
def _linear(n: int) -> npt.NDArray[np.uint8]:
    """Codewords of each value of each hexadecimal digit by itself: the code is linear, their XOR is any other's."""
    count = registry_number_bits(n) // 4
    words = [
        [PlateCode.from_registry_number(value << 4 * (count - 1 - k), n=n).symbols for value in range(16)]
        for k in range(count)
    ]
    return np.array(words, dtype=np.uint8)


def _joined(symbols: npt.NDArray[np.uint8]) -> Digits:
    return np.ascontiguousarray(_ASCII[symbols]).view(f"S{symbols.shape[1]}").ravel()
