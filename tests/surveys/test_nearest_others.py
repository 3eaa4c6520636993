"""The nearest other point of each, also where many are at one place."""

from __future__ import annotations

import time

import numpy as np

from app.surveys.consistency_checks import nearest_others


def _seconds(points: np.ndarray) -> float:
    began = time.process_time()
    nearest_others(points)
    return time.process_time() - began


def test_it_is_that_of_all_distances() -> None:
    points = np.random.default_rng(1).uniform(0, 100, (300, 2))
    points[10] = points[30] = points[20]
    points[299] = points[0]
    distance_m, nearest = nearest_others(points)
    every_m = np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1))
    np.fill_diagonal(every_m, np.inf)
    assert np.allclose(distance_m, every_m.min(axis=1))
    assert np.allclose(every_m[np.arange(300), nearest], distance_m)


def test_many_points_at_one_place_take_no_longer_than_others() -> None:
    apart = np.random.default_rng(2).uniform(0, 1e5, (30_000, 2))
    _seconds(apart)
    assert _seconds(np.zeros((30_000, 2))) < 5 * _seconds(apart)
