"""Heated plates in thermal frames, which show no colours."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from app.decoders.plate.detect_thermal import detect_warm_quads, find_warm_plates, without_trail
from app.decoders.plate.reader import decode_plates
from app.markers.plate import EXPECTED_GEOMETRIES, PlateCode
from app.markers.reading import PlateOutcome
from benchmarks.plates.sets import Job, Shot, find_shot, shoot
from tests.decoders.plate.scenes import PAPER, THERMAL_CAMERA, shoot_warm

pytestmark = pytest.mark.slow

CODES = [PAPER, PlateCode.from_registry_number(0xDEADBEEF)]


@pytest.mark.parametrize("turn_deg", [0.0, 90.0, 180.0, 270.0, 37.0])
@pytest.mark.parametrize("code", CODES, ids=lambda code: code.digits)
def test_a_heated_plate_is_read_at_any_turn(code: PlateCode, turn_deg: float) -> None:
    frame = shoot_warm(code, turn_deg)
    assert frame.image.ndim == 2
    readings = decode_plates(frame.image, camera=THERMAL_CAMERA, thermal=True)
    read = [r for r in readings if r.outcome is PlateOutcome.READ]
    assert [r.digits for r in read] == [code.digits]
    assert read[0].corners_px is not None
    errors_px = np.linalg.norm(read[0].corners_px - frame.truths[0].corners_px, axis=1)
    assert errors_px.max() < 1.0  # clockwise from the triangle's, which only the pattern tells
    assert read[0].pose is not None


def test_a_cold_road_gives_nothing() -> None:
    road = np.clip(85 + 4 * np.random.default_rng(0).standard_normal((512, 640)), 0, 255).astype(np.uint8)
    assert decode_plates(road, thermal=True) == []
    assert [r for r in decode_plates(road, thermal=True, codebook=CODES) if r.outcome is PlateOutcome.READ] == []


def test_a_warm_patch_of_one_level_is_no_plate_of_zeros() -> None:
    """In this frame one was: all zeros are a Reed-Solomon codeword, so the check said nothing."""
    shot = find_shot(Job("thermal", 10, seed=51, frames=0), 2)
    assert isinstance(shot, Shot)
    digits = {r.digits for r in decode_plates(shot.frame.image, thermal=True)}
    assert digits <= {None, shot.code.digits if shot.code else None}


@pytest.mark.parametrize("code", CODES, ids=lambda code: code.digits)
@pytest.mark.parametrize("turn_deg", [0.0, 200.0])
def test_a_plate_that_is_colder_than_the_road_is_read(code: PlateCode, turn_deg: float) -> None:
    inverted = 255 - shoot_warm(code, turn_deg).image
    readings = decode_plates(inverted, thermal=True)
    assert [r.digits for r in readings if r.outcome is PlateOutcome.READ] == [code.digits]


def test_four_warm_squares_are_no_plate() -> None:
    """Without a triangle there is no first corner, and no digits."""
    image = shoot_warm(PAPER, 0.0).image
    (plate,) = find_warm_plates(image, EXPECTED_GEOMETRIES)
    corner, right, opposite, below = plate.fit.corners_px
    middle = corner + 0.13 * ((right - corner) + (below - corner))
    cv2.circle(image, middle.round().astype(int).tolist(), 5, int(image.max()), -1)
    found = [r for r in decode_plates(image, thermal=True) if r.outcome is PlateOutcome.READ]
    assert found == [] or (found[0].digits == PAPER.digits and opposite is not None)


def test_a_warm_disc_is_no_quadrangle_of_units() -> None:
    image = np.full((512, 640), 85, np.uint8)
    cv2.circle(image, (320, 300), 40, 190, -1)
    assert detect_warm_quads(image) == []


def test_a_slow_sensor_s_trail_is_taken_off() -> None:
    """What a pixel that follows with a lag shows of an edge that moves down is the edge again."""
    scene, trail_px = np.zeros((60, 8)), 3.0
    scene[30:] = 1.0
    seen = scene.copy()
    for row in range(58, -1, -1):  # the time before is below: the scene moves down
        seen[row] = (scene[row] + trail_px * seen[row + 1]) / (1 + trail_px)
    frame = np.round(40 + 160 * seen).astype(np.uint8)
    everywhere_px = np.array([(0.0, 8.0), (7.0, 8.0), (7.0, 52.0), (0.0, 52.0)])
    sharp = without_trail(frame, everywhere_px, trail_px).astype(float)
    assert np.ptp(sharp[2:29]) < 0.05 * np.ptp(sharp)
    assert np.ptp(sharp[31:57]) < 0.05 * np.ptp(sharp)
    assert abs(float(sharp[31:57].mean() - sharp[2:29].mean())) > 0.9 * np.ptp(sharp)


@pytest.mark.parametrize("set_name", ["thermal-20", "thermal-30"])
def test_plates_are_read_at_20_and_30_km_h(set_name: str) -> None:
    shots = [shot for index in range(4) for shot in shoot(Job(set_name, index, seed=93, frames=0, share=0.25))]
    read = 0
    for shot in shots:
        assert isinstance(shot, Shot)
        assert shot.code is not None
        digits = {reading.digits for reading in decode_plates(shot.frame.image, thermal=True) if reading.digits}
        assert digits <= {shot.code.digits}
        read += bool(digits)
    assert read >= len(shots) / 3
