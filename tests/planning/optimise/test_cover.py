"""Chains and covers against brute force, against each other, and against proved optima."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.planning.optimise.cover import (
    cheapest_chain,
    cheapest_cover,
    cheapest_sums,
    least_gain,
    uncovered_m,
    window_rows,
)
from app.values import Floats

NEED = float(np.log(100))


def covers(chainage: Floats, gain: Floats, need: float, window_m: float, length_m: float) -> bool:
    """By the definition: every stretch of the window's length, at all starts where its content changes."""
    ends = {0.0, length_m - window_m}
    for x in chainage.tolist():
        ends |= {x + 1e-7, x - window_m - 1e-7}
    starts = [start for start in ends if -1e-12 <= start <= length_m - window_m + 1e-12] or [0.0]
    for start in starts:
        inside = (chainage >= start - 1e-12) & (chainage <= start + window_m + 1e-12)
        if length_m <= window_m:
            inside = np.ones(len(chainage), dtype=bool)
        if gain[inside].sum() < need - 1e-9:
            return False
    return True


def brute_force(chainage: Floats, cost: Floats, gain: Floats, window_m: float, length_m: float) -> float | None:
    best = None
    for choice in product((False, True), repeat=len(cost)):
        picked = np.array(choice)
        total = float(cost[picked].sum())
        if (best is None or total < best) and covers(chainage[picked], gain[picked], NEED, window_m, length_m):
            best = total
    return best


@st.composite
def instances(draw: st.DrawFn, enough: bool) -> tuple[Floats, Floats, Floats, float, float]:
    """Up to nine candidates on a short road; whole metres, so that places and ends of windows coincide."""
    length = draw(st.integers(5, 40))
    count = draw(st.integers(1, 9))
    chainage = np.sort(np.array(draw(st.lists(st.integers(0, length), min_size=count, max_size=count)), dtype=float))
    cost = np.array(draw(st.lists(st.integers(0, 9), min_size=count, max_size=count)), dtype=float)
    probability = st.just(0.995) if enough else st.sampled_from([0.5, 0.8, 0.9, 0.97, 0.995])
    chances = np.array(draw(st.lists(probability, min_size=count, max_size=count)))
    return chainage, cost, -np.log1p(-chances), float(draw(st.integers(3, 20))), float(length)


@settings(max_examples=150, deadline=None)
@given(instances(enough=True))
def test_chains_cost_as_much_as_brute_force_and_as_the_integer_program(
    instance: tuple[Floats, Floats, Floats, float, float],
) -> None:
    chainage, cost, gain, window_m, length_m = instance
    expected = brute_force(chainage, cost, gain, window_m, length_m)
    if expected is None:
        assert uncovered_m(chainage, gain, NEED, window_m, length_m) is not None
        return
    found = cheapest_cover(chainage, cost, gain, need=NEED, window_m=window_m, length_m=length_m)
    assert found.cost == found.bound == pytest.approx(expected)
    assert covers(chainage[found.chosen], gain[found.chosen], NEED, window_m, length_m)
    program = cheapest_sums(chainage, cost, gain, need=NEED, window_m=window_m, length_m=length_m)
    if length_m <= 8 * window_m:
        assert program.cost == pytest.approx(expected)


@settings(max_examples=100, deadline=None)
@given(instances(enough=False))
def test_covers_of_unsure_markers_cost_as_much_as_brute_force(
    instance: tuple[Floats, Floats, Floats, float, float],
) -> None:
    chainage, cost, gain, window_m, length_m = instance
    expected = brute_force(chainage, cost, gain, window_m, length_m)
    if expected is None:
        with pytest.raises(ValueError, match="too few"):
            cheapest_cover(chainage, cost, gain, need=NEED, window_m=window_m, length_m=length_m)
        return
    found = cheapest_cover(chainage, cost, gain, need=NEED, window_m=window_m, length_m=length_m)
    assert covers(chainage[found.chosen], gain[found.chosen], NEED, window_m, length_m)
    assert least_gain(chainage[found.chosen], gain[found.chosen], window_m, length_m) >= NEED - 1e-9
    assert found.cost >= found.bound - 1e-9
    if length_m <= 8 * window_m:
        assert found.is_optimal
        assert found.cost == pytest.approx(expected)


def test_a_chain_reaches_less_far_from_some_candidates() -> None:
    # from 10 m the next one must follow by 15 m, so that the cheap one at 20 m needs the dear one between
    at, reach = np.array([0.0, 10.0, 14.0, 20.0, 30.0]), np.array([12.0, 15.0, 30.0, 30.0, 40.0])
    chain = cheapest_chain(at, np.array([1.0, 1.0, 5.0, 1.0, 1.0]), reach, first_before_m=0, last_after_m=30)
    assert chain is not None
    assert chain.tolist() == [0, 1, 2, 4]
    without = cheapest_chain(at, np.ones(5), np.full(5, 9.0) + at, first_before_m=0, last_after_m=30)
    assert without is None


def test_even_candidates_of_one_price_are_taken_at_the_window() -> None:
    at = np.arange(0.0, 1001.0, 10.0)
    found = cheapest_cover(at, np.ones(101), np.full(101, 9.0), need=NEED, window_m=100.0, length_m=1000.0)
    assert found.cost == 9
    assert np.diff(at[found.chosen]).max() == 100
    assert uncovered_m(at[(at < 300) | (at > 410)], np.full(89, 9.0), NEED, 100.0, 1000.0) == pytest.approx(290)


def test_rows_are_the_windows_that_matter() -> None:
    first, last = window_rows(np.array([1.0, 4.0, 4.0, 9.0]), 5.0, 10.0)
    assert list(zip(first.tolist(), last.tolist(), strict=True)) == [(0, 3), (1, 3), (3, 4)]
    assert [a.tolist() for a in window_rows(np.array([1.0, 4.0]), 50.0, 10.0)] == [[0], [2]]


def test_long_lines_are_solved_in_sections_near_the_optimum() -> None:
    rng = np.random.default_rng(5)
    at = np.repeat(np.arange(5.0, 2400.0, 10.0), 2)
    chances = np.tile([0.93, 0.995], len(at) // 2) - 0.05 * rng.random(len(at))
    cost = np.tile([6.0, 15.0], len(at) // 2)
    gain = -np.log1p(-chances)
    whole = cheapest_cover(at, cost, gain, need=NEED, window_m=100.0, length_m=2400.0)
    assert least_gain(at[whole.chosen], gain[whole.chosen], 100.0, 2400.0) >= NEED - 1e-9
    # lower bound from disjoint thirds, each proved: windows inside of a third have no candidates of another one
    proved = 0.0
    for k in range(3):
        part = (at > 800 * k) & (at < 800 * (k + 1))
        third = cheapest_cover(at[part] - 800 * k, cost[part], gain[part], need=NEED, window_m=100.0, length_m=800.0)
        assert third.is_optimal
        proved += third.cost
    assert proved <= whole.cost <= 1.15 * proved
    assert whole.bound <= whole.cost
