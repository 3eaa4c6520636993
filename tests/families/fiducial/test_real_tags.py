"""Photos of real AprilTags, and the images that their authors publish: so many at least are read, and none wrongly."""

from __future__ import annotations

import ast
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from app.decoders.fiducial import FiducialOutcome, decode_fiducials
from app.encoders.fiducial import FiducialOrder, encode_fiducial, prove_fiducial
from app.encoders.plate.proof import render_face
from app.markers.fiducial import FiducialCode, FiducialGeometry, KnownFiducial, Mounting, SignImage
from app.sensors.camera import Camera
from app.values import Floats
from tests.families.fiducial.scene import lying_axes, render_sign, square_px, upright_axes

FOLDER = Path(__file__).parent / "apriltags"
CAMERA = Camera.from_field_of_view(1920, 1080, 70.0, height_m=1.5, depression_deg=5.0, forward_m=1.2)
SIDE_MM, PANEL_MM = 600.0, 750.0
IMAGES = sorted((FOLDER / "images").glob("*.png"))
DICTIONARIES = {"tag16_05": "apriltag-16h5", "tag25_09": "apriltag-25h9", "tag36_11": "apriltag-36h11"}


def published(path: Path) -> tuple[FiducialCode, np.ndarray[Any, np.dtype[np.uint8]]]:
    """A code, and its panel of 10 modules a side as the authors publish it."""
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    code = FiducialCode(DICTIONARIES[path.stem[:8]], int(path.stem[9:]))
    panel = cv2.resize(image, None, fx=20, fy=20, interpolation=cv2.INTER_NEAREST)
    return code, np.asarray(np.where(panel < 128, 25, 235), np.uint8)


def expected(path: Path) -> list[tuple[int, Floats]]:
    """Number and corners of each tag that the AprilTag library's own test expects. [px]"""
    found = [ast.literal_eval(f"[{line.replace(') (', '), (')}]".replace(" ", ",").replace(",,", ",")) for line in
             path.read_text().splitlines() if line.strip()]  # fmt: skip
    return [(number, np.array(corners)) for number, *corners in found]


@pytest.mark.parametrize(("name", "least"), [("33369213973", 12), ("34085369442", 12), ("34139872896", 13)])
def test_tags_in_photos(name: str, least: int) -> None:
    (photo,), (listed,) = (FOLDER / "photos").glob(f"{name}*.jpg"), (FOLDER / "photos").glob(f"{name}*.txt")
    pixels = cv2.imread(str(photo))
    assert pixels is not None
    readings = [one for one in decode_fiducials(pixels) if one.outcome is FiducialOutcome.READ]
    assert len(readings) >= least
    assert {reading.code for reading in readings} == {FiducialCode("apriltag-36h11", 0)}  # all tags of the scene
    places = expected(listed)
    assert {number for number, _corners in places} == {0}
    agreeing = 0
    for reading in readings:
        centre = reading.corners_px.mean(axis=0)
        away = [float(np.linalg.norm(corners.mean(axis=0) - centre)) for _number, corners in places]
        agreeing += min(away) < 1.5
    assert agreeing >= least - 5  # the library's test does not list all tags of the third photo


