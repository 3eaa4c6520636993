"""Where plate, camera and vehicle are: against geometry worked out apart from the decoder's."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from app.decoders.plate.pose import VehicleFix, camera_position_m, fix_vehicle, locate_plate
from app.decoders.plate.reader import decode_plates
from app.markers.plate import PlateGeometry
from app.markers.reading import PlatePose, PlateReading
from app.sensors.camera import Camera
from app.simulation.camera import RenderedFrame
from app.simulation.plate_scene import PlacedFace
from tests.decoders.plate.scenes import CAMERA, PAPER, face_of, shoot

PLATE_LON_DEG, PLATE_LAT_DEG, PLATE_HEIGHT_M = 114.1793123, 22.3045678, 61.25
NOTHING = np.zeros((6, 6))


def metres_from_plate(lon_deg: float, lat_deg: float) -> tuple[float, float]:
    """East and north by the ellipsoid's radii of curvature at the plate (WGS 84)."""
    a, e2 = 6378137.0, 0.00669437999014
    s = math.sin(math.radians(PLATE_LAT_DEG))
    meridian = a * (1 - e2) / (1 - e2 * s * s) ** 1.5
    normal = a / math.sqrt(1 - e2 * s * s)
    east = math.radians(lon_deg - PLATE_LON_DEG) * normal * math.cos(math.radians(PLATE_LAT_DEG))
    return east, math.radians(lat_deg - PLATE_LAT_DEG) * meridian


def seen_from(camera: Camera, east_m: float, north_m: float, vehicle_deg: float, plate_deg: float) -> PlatePose:
    """Pose of a plate at the origin from a vehicle whose reference point is at east, north; by its axes in ENU."""

    def level(heading_deg: float) -> tuple[np.ndarray, np.ndarray]:
        h = math.radians(heading_deg)
        return np.array([math.sin(h), math.cos(h), 0]), np.array([math.cos(h), -math.sin(h), 0])  # ahead, right

    up = np.array([0, 0, 1.0])
    ahead, right = level(vehicle_deg)
    optical_centre = np.array([east_m, north_m, 0]) + camera.forward_m * ahead - camera.left_m * right
    optical_centre = optical_centre + camera.height_m * up
    ahead, right = level(vehicle_deg + camera.azimuth_deg)
    dip, roll = math.radians(camera.depression_deg), math.radians(camera.roll_deg)
    axis = math.cos(dip) * ahead - math.sin(dip) * up
    down = np.cross(axis, right)
    x = math.cos(roll) * right + math.sin(roll) * down  # a camera rolled clockwise has its right side low
    camera_from_enu = np.array([x, np.cross(axis, x), axis])
    travel, plate_right = level(plate_deg)
    rotation = camera_from_enu @ np.column_stack([plate_right, travel, up])
    return PlatePose(rotation, camera_from_enu @ -optical_centre, NOTHING, 0.0)


def fix(
    pose: PlatePose, camera: Camera, plate_deg: float, *, rmse: tuple[float, float, float] = (0, 0, 0)
) -> VehicleFix:
    return fix_vehicle(
        pose, camera, lon_deg=PLATE_LON_DEG, lat_deg=PLATE_LAT_DEG, height_m=PLATE_HEIGHT_M, heading_deg=plate_deg,
        horizontal_rmse_m=rmse[0], vertical_rmse_m=rmse[1], heading_rmse_deg=rmse[2],
    )  # fmt: skip


@pytest.mark.parametrize("plate_deg", [0.0, 123.0, 271.5])
@pytest.mark.parametrize(
    ("vehicle_deg", "azimuth_deg", "roll_deg", "lever_m"),
    [
        (0.0, 0.0, 0.0, (0.0, 0.0)),
        (90.0, 30.0, 0.0, (1.8, 0.0)),
        (200.0, -75.0, 2.0, (0.4, 0.9)),
        (359.5, 180.0, -3.0, (-2.5, -0.6)),
    ],
)
def test_a_vehicle_is_fixed_where_it_stands(
    plate_deg: float, vehicle_deg: float, azimuth_deg: float, roll_deg: float, lever_m: tuple[float, float]
) -> None:
    camera = replace(
        CAMERA, azimuth_deg=azimuth_deg, roll_deg=roll_deg, forward_m=lever_m[0], left_m=lever_m[1], height_m=1.4
    )
    found = fix(seen_from(camera, -3.2, 1.7, vehicle_deg, plate_deg), camera, plate_deg)
    assert metres_from_plate(found.lon_deg, found.lat_deg) == pytest.approx((-3.2, 1.7), abs=1e-4)
    assert found.height_m == pytest.approx(PLATE_HEIGHT_M, abs=1e-5)  # the road lies level
    assert math.remainder(found.heading_deg - vehicle_deg, 360) == pytest.approx(0, abs=1e-9)
    assert 0 <= found.heading_deg <= 360


