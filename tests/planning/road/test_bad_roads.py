"""Roads that cannot be used are refused with lane, place and cure."""

from __future__ import annotations

import math

import numpy as np
import pytest

from app.errors import InvalidParameter, UnreadableUpload
from app.formats.alignments.geometry import AlignmentDeclaration, AlignmentFile, LaneGeometry
from app.planning.build_alignment import build_alignment
from app.planning.rules import RoadRules

from .roads import RULES, Floats, build, centre_lane, straight_and_arc, wgs84


def _sides(left: object, right: object) -> LaneGeometry:
    sides = {k: wgs84(np.asarray(v, dtype=float)) for k, v in (("left", left), ("right", right))}
    return LaneGeometry("x", **sides)


def _loop(height_m: float) -> Floats:
    """A lane that crosses itself, the second time higher by some metres."""
    angles = np.linspace(0, 1.5 * math.pi, 80)
    circle = np.stack([100 + 30 * np.sin(angles), 30 - 30 * np.cos(angles)], axis=1)
    points = wgs84(np.concatenate([[[0, 0]], circle, [[70, -60]]]))
    points[:, 2] = np.linspace(100, 100 + height_m, len(points))
    return points


@pytest.mark.parametrize(
    ("lane", "message"),
    [
        (
            LaneGeometry("x", _loop(0.5) * (1, 1, np.nan)),
            r"crosses itself at 8.4009\d+, 49.0000000, chainages 70.0 m and ",
        ),
        (centre_lane([[0, 0], [50, 0], [10, 0.1], [90, 3]], "x"), "turns by 180 degrees at one vertex"),
        (centre_lane([[0, 0], [50, 0], [50, 0.4], [49, -40]], "x"), "turns by .* degrees at one vertex"),
        (centre_lane(straight_and_arc(0.2, 2.0, math.pi / 2), "x"), r"radius of [23]\.\d+ m"),
        (_sides([[0, 2], [100, 2]], [[0, 2], [100, 2]]), "0.00 to 0.00 m apart"),
        (_sides([[0, 2], [50, 0.3], [100, 2]], [[0, -2], [50, -0.2], [100, -2]]), r"chainage (49|5[01]) m"),
        (_sides([[0, -2], [100, -2]], [[0, 2], [100, 2]]), "apart"),
        (_sides([[0, 2], [100, 2]], [[100, -2], [0, -2]]), "opposite directions"),
        (_sides([[0, 2], [60, 2], [30, 2.1], [90, 3]], [[0, -2], [100, -2]]), "turns by"),
        (
            centre_lane([[0, 0], [50, 0], [100, 0]], "x", width_m=np.array([3.0, 0.0, 3.0])),
            r"the lane is \d.\d+ m wide",
        ),
        (centre_lane([[0, 0], [100, 0]], "x", width_m=np.zeros(2)), "the lane is 0.00 m wide"),
        (centre_lane([[0, 0], [0, 0]], "x"), "is one point"),
        (LaneGeometry("x", np.array([[8.4, 49.0, 0], [np.nan, 49.0, 0]])), "vertex 2 is not finite"),
        (LaneGeometry("x", np.array([[8.4, 49.0, 0], [8.5, 91.0, 0]])), "vertex 2 at 8.5, 91 is no longitude"),
        (
            LaneGeometry("x", np.array([[456_000.0, 5_430_000.0, 0], [456_100.0, 5_430_000.0, 0]])),
            "vertex 1 at 456000, 5430000 is no longitude",
        ),
        (LaneGeometry("x", np.array([[0.0, 10.0, 0], [12.0, 10.0, 0]])), "km long"),
        (centre_lane([[0, 0], [4.9, 0]], "x"), "no lane is left"),
    ],
)
def test_unusable_lanes(lane: LaneGeometry, message: str) -> None:
    with pytest.raises(InvalidParameter, match=message) as refused:
        build(lane)
    error = refused.value
    assert "lane x" in error.message or "no lane" in error.message or "km" in error.message
    assert error.field
    assert error.limit
    assert error.cure
    if lane.left is not None:
        assert "leave the lane out by road.lanes" in error.cure


