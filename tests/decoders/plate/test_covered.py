"""Plates of which a part is covered: hidden markers, cells that count little, and plates that other frames show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from app.decoders.plate.accumulate import confirm_drive
from app.decoders.plate.confirm import (
    ADVANCE_ERRORS,
    UNCHECKED_CONFIDENCE,
    DriveFrame,
    Expected,
    list_expected,
    with_expected,
)
from app.decoders.plate.detect_blobs import half_planes, ratio_signal
from app.decoders.plate.detect_quads import detect_marker_quads
from app.decoders.plate.follow_plate import expect_plate, find_expected
from app.decoders.plate.reader import decode_plates, read_plates
from app.decoders.plate.unit_likelihoods import RISK_BESIDE_HIDDEN, with_hidden_markers
from app.markers.plate import PlateCode, PlateScheme
from app.markers.reading import Certainty, PlateOutcome, PlatePose, PlateReading, SymbolEvidence
from app.simulation.plate_face import Face
from app.simulation.plate_scene import PlacedFace, PlateScene
from benchmarks.plates.sets import draw_scenes
from benchmarks.scenes.weather import WEATHER, MirroredLamp, Weather, draw_weather
from tests.decoders.plate.scenes import AHEAD_M, CAMERA, face_of, marker_units, painted, shoot

CODE, OTHER = PlateCode.from_registry_number(0xC0FFEE11), PlateCode.from_registry_number(0x5EED0001)
SNOW = (0.88, 0.86, 0.83)


def snowed(corner: str, *, beside: int = 0) -> Face:
    """A plate with snow on one marker, and on so many rows of the cells beside it."""
    units = marker_units(corner)
    rows = sorted({row for row, _column in units})
    columns = [column for row in rows for column in range(8) if (row, column) in units]
    step = 1 if min(columns) == 0 else -1
    covered = [*units, *((row, columns[0 if step < 0 else 1] + step * (k + 1)) for row in rows for k in range(beside))]
    return painted(face_of(CODE), dict.fromkeys(covered, SNOW))


@pytest.mark.parametrize("corner", ["top-left", "top-right", "bottom-right", "bottom-left"])
def test_a_plate_is_read_with_any_of_its_markers_under_snow(corner: str) -> None:
    image = shoot(PlacedFace(snowed(corner), AHEAD_M)).image
    assert [reading.digits for reading in decode_plates(image)] == [CODE.digits]


@pytest.mark.parametrize("corner", ["top-left", "bottom-right"])
def test_units_beside_a_covered_marker_are_left_to_the_checks(corner: str) -> None:
    image = shoot(PlacedFace(snowed(corner, beside=2), AHEAD_M)).image
    [alone] = decode_plates(image)
    assert alone.digits in (CODE.digits, None)
    [known] = decode_plates(image, codebook=(CODE, OTHER))
    assert known.digits == CODE.digits


def test_a_hidden_marker_raises_the_risk_of_the_cells_beside_it_alone() -> None:
    [(_reading, evidence)] = read_plates(shoot(PlacedFace(face_of(CODE), AHEAD_M)).image)
    assert evidence is not None
    plain = with_hidden_markers(evidence.units, np.ones(4), 8)
    hidden = with_hidden_markers(evidence.units, np.array([1.0, 1.0, 0.0, 1.0]), 8)
    added = hidden.risk_log_odds - plain.risk_log_odds
    # cells in reading order: two above, four in each middle row, two below; the last marker clockwise but one is the
    # bottom right
    beside = np.zeros(12, bool)
    beside[[9, 11]] = True
    assert added[beside] == pytest.approx(RISK_BESIDE_HIDDEN, rel=0.05)
    assert np.abs(added[~beside]).max() < 0.01


def test_a_lamp_mirrored_over_the_triangle_leaves_the_ratio_signal() -> None:
    lamp = MirroredLamp((0.02, 0.25, 0.08), over_m=AHEAD_M, left_m=0.12, height_m=0.8, size_m=(1.2, 0.05))
    weather = Weather(draw_weather("wet", np.random.default_rng(1)).conditions, None, 0.6, (lamp,))
    scene = weather.in_scene(PlateScene(CAMERA, (PlacedFace(face_of(CODE), AHEAD_M),)))
    frame = shoot(*scene.faces, background=weather.on_road(scene, shoot().image))
    truth = frame.truths[0].corners_px
    quads = detect_marker_quads(ratio_signal(half_planes(frame.image)))
    size = float(np.ptp(truth, axis=0).max())
    assert any(np.abs(quad.centroids_px.mean(axis=0) - truth.mean(axis=0)).max() < 0.05 * size for quad in quads)


# --- frames of a drive ------------------------------------------------------------------------------------------------


def symbols_of(code: PlateCode, unsure: tuple[int, ...], seed: int) -> SymbolEvidence:
    """Evidence that shows a code, but for some cells that may be anything."""
    rng = np.random.default_rng(seed)
    likelihoods = np.exp(rng.normal(0, 0.3, (12, 16)))
    for cell, symbol in enumerate(code.symbols):
        likelihoods[cell, symbol] *= 1.0 if cell in unsure else 3e3
    return SymbolEvidence(np.log(16 * likelihoods / likelihoods.sum(axis=1, keepdims=True)), 1.0)


def refused(code: PlateCode, unsure: tuple[int, ...], seed: int = 1) -> PlateReading:
    return PlateReading(PlateOutcome.CELLS_UNDECODABLE, symbols=symbols_of(code, unsure, seed), reason="unsure")


def test_frames_that_show_different_cells_show_the_code_together() -> None:
    frames = [(3, [refused(CODE, (0, 1, 2, 3), 1)]), (5, [refused(CODE, (8, 9, 10, 11), 2)])]
    for one in frames:
        assert confirm_drive([one]) == {}
    confirmed = confirm_drive(frames)
    assert {number: one.digits for number, [one] in confirmed.items()} == {3: CODE.digits, 5: CODE.digits}
    assert all(one.frames == (3, 5) and one.confidence > 1 - 1e-4 for [one] in confirmed.values())


def test_frames_of_two_plates_are_not_added_up() -> None:
    assert confirm_drive([(0, [refused(CODE, (0, 1, 2))]), (1, [refused(OTHER, (8, 9, 10))])]) == {}
    same = [(0, [refused(CODE, tuple(range(6)))]), (9, [refused(CODE, tuple(range(6, 12)))])]
    assert confirm_drive(same) == {}  # too many frames in between


def test_a_sure_frame_gives_its_code_to_those_that_show_it_only() -> None:
    sure = replace(refused(CODE, ()), outcome=PlateOutcome.READ, code=CODE, confidence=0.9999)
    confirmed = confirm_drive([(0, [refused(CODE, (0, 4, 5, 6, 7))]), (1, [sure]), (2, [refused(OTHER, ())])])
    assert set(confirmed) == {0}
    assert confirmed[0][0].digits == CODE.digits


def seen_at(ahead_m: float, code: PlateCode = CODE) -> PlateReading:
    forward = CAMERA.camera_from_vehicle[:, 0]
    pose = PlatePose(np.eye(3), ahead_m * forward, np.eye(6), 0.1)
    return PlateReading(PlateOutcome.READ, code=code, pose=pose)


def test_the_advance_follows_from_two_frames_that_show_a_plate() -> None:
    shown = {1: [seen_at(6.0)], 3: [seen_at(4.0)]}
    expected = list_expected([DriveFrame(10 + k, shown.get(k, []), CAMERA) for k in range(5)])
    assert set(expected) == {10, 12, 14}
    for number, from_number, way_m in ((10, 11, -1.0), (14, 13, 1.0)):
        [plate] = expected[number]
        assert plate.number == from_number
        assert plate.advances_m == pytest.approx([way_m * ratio for ratio in ADVANCE_ERRORS])
    standing = {1: [seen_at(6.0)], 3: [seen_at(5.99)]}
    assert list_expected([DriveFrame(k, standing.get(k, []), CAMERA) for k in range(5)]) == {}


def test_a_plate_without_colours_is_found_where_another_frame_places_it() -> None:
    """All four markers are covered: no signal has a candidate."""
    near = shoot(PlacedFace(face_of(CODE), AHEAD_M)).image
    covered = dict.fromkeys([unit for corner in ("top-left", "top-right", "bottom-right", "bottom-left")
                             for unit in marker_units(corner)], (0.3, 0.3, 0.3))  # fmt: skip
    far = shoot(PlacedFace(painted(face_of(CODE), covered), AHEAD_M + 0.7))
    assert not any(reading.code for reading in decode_plates(far.image, camera=CAMERA))
    [reading] = decode_plates(near, camera=CAMERA)
    place = expect_plate(Expected(7, reading, (-0.5, -0.7, -0.9)), CAMERA)
    assert place is not None
    found = find_expected(far.image, place, CAMERA)
    assert found is not None
    assert (found.digits, found.frames, found.from_codebook) == (CODE.digits, (7,), False)
    assert found.pose is not None
    assert found.corners_px is not None
    assert np.abs(found.corners_px - far.truths[0].corners_px).max() < 1.5
    # neither a plate with another code nor the empty road is taken for it
    other = shoot(PlacedFace(face_of(OTHER), AHEAD_M + 0.7)).image
    assert find_expected(other, place, CAMERA) is None
    assert find_expected(shoot().image, place, CAMERA) is None


def test_digits_without_a_check_are_no_surer_where_another_frame_shows_them() -> None:
    plain = PlateCode("391204578613")
    face = face_of(plain)
    [reading] = decode_plates(shoot(PlacedFace(face, AHEAD_M)).image, camera=CAMERA)
    assert reading.certainty is Certainty.UNCHECKED
    place = expect_plate(Expected(7, reading, (-0.5, -0.7, -0.9)), CAMERA)
    assert place is not None
    found = find_expected(shoot(PlacedFace(face, AHEAD_M + 0.7)).image, place, CAMERA)
    assert found is not None
    assert (found.digits, found.certainty, found.confidence) == (
        plain.digits,
        Certainty.UNCHECKED,
        UNCHECKED_CONFIDENCE,
    )


def test_a_plate_that_is_found_takes_the_place_of_a_refused_one() -> None:
    square = np.array([(0, 0), (10, 0), (10, 10), (0, 10)], float)
    found = PlateReading(PlateOutcome.READ, square, code=CODE)
    here, away = PlateReading(PlateOutcome.UNSURE, square + 1), PlateReading(PlateOutcome.UNSURE, square + 50)
    assert with_expected([here, away], [found]) == [found, away]
    sure = PlateReading(PlateOutcome.READ, square, code=OTHER)
    assert with_expected([sure], [found]) == [sure]


@pytest.mark.parametrize("name", WEATHER)
def test_weather_changes_the_plate_or_its_light(name: str) -> None:
    rng = np.random.default_rng(3)
    weather = draw_weather(name, rng)
    face = face_of(CODE)
    scene = draw_scenes(face, weather.conditions, rng)[2]
    covered = weather.on_face(face)
    placed = weather.in_scene(replace(scene, faces=(replace(scene.faces[0], face=covered),)))
    changed = float(np.abs(covered.reflectance - face.reflectance).max())
    emission = placed.faces[0].face.emission
    assert (changed > 0.05) == (name != "dusk")
    assert (emission is not None and float(emission.max()) > 0.01) == (name == "wet")
    assert (weather.conditions.night_light is not None) == (name == "dusk")


# === Plates that the registry expects, by their patterns.


def grey_markers(code: PlateCode = CODE) -> Face:
    """A plate whose four markers are under snow: nothing of it has a colour."""
    hidden = [unit for corner in CORNERS for unit in marker_units(corner)]
    return painted(face_of(code), dict.fromkeys(hidden, SNOW))


NEIGHBOURS = tuple(PlateCode.from_registry_number(0xAB000000 + 7919 * number) for number in range(19))
CORNERS = ("top-left", "top-right", "bottom-right", "bottom-left")


@pytest.mark.parametrize("turned_deg", [-15.0, 0.0, 12.0])
def test_a_registered_plate_without_any_marker_is_read_by_its_pattern(turned_deg: float) -> None:
    shot = shoot(PlacedFace(grey_markers(), AHEAD_M, rotation_deg=turned_deg))
    assert not any(reading.digits for reading in decode_plates(shot.image, camera=CAMERA)), "by its colours"
    [reading] = decode_plates(shot.image, camera=CAMERA, codebook=(*NEIGHBOURS, CODE))
    assert (reading.digits, reading.is_registered) == (CODE.digits, True)
    assert reading.pose is not None
    corners_px = reading.corners_px
    assert corners_px is not None
    np.testing.assert_allclose(corners_px, shot.truths[0].corners_px, atol=1.0)


def test_it_is_not_taken_for_a_registered_neighbour_of_another_code() -> None:
    image = shoot(PlacedFace(grey_markers(), AHEAD_M)).image
    read = [one.digits for one in decode_plates(image, camera=CAMERA, codebook=NEIGHBOURS) if one.code is not None]
    assert read in ([], [CODE.digits]), "its own checks may confirm it"


def test_plain_digits_are_not_read_by_a_pattern_beside_a_registered_plate_that_differs_in_one() -> None:
    """Snow on two units makes the other plate's digits of it, and nothing but a check would show that."""
    built, shown = (PlateCode(digits, PlateScheme.POSITION, 8) for digits in ("623453036139", "623413036139"))
    image = shoot(PlacedFace(grey_markers(shown), AHEAD_M)).image
    for codebook in ((built, shown), (shown,)):
        assert not any(reading.code for reading in decode_plates(image, camera=CAMERA, codebook=codebook))


def test_it_is_not_sought_where_nothing_is_registered_or_the_mount_is_unknown() -> None:
    image = shoot(PlacedFace(grey_markers(), AHEAD_M)).image
    for options in ({"camera": CAMERA}, {"codebook": (CODE,)}):
        assert not any(reading.code for reading in decode_plates(image, **options))


def test_a_road_without_a_plate_shows_none_of_the_registry() -> None:
    for seed in range(3):
        image = shoot(seed=seed).image
        assert not any(reading.code for reading in decode_plates(image, camera=CAMERA, codebook=(*NEIGHBOURS, CODE)))