def test_the_surveys_errors_reach_the_vehicle() -> None:
    camera = replace(CAMERA, forward_m=1.0)
    pose = seen_from(camera, 1.5, -4.0, 0.0, 30.0)
    by_place = fix(pose, camera, 30.0, rmse=(0.02, 0.05, 0)).covariance
    np.testing.assert_allclose(by_place, np.diag([0.0002, 0.0002, 0.0025, 0]), atol=1e-12)
    # the plate's heading turns the vehicle about the plate: 4 m away, a degree is 7 cm across and a degree of heading
    by_turn = fix(pose, camera, 30.0, rmse=(0, 0, 1.0)).covariance
    turned = fix(pose, camera, 31.0)
    east, north = metres_from_plate(turned.lon_deg, turned.lat_deg)
    moved = np.array([east - 1.5, north + 4.0, 0, math.radians(turned.heading_deg)])
    assert abs(moved[0]) == pytest.approx(0.0698, abs=4e-4)
    np.testing.assert_allclose(by_turn, np.outer(moved, moved), atol=8e-5)  # a degree is not quite small


@pytest.mark.slow
def test_the_poses_errors_reach_the_vehicle() -> None:
    camera = replace(CAMERA, height_m=1.5)
    pose = seen_from(camera, 1.0, -3.0, 40.0, 10.0)
    by_shift = replace(pose, covariance=np.diag([0, 0, 0, 1e-4, 1e-4, 1e-4]))
    np.testing.assert_allclose(
        fix(by_shift, camera, 10.0).covariance, np.diag([1e-4, 1e-4, 1e-4, 0]), atol=1e-9
    )  # the same in every direction stays so
    rng = np.random.default_rng(0)
    spread = np.array([2e-3, 1e-3, 3e-3, 4e-3, 5e-3, 8e-3])
    states = []
    for sample in rng.standard_normal((1500, 6)) * spread:
        rotation = cv2.Rodrigues(sample[:3])[0] @ pose.rotation
        found = fix(replace(pose, rotation=rotation, translation_m=pose.translation_m + sample[3:]), camera, 10.0)
        place = metres_from_plate(found.lon_deg, found.lat_deg)
        states.append([*place, found.height_m - PLATE_HEIGHT_M, math.radians(found.heading_deg)])
    stated = fix(replace(pose, covariance=np.diag(spread**2)), camera, 10.0).covariance
    whiten = np.linalg.inv(np.linalg.cholesky(stated))
    np.testing.assert_allclose(whiten @ np.cov(np.array(states).T) @ whiten.T, np.eye(4), atol=0.15)


@pytest.mark.parametrize("distortion", [(), (-0.3, 0.1, 0.001, -0.001)])
@pytest.mark.parametrize("turn_deg", [0.0, 100.0, 250.0])
def test_exact_corners_give_the_pose_back(turn_deg: float, distortion: tuple[float, ...]) -> None:
    camera, geometry = replace(CAMERA, distortion=distortion), PlateGeometry(10)
    truth = seen_from(camera, -0.4, -2.8, 0.0, turn_deg)
    corners_m = np.column_stack([geometry.corners_mm / 1000, np.zeros(4)]) @ truth.rotation.T + truth.translation_m
    coefficients = np.array(distortion or (0.0,) * 4)
    corners_px = cv2.projectPoints(corners_m, np.zeros(3), np.zeros(3), camera.matrix, coefficients)[0][:, 0]
    pose = locate_plate(corners_px, 0.01 * np.eye(8), geometry, camera)
    assert pose is not None
    np.testing.assert_allclose(pose.rotation, truth.rotation, atol=1e-5)
    np.testing.assert_allclose(pose.translation_m, truth.translation_m, atol=1e-4)
    assert pose.reprojection_rms_px < 1e-2
    np.testing.assert_allclose(pose.covariance, pose.covariance.T, atol=1e-12)
    assert np.linalg.eigvalsh(pose.covariance).min() > 0


