"""How many codes a design has, against the paper's figures and against counting them."""

from __future__ import annotations

import itertools
import math
from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.errors import InvalidParameter
from app.markers.magnet_design import TagDesign

# METRO figure 17a, M = 3 and L = 4 m: segment [m], ideal (equation 2), with neighbours at least 0.5 m apart
FIGURE_17A = [
    (1.0, 24, 24),
    (0.8, 32, 32),
    (0.5, 56, 56),
    (0.4, 72, 56),
    (0.2, 152, 120),
    (0.1, 312, 248),
    (0.05, 632, 488),
    (0.02, 1592, 1208),
]


@pytest.mark.parametrize(("segment_m", "ideal", "coupled"), FIGURE_17A)
def test_the_papers_capacities_come_out_exactly(segment_m: float, ideal: int, coupled: int) -> None:
    design = TagDesign(3, 4.0, segment_m)
    assert (design.ideal_capacity, design.coupled_capacity) == (ideal, coupled)
    assert TagDesign(3, 4.0, segment_m, min_gap_m=0).coupled_capacity == ideal
    assert design.wrong_way_safe_capacity == coupled / 2


def test_seven_magnets_on_four_metres_hold_2688_codes() -> None:
    assert TagDesign(7, 4.0, 0.5).ideal_capacity == 2688  # section 4.2
    assert [TagDesign(m, 4.0, 0.5).ideal_capacity for m in range(2, 8)] == [
        2**m * math.comb(7, m - 2) for m in range(2, 8)
    ]


@pytest.mark.parametrize(
    ("segment_m", "segments"),
    [(0.1, 7), (0.1, 117), (0.3, 49), (0.6, 7), (0.7, 7), (0.0254, 49), (0.0254, 117), (0.1524, 7), (0.1524, 117)],
)
def test_lengths_that_floats_cannot_hold_are_counted_right(segment_m: float, segments: int) -> None:
    design = TagDesign(3, segments * segment_m, segment_m)  # 0.1 * 7 = 0.7000000000000001
    assert design.segments == segments
    assert design.min_gap_steps == math.ceil(round(0.5 / segment_m, 9))


@pytest.mark.parametrize(
    ("length_m", "segment_m", "cure"),
    [(4.0, 0.3, "3.9 or 4.2 m"), (4.0, 0.7, "3.5 or 4.2 m"), (1.0, 2.0, "a length of 2 m")],
)
def test_a_length_that_is_no_whole_number_of_segments_is_refused(length_m: float, segment_m: float, cure: str) -> None:
    with pytest.raises(InvalidParameter, match="not a whole number") as caught:
        TagDesign(3, length_m, segment_m)
    assert caught.value.field == "length_m"
    assert cure in str(caught.value.cure)


@given(st.integers(2, 7), st.integers(1, 14), st.sampled_from([0.1, 0.2, 0.25, 0.5, 1.0]), st.sampled_from([0.0, 0.5]))
@settings(max_examples=80, deadline=None)
def test_capacities_are_what_counting_gives(magnets: int, n: int, segment_m: float, min_gap_m: float) -> None:
    if n * segment_m < 0.5:
        return
    design = TagDesign(magnets, n * segment_m, segment_m, min_gap_m)
    g = max(math.ceil(round(min_gap_m / segment_m, 9)), 1)
    middles = list(itertools.combinations(range(1, n), magnets - 2))
    apart = [m for m in middles if all(b - a >= g for a, b in itertools.pairwise((0, *m, n)))]
    assert design.ideal_capacity == 2**magnets * len(middles)
    assert design.coupled_capacity == 2**magnets * len(apart)
    gaps = list(design.list_gap_steps())
    assert gaps == sorted(gaps)
    assert {tuple(itertools.accumulate(gap))[:-1] for gap in gaps} == set(apart)
    assert len(gaps) == len(apart)


@pytest.mark.parametrize(
    ("magnets", "length_m", "segment_m"),
    [
        (2, 2.0, 0.5),
        (3, 2.0, 0.25),
        (4, 3.0, 0.25),
        (4, 3.2, 0.2),
        (5, 3.0, 0.5),
        (6, 4.0, 0.25),
        (6, 4.2, 0.3),
        (7, 4.0, 0.5),
    ],
)
def test_wrong_way_pairs_are_counted_right(magnets: int, length_m: float, segment_m: float) -> None:
    design = TagDesign(magnets, length_m, segment_m)
    codes = list(design.list_codes())
    assert len(set(codes)) == len(codes) == design.coupled_capacity
    assert all(design.admits(code) for code in codes)
    reverse = {code: code.reversed_wrong_way() for code in codes}
    assert set(reverse.values()) == set(codes)
    own = sum(code == back for code, back in reverse.items())
    assert own == design.own_reverses
    assert (own == 0) == (magnets % 2 == 1)
    pairs = Counter(frozenset((code, back)) for code, back in reverse.items())
    assert sum(size == 2 for size in map(len, pairs)) == design.wrong_way_safe_capacity


def test_a_huge_design_is_listed_lazily() -> None:
    design = TagDesign(7, 30.0, 0.02)
    assert design.coupled_capacity > 10**15
    first = next(iter(design.list_codes()))
    assert first.text == "NNNNNNN_30_0.02_25-25-25-25-25-1375"


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ((1, 4.0, 1.0), "magnets"),
        ((8, 4.0, 1.0), "magnets"),
        ((3, math.nan, 1.0), "length_m"),
        ((3, 4.0, math.inf), "segment_m"),
        ((3, 4.0, 0.019), "segment_m"),
        ((3, 30.5, 0.5), "length_m"),
        ((3, 4.0, 0.33333), "segment_m"),
        ((3, 4.0, 1.0, -0.1), "min_gap_m"),
        ((3, 4.0, 1.0, math.nan), "min_gap_m"),
        ((3, 4.0, 1.0, 4.1), "min_gap_m"),
    ],
)
def test_designs_outside_the_limits_are_refused_by_name(values: tuple[float, ...], field: str) -> None:
    with pytest.raises(InvalidParameter) as caught:
        TagDesign(*values)  # type: ignore[arg-type]
    assert caught.value.field == field
    assert caught.value.limit
