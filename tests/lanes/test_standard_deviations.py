"""Standard deviations of paths that are known well in one place and badly in another."""

from __future__ import annotations

import numpy as np
import pytest

from app.lanes.least_squares import Hyperparameters, LaneProblem, Measurements, factor, inverse_band, variances
from app.lanes.smooth_line import SmoothLine


@pytest.mark.parametrize("size", [1, 5, 40])
def test_the_inverse_within_the_band(size):
    rng = np.random.default_rng(size)
    band = min(3, size - 1)
    matrix = np.zeros((band + 1, size))
    matrix[0] = 10.0 ** rng.uniform(-2, 3, size) + 4
    for k in range(1, band + 1):
        matrix[k, : size - k] = rng.normal(size=size - k)
    full = np.diag(matrix[0])
    for k in range(1, band + 1):
        full += np.diag(matrix[k, : size - k], -k) + np.diag(matrix[k, : size - k], k)
    wanted, found = np.linalg.inv(full), inverse_band(factor(matrix))
    for k in range(band + 1):
        assert found[k, : size - k] == pytest.approx(np.diag(wanted, -k), rel=1e-9, abs=1e-12)
    index, value = np.array([[0, band], [size - 1, size - 1 - band]]), np.array([[1.0, -2.0], [0.5, 3.0]])
    rows = np.zeros((2, size))
    np.add.at(rows, (np.arange(2)[:, None], index), value)
    assert variances(found, index, value) == pytest.approx(np.diag(rows @ wanted @ rows.T))


@pytest.mark.parametrize("overlap_m", [-30.0, 12.0, 40.0])
def test_standard_deviations_where_one_side_is_known_at_a_time(overlap_m):
    """The width is uncertain over hundreds of metres there, and so is the centre: they were once reported as 0."""
    line = SmoothLine(np.stack([np.arange(0, 601.0, 3.0), np.zeros(201)], 1))
    left, right = np.arange(0, 300 + overlap_m / 2, 12.0), np.arange(600, 300 - overlap_m / 2, -12.0)
    station = np.concatenate([left, right])
    sign = np.repeat([1.0, -1.0], [len(left), len(right)])
    none = np.empty(0)
    markers = (station, sign * 1.65, np.full(len(station), 0.02), sign)
    problem = LaneProblem(line, Measurements(*markers, none, none, none, none, none, none), 0.0, 600.0)
    strengths = Hyperparameters(width_sd_m=0.4, width_length_m=400.0)
    station_m, *found = problem.solve(strengths).sigmas()
    matrix, _, _ = problem.matrix(strengths)
    full = np.zeros((problem.size, problem.size))
    for k in range(len(matrix)):
        full += np.diag(matrix[k, : problem.size - k], -k)
    covariance = np.linalg.inv(full + np.tril(full, -1).T)
    c = np.searchsorted(problem.station_m, station_m) * problem.fields
    cc, cw, ww = covariance[c, c], covariance[c, c + 1], covariance[c + 1, c + 1]
    for values, wanted in zip(found, (cc, cc + cw + ww / 4, cc - cw + ww / 4, ww), strict=True):
        assert values == pytest.approx(np.sqrt(wanted), rel=1e-4)
