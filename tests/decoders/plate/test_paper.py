"""Algorithm 1 of the paper, the peer: digits of a clear plate, and its five rejections by name."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from app.decoders.plate.paper import CONFIDENCE, decode_box, decode_plates_paper, find_markers, find_vertices
from app.errors import InvalidParameter
from app.markers.reading import PlateOutcome, PlateReading
from app.simulation.plate_scene import PlacedFace
from tests.decoders.plate.scenes import CAMERA, PAPER, face_of, marker_units, painted, shoot, shoot_plate

BLACK, GREY = (0.04,) * 3, (0.2,) * 3
PITCH_PX = 40


def upright(hidden: tuple[str, ...] = ()) -> np.ndarray:
    """The paper's plate from above, 40 px a pitch, on a grey road; some of its markers are black."""
    image = np.full((480, 480, 3), 110, np.uint8)
    image[76:404, 76:404] = 150
    for row in range(8):
        for column in range(8):
            y, x = 82 + PITCH_PX * row, 82 + PITCH_PX * column
            image[y : y + 35, x : x + 35] = 30 if PAPER.units[row, column] else 230
    for name, (y, x) in {"tl": (82, 82), "tr": (82, 322), "br": (322, 322), "bl": (322, 82)}.items():
        image[y : y + 75, x : x + 75] = 30 if name in hidden or name == "tl" else (40, 160, 40)
    if "tl" not in hidden:
        image[82:157, 82:157] = 230
        cv2.fillPoly(image, [np.array([(82, 82), (156, 82), (82, 156)])], (40, 40, 190))
    return image


def outcomes(image: np.ndarray) -> set[PlateOutcome]:
    readings = decode_plates_paper(image)
    assert all(r.digits is None and r.reason and r.confidence == 0 for r in readings)
    return {r.outcome for r in readings}


def test_the_paper_s_plate_shows_the_digits_that_the_paper_prints() -> None:
    """Dark is 1: with white = 1, as in lines 21 to 24 of the listing, its cells are no digits of the figure."""
    (reading,) = decode_plates_paper(upright())
    assert (reading.outcome, reading.digits) == (PlateOutcome.READ, PAPER.digits)
    assert reading.confidence == CONFIDENCE
    assert reading.corners_px is not None
    assert np.abs(reading.corners_px - [(77, 77), (402, 77), (402, 402), (77, 402)]).max() < 3


def test_a_plate_on_the_road_is_read_and_placed() -> None:
    image = shoot(PlacedFace(face_of(), 2.2, 0.0, 0.0)).image
    read = [r for r in decode_plates_paper(image, camera=CAMERA) if r.digits]
    assert [r.digits for r in read] == [PAPER.digits]
    assert read[0].pose is not None


@pytest.mark.parametrize("hidden", [("tr",), ("tr", "bl"), ("br", "bl")])
def test_hidden_green_markers_are_missing(hidden: tuple[str, ...]) -> None:
    assert outcomes(upright(hidden)) == {PlateOutcome.GREEN_MARKER_MISSING}


def test_a_plate_that_the_lower_edge_cuts_lacks_green_markers() -> None:
    assert outcomes(upright()[:300]) == {PlateOutcome.GREEN_MARKER_MISSING}


def test_two_painted_green_markers_are_missing_on_the_road() -> None:
    face = painted(face_of(), dict.fromkeys(marker_units("bottom-left") + marker_units("bottom-right"), GREY))
    assert PlateOutcome.GREEN_MARKER_MISSING in outcomes(shoot(PlacedFace(face, 2.6, 0.1, 0.0)).image)


def test_without_a_triangle_the_red_marker_is_missing() -> None:
    assert outcomes(upright(("tl",))) == {PlateOutcome.RED_MARKER_MISSING}


def test_a_road_of_one_colour_gives_nothing() -> None:
    assert decode_plates_paper(np.full((240, 320, 3), 110, np.uint8)) == []


def test_vertices_that_are_not_of_four_markers_are_beyond_them() -> None:
    """One green bar has both lower vertices, and the third green area none."""
    image = upright()
    image[322:397, 82:397] = (40, 160, 40)
    image[220:240, 220:240] = (40, 160, 40)
    reading = decode_box(image, (72, 72, 408, 408))
    assert (reading.outcome, reading.confidence) == (PlateOutcome.VERTICES_BEYOND_MARKERS, 0.0)


def test_one_corner_for_two_makes_fewer_than_four_vertices() -> None:
    crop = np.full((60, 200, 3), 110, np.uint8)
    crop[20:28, 5:13] = (40, 160, 40)
    greens, reds = find_markers(crop)
    assert (len(greens), len(reds)) == (1, 0)
    assert len(find_vertices(greens)) == 4
    dot = np.zeros((60, 200), np.uint8)
    dot[30, 100] = 1
    assert len(find_vertices([dot])) < 4


def test_cells_that_are_no_digit_cannot_be_decoded() -> None:
    image = upright()
    image[82 : 82 + 75, 162 : 162 + 75] = 30  # the first cell shows 15
    assert outcomes(image) == {PlateOutcome.CELLS_UNDECODABLE}


def test_grey_frames_are_refused() -> None:
    with pytest.raises(InvalidParameter, match="blue, green, red"):
        decode_plates_paper(np.zeros((100, 100), np.uint8))


def test_a_refused_reading_of_our_own_decoder_is_as_sure_as_its_digits() -> None:
    from app.decoders.plate.reader import decode_plates

    face = painted(face_of(), dict.fromkeys(marker_units("bottom-left"), BLACK))
    readings: list[PlateReading] = decode_plates(shoot(PlacedFace(face, 2.6, 0.1, 0.0)).image)
    assert readings
    assert all(r.confidence == 0 for r in readings if r.code is None and r.likely_code is None)
    assert decode_plates(shoot_plate(PAPER).image)[0].confidence > 0.9
