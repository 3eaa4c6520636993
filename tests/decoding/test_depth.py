"""The registered depth of magnets in the decoding of recordings: it is part of the distance to the bar."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from app.decoders.magnet.readings import MagnetReading
from app.decoders.magnet.recording_check import find_mistakes
from app.decoding.declarations import DeclaredTrace
from app.decoding.recordings import NearbyTags, bar_above, find_magnets
from app.families import rows_of_plan
from app.formats.alignments.geometry import EventKind
from app.markers.magnet import HALF_HEIGHT_M, InformationTag
from app.planning.alignment import RoadEvent
from app.planning.placement import place_plan
from app.planning.rules import PlanRules
from app.sensors.magnetometer_bar import BarDeclaration, MagnetometerBar
from app.simulation.magnetic.drive import Course, Scene, Vehicle, simulate_drive
from app.simulation.magnetic.road import PlacedTag, Road
from tests.planning.roads import road, straight


def nearby(*installations: dict[str, object]) -> NearbyTags:
    """Tags and lines of plans that are installed in these ways."""
    rows = []
    for installation in installations:
        rules = {"version": 1, "tags": {"at": ["speed_limit"]}, "lines": {}, "installation": installation}
        event = RoadEvent(EventKind.SPEED_LIMIT, "1", 150.0, 50.0)
        made = place_plan(replace(road(straight(200)), events=(event,)), PlanRules.model_validate(rules), name="plan")
        rows += list(rows_of_plan(made, datetime(2026, 1, 1, tzinfo=UTC)).values())
    return NearbyTags.of(rows, 2026.5)


def test_the_depth_of_all_magnets_nearby_is_known_if_they_have_one() -> None:
    assert NearbyTags.of([], 2026.5).depth_m == nearby({}).depth_m == -HALF_HEIGHT_M
    deep = nearby({"hole_depth_mm": 120})
    assert deep.depth_m == pytest.approx(0.115)
    assert [tag.depth_m for tag in deep.tags] == [pytest.approx(0.115)]
    assert nearby({"hole_depth_mm": 120}, {"hole_depth_mm": 140}).depth_m == pytest.approx(0.125)
    assert nearby({"hole_depth_mm": 120}, {"mounting": "surface"}).depth_m is None


def test_a_declared_clearance_is_above_the_road() -> None:
    bar = MagnetometerBar.metro(clearance_m=0.16)
    assert bar_above(bar, 0.115).clearance_m == pytest.approx(0.275)
    assert bar_above(bar, None).clearance_m is None
    assert bar_above(MagnetometerBar.metro(), 0.115).clearance_m is None


def test_buried_magnets_are_read_with_the_clearance_of_the_vehicle() -> None:
    depth_m = 0.15
    tags = [PlacedTag(InformationTag.from_gaps("NSN", 1.0, [1, 3]), 30.0, depth_m=depth_m)]
    scene = Scene(Road(60.0), Vehicle.compact(clearance_m=0.16, wheel_moment_am2=0.0), Course(10.0), tags=tags)
    trace = simulate_drive(scene, np.random.default_rng(8)).trace
    declared = DeclaredTrace(unit="uT", axes="ISO8855", bar=BarDeclaration(forward_m=3.2, clearance_m=0.16))
    checked, _version = find_magnets(trace, declared, (tags[0].tag.text,), (), depth_m)
    findings = checked.findings
    magnets = [one for one in findings if isinstance(one, MagnetReading)]
    assert [one.polarity.value for one in magnets] == ["N", "S", "N"]
    assert np.median([one.clearance_cm for one in magnets]) == pytest.approx(31.0, abs=3.0)
    assert not find_mistakes(trace, bar_above(declared.sensors, depth_m), findings, depth_m=depth_m)
