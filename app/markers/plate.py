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

from collections.abc import Sequence
from dataclasses import dataclass
from decimal import ROUND_HALF_EVEN, Decimal
from enum import StrEnum
from functools import lru_cache

import numpy as np
import numpy.typing as npt
import reedsolo

from app.errors import CodeMismatch, InvalidParameter
from app.geodesy import check_lon_lat

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
    ID = "id"


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


@dataclass(frozen=True, slots=True)
class _Layout:
    """How a scheme divides the symbols: data, checks, interleaved codewords, spare cells (always 0)."""

    data: int
    checks: int
    codewords: int
    spare: int


def _layout(n: int, scheme: PlateScheme, check_digits: int) -> _Layout:
    if n not in SIZES:
        raise InvalidParameter(
            f"no plate has {n} units along a side", field="n", limit="8, 10 or 12", cure="choose n = 8, 10 or 12"
        )
    cells = len(code_cells(n))
    if scheme is PlateScheme.ID:  # GF(16) codewords hold at most 15 symbols, so larger plates interleave two
        data, checks, words = {8: (8, 4, 1), 10: (6, 4, 2), 12: (8, 7, 2)}[n]
        return _Layout(data * words, checks * words, words, cells - (data + checks) * words)
    checks = check_digits if scheme is PlateScheme.POSITION_CHECK else 0
    data = min(cells - checks, 2 * _MAX_DECIMALS)
    return _Layout(data, checks, 1, cells - checks - data)


def plate_capacity(n: int, scheme: PlateScheme, check_digits: int = 1) -> PlateCapacity:
    """Capacity of a scheme on an ``n`` x ``n`` plate.

    Notes
    -----
    The id scheme corrects, per codeword, half as many wrong cells as it has check symbols, or all of them unreadable.
    """
    lay = _layout(n, scheme, check_digits)
    is_id = scheme is PlateScheme.ID
    return PlateCapacity(
        n=n,
        scheme=scheme,
        symbols=len(code_cells(n)),
        data_symbols=lay.data,
        bits=lay.data * (4.0 if is_id else float(np.log2(10))),
        correctable_cells=lay.checks // lay.codewords // 2 if is_id else 0,
        correctable_erasures=lay.checks // lay.codewords if is_id else 0,
    )


def codewords_of_cells(n: int, scheme: PlateScheme) -> tuple[int | None, ...]:
    """Number of the interleaved codeword that each cell belongs to, in reading order; None for spare cells."""
    lay = _layout(n, scheme, 1)
    return tuple(i % lay.codewords if i < lay.data + lay.checks else None for i in range(len(code_cells(n))))


@lru_cache
def _reed_solomon(checks: int) -> reedsolo.RSCodec:
    return reedsolo.RSCodec(checks, nsize=15, c_exp=4, prim=0x13)


