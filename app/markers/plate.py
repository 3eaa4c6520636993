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
from itertools import product
from typing import Final

import numpy as np
import numpy.typing as npt
import reedsolo

from app.errors import CodeMismatch, InvalidParameter
from app.geodesy import check_lon_lat
from app.values import Floats

# === Reed-Solomon words over GF(16) on the cells of a plate.
#
# Source: I.S. Reed and G. Solomon, "Polynomial codes over certain finite fields", J. SIAM 8 (1960), with the field x^4
# + x + 1 and the roots alpha^0, alpha^1, ... A word holds at most 15 symbols, so that larger plates interleave two.


FIELD = 0x13
"""[1] x^4 + x + 1, the polynomial of the field. Source: the id scheme's first plates."""
MAX_SYMBOLS = 15
"""[symbols] of one word. Source: a Reed-Solomon word over GF(q) has q - 1 symbols at most."""


@dataclass(frozen=True, slots=True)
class ReedSolomonWord:
    """One word of a plate: where its symbols stand and how many are data."""

    cells: tuple[int, ...]  # indices of the cells in reading order, data first
    # places of its data among the hexadecimal digits of the plate's number; the other symbols are checks
    digits: tuple[int, ...]
    # XORed on the symbols, so that words of another scheme, and blank faces, are far from those of this one
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
    def generator(self) -> npt.NDArray[np.uint8]:
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
def _generator(length: int, data: int) -> npt.NDArray[np.uint8]:
    rows = [list(_codec(length - data).encode([int(k == i) for k in range(data)])) for i in range(data)]
    return np.array(rows, dtype=np.uint8)


@lru_cache
def gf16_products() -> npt.NDArray[np.uint8]:
    """Products in the field, shape (16, 16)."""
    powers = [1]
    for _ in range(14):
        powers.append(powers[-1] << 1 ^ (FIELD if powers[-1] & 8 else 0))
    table = np.zeros((16, 16), dtype=np.uint8)
    for (i, a), (k, b) in product(enumerate(powers), repeat=2):
        table[a, b] = powers[(i + k) % 15]
    return table


# === The coded plate.


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
    def has_check(self) -> bool:
        """Whether a plate that is read wrongly can be noticed without the registry."""
        return self is not PlateScheme.POSITION

    @property
    def sizes(self) -> tuple[int, ...]:
        """Units along a side for which the scheme exists."""
        return (10, 12) if self is PlateScheme.POSITION_ROBUST else SIZES


NO_CHECK_TEXT = "any twelve digits are a plate, and a wrong one is not noticed"
"""Why plain positions are not for vehicles that read alone. Source: PolyU section II-B, on 8 x 8 units."""


@dataclass(frozen=True, slots=True)
class PlateGeometry:
    """Dimensions of a plate."""

    n: int = 8  # units along a side: 8, 10 or 12
    unit_mm: float = 35.0  # [mm] side of a unit, 20 to 50
    gap_mm: float = 5.0  # [mm] Insulation between units and round the border, 2 to 10
    thickness_mm: float = 20.0  # [mm] Thickness of the base plate, 5 to 50

    def __post_init__(self) -> None:
        """Raises InvalidParameter if a dimension or the side (150 to 500 mm) is outside the paper's limits."""
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
    """The symbols of one plate, checked against their scheme."""

    # one hexadecimal digit a cell in reading order; decimal for the schemes ``position`` and ``position-check``
    digits: str
    scheme: PlateScheme = PlateScheme.POSITION
    n: int = 8  # units along a side
    check_digits: int = 1  # for ``position-check``: 1 or 2 digits of the sum of the others

    def __post_init__(self) -> None:
        """Raises CodeMismatch if the length, the alphabet or a check is wrong."""
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


# === Full coordinates of a position plate, whose code holds the decimals only, and the schemes that digits may have.


