"""The simulated camera against geometry, light and noise worked out independently."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from app.errors import InvalidParameter
from app.markers.plate import PlateCode, PlateGeometry
from app.sensors.camera import Camera
from app.simulation.camera import render_plate_scene
from app.simulation.plate_face import Face, PlateLook, PlateWear, plate_face
from app.simulation.plate_scene import Air, Occluder, PlacedFace, PlateScene, Sensor, Shadow, face_truth

CAMERA = Camera.from_field_of_view(1920, 1080, 70.0)
CODE = PlateCode("023792168411")
# linear up to clipping after the inverse of the tone curve; no noise, no blur, no JPEG
IDEAL = Sensor(blur_px=0.0, full_well_e=1e12, read_noise_e=0.0, bayer=False, shoulder=1.0, gamma=2.2, jpeg_quality=None)
BLACK = np.zeros((1080, 1920, 3), np.uint8)


def white_face(side_m: float = 0.325) -> Face:
    """A square that shines by itself, so that the photo's light does not matter."""
    nothing = np.zeros((325, 325, 3), np.float32)
    return Face(side_m, nothing, nothing + np.float32(GLOW))


def linear(image: np.ndarray) -> np.ndarray:
    """Inverse of the sRGB curve, which the tone curve is at gamma 2.2."""
    v = image.astype(np.float64) / 255
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)


GLOW = float(linear(np.array([188]))[0])  # a grey level exactly, about half of saturation


def scene_of(face: Face, ahead_m: float = 3.0, left_m: float = 0.0, rotation_deg: float = 0.0, **kwargs) -> PlateScene:
    kwargs.setdefault("sensor", IDEAL)
    kwargs.setdefault("camera", CAMERA)
    return PlateScene(faces=(PlacedFace(face, ahead_m, left_m, rotation_deg),), **kwargs)


def render(scene: PlateScene, background: np.ndarray | None = BLACK, seed: int = 0):
    return render_plate_scene(scene, background, np.random.default_rng(seed))


def test_level_camera_projects_by_similar_triangles():
    camera = Camera.from_field_of_view(1000, 1000, 90.0, height_m=2.0, depression_deg=0.0)
    truth = face_truth(scene_of(white_face(1.0), 10.0, camera=camera), PlacedFace(white_face(1.0), 10.0))
    # f = 500 px; far edge 10.5 m, near edge 9.5 m, half a metre left and right, 2 m below
    expected = [
        (499.5 - 500 * 0.5 / 10.5, 499.5 + 500 * 2 / 10.5),
        (499.5 + 500 * 0.5 / 10.5, 499.5 + 500 * 2 / 10.5),
        (499.5 + 500 * 0.5 / 9.5, 499.5 + 500 * 2 / 9.5),
        (499.5 - 500 * 0.5 / 9.5, 499.5 + 500 * 2 / 9.5),
    ]
    np.testing.assert_allclose(truth.corners_px, expected, atol=1e-9)


def test_depression_moves_the_road_up_by_its_angle():
    for depression in (10.0, 23.0, 45.0):
        camera = Camera.from_field_of_view(1000, 1000, 90.0, height_m=1.5, depression_deg=depression)
        placed = PlacedFace(white_face(), 1.5 / math.tan(math.radians(depression)))  # where the axis meets the road
        centre = scene_of(white_face(), camera=camera).project(np.array([[placed.ahead_m, 0.0, 0.0]]))
        np.testing.assert_allclose(centre, [[499.5, 499.5]], atol=1e-9)


def test_azimuth_to_the_right_moves_the_plate_to_the_left():
    camera = Camera.from_field_of_view(1000, 1000, 90.0, depression_deg=0.0, azimuth_deg=15.0)
    centre = scene_of(white_face(), camera=camera).project(np.array([[10.0, 0.0, 0.0]]))
    assert centre[0, 0] == pytest.approx(499.5 - 500 * math.tan(math.radians(15)), abs=1e-9)


def test_rotation_turns_the_triangle_clockwise():
    face = white_face()
    ahead, right, back, left = (PlacedFace(face, 3.0, 0.0, a).corners_ground_m[0] for a in (0, 90, 180, 270))
    half = face.side_m / 2
    np.testing.assert_allclose(ahead, (3 + half, half, 0), atol=1e-12)  # top-left: ahead and left
    np.testing.assert_allclose(right, (3 + half, -half, 0), atol=1e-12)
    np.testing.assert_allclose(back, (3 - half, -half, 0), atol=1e-12)
    np.testing.assert_allclose(left, (3 - half, half, 0), atol=1e-12)


