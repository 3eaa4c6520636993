"""The plate's code: layout, checks, limits, and positions from decimals, against the paper and against arithmetic."""

from __future__ import annotations

import math
import re
from decimal import Decimal

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from app.errors import CodeMismatch, InvalidParameter
from app.markers.plate import (
    PlateCode,
    PlateGeometry,
    PlateScheme,
    code_cells,
    decimal_codes,
    encode_number,
    is_codeword,
    plate_capacity,
    position_decimals,
    resolve_position,
    unit_index,
    units_from_symbols,
)

# --- layout -----------------------------------------------------------------------------------------------------------

PAPER_DIGITS = "023792168411"
PAPER_UNITS = """
    ..  ..  ..  ..
    ..  ..  #.  ..
    ..  .#  #.  ..
    ##  ##  .#  #.
    ..  .#  #.  .#
    .#  #.  ..  ..
    ..  ..  ..  ..
    ..  .#  .#  ..
"""  # the paper's [999 0 2 999; 3 7 9 2; 1 6 8 4; 999 1 1 999], dark = #, markers left empty


def grid(text: str) -> np.ndarray:
    return np.array([[c == "#" for c in line.replace(" ", "")] for line in text.split("\n") if line.strip()], np.uint8)


def symbols_from_units(units: np.ndarray) -> tuple[int, ...]:
    bits = units.reshape(-1)[unit_index(units.shape[0])]
    return tuple(int(v) for v in bits @ np.array([8, 4, 2, 1]))


def test_the_papers_matrix_is_read_row_by_row() -> None:
    code = PlateCode(PAPER_DIGITS)
    np.testing.assert_array_equal(code.units, grid(PAPER_UNITS))
    assert symbols_from_units(grid(PAPER_UNITS)) == (0, 2, 3, 7, 9, 2, 1, 6, 8, 4, 1, 1)
    assert PlateCode.from_symbols(symbols_from_units(grid(PAPER_UNITS)), PlateScheme.POSITION) == code


@pytest.mark.parametrize(
    ("symbol", "cell"), [(8, "#. .."), (4, ".# .."), (2, ".. #."), (1, ".. .#"), (14, "## #."), (7, ".# ##")]
)
def test_bits_run_left_to_right_top_to_bottom_most_significant_first(symbol: int, cell: str) -> None:
    first = units_from_symbols([symbol, *[0] * 11], 8)[0:2, 2:4]
    np.testing.assert_array_equal(first, grid(cell.replace(" ", "\n")))


@pytest.mark.parametrize(("n", "cells"), [(8, 12), (10, 21), (12, 32)])
def test_all_cells_but_the_corners_hold_symbols(n: int, cells: int) -> None:
    at = code_cells(n)
    last = n // 2 - 1
    assert len(at) == len(set(at)) == cells
    assert list(at) == sorted(at)  # row by row
    assert not {(0, 0), (0, last), (last, 0), (last, last)} & set(at)
    lit = units_from_symbols([15] * cells, n)
    assert lit.sum() == 4 * cells == n * n - 16
    assert lit[:2, :2].sum() == lit[:2, -2:].sum() == lit[-2:, :2].sum() == lit[-2:, -2:].sum() == 0


@given(st.sampled_from([8, 10, 12]), st.data())
@settings(max_examples=50, deadline=None)
def test_units_carry_any_symbols(n: int, data: st.DataObject) -> None:
    count = len(code_cells(n))
    symbols = tuple(data.draw(st.lists(st.integers(0, 15), min_size=count, max_size=count)))
    assert symbols_from_units(units_from_symbols(symbols, n)) == symbols


# --- limits -----------------------------------------------------------------------------------------------------------


def test_the_papers_plate_is_325_mm() -> None:
    plate = PlateGeometry()
    assert (plate.side_mm, plate.pitch_mm) == (325.0, 40.0)  # 8 x 35 + 9 x 5
    half = 162.5  # clockwise from the triangle's corner, y up
    np.testing.assert_array_equal(plate.corners_mm, [(-half, half), (half, half), (half, -half), (-half, -half)])


