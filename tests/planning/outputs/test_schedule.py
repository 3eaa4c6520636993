"""Schedule of work and programming list of a plan."""

from __future__ import annotations

import csv
import io
from itertools import pairwise

import orjson
import pytest

from app.markers.cerpm import CerpmMessage
from app.planning.outputs.bill import plan_schedule, write_schedule_csv
from app.planning.outputs.plan_document import plan_programs, write_plan_programs_csv, write_plan_programs_json
from app.planning.plan import PlannedCerpm
from tests.planning.outputs.made import ALL, full_plan, plan_of, two_lanes
from tests.planning.roads import road, straight

RADIO = {"spreading_factor": 7, "interval_s": 1.0}


def test_every_marker_is_in_one_section_in_the_direction_of_travel() -> None:
    plan = full_plan()
    sections = plan_schedule(plan)
    assert [marker for section in sections for marker in section.markers] == list(plan.markers)
    assert all(a.chainage_m <= b.chainage_m for s in sections for a, b in pairwise(s.markers))
    assert {section.day for section in sections} == {None}
    assert [section.lane for section in sections] == ["1", "2"]


def test_a_section_is_a_kilometre_without_a_daily_rate() -> None:
    sections = plan_schedule(plan_of(road(straight(2500)), plates={}))
    assert [len(section.markers) for section in sections] == [10, 10, 5]


@pytest.mark.parametrize("rate", [1.0, 37.0, 100.5, 1e6])
def test_a_day_has_as_many_markers_as_a_crew_installs(rate: float) -> None:
    plan = plan_of(two_lanes(), **ALL, costs={"markers_per_day": rate})
    by_day: dict[int, int] = {}
    for section in plan_schedule(plan):
        assert section.day is not None
        by_day[section.day] = by_day.get(section.day, 0) + len(section.markers)
    assert list(by_day) == list(range(1, len(by_day) + 1))
    assert len(by_day) == -(-len(plan.markers) // rate)
    assert max(by_day.values()) <= rate + 1
    assert sum(by_day.values()) == len(plan.markers)


def test_the_csv_counts_by_family() -> None:
    plan = full_plan()
    rows = list(csv.DictReader(io.StringIO(write_schedule_csv(plan).decode())))
    total = {name: sum(int(row[name]) for row in rows) for name in ("markers", "plates", "holes", "cerpms")}
    assert total["markers"] == len(plan.markers)
    assert total["plates"] == plan.counts["plate"]
    assert total["cerpms"] == plan.counts["cerpm"]
    assert total["holes"] == plan.counts["magnet"] + 2 * 3, "three tags have three magnets each"
    assert rows[0]["from_station"] == "0+000.00"


def test_programs_have_no_keys_and_the_first_message_of_each_marker() -> None:
    plan = plan_of(two_lanes(), cerpm=RADIO)
    programs = plan_programs(plan)
    rows = list(csv.DictReader(io.StringIO(write_plan_programs_csv(programs).decode())))
    assert len(rows) == len(plan.markers)
    assert not any("key" in name for name in rows[0])
    document = orjson.loads(write_plan_programs_json(plan, programs))
    assert b"key_hex" not in write_plan_programs_json(plan, programs)
    assert document["radio"]["spreading_factor"] == 7
    for marker, row, entry, program in zip(plan.markers, rows, document["markers"], programs, strict=True):
        assert isinstance(marker.detail, PlannedCerpm)
        assert int(row["number"]) == entry["number"] == marker.detail.number
        assert float(row["lon_deg"]) == pytest.approx(marker.lon_deg, abs=6e-8)
        assert row["body_hex"] == entry["body_hex"]
        assert isinstance(program.message, CerpmMessage)
        assert program.message.height_m is None, "heights of an unknown datum are not sent"
    assert plan_programs(plan_of(two_lanes(), plates={})) == ()
