"""Refused inputs: the field is the path in the request, with the limit and the cure of the check that failed."""

from __future__ import annotations

from typing import Any

import pytest

from app.decoding.declarations import DecodeContext, UploadContext
from app.errors import InvalidParameter
from app.inputs import parse_input
from app.lanes.types import LaneDeclaration, LaneRules

CAMERA = {"width_px": 96, "height_px": 64, "fx_px": 80.0, "fy_px": 80.0, "cx_px": 47.5}


@pytest.mark.parametrize(
    ("document", "field", "limit"),
    [
        ({"heading_deg": 361.0}, "heading_deg", "0 to 360"),
        ({"coarse_position": {"lon_deg": 8.0, "lat_deg": 91.0, "accuracy_m": 5.0}}, "coarse_position.lat_deg", "90"),
        ({"coarse_position": {"lon_deg": 8.0, "lat_deg": 49.0, "accuracy_m": 0.0}}, "coarse_position.accuracy_m", "20"),
        ({"packets": {"clock": {"utc_offset_s": 60_000.0}}}, "packets.clock.utc_offset_s", "at most 50400"),
        ({"packets": {"poses": {"columns": {"colour": "a"}}}}, "packets.poses.columns", "heading"),
        ({"frames": {"poses": {"date": "2026-13-01"}}}, "frames.poses.date", "date"),
        ({"trace": {"bar": {"sensors": [{"position_m": [0, 0, 0]}] * 3}}}, "trace.bar.positions_m", "no two alike"),
        ({"trace": {"can": {"speed": {}}}}, "trace.can.speed", "an identifier, or both"),
        ({"trace": {"can": {"speed": {"name": "v", "factor": 0}}}}, "trace.can.speed.factor", "not 0"),
        ({"trace": {"tag_formats": [{"magnets": 9}]}}, "trace.tag_formats.0.magnets", "at most 7"),
        ({"trace": {"columns": {"decimal": ","}}}, "trace.columns.delimiter", "differ"),
        ({"trace": {}, "packets": {}}, "packets", "one of trace, packets"),
        ({"camera": CAMERA}, "camera.fx_px", "horizontal_fov_deg"),
        ({"camera": {"horizontal_fov_deg": 0.5}}, "camera.horizontal_fov_deg", "1 to 179"),
        ({"thermal_range": [10, 20]}, "thermal_range", "with thermal only"),
        ({"lens": 1}, "lens", "not permitted"),
    ],
)
def test_a_refusal_names_field_limit_and_cure(document: dict[str, Any], field: str, limit: str) -> None:
    with pytest.raises(InvalidParameter) as refused:
        parse_input(DecodeContext, document)
    assert refused.value.field == field
    assert limit in (refused.value.limit or "")
    assert refused.value.cure


def test_all_faults_are_named() -> None:
    with pytest.raises(InvalidParameter) as refused:
        parse_input(UploadContext, {"heading_deg": "north", "vehicle": ""}, "context")
    assert refused.value.field == "context.heading_deg"
    assert [part.field for part in refused.value.parts] == ["context.vehicle"]


def test_a_context_is_stored_as_it_was_declared() -> None:
    declared = {"trace": {"unit": "uT", "tag_formats": [{"magnets": 3, "length_m": 4.0, "segment_m": 1.0}]}}
    context = parse_input(DecodeContext, {**declared, "captured_at": "2026-05-04T08:30:00Z"})
    stored = context.model_dump(mode="json", exclude_unset=True)
    assert stored == {**declared, "captured_at": "2026-05-04T08:30:00Z"}
    assert DecodeContext.model_validate(stored) == context


def test_a_part_of_an_upload_may_need_the_vehicles_profile() -> None:
    stated = parse_input(UploadContext, {"camera": {"fx_px": 80.0}, "trace": {"columns": {"decimal": ","}}})
    assert stated.stated == {"camera": {"fx_px": 80.0}, "trace": {"columns": {"decimal": ","}}}


def test_rules_are_those_that_were_declared_and_the_others() -> None:
    assert LaneRules.of(None) == LaneRules()
    assert LaneRules.of(LaneDeclaration(bridge_m=90.0)) == LaneRules(bridge_m=90.0)
