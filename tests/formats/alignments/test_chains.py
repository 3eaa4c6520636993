"""Parts are joined where exactly two ends meet, in the direction in which they are drawn."""

from __future__ import annotations

import numpy as np
import pytest

from app.formats.alignments.features import JOIN_M, Link, chain_parts, join_chain


def _parts(*lines: list[tuple[float, float]]) -> list[np.ndarray]:
    return [np.array([(*point, 0.0) for point in line]) for line in lines]


def test_many_parts_in_random_order_are_one_chain() -> None:
    rng = np.random.default_rng(4)
    order = rng.permutation(500)
    parts = _parts(*[[(k, 0.0), (k + 0.5, 1.0), (k + 1.0, 0.0)] for k in order])
    (chain,) = chain_parts(parts, geographic=False, unit_m=1.0)
    assert [order[link.part] for link in chain] == list(range(500))
    assert join_chain(parts, chain)[:, 0].tolist() == [k / 2 for k in range(1001)]


def test_a_closed_chain_begins_at_its_first_part() -> None:
    corners = [(0.0, 0.0), (9.0, 0.0), (9.0, 9.0), (0.0, 9.0), (0.0, 0.0)]
    (chain,) = chain_parts(_parts(*[corners[k : k + 2] for k in range(4)]), geographic=False, unit_m=1.0)
    assert [link.part for link in chain] == [0, 1, 2, 3]


def test_parts_without_direction_are_turned() -> None:
    parts = _parts([(9, 0), (5, 0)], [(0, 0), (5, 0)], [(9, 0), (12, 0)])
    (chain,) = chain_parts(parts, geographic=False, unit_m=1.0, reversible=[True, False, True])
    assert chain == [Link(1, False), Link(0, True), Link(2, False)]
    assert len(chain_parts(parts, geographic=False, unit_m=1.0)) == 3


def test_chains_end_where_three_ends_meet_and_at_gaps() -> None:
    fork = _parts([(0, 0), (5, 0)], [(5, 0), (9, 3)], [(5, 0), (9, -3)])
    assert len(chain_parts(fork, geographic=False, unit_m=1.0)) == 3
    near = _parts([(0, 0), (5, 0)], [(5 + 0.9 * JOIN_M, 0), (9, 0)])
    far = _parts([(0, 0), (5, 0)], [(5 + 1.1 * JOIN_M, 0), (9, 0)])
    assert [len(chain_parts(parts, geographic=False, unit_m=1.0)) for parts in (near, far)] == [1, 2]
    assert len(chain_parts(near, geographic=False, unit_m=2.0)) == 2


@pytest.mark.parametrize("lon", [(180.0, -180.0), (180.0, 180.0)])
def test_ends_meet_across_the_antimeridian(lon: tuple[float, float]) -> None:
    parts = _parts([(179.0, 70.0), (lon[0], 70.0)], [(lon[1], 70.0), (-179.0, 70.0)])
    assert len(chain_parts(parts, geographic=True, unit_m=1.0)) == 1
