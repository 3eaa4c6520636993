"""The probability of a magnet follows from the fit of its dipole and from the poles beside it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from app.decoders.magnet.classify import (
    FEATURES,
    MIN_PROBABILITY,
    WEIGHTS,
    Accepted,
    MagnetState,
    Rejected,
    classify_dipoles,
    is_ferrous,
    magnet_features,
    own_log_odds,
    rows_beside,
    with_log_odds,
)
from app.decoders.magnet.fit_window import Dipole
from app.decoders.magnet.readings import NoiseKind
from app.markers.magnet import Orientation, Polarity

HALF_M = 0.88
STATE = MagnetState(2.47, 0.16)
PRIOR = STATE.prior
STD = np.diag((0.004, 0.004, 0.004, 0.05, 0.05, 0.05)) ** 2


def pole(s_m: float, y_m: float, *, height_m: float = 0.16, moment: float = 2.47) -> Dipole:
    params = np.array([s_m, y_m, height_m, moment, 0.0, 0.0])
    return Dipole(params, STD, 400.0, 0.0, 0.5, 0, 50.0)


def classify(dipoles: list[Dipole], before: list[Dipole] | None = None) -> list[Accepted | Rejected]:
    return classify_dipoles(with_log_odds(dipoles, PRIOR), with_log_odds(before or [], PRIOR), STATE, HALF_M)


MESH = [pole(s, y, height_m=0.19) for s, y in ((10.0, -0.8), (10.2, -0.3), (10.1, 0.2), (10.3, 0.7))]
TAG = [pole(10 + 0.5 * i, 0.02 * i) for i in range(5)]


def test_there_is_a_weight_for_each_feature() -> None:
    assert len(WEIGHTS) == len(FEATURES) == len(magnet_features(TAG[0], TAG, STATE, HALF_M))


def test_poles_beside_each_other_are_iron_and_a_row_is_not() -> None:
    assert is_ferrous(MESH, HALF_M)
    assert all(isinstance(one, Rejected) and one.kind is NoiseKind.FERROUS for one in classify(MESH))
    assert all(isinstance(classify([one])[0], Accepted) for one in MESH)
    assert not is_ferrous(TAG, HALF_M)
    assert all(isinstance(one, Accepted) for one in classify(TAG))


def test_a_line_beside_a_tag_is_one_row() -> None:
    line = pole(11.0, -0.85)
    assert rows_beside(TAG[0], [*TAG, line], HALF_M) == 1
    assert rows_beside(line, [*TAG, line], HALF_M) == 1
    assert not is_ferrous([*TAG, line], HALF_M)
    assert all(isinstance(one, Accepted) for one in classify([*TAG, line]))


def test_poles_of_parked_cars_do_not_count() -> None:
    cars = [pole(9.0, 1.1), pole(11.0, 1.1), pole(10.0, -1.2)]
    assert rows_beside(TAG[0], cars, HALF_M) == 0
    kinds = [one.kind for one in classify(cars) if isinstance(one, Rejected)]
    assert kinds == [NoiseKind.BESIDE] * 3


def test_the_other_end_of_a_plate_is_less_sure() -> None:
    end = pole(12.6, 0.1)
    (alone,), (behind,) = classify([end]), classify([end], MESH)
    assert isinstance(alone, Accepted)
    assert alone[:2] == (Orientation.FORWARD, Polarity.N)
    assert isinstance(behind, Rejected) or behind.confidence < alone.confidence


@pytest.mark.parametrize(("height_m", "fine"), [(0.13, True), (0.34, False)])
def test_what_lies_deep_is_no_magnet(height_m: float, fine: bool) -> None:
    (classification,) = classify([pole(10, 0, height_m=height_m)])
    assert isinstance(classification, Accepted) is fine
    if isinstance(classification, Rejected):
        assert classification.kind is NoiseKind.WRONG_HEIGHT
        assert f"{MIN_PROBABILITY:.0%} are needed" in classification.reason


def test_magnets_in_a_row_with_a_dipole_make_it_likelier() -> None:
    odd = pole(12, 0, moment=3.1)
    (alone,), (*_, in_a_row) = classify([odd]), classify([pole(10, 0), pole(11, 0.02), odd])
    (*_, beside) = classify([pole(10, 0.5), pole(11, 0.52), odd])
    assert isinstance(alone, Accepted)
    assert isinstance(in_a_row, Accepted)
    assert in_a_row.confidence > alone.confidence
    assert isinstance(beside, Rejected) or beside.confidence < in_a_row.confidence


def test_a_dipole_that_the_fit_moved_to_where_magnets_are_says_little() -> None:
    sure = pole(10, 0)
    weak = replace(sure, covariance=np.diag((0.03, 0.03, 0.0248, 0.39, 0.34, 0.24)) ** 2)
    assert own_log_odds(sure, PRIOR) > 6
    assert own_log_odds(weak, PRIOR) < own_log_odds(sure, PRIOR) - 3


def test_a_moment_unlike_the_others_is_iron() -> None:
    state = MagnetState(2.47, 0.16)
    for _ in range(10):
        state.learn(pole(10, 0), state.prior)
    odd = with_log_odds([pole(10, 0, moment=0.9)], state.prior)
    (classification,) = classify_dipoles(odd, [], state, HALF_M)
    assert isinstance(classification, Rejected)
    assert classification.kind is NoiseKind.WRONG_MOMENT


@pytest.mark.parametrize("moment", [5.0, 10.0, 20.0])
def test_iron_far_above_the_road_is_no_likelier_a_magnet(moment: float) -> None:
    state = MagnetState(2.47, 0.34)
    (dipole,) = with_log_odds([pole(10, 0, height_m=0.08, moment=moment)], state.prior)
    (classification,) = classify_dipoles([dipole], [], state, HALF_M)
    assert isinstance(classification, Rejected)
