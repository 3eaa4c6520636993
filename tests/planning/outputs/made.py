"""Plans of short roads with all families, for the tests of outputs."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from app.formats.alignments.geometry import EventKind
from app.planning.alignment import Alignment, AvoidedArea, RoadEvent
from app.planning.placement import place_plan
from app.planning.plan import Plan
from app.planning.rules import PlanRules
from tests.planning.roads import bend, opposite, road

ALL: dict[str, Any] = {
    "plates": {},
    "decision_points": {},
    "lines": {},
    "tags": {},
    "cerpm": {},
    "avoid": {"max_shift_m": 5},
}


def plan_of(alignment: Alignment, name: str = "test plan", **rules: Any) -> Plan:
    """A plan by rules."""
    return place_plan(alignment, PlanRules.model_validate({"version": 1, **rules}), name=name)


def two_lanes() -> Alignment:
    """A bend of two lanes with events and a bridge."""
    lane = bend(150, name="1")
    lon, lat = lane.position_at([300, 303, 303, 300], [3, 3, -3, -3])
    ring = np.column_stack([lon, lat])[[0, 1, 2, 3, 0]]
    events = (
        RoadEvent(EventKind.SPEED_LIMIT, "1", 150.0, 50.0),
        RoadEvent(EventKind.CURVE, "1", 200.0, 60.0),
        RoadEvent(EventKind.STOP_LINE, "1", 500.0),
    )
    return road(lane, opposite(lane, "2"), events=events, areas=(AvoidedArea("bridges", ring),))


@lru_cache(maxsize=1)
def full_plan() -> Plan:
    """All families on `two_lanes`."""
    return plan_of(two_lanes(), **ALL)