@pytest.mark.parametrize("path", IMAGES, ids=[path.stem for path in IMAGES])
@pytest.mark.parametrize("hung_deg", [0, 90, 180, 270])
def test_an_upright_sign_gives_its_place_whichever_edge_is_up(path: Path, hung_deg: int) -> None:
    code, panel = published(path)
    panel = np.ascontiguousarray(np.rot90(panel, -hung_deg // 90))
    modules = len(panel) // 20
    side_m = PANEL_MM / 1000 * (modules - 2) / modules
    known = KnownFiducial(code, FiducialGeometry(side_m * 1000, 0.0, Mounting.UPRIGHT))
    centre, axes = np.array([9.0, -2.0, 2.1]), upright_axes(-20.0)
    frame = render_sign(CAMERA, panel, axes, centre, PANEL_MM / 1000, np.random.default_rng(1))
    (reading,) = decode_fiducials(frame, known=[known], camera=CAMERA, dictionaries=())
    assert reading.code == code
    assert reading.pose is not None
    assert reading.turned_deg == (180 + hung_deg) % 360
    found = CAMERA.camera_from_vehicle.T @ reading.pose.translation_m + CAMERA.position_vehicle_m
    assert np.linalg.norm(found - centre) < 0.09
    ahead = CAMERA.camera_from_vehicle.T @ reading.pose.rotation[:, 1]
    assert math.degrees(math.atan2(ahead[1], ahead[0])) == pytest.approx(-20.0, abs=2.0)
    assert reading.corners_px == pytest.approx(square_px(CAMERA, axes, centre, side_m), abs=0.5)


def test_a_sign_that_leans_more_than_any_does_has_no_pose() -> None:
    code, panel = published(FOLDER / "images" / "tag36_11_00017.png")
    upright = upright_axes(0.0)
    for lean_deg, has_pose in ((10.0, True), (45.0, False)):
        lean = math.radians(lean_deg)
        turn = np.array([[math.cos(lean), -math.sin(lean), 0], [math.sin(lean), math.cos(lean), 0], [0, 0, 1.0]])
        known = KnownFiducial(code, FiducialGeometry(SIDE_MM, 75.0, Mounting.UPRIGHT))
        centre = np.array([8.0, 1.0, 2.0])
        frame = render_sign(CAMERA, panel, upright @ turn, centre, PANEL_MM / 1000, np.random.default_rng(2))
        (reading,) = decode_fiducials(frame, known=[known], camera=CAMERA, dictionaries=())
        assert reading.code == code
        assert (reading.pose is not None) == has_pose
        assert has_pose == (reading.reason == "")


@pytest.mark.parametrize(
    ("image", "turned_deg", "ahead_deg"), [(None, None, 180.0), ("apriltag", 180, 0.0), ("opencv", 0, 180.0)]
)
def test_a_lying_sign_is_as_it_is_registered(image: str | None, turned_deg: int | None, ahead_deg: float) -> None:
    code, panel = published(FOLDER / "images" / "tag36_11_00017.png")
    geometry = FiducialGeometry(SIDE_MM, 75.0, Mounting.LYING, SignImage(image) if image else None)
    centre = np.array([6.0, 0.3, 0.0])
    frame = render_sign(CAMERA, panel, lying_axes(0.0), centre, PANEL_MM / 1000, np.random.default_rng(3))
    (reading,) = decode_fiducials(frame, known=[KnownFiducial(code, geometry)], camera=CAMERA, dictionaries=())
    assert reading.turned_deg == turned_deg
    assert reading.pose is not None
    ahead = CAMERA.camera_from_vehicle.T @ reading.pose.rotation[:, 1]
    off_deg = math.degrees(math.atan2(ahead[1], ahead[0])) - ahead_deg
    assert (off_deg + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=2.0)


@pytest.mark.parametrize("path", IMAGES, ids=[path.stem for path in IMAGES])
def test_the_artwork_of_a_published_image_is_that_image(path: Path) -> None:
    code, panel = published(path)
    n = len(panel) // 20
    geometry = FiducialGeometry(100.0 * (n - 2), 100.0, Mounting.UPRIGHT, SignImage.APRILTAG)
    drawing = encode_fiducial(FiducialOrder("a sign", code, geometry))
    prove_fiducial(drawing, code, geometry)
    image, corners_px = render_face(drawing, px_per_mm=0.2)
    (left, top), (right, bottom) = np.round(corners_px[[0, 2]]).astype(int)
    face = np.asarray(image)[top : bottom + 1, left : right + 1]
    face = face if face.ndim == 2 else face[..., 0]
    cells = cv2.resize(face, (n, n), interpolation=cv2.INTER_AREA) < 128
    assert np.array_equal(cells, panel[10::20, 10::20] < 128)