@pytest.mark.parametrize("rotation_deg", [0.0, 37.0, 200.0])
def test_truth_pose_projects_to_the_truth_corners(rotation_deg):
    camera = Camera.from_field_of_view(1920, 1080, 70.0, azimuth_deg=-15.0, roll_deg=2.0)
    scene = scene_of(white_face(), 4.0, 0.3, rotation_deg, camera=camera, body_deg=(0.5, -1.0, 2.0))
    truth = face_truth(scene, scene.faces[0])
    half = 0.1625
    corners = np.array([(-half, half, 0), (half, half, 0), (half, -half, 0), (-half, -half, 0)])
    rotation = cv2.Rodrigues(truth.camera_from_face)[0]
    projected = cv2.projectPoints(corners, rotation, truth.translation_m, camera.matrix, None)[0][:, 0]
    np.testing.assert_allclose(projected, truth.corners_px, atol=1e-6)
    assert truth.camera_position_m[2] == pytest.approx(camera.height_m)
    assert np.hypot(*truth.camera_position_m[:2]) == pytest.approx(math.hypot(4.0, 0.3))


@pytest.mark.parametrize(("ahead_m", "rotation_deg"), [(2.2, 0.0), (3.5, 30.0), (8.0, 0.0), (8.0, 45.0)])
def test_rendered_square_has_the_area_and_centroid_of_its_corners(ahead_m, rotation_deg):
    frame = render(scene_of(white_face(), ahead_m, 0.2, rotation_deg))
    share = linear(frame.image)[..., 1] / GLOW
    corners = frame.truths[0].corners_px
    x, y = corners[:, 0], corners[:, 1]
    cross = x * np.roll(y, -1) - np.roll(x, -1) * y
    area = cross.sum() / 2
    centroid_x = ((x + np.roll(x, -1)) * cross).sum() / (6 * area)
    centroid_y = ((y + np.roll(y, -1)) * cross).sum() / (6 * area)
    assert share.sum() == pytest.approx(abs(area), rel=0.006)
    rows, cols = np.mgrid[0:1080, 0:1920]
    assert (share * cols).sum() / share.sum() == pytest.approx(centroid_x, abs=0.03)
    assert (share * rows).sum() / share.sum() == pytest.approx(centroid_y, abs=0.03)


def test_edges_lie_where_the_corners_say():
    frame = render(scene_of(white_face(), 3.0))
    share = linear(frame.image)[..., 1] / GLOW
    left, right, bottom, _ = (frame.truths[0].corners_px[k] for k in (0, 1, 2, 3))
    middle = round((left[0] + right[0]) / 2)
    column = share[:, middle]
    assert column.sum() == pytest.approx(bottom[1] - left[1], abs=0.03)
    first = int(np.argmax(column > 0))
    assert first + 1 - column[first] - 0.5 == pytest.approx(left[1], abs=0.03)  # pixel i reaches from i - 0.5


def test_units_thinner_than_pixels_keep_their_mean():
    look = PlateLook(dark=(0.05,) * 3, light=(0.45,) * 3, gap=(0.1,) * 3)
    face = plate_face(CODE, PlateGeometry(), look, PlateWear(), np.random.default_rng(0))
    photo = np.full((1080, 1920, 3), 100, np.uint8)
    scene = scene_of(face, 9.0, road_reflectance=0.3)
    image = render(scene, photo).image
    truth = face_truth(scene, scene.faces[0])
    assert 1.0 < truth.height_px / 8 < 2.0  # rows a unit
    road = linear(np.array([100]))[0]
    x, y = truth.corners_px[:, 0], truth.corners_px[:, 1]
    area = abs((x * np.roll(y, -1) - np.roll(x, -1) * y).sum()) / 2
    mean = (linear(image) - linear(photo))[..., 1].sum() / area + road
    assert mean == pytest.approx(road / 0.3 * face.reflectance[..., 1].mean(), rel=0.01)


def test_motion_blur_is_as_long_as_the_way_in_the_image():
    speed, exposure = 20.0, 1 / 200
    scene = scene_of(white_face(), 3.0, speed_m_s=speed, exposure_s=exposure)
    frame = render(scene)
    column = linear(frame.image)[:, 960, 1] / GLOW
    rising = np.flatnonzero((column > 0.02) & (np.arange(1080) < 650))
    ramp = column[rising[0] : rising[0] + 200]
    top = int(np.argmax(ramp > 0.97))
    # independent: image row of a point on the road d ahead is c + f tan(atan(h / d) - depression)
    focal, tilt = 960 / math.tan(math.radians(35)), math.radians(23)

    def row(distance: float) -> float:
        return 539.5 + focal * math.tan(math.atan(1.57 / distance) - tilt)

    far = 3.0 + 0.1625
    expected = row(far - speed * exposure / 2) - row(far + speed * exposure / 2)
    assert expected > 15
    assert top == pytest.approx(0.95 * expected, abs=2.5)
    assert frame.truths[0].corners_px[0, 1] == pytest.approx(row(far), abs=0.01)


