"""Photos of a board through a known camera: the camera comes back, and every trap has its name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from app.calibration.board_view import CalibrationRules, CameraCalibration, Photo, ViewFault, find_board
from app.calibration.calibrate import calibrate_camera, is_invertible
from app.errors import CalibrationRefused, InvalidParameter
from app.sensors.camera import CalibrationBoard
from tests.api.fleet.board_photos import BOARD, Pose, TrueCamera, good_photos, photo, poses, true_corners_px

pytestmark = pytest.mark.slow

CAMERA = TrueCamera()
ROOT = Path(__file__).resolve().parents[2]
Grey = npt.NDArray[np.uint8]


def seen(photos: Sequence[Grey], board: CalibrationBoard = BOARD) -> list[Photo]:
    """Photos with what they show of the board."""
    return [Photo(f"{k}.jpg", grey.shape[::-1], 1, find_board(grey, board)) for k, grey in enumerate(photos)]


@pytest.fixture(scope="module")
def views() -> list[Photo]:
    return seen(good_photos())


def calibrated(photos: Sequence[Photo], **more: object) -> CameraCalibration:
    return calibrate_camera(photos, BOARD, **more)  # type: ignore[arg-type]


def refused(photos: Sequence[Photo], reason: str, **more: object) -> CalibrationRefused:
    with pytest.raises(CalibrationRefused) as caught:
        calibrated(photos, **more)
    assert caught.value.message.startswith(f"{reason}: "), caught.value.message
    assert caught.value.limit
    assert caught.value.cure
    return caught.value


# --- the camera comes back ----------------------------------------------------------------------------------------


def test_the_camera_comes_back(views: list[Photo]) -> None:
    found = calibrated(views)
    assert found.camera.fx_px == pytest.approx(CAMERA.fx_px, rel=0.003)
    assert found.camera.fy_px == pytest.approx(CAMERA.fy_px, rel=0.003)
    assert found.rms_px < 0.3
    for name in ("fx_px", "fy_px", "cx_px", "cy_px"):
        off = abs(getattr(found.camera, name) - getattr(CAMERA, name))
        assert 0 < getattr(found.sigma, name) < 1.5
        assert off < 5 * getattr(found.sigma, name), name
    assert (found.camera.width_px, found.camera.height_px) == (960, 720)
    assert len(found.camera.distortion) == len(found.sigma.distortion) == 4, "k3 is not in these photos"
    assert found.camera.distortion[0] == pytest.approx(-0.21, abs=0.01)
    assert found.coverage.share > 0.9
    assert found.tilt_spread_deg > 45
    assert all(view.used for view in found.views)
    # where the pixels go is what counts: within a pixel all over the image
    edge = np.array([(x, y) for x in (0.0, 480, 959) for y in (0.0, 360, 719)]).reshape(-1, 1, 2)
    rays = cv2.undistortPoints(edge, CAMERA.matrix, np.array(CAMERA.distortion))
    camera = found.camera
    matrix = np.array([[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1]])
    points = np.concatenate([rays.reshape(-1, 2), np.ones((9, 1))], axis=1)
    back, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(camera.distortion))
    assert np.abs(back - edge).max() < 1.0


def test_corners_are_found_to_a_fraction_of_a_pixel(views: list[Photo]) -> None:
    errors = []
    for view, pose in zip(views, poses(14), strict=True):
        truth = true_corners_px(CAMERA, pose)[view.view.corner]
        errors.append(np.linalg.norm(view.view.corners_px - truth, axis=1))
    assert float(np.median(np.concatenate(errors))) < 0.1
    assert float(np.sqrt(np.mean(np.concatenate(errors) ** 2))) < 0.25


def test_further_coefficients_are_there_where_they_show_or_are_asked_for(views: list[Photo]) -> None:
    assert len(calibrated(views, coefficients=5).camera.distortion) == 5
    assert len(calibrated(views, coefficients=8).camera.distortion) == 8
    with pytest.raises(InvalidParameter):
        calibrated(views, coefficients=6)
    bent = TrueCamera(distortion=(-0.30, 0.18, 0.0, 0.0, -0.06))
    shown = []
    for view, pose in zip(views, poses(14), strict=True):
        noise = np.random.default_rng(1).normal(0, 0.02, (len(view.view.corner), 2))
        corners = true_corners_px(bent, pose)[view.view.corner] + noise
        shown.append(replace(view, view=replace(view.view, corners_px=corners)))
    found = calibrated(shown)
    assert len(found.camera.distortion) == 5
    assert found.camera.distortion[4] == pytest.approx(-0.06, abs=5 * found.sigma.distortion[4])


# --- views that are left out --------------------------------------------------------------------------------------


def _fault(grey: Grey, board: CalibrationBoard = BOARD) -> ViewFault | None:
    view = find_board(grey, board)
    assert (view.fault is None) == (view.detail == "")
    return view.fault


def test_traps_are_left_out_by_name() -> None:
    grey, pose = good_photos()[0], poses(14)[0]
    assert _fault(grey) is None
    assert _fault(grey[:, ::-1].copy()) is ViewFault.MIRRORED
    assert _fault(grey[::-1].copy()) is ViewFault.MIRRORED
    assert _fault(cv2.rotate(grey, cv2.ROTATE_180)) is None
    assert _fault(np.full((480, 640), 90, np.uint8)) is ViewFault.NO_BOARD
    road = cv2.imread(str(ROOT / "docs/images/frame.jpg"), cv2.IMREAD_GRAYSCALE)
    assert _fault(np.asarray(road, np.uint8)) is ViewFault.NO_BOARD
    assert _fault(np.random.default_rng(1).integers(0, 255, (480, 640), dtype=np.uint8)) is ViewFault.NO_BOARD
    for size in ((1, 1), (2, 3000), (1, 60_000)):
        assert _fault(np.zeros(size, np.uint8)) is ViewFault.NO_BOARD
    assert _fault(photo(CAMERA, pose, blur_px=4.0)) is ViewFault.BLURRED
    assert _fault(np.asarray(cv2.resize(grey, (4000, 3000), interpolation=cv2.INTER_CUBIC), np.uint8)) is None
    moving = np.zeros((1, 15), np.float32)
    moving[:] = 1 / 15
    assert _fault(cv2.filter2D(grey, -1, moving)) is ViewFault.BLURRED
    hidden = np.full_like(grey, 90)
    hidden[260:460, 370:590] = grey[260:460, 370:590]
    assert _fault(hidden) is ViewFault.TOO_FEW_CORNERS


@pytest.mark.parametrize("other", [CalibrationBoard(8, 9, 25, 18), CalibrationBoard(6, 9, 25, 18)], ids=str)
def test_another_board_is_named(other: CalibrationBoard) -> None:
    grey = photo(CAMERA, Pose(pitch=10, fill=0.8), board=other)
    assert _fault(grey, other) is None
    assert _fault(grey) is ViewFault.WRONG_BOARD


def test_a_board_of_another_dictionary_is_named() -> None:
    theirs = cv2.aruco.CharucoBoard((7, 10), 25, 18, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_6X6_250))
    assert _fault(theirs.generateImage((700, 1000), marginSize=20)) is ViewFault.WRONG_BOARD


def test_other_sizes_twins_and_misfits_are_left_out(views: list[Photo]) -> None:
    small = Photo("small", (480, 360), 1, views[0].view)
    turned = Photo("turned", (960, 720), 3, views[1].view)
    shifted = replace(views[2].view, corners_px=views[2].view.corners_px + 0.3)
    bent = views[3].view.corners_px.copy()
    bent[:, 1] += 6 * np.sin(bent[:, 0] / 60)  # a board that was not flat
    misfit = Photo("bent", (960, 720), 1, replace(views[3].view, corners_px=bent))
    photos = [views[0], small, *views[1:3], turned, Photo("twin", (960, 720), 1, shifted), misfit, *views[4:]]
    found = calibrated(photos)
    faults = {view.name: view.reason for view in found.views if not view.used}
    assert faults == {
        "small": ViewFault.OTHER_SIZE,
        "turned": ViewFault.OTHER_SIZE,
        "twin": ViewFault.ALIKE,
        "bent": ViewFault.DOES_NOT_FIT,
    }
    assert "960 x 720" in next(view.detail or "" for view in found.views if view.name == "small")
    assert "photo 3" in next(view.detail or "" for view in found.views if view.name == "twin")
    assert found.camera.fx_px == pytest.approx(CAMERA.fx_px, rel=0.003)
    assert found.rms_px < 0.3


# --- what is not good enough --------------------------------------------------------------------------------------


def test_too_few_views_are_refused(views: list[Photo]) -> None:
    refused([], "too-few-views")
    error = refused([*views[:4], *seen([np.full((720, 960), 90, np.uint8)] * 4)], "too-few-views")
    assert "4 of 8" in error.message
    assert [part.field for part in error.parts] == [f"photos.{k}" for k in range(4, 8)]
    assert all(part.message.startswith("no-board: ") for part in error.parts)


def test_views_that_are_all_alike_are_refused(views: list[Photo]) -> None:
    refused([views[0]] * 10, "views-alike")
    held = [
        (0, 0, 0.8),
        (0.3, 0, 0.7),
        (-0.3, 0, 0.7),
        (0.2, 0.3, 0.6),
        (-0.2, -0.3, 0.6),
        (0.4, 0.2, 0.5),
        (0, 0.2, 0.5),
    ]
    flat = [photo(CAMERA, Pose(right=x, down=y, fill=fill)) for x, y, fill in held]
    error = refused(seen(flat), "views-alike")
    assert "tilt" in str(error.cure)


def test_a_corner_of_the_image_alone_is_refused(views: list[Photo]) -> None:
    crammed = []
    for k, pose in enumerate(poses(10)):
        held = replace(pose, right=-0.6 + 0.03 * (k % 3), down=-0.55 + 0.03 * (k % 4), fill=0.35)
        crammed.append(photo(CAMERA, held, seed=k))
    refused(seen(crammed), "poor-coverage")


def test_other_limits_are_named(views: list[Photo]) -> None:
    refused(views, "high-error", rules=CalibrationRules(max_rms_px=0.01))
    refused(views, "unsure-focal-length", rules=CalibrationRules(max_focal_share=1e-6))


@pytest.mark.parametrize(("k1", "good"), [(-0.2, True), (0.3, True), (-1.2, False)])
def test_a_distortion_that_turns_back_within_the_image_is_none(views: list[Photo], k1: float, good: bool) -> None:
    camera = replace(calibrated(views).camera, distortion=(k1, 0.0, 0.0, 0.0))
    assert is_invertible(camera) is good