def test_a_ramp_may_pass_above_itself() -> None:
    points = _loop(12.0)
    file = AlignmentFile("geojson", (LaneGeometry("x", points),))
    built = build_alignment(file, RULES, AlignmentDeclaration(vertical_datum="ellipsoid"))
    assert built.lanes[0].length_m > 300


def test_a_closed_track_is_no_crossing() -> None:
    angles = np.linspace(0, 2 * math.pi, 200)
    lane = build(centre_lane(np.stack([50 * np.sin(angles), -50 * np.cos(angles)], axis=1))).lanes[0]
    assert lane.length_m == pytest.approx(2 * math.pi * 50, abs=0.1)


def test_speed_is_required() -> None:
    lane = centre_lane([[0, 0], [50, 0], [100, 0]], "x", speed_limit_m_s=np.array([10.0, np.nan, np.nan]))
    with pytest.raises(
        InvalidParameter, match=r"lane x, chainage 5[01].0 m at 8\.4006\d+, 49.0000000: neither"
    ) as refused:
        build(lane, rules=RoadRules())
    assert refused.value.field == "road.design_speed_kmh"


def test_vertices_that_stand_twice_are_dropped_with_a_warning() -> None:
    alignment = build(centre_lane([[0, 0], [50, 0], [50, 0], [50, 0.00001], [100, 0]], "x"))
    assert alignment.warnings == ("lane x: 2 vertices that stand twice are left out",)
    assert alignment.lanes[0].length_m == pytest.approx(100.0, abs=1e-4)


def test_narrow_ends_are_cut_with_a_warning() -> None:
    width = np.array([0.0, 3.5, 3.5])
    alignment = build(centre_lane([[0, 0], [35, 0], [100, 0]], "x", width_m=width, station_m=np.array([0.0, 35, 100])))
    lane = alignment.lanes[0]
    assert "narrower" in alignment.warnings[0]
    assert lane.length_m == pytest.approx(85.0, abs=1.0)
    assert lane.chainage_m[0] == 0.0
    assert lane.width_m[0] >= 1.5
    assert lane.station_m[0] == pytest.approx(100 - lane.length_m, abs=1e-3)


def test_short_lanes_are_left_out_unless_they_are_named() -> None:
    lanes = (centre_lane([[0, 0], [100, 0]], "a"), centre_lane([[100, 0], [104, 0]], "b"))
    alignment = build(*lanes)
    assert [lane.name for lane in alignment.lanes] == ["a"]
    assert "lane b" in alignment.warnings[0]
    with pytest.raises(InvalidParameter, match=r"lane b at .* is 4.00 m long"):
        build(*lanes, rules=RoadRules(design_speed_kmh=50, lanes=["a", "b"]))


def test_names_of_lanes() -> None:
    lane = centre_lane([[0, 0], [100, 0]], "a")
    with pytest.raises(InvalidParameter, match="no lane 'z'") as refused:
        build(lane, rules=RoadRules(design_speed_kmh=50, lanes=["z"]))
    assert refused.value.limit == "a"
    with pytest.raises(InvalidParameter, match="several lanes 'a'"):
        build(lane, lane)
    with pytest.raises(UnreadableUpload, match="no lanes"):
        build()


def test_more_than_five_hundred_kilometres_are_refused() -> None:
    lanes = [LaneGeometry(str(k), np.array([[0.0, 10.0 + k, np.nan], [2.5, 10.0 + k, np.nan]])) for k in range(2)]
    with pytest.raises(InvalidParameter, match="km long"):
        build(*lanes)
    assert build(*lanes, rules=RoadRules(design_speed_kmh=50, lanes=["1"])).lane_length_m > 250_000


def test_bends_below_the_minimum_radius_are_reported() -> None:
    alignment = build(centre_lane(straight_and_arc(1.0, 60.0, 0.8), "x"))
    assert alignment.warnings[0].startswith("lane x, chainage ")
    assert "79 m of the design speed 50 km/h" in alignment.warnings[0]
    assert build(centre_lane(straight_and_arc(1.0, 95.0, 0.8), "x")).warnings == ()
