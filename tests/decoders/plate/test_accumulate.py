"""Evidence of several frames of one plate: it adds up as stated, and reads what single frames do not."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from app.decoders.plate.accumulate import accumulate, count_effective, differing_units, read_accumulated
from app.decoders.plate.evidence import PlateEvidence
from app.decoders.plate.follow_plate import predict_corners, view_elsewhere
from app.decoders.plate.pose import locate_plate
from app.decoders.plate.reader import read_plates
from app.decoders.plate.video_search import PlateTracker, SeenPlate
from app.markers.plate import PlateCode
from app.markers.reading import PlateOutcome, PlateReading
from app.simulation.camera import render_plate_scene
from app.simulation.plate_scene import PlacedFace, PlateScene, Sensor
from tests.decoders.plate.scenes import CAMERA, face_of

CODE = PlateCode.from_registry_number(0xC0FFEE11)
UNCHECKED = PlateCode("415919005231")  # checks would read each frame alone


def _noisy_frames(full_well_e: float, count: int, code: PlateCode = CODE) -> list[tuple[PlateReading, PlateEvidence]]:
    """Readings of a plate that comes nearer in frames with few electrons, with their evidence."""
    found = []
    for k in range(count):
        sensor = Sensor(full_well_e=full_well_e, read_noise_e=4, jpeg_quality=None, blur_px=0.9)
        scene = PlateScene(CAMERA, (PlacedFace(face_of(code), 4.6 - 0.12 * k, 0.2),), sensor=sensor)
        image = render_plate_scene(scene, None, np.random.default_rng(100 + k)).image
        found += [(r, e) for r, e in read_plates(image, camera=CAMERA) if e is not None and e.geometry.n == code.n]
    return found


@pytest.fixture(scope="module")
def noisy() -> list[tuple[PlateReading, PlateEvidence]]:
    return _noisy_frames(80.0, 8)


def test_equal_frames_count_as_stated(noisy: list[tuple[PlateReading, PlateEvidence]]) -> None:
    one = noisy[0][1]
    joint = accumulate([one] * 4)
    assert joint.frames == 4
    assert (joint.units.best == one.units.best).all()
    assert joint.units.cell_costs == pytest.approx(count_effective(4) * one.units.cell_costs, rel=1e-6, abs=1e-6)
    assert 1 < count_effective(4) < count_effective(100) < 1.7
    assert accumulate([one]) is one


@pytest.mark.slow
def test_frames_that_are_not_read_alone_are_read_together() -> None:
    noisy = _noisy_frames(85.0, 14, UNCHECKED)
    refused = [evidence for reading, evidence in noisy if reading.code is None]
    assert len(refused) >= 3
    together, _joint = read_accumulated(refused, (), CAMERA)
    assert together.code == UNCHECKED
    assert together.pose is not None


def test_frames_of_two_plates_do_not_make_a_third(noisy: list[tuple[PlateReading, PlateEvidence]]) -> None:
    other = PlateCode.from_registry_number(0x12345678)
    scene = PlateScene(CAMERA, (PlacedFace(face_of(other), 4.0, 0.2),))
    image = render_plate_scene(scene, None, np.random.default_rng(1)).image
    foreign = [evidence for _reading, evidence in read_plates(image, camera=CAMERA) if evidence is not None]
    mixed, _joint = read_accumulated([foreign[0], *(evidence for _reading, evidence in noisy[:1])], ())
    assert mixed.code in (None, CODE, other)


def test_a_spoilt_frame_does_not_outweigh_frames_that_agree(noisy: list[tuple[PlateReading, PlateEvidence]]) -> None:
    rng = np.random.default_rng(3)
    good = [evidence for _reading, evidence in noisy]
    largest = max(good, key=lambda one: one.unit_px)
    dark = rng.random(len(largest.units.dark)) < 0.5
    units = replace(largest.units, dark=dark, weight=100 * largest.units.weight)
    spoilt = replace(largest, units=units, unit_px=2 * largest.unit_px)
    assert (accumulate([spoilt, *good]).units.best == accumulate(good).units.best).all()
    assert accumulate([spoilt, *good]).frames == accumulate(good).frames


def test_a_plate_is_followed_into_a_frame_without_its_colours() -> None:
    face = face_of(CODE)
    images = [
        render_plate_scene(PlateScene(CAMERA, (PlacedFace(face, ahead_m, 0.2),)), None, np.random.default_rng(k)).image
        for k, ahead_m in enumerate((3.9, 3.2))
    ]
    grey = cv2.cvtColor(cv2.cvtColor(images[0], cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR)
    assert not any(reading.code for reading, _evidence in read_plates(grey, camera=CAMERA))
    ((_reading, known),) = [found for found in read_plates(images[1], camera=CAMERA) if found[0].code]
    assert known is not None
    pose = locate_plate(known.corners_px, known.corners_covariance_px2, known.geometry, CAMERA)
    assert pose is not None
    for off_m, is_found in ((0.0, True), (0.05, True), (2.0, False)):  # the last is beyond the search
        corners_px = predict_corners(pose, known.geometry, CAMERA, -0.7 - off_m)
        assert corners_px is not None
        view = view_elsewhere(known, images[1], grey, corners_px)
        assert (view is not None and differing_units(view.units, known.units) == 0.0) is is_found
    empty = np.full_like(grey, 90)
    assert view_elsewhere(known, images[1], empty, predict_corners(pose, known.geometry, CAMERA, -0.7)) is None
    assert predict_corners(pose, known.geometry, CAMERA, 10.0) is None  # behind


def _seen(frame: int, rate_hz: float, ahead_m: float, left_m: float = 0.0, digits: str | None = None) -> SeenPlate:
    reading = PlateReading(PlateOutcome.UNSURE, confidence=0.5)
    if digits is not None:
        reading = replace(reading, outcome=PlateOutcome.READ, code=PlateCode(digits))
    return SeenPlate(frame, frame / rate_hz, reading, None, None, ahead_m, left_m)


@pytest.mark.parametrize("speed_m_s", [0.0, 3.0, 14.0, 33.0])
@pytest.mark.parametrize("is_known", [True, False])
def test_a_plate_is_found_again_by_its_place(speed_m_s: float, is_known: bool) -> None:
    rng = np.random.default_rng(7)
    tracker, done = PlateTracker(), []
    for frame in range(90):
        # a plate every 20 m, and a second one beside each
        seen = []
        for at_m in (20.0, 40.0, 60.0):
            ahead_m = at_m - 10.0 - speed_m_s * frame / 30.0
            if 2.0 < ahead_m < 11.0:
                noise = 0.02 * ahead_m * rng.standard_normal()
                seen += [_seen(frame, 30.0, ahead_m + noise), _seen(frame, 30.0, ahead_m + noise, 1.5)]
        done += tracker.add(frame / 30.0, seen, speed_m_s if is_known else None)
    done += tracker.finish()
    passed = {0.0: 1, 3.0: 1, 14.0: 3, 33.0: 3}[speed_m_s]
    assert len(done) == 2 * passed
    assert all(len({round(one.left_m) for one in track.seen}) == 1 for track in done)
    if speed_m_s > 5:
        assert all(track.speed_m_s() == pytest.approx(speed_m_s, rel=0.1) for track in done[:4])


def test_different_digits_are_different_plates() -> None:
    tracker = PlateTracker()
    tracker.add(0.0, [_seen(0, 10.0, 5.0, digits="023792168411")])
    tracker.add(0.1, [_seen(1, 10.0, 5.0, digits="123792168411")])
    assert len(tracker.finish()) == 2
