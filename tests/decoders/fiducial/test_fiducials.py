"""Fiducial signs in pictures: every dictionary, damage, small dictionaries, and pictures without signs."""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from app.decoders.fiducial import FiducialOutcome, decode_fiducials, detect_squares, locate_fiducial
from app.encoders.plate import PlateOrder, encode_plate
from app.encoders.plate.proof import render_face
from app.errors import CodeMismatch, InvalidParameter
from app.markers.fiducial import DICTIONARIES, FiducialCode, FiducialGeometry, KnownFiducial, codewords
from app.markers.plate import PlateCode
from benchmarks.scenes.hunted_weather import wide_camera

Image = npt.NDArray[np.uint8]

GEOMETRY = FiducialGeometry(300.0, 40.0)
_MODULE_PX = 12


def face(code: FiducialCode, damaged: tuple[int, ...] = (), quarter_turns: int = 0) -> Image:
    """A sign on a grey ground; `damaged` are modules, row by row, that show the opposite."""
    modules = code.modules.copy()
    n = len(modules) - 2
    for module in damaged:
        modules[1 + module // n, 1 + module % n] ^= 1
    dark = np.pad(np.kron(modules, np.ones((_MODULE_PX, _MODULE_PX), np.uint8)), 2 * _MODULE_PX)
    picture = np.where(dark == 1, 25, 235).astype(np.uint8)
    framed = cv2.copyMakeBorder(np.rot90(picture, quarter_turns), 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=(110,))
    return np.asarray(cv2.GaussianBlur(framed, (5, 5), 1.0), dtype=np.uint8)


@pytest.mark.parametrize("name", [name for name in DICTIONARIES if not name.endswith(("-100", "-250"))])
def test_a_registered_sign_of_every_dictionary_is_read(name: str) -> None:
    code = FiducialCode(name, 7)
    (reading,) = decode_fiducials(face(code), known=[KnownFiducial(code, GEOMETRY)])
    assert (reading.outcome, reading.code, reading.bit_errors) == (FiducialOutcome.READ, code, 0)


@pytest.mark.parametrize("turns", range(4))
def test_corners_begin_at_the_signs_upper_left(turns: int) -> None:
    code = FiducialCode("apriltag-36h11", 17)
    picture = face(code, quarter_turns=turns)
    (reading,) = decode_fiducials(picture)
    inset = 60 + 2 * _MODULE_PX - 0.5
    far = len(picture) - 1 - inset
    upright = np.array([(inset, inset), (far, inset), (far, far), (inset, far)])
    assert np.abs(reading.corners_px - np.roll(upright, -turns if turns % 2 == 0 else turns, axis=0)).max() < 0.3


def test_the_codewords_are_those_of_opencv() -> None:
    """OpenCV's own detector reads what our pattern shows."""
    for name, number in (("apriltag-36h11", 586), ("aruco-4x4-50", 49), ("aruco-7x7-1000", 999)):
        words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARIES[name].opencv))
        _corners, numbers, _rejected = cv2.aruco.ArucoDetector(words).detectMarkers(face(FiducialCode(name, number)))
        assert numbers.ravel().tolist() == [number]


def test_dictionaries_of_a_series_share_their_codewords() -> None:
    for n in (4, 5, 6, 7):
        for size in (50, 100, 250):
            assert (codewords(f"aruco-{n}x{n}-{size}") == codewords(f"aruco-{n}x{n}-1000")[:size]).all()


def test_a_small_dictionary_is_read_only_where_the_sign_is_registered() -> None:
    code = FiducialCode("apriltag-16h5", 7)
    alone = decode_fiducials(face(code), dictionaries=("apriltag-16h5",))
    beside = decode_fiducials(face(code), known=[KnownFiducial(FiducialCode("apriltag-16h5", 8), GEOMETRY)])
    assert [reading.outcome for reading in (*alone, *beside)] == [FiducialOutcome.UNSURE] * 2
    (reading,) = decode_fiducials(face(code), known=[KnownFiducial(code, GEOMETRY)])
    assert reading.code == code


@pytest.mark.parametrize(("damaged", "registered", "outcome"), [(1, False, "read"), (3, True, "read"), (12, True, "")])
def test_damage_lowers_the_confidence(damaged: int, registered: bool, outcome: str) -> None:
    code = FiducialCode("apriltag-36h11", 100)
    modules = tuple(np.random.default_rng(1).choice(36, damaged, replace=False).tolist())
    readings = decode_fiducials(face(code, modules), known=[KnownFiducial(code, GEOMETRY)] if registered else [])
    assert [str(reading.outcome) for reading in readings] == ([outcome] if outcome else [])
    assert all(reading.code == code and reading.bit_errors == damaged for reading in readings)


