"""The clearance follows from dipoles that agree, however much iron lies between them."""

from __future__ import annotations

import numpy as np
import pytest

from app.decoders.magnet.clearance import KNOWN_STD_M, ClearanceEstimate
from app.decoders.magnet.fit_window import UPRIGHT, Dipole
from app.markers.magnet import MOMENT_AM2


def learn(estimate: ClearanceEstimate, depths_m: list[float], std_m: float = 0.015) -> None:
    """Dipoles as they are fitted under what was expected of each."""
    for depth_m in depths_m:
        prior = estimate.prior
        precision = 1 / std_m**2 + 1 / prior.clearance_std_m**2
        fitted_m = (depth_m / std_m**2 + prior.clearance_m / prior.clearance_std_m**2) / precision
        covariance = np.zeros((6, 6))
        covariance[2, 2] = 1 / precision
        params = np.array([0.0, 0.0, fitted_m, 0.0, 0.0, MOMENT_AM2])
        estimate.learn(Dipole(params, covariance, 100.0, 0.0, 0.0, UPRIGHT, 30.0), prior)


@pytest.mark.parametrize("clearance_m", [0.12, 0.17, 0.25, 0.4])
def test_five_magnets_show_it(clearance_m: float) -> None:
    estimate = ClearanceEstimate(MOMENT_AM2)
    learn(estimate, [clearance_m + off for off in (0.01, -0.01, 0.0, 0.005, -0.005)])
    assert estimate.is_known
    assert estimate.prior.clearance_m == pytest.approx(clearance_m, abs=0.01)


def test_one_dipole_shows_nothing() -> None:
    estimate = ClearanceEstimate(MOMENT_AM2)
    learn(estimate, [0.40])
    assert estimate.prior.clearance_std_m > 2 * KNOWN_STD_M


def test_iron_is_at_all_depths_and_shows_nothing() -> None:
    known = 0
    for seed in range(100):
        estimate = ClearanceEstimate(MOMENT_AM2)
        learn(estimate, np.random.default_rng(seed).uniform(0.1, 0.6, 6).tolist())
        known += estimate.is_known
    assert known <= 5  # six depths agree by chance now and then


def test_magnets_among_iron_show_it() -> None:
    rng = np.random.default_rng(3)
    depths = np.where(np.arange(40) % 2, 0.17, rng.uniform(0.1, 0.6, 40))
    estimate = ClearanceEstimate(MOMENT_AM2)
    learn(estimate, depths.tolist())
    assert estimate.is_sure
    assert estimate.prior.clearance_m == pytest.approx(0.17, abs=0.01)
