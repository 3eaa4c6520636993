"""Places of markers on lanes whose geometry is known without the code: straights, circles, kinks."""

from __future__ import annotations

import numpy as np
import pytest

from app.errors import InvalidParameter
from app.lanes.cross_sections import cut_lane
from app.markers.cerpm import LaneSide
from app.planning.cerpm_placement import SPACING_M, place_markers

STRAIGHT_LEFT = np.array([[0.0, 1.7], [100.0, 1.7]])
STRAIGHT_RIGHT = np.array([[0.0, -1.7], [40.0, -1.7], [100.0, -1.7]])


def _arc(radius_m: float, offset_m: float, turn_rad: float = 1.5, step_m: float = 0.5) -> np.ndarray:
    """A bend to the left about (0, radius), beginning at the origin to the east."""
    angle = np.linspace(0, turn_rad, int(radius_m * turn_rad / step_m) + 2)
    r = radius_m - offset_m
    return np.stack([r * np.sin(angle), radius_m - r * np.cos(angle)], 1)


def test_pairs_stand_across_from_each_other_at_even_steps_to_both_ends() -> None:
    places = place_markers(STRAIGHT_LEFT, STRAIGHT_RIGHT)
    left = [p for p in places if p.side is LaneSide.LEFT]
    right = [p for p in places if p.side is LaneSide.RIGHT]
    assert [p.chainage_m for p in left] == [p.chainage_m for p in right]
    assert len(left) == 10  # 100 m need nine gaps of at most 12.192 m
    assert np.diff([p.point_m[0] for p in left]) == pytest.approx(np.full(9, 100 / 9), abs=1e-6)
    assert {round(p.point_m[1], 9) for p in left} == {1.7}
    assert {round(p.point_m[1], 9) for p in right} == {-1.7}
    assert [p.heading_deg for p in places] == pytest.approx([90.0] * 20)


def test_no_gap_is_wider_than_asked() -> None:
    for spacing_m in (5.0, 12.192, 33.0):
        at = np.unique([p.chainage_m for p in place_markers(STRAIGHT_LEFT, STRAIGHT_RIGHT, spacing_m=spacing_m)])
        assert np.diff(at).max() <= spacing_m + 1e-6
        assert np.diff(at).max() > spacing_m / 2


def test_markers_on_a_circle_lie_on_its_boundaries() -> None:
    places = place_markers(_arc(60, 1.6), _arc(60, -1.6))
    for place in places:
        radius = np.hypot(place.point_m[0], place.point_m[1] - 60)
        assert radius == pytest.approx(58.4 if place.side is LaneSide.LEFT else 61.6, abs=2e-3)
        angle = np.arctan2(place.point_m[0], 60 - place.point_m[1])
        assert place.heading_deg == pytest.approx(90 - np.degrees(angle), abs=0.2)


@pytest.mark.parametrize(("radius_m", "closer"), [(60, True), (110, True), (140, False), (1000, False)])
def test_spacing_halves_where_the_chord_leaves_the_arc(radius_m: float, closer: bool) -> None:
    at = np.unique([p.chainage_m for p in place_markers(_arc(radius_m, 1.6), _arc(radius_m, -1.6))])
    widest = np.diff(at).max()
    assert widest <= (SPACING_M / 2 if closer else SPACING_M) + 1e-6
    assert widest > (0 if closer else SPACING_M / 2)


def test_a_bend_is_marked_closer_than_the_straight_before_it() -> None:
    lines = []
    for offset in (1.6, -1.6):
        arc = _arc(50, offset, turn_rad=1.0)
        lines.append(np.concatenate([[[-150.0, arc[0, 1]]], arc]))
    at = np.unique([p.chainage_m for p in place_markers(*lines)])
    gaps = np.diff(at)
    assert gaps[at[:-1] < 100] == pytest.approx(11.8, abs=0.4)
    assert gaps[at[:-1] > 150] == pytest.approx(5.9, abs=0.2)
    same = np.unique([p.chainage_m for p in place_markers(*lines, closer_in_bends=False)])
    assert np.ptp(np.diff(same)) < 1e-3


