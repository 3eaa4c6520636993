"""Magnets as rows of the registry: planned ones, and sites that earlier releases stored."""

from __future__ import annotations

from dataclasses import asdict
from datetime import UTC, datetime
from typing import cast

from app.families.magnet.layouts import MAX_MAGNETS, layout_of, sheet_of, site_of
from app.families.magnet.magnets import MAGNET
from app.families.surveys import Commitment, MarkerRules
from app.markers.magnet import Installation, MagnetMounting
from app.markers.magnet_design import MagnetSpec
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


def test_a_site_of_an_earlier_release_is_read() -> None:
    site = {
        "design_speed_mps": 20.0, "stop_line_chainage_m": 130.0, "vehicles": ["van"], "readable_clearance_m": 0.3,
        "reaction_s": 2.0, "deceleration_mps2": 3.0,
    }  # fmt: skip
    older = site_of(cast(MagnetSpec, {"site": site}))
    assert (older.design_speed_m_s, older.deceleration_m_s2, older.vehicles) == (20.0, 3.0, ("van",))
    assert site_of(cast(MagnetSpec, {"site": asdict(older)})) == older


def test_planned_magnets_are_registered_as_they_are_fixed() -> None:
    rules = PlanRules.model_validate(
        {"version": 1, "lines": {}, "installation": {"mounting": "surface", "shell_height_mm": 12}}
    )
    made = place_plan(road(straight(200)), rules, name="glued")
    commitment = Commitment(
        "plan", made.alignment, MarkerRules(), datetime(2026, 1, 1, tzinfo=UTC), installation=rules.installation
    )
    for row in MAGNET.planned_rows(commitment, made.markers):
        layout = layout_of("a line", row.columns["spec"])
        assert layout.installation == Installation(MagnetMounting.SURFACE, shell_height_mm=12)


def test_a_layout_of_an_earlier_release_is_read() -> None:
    made = place_plan(road(straight(200)), PlanRules.model_validate({"version": 1, "lines": {}}), name="earlier")
    commitment = Commitment("plan", made.alignment, MarkerRules(), datetime(2026, 1, 1, tzinfo=UTC))
    row, *_ = MAGNET.planned_rows(commitment, made.markers)
    spec = row.columns["spec"]
    earlier = {name: value for name, value in spec.items() if name != "installation"}
    earlier["site"] = {name: value for name, value in spec["site"].items() if name != "wheel_circumference_m"}
    now, then = sheet_of("a line", spec), sheet_of("a line", cast(MagnetSpec, earlier))
    assert then.layout.installation == Installation()
    assert (then.checks, then.bill, then.layout.holes) == (now.checks, now.bill, now.layout.holes)