@pytest.mark.parametrize(
    ("dimensions", "field", "limit", "in_paper"),
    [
        ({"n": 9}, "n", "8, 10 or 12", "8, 10 or 12 units"),
        ({"n": 6}, "n", "8, 10 or 12", "8, 10 or 12 units"),
        ({"unit_mm": 19.9}, "unit_mm", "20 to 50 mm", "2-5 cm"),
        ({"unit_mm": 50.1}, "unit_mm", "20 to 50 mm", "2-5 cm"),
        ({"gap_mm": 1.9}, "gap_mm", "2 to 10 mm", "0.2-1 cm"),
        ({"gap_mm": 10.1}, "gap_mm", "2 to 10 mm", "0.2-1 cm"),
        ({"thickness_mm": 4.9}, "thickness_mm", "5 to 50 mm", "0.5-5 cm"),
        ({"thickness_mm": 50.1}, "thickness_mm", "5 to 50 mm", "0.5-5 cm"),
        ({"n": 12, "unit_mm": 40.0}, "side_mm", "150 to 500 mm", "15-50 cm"),
        ({"unit_mm": math.nan}, "unit_mm", "20 to 50 mm", "2-5 cm"),
        ({"gap_mm": math.inf}, "gap_mm", "2 to 10 mm", "0.2-1 cm"),
    ],
)
def test_a_dimension_outside_the_papers_limits_is_refused_by_name(
    dimensions: dict[str, float], field: str, limit: str, in_paper: str
) -> None:
    with pytest.raises(InvalidParameter, match=re.escape(in_paper)) as caught:
        PlateGeometry(**dimensions)  # type: ignore[arg-type]
    assert (caught.value.field, caught.value.limit) == (field, limit)
    assert caught.value.cure


@pytest.mark.parametrize(
    "dimensions", [(8, 20.0, 2.0, 5.0), (8, 50.0, 10.0, 50.0), (12, 35.0, 5.0, 20.0), (10, 20.0, 10.0, 20.0)]
)
def test_the_limits_themselves_are_allowed(dimensions: tuple[int, float, float, float]) -> None:
    assert 150 <= PlateGeometry(*dimensions).side_mm <= 500


@pytest.mark.parametrize(
    ("make", "field", "limit"),
    [
        (lambda: PlateCode("0" * 11), "digits", "12 digits"),
        (lambda: PlateCode("0" * 12, n=10), "digits", "21 digits"),
        (lambda: PlateCode("02379216841A"), "digits", "alphabet 0123456789"),
        (lambda: PlateCode("deadbeef1bc6", PlateScheme.ID), "digits", "alphabet 0123456789ABCDEF"),
        (lambda: PlateCode("٠" * 12), "digits", "alphabet 0123456789"),
        (lambda: PlateCode("DEADBEEF1BC7", PlateScheme.ID), "digits", None),
        (lambda: PlateCode("F9E8D7C6B5A4965269BC1", PlateScheme.ID, 10), "digits", None),  # a spare cell is not 0
        (lambda: PlateCode("123456789012", PlateScheme.POSITION_CHECK), "digits", None),
        (lambda: PlateCode("0" * 12, n=7), "n", "8, 10 or 12"),
        (lambda: PlateCode("0" * 12, PlateScheme.POSITION_ROBUST, 8), "n", "10 or 12"),
        (lambda: PlateCode.from_position(8, 49, scheme=PlateScheme.POSITION_ROBUST), "n", "10 or 12"),
        (lambda: PlateCode("0" * 21, PlateScheme.POSITION_ROBUST, 10), "digits", None),  # a blank face
        (lambda: PlateCode("F" * 21, PlateScheme.POSITION_ROBUST, 10), "digits", None),  # a dark one
        (lambda: PlateCode("289ab1fbd8f7489f3d7d4", PlateScheme.POSITION_ROBUST, 10), "digits", None),
        (lambda: PlateCode("0" * 12, PlateScheme.POSITION_CHECK, check_digits=3), "check_digits", "1 or 2"),
        (lambda: PlateCode.from_registry_number(-1), "registry_number", "0 to 4294967295"),
        (lambda: PlateCode.from_registry_number(2**32), "registry_number", "0 to 4294967295"),
        (lambda: PlateCode.from_registry_number(2**48, n=10), "registry_number", "0 to 281474976710655"),
        (lambda: PlateCode.from_registry_number(2**64, n=12), "registry_number", "0 to 18446744073709551615"),
        (lambda: PlateCode.from_position(180.1, 0), "position.lon_deg", "-180 to 180 deg"),
        (lambda: PlateCode.from_position(0, -90.1), "position.lat_deg", "-90 to 90 deg"),
        (lambda: PlateCode.from_position(math.nan, 0), "position.lon_deg", "-180 to 180 deg"),
        (lambda: PlateCode.from_position(0, math.inf), "position.lat_deg", "-90 to 90 deg"),
        (lambda: resolve_position(PlateCode("0" * 12), math.nan, 0), "coarse_position.lon_deg", "-180 to 180 deg"),
    ],
)
def test_a_code_that_does_not_fit_is_refused_by_name(make: object, field: str, limit: str | None) -> None:
    with pytest.raises(InvalidParameter) as caught:
        make()  # type: ignore[operator]
    assert caught.value.field == field
    if limit is not None:
        assert caught.value.limit == limit
    if field == "digits":
        assert isinstance(caught.value, CodeMismatch)


