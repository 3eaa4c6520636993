"""Planned magnets as rows of the registry."""

from __future__ import annotations

from datetime import UTC, datetime

from app.families.magnet.layouts import MAX_MAGNETS
from app.families.magnet.magnets import MAGNET
from app.families.surveys import Commitment, MarkerRules
from app.planning.placement import place_plan
from app.planning.rules import PlanRules
from tests.planning.roads import road, straight


def test_a_long_line_becomes_several_markers_of_no_more_magnets_than_one_may_have() -> None:
    rules = PlanRules.model_validate({"version": 1, "lines": {"sides": "left"}})
    made = place_plan(road(straight(6500)), rules, name="a long line")
    commitment = Commitment("plan", made.alignment, MarkerRules(), datetime(2026, 1, 1, tzinfo=UTC))
    rows = list(MAGNET.planned_rows(commitment, made.markers))
    assert len(made.markers) > MAX_MAGNETS
    assert [row.covered for row in rows] == [MAX_MAGNETS, len(made.markers) - MAX_MAGNETS]
    assert rows[1].columns["original"]["plan"]["number"] == made.markers[MAX_MAGNETS].number
