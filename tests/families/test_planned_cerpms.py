"""CERPMs of a plan as rows of the registry: each sends in its own place of a frame."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np

from app.families.cerpm import CERPM
from app.families.surveys import Commitment, MarkerRules
from app.planning.placement import place_plan
from app.planning.radio_checks import RadioPlan, in_slots
from app.planning.rules import PlanRules
from app.radio.settings import RadioSettings
from tests.planning.roads import road, straight


def planned_radios(radio: RadioSettings) -> tuple[list[RadioSettings], list[float]]:
    """Radio and chainage of each row of a long lane."""
    rules = PlanRules.model_validate({"version": 1, "cerpm": {"region": "EU868"}})
    made = place_plan(road(straight(3000)), rules, name="a lane in slots")
    commitment = Commitment("plan", made.alignment, MarkerRules(), datetime(2026, 1, 1, tzinfo=UTC), None, radio)
    rows = list(CERPM.planned_rows(commitment, made.markers))
    assert [row.number for row in rows] == [marker.number for marker in made.markers]
    return [RadioSettings(**row.columns["spec"]["radio"]) for row in rows], [m.chainage_m for m in made.markers]


def test_markers_of_a_plan_share_a_place_only_far_apart() -> None:
    radio = replace(in_slots(RadioPlan(RadioSettings(power_dbm=14.0))).radio, interval_s=1.0, spreading_factor=8)
    radios, chainages = planned_radios(radio)
    assert radio.slots is not None
    capacity = radio.slots.capacity
    assert len(radios) > 2 * capacity
    places = np.array([one.place for one in radios])
    assert set(places) == set(range(capacity))
    at_m = np.array(chainages)
    spacing_m = float(np.median(np.diff(np.unique(at_m))))
    nearest_m = min(np.diff(np.sort(at_m[places == place])).min() for place in range(capacity))
    assert nearest_m >= 0.9 * spacing_m * capacity / 2  # two markers at each station


def test_without_slots_all_radios_are_the_plans() -> None:
    radios, _chainages = planned_radios(RadioSettings())
    assert set(radios) == {RadioSettings()}
