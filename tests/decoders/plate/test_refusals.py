"""Plates that are damaged, hidden or half out of view: named outcomes, never wrong digits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from app.decoders.plate.reader import decode_plates
from app.markers.plate import PlateCode, code_cells
from app.markers.reading import PlateOutcome, PlateReading
from app.simulation.plate_face import Face, PlateWear
from app.simulation.plate_scene import PlacedFace, Sensor
from tests.decoders.plate.scenes import PAPER, face_of, marker_units, painted, shoot, shoot_plate

BLACK, GREY, WHITE = (0.04,) * 3, (0.2,) * 3, (0.75,) * 3
ID = PlateCode.from_registry_number(0xDEADBEEF)
AHEAD_M = 2.6
PAPERS_CASES = {  # section II-D4
    PlateOutcome.GREEN_MARKER_MISSING, PlateOutcome.RED_MARKER_MISSING, PlateOutcome.FEWER_THAN_FOUR_VERTICES,
    PlateOutcome.VERTICES_BEYOND_MARKERS, PlateOutcome.CELLS_UNDECODABLE,
}  # fmt: skip


def read_face(face: Face, *, codebook: tuple[PlateCode, ...] = (), turn_deg: float = 0.0) -> list[PlateReading]:
    return decode_plates(shoot(PlacedFace(face, AHEAD_M, 0.1, turn_deg)).image, codebook=codebook)


def digits_in(readings: list[PlateReading]) -> list[str | None]:
    return [r.digits for r in readings if r.outcome is PlateOutcome.READ]


def with_damage(code: PlateCode, cells: tuple[int, ...], how: str, seed: int = 0) -> Face:
    """The plate with cells inverted, black, stained (one colour for all units) or unreadable (each unit another)."""
    rng = np.random.default_rng(seed)
    units: dict[tuple[int, int], tuple[float, float, float]] = {}
    for cell in cells:
        row, column = code_cells(code.n)[cell]
        for r in (2 * row, 2 * row + 1):
            for c in (2 * column, 2 * column + 1):
                level = float(rng.uniform(0.12, 0.5))
                colours = {
                    "inverted": WHITE if code.units[r, c] else BLACK, "black": BLACK, "stained": (0.2, 0.25, 0.3),
                    "unreadable": (level, level, level),
                }  # fmt: skip
                units[r, c] = colours[how]
    return painted(face_of(code), units, code.n)


@pytest.mark.parametrize("turn_deg", [0.0, 130.0])
@pytest.mark.parametrize("colour", [BLACK, GREY, WHITE], ids=["black", "grey", "white"])
@pytest.mark.parametrize("corner", ["top-right", "bottom-right", "bottom-left"])
def test_a_green_marker_painted_over_is_missing(
    corner: str, colour: tuple[float, float, float], turn_deg: float
) -> None:
    face = painted(face_of(), dict.fromkeys(marker_units(corner), colour))
    readings = read_face(face, turn_deg=turn_deg)
    assert {r.outcome for r in readings} == {PlateOutcome.GREEN_MARKER_MISSING}
    assert all(r.digits is None and r.reason for r in readings)


@pytest.mark.parametrize("turn_deg", [0.0, 130.0])
@pytest.mark.parametrize("colour", [BLACK, GREY, WHITE], ids=["black", "grey", "white"])
def test_a_red_marker_painted_over_is_missing(colour: tuple[float, float, float], turn_deg: float) -> None:
    face = painted(face_of(), dict.fromkeys(marker_units("top-left"), colour))
    readings = read_face(face, turn_deg=turn_deg)
    assert readings
    assert {r.outcome for r in readings} == {PlateOutcome.RED_MARKER_MISSING}
    assert all(r.digits is None and r.reason for r in readings)


@pytest.mark.parametrize("ahead_m", [2.6, 3.4])
def test_a_red_square_is_no_triangle(ahead_m: float) -> None:
    """A chessboard with coloured corners has a plate's grid and colours; only its red corner is of another shape."""
    red = (0.05, 0.05, 0.5)
    face = painted(face_of(PlateCode("999999999999")), dict.fromkeys(marker_units("top-left"), red))
    image = shoot(PlacedFace(face, ahead_m, 0.1)).image
    readings = decode_plates(image)
    assert digits_in(readings) == []
    assert PlateOutcome.RED_MARKER_MISSING in {r.outcome for r in readings}
    assert any("square" in r.reason for r in readings)
    assert digits_in(decode_plates(image, codebook=(PlateCode("999999999999"), PAPER))) == ["999999999999"]


@pytest.mark.parametrize("corner", ["top-left", "bottom-right"])
def test_the_registry_vouches_for_a_plate_without_a_marker(corner: str) -> None:
    face = painted(face_of(), dict.fromkeys(marker_units(corner), GREY))
    others = PlateCode("023792168999"), PlateCode("023811168999")
    assert digits_in(read_face(face, codebook=(PAPER, *others))) == [PAPER.digits]
    assert digits_in(read_face(face, codebook=others)) == []


@pytest.mark.parametrize("left_m", [1.5, 1.55])
def test_a_plate_that_the_frame_cuts_has_fewer_than_four_vertices(left_m: float) -> None:
    frame = shoot_plate(ahead_m=AHEAD_M, left_m=left_m)
    assert not frame.truths[0].in_view
    readings = decode_plates(frame.image)
    assert {r.outcome for r in readings} == {PlateOutcome.FEWER_THAN_FOUR_VERTICES}
    assert digits_in(readings) == []