def test_signs_of_other_dictionaries_are_not_taken_for_registered_ones() -> None:
    known = [KnownFiducial(FiducialCode("apriltag-25h9", number), GEOMETRY) for number in range(5)]
    for name in ("aruco-5x5-1000", "apriltag-16h5"):
        readings = decode_fiducials(face(FiducialCode(name, 3)), known=known, dictionaries=())
        assert not [reading for reading in readings if reading.outcome is FiducialOutcome.READ]


@pytest.mark.slow
def test_frames_without_signs_give_no_reading() -> None:
    """Plates, and pictures full of squares with random modules: no code is returned, whatever is registered."""
    rng = np.random.default_rng(11)
    known = [KnownFiducial(FiducialCode(name, 3), GEOMETRY) for name in ("apriltag-16h5", "aruco-4x4-50")]
    pictures = [_plate(rng) for _ in range(3)] + [_clutter(rng) for _ in range(12)]
    squares = sum(len(detect_squares(cv2.cvtColor(p, cv2.COLOR_BGR2GRAY) if p.ndim == 3 else p)) for p in pictures)
    readings = [reading for p in pictures for reading in decode_fiducials(p, known=known, dictionaries=[*DICTIONARIES])]
    assert squares > 100  # the pictures do hold candidates
    assert [reading for reading in readings if reading.outcome is FiducialOutcome.READ] == []


def _plate(rng: np.random.Generator) -> Image:
    code = PlateCode.from_position(114 + rng.uniform(0, 1), 22 + rng.uniform(0, 1))
    return render_face(encode_plate(PlateOrder("plate", code)), px_per_mm=rng.uniform(0.5, 2.0))[0]


def _clutter(rng: np.random.Generator) -> Image:
    """Turned boxes, and bordered squares of random modules."""
    picture = np.full((480, 640), 120, np.uint8)
    for _ in range(int(rng.integers(5, 40))):
        side, turn = float(rng.uniform(10, 120)), float(rng.uniform(0, 90))
        place = (float(rng.uniform(0, 640)), float(rng.uniform(0, 480)))
        box = cv2.boxPoints((place, (side, side * float(rng.uniform(0.7, 1.3))), turn))
        cv2.fillPoly(picture, [box.astype(np.int32)], (int(rng.integers(0, 255)),))
        n = int(rng.integers(4, 8))
        tile = np.kron(np.pad(rng.integers(0, 2, (n, n)), 1), np.ones((8, 8))) * 200 + 20
        tile = np.pad(tile, 8, constant_values=230)
        x, y = (int(rng.integers(0, length - len(tile))) for length in (640, 480))
        if rng.random() < 0.5:
            picture[y : y + len(tile), x : x + len(tile)] = tile
    return np.asarray(cv2.GaussianBlur(picture, (5, 5), 1.0), dtype=np.uint8)


def test_codes_are_checked() -> None:
    assert FiducialCode.from_text("aruco-4x4-17", "aruco-4x4-50") == FiducialCode("aruco-4x4-50", 17)
    assert FiducialCode.from_text("17", "aruco-4x4-50").text == "aruco-4x4-17"
    for text, dictionary in (("aruco-5x5-17", "aruco-4x4-50"), ("50", "aruco-4x4-50"), ("x", "aruco-4x4-50")):
        with pytest.raises(CodeMismatch):
            FiducialCode.from_text(text, dictionary)
    with pytest.raises(InvalidParameter):
        FiducialCode("aruco-9x9", 0)
    with pytest.raises(InvalidParameter):
        FiducialGeometry(10.0, 0.0)


@pytest.mark.parametrize("aside_deg", [0.0, 30.0, 55.0])
def test_a_sign_at_the_edge_of_a_wide_lens_is_where_it_stands(aside_deg: float) -> None:
    """On a lens of eight coefficients five steps of undistorting, OpenCV's default, are tens of pixels short."""
    camera = wide_camera(1920, 1080, 128.0, 0.6, depression_deg=0.0)
    sign, ahead = FiducialGeometry(600.0, 80.0), math.radians(aside_deg)
    right, towards = np.array([math.cos(ahead), 0, -math.sin(ahead)]), np.array([math.sin(ahead), 0, math.cos(ahead)])
    centre = 4.0 * towards + np.array([0, -0.4, 0])
    corners_m = np.array(
        [centre + 0.3 * (x * right + y * np.array([0, 1, 0])) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    )
    corners_px = camera.project(corners_m)
    np.testing.assert_allclose(camera.undistort(corners_px), corners_m[:, :2] / corners_m[:, 2:], atol=1e-6)
    pose = locate_fiducial(corners_px, sign, camera)
    assert pose is not None
    np.testing.assert_allclose(pose.translation_m, centre, atol=1e-3)
    assert pose.reprojection_rms_px < 0.01
