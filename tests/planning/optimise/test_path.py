"""Pairs of CERPMs by path error, against even spacing of the same error."""

from __future__ import annotations

import numpy as np
import pytest

from app.errors import InvalidParameter
from app.planning.alignment import Lane
from app.planning.optimise.cover import even_pairs, fewest_pairs
from app.planning.placement.place import path_error_m
from tests.planning.roads import bend, lane_of_curvature, straight

SPACING_M = 36.576  # three cycles of 40 ft: MUTCD's greatest on straight level freeways


def winding(seed: int, transition_m: int, length_m: int = 3000) -> Lane:
    """Arcs of 60 to 300 m radius between straights; with clothoids unless `transition_m` is 1."""
    rng = np.random.default_rng(seed)
    curvature = np.zeros(length_m)
    at = 100
    while at < length_m - 200:
        arc = int(rng.uniform(50, 150))
        curvature[at : at + arc] = rng.choice([-1, 1]) / rng.uniform(60, 300)
        at += arc + int(rng.uniform(100, 300))
    return lane_of_curvature(np.convolve(curvature, np.full(transition_m, 1 / transition_m), mode="same"))


@pytest.mark.parametrize(
    ("lane", "error_m", "share"),
    [
        # share of even spacing with the same greatest error; measured 0.41, 0.57, 0.52, 0.71, 0.80
        (bend(62.5), 0.02, 0.5),
        (bend(62.5), 0.05, 0.65),
        (winding(2, 1), 0.05, 0.6),
        (winding(1, 40), 0.02, 0.8),
        (winding(1, 40), 0.05, 0.82),
        # gentle bends and loose limits: the greatest spacing decides, and nothing is gained
        (straight(2000), 0.05, 1.0),
        (bend(200), 0.1, 1.0),
    ],
)
def test_pairs_follow_the_change_of_curvature(lane: Lane, error_m: float, share: float) -> None:
    pairs = fewest_pairs(lane, error_m, max_spacing_m=SPACING_M)
    even = even_pairs(lane, error_m, max_spacing_m=SPACING_M)
    for chainages in (pairs, even):
        assert path_error_m(lane, chainages).max() <= error_m
        assert np.diff(chainages).max() <= SPACING_M + 1e-6
        assert np.diff(chainages).min() >= 2 - 1e-6
        assert [chainages[0], chainages[-1]] == [0, lane.length_m]
    assert len(pairs) <= share * len(even)


def test_even_pairs_are_the_fewest() -> None:
    lane = bend(62.5)
    even = even_pairs(lane, 0.05, max_spacing_m=SPACING_M)
    for fewer in range(round(lane.length_m / SPACING_M), len(even) - 1):
        assert path_error_m(lane, np.linspace(0, lane.length_m, fewer + 1)).max() > 0.05


def test_pairs_keep_out_of_avoided_samples() -> None:
    lane = bend(100)
    allowed = np.ones(len(lane.chainage_m), dtype=bool)
    allowed[190:205] = False
    pairs = fewest_pairs(lane, 0.1, max_spacing_m=SPACING_M, allowed=allowed)
    assert not np.any((pairs > 189.5) & (pairs < 204.5))
    assert path_error_m(lane, pairs).max() <= 0.1


def test_an_error_that_no_spacing_has_is_refused_with_its_place() -> None:
    lane = bend(20, straight_m=100)
    with pytest.raises(InvalidParameter, match=r"path error of lane 1 is 0\.\d+ m at 0\+\d+\.\d\d at best") as refused:
        fewest_pairs(lane, 0.0005, max_spacing_m=SPACING_M)
    assert refused.value.field == "quality.path_error_m"
    with pytest.raises(InvalidParameter, match="no even spacing"):
        even_pairs(lane, 0.0005, max_spacing_m=SPACING_M)
