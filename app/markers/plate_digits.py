"""Digits of many plates in one call, the same as `PlateCode` makes one by one: for imports of a million."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from app.markers.plate import PlateCode, PlateScheme, code_cells, encode_number, plate_capacity, position_decimals

Digits = npt.NDArray[np.bytes_]
_NEAR_TIE = 0.02
_ASCII = np.frombuffer(b"0123456789ABCDEF", dtype=np.uint8)


def position_digits(
    lon_deg: npt.NDArray[np.float64],
    lat_deg: npt.NDArray[np.float64],
    *,
    n: int = 8,
    scheme: PlateScheme = PlateScheme.POSITION,
    check_digits: int = 0,
) -> Digits:
    """Digits of position plates, each as `PlateCode.from_position` gives them, shape (N,).

    Notes
    -----
    A coordinate whose next decimal is near 5 goes through exact decimal arithmetic; all others round alike in both.
    """
    if scheme is PlateScheme.POSITION_CHECK:
        check_digits = check_digits or 1
    places = position_decimals(n, scheme, check_digits)
    lon, lon_exact = _decimals(lon_deg, places[0])
    lat, lat_exact = _decimals(lat_deg, places[1])
    if scheme.corrects:
        symbols = _encoded(lon * np.uint64(10 ** places[1]) + lat, n, scheme)
    else:
        symbols = _decimal_symbols(lon, lat, places, check_digits, len(code_cells(n)))
    digits = _joined(symbols)
    for k in np.flatnonzero(lon_exact | lat_exact).tolist():
        code = PlateCode.from_position(
            float(lon_deg[k]), float(lat_deg[k]), n=n, scheme=scheme, check_digits=check_digits
        )
        digits[k] = code.digits.encode()
    return digits


def _decimals(degrees: npt.NDArray[np.float64], places: int) -> tuple[npt.NDArray[np.uint64], npt.NDArray[np.bool_]]:
    """Decimals of |degrees| as numbers, and which of them need exact arithmetic."""
    scaled = np.abs(degrees) * 10.0**places
    decimals = np.rint(scaled).astype(np.uint64) % np.uint64(10**places)
    return decimals, np.abs(scaled - np.floor(scaled) - 0.5) < _NEAR_TIE


def _decimal_symbols(
    lon: npt.NDArray[np.uint64], lat: npt.NDArray[np.uint64], places: tuple[int, int], check_digits: int, cells: int
) -> npt.NDArray[np.uint8]:
    symbols = np.zeros((len(lon), cells), dtype=np.uint8)
    start = 0
    for decimals, count in zip((lon, lat), places, strict=True):
        symbols[:, start : start + count] = _decimal_digits(decimals, count)
        start += count
    total: npt.NDArray[np.uint64] = symbols.sum(axis=1, dtype=np.uint64)
    symbols[:, start : start + check_digits] = _decimal_digits(total, check_digits)
    return symbols


def _decimal_digits(numbers: npt.NDArray[np.uint64], count: int) -> npt.NDArray[np.uint8]:
    powers = 10 ** np.arange(count, dtype=np.uint64)[::-1]
    return (numbers[:, None] // powers % np.uint64(10)).astype(np.uint8)


def id_digits(numbers: npt.NDArray[np.uint64], *, n: int = 8) -> Digits:
    """Digits of id plates, each as `PlateCode.from_registry_number` gives them, shape (N,); every number fits."""
    return _joined(_encoded(numbers, n, PlateScheme.ID))


def registry_number_bits(n: int) -> int:
    """Bits of the number that an id plate carries."""
    return round(plate_capacity(n, PlateScheme.ID).bits)


def _encoded(numbers: npt.NDArray[np.uint64], n: int, scheme: PlateScheme) -> npt.NDArray[np.uint8]:
    """Symbols of numbers in a scheme with Reed-Solomon words, shape (N, cells)."""
    zero, table = _linear(n, scheme)
    symbols = np.repeat(zero[None], len(numbers), axis=0)
    for k, changes in enumerate(table):
        nibble = (numbers >> np.uint64(4 * (len(table) - 1 - k))).astype(np.uint8) & 0xF
        symbols ^= changes[nibble]
    return symbols


@lru_cache
def _linear(n: int, scheme: PlateScheme) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
    """Codeword of zero, and what each value of each hexadecimal digit changes in it: the code is linear but for it."""
    count = plate_capacity(n, scheme).data_symbols
    zero = np.array(encode_number(0, n, scheme), dtype=np.uint8)
    words = [[encode_number(value << 4 * (count - 1 - k), n, scheme) for value in range(16)] for k in range(count)]
    return zero, np.array(words, dtype=np.uint8) ^ zero


def _joined(symbols: npt.NDArray[np.uint8]) -> Digits:
    return np.ascontiguousarray(_ASCII[symbols]).view(f"S{symbols.shape[1]}").ravel()
