"""The coded plate: layout, code and capacity.

Source: PolyU paper (Wang et al., IEEE T-ITS 23(11), 2022, doi 10.1109/TITS.2022.3173656), section II-B, and
docs/nomenclature.md.

An ``n`` x ``n`` grid of square units. Two by two units make a cell. The four corner cells are boundary markers (red
triangle top-left with its right angle at the plate's corner, green squares elsewhere); each other cell holds one
hexadecimal symbol, its units read left to right, top to bottom, most significant first, dark = 1.

Plate frame: millimetres from the plate's centre, x to the right, y up (the direction of travel), seen from above
with the red triangle top-left.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import ROUND_HALF_EVEN, Decimal
from enum import StrEnum
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from app.errors import CodeMismatch, InvalidParameter
from app.geodesy import check_lon_lat
from app.markers.reed_solomon import ReedSolomonWord, coset_mask

SIZES = (8, 10, 12)
UNIT_MM = (20.0, 50.0)
GAP_MM = (2.0, 10.0)
SIDE_MM = (150.0, 500.0)
THICKNESS_MM = (5.0, 50.0)
_SOURCE = "PolyU paper, section II-B"
_DIGITS = "0123456789ABCDEF"
_MAX_DECIMALS = 9


class PlateScheme(StrEnum):
    """How the symbols of a plate carry meaning."""

    POSITION = "position"
    POSITION_CHECK = "position-check"
    POSITION_ROBUST = "position-robust"
    ID = "id"

    @property
    def corrects(self) -> bool:
        """Whether Reed-Solomon check symbols correct wrong cells."""
        return self in (PlateScheme.POSITION_ROBUST, PlateScheme.ID)

    @property
    def sizes(self) -> tuple[int, ...]:
        """Units along a side for which the scheme exists."""
        return (10, 12) if self is PlateScheme.POSITION_ROBUST else SIZES


@dataclass(frozen=True, slots=True)
class PlateGeometry:
    """Dimensions of a plate.

    Parameters
    ----------
    n : int
        Units along a side: 8, 10 or 12.
    unit_mm : float
        Side of a unit, 20 to 50. [mm]
    gap_mm : float
        Insulation between units and round the border, 2 to 10. [mm]
    thickness_mm : float
        Thickness of the base plate, 5 to 50. [mm]

    Raises
    ------
    InvalidParameter
        A dimension, or the side that follows from them (150 to 500 mm), is outside the paper's limits.
    """

    n: int = 8
    unit_mm: float = 35.0
    gap_mm: float = 5.0
    thickness_mm: float = 20.0

    def __post_init__(self) -> None:
        if self.n not in SIZES:
            raise InvalidParameter(
                f"a plate has 8, 10 or 12 units along a side, not {self.n}",
                field="n",
                limit="8, 10 or 12",
                cure="choose n = 8, 10 or 12",
            )
        _check_range("unit_mm", self.unit_mm, UNIT_MM, "units are 20 to 50 mm (2-5 cm)")
        _check_range("gap_mm", self.gap_mm, GAP_MM, "gaps are 2 to 10 mm (0.2-1 cm)")
        _check_range("thickness_mm", self.thickness_mm, THICKNESS_MM, "base plates are 5 to 50 mm thick (0.5-5 cm)")
        _check_range("side_mm", self.side_mm, SIDE_MM, "base plates are 150 to 500 mm square (15-50 cm)")

    @property
    def pitch_mm(self) -> float:
        """Distance from one unit to the next. [mm]"""
        return self.unit_mm + self.gap_mm

    @property
    def side_mm(self) -> float:
        """Outer edge of the plate, the border gap included. [mm]"""
        return self.n * self.unit_mm + (self.n + 1) * self.gap_mm

    @property
    def corners_mm(self) -> npt.NDArray[np.float64]:
        """Outer corners in the plate frame, clockwise from the triangle's, shape (4, 2). [mm]"""
        half = self.side_mm / 2
        return np.array([(-half, half), (half, half), (half, -half), (-half, -half)])


def _check_range(field: str, value: float, limits: tuple[float, float], rule: str) -> None:
    low, high = limits
    if not low <= value <= high:
        raise InvalidParameter(
            f"{field} is {value:g} mm, but {rule}: {_SOURCE}",
            field=field,
            limit=f"{low:g} to {high:g} mm",
            cure=f"choose {field} between {low:g} and {high:g} mm",
        )


# --- layout -----------------------------------------------------------------------------------------------------


