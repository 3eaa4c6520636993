"""Bill of materials and cost of a plan."""

from __future__ import annotations

import csv
import io
from typing import Any

import pytest

from app.planning.outputs.bill import bill_document, plan_bill, plan_quantities, write_bill_csv
from app.planning.plan import PlannedLineMagnet, PlannedTag
from tests.planning.outputs.made import ALL, full_plan, plan_of, two_lanes
from tests.planning.roads import road, straight


def items(*prices: tuple[str, float]) -> list[dict[str, Any]]:
    return [{"item": f"price per {per}", "per": per, "price": price, "pay_item": f"P-{per}"} for per, price in prices]


def test_quantities_count_what_is_installed() -> None:
    plan = full_plan()
    quantities = plan_quantities(plan)
    tags = [m.detail for m in plan.markers if isinstance(m.detail, PlannedTag)]
    lines = [m for m in plan.markers if isinstance(m.detail, PlannedLineMagnet)]
    assert len(tags) == 3
    assert quantities["magnet"] == quantities["hole"] == len(lines) + 3 * len(tags)
    assert quantities["plate"] == sum(m.family == "plate" for m in plan.markers) > 0
    assert quantities["cerpm"] == sum(m.family == "cerpm" for m in plan.markers) > 0
    assert quantities["marker"] == len(plan.markers)
    assert quantities["metre_of_lane"] == pytest.approx(plan.alignment.lane_length_m, abs=0.001)
    assert quantities["day"] is None


def test_cost_is_quantity_times_the_agency_s_price() -> None:
    prices = items(("plate", 60.0), ("magnet", 1.25), ("cerpm", 35.0), ("day", 1800.0), ("plan", 500.0))
    plan = plan_of(two_lanes(), **ALL, costs={"currency": "EUR", "items": prices, "markers_per_day": 100})
    bill, count = plan_bill(plan), plan_quantities(plan)
    days = -(-len(plan.markers) // 100)
    assert count["day"] == days
    expected = 60.0 * count["plate"] + 1.25 * count["magnet"] + 35.0 * count["cerpm"] + 1800.0 * days + 500.0
    assert bill.total == pytest.approx(expected)
    assert bill.complete
    assert bill.sentence == f"{expected:,.2f} EUR"


def test_materials_without_a_price_are_named_and_the_total_is_incomplete() -> None:
    plan = plan_of(two_lanes(), **ALL, costs={"items": items(("plate", 60.0), ("hole", 5.0))})
    bill = plan_bill(plan)
    assert not bill.complete
    assert "incomplete: no unit cost given for chip-enabled raised pavement marker; line magnet" in bill.sentence
    unpriced = {material.item for material in bill.materials if not material.priced}
    assert unpriced == {material.item for material in bill.materials if material.family != "plate"}
    rows = list(csv.DictReader(io.StringIO(write_bill_csv(bill).decode())))
    assert [row["note"] for row in rows if row["section"] == "material" and row["family"] == "cerpm"] == [
        "no unit cost given"
    ]
    total = next(row for row in rows if row["section"] == "total")
    assert total["note"].startswith("incomplete")
    assert float(total["cost"]) == bill.total


def test_published_figures_are_a_labelled_comparison_and_no_part_of_the_total() -> None:
    bill = plan_bill(plan_of(road(straight(600)), lines={"solid": "N", "dashed": "S"}))
    assert bill.total == 0
    found = {row.cost.item: row for row in bill.comparisons}
    # METRO section 8.1: $0.17 a metre of line magnets against $0.21 to $7.70 of paint; 600 m of lane have two lines
    line = found["line tags at 6 m"]
    assert line.quantity == pytest.approx(1200.0, abs=1.0)
    assert line.high_usd / line.quantity == pytest.approx(0.17, abs=0.001)
    paint = found["paint or thermoplastic marking"]
    assert (paint.low_usd / paint.quantity, paint.high_usd / paint.quantity) == pytest.approx((0.21, 7.70), abs=0.001)
    magnets = found["magnet with shell"]
    assert magnets.high_usd / line.quantity == pytest.approx(0.17, abs=0.01), "the plan's own magnets cost as much"
    document: Any = bill_document(bill)
    assert document["comparison"]["label"].startswith("published figures for comparison")
    assert document["total"] == 0
    tags = {row.cost.item: row for row in plan_bill(full_plan()).comparisons}["information tag of 3 magnets"]
    assert tags.high_usd == 3 * 3.00


def test_texts_of_the_price_list_are_no_formulas() -> None:
    prices = [{"item": "=1+1", "per": "plate", "price": 1, "pay_item": "+2*3", "source": "@x"}]
    text = write_bill_csv(plan_bill(plan_of(road(straight(300)), plates={}, costs={"items": prices}))).decode()
    assert "'=1+1" in text
    assert ",=1+1" not in text
    assert ",+2*3" not in text
    assert ",@x" not in text