def test_rolling_shutter_moves_the_near_edge_later():
    sensor = Sensor(**{**_fields(IDEAL), "readout_s": 0.02})
    speed = 10.0
    still = face_truth(scene_of(white_face(), 2.0), PlacedFace(white_face(), 2.0))
    scene = scene_of(white_face(), 2.0, speed_m_s=speed, exposure_s=1e-6, sensor=sensor)
    moved = face_truth(scene, scene.faces[0])
    assert (moved.corners_px[2, 1] - still.corners_px[2, 1]) > 5  # low rows are exposed later, the plate came nearer
    share = linear(render(scene).image)[:, 960, 1] / GLOW
    assert share.sum() == pytest.approx(moved.corners_px[2, 1] - moved.corners_px[1, 1], abs=0.2)


def test_distorted_camera_renders_where_opencv_projects():
    camera = Camera(1280, 720, 900.0, 900.0, 640.0, 360.0, (-0.25, 0.06, 0.001, -0.001))
    scene = scene_of(white_face(), 3.2, 1.2, 20.0, camera=camera)
    frame = render(scene, np.zeros((720, 1280, 3), np.uint8))
    share = linear(frame.image)[..., 1] / GLOW
    rows, cols = np.mgrid[0:720, 0:1280]
    truth = frame.truths[0]
    centre = cv2.projectPoints(
        np.zeros((1, 3)), cv2.Rodrigues(truth.camera_from_face)[0], truth.translation_m, camera.matrix,
        np.array(camera.distortion),
    )[0].ravel()  # fmt: skip
    assert (share * cols).sum() / share.sum() == pytest.approx(centre[0], abs=1.0)
    assert (share * rows).sum() / share.sum() == pytest.approx(centre[1], abs=1.5)
    x, y = truth.corners_px[:, 0], truth.corners_px[:, 1]
    assert share.sum() == pytest.approx(abs((x * np.roll(y, -1) - np.roll(x, -1) * y).sum()) / 2, rel=0.02)


def test_noise_is_that_of_the_electrons():
    sensor = Sensor(**{**_fields(IDEAL), "full_well_e": 2000.0, "read_noise_e": 5.0})
    photo = np.full((1080, 1920, 3), 120, np.uint8)
    grey = np.zeros((325, 325, 3), np.float32)
    face = Face(0.6, grey, grey + np.float32(0.4))
    image = render(scene_of(face, 2.2, sensor=sensor), photo).image
    truth = face_truth(scene_of(face, 2.2), PlacedFace(face, 2.2))
    inside = cv2.fillConvexPoly(np.zeros((1080, 1920), np.uint8), np.round(truth.corners_px).astype(np.int32), 1)
    inside = cv2.erode(inside, np.ones((9, 9), np.uint8)).astype(bool)
    on_plate = linear(image)[inside]
    assert on_plate.mean() == pytest.approx(0.4, abs=0.003)
    assert on_plate.std() == pytest.approx(math.sqrt(0.4 * 2000 + 25) / 2000, rel=0.06)
    dark = render(scene_of(Face(0.6, grey), 2.2, sensor=sensor)).image[inside]
    assert (dark > 0).mean() == pytest.approx(0.5, abs=0.2)  # read noise alone, half of it below zero
    on_road = linear(image[:200])
    level = linear(np.array([120]))[0]
    assert on_road.mean() == pytest.approx(level, abs=0.003)
    assert on_road.std() == pytest.approx(math.sqrt(level * 2000 + 25) / 2000, rel=0.06)


def test_colour_mosaic_keeps_colours_of_even_areas():
    colour = np.zeros((325, 325, 3), np.float32) + np.array([0.1, 0.3, 0.6], np.float32)
    face = Face(0.6, np.zeros_like(colour), colour)
    sensor = Sensor(**{**_fields(IDEAL), "bayer": True})
    frame = render(scene_of(face, 2.2, sensor=sensor))
    x, y = frame.truths[0].corners_px.mean(axis=0).astype(int)
    np.testing.assert_allclose(linear(frame.image[y, x]), (0.1, 0.3, 0.6), atol=0.006)


