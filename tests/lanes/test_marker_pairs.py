"""Pairs of markers of which some were set along their own line: oblique pairs show no direction."""

from __future__ import annotations

import numpy as np
import pytest

from app.lanes.estimate import fit_lane
from app.lanes.observations import find_known_lengths, find_pairs
from app.lanes.smooth_line import SmoothLine
from app.lanes.types import LEFT, RIGHT
from tests.lanes.lanes import Road, bendy, markers_at, place

SPACING_M = 12.192


def place_some_along(road, rng, *, share, along_m):
    """Markers in pairs, of which some were set further along their boundary than the other of their pair."""
    at = np.arange(4.0, road.at[-1], SPACING_M)
    station = np.concatenate([at, at])
    moved = rng.permutation(len(station)) < max(round(share * len(station)), 1)
    station = np.clip(station + moved * rng.choice([-1, 1], len(station)) * along_m, 0, road.at[-1])
    left = np.repeat([1.6, -1.6], len(at))
    points = road.beside(station, left) + rng.normal(0, 0.02, (len(station), 2))
    return markers_at(points, np.repeat([1, 2], len(at)))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("share", "along_m"), [(0.03, 1.3), (0.05, 1.0), (0.1, 0.7)])
def test_markers_set_along_their_line_do_not_bend_the_path(seed, share, along_m):
    road = bendy()
    found = fit_lane(place_some_along(road, np.random.default_rng(seed), share=share, along_m=along_m))
    assert found.refusal is None
    assert np.abs(road.errors(found)).max() < 0.15  # up to 1 m where all pairs counted alike


@pytest.mark.parametrize("seed", range(6))
def test_pairs_in_tight_bends_still_count(seed):
    at = np.arange(0, 200.1, 0.25)
    knots = [0, 40, 46, 58, 64, 76, 82, 100, 106, 200]
    road = Road(np.interp(at, knots, [0, 0, 1 / 15, 1 / 15, -1 / 15, -1 / 15, 1 / 15, 1 / 15, 0, 0]), at * 0 + 3.2)
    found = fit_lane(place(road, np.random.default_rng(seed)))
    assert np.abs(road.errors(found)).max() < 0.3


def test_an_oblique_pair_is_doubtful_and_a_bend_is_not():
    at = np.arange(12) * SPACING_M
    ahead = np.where(np.arange(12) == 5, 0.8, 0.0) + np.random.default_rng(1).normal(0, 0.01, 12)
    bend = 0.01 * np.arange(12)  # slopes that grow steadily, as beside a line that is too straight
    station = np.concatenate([at + ahead - 3.2 * bend, at])
    left = np.repeat([1.6, -1.6], 12)
    pairs = find_pairs(station, left, np.repeat([int(LEFT), int(RIGHT)], 12), np.full(24, 0.02))
    assert np.flatnonzero(pairs.cautious_sigma > pairs.sigma).tolist() == [5]
    assert pairs.cautious_sigma[5] > 0.2


@pytest.mark.parametrize("along_m", [-0.4, 0.4, 0.6])
@pytest.mark.parametrize("seed", range(3))
def test_a_pair_beside_its_even_place_does_not_bend_the_path(seed, along_m):
    """At 80 ft, without a track: the stretch before it seems to be longer than the line, the next one shorter."""
    road, station = even_road(along_m)
    rng = np.random.default_rng(seed)
    points = np.concatenate(
        [road.beside(station, left) + rng.normal(0, 0.02, (len(station), 2)) for left in (1.6, -1.6)]
    )
    found = fit_lane(markers_at(points, np.repeat([1, 2], len(station))))
    assert found.refusal is None
    assert np.abs(road.errors(found)).max() < 0.25  # 1.4 m and more where these lengths counted


def test_lengths_beside_a_moved_pair_are_not_known():
    road, station = even_road(0.4)
    found = find_known_lengths(SmoothLine(road.centre[::12]), station, np.ones(len(station), bool), 3.2)
    assert len(found.start_m) == len(station) - 3
    assert np.abs(found.excess_m).max() < 0.2


def even_road(along_m):
    """A road with a bend, and places every 80 ft along its centre of which one in the bend is moved."""
    at = np.arange(0, 352.1, 0.25)
    road = Road(np.interp(at, [0, 120, 140, 180, 200, 352], [0, 0, 1 / 60, 1 / 60, 0, 0]), at * 0 + 3.2)
    station = np.arange(10.0, 350.0, 2 * SPACING_M)
    station[6] += along_m
    return road, station
