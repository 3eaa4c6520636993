"""The benchmark of plans at its smallest: the papers' set-ups come out, and its roads have all families. Never time."""

from __future__ import annotations

import pytest

from app.planning.rules import check_rules
from benchmarks.planning.optimiser import brute_force
from benchmarks.planning.papers import measure_papers
from benchmarks.planning.roads import LANES, generated_road, real_lane
from benchmarks.planning.speed import RADII_M, RULES, SEED, measure_road


@pytest.mark.slow
def test_the_papers_set_ups_come_out() -> None:
    section = measure_papers(short=True)
    assert section.met, section.text
    assert " NO " not in section.text


@pytest.mark.slow
def test_a_road_of_the_speed_table_has_all_families() -> None:
    found = measure_road(1.0)
    assert found.markers.keys() == {"plate", "magnet", "cerpm"}
    assert found.findings > 10
    assert found.total_s == sum(found.seconds.values()) > 0


def test_generated_roads_are_as_long_as_asked_and_their_lanes_run_both_ways() -> None:
    rules = check_rules(RULES)
    forward, back = generated_road(900.0, SEED, radii_m=RADII_M, rules=rules.road).lanes
    assert [forward.length_m, back.length_m] == pytest.approx([900.0, 900.0], abs=5.0)
    turn = (back.heading_deg[-1] - forward.heading_deg[0]) % 360.0
    assert turn == pytest.approx(180.0, abs=2.0)


@pytest.mark.parametrize("name", LANES)
def test_real_lanes_are_read(name: str) -> None:
    (lane,) = real_lane(name).lanes
    assert lane.length_m > 200
    assert lane.design_speed_m_s.max() < 14


def test_the_optimiser_is_as_cheap_as_trying_all_choices() -> None:
    assert brute_force(8) == (8, 8)