def test_corners_of_no_square_widen_the_covariance() -> None:
    truth = seen_from(CAMERA, -0.4, -2.8, 0.0, 0.0)
    geometry = PlateGeometry()
    corners_m = np.column_stack([geometry.corners_mm / 1000, np.zeros(4)]) @ truth.rotation.T + truth.translation_m
    corners_px = cv2.projectPoints(corners_m, np.zeros(3), np.zeros(3), CAMERA.matrix, np.zeros(4))[0][:, 0]
    warped_px = corners_px + np.array([(1.5, 0), (-1.5, 0), (1.5, 0), (-1.5, 0)])
    square, warped = (locate_plate(seen_px, 0.01 * np.eye(8), geometry, CAMERA) for seen_px in (corners_px, warped_px))
    assert square is not None
    assert warped is not None
    assert np.linalg.norm(camera_position_m(warped) - camera_position_m(square)) > 0.003
    wider = np.sqrt(np.trace(warped.covariance) / np.trace(square.covariance))
    assert wider > 5  # residuals of 15 standard deviations


# --- from frames ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def seen() -> list[tuple[PlateReading, RenderedFrame]]:
    """Clean frames of a plate at drawn places and turns."""
    pairs = []
    for seed in range(24):
        rng = np.random.default_rng(seed)
        place = float(rng.uniform(2.0, 3.2)), float(rng.uniform(-0.5, 0.5)), float(rng.uniform(0, 360))
        frame = shoot(PlacedFace(face_of(), *place), seed=seed)
        read = [reading for reading in decode_plates(frame.image, camera=CAMERA) if reading.code]
        assert [reading.digits for reading in read] == [PAPER.digits]
        pairs.append((read[0], frame))
    return pairs


@pytest.mark.slow
def test_the_camera_is_placed_within_centimetres(seen: list[tuple[PlateReading, RenderedFrame]]) -> None:
    errors_m = [
        np.linalg.norm(camera_position_m(r.pose) - f.truths[0].camera_position_m) for r, f in seen if r.pose is not None
    ]
    assert len(errors_m) == len(seen)
    assert np.median(errors_m) < 0.012
    assert max(errors_m) < 0.03


def test_corners_err_as_much_as_they_say(seen: list[tuple[PlateReading, RenderedFrame]]) -> None:
    normalized = []
    for reading, frame in seen:
        assert reading.corners_px is not None
        assert reading.corners_covariance_px2 is not None
        error = (reading.corners_px - frame.truths[0].corners_px).ravel()
        normalized.append(error @ np.linalg.solve(reading.corners_covariance_px2, error) / 8)
    assert 0.15 < np.median(normalized) < 3  # 0.92 if the covariance were exact
    assert max(normalized) < 8


def test_positions_err_no_more_than_they_say(seen: list[tuple[PlateReading, RenderedFrame]]) -> None:
    normalized = []
    for reading, frame in seen:
        assert reading.pose is not None
        error = reading.pose.translation_m - frame.truths[0].translation_m
        normalized.append(error @ np.linalg.solve(reading.pose.covariance[3:, 3:], error) / 3)
    assert np.median(normalized) < 2
    assert max(normalized) < 6


@pytest.mark.parametrize(
    ("vehicle_deg", "azimuth_deg", "lever_m"),
    [(15.0, 0.0, (0.0, 0.0)), (100.0, 12.0, (1.5, 0.3)), (190.0, -12.0, (0.8, -0.4)), (285.0, 5.0, (-1.0, 0.0))],
)
def test_a_frame_fixes_its_vehicle(vehicle_deg: float, azimuth_deg: float, lever_m: tuple[float, float]) -> None:
    camera = replace(CAMERA, azimuth_deg=azimuth_deg, forward_m=lever_m[0], left_m=lever_m[1])
    plate_deg = 40.0
    ahead_m, left_m = 2.6, 0.15  # of the camera
    frame = shoot(PlacedFace(face_of(), ahead_m, left_m, plate_deg - vehicle_deg), camera=camera)
    reading = decode_plates(frame.image, camera=camera)[0]
    assert reading.pose is not None
    found = fix(reading.pose, camera, plate_deg, rmse=(0.02, 0.03, 0.2))
    h = math.radians(vehicle_deg)
    ahead, left = np.array([math.sin(h), math.cos(h)]), np.array([-math.cos(h), math.sin(h)])
    vehicle_enu_m = -(ahead_m + lever_m[0]) * ahead - (left_m + lever_m[1]) * left
    found_m = np.array(metres_from_plate(found.lon_deg, found.lat_deg))
    assert np.linalg.norm(found_m - vehicle_enu_m) < 0.04
    assert abs(found.height_m - PLATE_HEIGHT_M) < 0.03
    assert abs(math.remainder(found.heading_deg - vehicle_deg, 360)) < 0.7
    error = np.array(
        [*(found_m - vehicle_enu_m), found.height_m - PLATE_HEIGHT_M,
         math.radians(math.remainder(found.heading_deg - vehicle_deg, 360))]
    )  # fmt: skip
    assert error @ np.linalg.solve(found.covariance, error) / 4 < 4