@dataclass(frozen=True, slots=True)
class ResolvedPosition:
    """A position plate's full coordinates."""

    # `lon_deg`, `lat_deg`: [deg] the candidate nearest to the coarse position
    lon_deg: float
    lat_deg: float
    distance_deg: float  # [deg] how far it is from the coarse position, per axis at most
    next_distance_deg: float  # [deg] how far the second candidate is on the axis where the two are closest


def resolve_position(code: PlateCode, coarse_lon_deg: float, coarse_lat_deg: float) -> ResolvedPosition:
    """Complete a position plate's decimals with the integer degrees and sign from a coarse position.

    Notes
    -----
    The decimals are those of the magnitude, and rounding may have carried into the integer, so the neighbouring
    integers of both signs are tried and the nearest is taken; longitude wraps at the antimeridian.
    """
    check_lon_lat(coarse_lon_deg, coarse_lat_deg, field="coarse_position")
    lon_decimals, lat_decimals = code.decimals
    lon, lon_d, lon_next = _nearest_degree(lon_decimals, coarse_lon_deg, 180.0, wraps=True)
    lat, lat_d, lat_next = _nearest_degree(lat_decimals, coarse_lat_deg, 90.0, wraps=False)
    return ResolvedPosition(lon, lat, max(lon_d, lat_d), min(lon_next, lat_next))


def _nearest_degree(decimals: str, coarse_deg: float, bound: float, *, wraps: bool) -> tuple[float, float, float]:
    whole = int(abs(coarse_deg))
    candidates: dict[float, float] = {}
    for integer in range(max(whole - 1, 0), whole + 2):
        for sign in (1.0, -1.0):
            value = sign * float(f"{integer}.{decimals}")
            if abs(value) > bound:
                continue
            if wraps and value == -bound:
                value = bound
            difference = abs(value - coarse_deg)
            candidates[value + 0.0] = min(difference, 360.0 - difference) if wraps else difference
    ranked = sorted(candidates.items(), key=lambda item: item[1])
    return ranked[0][0], ranked[0][1], ranked[1][1] if len(ranked) > 1 else float("inf")


def decimal_codes(symbols: Sequence[int], n: int = 8) -> tuple[PlateCode, ...]:
    """Codes of the schemes without Reed-Solomon checks that show these symbols, the one with fewest check digits first.

    The plate does not say which it is: one check digit holds by accident for one plain position in ten, two for one in
    a hundred.
    """
    kinds = ((PlateScheme.POSITION, 1), (PlateScheme.POSITION_CHECK, 1), (PlateScheme.POSITION_CHECK, 2))
    return tuple(
        PlateCode.from_symbols(symbols, scheme, n, checks)
        for scheme, checks in kinds
        if is_codeword(symbols, scheme, n, checks)
    )


# === Digits of many plates in one call, the same as `PlateCode` makes one by one: for imports of a million.


Digits = npt.NDArray[np.bytes_]
_Numbers = npt.NDArray[np.uint64]
_Symbols = npt.NDArray[np.uint8]
_NEAR_TIE = 0.02
_ASCII = np.frombuffer(b"0123456789ABCDEF", dtype=np.uint8)


