"""Plans of rules with a quality: the cheapest places, their findings, the budget, and what is refused."""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from app.errors import InvalidParameter
from app.formats.alignments.geometry import EventKind
from app.markers.reading import Verdict
from app.planning.alignment import Alignment, RoadEvent
from app.planning.outputs.bill import plan_bill
from app.planning.outputs.package import plan_files
from app.planning.outputs.plan_document import read_plan, write_plan
from app.planning.placement import place_plan
from app.planning.plan import Plan
from app.planning.planner import make_plan
from app.planning.rules import check_rules
from app.plots.track import draw_trade_off
from tests.planning.optimise.test_path import winding
from tests.planning.roads import road, straight

COSTS: dict[str, Any] = {
    "currency": "EUR",
    "items": [
        {"item": "plate", "per": "plate", "price": 100},
        {"item": "magnet", "per": "magnet", "price": 3},
        {"item": "marker", "per": "cerpm", "price": 40},
        {"item": "crew", "per": "day", "price": 900},
        {"item": "set-up", "per": "plan", "price": 500},
    ],
    "markers_per_day": 30,
}
QUALITY: dict[str, Any] = {"fix_every_m": 120, "fix_probability": 0.98, "fix_error_m": 0.1}


def made(alignment: Alignment, **rules: Any) -> Plan:
    document = {"version": 1, "costs": COSTS, "quality": QUALITY, **rules}
    return make_plan(alignment, check_rules(document), name="cheapest")


def figures(plan: Plan) -> dict[str, Any]:
    return {found.name: found for found in plan.findings}


def test_plates_stand_only_where_the_required_fixes_need_them() -> None:
    plan = made(road(straight(1000, speed_kmh=60.0)), plates={"spacing_m": 20})
    assert plan.optimum is not None
    at = np.array([marker.chainage_m for marker in plan.markers])
    assert len(at) == 8  # stretches of 120 m
    assert np.diff(at).max() <= 120.0 + 1e-6
    fixes = figures(plan)["fix-probability"]
    assert fixes.verdict is Verdict.OK
    assert fixes.figure >= 0.98
    assert figures(plan)["fix-error"].figure == pytest.approx(0.0307, abs=0.0002)
    assert plan_bill(plan).total <= plan.optimum.cost
    assert plan.optimum.table[0].cost == plan.optimum.cost


def test_where_plates_are_read_less_often_there_are_more_of_them() -> None:
    camera = {"name": "weak", "frames_per_s": 4, "exposure_s": 0.002}
    slow, fast = (made(road(straight(1000, speed_kmh=v)), plates={}, cameras=[camera]) for v in (40.0, 90.0))
    assert len(fast.markers) > len(slow.markers)
    for plan in (slow, fast):
        assert figures(plan)["fix-probability"].verdict is Verdict.OK
    lost = made(road(straight(1000, speed_kmh=40.0)), plates={}, cameras=[camera], predictions={"lost_share": 0.1})
    assert len(lost.markers) > len(slow.markers)


def test_plates_and_tags_ahead_of_events_count_as_fixes_and_tags_are_not_covered() -> None:
    events = tuple(RoadEvent(EventKind.STOP_LINE, "1", at) for at in (400.0, 700.0))
    alignment = road(straight(1000, speed_kmh=60.0), events=events)
    plain = made(alignment, plates={})
    plan = made(alignment, plates={}, tags={}, decision_points={"at": ["stop_line"], "before": 60.0})
    assert sum(marker.family == "magnet" for marker in plan.markers) == 2
    assert figures(plan)["fix-probability"].verdict is Verdict.OK
    assert len(plan.markers) < len(plain.markers) + 4
    tags = [marker.chainage_m for marker in plan.markers if marker.family == "magnet"]
    for marker in plan.markers:
        if marker.family == "plate":
            assert not any(at - 0.5 < marker.chainage_m < at + 4.5 for at in tags)


