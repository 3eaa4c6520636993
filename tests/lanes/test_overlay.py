"""A lane in a camera frame."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from app.errors import InvalidParameter
from app.geodesy import enu_from_heading
from app.lanes.overlay import (
    NEAR_M,
    VehiclePose,
    camera_from_ned,
    lane_in_frame,
    level_camera_from_ned,
    ned_from_enu,
    points_in_frame,
)
from app.sensors.camera import Camera
from app.simulation.plate_face import Face
from app.simulation.plate_scene import PlacedFace, PlateScene

LEVEL = Camera.from_field_of_view(1000, 800, 90.0, height_m=1.5, depression_deg=0.0)
HERE = VehiclePose((0.0, 0.0, 0.0), 0.0)
DISTORTED = Camera(
    1280, 720, 900.0, 910.0, 645.0, 352.0, (-0.25, 0.06, 0.001, -0.001),
    height_m=1.4, depression_deg=8.0, azimuth_deg=5.0, roll_deg=1.5, forward_m=1.9, left_m=-0.2,
)  # fmt: skip


def straight(first_m: float, last_m: float, east_m: float, count: int = 2) -> np.ndarray:
    """A line northward on the road."""
    return np.column_stack([np.linspace(first_m, last_m, count), np.full(count, east_m), np.zeros(count)])


def overlay(first_m: float, last_m: float, *, pose: VehiclePose = HERE, camera: Camera = LEVEL, count: int = 2):
    sides = (straight(first_m, last_m, east, count) for east in (-1.75, 1.75, 0.0))
    return lane_in_frame(*sides, pose=pose, camera=camera, far_m=1000.0)


@pytest.mark.parametrize("heading_deg", [0.0, 37.0, 90.0, 200.0, 359.0])
def test_equation_2_is_a_proper_rotation_to_right_down_ahead(heading_deg):
    turn = level_camera_from_ned(heading_deg)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1.0)
    theta = math.radians(heading_deg)
    ahead, right = (math.cos(theta), math.sin(theta), 0), (-math.sin(theta), math.cos(theta), 0)
    np.testing.assert_allclose(turn @ ahead, (0, 0, 1), atol=1e-12)
    np.testing.assert_allclose(turn @ right, (1, 0, 0), atol=1e-12)
    np.testing.assert_allclose(turn @ (0, 0, 1), (0, 1, 0), atol=1e-12)
    # and the same as the project's own rotation by a heading
    enu = enu_from_heading(heading_deg) @ (1.0, 2.0, 3.0)  # right, forward, up
    np.testing.assert_allclose(turn @ ned_from_enu(enu), (1.0, -3.0, 2.0), atol=1e-12)


def test_pixels_by_hand():
    # focal length 500 px, 1.5 m above the road: 10 m ahead is 500 * 1.5 / 10 = 75 px below the middle
    seen = points_in_frame([(10, 0, 0), (10, 2, 0), (10, -2, -1.5), (-10, 0, 0), (2, 50, 0)], HERE, LEVEL)
    expected = [(499.5, 474.5), (599.5, 474.5), (399.5, 399.5)]
    np.testing.assert_allclose(seen.points_px[:3], expected, atol=1e-9)
    assert np.isnan(seen.points_px[3:]).all()
    np.testing.assert_array_equal(seen.visible, [True, True, True, False, False])
    np.testing.assert_allclose(seen.ahead_m, [10, 10, 10, -10, 2])


def test_pose_and_mount_by_hand():
    # heading east, 100 m east of the origin, camera 2 m before and 0.5 m left of the reference point
    camera = Camera.from_field_of_view(1000, 800, 90.0, height_m=1.5, depression_deg=0.0, forward_m=2.0, left_m=0.5)
    pose = VehiclePose((20.0, 100.0, 5.0), 90.0)
    point = (20.0 + 0.5 - 2.0, 100.0 + 2.0 + 10.0, 5.0)  # 10 m ahead of the camera, 2 m right of it (south)
    np.testing.assert_allclose(camera_from_ned([point], pose, camera), [(2.0, 1.5, 10.0)], atol=1e-9)
    np.testing.assert_allclose(points_in_frame([point], pose, camera).points_px, [(599.5, 474.5)], atol=1e-9)


def test_images_are_those_of_the_simulated_camera():
    face = Face(0.3, np.full((3, 3, 3), 0.5, np.float32))
    heading_deg, at = 250.0, (12.0, -40.0, 3.0)
    scene = PlateScene(DISTORTED, (PlacedFace(face, 5.0),))
    rng = np.random.default_rng(3)
    ground = np.column_stack([rng.uniform(3, 60, 200), rng.uniform(-5, 5, 200), rng.uniform(0, 1, 200)])
    # the simulation's ground: ahead and left of the point below the camera
    vehicle = ground + np.array([DISTORTED.forward_m, DISTORTED.left_m, 0.0])
    enu = vehicle[:, [1, 0, 2]] * (-1, 1, 1) @ enu_from_heading(heading_deg).T
    seen = points_in_frame(ned_from_enu(enu) + at, VehiclePose(at, heading_deg), DISTORTED)
    simulated = scene.project(ground)
    assert seen.visible.sum() > 100
    np.testing.assert_allclose(seen.points_px[seen.visible], simulated[seen.visible], atol=1e-6)
    inside = ((simulated >= -0.5) & (simulated <= (1279.5, 719.5))).all(axis=1)
    np.testing.assert_array_equal(seen.visible, inside)


def test_a_segment_that_passes_the_camera_is_cut_not_dropped():
    # one segment from 50 m behind to 50 m ahead: both of its ends lie outside what is near the vehicle
    lane = overlay(-50.0, 50.0)
    assert np.isnan(lane.left.points.points_px[0]).all()
    (piece,) = lane.left.pieces_px
    # the lowest row looks 400 px down: at 1.5 m below the camera that is 500 * 1.5 / 400 = 1.875 m ahead
    np.testing.assert_allclose(piece[0], (499.5 - 500 * 1.75 / 1.875, 799.5), atol=1e-6)
    np.testing.assert_allclose(piece[-1], (499.5 - 500 * 1.75 / 50, 399.5 + 500 * 1.5 / 50), atol=1e-6)
    (piece,) = lane.centre.pieces_px
    np.testing.assert_allclose(piece[0], (499.5, 799.5), atol=1e-6)
    assert all((p >= -0.5 - 1e-6).all() and (p <= (999.5 + 1e-6, 799.5 + 1e-6)).all() for p in lane.area_px)


def test_area_is_what_the_picture_shows_of_the_lane():
    camera = Camera.from_field_of_view(1000, 800, 90.0, height_m=1.5, depression_deg=10.0)
    for first_m, last_m in ((-50.0, 50.0), (5.0, 20.0), (1.0, 300.0)):
        (area,) = overlay(first_m, last_m, camera=camera).area_px
        mask = cv2.fillPoly(np.zeros((800, 1000), np.uint8), [np.round(area).astype(np.int32)], 1)
        rows, cols = np.mgrid[0:800, 0:1000]
        rays = np.stack([(cols - 499.5) / 500, (rows - 399.5) / 500, np.ones((800, 1000))], axis=-1)
        rays = rays @ camera.camera_from_vehicle  # forward, left, up
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = 1.5 / -rays[..., 2]
            on_lane = (rays[..., 2] < 0) & (np.abs(rays[..., 1] * scale) < 1.75)
            on_lane &= (rays[..., 0] * scale > first_m) & (rays[..., 0] * scale < last_m)
        assert on_lane.sum() > 10_000
        assert (mask.astype(bool) != on_lane).sum() < 0.01 * on_lane.sum() + 1500  # borders


def test_nothing_of_a_lane_behind_is_seen():
    lane = overlay(-80.0, -1.0, count=30)
    assert lane.area_px == ()
    assert lane.left.pieces_px == lane.right.pieces_px == lane.centre.pieces_px == ()
    assert not lane.centre.points.visible.any()


def test_a_lane_across_the_view_leaves_the_frame_on_both_sides():
    points = np.column_stack([np.full(3, 10.0), (-200.0, 0.0, 200.0), np.zeros(3)])
    ahead = np.array([1.0, 0.0, 0.0])
    lane = lane_in_frame(points + 2 * ahead, points, points + ahead, pose=HERE, camera=LEVEL)
    (piece,) = lane.right.pieces_px
    assert (piece[0, 0], piece[-1, 0]) == pytest.approx((-0.5, 999.5))
    np.testing.assert_allclose(piece[:, 1], 474.5, atol=1e-9)
    (area,) = lane.area_px
    x, y = area.T
    assert abs(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) / 2 == pytest.approx(1000 * 750 * (1 / 10 - 1 / 12))


def test_boundaries_with_gaps_make_pieces():
    left, right, centre = (straight(5.0, 60.0, east, 12) for east in (-1.75, 1.75, 0.0))
    left[5:7] = np.nan
    lane = lane_in_frame(left, right, centre, pose=HERE, camera=LEVEL)
    assert (len(lane.left.pieces_px), len(lane.right.pieces_px), len(lane.area_px)) == (2, 1, 2)
    assert np.isnan(lane.left.points.points_px[5:7]).all()
    assert not lane.left.points.visible[5:7].any()


def test_the_far_part_is_left_out():
    sides = [straight(5.0, 500.0, east) for east in (-1.75, 1.75, 0.0)]
    lane = lane_in_frame(*sides, pose=HERE, camera=LEVEL, far_m=100.0)
    np.testing.assert_allclose(lane.centre.pieces_px[0][-1], (499.5, 399.5 + 500 * 1.5 / 100), atol=1e-6)


def test_a_lens_bends_straight_lines():
    for points in (2, 200):
        lane = overlay(1.0, 80.0, camera=DISTORTED, count=points)
        (piece,) = lane.right.pieces_px
        assert len(piece) > 15
        # each point of the piece, seen back through the lens, lies on the line on the road
        ideal = cv2.undistortPoints(piece[:, None], DISTORTED.matrix, np.array(DISTORTED.distortion))[:, 0]
        rays = np.column_stack([ideal, np.ones(len(ideal))]) @ DISTORTED.camera_from_vehicle
        road = rays * (-DISTORTED.height_m / rays[:, 2])[:, None] + (DISTORTED.forward_m, DISTORTED.left_m, 0)
        assert np.abs(road[:, 1] + 1.75).max() < 0.05  # the curve's chords, and undistortPoints' own error
        chord = piece[-1] - piece[0]
        away = np.abs(chord[0] * (piece - piece[0])[:, 1] - chord[1] * (piece - piece[0])[:, 0]) / np.hypot(*chord)
        assert away.max() > 1.5


def test_a_distorted_lane_from_behind_does_not_fold_into_the_picture():
    lane = overlay(-100.0, 100.0, camera=DISTORTED)
    for line in (lane.left, lane.right, lane.centre):
        assert len(line.pieces_px) == 1
        steps = np.diff(line.pieces_px[0][:, 1])
        assert (steps < 0).all()  # only upward


def test_a_distortion_that_folds_over_is_refused():
    camera = Camera(1280, 720, 500.0, 500.0, 640.0, 360.0, (-0.6, 0.0, 0.0, 0.0))
    with pytest.raises(InvalidParameter) as caught:
        overlay(1.0, 80.0, camera=camera)
    assert caught.value.field == "camera.distortion"


def test_markers_are_seen_one_by_one():
    sides = [straight(5.0, 50.0, east) for east in (-1.75, 1.75, 0.0)]
    lane = lane_in_frame(
        *sides, pose=HERE, camera=LEVEL, markers_ned_m=[(10, -2, 0), (-5, 2, 0), (NEAR_M / 2, 0, 0), (151, 0, 0)]
    )
    np.testing.assert_array_equal(lane.markers.visible, [True, False, False, False])
    assert lane_in_frame(*sides, pose=HERE, camera=LEVEL).markers.points_px.shape == (0, 2)


def test_bad_input_is_refused_by_name():
    sides = [straight(5.0, 50.0, east) for east in (-1.75, 1.75, 0.0)]
    for arguments, field in (
        ((sides[0][:, :2], sides[1], sides[2]), "points_ned_m"),
        ((sides[0], straight(5, 50, 1.75, 3), sides[2]), "right_ned_m"),
        ((np.where(sides[0] == 5, np.inf, sides[0]), sides[1], sides[2]), "points_ned_m"),
    ):
        with pytest.raises(InvalidParameter) as caught:
            lane_in_frame(*arguments, pose=HERE, camera=LEVEL)
        assert caught.value.field == field
    with pytest.raises(InvalidParameter, match="heading"):
        VehiclePose((0.0, 0.0, 0.0), math.nan)
    with pytest.raises(InvalidParameter, match="position"):
        VehiclePose((0.0, math.inf, 0.0), 0.0)
    with pytest.raises(InvalidParameter, match="far_m"):
        lane_in_frame(*sides, pose=HERE, camera=LEVEL, far_m=math.nan)