def test_white_balance_haze_and_gain_act_in_linear_light():
    air = Air(haze=0.25, airlight=0.8)
    sensor = Sensor(**{**_fields(IDEAL), "white_balance": (1.2, 1.0, 0.8), "gain": 0.5})
    frame = render(scene_of(white_face(0.6), 2.2, air=air, sensor=sensor))
    x, y = frame.truths[0].corners_px.mean(axis=0).astype(int)
    seen = (GLOW * 0.75 + 0.8 * 0.25) * 0.5
    np.testing.assert_allclose(linear(frame.image[y, x]), (seen * 1.2, seen, seen * 0.8), rtol=0.03)
    np.testing.assert_allclose(linear(frame.image[5, 5]), np.array((1.2, 1.0, 0.8)) * 0.1, rtol=0.05)


def test_a_shadow_falls_on_plate_and_road_alike():
    shadow = Shadow(edge_light=0.4, edge_angle_deg=90.0, penumbra_m=0.005)  # the right half lies in shadow
    photo = np.full((1080, 1920, 3), 100, np.uint8)
    face = Face(0.6, np.full((325, 325, 3), 0.5, np.float32))
    frame = render(scene_of(face, 2.2, shadow=shadow), photo)
    image, corners = linear(frame.image)[..., 1], frame.truths[0].corners_px
    x, y = corners.mean(axis=0).astype(int)
    beside = round(corners[1:3, 0].mean() - x) + 5  # road next to the plate, painted together with it
    for away in (60, beside, 500):
        assert image[y, x + away] / image[y, x - away] == pytest.approx(0.4, abs=0.03)


def test_an_occluder_hides_its_share():
    frame = render(scene_of(white_face(), 3.0, occluder=Occluder(0.0, 0.5, 0.0, 0.1)))
    share = linear(frame.image)[..., 1] / GLOW
    whole = linear(render(scene_of(white_face(), 3.0)).image)[..., 1] / GLOW
    assert share.sum() == pytest.approx(whole.sum() / 2, rel=0.02)


@pytest.mark.slow
def test_plates_whose_windows_overlap_are_all_there():
    places = [(i, j) for i in range(5) for j in range(5) if (i + j) % 2 == 0]
    np.random.default_rng(0).shuffle(places)
    faces = tuple(PlacedFace(white_face(), 2.8 + 0.25 * i, 0.25 * j, 45.0) for i, j in places)  # diamonds, interleaved
    total = linear(render(PlateScene(CAMERA, faces, sensor=IDEAL)).image)[..., 1].sum()
    alone = sum(linear(render(PlateScene(CAMERA, (face,), sensor=IDEAL)).image)[..., 1].sum() for face in faces)
    assert total == pytest.approx(alone, rel=0.002)


def test_same_seed_same_frame_and_no_global_random_state():
    face = plate_face(CODE, PlateGeometry(), PlateLook(), PlateWear(0.1, 0.5, 60, 3, 15), np.random.default_rng(5))
    again = plate_face(CODE, PlateGeometry(), PlateLook(), PlateWear(0.1, 0.5, 60, 3, 15), np.random.default_rng(5))
    np.testing.assert_array_equal(face.reflectance, again.reflectance)
    scene = scene_of(face, 3.0, sensor=Sensor(), shadow=Shadow(dapple_light=0.4))
    np.random.seed(1)  # noqa: NPY002
    cv2.setRNGSeed(1)
    state = np.random.get_state()[1].copy()  # noqa: NPY002
    first = render(scene, seed=3)
    np.testing.assert_array_equal(np.random.get_state()[1], state)  # noqa: NPY002
    np.random.seed(2)  # noqa: NPY002
    cv2.setRNGSeed(2)
    assert render(scene, seed=3).jpeg == first.jpeg
    assert render(scene, seed=4).jpeg != first.jpeg


def test_jpeg_bytes_are_the_frame():
    frame = render(scene_of(white_face(), 3.0, sensor=Sensor(jpeg_quality=90)))
    np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(frame.jpeg, np.uint8), cv2.IMREAD_COLOR), frame.image)
    assert b"\x11\x22\x00" in frame.jpeg[:700].replace(b"\x01\x22\x00", b"\x11\x22\x00")  # luma sampled 2 x 2


def test_photo_of_another_size_is_refused():
    with pytest.raises(InvalidParameter, match="photo"):
        render(scene_of(white_face()), np.zeros((720, 1280, 3), np.uint8))


def _fields(sensor: Sensor) -> dict[str, object]:
    return {name: getattr(sensor, name) for name in Sensor.__slots__}
