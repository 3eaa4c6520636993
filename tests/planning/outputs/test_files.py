"""The maps among the files of a plan, also of a plan that was written and read again."""

from __future__ import annotations

from dataclasses import replace

import pytest

from app.errors import NotFound
from app.planning.outputs.package import plan_files, write_plan_file
from app.planning.outputs.plan_document import read_plan, write_plan
from tests.planning.outputs.made import full_plan

ODD = 'A "plan" <&> of ]]> Zürich, 東京 \u2028 \U0001f6e3'


def test_maps_are_files_of_a_plan_and_the_same_after_a_round_trip() -> None:
    plan = replace(full_plan(), name=ODD)
    again = read_plan(write_plan(plan))
    assert write_plan(again) == write_plan(plan)
    for name in ("map.osm", "map.xodr"):
        data = write_plan_file(plan, name)
        assert data == write_plan_file(again, name)
        assert data.decode().count("waymark_id" if name == "map.osm" else "<signal ") >= len(plan.markers)


def test_a_marker_beside_no_lane_leaves_out_one_map_and_the_report_says_so() -> None:
    plan = full_plan()
    away = replace(plan.markers[0], lat_deg=plan.markers[0].lat_deg + 0.01)
    plan = replace(plan, markers=(away, *plan.markers[1:]))
    names = [file.name for file in plan_files(plan)]
    assert "map.osm" in names
    assert "map.xodr" not in names
    report = write_plan_file(plan, "report.md").decode()
    assert "map.xodr: marker 1 at" in report
    assert "left out" not in write_plan_file(full_plan(), "report.md").decode().partition("## Files")[2]
    with pytest.raises(NotFound) as refused:
        write_plan_file(plan, "map.xodr")
    assert refused.value.limit is not None
    assert "map.osm" in refused.value.limit
