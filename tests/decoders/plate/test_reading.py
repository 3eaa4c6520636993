"""Plates that are in view are read: any turn, size, scheme and number, from pictures as they come."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from app.decoders.plate.confirm import UNCHECKED_CONFIDENCE
from app.decoders.plate.reader import decode_plates
from app.errors import InvalidParameter
from app.formats.images import load_image
from app.markers.plate import EXPECTED_GEOMETRIES, PlateCode, PlateGeometry, PlateScheme
from app.markers.reading import Certainty, PlateOutcome, PlateReading
from app.sensors.camera import Camera
from app.simulation.plate_scene import PlacedFace
from tests.decoders.plate.scenes import BACKGROUNDS, CAMERA, PAPER, face_of, photo, road, shoot, shoot_plate

CORNER_LIMIT_PX = 0.6
HK = (114.1793123, 22.3045678)


def only(readings: list[PlateReading]) -> PlateReading:
    read = [reading for reading in readings if reading.outcome is PlateOutcome.READ]
    assert len(read) == 1, [(reading.outcome, reading.reason) for reading in readings]
    return read[0]


def corner_errors(reading: PlateReading, truth_px: np.ndarray) -> np.ndarray:
    assert reading.corners_px is not None
    return np.asarray(np.linalg.norm(reading.corners_px - truth_px, axis=1))


@pytest.mark.slow
@pytest.mark.parametrize("turn_deg", range(0, 360, 15))
def test_a_plate_is_read_at_any_turn(turn_deg: int) -> None:
    frame = shoot_plate(turn_deg=turn_deg, left_m=-0.2, seed=turn_deg + 1)
    reading = only(decode_plates(frame.image))
    assert reading.digits == "023792168411"
    # clockwise from the triangle's: the truth's corners start at the triangle too
    assert corner_errors(reading, frame.truths[0].corners_px).max() < CORNER_LIMIT_PX
    assert not reading.from_codebook
    assert reading.pose is None


@pytest.mark.parametrize(
    "code",
    [
        PlateCode.from_position(*HK),
        PlateCode.from_position(*HK, check_digits=1),
        PlateCode.from_position(*HK, check_digits=2),
        PlateCode.from_registry_number(0xDEADBEEF),
        PlateCode.from_registry_number(7),
        PlateCode.from_position(*HK, n=10),
        PlateCode.from_position(*HK, n=10, check_digits=1),
        PlateCode.from_position(*HK, n=10, check_digits=2),
        PlateCode.from_registry_number(0xFEDCBA987654, n=10),
        PlateCode.from_position(*HK, n=12),
        PlateCode.from_position(*HK, n=10, scheme=PlateScheme.POSITION_ROBUST),
        PlateCode.from_position(*HK, n=12, scheme=PlateScheme.POSITION_ROBUST),
        PlateCode.from_position(*HK, n=12, check_digits=2),
        PlateCode.from_registry_number(0xFEDCBA9876543210, n=12),
    ],
    ids=lambda code: f"{code.n}-{code.scheme}-{code.digits[:8]}",
)
def test_every_size_and_scheme_is_read(code: PlateCode) -> None:
    geometry = next(one for one in EXPECTED_GEOMETRIES if one.n == code.n)
    frame = shoot(PlacedFace(face_of(code, geometry), 2.4, 0.0, 8.0))
    reading = only(decode_plates(frame.image))
    assert reading.digits == code.digits
    assert reading.geometry == geometry
    assert corner_errors(reading, frame.truths[0].corners_px).max() < CORNER_LIMIT_PX
    assert reading.code is not None
    if code.scheme is PlateScheme.ID:
        assert reading.code.registry_number == code.registry_number
    if code.scheme.corrects:
        assert reading.code == code  # without a word about its scheme
    assert reading.confidence > 0.99 if code.scheme.corrects else reading.confidence == UNCHECKED_CONFIDENCE
    assert reading.certainty is (Certainty.SURE if code.scheme.corrects else Certainty.UNCHECKED)
    assert len(reading.cell_confidence) == len(code.digits)
    assert reading.grade is not None
    assert reading.grade.letter in "ABCDF"


def test_the_codebook_tells_the_scheme_that_digits_cannot() -> None:
    code = PlateCode.from_position(*HK, check_digits=2)
    reading = only(decode_plates(shoot_plate(code).image, codebook=[PAPER, code]))
    assert reading.code == code
    assert not reading.from_codebook  # the frame alone was enough
    assert reading.certainty is Certainty.SURE
    assert reading.confidence > UNCHECKED_CONFIDENCE


def test_a_plate_of_other_dimensions_is_read_when_its_geometry_is_named() -> None:
    geometry = PlateGeometry(8, 45.0, 8.0)
    frame = shoot(PlacedFace(face_of(PAPER, geometry), 3.2, 0.1, 200.0))
    reading = only(decode_plates(frame.image, geometries=[geometry]))
    assert reading.digits == PAPER.digits
    assert corner_errors(reading, frame.truths[0].corners_px).max() < CORNER_LIMIT_PX


def test_one_symbol_in_all_cells_needs_a_registry() -> None:
    code = PlateCode("999999999999")
    image = shoot_plate(code).image
    assert [reading.outcome for reading in decode_plates(image)] == [PlateOutcome.UNSURE]
    assert only(decode_plates(image, codebook=[code])).digits == code.digits


def test_several_plates_in_a_frame_are_all_read() -> None:
    codes = [PAPER, PlateCode("999999999998"), PlateCode.from_registry_number(0xDEADBEEF)]
    places = [(2.4, -0.6, 10.0), (3.3, 0.7, 200.0), (2.3, 0.5, 300.0)]
    faces = [PlacedFace(face_of(code), *place) for code, place in zip(codes, places, strict=True)]
    frame = shoot(*faces)
    readings = decode_plates(frame.image)
    found = {r.digits: r for r in readings if r.outcome is PlateOutcome.READ}
    assert set(found) == {code.digits for code in codes}
    errors = [corner_errors(found[c.digits], t.corners_px) for c, t in zip(codes, frame.truths, strict=True)]
    assert np.median(errors) < CORNER_LIMIT_PX
    assert np.max(errors) < 1.5


@pytest.mark.parametrize("form", [".jpg", ".png"])
def test_pictures_are_read_as_they_are_uploaded(form: str) -> None:
    frame = shoot_plate(turn_deg=75.0)
    content = cv2.imencode(form, frame.image, [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes()
    image = load_image(content).pixels
    reading = only(decode_plates(np.asarray(image)))
    assert reading.digits == PAPER.digits
    assert corner_errors(reading, frame.truths[0].corners_px).max() < CORNER_LIMIT_PX


@pytest.mark.parametrize("name", sorted(path.name for path in BACKGROUNDS.glob("*.jpg")))
def test_a_road_without_a_plate_gives_no_digits(name: str) -> None:
    for image in (photo(name), road(name)):
        for codebook in ((), (PAPER,)):
            readings = decode_plates(image, codebook=codebook)
            assert not any(r.outcome is PlateOutcome.READ or r.digits for r in readings)
            assert all(r.reason for r in readings)


def test_most_roads_without_a_plate_give_nothing_at_all() -> None:
    """Some show what looks like a plate at first; such candidates are named and refused."""
    names = sorted(path.name for path in BACKGROUNDS.glob("*.jpg"))
    empty = [decode_plates(image) == [] for name in names for image in (photo(name), road(name))]
    assert sum(empty) >= 0.6 * len(empty)
    assert decode_plates(road("adv_test3.jpg")) == []


@pytest.mark.parametrize("level", [0, 128, 255])
def test_an_even_picture_gives_nothing(level: int) -> None:
    assert decode_plates(np.full((240, 320, 3), level, np.uint8)) == []
    assert decode_plates(np.full((240, 320), level, np.uint8), thermal=True) == []


def test_noise_gives_nothing() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (540, 960, 3), dtype=np.uint8)
    assert [r for r in decode_plates(noise, codebook=[PAPER]) if r.outcome is PlateOutcome.READ] == []


def test_the_same_frame_gives_the_same_answer_and_stays_as_it_is() -> None:
    image = shoot_plate(turn_deg=33.0).image
    before = image.copy()
    first, second = (decode_plates(image, camera=CAMERA, codebook=[PAPER]) for _ in range(2))
    np.testing.assert_array_equal(image, before)
    assert len(first) == len(second) > 0
    for a, b in zip(first, second, strict=True):
        assert (a.outcome, a.code, a.confidence, a.cell_confidence, a.grade, a.reason) == (
            b.outcome, b.code, b.confidence, b.cell_confidence, b.grade, b.reason,
        )  # fmt: skip
        np.testing.assert_array_equal(a.corners_px, b.corners_px)
        np.testing.assert_array_equal(a.corners_covariance_px2, b.corners_covariance_px2)
        assert a.pose is not None
        assert b.pose is not None
        np.testing.assert_array_equal(a.pose.translation_m, b.pose.translation_m)


def test_a_view_into_a_larger_frame_reads_like_its_copy() -> None:
    image = shoot_plate().image
    part = image[200:500, 300:660]
    view, copy = (only(decode_plates(p)) for p in (part, np.ascontiguousarray(part)))
    assert view.digits == copy.digits == PAPER.digits
    np.testing.assert_array_equal(view.corners_px, copy.corners_px)


@pytest.mark.parametrize(
    ("image", "kwargs", "field"),
    [
        (np.zeros((540, 960, 3), np.float32), {}, "image"),
        (np.zeros((540, 960, 3), np.uint16), {}, "image"),
        (np.zeros((540, 960), np.uint8), {}, "image"),
        (np.zeros((540, 960, 4), np.uint8), {}, "image"),
        (np.zeros((540, 960, 3), np.uint8), {"thermal": True}, "image"),
        (np.zeros((540, 10, 3), np.uint8), {}, "image"),
        (np.zeros((0, 0, 3), np.uint8), {}, "image"),
        (np.zeros((960, 540, 3), np.uint8), {"camera": CAMERA}, "camera.width_px"),
        (
            np.zeros((540, 960, 3), np.uint8),
            {"camera": Camera.from_field_of_view(1920, 1080, 60.0)},
            "camera.width_px",
        ),
        (np.zeros((540, 960, 3), np.uint8), {"geometries": []}, "geometries"),
    ],
)
def test_what_is_no_frame_is_refused_by_name(image: np.ndarray, kwargs: dict, field: str) -> None:
    with pytest.raises(InvalidParameter) as caught:
        decode_plates(image, **kwargs)
    assert caught.value.field == field
