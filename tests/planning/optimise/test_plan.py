"""Optimised plans: quality by its definition, costs, budgets, and even spacing for comparison."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from app.errors import InvalidParameter
from app.formats.alignments.geometry import EventKind
from app.planning.alignment import Alignment, AvoidedArea, Lane, RoadEvent
from app.planning.optimise import FamilyModel, OptimisedPlan, optimise_plan, pareto_points, site_costs
from app.planning.outputs.bill import plan_bill
from app.planning.placement import place_plan
from app.planning.placement.place import path_error_m
from app.planning.rules import PlanRules
from app.values import Floats
from tests.planning.optimise.test_path import winding
from tests.planning.roads import road, straight

COSTS = {
    "currency": "EUR",
    "items": [
        {"item": "plate", "per": "plate", "price": 100},
        {"item": "magnet", "per": "magnet", "price": 3},
        {"item": "hole", "per": "hole", "price": 7},
        {"item": "marker", "per": "cerpm", "price": 40},
        {"item": "crew", "per": "day", "price": 1000},
        {"item": "closure", "per": "metre_of_lane", "price": 2},
        {"item": "set-up", "per": "plan", "price": 500},
    ],
    "markers_per_day": 50,
}


def sure(lane: Lane, at: Floats) -> tuple[Floats, Floats]:
    return np.full(len(at), 0.999), np.full(len(at), 0.03)


def slower_is_better(lane: Lane, at: Floats) -> tuple[Floats, Floats]:
    """A camera that gets more frames of a plate at lower speed: 99.5 % up to 60 km/h, 93 % at 100 km/h."""
    speed_kmh = lane.value_at(lane.design_speed_m_s, at) * 3.6
    return np.interp(speed_kmh, [60, 100], [0.995, 0.93]), np.full(len(at), 0.05)


def rules_of(**parts: object) -> PlanRules:
    document: dict[str, Any] = {"version": 1, "plates": {}, "costs": COSTS, **parts}
    return PlanRules.model_validate(document)


def optimise(alignment: Alignment, rules: PlanRules, **fixes: Any) -> OptimisedPlan:
    costs = site_costs(rules)
    return optimise_plan(alignment, rules, [FamilyModel(name, costs[name], fix) for name, fix in fixes.items()])


def least_probability(lane: Lane, plan: OptimisedPlan, every_m: float, **fixes: Any) -> float:
    """Least probability of a fix in any stretch, by the definition, at starts of 1 m."""
    sites = [site for site in plan.sites if site.lane == lane.name and fixes.get(site.family)]
    at = np.array([site.chainage_m for site in sites])
    chance = np.array([fixes[s.family](lane, np.array([s.chainage_m]))[0][0] for s in sites])
    worst = 1.0
    for start in np.arange(0.0, lane.length_m - every_m + 1e-6, 1.0):
        inside = (at >= start - 1e-6) & (at <= start + every_m + 1e-6)
        worst = min(worst, 1 - math.prod((1 - chance[inside]).tolist()))
    return worst


def test_site_costs_are_those_of_the_unit_costs() -> None:
    rules = rules_of(tags={"magnets": 4}, cerpm={})
    assert site_costs(rules) == {"plate": 120, "magnet": 4 * 10 + 20, "cerpm": 2 * 60}
    with pytest.raises(InvalidParameter, match="no unit cost for the family plate") as refused:
        site_costs(rules_of(costs={}))
    assert refused.value.field == "costs.items"


def test_sure_plates_on_a_straight_are_as_many_as_the_windows_need() -> None:
    rules = rules_of(quality={"fix_every_m": 100})
    plan = optimise(road(straight(1000)), rules, plate=sure)
    # nine plates at most 100 m apart, the first and the last at most 100 m from the ends, hit by candidates of 5 m
    assert len(plan.sites) == 10
    assert plan.cost == plan.bound == 500 + 2 * 1000 + 10 * 120
    assert least_probability(straight(1000), plan, 100, plate=sure) >= 0.99
    (asked,) = [point for point in plan.table if point.fix_every_m == 100]
    assert asked.cost == plan.cost
    assert asked.even_cost == plan.cost


def test_unsure_plates_stand_twice_where_vehicles_are_fast() -> None:
    lane = straight(1200)
    speed = np.where(lane.chainage_m < 600, 60 / 3.6, 100 / 3.6)
    lane = Lane(**{name: getattr(lane, name) for name in Lane.__slots__} | {"design_speed_m_s": speed})
    plan = optimise(road(lane), rules_of(quality={"fix_every_m": 100}), plate=slower_is_better)
    assert least_probability(lane, plan, 100, plate=slower_is_better) >= 0.99 - 1e-9
    slow = [site for site in plan.sites if site.chainage_m < 600]
    assert len(plan.sites) - len(slow) >= 1.8 * len(slow)
    (asked,) = [point for point in plan.table if point.fix_every_m == 100]
    assert asked.even_cost is not None
    markers, even = plan.cost - 500 - 2 * 1200, asked.even_cost - 500 - 2 * 1200
    assert markers <= 0.8 * even


def test_the_cheapest_mix_takes_the_family_that_is_good_enough_in_each_place() -> None:
    def only_later(lane: Lane, at: Floats) -> tuple[Floats, Floats]:
        return np.full(len(at), 0.999), np.where(at < 500, 0.2, 0.05)

    rules = rules_of(tags={}, quality={"fix_every_m": 100, "fix_error_m": 0.1})
    plan = optimise(road(straight(1000)), rules, plate=sure, magnet=only_later)
    assert plan.counts.keys() == {"plate", "magnet"}
    assert max(site.chainage_m for site in plan.sites if site.family == "plate") < 500
    assert min(site.chainage_m for site in plan.sites if site.family == "magnet") >= 500
    with pytest.raises(InvalidParameter, match="places of information tags"):
        place_plan(road(straight(1000)), rules, name="tags", chosen=plan.places)


@pytest.mark.slow
def test_the_path_and_the_fixes_of_a_winding_road_cost_at_most_eight_tenths_of_even_spacing() -> None:
    lane = winding(2, 1, 1200)
    rules = rules_of(cerpm={"straight": 3.0}, quality={"fix_every_m": 100, "path_error_m": 0.05})

    def cerpm(lane: Lane, at: Floats) -> tuple[Floats, Floats]:
        return np.full(len(at), 0.9), np.full(len(at), 0.5)

    plan = optimise(road(lane), rules, plate=sure, cerpm=cerpm)
    pairs = np.array([site.chainage_m for site in plan.sites if site.purpose == "path"])
    assert path_error_m(lane, pairs).max() <= 0.05
    assert least_probability(lane, plan, 100, plate=sure) >= 0.99
    (asked,) = [p for p in plan.table if (p.fix_every_m, p.path_error_m) == (100, 0.05)]
    assert asked.even_cost is not None
    assert plan.cost - 500 - 2 * lane.length_m <= 0.8 * (asked.even_cost - 500 - 2 * lane.length_m)
    # the table: a stricter requirement is never cheaper, and what is on the front is better than nothing else
    by_fixes = [p.cost for p in sorted(plan.table, key=lambda p: p.fix_every_m) if p.path_error_m == 0.05]
    assert by_fixes == sorted(by_fixes, reverse=True)
    assert len(by_fixes) == 5
    by_path = [p.cost for p in sorted(plan.table, key=lambda p: p.path_error_m or 0) if p.fix_every_m == 100]
    assert by_path == sorted(by_path, reverse=True)
    front = pareto_points(plan.table)
    assert 0 < len(front) <= len(plan.table)
    assert [p.cost for p in front] == sorted(p.cost for p in front)
    assert not any(other.is_better(point) for point in front for other in plan.table)


def test_markers_that_are_needed_anyway_serve_as_fixes() -> None:
    stop = RoadEvent(EventKind.STOP_LINE, "1", 400.0)
    rules = rules_of(decision_points={"before": 150.0}, quality={"fix_every_m": 250})
    plan = optimise(road(straight(500), events=(stop,)), rules, plate=sure)
    assert [(site.chainage_m, site.purpose) for site in plan.sites] == [(250.0, "event")]
    assert plan.cost == 500 + 1000 + 120


def test_a_chosen_plan_is_placed_as_it_was_chosen_and_has_its_cost() -> None:
    lane = winding(2, 1, 900)
    stop = RoadEvent(EventKind.STOP_LINE, "1", 700.0)
    rules = rules_of(
        cerpm={}, decision_points={"at": ["stop_line"]}, quality={"fix_every_m": 120, "path_error_m": 0.05}
    )
    alignment = road(lane, events=(stop,))
    plan = optimise(alignment, rules, plate=sure, cerpm=None)
    placed = place_plan(alignment, rules, name="optimised", chosen=plan.places)
    for family in ("plate", "cerpm"):
        at = sorted({round(m.chainage_m, 6) for m in placed.markers if m.family == family})
        assert at == sorted({round(site.chainage_m, 6) for site in plan.sites if site.family == family})
    assert {site.purpose for site in plan.sites} == {"fix", "path", "event"}
    # the bill has whole days of the crew, the optimiser parts of a day
    assert plan.cost <= plan_bill(placed).total <= plan.cost + 1000
    assert not placed.left_out


def test_avoided_areas_steep_grades_and_lanes_that_are_not_chosen_get_nothing() -> None:
    lane = straight(600, grade=0.02)
    lon, lat = lane.position_at([180.0, 220.0, 220.0, 180.0, 180.0], [-3.0, -3.0, 3.0, 3.0, -3.0])
    bridge = AvoidedArea("bridges", np.column_stack([lon, lat]))
    rules = rules_of(quality={"fix_every_m": 100}, road={"lanes": ["1"]})
    plan = optimise(road(lane, straight(600, name="2"), areas=(bridge,)), rules, plate=sure)
    assert {site.lane for site in plan.sites} == {"1"}
    assert not [site for site in plan.sites if 179.4 < site.chainage_m < 220.6]
    assert least_probability(lane, plan, 100, plate=sure) >= 0.99
    long = AvoidedArea("bridges", np.column_stack(lane.position_at([150, 290, 290, 150, 150], [-3.0, -3, 3, 3, -3])))
    with pytest.raises(InvalidParameter, match=r"on lane 1 no markers fix the position .* between 0\+14\d") as refused:
        optimise(road(lane, areas=(long,)), rules, plate=sure)
    assert refused.value.cure
    with pytest.raises(InvalidParameter, match="no markers fix"):
        optimise(road(straight(600, grade=0.09)), rules, plate=sure)


def test_a_budget_buys_the_shortest_distance_between_fixes() -> None:
    alignment = road(straight(2000))
    base = 500 + 2 * 2000
    plan = optimise(alignment, rules_of(quality={"budget": base + 20 * 120}), plate=sure)
    assert plan.cost <= base + 20 * 120
    # 19 gaps between 20 plates and a gap at each end
    assert 2000 / 21 - 1e-6 <= plan.quality.fix_every_m <= 2000 / 21 * 1.06
    richer = optimise(alignment, rules_of(quality={"budget": base + 40 * 120}), plate=sure)
    assert richer.quality.fix_every_m < 0.6 * plan.quality.fix_every_m
    with pytest.raises(InvalidParameter, match=r"the cheapest plan costs 4,620\.00 EUR") as refused:
        optimise(alignment, rules_of(quality={"budget": base + 119}), plate=sure)
    assert refused.value.field == "quality.budget"


def test_rules_without_quality_and_path_errors_without_cerpms_are_refused() -> None:
    with pytest.raises(InvalidParameter, match="require no quality"):
        optimise(road(straight(500)), rules_of(), plate=sure)
    with pytest.raises(InvalidParameter, match="no CERPMs may be placed"):
        optimise(road(straight(500)), rules_of(quality={"path_error_m": 0.05}), plate=sure)


def test_families_that_fix_no_position_serve_the_path_only() -> None:
    lane = winding(2, 1, 600)
    plan = optimise(road(lane), rules_of(cerpm={}, quality={"path_error_m": 0.1}), cerpm=None)
    assert {site.purpose for site in plan.sites} == {"path"}
    assert path_error_m(lane, np.array([site.chainage_m for site in plan.sites])).max() <= 0.1
    assert plan.table[0].even_cost is not None
    assert plan.table[0].even_cost >= plan.cost


def test_the_same_input_gives_the_same_plan() -> None:
    alignment = road(winding(3, 40, 1000))
    rules = rules_of(quality={"fix_every_m": 150})
    assert optimise(alignment, rules, plate=sure) == optimise(alignment, rules, plate=sure)