def position_digits(
    lon_deg: Floats,
    lat_deg: Floats,
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
    lon, lon_exact = _decimals_of_many(lon_deg, places[0])
    lat, lat_exact = _decimals_of_many(lat_deg, places[1])
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


def _decimals_of_many(degrees: Floats, places: int) -> tuple[_Numbers, npt.NDArray[np.bool_]]:
    """Decimals of |degrees| as numbers, and which of them need exact arithmetic."""
    scaled = np.abs(degrees) * 10.0**places
    decimals = np.rint(scaled).astype(np.uint64) % np.uint64(10**places)
    return decimals, np.abs(scaled - np.floor(scaled) - 0.5) < _NEAR_TIE


def _decimal_symbols(lon: _Numbers, lat: _Numbers, places: tuple[int, int], check_digits: int, cells: int) -> _Symbols:
    symbols = np.zeros((len(lon), cells), dtype=np.uint8)
    start = 0
    for decimals, count in zip((lon, lat), places, strict=True):
        symbols[:, start : start + count] = _decimal_digits(decimals, count)
        start += count
    total: _Numbers = symbols.sum(axis=1, dtype=np.uint64)
    symbols[:, start : start + check_digits] = _decimal_digits(total, check_digits)
    return symbols


def _decimal_digits(numbers: _Numbers, count: int) -> _Symbols:
    powers = 10 ** np.arange(count, dtype=np.uint64)[::-1]
    return (numbers[:, None] // powers % np.uint64(10)).astype(np.uint8)


def id_digits(numbers: _Numbers, *, n: int = 8) -> Digits:
    """Digits of id plates, each as `PlateCode.from_registry_number` gives them, shape (N,); every number fits."""
    return _joined(_encoded(numbers, n, PlateScheme.ID))


def registry_number_bits(n: int) -> int:
    """Bits of the number that an id plate carries."""
    return round(plate_capacity(n, PlateScheme.ID).bits)


def _encoded(numbers: _Numbers, n: int, scheme: PlateScheme) -> _Symbols:
    """Symbols of numbers in a scheme with Reed-Solomon words, shape (N, cells)."""
    zero, table = _linear(n, scheme)
    symbols = np.repeat(zero[None], len(numbers), axis=0)
    for k, changes in enumerate(table):
        nibble = (numbers >> np.uint64(4 * (len(table) - 1 - k))).astype(np.uint8) & 0xF
        symbols ^= changes[nibble]
    return symbols


@lru_cache
def _linear(n: int, scheme: PlateScheme) -> tuple[_Symbols, _Symbols]:
    """Codeword of zero, and what each value of each hexadecimal digit changes in it: the code is linear but for it."""
    count = plate_capacity(n, scheme).data_symbols
    zero = np.array(encode_number(0, n, scheme), dtype=np.uint8)
    words = [[encode_number(value << 4 * (count - 1 - k), n, scheme) for value in range(16)] for k in range(count)]
    return zero, np.array(words, dtype=np.uint8) ^ zero


def _joined(symbols: _Symbols) -> Digits:
    return np.ascontiguousarray(_ASCII[symbols]).view(f"S{symbols.shape[1]}").ravel()


# === The plates that are recommended: one size on the road, 325 mm, and checks that survive dirt.


RECOMMENDED_SCHEME: Final = PlateScheme.ID
"""Of a plate that the registry knows. Source: docs/decisions/0008-plate-codes.md."""
RECOMMENDED_POSITION_SCHEME: Final = PlateScheme.POSITION_ROBUST
"""Of a plate that must carry its position itself. Source: the same."""
ROBUST_GEOMETRY = PlateGeometry(n=10, unit_mm=27.0, gap_mm=5.0)
"""325 mm, as the paper's 8 x 8 units of 35 mm. Source: the same."""
EXPECTED_GEOMETRIES = (PlateGeometry(8), ROBUST_GEOMETRY, PlateGeometry(12))
"""Of plates that no registry names. Source: the recommended ones, and 12 x 12 units of 35 mm."""


def recommended_geometry(
    scheme: PlateScheme,
    *,
    n: int | None = None,
    unit_mm: float | None = None,
    gap_mm: float = 5.0,
    thickness_mm: float = 20.0,
) -> PlateGeometry:
    """Dimensions of a plate of a scheme, where some of them are chosen.

    Parameters
    ----------
    n : int, optional
        Units along a side; without, 10 for ``position-robust`` and 8 for the others.
    unit_mm : float, optional
        Side of a unit; without, 27 for ``position-robust`` on 10 x 10 and 35 for the others. [mm]

    Raises
    ------
    InvalidParameter
        A dimension is outside the limits, or the scheme does not exist on this size.
    """
    usual = ROBUST_GEOMETRY if scheme is PlateScheme.POSITION_ROBUST else PlateGeometry()
    n = usual.n if n is None else n
    check_size(n, scheme)
    if unit_mm is None:
        unit_mm = usual.unit_mm if n == usual.n else PlateGeometry().unit_mm
    return PlateGeometry(n, unit_mm, gap_mm, thickness_mm)
