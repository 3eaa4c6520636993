"""Places and codes of all families."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from app.errors import InvalidParameter
from app.formats.alignments.geometry import BoundaryStyle, EventKind
from app.markers.cerpm import LaneSide
from app.markers.magnet_design import MeaningKind
from app.planning.alignment import Alignment, AvoidedArea, RoadEvent
from app.planning.placement import place_plan
from app.planning.placement.place import path_error_m
from app.planning.plan import Plan, PlannedCerpm, PlannedLineMagnet, PlannedTag, Purpose
from app.planning.rules import PlanRules
from tests.planning.roads import GEOD, bend, opposite, road, straight


def plan(alignment: Alignment, **rules: object) -> Plan:
    return place_plan(alignment, PlanRules.model_validate({"version": 1, **rules}), name="test plan")


def gaps_m(made: Plan) -> list[float]:
    return [
        GEOD.inv(a.lon_deg, a.lat_deg, b.lon_deg, b.lat_deg)[2] for a, b in pairwise(made.markers) if a.lane == b.lane
    ]


def test_plates_lie_mid_lane_no_farther_apart_than_the_spacing() -> None:
    made = plan(road(straight(1000)), plates={"spacing_m": 90})
    assert len(made.markers) == 12
    assert max(gaps_m(made)) == pytest.approx(1000 / 12, abs=1e-3)
    assert made.markers[0].chainage_m == pytest.approx(1000 / 24)
    assert all(marker.offset_m == 0 for marker in made.markers)
    assert len({marker.code for marker in made.markers}) == 12
    assert [marker.number for marker in made.markers] == list(range(1, 13))


def test_position_plates_carry_the_decimals_of_their_place() -> None:
    made = plan(road(straight(300)), plates={"spacing_m": 100, "scheme": "position"})
    for marker in made.markers:
        assert marker.code == f"{marker.lon_deg:.6f}".split(".")[1] + f"{marker.lat_deg:.6f}".split(".")[1]


def test_the_same_input_gives_the_same_plan() -> None:
    alignment = road(bend(100))
    rules = {"plates": {}, "lines": {}, "cerpm": {}}
    assert plan(alignment, **rules).markers == plan(alignment, **rules).markers


@pytest.mark.parametrize(
    ("before", "grade", "expected_m"),
    [
        # AASHTO Green Book (2018), equations 3-2 and 3-3, 90 km/h: 62.5 m of reaction and 25^2 / (2 x 3.4) of braking
        ("stopping_distance", 0.0, 62.5 + 25.0**2 / 6.8),
        ("reaction_distance", 0.0, 62.5),
        (80.0, 0.0, 80.0),
        ("stopping_distance", -0.06, 62.5 + 25.0**2 / (2 * 9.81 * (3.4 / 9.81 - 0.06))),
    ],
)
def test_decision_points_have_a_plate_the_needed_distance_before_them(
    before: str | float, grade: float, expected_m: float
) -> None:
    stop = RoadEvent(EventKind.STOP_LINE, "1", 480.0)
    made = plan(road(straight(500, grade=grade), events=(stop,)), plates={}, decision_points={"before": before})
    [marker] = [m for m in made.markers if m.purpose is Purpose.DECISION_POINT]
    assert stop.chainage_m - marker.chainage_m == pytest.approx(expected_m, abs=0.2)
    others = [m.chainage_m for m in made.markers if m.purpose is Purpose.SPACING]
    assert min(abs(at - marker.chainage_m) for at in others) > 25


def test_an_event_too_near_the_start_is_left_out_with_the_reason() -> None:
    stop = RoadEvent(EventKind.STOP_LINE, "1", 60.0)
    made = plan(road(straight(500), events=(stop,)), plates={}, decision_points={}, tags={})
    assert {left.family for left in made.left_out} == {"plate", "magnet"}
    assert all("before the lane's start" in left.reason for left in made.left_out)


def test_line_magnets_follow_painted_lines_and_a_shared_line_is_placed_once() -> None:
    lane = bend(60.0, 100)
    made = plan(road(lane, opposite(lane, "2")), lines={"max_spacing_m": 6})
    styles = {(m.lane, m.detail.side, m.detail.style) for m in made.markers if isinstance(m.detail, PlannedLineMagnet)}
    assert styles == {
        ("1", LaneSide.LEFT, BoundaryStyle.DASHED),
        ("1", LaneSide.RIGHT, BoundaryStyle.SOLID),
        ("2", LaneSide.RIGHT, BoundaryStyle.SOLID),
    }
    for key in styles:
        line = [m for m in made.markers if (m.lane, m.detail.side, m.detail.style) == key]  # type: ignore[union-attr]
        apart = [GEOD.inv(a.lon_deg, a.lat_deg, b.lon_deg, b.lat_deg)[2] for a, b in pairwise(line)]
        assert min(apart) > 5.8
        assert max(apart) <= 6.0
        assert {m.code for m in line} == {"S_90" if key[2] is BoundaryStyle.DASHED else "N_90"}


def test_tags_have_the_meaning_of_their_event_and_equal_meanings_one_code() -> None:
    events = (
        RoadEvent(EventKind.STOP_LINE, "1", 400.0),
        RoadEvent(EventKind.STOP_LINE, "1", 900.0),
        RoadEvent(EventKind.CURVE, "1", 600.0, -93.0),
        RoadEvent(EventKind.SPEED_LIMIT, "1", 700.0, 50.0),
        RoadEvent(EventKind.ARROW, "1", 880.0, "left"),
    )
    made = plan(road(straight(1000), events=events), tags={"magnets": 4})
    details = [m.detail for m in made.markers if isinstance(m.detail, PlannedTag)]
    assert [d.meaning.kind for d in details] == [
        MeaningKind.STOP_LINE_AHEAD, MeaningKind.BEND_RIGHT, MeaningKind.SPEED_LIMIT_KMH,
        MeaningKind.STOP_LINE_AHEAD, MeaningKind.ARROW,
    ]  # fmt: skip
    assert details[1].meaning.value == 95.0
    assert details[0].tag == details[3].tag
    assert len({d.tag for d in details}) == 4
    assert made.codebook is not None
    assert len(made.codebook.entries) == 4
    for marker, detail in zip(made.markers, details, strict=True):
        lons, lats = [m[1] for m in detail.magnets], [m[2] for m in detail.magnets]
        assert GEOD.line_length([lons[0], lons[-1]], [lats[0], lats[-1]]) == pytest.approx(4.0, abs=1e-4)
        assert marker.chainage_m + 4.0 <= detail.event.chainage_m + 1e-6


def test_more_meanings_than_codes_is_an_error_with_the_cure() -> None:
    events = tuple(RoadEvent(EventKind.SPEED_LIMIT, "1", 100.0 + 40 * k, 5.0 + k) for k in range(60))
    with pytest.raises(InvalidParameter, match="meanings") as caught:
        plan(road(straight(3000), events=events), tags={"magnets": 2, "length_m": 1.0})
    assert caught.value.field == "tags.magnets"
    assert "longer tag" in (caught.value.cure or "")


def test_cerpms_are_closer_where_the_curvature_changes() -> None:
    """A straight that meets an arc of R 62.5 m without a spiral: 70 mm at 12.2 m, 16 mm at 6.1 m (exact markers)."""
    lane = bend(62.5, 195, 90.0)
    coarse = plan(road(lane), cerpm={"max_path_error_m": None, "curve": 1.0, "straight": 1.0})
    fine = plan(road(lane), cerpm={"max_path_error_m": 0.05, "curve": 1.0, "straight": 1.0})
    pairs = {
        made: np.unique([m.chainage_m for m in made.markers if isinstance(m.detail, PlannedCerpm)])
        for made in (coarse, fine)
    }
    assert 0.05 < path_error_m(lane, pairs[coarse]).max() < 0.09
    assert path_error_m(lane, pairs[fine]).max() <= 0.05
    added = np.setdiff1d(pairs[fine].round(3), pairs[coarse].round(3))
    assert 0 < len(added) < 12
    assert np.minimum(np.abs(added - 195), np.abs(added - 293)).max() < 15


def test_cerpms_are_closer_where_a_lane_is_added() -> None:
    lane = straight(1000)
    taper = replace(lane, width_m=3.5 + 3.5 * np.clip((lane.chainage_m - 400) / 200, 0, 1))
    spacing = {"n_m": 12.0, "straight": 2.0, "curve": 1.0, "max_path_error_m": None}
    at = np.array([m.chainage_m for m in plan(road(taper), cerpm=spacing).markers if m.detail.side is LaneSide.LEFT])
    inside = (at[:-1] > 400) & (at[1:] < 600)
    assert np.diff(at)[inside] == pytest.approx(12.0, abs=0.3)
    assert np.diff(at)[at[1:] < 380] == pytest.approx(24.0, abs=0.6)


@pytest.mark.parametrize("length_m", [2, 4, 9])
def test_lanes_of_a_few_metres_have_a_pair_at_each_end(length_m: int) -> None:
    made = plan(road(straight(length_m)), cerpm={})
    assert len(made.markers) == 4
    assert {round(marker.chainage_m, 3) for marker in made.markers} == {0, length_m}


def test_cerpms_of_a_shared_boundary_stand_once_and_name_no_side_where_lanes_differ() -> None:
    lane = straight(300)
    made = plan(road(lane, opposite(lane, "2")), cerpm={})
    sides = {(m.lane, m.detail.side) for m in made.markers if isinstance(m.detail, PlannedCerpm)}
    assert sides == {("1", LaneSide.LEFT), ("1", LaneSide.RIGHT), ("2", LaneSide.RIGHT)}
    assert len({m.code for m in made.markers}) == len(made.markers)
    assert {m.detail.speed_limit.value for m in made.markers} == {90}  # type: ignore[union-attr]


def test_avoided_areas_move_markers_or_leave_them_out() -> None:
    lane = straight(1000)
    lon, lat = lane.position_at([49.5, 50.5, 50.5, 49.5], [-3.0, -3.0, 3.0, 3.0])
    joint = AvoidedArea("joints", np.stack([lon, lat], 1)[[0, 1, 2, 3, 0]])
    lon, lat = lane.position_at([600.0, 700.0, 700.0, 600.0], [-3.0, -3.0, 3.0, 3.0])
    bridge = AvoidedArea("bridges", np.stack([lon, lat], 1)[[0, 1, 2, 3, 0]])
    lon, lat = lane.position_at([200.0, 300.0, 300.0, 200.0], [-3.0, -3.0, 3.0, 3.0])
    lawn = AvoidedArea("lawns", np.stack([lon, lat], 1)[[0, 1, 2, 3, 0]])
    made = plan(road(lane, areas=(joint, bridge, lawn)), plates={"spacing_m": 100})
    assert len(made.markers) == 9
    assert made.markers[0].chainage_m == pytest.approx(48.75, abs=0.3)
    moved, left = sorted(made.left_out, key=lambda found: found.chainage_m)
    assert moved.moved_m == pytest.approx(-1.25, abs=0.3)
    assert left.moved_m is None
    assert left.chainage_m == pytest.approx(650)
    assert "bridges" in left.reason


@pytest.mark.parametrize(
    ("rules", "field"),
    [
        ({"plates": {}, "road": {"lanes": ["7"]}}, "road.lanes"),
        ({"plates": {}, "applies": {"speed_kmh": [20, 50]}}, "applies.speed_kmh"),
        ({"cerpm": {"marking_rules": "moon"}}, "cerpm.marking_rules"),
    ],
)
def test_rules_that_do_not_fit_the_road_are_refused(rules: dict[str, object], field: str) -> None:
    with pytest.raises(InvalidParameter) as caught:
        plan(road(straight(300)), **rules)
    assert caught.value.field == field
    assert caught.value.cure


def test_pairs_of_cerpms_beside_line_magnets_stay_across_from_each_other() -> None:
    made = plan(road(straight(1000)), lines={}, cerpm={"n_m": 12.0, "max_path_error_m": None})
    places: dict[float, set[float]] = {}
    for marker in made.markers:
        if marker.family == "cerpm":
            places.setdefault(marker.chainage_m, set()).add(marker.offset_m)
    assert all(offsets == {1.75, -1.75} for offsets in places.values())
    magnets = np.array([marker.chainage_m for marker in made.markers if marker.family == "magnet"])
    assert min(float(np.abs(magnets - at).min()) for at in places) >= 0.4 - 1e-9
    assert any(at not in np.linspace(0.0, 1000.0, 43) for at in places)