@pytest.mark.parametrize(
    ("n", "scheme", "checks", "data", "bits", "wrong", "erased"),
    [
        (8, PlateScheme.POSITION, 1, 12, 39.86, 0, 0),
        (8, PlateScheme.POSITION_CHECK, 1, 11, 36.54, 0, 0),
        (8, PlateScheme.POSITION_CHECK, 2, 10, 33.22, 0, 0),
        (8, PlateScheme.ID, 1, 8, 32, 2, 4),
        (10, PlateScheme.POSITION, 1, 18, 59.79, 0, 0),
        (10, PlateScheme.ID, 1, 12, 48, 2, 4),
        (12, PlateScheme.POSITION, 1, 18, 59.79, 0, 0),
        (12, PlateScheme.ID, 1, 16, 64, 3, 7),
        (10, PlateScheme.POSITION_ROBUST, 1, 10, 39.86, 2, 5),
        (12, PlateScheme.POSITION_ROBUST, 1, 12, 46.51, 4, 9),
    ],
)
def test_capacity(n: int, scheme: PlateScheme, checks: int, data: int, bits: float, wrong: int, erased: int) -> None:
    capacity = plate_capacity(n, scheme, checks)
    assert capacity.symbols == {8: 12, 10: 21, 12: 32}[n]
    assert capacity.data_symbols == data
    assert capacity.bits == pytest.approx(bits, abs=0.005)
    assert (capacity.correctable_cells, capacity.correctable_erasures) == (wrong, erased)


# --- checks -----------------------------------------------------------------------------------------------------------

# made with reedsolo.rs_encode_msg over GF(16), 0x13, first root alpha^0; longer plates interleave two words
ID_VECTORS = [
    (0x00000001, 8, "00000001F31C"),
    (0x0123ABCD, 8, "0123ABCDF0D2"),
    (0xDEADBEEF, 8, "DEADBEEF1BC6"),
    (0xFFFFFFFF, 8, "FFFFFFFF941C"),
    (0x123456789ABC, 10, "1728394A5B6CBF0ECB01" + "0"),
    (0xFEDCBA987654, 10, "F9E8D7C6B5A4965269BC" + "0"),
    (0x0123456789ABCDEF, 12, "08192A3B4C5D6E7F056B8FB7F48B29" + "00"),
    (0xFEDCBA9876543210, 12, "F7E6D5C4B3A2918041D0BCA6D6560B" + "00"),
]


def times(a: int, b: int) -> int:
    """Product in GF(16) modulo x^4 + x + 1, bit by bit."""
    product = 0
    for k in range(4):
        product ^= (a << k) * (b >> k & 1)
    for k in (6, 5, 4):
        product ^= (0b10011 << (k - 4)) * (product >> k & 1)
    return product


def syndromes(word: list[int], count: int) -> list[int]:
    """Values of the word's polynomial at alpha^0, alpha^1, ..."""
    values, root = [], 1
    for _ in range(count):
        value = 0
        for symbol in word:
            value = times(value, root) ^ symbol
        values.append(value)
        root = times(root, 2)
    return values


