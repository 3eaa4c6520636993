"""Curvature of polylines is that of the road they were drawn from; noise of the vertices is no bend."""

from __future__ import annotations

import math

import numpy as np
import pytest

from app.formats.alignments.geometry import EventKind, LaneGeometry
from app.planning.road.ground_line import make_ground_line, smoothing_m, vertex_noise_m

from .roads import build, centre_lane, east_north, straight_and_arc, wgs84


@pytest.mark.parametrize("radius_m", [30.0, 60.0, 150.0])
@pytest.mark.parametrize("spacing_m", [0.5, 2.0, 5.0, 10.0, 14.0])
@pytest.mark.parametrize("turn", [math.pi / 2, -math.pi / 2])
def test_an_arc_has_its_radius_however_its_vertices_are_spaced(radius_m: float, spacing_m: float, turn: float) -> None:
    lane = build(centre_lane(straight_and_arc(spacing_m, radius_m, turn))).lanes[0]
    arc_m = radius_m * abs(turn)
    margin_m = max(10.0, 1.2 * spacing_m)
    inside = (lane.chainage_m > 150 + margin_m) & (lane.chainage_m < 150 + arc_m - margin_m)
    straight = (lane.chainage_m < 150 - 20) | (lane.chainage_m > 150 + arc_m + 25)
    assert inside.sum() > 10
    np.testing.assert_allclose(lane.curvature_per_m[inside] * radius_m, math.copysign(1.0, turn), rtol=0.1)
    assert np.abs(lane.curvature_per_m[straight]).max() < 1 / 2000
    turned = np.sum((lane.curvature_per_m[1:] + lane.curvature_per_m[:-1]) / 2) * lane.step_m
    assert turned == pytest.approx(turn, abs=0.01)


@pytest.mark.parametrize("spacing_m", [5.0, 10.0, 14.0])
def test_boundaries_with_vertices_at_other_places_have_the_radius_of_the_centre(spacing_m: float) -> None:
    radius_m = 60.0
    left = wgs84(straight_and_arc(spacing_m, radius_m, math.pi / 2, 1.75))
    right = wgs84(straight_and_arc(spacing_m * 0.83, radius_m, math.pi / 2, -1.75))
    lane = build(LaneGeometry("1", left=left, right=right)).lanes[0]
    inside = (lane.chainage_m > 165) & (lane.chainage_m < 150 + 94 - 15)
    np.testing.assert_allclose(lane.curvature_per_m[inside] * radius_m, 1.0, rtol=0.1)
    assert np.abs(lane.width_m - 3.5).max() < spacing_m**2 / 8 / (radius_m - 1.75) + 0.01


def test_long_pieces_beside_short_ones_stay_straight() -> None:
    points = straight_and_arc(5.0, 60.0, math.pi / 2)
    sparse = np.concatenate([points[:1], points[30:48], points[-1:]])  # 150 m, then vertices every 5 m
    lane = build(centre_lane(sparse)).lanes[0]
    assert np.abs(lane.curvature_per_m[lane.chainage_m < 130]).max() < 1e-5
    inside = (lane.chainage_m > 165) & (lane.chainage_m < 215)
    np.testing.assert_allclose(lane.curvature_per_m[inside] * 60.0, 1.0, rtol=0.1)


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("spacing_m", [0.5, 1.0, 2.0, 5.0, 10.0, 14.0])
def test_centimetres_of_noise_on_a_straight_road_are_no_bends(spacing_m: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    s = np.arange(0.0, 10_000.0, spacing_m)
    sides = [
        np.stack([s, np.full(len(s), north)], axis=1) + rng.normal(0, 0.01, (len(s), 2)) for north in (1.75, -1.75)
    ]
    boundaries = LaneGeometry("2", left=wgs84(sides[0]), right=wgs84(sides[1]))
    alignment = build(centre_lane(sides[0]), boundaries)
    for lane in alignment.lanes:
        assert np.abs(lane.curvature_per_m).max() < 1 / 500
    assert alignment.events == ()


def test_noise_is_estimated_from_the_vertices() -> None:
    rng = np.random.default_rng(2)
    points = straight_and_arc(5.0, 100.0, math.pi / 2)
    noisy = wgs84(points + rng.normal(0, 0.02, points.shape))
    line = make_ground_line(noisy[:, 0], noisy[:, 1], noisy[:, 2], np.arange(len(noisy), dtype=float), "1")
    noise_m, spacing = vertex_noise_m(line)
    assert noise_m == pytest.approx(0.02, rel=0.3)
    assert spacing == pytest.approx(5.0, abs=0.05)
    assert smoothing_m(0.0, 5.0) == 2.0
    assert smoothing_m(0.02, 5.0) > smoothing_m(0.01, 5.0) > 2.0


def test_a_curve_is_found_at_its_start_with_its_turn() -> None:
    alignment = build(centre_lane(straight_and_arc(1.0, 60.0, math.radians(-45))))
    (curve,) = alignment.events
    assert curve.kind is EventKind.CURVE
    assert curve.chainage_m == pytest.approx(150.0, abs=3.0)
    assert curve.value == pytest.approx(-45.0, abs=1.0)


def test_bends_in_both_directions_are_two_curves_and_slight_ones_none() -> None:
    first = straight_and_arc(1.0, 60.0, math.radians(40))
    direction = first[-1] - first[-2]
    angle = math.atan2(direction[1], direction[0])
    turn = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    second = straight_and_arc(1.0, 60.0, math.radians(-40)) @ turn + first[-1] + direction
    alignment = build(centre_lane(np.concatenate([first, second])))
    assert [round(float(event.value or 0)) for event in alignment.events] == [40, -40]
    assert build(centre_lane(straight_and_arc(1.0, 60.0, math.radians(8)))).events == ()
    assert build(centre_lane(straight_and_arc(1.0, 500.0, math.radians(40)))).events == ()


def test_the_centre_between_boundaries_lies_on_its_arc() -> None:
    left, right = (wgs84(straight_and_arc(0.1, 12.0, math.pi / 2, side)) for side in (1.75, -1.75))
    lane = build(LaneGeometry("1", left=left, right=right)).lanes[0]
    inside = (lane.chainage_m > 155) & (lane.chainage_m < 150 + 12 * math.pi / 2 - 5)
    points = east_north(lane.lon_deg[inside], lane.lat_deg[inside])
    assert np.abs(np.hypot(points[:, 0] - 150, points[:, 1] - 12) - 12).max() < 0.001