@pytest.mark.parametrize("cut", ["left", "bottom", "top", "right"])
@pytest.mark.parametrize("share", [0.1, 0.3, 0.5, 0.8])
def test_a_plate_half_out_of_the_frame_is_never_read_wrong(cut: str, share: float) -> None:
    frame = shoot_plate(ahead_m=2.2, turn_deg=20.0)
    low, high = frame.truths[0].corners_px.min(axis=0), frame.truths[0].corners_px.max(axis=0)
    x, y = (low + share * (high - low)).astype(int)
    part = {
        "left": frame.image[:, x:], "right": frame.image[:, :x], "top": frame.image[y:], "bottom": frame.image[:y]
    }[cut]  # fmt: skip
    readings = decode_plates(np.ascontiguousarray(part))
    assert digits_in(readings) == []
    assert {r.outcome for r in readings} <= PAPERS_CASES


def test_a_face_without_dark_units_is_undecodable() -> None:
    readings = decode_plates(shoot_plate(PlateCode("000000000000"), ahead_m=AHEAD_M).image)
    assert {r.outcome for r in readings} == {PlateOutcome.CELLS_UNDECODABLE}


@pytest.mark.parametrize("seed", [20, 53, 95])
def test_a_stain_that_turns_a_light_unit_dark_is_no_digit(seed: int) -> None:
    """Each of these shows a wrong digit, every cell clear: only the residuals beside the units show the stains."""
    wear = PlateWear(contrast_loss=0.2, patchy_loss=0.4, dirt_blobs=3, dirt_mm=16.0)
    readings = read_face(face_of(wear=wear, seed=seed), turn_deg=20.0)
    assert digits_in(readings) == []
    assert [r.outcome for r in readings] == [PlateOutcome.UNSURE]
    assert "stain" in readings[0].reason


def test_the_registry_confirms_digits_beside_a_stain() -> None:
    wear = PlateWear(contrast_loss=0.2, patchy_loss=0.4, dirt_blobs=3, dirt_mm=16.0)
    face = face_of(wear=wear, seed=5)
    assert digits_in(read_face(face, turn_deg=20.0)) == []
    assert digits_in(read_face(face, turn_deg=20.0, codebook=(PAPER, PlateCode("123456789012")))) == [PAPER.digits]


def test_the_same_stain_does_not_matter_where_digits_are_checked() -> None:
    wear = PlateWear(contrast_loss=0.2, patchy_loss=0.4, dirt_blobs=3, dirt_mm=16.0)
    for seed in (20, 53, 95):
        assert digits_in(read_face(face_of(ID, wear=wear, seed=seed), turn_deg=20.0)) in ([], [ID.digits])


@pytest.mark.parametrize("how", ["inverted", "stained", "unreadable"])
@pytest.mark.parametrize("cells", [(5,), (0, 11), (2, 7)])
def test_two_damaged_cells_of_an_id_plate_are_corrected(cells: tuple[int, ...], how: str) -> None:
    """With the registry's help; alone, cells that look sound are no reason to believe a full correction."""
    damaged = with_damage(ID, cells, how)
    readings = read_face(damaged, codebook=(ID, PAPER))
    assert digits_in(readings) == [ID.digits]
    assert set(readings[0].corrected_cells) <= set(cells)
    assert digits_in(read_face(damaged)) in ([], [ID.digits])
    if how == "inverted":
        assert set(readings[0].corrected_cells) == set(cells)


@pytest.mark.parametrize("cells", [(2, 5, 7), (0, 3, 8), (1, 4, 10)])
def test_three_wrong_cells_of_an_id_plate_are_refused(cells: tuple[int, ...]) -> None:
    readings = read_face(with_damage(ID, cells, "inverted"))
    assert digits_in(readings) == []
    assert {r.outcome for r in readings} <= {PlateOutcome.UNSURE, *PAPERS_CASES}


@pytest.mark.parametrize("how", ["inverted", "black", "unreadable"])
@pytest.mark.parametrize("cells", [(2, 5, 7), (4, 5, 6, 7)])
def test_with_the_registry_these_damaged_id_plates_are_not_read_wrong(cells: tuple[int, ...], how: str) -> None:
    codebook = (ID, *(PlateCode.from_registry_number(0xDEADBE00 + k) for k in range(12)))
    assert digits_in(read_face(with_damage(ID, cells, how), codebook=codebook)) in ([], [ID.digits])


@pytest.mark.parametrize("cells", [(5,), (2, 7)])
def test_black_or_unreadable_cells_of_a_decimal_plate_are_refused(cells: tuple[int, ...]) -> None:
    for how in ("black", "unreadable"):  # black says 15, which is no decimal digit
        readings = read_face(with_damage(PAPER, cells, how))
        assert digits_in(readings) == []
        assert {r.outcome for r in readings} <= {PlateOutcome.UNSURE, *PAPERS_CASES}


@pytest.mark.parametrize(("ahead_m", "turn_deg"), [(6.3, 0.0), (6.3, 4.0), (6.0, 4.0)])
def test_digits_that_nothing_checks_need_rows_enough(ahead_m: float, turn_deg: float) -> None:
    """A worn unit of a row and a half looks like the other level now and then (one frame in 2,600)."""

    def read(code: PlateCode, *known: PlateCode) -> PlateReading:
        face = PlacedFace(face_of(code), ahead_m, 0.1, turn_deg)
        still = shoot(face, seed=3, sensor=Sensor(blur_px=0.6), change=lambda scene: replace(scene, speed_m_s=0.0))
        return decode_plates(still.image, codebook=known)[0]

    small = read(PAPER)
    assert 10 < (small.height_px or 0) < 12
    assert small.outcome is PlateOutcome.UNSURE
    assert "no check" in small.reason
    assert read(PAPER, PAPER).digits == PAPER.digits
    assert read(ID).digits == ID.digits
