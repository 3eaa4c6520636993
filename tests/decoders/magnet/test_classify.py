"""Poles of iron are recognised by the poles beside them."""

from __future__ import annotations

import numpy as np
import pytest

from app.decoders.magnet.classify import classify_dipoles
from app.decoders.magnet.ferrous import ferrous_reason, is_ferrous, rows_beside
from app.decoders.magnet.fit_window import Dipole, magnet_prior
from app.decoders.magnet.readings import NoiseKind
from app.markers.magnet import Orientation, Polarity

HALF_M = 0.88
PRIOR = magnet_prior(2.47, 0.12, 0.16, 0.025)


def pole(s_m: float, y_m: float, *, height_m: float = 0.16, moment: float = 2.47, prior_cost: float = 0.5) -> Dipole:
    params = np.array([s_m, y_m, height_m, moment, 0.0, 0.0])
    return Dipole(params, np.eye(6) * 1e-4, 400.0, 0.0, prior_cost, 0, 50.0)


MESH = [pole(s, y) for s, y in ((10.0, -0.8), (10.2, -0.3), (10.1, 0.2), (10.3, 0.7))]
TAG = [pole(10 + 0.5 * i, 0.02 * i) for i in range(5)]


def test_poles_beside_each_other_are_iron_and_a_row_is_not() -> None:
    assert is_ferrous(MESH, HALF_M)
    assert all(ferrous_reason(p, MESH, HALF_M) for p in MESH)
    assert not is_ferrous(TAG, HALF_M)
    assert not any(ferrous_reason(p, TAG, HALF_M) for p in TAG)


def test_a_line_beside_a_tag_is_one_row() -> None:
    line = pole(11.0, -0.85)
    assert rows_beside(TAG[0], [*TAG, line], HALF_M) == 1
    assert rows_beside(line, [*TAG, line], HALF_M) == 1
    assert not is_ferrous([*TAG, line], HALF_M)


def test_poles_of_parked_cars_do_not_count() -> None:
    cars = [pole(9.0, 1.1), pole(11.0, 1.1), pole(10.0, -1.2)]
    assert rows_beside(TAG[0], cars, HALF_M) == 0


def test_the_other_end_of_a_plate_is_iron_too() -> None:
    end = pole(12.6, 0.1)
    assert ferrous_reason(end, [*MESH, end], HALF_M)
    assert classify_dipoles([end], MESH, PRIOR, HALF_M)[0][0] is NoiseKind.FERROUS
    assert classify_dipoles([end], [], PRIOR, HALF_M)[0][:2] == (Orientation.FORWARD, Polarity.N)


@pytest.mark.parametrize(("height_m", "fine"), [(0.11, True), (0.24, False)])
def test_what_lies_deep_is_refused_sooner_than_a_low_nose(height_m: float, fine: bool) -> None:
    cost = ((height_m - 0.16) / 0.025) ** 2
    classification = classify_dipoles([pole(10, 0, height_m=height_m, prior_cost=cost)], [], PRIOR, HALF_M)[0]
    assert (classification[0] is Orientation.FORWARD) is fine
    if not fine:
        assert classification[0] is NoiseKind.WRONG_HEIGHT