@pytest.mark.slow
def test_pairs_of_cerpms_follow_the_required_path_and_else_the_rules() -> None:
    lane = winding(2, 40, 1500)
    required = made(road(lane), cerpm={"straight": 3.0}, quality={**QUALITY, "path_error_m": 0.05})
    assert figures(required)["path-error"].verdict is Verdict.OK
    assert figures(required)["path-error"].limit == 0.05
    assert figures(required).keys() & {"fix-probability", "budget"} == set()
    both = made(road(lane), cerpm={}, plates={})
    by_rules = place_plan(road(lane), check_rules({"version": 1, "cerpm": {}}), name="rules")
    assert both.counts["cerpm"] == by_rules.counts["cerpm"]


def test_a_budget_buys_the_nearest_fixes_and_is_kept() -> None:
    alignment = road(straight(1500, speed_kmh=60.0))
    budget = 20_000.0
    plan = made(alignment, plates={}, lines={"max_spacing_m": 6}, quality={**QUALITY, "budget": budget})
    found = figures(plan)["budget"]
    assert found.verdict is Verdict.OK
    assert found.figure == plan_bill(plan).total <= budget
    assert plan.optimum is not None
    assert plan.optimum.quality.fix_every_m < 1500
    assert budget - plan.optimum.cost < 300  # another plate and its share of a day do not fit
    with pytest.raises(InvalidParameter) as error:
        made(alignment, plates={}, quality={**QUALITY, "budget": 400})
    assert error.value.field == "quality.budget"
    assert "cheapest plan costs" in error.value.message


@pytest.mark.parametrize(
    ("rules", "field", "says"),
    [
        ({"plates": {}, "costs": {}}, "costs.items", "no unit cost for the family plate"),
        ({"lines": {}}, "quality", "no marker of the rules fixes a position"),
        ({"cerpm": {}}, "quality", "no marker of the rules fixes a position"),
        ({"plates": {}, "quality": {**QUALITY, "fix_error_m": 0.02}}, "quality", "no markers fix the position"),
        ({"plates": {}, "quality": {**QUALITY, "path_error_m": 0.05}}, "quality.path_error_m", "no CERPMs"),
        ({"cerpm": {}, "costs": {}, "quality": {"path_error_m": 0.05}}, "costs.items", "family cerpm"),
    ],
)
def test_what_cannot_be_is_refused_with_what_is_possible(rules: dict[str, Any], field: str, says: str) -> None:
    with pytest.raises(InvalidParameter) as error:
        made(road(straight(600)), **rules)
    assert error.value.field == field
    assert says in error.value.message
    assert error.value.cure
    if rules.get("quality", {}).get("fix_error_m") == 0.02:
        assert "an error of 0.031 m" in str(error.value.limit)


def test_an_optimised_plan_is_written_with_its_trade_off_and_read_back() -> None:
    plan = made(road(straight(800, speed_kmh=60.0)), plates={})
    again = read_plan(write_plan(plan))
    assert again.optimum == plan.optimum
    files = {file.name: file for file in plan_files(again, draw_trade_off=draw_trade_off)}
    lines = files["trade-off.csv"].write().decode().splitlines()
    assert lines[0].startswith("fix_every_m,path_error_m,cost,bound,even_cost")
    assert lines[1].startswith("120,,")
    assert lines[1].endswith(",yes")
    assert len(lines) == 6
    assert ElementTree.fromstring(files["trade-off.svg"].write()).tag.endswith("svg")
    assert "trade-off.svg" not in {file.name for file in plan_files(again)}
    plain = make_plan(plan.alignment, check_rules({"version": 1, "plates": {}}), name="plain")
    assert plain.optimum is None
    assert not any(file.name.startswith("trade-off") for file in plan_files(plain))


def test_where_misses_add_up_even_spacing_is_never_cheaper() -> None:
    camera = {"name": "weak", "frames_per_s": 4, "exposure_s": 0.002}
    for length_m in (1500, 9000):  # solved in sections, and greedily
        plan = made(road(straight(length_m, speed_kmh=80.0)), plates={}, cameras=[camera])
        assert plan.optimum is not None
        for point in plan.optimum.table:
            assert point.even_cost is not None
            assert point.bound - 1e-6 <= point.cost <= point.even_cost + 1e-6
