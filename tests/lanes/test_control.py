"""The path as a controller follows it, the speed along it, and the laws that steer."""

from __future__ import annotations

import math

import numpy as np
import pytest

from app.errors import InvalidParameter
from app.lanes.control import (
    Controller,
    SteeringSettings,
    follow_path,
    nearest_on_path,
    plan_speed,
    predict_pose,
    stanley_rad,
)

EAST = np.column_stack([np.arange(0.0, 101.0), np.zeros(101)])


def bend(radius_m: float, turn_deg: float, step_m: float = 0.5) -> np.ndarray:
    """A left bend from the origin, at first eastward."""
    angle = np.arange(0.0, math.radians(turn_deg), step_m / radius_m)
    return radius_m * np.column_stack([np.sin(angle), 1 - np.cos(angle)])


def steer(path, x, y, yaw, speed, gain, ahead=0.0):
    followed = follow_path(path)
    near = int(np.argmin(np.hypot(*(followed.position_enu_m - (x, y)).T)))
    near = min(near, len(followed.heading_rad) - 2)
    far = min(near + int(ahead / followed.step_m), len(followed.heading_rad) - 2)
    return stanley_rad(followed.position_enu_m, followed.heading_rad, x, y, yaw, speed, gain, ahead, near, far)


def test_a_path_gets_an_even_grid_headings_and_curvature():
    path = follow_path(bend(24.0, 180.0, 3.0))
    assert path.length_m == pytest.approx(24 * math.pi, rel=0.03)
    steps = np.hypot(*np.diff(path.position_enu_m, axis=0).T)
    np.testing.assert_allclose(steps, path.step_m, rtol=0.01)
    assert path.step_m == pytest.approx(0.25, rel=0.01)
    np.testing.assert_allclose(path.curvature_per_m[20:-20], 1 / 24, rtol=0.35)  # chords of 3 m turn by jumps
    assert path.curvature_per_m[20:-20].mean() == pytest.approx(1 / 24, rel=0.02)
    assert path.heading_rad[-1] - path.heading_rad[0] == pytest.approx(math.pi, abs=0.15)


def test_points_that_repeat_are_passed_over():
    path = follow_path(np.repeat(EAST, 2, axis=0))
    assert path.length_m == pytest.approx(100.0)
    np.testing.assert_allclose(path.heading_rad, 0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("path", "why"),
    [
        (EAST[:8], "7.0 m long"),
        (EAST[:1], "0.0 m long"),
        (np.empty((0, 2)), "0.0 m long"),
        (np.where(EAST == 50, np.nan, EAST), "not finite"),
        (np.where(EAST == 50, np.inf, EAST), "not finite"),
        (np.column_stack([EAST, EAST]), "shape"),
        (np.delete(EAST, np.arange(40, 66), axis=0), "no point for 27.0 m from 39.0 m on"),
        (EAST + np.column_stack([np.zeros(101), np.where(EAST[:, 0] > 50, 3.0, 0.0)]), "jumps"),
        (np.vstack([EAST[:60], EAST[50:]]), "jumps"),
        (np.vstack([EAST, EAST[::-1]]), "jumps"),
    ],
)
def test_paths_that_cannot_be_driven_are_refused_by_name(path, why):
    with pytest.raises(InvalidParameter, match=why) as caught:
        follow_path(path, field="truth_enu_m")
    assert caught.value.field == "truth_enu_m"
    assert caught.value.limit is not None


def test_two_spacings_of_40_ft_are_no_gap_and_corners_of_their_chords_no_jump():
    follow_path(np.column_stack([np.arange(0, 200, 24.384), np.zeros(9)]))
    follow_path(bend(24.0, 180.0, 12.192))  # 29 degrees at a corner


def test_bends_are_taken_at_the_comfort_of_their_radius_and_braked_for_ahead():
    straight = np.column_stack([np.arange(-150.0, 0.0, 0.5), np.zeros(300)])
    points = np.vstack([straight, bend(24.0, 170.0)])
    path = follow_path(points)
    speed = plan_speed(path, points, 50.0, comfort_m_s2=2.0, braking_m_s2=1.5)
    assert speed[0] == pytest.approx(50 / 3.6)
    in_bend = slice(round(160 / path.step_m), round(210 / path.step_m))
    np.testing.assert_allclose(speed[in_bend], math.sqrt(2.0 * 24.0), rtol=0.01)
    slowing = -np.diff(speed**2) / 2 / path.step_m
    assert slowing.max() == pytest.approx(1.5, rel=1e-6)
    before_m = ((50 / 3.6) ** 2 - 48.0) / 2 / 1.5  # v^2 = u^2 - 2 a s
    first = int(np.argmax(speed < 50 / 3.6 - 1e-9)) * path.step_m
    assert first == pytest.approx(150 - before_m, abs=1.0)