@pytest.mark.parametrize(("number", "n", "digits"), ID_VECTORS)
def test_id_plates_carry_the_known_words(number: int, n: int, digits: str) -> None:
    code = PlateCode.from_registry_number(number, n=n)
    assert code.digits == digits
    assert PlateCode(digits, PlateScheme.ID, n).registry_number == number
    words, checks = {8: (1, 4), 10: (2, 4), 12: (2, 7)}[n]
    coded = [int(d, 16) for d in digits[: {8: 12, 10: 20, 12: 30}[n]]]
    for k in range(words):
        assert syndromes(coded[k::words], checks) == [0] * checks


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=50, deadline=None)
def test_id_words_are_roots_of_the_generator(number: int) -> None:
    digits = PlateCode.from_registry_number(number).digits
    assert digits[:8] == f"{number:08X}"
    assert syndromes([int(d, 16) for d in digits], 4) == [0, 0, 0, 0]


@given(st.integers(0, 2**32 - 1), st.integers(0, 11), st.integers(1, 15))
@settings(max_examples=100, deadline=None)
def test_a_wrong_cell_is_no_codeword(number: int, cell: int, change: int) -> None:
    symbols = list(PlateCode.from_registry_number(number).symbols)
    symbols[cell] ^= change
    assert not is_codeword(symbols, PlateScheme.ID)


# made with reedsolo.rs_encode_msg as above; the masks are the generator polynomials of 3 and of 6 checks
ROBUST_MASKS = {10: [1, 7, 14, 8], 12: [1, 10, 15, 2, 4, 3, 1]}


@pytest.mark.parametrize("n", [10, 12])
@given(position=st.tuples(st.floats(-180, 180), st.floats(-90, 90)))
@settings(max_examples=50, deadline=None)
def test_robust_positions_are_two_masked_words(n: int, position: tuple[float, float]) -> None:
    """Without its mask each word is a root of its generator, and its data are every other digit of the position."""
    code = PlateCode.from_position(*position, n=n, scheme=PlateScheme.POSITION_ROBUST)
    places = {10: 6, 12: 7}[n]
    checks = {10: (6, 5), 12: (9, 9)}[n]
    words = [list(code.symbols[k : sum(checks) + 2 * places - 2 : 2]) for k in (0, 1)]
    data = ["", ""]
    for k, word in enumerate(words):
        mask = ROBUST_MASKS[n]
        plain = [*word[: -len(mask)], *(a ^ b for a, b in zip(word[-len(mask) :], mask, strict=True))]
        assert syndromes(plain, checks[k]) == [0] * checks[k]
        assert any(syndromes(word, checks[k]))
        data[k] = "".join(f"{symbol:X}" for symbol in plain[: len(word) - checks[k]])
    number = int("".join(a + b for a, b in zip(*data, strict=True)), 16)
    assert f"{number:0{2 * places}d}" == "".join(code.decimals)
    for degrees, decimals in zip(position, code.decimals, strict=True):
        assert decimals == f"{abs(Decimal(degrees)).quantize(Decimal(1).scaleb(-places)):f}".partition(".")[2]
    assert PlateCode(code.digits, PlateScheme.POSITION_ROBUST, n) == code


def test_numbers_beyond_all_positions_are_no_codewords() -> None:
    """Ten hexadecimal digits hold 10^12 positions and more; the rest is refused."""
    beyond = encode_number(10**12, 10, PlateScheme.POSITION_ROBUST)
    assert not is_codeword(beyond, PlateScheme.POSITION_ROBUST, 10)
    assert is_codeword(encode_number(10**12 - 1, 10, PlateScheme.POSITION_ROBUST), PlateScheme.POSITION_ROBUST, 10)


@pytest.mark.parametrize(
    ("digits", "checks", "holds"),
    [
        ("123456789016", 1, True),  # 1+2+...+9+0+1 = 46
        ("123456789017", 1, False),
        ("123456789045", 2, True),  # 45
        ("123456789044", 2, False),
        ("999999999990", 2, True),  # 90
        ("000000000000", 1, True),
    ],
)
def test_check_digits_are_the_last_of_the_sum(digits: str, checks: int, holds: bool) -> None:
    symbols = [int(d) for d in digits]
    assert is_codeword(symbols, PlateScheme.POSITION_CHECK, 8, checks) is holds


