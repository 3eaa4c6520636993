"""Drives, thermal frames, backgrounds, drawn conditions and distractors."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from app.errors import InvalidParameter
from app.markers.plate import PlateCode, PlateGeometry
from app.sensors.camera import Camera
from app.simulation.backgrounds import road_background
from app.simulation.camera import render_plate_scene
from app.simulation.conditions import Drive, draw_daylight, draw_stress, drive_over_plate
from app.simulation.plate_face import Face, PlateWear, plate_face
from app.simulation.plate_scene import PlacedFace, PlateScene, face_truth
from benchmarks.scenes.distractors import decoy_plate, draw_distractor_faces, paint_distractors
from benchmarks.scenes.places import draw_place, scene_under
from benchmarks.scenes.thermal import PlateWarmth, ThermalSensor, draw_thermal, render_thermal_scene, warm_face

CAMERA = Camera.from_field_of_view(1920, 1080, 70.0)
CODE = PlateCode("023792168411")
FACE = Face(0.325, np.full((325, 325, 3), 0.5, np.float32))


def test_drive_takes_a_frame_each_period_while_the_plate_is_in_view():
    drive = Drive(CAMERA, FACE, speed_m_s=10.0, fps=30.0, exposure_s=0.001, far_m=9.0, sway_deg=0.0)
    scenes = list(drive_over_plate(drive, np.random.default_rng(0)))
    ahead = np.array([s.faces[0].ahead_m for s in scenes])
    np.testing.assert_allclose(-np.diff(ahead), 10 / 30)
    assert 9.0 - 10 / 30 <= ahead[0] <= 9.0
    assert all(face_truth(s, s.faces[0]).in_view for s in scenes)
    # the near edge leaves the image at the depression of the lowest row
    lowest = math.radians(23) + math.atan(540 / (960 / math.tan(math.radians(35))))
    leaves = 1.57 / math.tan(lowest) + 0.1625
    assert leaves <= ahead[-1] < leaves + 10 / 30
    more = list(drive_over_plate(drive, np.random.default_rng(0), partly=True))
    assert len(more) > len(scenes)


def test_phase_of_a_drive_is_drawn():
    drive = Drive(CAMERA, FACE, speed_m_s=20.0, fps=30.0, exposure_s=0.001)
    starts = {next(drive_over_plate(drive, np.random.default_rng(k))).faces[0].ahead_m for k in range(5)}
    assert len(starts) == 5


def test_placed_faces_have_the_wanted_height():
    rng = np.random.default_rng(4)
    for _ in range(10):
        placed = draw_place(CAMERA, FACE, rng, (24.0, 60.0))
        truth = face_truth(PlateScene(CAMERA, (placed,)), placed)
        assert truth.in_view
        assert 23.9 <= truth.height_px <= 60.1


@pytest.mark.slow
def test_heights_that_a_camera_never_sees_are_refused():
    with pytest.raises(InvalidParameter, match="rows"):
        draw_place(CAMERA, FACE, np.random.default_rng(0), (900.0, 1000.0))


def test_thermal_frame_shows_dark_units_warm_in_one_channel():
    camera = Camera.from_field_of_view(640, 512, 45.0)
    face = warm_face(CODE, PlateGeometry(), PlateWarmth(), np.random.default_rng(0))
    sensor = ThermalSensor(blur_px=0.8, netd_k=0.0, road_k=0.01, span_k=25.0)
    scene = PlateScene(camera, (PlacedFace(face, 2.9),))
    frame = render_thermal_scene(scene, sensor, None, np.random.default_rng(0))
    assert frame.image.shape == (512, 640)
    plate = cv2.getPerspectiveTransform(
        np.array([(0, 0), (325, 0), (325, 325), (0, 325)], np.float32), frame.truths[0].corners_px.astype(np.float32)
    )

    def grey(x_mm: float, y_mm: float) -> float:
        x, y = cv2.perspectiveTransform(np.array([[[x_mm, y_mm]]], np.float32), plate)[0, 0]
        return float(frame.image[round(float(y)), round(float(x))])

    assert grey(22.5, 142.5) > 85 + 80  # 3 1 6 8: first unit of the third cell row is dark
    assert grey(285, 40) > 85 + 80  # marker
    assert grey(102.5, 22.5) < 85 + 60  # 0: light


def test_thermal_lag_draws_a_trail_behind():
    camera = Camera.from_field_of_view(640, 512, 45.0)
    hot = np.zeros((325, 325, 3), np.float32)
    face = Face(0.325, hot, hot + np.float32(10))
    sensor = ThermalSensor(lag_s=0.012, blur_px=0.5, netd_k=0.0, road_k=1e-4, span_k=25.0)
    still = PlateScene(camera, (PlacedFace(face, 2.9),))
    moving = PlateScene(camera, (PlacedFace(face, 2.9),), speed_m_s=10.0)
    rng = np.random.default_rng
    at_rest = render_thermal_scene(still, sensor, None, rng(0)).image.astype(float) - 85
    trailed = render_thermal_scene(moving, sensor, None, rng(0)).image.astype(float) - 85
    rows = np.arange(512)[:, None]
    mean_row = [(np.clip(i, 2, None) * rows).sum() / np.clip(i, 2, None).sum() for i in (at_rest, trailed)]
    assert mean_row[1] < mean_row[0] - 2  # it was farther away, so higher in the image
    low_edge = int(face_truth(still, still.faces[0]).corners_px[2, 1]) - 3
    assert trailed[low_edge, 320] < 0.8 * at_rest[low_edge, 320]


def test_road_background_fills_the_frame_with_the_photos_road():
    photo = np.zeros((720, 1280, 3), np.uint8)
    photo[:, :] = (90, 90, 90)
    photo[:421] = (230, 120, 40)  # sky down to the horizon
    view = road_background(photo, CAMERA, np.random.default_rng(0), grain=0.0)
    assert view.shape == (1080, 1920, 3)
    np.testing.assert_allclose(view[200:].mean(axis=(0, 1)), 90, atol=1)  # 23 degrees down there is road only
    level = Camera.from_field_of_view(1920, 1080, 70.0, depression_deg=0.0)
    view = road_background(photo, level, np.random.default_rng(0), grain=0.0)
    assert view[300, 960, 0] == pytest.approx(230, abs=3)
    assert view[800, 960, 0] == pytest.approx(90, abs=3)


def test_stress_scenes_render_and_keep_the_plate_in_view():
    rng = np.random.default_rng(8)
    for night in (False, True):
        conditions = draw_stress(rng, night=night)
        face = plate_face(CODE, PlateGeometry(), conditions.look, conditions.wear, rng)
        placed = draw_place(CAMERA, face, rng, (24.0, 100.0))
        extra = draw_distractor_faces(CAMERA, rng, 3, (placed,))
        photo = paint_distractors(np.full((1080, 1920, 3), 100, np.uint8), rng, 5)
        frame = render_plate_scene(scene_under(conditions, CAMERA, (placed, *extra), 15.0, rng), photo, rng)
        assert frame.truths[0].in_view
        x, y = frame.truths[0].corners_px.mean(axis=0).astype(int)
        assert frame.image[y - 8 : y + 8, x - 8 : x + 8].std() > 3


def test_conditions_are_drawn_from_the_seed_alone():
    assert draw_daylight(np.random.default_rng(3)) == draw_daylight(np.random.default_rng(3))
    assert draw_stress(np.random.default_rng(3)) == draw_stress(np.random.default_rng(3))
    assert draw_stress(np.random.default_rng(3)) != draw_stress(np.random.default_rng(4))
    assert draw_thermal(np.random.default_rng(3)) == draw_thermal(np.random.default_rng(3))


def test_distractors_stay_clear_of_the_plate_and_of_each_other():
    rng = np.random.default_rng(1)
    plate = PlacedFace(FACE, 3.0)
    placed = (plate, *draw_distractor_faces(CAMERA, rng, 6, (plate,)))
    for i, a in enumerate(placed):
        for b in placed[:i]:
            reach = math.hypot(a.ahead_m - b.ahead_m, a.left_m - b.left_m)
            assert reach > (a.face.side_m + b.face.side_m) / math.sqrt(2)  # circles around them don't meet


def test_no_decoy_has_a_plates_markers():
    rng = np.random.default_rng(5)
    for _ in range(20):
        face = decoy_plate(rng, PlateWear()).reflectance
        corners = [face[20, 20], face[20, -20], face[-20, -20], face[-20, 20]]
        red = [c[2] > 2 * max(c[0], c[1]) for c in corners]
        green = [c[1] > 1.3 * max(c[0], c[2]) for c in corners]
        assert not (sum(red) == 1 and sum(green) == 3)
