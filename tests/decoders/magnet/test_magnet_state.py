"""Clearance and moment follow from dipoles that agree, however much iron lies between them."""

from __future__ import annotations

import numpy as np
import pytest

from app.decoders.magnet.classify import KNOWN_STD_M, MagnetState
from app.decoders.magnet.fit_window import UPRIGHT, Dipole
from app.markers.magnet import MOMENT_AM2


def learn(
    state: MagnetState, depths_m: list[float], *, std_m: float = 0.015, ratios: float | list[float] = 1.0
) -> None:
    """Dipoles as they are fitted under what was expected of each, their moments known to a tenth."""
    for depth_m, ratio in zip(depths_m, np.broadcast_to(ratios, len(depths_m)), strict=True):
        prior = state.prior
        depth_precision = 1 / std_m**2 + 1 / prior.clearance_std_m**2
        fitted_m = (depth_m / std_m**2 + prior.clearance_m / prior.clearance_std_m**2) / depth_precision
        own, given = (0.1 * MOMENT_AM2) ** -2, prior.moment_std_am2**-2
        moment = (ratio * MOMENT_AM2 * own + prior.moment_am2 * given) / (own + given)
        covariance = np.diag([1.0, 1.0, 1 / depth_precision, 1.0, 1.0, 1 / (own + given)])
        params = np.array([0.0, 0.0, fitted_m, 0.0, 0.0, moment])
        state.learn(Dipole(params, covariance, 100.0, 0.0, 0.0, UPRIGHT, 30.0), prior)


@pytest.mark.parametrize("clearance_m", [0.12, 0.17, 0.25, 0.4])
def test_five_magnets_show_it(clearance_m: float) -> None:
    state = MagnetState(MOMENT_AM2)
    learn(state, [clearance_m + off for off in (0.01, -0.01, 0.0, 0.005, -0.005)])
    assert state.is_known
    assert state.prior.clearance_m == pytest.approx(clearance_m, abs=0.01)


@pytest.mark.parametrize("ratio", [0.65, 1.0, 1.2])
def test_magnets_show_the_moment_that_they_share(ratio: float) -> None:
    state = MagnetState(MOMENT_AM2)
    learn(state, 12 * [0.16], ratios=ratio)
    assert state.prior.moment_am2 == pytest.approx(ratio * MOMENT_AM2, rel=0.06)
    assert state.prior.moment_std_am2 < 0.16 * MOMENT_AM2


def test_one_dipole_shows_nothing() -> None:
    state = MagnetState(MOMENT_AM2)
    learn(state, [0.40])
    assert state.prior.clearance_std_m > 2 * KNOWN_STD_M


def test_iron_is_at_all_depths_and_shows_nothing() -> None:
    known = 0
    for seed in range(100):
        state = MagnetState(MOMENT_AM2)
        rng = np.random.default_rng(seed)
        learn(state, rng.uniform(0.1, 0.6, 6).tolist(), ratios=rng.uniform(0.6, 1.5, 6).tolist())
        known += state.is_known
    assert known <= 8  # six depths agree by chance now and then


def test_magnets_among_iron_show_it() -> None:
    rng = np.random.default_rng(3)
    depths = np.where(np.arange(40) % 2, 0.17, rng.uniform(0.1, 0.6, 40))
    state = MagnetState(MOMENT_AM2)
    learn(state, depths.tolist(), ratios=np.where(np.arange(40) % 2, 1.0, rng.uniform(0.6, 1.5, 40)).tolist())
    assert state.is_sure
    assert state.prior.clearance_m == pytest.approx(0.17, abs=0.01)


def test_a_declared_clearance_is_known_at_once() -> None:
    state = MagnetState(MOMENT_AM2, 0.3)
    assert state.is_known
    assert not state.is_sure
    assert state.prior.clearance_m == pytest.approx(0.3, abs=0.005)


def test_magnets_correct_a_declared_clearance() -> None:
    state = MagnetState(MOMENT_AM2, 0.3)
    learn(state, 8 * [0.17])
    assert state.prior.clearance_m == pytest.approx(0.17, abs=0.01)