@pytest.mark.parametrize(
    ("lon_deg", "lat_deg", "kwargs", "digits"),
    [
        (114.023792, 22.168411, {}, "023792168411"),  # the paper's plate
        (-114.023792, -22.168411, {}, "023792168411"),
        (-77.0365301, -38.8976763, {}, "036530897676"),
        (114.179312, 22.304567, {"check_digits": 1}, "17931230457" + "2"),  # 1+7+9+3+1+2+3+0+4+5+7 = 42
        (114.179312, 22.304567, {"check_digits": 2}, "1793130457" + "40"),  # 1+7+9+3+1+3+0+4+5+7 = 40
        (114.1793123, 22.3045678, {"n": 12}, "179312300304567800" + "0" * 14),
        (12.9999997, -0.0000004, {}, "000000000000"),  # carries into the integer, and vanishes
        (12.9999994, 89.9999996, {}, "999999000000"),
    ],
)
def test_decimals_of_positions(lon_deg: float, lat_deg: float, kwargs: dict[str, int], digits: str) -> None:
    assert PlateCode.from_position(lon_deg, lat_deg, **kwargs).digits == digits


# --- position from decimals -------------------------------------------------------------------------------------------


def apart_deg(a: float, b: float) -> float:
    return abs((a - b + 180) % 360 - 180)


@pytest.mark.parametrize(
    ("place", "coarse"),
    [
        ((12.0000004, 45.9999996), (11.7, 46.2)),  # both round to whole degrees
        ((11.9999996, 44.0000004), (12.3, 43.8)),
        ((0.000012, 51.477800), (0.000002, 51.3)),  # Greenwich, either side
        ((-0.000012, 51.477800), (-0.000002, 51.3)),
        ((36.8, 0.000250), (36.9, 0.0002)),  # the equator, either side
        ((36.8, -0.000250), (36.9, -0.0002)),
        ((179.999900, -16.8), (179.99995, -16.5)),  # the antimeridian, either side
        ((-179.999900, -16.8), (-179.99995, -16.5)),
        ((180.0, 10.0), (-179.9, 10.1)),  # and on it, seen from the other side
        ((179.9999997, 10.0), (-179.9, 10.1)),
        ((-70.648270, -33.456940), (-70.3, -33.1)),  # south and west
        ((-0.25, -0.25), (-0.05, -0.49)),
        ((25.0, 90.0), (25.3, 89.7)),
        ((25.0, -90.0), (25.3, -89.7)),
    ],
)
def test_known_hard_places_are_resolved(place: tuple[float, float], coarse: tuple[float, float]) -> None:
    found = resolve_position(PlateCode.from_position(*place), *coarse)
    assert apart_deg(found.lon_deg, place[0]) <= 5.1e-7
    assert found.lat_deg == pytest.approx(place[1], abs=5.1e-7)


@st.composite
def axis_positions(draw: st.DrawFn, bound: int) -> float:
    """Degrees, every other one within a millionth or a thousandth of a whole degree."""
    whole = draw(st.integers(-bound, bound))
    offset = draw(
        st.one_of(st.floats(-2e-6, 2e-6), st.floats(-1e-3, 1e-3), st.floats(-0.5, 0.5), st.sampled_from([0.0, 0.5]))
    )
    return min(max(whole + offset, -bound), bound)


CARRIERS = [
    (PlateScheme.POSITION, 8),
    (PlateScheme.POSITION, 10),
    (PlateScheme.POSITION_ROBUST, 10),
    (PlateScheme.POSITION_ROBUST, 12),
]


def reach_deg(degrees: float, wraps_at: float | None) -> float:
    """How wrong a coarse position may be: half the way to the next place with the same decimals."""
    reach = min(0.5, abs(degrees))  # the next degree; the same magnitude across zero
    return reach if wraps_at is None else min(reach, wraps_at - abs(degrees))