@lru_cache
def code_cells(n: int) -> tuple[tuple[int, int], ...]:
    """(row, column) of the cells that hold symbols, in reading order: all but the four corners."""
    last = n // 2 - 1
    corners = {(0, 0), (0, last), (last, 0), (last, last)}
    return tuple((r, c) for r in range(n // 2) for c in range(n // 2) if (r, c) not in corners)


@lru_cache
def unit_index(n: int) -> npt.NDArray[np.intp]:
    """Flat index into the ``n`` x ``n`` grid of each symbol's four units, most significant first, shape (cells, 4)."""
    return np.array(
        [[(2 * r + i) * n + 2 * c + j for i in (0, 1) for j in (0, 1)] for r, c in code_cells(n)], dtype=np.intp
    )


def units_from_symbols(symbols: Sequence[int], n: int) -> npt.NDArray[np.uint8]:
    """Grid of units, dark = 1, shape (n, n); the corner cells, which are boundary markers, are 0."""
    index = unit_index(n)
    grid = np.zeros(n * n, dtype=np.uint8)
    bits = (np.asarray(symbols, dtype=np.uint8)[:, None] >> np.array([3, 2, 1, 0], dtype=np.uint8)) & 1
    grid[index] = bits
    return grid.reshape(n, n)


# --- code -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class PlateCapacity:
    """Capacity of a scheme on a plate of one size."""

    n: int
    scheme: PlateScheme
    symbols: int
    data_symbols: int
    bits: float
    correctable_cells: int
    correctable_erasures: int


_WORDS = {
    (PlateScheme.ID, 8): ((8, 4),),
    (PlateScheme.ID, 10): ((6, 4), (6, 4)),
    (PlateScheme.ID, 12): ((8, 7), (8, 7)),
    (PlateScheme.POSITION_ROBUST, 10): ((5, 6), (5, 5)),
    (PlateScheme.POSITION_ROBUST, 12): ((6, 9), (6, 9)),
}
"""Data and check symbols of each Reed-Solomon word. The cells alternate between the words in reading order."""


@dataclass(frozen=True, slots=True)
class _Layout:
    """How a scheme divides the symbols: data, checks, Reed-Solomon words if any, spare cells (always 0)."""

    data: int
    checks: int
    words: tuple[ReedSolomonWord, ...]
    spare: int


def check_size(n: int, scheme: PlateScheme) -> None:
    """Raise `InvalidParameter` where a scheme does not exist on ``n`` x ``n`` units."""
    if n not in scheme.sizes:
        sizes = " or ".join(", ".join(map(str, scheme.sizes)).rsplit(", ", 1))
        raise InvalidParameter(
            f"a plate of the scheme {scheme} does not have {n} units along a side",
            field="n",
            limit=sizes,
            cure=f"choose n = {sizes}, or another scheme",
        )


@lru_cache
def _layout(n: int, scheme: PlateScheme, check_digits: int) -> _Layout:
    check_size(n, scheme)
    cells = len(code_cells(n))
    if scheme.corrects:
        words = reed_solomon_words(n, scheme)
        data, checks = sum(word.data for word in words), sum(word.checks for word in words)
        return _Layout(data, checks, words, cells - data - checks)
    checks = check_digits if scheme is PlateScheme.POSITION_CHECK else 0
    data = min(cells - checks, 2 * _MAX_DECIMALS)
    return _Layout(data, checks, (), cells - checks - data)


@lru_cache
def reed_solomon_words(n: int, scheme: PlateScheme) -> tuple[ReedSolomonWord, ...]:
    """The Reed-Solomon words of a scheme on an ``n`` x ``n`` plate; none if it has no such checks or no such size.

    Notes
    -----
    Words of the position scheme are masked (`coset_mask`): on plates of one size they differ from any word of the id
    scheme, and so from a blank face, in at least as many cells of each word as an id word has check symbols: 4 on
    10 x 10, 7 on 12 x 12. The digits of a position alternate between the words, so that both differ between plates
    that lie more than some metres apart.
    """
    words = _WORDS.get((scheme, n), ())
    total, digits = sum(data + checks for data, checks in words), sum(data for data, _ in words)
    made = []
    for k, (data, checks) in enumerate(words):
        cells, length = tuple(range(k, total, len(words))), data + checks
        if scheme is PlateScheme.ID:
            made.append(ReedSolomonWord(cells, tuple(range(k * data, (k + 1) * data)), (0,) * length))
        else:
            mask = coset_mask(length, _WORDS[PlateScheme.ID, n][0][1])
            made.append(ReedSolomonWord(cells, tuple(range(k, digits, len(words))), mask))
    return tuple(made)


def plate_capacity(n: int, scheme: PlateScheme, check_digits: int = 1) -> PlateCapacity:
    """Capacity of a scheme on an ``n`` x ``n`` plate.

    Notes
    -----
    Schemes with Reed-Solomon words correct, in each word, half as many wrong cells as it has check symbols, or as many
    unreadable ones; the numbers are those of the word with the fewest checks.
    """
    lay = _layout(n, scheme, check_digits)
    checks = min((word.checks for word in lay.words), default=0)
    digits = sum(position_decimals(n, scheme, check_digits)) if scheme is not PlateScheme.ID else 0
    bits = float(digits * np.log2(10)) if digits else lay.data * 4.0
    return PlateCapacity(n, scheme, len(code_cells(n)), lay.data, bits, checks // 2, checks)


@dataclass(frozen=True, slots=True)
class PlateCode:
    """The symbols of one plate, checked against their scheme.

    Parameters
    ----------
    digits : str
        One hexadecimal digit a cell in reading order; decimal for the schemes ``position`` and ``position-check``.
    scheme : PlateScheme
    n : int
        Units along a side.
    check_digits : int
        For ``position-check``: 1 or 2 digits of the sum of the others.

    Raises
    ------
    CodeMismatch
        Wrong length, alphabet or check.
    """

    digits: str
    scheme: PlateScheme = PlateScheme.POSITION
    n: int = 8
    check_digits: int = 1

    def __post_init__(self) -> None:
        _layout(self.n, self.scheme, 1)
        if self.check_digits not in (1, 2):
            raise InvalidParameter("there are one or two check digits", field="check_digits", limit="1 or 2")
        cells = len(code_cells(self.n))
        if len(self.digits) != cells:
            raise CodeMismatch(
                f"a {self.n} x {self.n} plate holds {cells} digits, these are {len(self.digits)}",
                field="digits",
                limit=f"{cells} digits",
                cure=f"give {cells} digits, or another size of plate",
            )
        alphabet = _DIGITS if self.scheme.corrects else _DIGITS[:10]
        if any(d not in alphabet for d in self.digits):
            raise CodeMismatch(
                f"digits of the scheme {self.scheme} are {alphabet[0]}-{alphabet[-1]}",
                field="digits",
                limit=f"alphabet {alphabet}",
                cure="use upper-case hexadecimal digits with id and position-robust, decimal digits with the others",
            )
        if not is_codeword(self.symbols, self.scheme, self.n, self.check_digits):
            raise CodeMismatch(
                f"the check of the scheme {self.scheme} fails on {self.digits}",
                field="digits",
                limit="check symbols follow from the others",
                cure="give the position or the registry number and let Waymark make the digits",
            )

    @property
    def symbols(self) -> tuple[int, ...]:
        """One value from 0 to 15 a cell, in reading order."""
        return tuple(int(d, 16) for d in self.digits)

    @property
    def units(self) -> npt.NDArray[np.uint8]:
        """Grid of units, dark = 1, shape (n, n)."""
        return units_from_symbols(self.symbols, self.n)

    @property
    def registry_number(self) -> int:
        """The number that an id plate carries."""
        if self.scheme is not PlateScheme.ID:
            raise CodeMismatch("only id plates carry a registry number", field="scheme")
        return _number(self.symbols, self.n, self.scheme)

    @property
    def decimals(self) -> tuple[str, str]:
        """Decimals of |longitude| and of |latitude| that a position plate carries."""
        if self.scheme is PlateScheme.ID:
            raise CodeMismatch("an id plate carries no position", field="scheme")
        lon, lat = position_decimals(self.n, self.scheme, self.check_digits)
        digits = self.digits
        if self.scheme.corrects:
            digits = f"{_number(self.symbols, self.n, self.scheme):0{lon + lat}d}"
        return digits[:lon], digits[lon : lon + lat]

    @classmethod
    def from_symbols(cls, symbols: Sequence[int], scheme: PlateScheme, n: int = 8, check_digits: int = 1) -> PlateCode:
        """Code of a sequence of symbols, shape (cells,)."""
        return cls("".join(_DIGITS[s] for s in symbols), scheme, n, check_digits)

    @classmethod
    def from_position(
        cls, lon_deg: float, lat_deg: float, *, n: int = 8, scheme: PlateScheme | None = None, check_digits: int = 0
    ) -> PlateCode:
        """Position plate: the decimals of |longitude|, then of |latitude|, then the checks if any.

        Parameters
        ----------
        lon_deg, lat_deg : float
            Position of the plate's centre. [deg]
        n : int
            Units along a side.
        scheme : PlateScheme, optional
            Without, ``position``, or ``position-check`` with check digits.
        check_digits : int
            For ``position-check``: 1 (as with 0) or 2.

        Raises
        ------
        InvalidParameter
            The position is out of range or not finite, or the scheme does not exist on this size.
        """
        check_lon_lat(lon_deg, lat_deg)
        if scheme is None:
            scheme = PlateScheme.POSITION_CHECK if check_digits else PlateScheme.POSITION
        lay = _layout(n, scheme, check_digits or 1)
        lon_decimals, lat_decimals = position_decimals(n, scheme, check_digits or 1)
        data = _decimals(lon_deg, lon_decimals) + _decimals(lat_deg, lat_decimals)
        if scheme.corrects:
            return cls.from_symbols(encode_number(int(data), n, scheme), scheme, n)
        return cls(data + _digit_sum(data, lay.checks) + "0" * lay.spare, scheme, n, check_digits or 1)

    @classmethod
    def from_registry_number(cls, number: int, *, n: int = 8) -> PlateCode:
        """Id plate: the number in hexadecimal, protected by Reed-Solomon over GF(16).

        Raises
        ------
        InvalidParameter
            The number is negative or does not fit (32 bits on 8 x 8, 48 on 10 x 10, 64 on 12 x 12).
        """
        data = _layout(n, PlateScheme.ID, 1).data
        if not 0 <= number < 16**data:
            raise InvalidParameter(
                f"registry number {number} does not fit a {n} x {n} plate",
                field="registry_number",
                limit=f"0 to {16**data - 1}",
                cure="choose a smaller number or a larger plate",
            )
        return cls.from_symbols(encode_number(number, n, PlateScheme.ID), PlateScheme.ID, n)


def encode_number(number: int, n: int, scheme: PlateScheme) -> list[int]:
    """Symbols of a number in a scheme with Reed-Solomon words, shape (cells,)."""
    lay = _layout(n, scheme, 1)
    data = [int(d, 16) for d in f"{number:0{lay.data}X}"]
    symbols = [0] * len(code_cells(n))
    for word in lay.words:
        for cell, symbol in zip(word.cells, word.encode([data[k] for k in word.digits]), strict=True):
            symbols[cell] = symbol
    return symbols


def _number(symbols: Sequence[int], n: int, scheme: PlateScheme) -> int:
    """The number whose symbols these are; they must be a codeword."""
    found: dict[int, int] = {}
    for word in reed_solomon_words(n, scheme):
        found |= dict(zip(word.digits, word.decode(symbols), strict=True))
    return int("".join(_DIGITS[found[k]] for k in range(len(found))), 16)


def position_decimals(n: int, scheme: PlateScheme, check_digits: int = 1) -> tuple[int, int]:
    """Decimals of longitude and of latitude on a plate: six each on 8 x 8 without check digits."""
    data = _layout(n, scheme, check_digits).data
    digits = math.floor(data * math.log10(16) / 2) * 2 if scheme.corrects else data
    return digits - digits // 2, digits // 2


def _decimals(degrees: float, places: int) -> str:
    """Decimals of |degrees| rounded to `places`; a rounding that carries into the integer part leaves zeros."""
    rounded = abs(Decimal(repr(float(degrees)))).quantize(Decimal(1).scaleb(-places), ROUND_HALF_EVEN)
    return f"{rounded:f}".partition(".")[2]


def _digit_sum(digits: str, checks: int) -> str:
    return f"{sum(int(d) for d in digits) % 10**checks:0{checks}d}" if checks else ""


def is_codeword(symbols: Sequence[int], scheme: PlateScheme, n: int = 8, check_digits: int = 1) -> bool:
    """Whether the symbols satisfy every check of the scheme as they are."""
    lay = _layout(n, scheme, check_digits)
    body, spare = symbols[: lay.data + lay.checks], symbols[lay.data + lay.checks :]
    if any(spare):
        return False
    if scheme.corrects:
        held = all(word.holds(symbols) for word in lay.words)
        return held and (scheme is PlateScheme.ID or _number(symbols, n, scheme) < numbers(n, scheme))
    if any(s > 9 for s in body):
        return False
    digits = "".join(_DIGITS[s] for s in body)
    return digits[lay.data :] == _digit_sum(digits[: lay.data], lay.checks)


def numbers(n: int, scheme: PlateScheme) -> int:
    """How many plates of a scheme with Reed-Solomon words there are: registry numbers, or positions."""
    if scheme is PlateScheme.ID:
        return int(16 ** _layout(n, scheme, 1).data)
    return int(10 ** sum(position_decimals(n, scheme)))