def test_ten_a_side() -> None:
    places = place_markers(_arc(80, 1.6), _arc(80, -1.6), markers_per_side=10)
    assert len(places) == 20
    at = np.unique([p.chainage_m for p in places])
    assert np.diff(at) == pytest.approx(np.full(9, at[-1] / 9))


def test_kinks_and_vertices_millimetres_apart_leave_markers_on_the_polyline() -> None:
    rng = np.random.default_rng(1000)
    along = np.sort(np.concatenate([np.arange(0, 200, 7.0), np.arange(0.005, 200, 7.0), [200.0]]))
    left = np.stack([along, 1.6 + rng.normal(0, 0.03, len(along))], 1)
    left[1:-1:2, 1] = left[0:-2:2, 1]  # a pair of vertices 5 mm apart is one place
    right = np.stack([np.r_[0.0, 120.0, 200.0], np.r_[-1.6, -1.5, -1.7]], 1)
    for place in place_markers(left, right):
        line = left if place.side is LaneSide.LEFT else right
        assert place.point_m[1] == pytest.approx(np.interp(place.point_m[0], line[:, 0], line[:, 1]), abs=0.01)


def test_width_and_curvature_of_a_circle() -> None:
    lane = cut_lane(_arc(40, 1.5), _arc(40, -1.5))
    assert lane.width_m == pytest.approx(np.full(len(lane.width_m), 3.0), abs=2e-3)
    inner = lane.curvature_per_m[20:-20]
    assert inner == pytest.approx(np.full(len(inner), 1 / 40), rel=0.02)
    assert np.hypot(lane.centre_m[:, 0], lane.centre_m[:, 1] - 40) == pytest.approx(
        np.full(len(lane.centre_m), 40.0), abs=2e-3
    )


def test_ends_that_are_not_opposite_are_left_open() -> None:
    lane = cut_lane([[0.0, 1.5], [100.0, 1.5]], [[3.0, -1.5], [96.0, -1.5]])
    assert lane.centre_m[0, 0] == pytest.approx(3.0, abs=0.6)
    assert lane.centre_m[-1, 0] == pytest.approx(96.0, abs=0.6)
    assert lane.centre_m[:, 0].min() >= 3.0 - 1e-2


@pytest.mark.parametrize(
    ("left", "right", "field"),
    [
        (STRAIGHT_RIGHT, STRAIGHT_LEFT, "left_m"),
        (STRAIGHT_LEFT, STRAIGHT_RIGHT[::-1], "right_m"),
        (STRAIGHT_LEFT, STRAIGHT_RIGHT - (0, 30), "left_m"),
        (STRAIGHT_LEFT, [[0.0, 0.0]], "right_m"),
        (STRAIGHT_LEFT, [[0.0, 0.0], [0.0, 0.0]], "right_m"),
        ([[0.0, np.nan], [9.0, 1.0]], STRAIGHT_RIGHT, "left_m"),
        ([[0.0, 1.7], [1e9, 1.7]], [[0.0, -1.7], [1e9, -1.7]], "step_m"),
    ],
)
def test_boundaries_that_are_no_lane_are_refused(left, right, field: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(InvalidParameter) as caught:
        place_markers(left, right)
    assert caught.value.field == field


@pytest.mark.parametrize(
    ("how", "field"),
    [
        ({"spacing_m": 0.5}, "spacing_m"),
        ({"spacing_m": float("nan")}, "spacing_m"),
        ({"spacing_m": 101.0}, "spacing_m"),
        ({"markers_per_side": 1}, "markers_per_side"),
        ({"markers_per_side": 200}, "markers_per_side"),
    ],
)
def test_rules_that_cannot_be_met_are_refused(how: dict[str, float], field: str) -> None:
    with pytest.raises(InvalidParameter) as caught:
        place_markers(STRAIGHT_LEFT, STRAIGHT_RIGHT, **how)  # type: ignore[arg-type]
    assert caught.value.field == field