@given(
    axis_positions(180), axis_positions(90), st.floats(-0.98, 0.98), st.floats(-0.98, 0.98), st.sampled_from(CARRIERS)
)
@example(180.0, 0.0, 0.0, 0.0, CARRIERS[0])
@example(-180.0, -90.0, 0.0, 0.0, CARRIERS[2])
@example(12.9999997, -12.9999997, 0.9, 0.9, CARRIERS[2])
@settings(max_examples=400, deadline=None)
def test_a_coarse_position_within_reach_gives_the_place_back(
    lon: float, lat: float, lon_error: float, lat_error: float, carrier: tuple[PlateScheme, int]
) -> None:
    scheme, n = carrier
    code = PlateCode.from_position(lon, lat, n=n, scheme=scheme)
    half_digit = 0.51 * 10.0 ** -position_decimals(n, scheme)[1]
    # on a line of its own (0, 180) or within rounding of it both sides are the same place
    lon_reach, lat_reach = reach_deg(lon, 180.0), reach_deg(lat, None)
    coarse_lon = lon + lon_error * (lon_reach if lon_reach > 2e-6 else 0.4)
    coarse_lat = lat + lat_error * (lat_reach if lat_reach > 2e-6 else 0.4)
    assume(abs(coarse_lat) <= 90)
    found = resolve_position(code, (coarse_lon + 180) % 360 - 180, coarse_lat)
    lon_slack = half_digit if lon_reach > 2e-6 else 5e-6
    lat_slack = half_digit if lat_reach > 2e-6 else 5e-6
    assert apart_deg(found.lon_deg, lon) <= lon_slack
    assert abs(found.lat_deg - lat) <= lat_slack


def test_an_ambiguous_place_says_how_near_the_other_one_is() -> None:
    found = resolve_position(PlateCode.from_position(10.5, 0.010000), 10.5, 0.002)
    assert found.lat_deg == pytest.approx(0.01)
    assert found.distance_deg == pytest.approx(0.008)
    assert found.next_distance_deg == pytest.approx(0.012)  # 0.01 degrees south


def test_across_a_line_where_the_sign_changes_the_nearer_mirror_image_is_taken() -> None:
    """The decimals carry no sign: a coarse position on the wrong side cannot be told from a right one."""
    assert resolve_position(PlateCode.from_position(36.8, 0.00025), 36.8, -0.0001).lat_deg == -0.00025
    assert resolve_position(PlateCode.from_position(179.9999, -16.8), -179.99995, -16.8).lon_deg == -179.9999


@pytest.mark.parametrize(("checks", "places"), [(1, (6, 5)), (2, (5, 5))])
def test_check_digits_cost_decimals_not_truth(checks: int, places: tuple[int, int]) -> None:
    code = PlateCode.from_position(-77.036530, -38.897676, check_digits=checks)
    found = resolve_position(code, -77.2, -38.7)
    assert found.lon_deg == pytest.approx(-77.036530, abs=0.51 * 10 ** -places[0])
    assert found.lat_deg == pytest.approx(-38.897676, abs=0.51 * 10 ** -places[1])


def test_the_antimeridian_has_one_name() -> None:
    assert resolve_position(PlateCode.from_position(-180.0, 10.0), -179.9, 10.0).lon_deg == 180.0


def test_digits_are_named_under_every_scheme_whose_check_they_satisfy() -> None:
    def schemes(digits: str) -> list[tuple[PlateScheme, int]]:
        return [(code.scheme, code.check_digits) for code in decimal_codes([int(d) for d in digits])]

    plain = (PlateScheme.POSITION, 1)
    assert schemes("023792168411") == [plain]
    assert schemes("023792168413") == [plain, (PlateScheme.POSITION_CHECK, 1)]  # 2+3+7+9+2+1+6+8+4+1 = 43
    assert schemes("023792168442") == [plain, (PlateScheme.POSITION_CHECK, 2)]  # 2+3+7+9+2+1+6+8+4 = 42
    rng = np.random.default_rng(0)
    found = [schemes("".join(str(d) for d in rng.integers(0, 10, 12))) for _ in range(2000)]
    assert 0.08 < np.mean([(PlateScheme.POSITION_CHECK, 1) in one for one in found]) < 0.12
    assert 0.005 < np.mean([(PlateScheme.POSITION_CHECK, 2) in one for one in found]) < 0.018
    assert not decimal_codes([10] + 11 * [0])
