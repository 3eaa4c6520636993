"""Print grades of simulated photos: each fault lowers its own parameters and no other; what cannot be graded is
refused."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from app.decoders.plate.print_grade import grade_print
from app.errors import PrintNotGraded
from app.markers.plate import PlateCode, PlateGeometry, PlateScheme
from app.markers.print_grade import THRESHOLDS, PrintGrade, PrintParameter
from app.markers.print_grade import PrintParameterName as Name
from app.markers.reading import PlateOutcome
from app.simulation.plate_face import PlateLook
from app.simulation.plate_scene import Shadow
from benchmarks.scenes.printed_plate import PrintFaults, Stain
from tests.decoders.plate.print_photos import CODE, GEOMETRY, LOOK, photo_of, pixels

pytestmark = pytest.mark.slow

LIGHT_UNIT, DARK_UNIT = (5, 3), (3, 3)  # of CODE
BLACK_GAPS = replace(LOOK, gap=(0.05, 0.05, 0.05))
WHITE_GAPS = replace(LOOK, gap=(0.7, 0.7, 0.7))


def graded(photo: bytes, **declared: Any) -> PrintGrade:
    return grade_print(pixels(photo), **{"code": CODE, "geometry": GEOMETRY, **declared})


def parameter(grade: PrintGrade, name: Name) -> PrintParameter:
    return next(one for one in grade.parameters if one.name is name)


def below_a(grade: PrintGrade) -> set[Name]:
    return {one.name for one in grade.parameters if one.grade < 4}


def test_the_units_named_here_have_these_paints() -> None:
    assert not CODE.units[LIGHT_UNIT]
    assert CODE.units[DARK_UNIT]


@pytest.mark.parametrize("look", [LOOK, BLACK_GAPS, WHITE_GAPS], ids=["dark gaps", "black gaps", "white gaps"])
@pytest.mark.parametrize("tilt_deg", [0.0, 12.0])
def test_a_good_print_has_an_a_in_everything(look: PlateLook, tilt_deg: float) -> None:
    grade = graded(photo_of(look=look, tilt_deg=tilt_deg))
    assert (grade.letter, below_a(grade), grade.read) == ("A", set(), CODE.digits)
    assert grade.view.tilt_deg == pytest.approx(tilt_deg, abs=1.0)
    contrast = parameter(grade, Name.SYMBOL_CONTRAST)
    assert contrast.value == pytest.approx(100 * (1 - 0.04 / 0.75), abs=2.0)
    assert all(one.cure is None for one in grade.parameters)


FAULTS: list[tuple[str, PlateLook, PrintFaults, set[Name], float]] = [
    ("grey for black", replace(LOOK, dark=(0.3, 0.3, 0.3)), PrintFaults(), {Name.SYMBOL_CONTRAST}, 3),
    ("a pale light unit", LOOK, PrintFaults(faded={LIGHT_UNIT: 0.28}), {Name.MODULATION, Name.REFLECTANCE_MARGIN}, 3),
    ("a pale dark unit", LOOK, PrintFaults(faded={DARK_UNIT: 0.33}), {Name.MODULATION, Name.REFLECTANCE_MARGIN}, 2),
    ("stretched", LOOK, PrintFaults(stretch=0.07), {Name.AXIAL_NONUNIFORMITY}, 3),
    ("shortened", LOOK, PrintFaults(stretch=-0.10), {Name.AXIAL_NONUNIFORMITY}, 1),
    ("a displaced unit", WHITE_GAPS, PrintFaults(shifts_mm={DARK_UNIT: (0.0, 16.5)}), {Name.GRID_NONUNIFORMITY}, 3),
    ("ink that bleeds", WHITE_GAPS, PrintFaults(growth_mm=1.5), {Name.PRINT_GROWTH}, 3),
    ("closed gaps", WHITE_GAPS, PrintFaults(growth_mm=2.8), {Name.PRINT_GROWTH}, 0),
    ("closed black gaps", BLACK_GAPS, PrintFaults(growth_mm=2.8), {Name.PRINT_GROWTH}, 0),
    ("units too small", BLACK_GAPS, PrintFaults(growth_mm=-1.9), {Name.PRINT_GROWTH}, 2),
    ("pale green", replace(LOOK, green=(0.18, 0.28, 0.15)), PrintFaults(), {Name.COLOUR}, 3),
    ("pale red", replace(LOOK, red=(0.24, 0.24, 0.32)), PrintFaults(), {Name.COLOUR}, 2),
    ("a stain", LOOK, PrintFaults(stains=(Stain(40.0, -40.0, 22.0, (0.3, 0.3, 0.3)),)), {Name.DAMAGE}, 3),
]


@pytest.mark.parametrize(("look", "faults", "lowered", "least"), [f[1:] for f in FAULTS], ids=[f[0] for f in FAULTS])
def test_a_fault_lowers_its_own_parameters_and_no_other(
    look: PlateLook, faults: PrintFaults, lowered: set[Name], least: float
) -> None:
    grade = graded(photo_of(look=look, faults=faults, seed=3))
    assert below_a(grade) == lowered, [(one.name, one.value, one.finding) for one in grade.parameters if one.grade < 4]
    assert grade.overall == least
    assert set(grade.limited_by) <= lowered
    assert all(one.finding and one.cure for one in grade.parameters if one.name in lowered)


def test_the_measured_values_are_those_that_were_printed() -> None:
    faults = PrintFaults(stretch=0.05, growth_mm=0.8, shifts_mm={DARK_UNIT: (-6.0, 0.0)}, faded={LIGHT_UNIT: 0.2})
    grade = graded(photo_of(look=WHITE_GAPS, faults=faults, turn_deg=100.0))
    assert parameter(grade, Name.AXIAL_NONUNIFORMITY).value == pytest.approx(0.05 / 1.025, abs=0.006)
    assert parameter(grade, Name.PRINT_GROWTH).value == pytest.approx(1.6 / 5, abs=0.08)
    displaced = parameter(grade, Name.GRID_NONUNIFORMITY)
    assert displaced.value == pytest.approx(6.0 / GEOMETRY.pitch_mm, abs=0.025)  # one edge is hidden: growth adds 0.02
    assert displaced.unit_at == (DARK_UNIT[0] + 1, DARK_UNIT[1] + 1)
    weakest = parameter(grade, Name.MODULATION)
    assert weakest.value == pytest.approx(60.0, abs=3.0)
    assert weakest.unit_at == (LIGHT_UNIT[0] + 1, LIGHT_UNIT[1] + 1)


def test_a_wrong_digit_fails_and_is_named() -> None:
    printed = PlateCode("023792168415")
    grade = graded(photo_of(printed))
    assert below_a(grade) == {Name.REFLECTANCE_MARGIN, Name.DAMAGE, Name.DECODE}
    assert grade.letter == "F"
    assert grade.read == printed.digits
    assert (grade.wrong == (printed.units != CODE.units)).all()
    assert f"reads {printed.digits}, not {CODE.digits}" in parameter(grade, Name.DECODE).finding
    assert "1 units are of the wrong paint" in parameter(grade, Name.DAMAGE).finding


@pytest.mark.parametrize(("wrong", "unused", "letter"), [(0, 1.0, "A"), (1, 0.5, "B"), (2, 0.0, "F")])
def test_wrong_units_use_up_the_error_correction_of_an_id_plate(wrong: int, unused: float, letter: str) -> None:
    code = PlateCode.from_registry_number(987654321)
    places = [(2, 2), (4, 4)][:wrong]
    grade = graded(photo_of(code, faults=PrintFaults(faded=dict.fromkeys(places, 1.0))), code=code)
    found = parameter(grade, Name.UNUSED_ERROR_CORRECTION)
    assert (found.value, found.letter) == (unused, letter)
    assert grade.wrong.sum() == wrong


def test_without_a_code_the_plate_is_what_the_photo_shows() -> None:
    code = PlateCode.from_position(8.4, 49.0, n=10, check_digits=2)
    geometry = PlateGeometry(10, 30.0, 4.0)
    grade = graded(photo_of(code, geometry=geometry), code=None, geometry=geometry)
    assert (grade.letter, grade.expected, grade.code.digits) == ("A", False, code.digits)
    assert grade.code.scheme in (PlateScheme.POSITION, PlateScheme.POSITION_CHECK)


def test_a_plate_that_cannot_be_read_is_graded_against_its_code() -> None:
    stains = tuple(Stain(x, -20.0, 22.0, (0.75, 0.75, 0.75)) for x in (-20.0, 20.0))
    photo = photo_of(faults=PrintFaults(stains=stains))
    grade = graded(photo)
    assert grade.outcome is not PlateOutcome.READ
    assert parameter(grade, Name.DAMAGE).grade == 0
    with pytest.raises(PrintNotGraded, match="not read") as refused:
        graded(photo, code=None)
    assert "declare the code" in str(refused.value.cure)


def test_uneven_light_is_no_fault_of_the_print() -> None:
    image = pixels(photo_of()).astype(np.float32)
    slope = np.linspace(0.8, 1.05, image.shape[1], dtype=np.float32)[None, :, None]
    grade = grade_print(np.clip(image * slope, 0, 250).astype(np.uint8), code=CODE, geometry=GEOMETRY)
    assert below_a(grade) == set()
    assert grade.view.light_ratio > 1.15


def test_the_focal_length_of_the_exif_allows_more_tilt() -> None:
    photo = photo_of(tilt_deg=24.0)
    assert graded(photo, focal_35mm=26.0).letter == "A"
    with pytest.raises(PrintNotGraded, match="oblique") as refused:
        graded(photo)
    assert "15 degrees" in str(refused.value.limit)
    with pytest.raises(PrintNotGraded, match="oblique"):
        graded(photo_of(tilt_deg=38.0, side_px=600.0), focal_35mm=26.0)


REFUSED: list[tuple[str, dict[str, Any], str]] = [
    ("small", {"side_px": 300.0}, "covers 2"),
    ("blurred", {"blur_px": 7.0}, "blurred|not found|no plate"),
    ("over-exposed", {"exposure": 1.7}, "over-exposed"),
    ("dark", {"exposure": 0.07}, "dark"),
    ("shadow", {"shadow": Shadow(edge_light=0.35, edge_angle_deg=30.0, edge_offset_m=0.03)}, "uneven"),
]


@pytest.mark.parametrize(("view", "reason"), [r[1:] for r in REFUSED], ids=[r[0] for r in REFUSED])
def test_a_photo_that_shows_the_plate_badly_is_refused(view: dict[str, Any], reason: str) -> None:
    with pytest.raises(PrintNotGraded, match=reason) as refused:
        graded(photo_of(**view))
    assert refused.value.field == "photo"
    assert refused.value.limit
    assert refused.value.cure


def test_a_blurred_photo_is_told_from_one_without_a_plate() -> None:
    with pytest.raises(PrintNotGraded, match="edges are"):
        grade_print(cv2.GaussianBlur(pixels(photo_of()), (0, 0), 5.0), code=CODE, geometry=GEOMETRY)


def test_a_blurred_photo_of_closed_gaps_is_refused_too() -> None:
    image = pixels(photo_of(look=BLACK_GAPS, faults=PrintFaults(growth_mm=2.8)))
    with pytest.raises(PrintNotGraded, match="blurred"):
        grade_print(cv2.GaussianBlur(image, (0, 0), 6.0), code=CODE, geometry=GEOMETRY)


def test_photos_without_one_whole_plate_are_refused() -> None:
    image = pixels(photo_of(tilt_deg=0.0, turn_deg=0.0))
    height, width = image.shape[:2]
    road = np.full_like(image, 120)
    with pytest.raises(PrintNotGraded, match="grey"):
        grade_print(np.repeat(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)[..., None], 3, axis=2))
    coloured = road.copy()
    cv2.circle(coloured, (width // 2, height // 2), 200, (20, 20, 200), -1)
    with pytest.raises(PrintNotGraded, match="no plate was found"):
        grade_print(coloured, code=CODE)
    left, right = (
        pixels(photo_of(side_px=500.0, turn_deg=0.0)),
        pixels(photo_of(PlateCode("111122223333"), turn_deg=0.0)),
    )
    with pytest.raises(PrintNotGraded, match="2 plates"):
        grade_print(np.hstack([left, right]))
    with pytest.raises(PrintNotGraded, match=r"not 10 x 10|no plate was found"):
        grade_print(image, code=PlateCode.from_position(8.0, 49.0, n=10))


def test_thresholds_fall_in_order_and_their_limits_belong_to_the_better_grade() -> None:
    for name, thresholds in THRESHOLDS.items():
        ordered = sorted(thresholds.limits, reverse=thresholds.higher_is_better)
        assert list(thresholds.limits) == ordered, name
        if len(set(ordered)) == 4:
            assert [thresholds.grade(limit) for limit in thresholds.limits] == [4, 3, 2, 1], name
            beyond = -1.0 if thresholds.higher_is_better else 1e3
            assert thresholds.grade(beyond) == 0, name