def test_limits_hold_from_their_point_on():
    limits = np.where(EAST[:, 0] >= 40, 30.0, 60.0)
    limits[70:] = 60.0
    path = follow_path(EAST)
    speed = plan_speed(path, EAST, limits)
    at = np.arange(len(speed)) * path.step_m
    np.testing.assert_allclose(speed[(at >= 40) & (at < 70)], 30 / 3.6)
    np.testing.assert_allclose(speed[at >= 70], 60 / 3.6)
    assert speed[round(39 / path.step_m)] < 60 / 3.6


@pytest.mark.parametrize("limits", [0.0, -10.0, math.nan, 1e9, np.full(5, 50.0), np.full((101, 2), 50.0)])
def test_speed_limits_that_make_no_sense_are_refused(limits):
    with pytest.raises(InvalidParameter) as caught:
        plan_speed(follow_path(EAST), EAST, limits)
    assert caught.value.field == "speed_limit_kmh"


def test_equation_4_by_hand():
    angle, left, _, _ = steer(EAST, 50.0, 0.5, 0.0, 10.0, 2.0)
    assert left == pytest.approx(0.5)
    assert angle == pytest.approx(-math.atan(2.0 * 0.5 / 10.0))  # left of the path: steer right
    angle, *_ = steer(EAST, 50.0, 0.0, math.radians(10.0), 10.0, 2.0)
    assert angle == pytest.approx(math.radians(-10.0))
    angle, *_ = steer(EAST, 50.0, -0.5, math.radians(-3.0), 10.0, 2.0)
    assert angle == pytest.approx(math.radians(3.0) + math.atan(0.1))
    angle, *_ = steer(EAST, 50.0, 0.0, 2 * math.pi - 0.1, 10.0, 2.0)  # headings go round
    assert angle == pytest.approx(0.1)


def test_equation_5_takes_the_error_15_m_ahead_along_the_heading():
    angle, left, _, _ = steer(EAST, 50.0, 0.2, 0.1, 10.0, 0.4, ahead=15.0)
    assert left == pytest.approx(0.2)
    assert angle == pytest.approx(-0.1 - math.atan(0.4 * (0.2 + 15 * math.sin(0.1)) / 10.0))


def test_the_law_does_not_divide_by_a_standstill():
    angle, *_ = steer(EAST, 50.0, 0.5, 0.0, 0.0, 1.0)
    assert angle == pytest.approx(-math.atan(0.5))


def test_a_loop_that_comes_back_beside_itself_does_not_catch_the_search():
    points = np.vstack([bend(10.0, 350.0), bend(10.0, 350.0) + 0.05])
    followed = follow_path(points[: len(points) // 2])
    piece, _, left = nearest_on_path(followed.position_enu_m, 0.0, 0.2, 0)
    assert piece == 0
    assert left == pytest.approx(0.2, abs=0.01)
    piece, share, _ = nearest_on_path(followed.position_enu_m, -3.0, 0.0, 0)
    assert piece == 0
    assert share < -5  # before the start: the first piece goes on


def test_prediction_waits_out_commands_under_way():
    pending = np.full(20, 0.1)
    x, y, yaw, angle = predict_pose(0.0, 0.0, 0.0, 0.1, 10.0, 2.7, 0.1, pending, 0, 0.01)
    radius = 2.7 / math.tan(0.1)
    assert yaw == pytest.approx(10.0 * 0.2 / radius)
    assert (x, y) == pytest.approx((radius * math.sin(yaw), radius * (1 - math.cos(yaw))), abs=1e-4)
    assert angle == pytest.approx(0.1)
    *_, angle = predict_pose(0.0, 0.0, 0.0, 0.0, 10.0, 2.7, 0.1, pending[:1], 9, 0.01)
    assert angle == pytest.approx(0.1 * (1 - math.exp(-1)), rel=0.05)  # one time constant


@pytest.mark.parametrize(
    "values",
    [{"gain_per_s": 0.0}, {"latency_s": math.nan}, {"lookahead_m": -1.0}, {"horizon_s": 0.0}, {"jerk_weight_s3": 0.0}],
)
def test_settings_out_of_range_are_refused(values):
    with pytest.raises(InvalidParameter) as caught:
        SteeringSettings(**values)
    assert caught.value.field == f"settings.{next(iter(values))}"


def test_each_controller_has_settings():
    for law in Controller:
        assert SteeringSettings.suited_to(law).gain_per_s > 0
