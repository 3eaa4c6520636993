"""The proof renders what the writers write, and fails when it reads anything but the plate's own code."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from app.encoders.plate import (
    ArtworkOptions,
    Drawing,
    PlateOrder,
    encode_plate,
    encode_sheets,
    prove_plate,
    render_face,
)
from app.encoders.plate.drawing import Boxes, Layer
from app.encoders.plate.proof import UNIT_PX
from app.errors import ProofFailed
from app.markers.plate import PlateCode, PlateGeometry
from app.markers.reading import PlateOutcome, PlateReading
from tests.encoders.plate.artwork_reading import Rendering, marker_colours, read_digits

ROAD_PX = 36


def sampling_reader(image: np.ndarray, geometry: PlateGeometry) -> Sequence[PlateReading]:
    """Reads a rendered face by sampling it where the geometry says; refuses one without its markers."""
    per_mm = UNIT_PX / geometry.unit_mm
    side_px = per_mm * geometry.side_mm
    picture = Rendering(image, per_mm, ROAD_PX / per_mm, ROAD_PX / per_mm)
    size = (geometry.n, geometry.unit_mm, geometry.gap_mm)
    if marker_colours(picture, *size)[:4] != ["red", "green", "green", "green"]:
        return [PlateReading(PlateOutcome.GREEN_MARKER_MISSING)]
    digits = read_digits(picture, *size)
    corners = ROAD_PX - 0.5 + side_px * np.array([(0, 0), (1, 0), (1, 1), (0, 1)])
    scheme = "id" if not digits.isdecimal() or geometry.n > 8 else "position"
    try:
        code = PlateCode(digits, type(PlateCode("0" * 12).scheme)(scheme), geometry.n)
    except ValueError:
        return [PlateReading(PlateOutcome.CELLS_UNDECODABLE)]
    return [PlateReading(PlateOutcome.READ, corners, code=code, confidence=0.99)]


def _tampered(drawing: Drawing, change: Callable[[Drawing], list[object]]) -> Drawing:
    return replace(drawing, parts=tuple(change(drawing)))


@pytest.mark.parametrize(
    ("code", "geometry"),
    [
        (PlateCode("023792168411"), PlateGeometry()),
        (PlateCode("023792168411"), PlateGeometry(8, 20, 2)),
        (PlateCode("023792168411"), PlateGeometry(8, 50, 10)),
        (PlateCode.from_registry_number(2**48 - 5, n=10), PlateGeometry(10, 37.5, 2.5)),
        (PlateCode.from_registry_number(2**64 - 5, n=12), PlateGeometry(12, 35, 5)),
    ],
    ids=["8", "8-small", "8-large", "10", "12"],
)
def test_a_sound_drawing_passes(
    code: PlateCode, geometry: PlateGeometry, make_order: Callable[..., PlateOrder]
) -> None:
    drawing = encode_plate(make_order(code, geometry), ArtworkOptions(heaters=True, leds=True))
    proof = prove_plate(drawing, code, geometry, sampling_reader)
    assert proof.digits == code.digits
    assert proof.corner_error_px < 1e-6


def test_every_plate_of_a_sheet_is_proved_by_itself(make_order: Callable[..., PlateOrder]) -> None:
    codes = [PlateCode(f"{k:012d}") for k in (1, 987654321098, 5)]
    (sheet,) = encode_sheets([make_order(code) for code in codes], width_mm=1100, height_mm=900)
    for k, code in enumerate(codes):
        assert prove_plate(sheet, code, PlateGeometry(), sampling_reader, plate=k).digits == code.digits
    with pytest.raises(ProofFailed, match=f"reads {codes[0].digits} instead of {codes[1].digits}"):
        prove_plate(sheet, codes[1], PlateGeometry(), sampling_reader, plate=0)


def test_one_unit_of_the_wrong_colour_fails(make_order: Callable[..., PlateOrder]) -> None:
    def swap(drawing: Drawing) -> list[object]:
        dark = next(p for p in drawing.parts if isinstance(p, Boxes) and p.layer is Layer.CODE_DARK)
        return [*(p for p in drawing.parts if p is not dark), Boxes(Layer.CODE_DARK, dark.boxes_mm[1:])]

    drawing = encode_plate(make_order())
    with pytest.raises(ProofFailed, match="instead of 023792168411") as caught:
        prove_plate(_tampered(drawing, swap), PlateCode("023792168411"), PlateGeometry(), sampling_reader)
    assert caught.value.cure


def test_a_missing_marker_fails(make_order: Callable[..., PlateOrder]) -> None:
    def strip(drawing: Drawing) -> list[object]:
        return [p for p in drawing.parts if p.layer is not Layer.MARK_GREEN]

    with pytest.raises(ProofFailed, match="0 plates were read"):
        prove_plate(
            _tampered(encode_plate(make_order()), strip), PlateCode("023792168411"), PlateGeometry(), sampling_reader
        )


def test_a_plate_read_in_the_wrong_place_or_turned_fails(make_order: Callable[..., PlateOrder]) -> None:
    def turned(image: np.ndarray, geometry: PlateGeometry) -> Sequence[PlateReading]:
        (reading,) = sampling_reader(image, geometry)
        assert reading.corners_px is not None
        return [replace(reading, corners_px=np.roll(reading.corners_px, 1, axis=0))]

    with pytest.raises(ProofFailed, match="corners"):
        prove_plate(encode_plate(make_order()), PlateCode("023792168411"), PlateGeometry(), turned)


def test_the_rendering_shows_the_face_on_road_and_nothing_of_the_margin(
    make_order: Callable[..., PlateOrder],
) -> None:
    drawing = encode_plate(make_order())
    image, corners = render_face(drawing, px_per_mm=UNIT_PX / 35)
    side_px = 325 * UNIT_PX / 35
    assert image.shape[0] == image.shape[1] == int(np.ceil(side_px)) + 2 * ROAD_PX
    assert corners == pytest.approx(ROAD_PX - 0.5 + side_px * np.array([(0, 0), (1, 0), (1, 1), (0, 1)]))
    road = np.concatenate([image[: ROAD_PX - 3].reshape(-1, 3), image[:, : ROAD_PX - 3].reshape(-1, 3)])
    assert np.ptp(road) == 0
    assert 60 < road[0, 0] < 130