@dataclass(frozen=True, slots=True)
class PlateCode:
    """The symbols of one plate, checked against their scheme.

    Parameters
    ----------
    digits : str
        One hexadecimal digit a cell in reading order; decimal for the position schemes.
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
        if self.n not in SIZES:
            raise InvalidParameter(f"no plate has {self.n} units along a side", field="n", limit="8, 10 or 12")
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
        alphabet = _DIGITS if self.scheme is PlateScheme.ID else _DIGITS[:10]
        if any(d not in alphabet for d in self.digits):
            raise CodeMismatch(
                f"digits of the scheme {self.scheme} are {alphabet[0]}-{alphabet[-1]}",
                field="digits",
                limit=f"alphabet {alphabet}",
                cure="use upper-case hexadecimal digits for id plates, decimal digits for positions",
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
        lay = _layout(self.n, self.scheme, self.check_digits)
        return int("".join(w[: lay.data // lay.codewords] for w in _deinterleave(self.digits, lay)), 16)

    @classmethod
    def from_symbols(cls, symbols: Sequence[int], scheme: PlateScheme, n: int = 8, check_digits: int = 1) -> PlateCode:
        """Code of a sequence of symbols, shape (cells,)."""
        return cls("".join(_DIGITS[s] for s in symbols), scheme, n, check_digits)

    @classmethod
    def from_position(cls, lon_deg: float, lat_deg: float, *, n: int = 8, check_digits: int = 0) -> PlateCode:
        """Position plate: the decimals of |longitude|, then of |latitude|, then the check digits if any.

        Parameters
        ----------
        lon_deg, lat_deg : float
            Position of the plate's centre. [deg]
        n : int
            Units along a side.
        check_digits : int
            0 for the scheme ``position``, 1 or 2 for ``position-check``.

        Raises
        ------
        InvalidParameter
            The position is out of range or not finite.
        """
        check_lon_lat(lon_deg, lat_deg)
        scheme = PlateScheme.POSITION_CHECK if check_digits else PlateScheme.POSITION
        lay = _layout(n, scheme, check_digits)
        lon_decimals, lat_decimals = position_decimals(n, scheme, check_digits)
        data = _decimals(lon_deg, lon_decimals) + _decimals(lat_deg, lat_decimals)
        return cls(data + _digit_sum(data, lay.checks) + "0" * lay.spare, scheme, n, check_digits or 1)

    @classmethod
    def from_registry_number(cls, number: int, *, n: int = 8) -> PlateCode:
        """Id plate: the number in hexadecimal, protected by Reed-Solomon over GF(16).

        Raises
        ------
        InvalidParameter
            The number is negative or does not fit (32 bits on 8 x 8, 48 on 10 x 10, 64 on 12 x 12).
        """
        lay = _layout(n, PlateScheme.ID, 1)
        if not 0 <= number < 16**lay.data:
            raise InvalidParameter(
                f"registry number {number} does not fit a {n} x {n} plate",
                field="registry_number",
                limit=f"0 to {16**lay.data - 1}",
                cure="choose a smaller number or a larger plate",
            )
        data = [int(d, 16) for d in f"{number:0{lay.data}X}"]
        per_word = lay.data // lay.codewords
        codec = _reed_solomon(lay.checks // lay.codewords)
        words = [list(codec.encode(data[i * per_word : (i + 1) * per_word])) for i in range(lay.codewords)]
        woven = [words[i][k] for k in range(len(words[0])) for i in range(lay.codewords)]
        return cls.from_symbols(woven + [0] * lay.spare, PlateScheme.ID, n)


def position_decimals(n: int, scheme: PlateScheme, check_digits: int = 1) -> tuple[int, int]:
    """Decimals of longitude and of latitude on a plate: six each on 8 x 8 without check digits."""
    data = _layout(n, scheme, check_digits).data
    return data - data // 2, data // 2


def _decimals(degrees: float, places: int) -> str:
    """Decimals of |degrees| rounded to `places`; a rounding that carries into the integer part leaves zeros."""
    rounded = abs(Decimal(repr(float(degrees)))).quantize(Decimal(1).scaleb(-places), ROUND_HALF_EVEN)
    return f"{rounded:f}".partition(".")[2]


def _digit_sum(digits: str, checks: int) -> str:
    return f"{sum(int(d) for d in digits) % 10**checks:0{checks}d}" if checks else ""


def _deinterleave(digits: str, lay: _Layout) -> list[str]:
    woven = digits[: lay.data + lay.checks]
    return [woven[i :: lay.codewords] for i in range(lay.codewords)]


def is_codeword(symbols: Sequence[int], scheme: PlateScheme, n: int = 8, check_digits: int = 1) -> bool:
    """Whether the symbols satisfy every check of the scheme as they are."""
    lay = _layout(n, scheme, check_digits)
    body, spare = symbols[: lay.data + lay.checks], symbols[lay.data + lay.checks :]
    if any(spare):
        return False
    if scheme is PlateScheme.ID:
        codec = _reed_solomon(lay.checks // lay.codewords)
        return all(all(codec.check(list(body[i :: lay.codewords]))) for i in range(lay.codewords))
    if any(s > 9 for s in body):
        return False
    digits = "".join(_DIGITS[s] for s in body)
    return digits[lay.data :] == _digit_sum(digits[: lay.data], lay.checks)


def correct_symbols(symbols: Sequence[int], n: int = 8, erasures: Sequence[int] = ()) -> tuple[int, ...] | None:
    """Nearest codeword of the id scheme, or None beyond the correction capacity.

    Parameters
    ----------
    symbols : sequence of int, shape (cells,)
        As read; the value at an erasure does not matter.
    n : int
        Units along a side.
    erasures : sequence of int
        Indices of unreadable cells.
    """
    lay = _layout(n, PlateScheme.ID, 1)
    per_word = (lay.data + lay.checks) // lay.codewords
    codec = _reed_solomon(lay.checks // lay.codewords)
    fixed = [0] * (lay.data + lay.checks)
    for i in range(lay.codewords):
        word = list(symbols[i : lay.data + lay.checks : lay.codewords])
        erased = [(e - i) // lay.codewords for e in erasures if e % lay.codewords == i and e < len(fixed)]
        if len(erased) > lay.checks // lay.codewords:
            return None
        try:
            repaired = list(codec.decode(word, erase_pos=erased)[1])
        except reedsolo.ReedSolomonError:
            return None
        if len(repaired) != per_word:
            return None
        fixed[i :: lay.codewords] = repaired
    corrected = (*fixed, *([0] * lay.spare))
    return corrected if is_codeword(corrected, PlateScheme.ID, n) else None
