"""The registry as codebook: it decides what the frame leaves open and never makes a plate up."""

from __future__ import annotations

import numpy as np
import pytest

from app.decoders.plate.reader import decode_plates
from app.markers.plate import PlateCode
from app.markers.reading import PlateOutcome
from tests.decoders.plate.scenes import PAPER, road, shoot_plate

NEIGHBOURS = tuple(PlateCode(f"02{3000 + 97 * k:04d}16{8000 + 61 * k:04d}") for k in range(15))
FAR_M = 6.5  # about 12 rows: too few for the frame alone


def read(image: np.ndarray, codebook: tuple[PlateCode, ...]) -> list[tuple[str | None, bool]]:
    readings = decode_plates(image, codebook=codebook)
    return [(r.digits, r.from_codebook) for r in readings if r.outcome is PlateOutcome.READ]


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_the_codebook_decides_a_frame_that_is_too_hard_alone(seed: int) -> None:
    frame = shoot_plate(ahead_m=FAR_M, left_m=0.1 * seed, turn_deg=20.0 * seed, seed=seed)
    assert read(frame.image, ()) in ([], [(PAPER.digits, False)])
    assert [digits for digits, _ in read(frame.image, (*NEIGHBOURS, PAPER))] == [PAPER.digits]


def test_a_decision_by_the_codebook_says_so() -> None:
    hard = [shoot_plate(ahead_m=FAR_M, left_m=0.1 * k, turn_deg=20.0 * k, seed=k).image for k in range(4)]
    alone = [read(image, ()) for image in hard]
    known = [read(image, (*NEIGHBOURS, PAPER)) for image in hard]
    assert [] in alone  # else these frames are not hard any more, and this test shows nothing
    for without, with_it in zip(alone, known, strict=True):
        if not without:
            assert with_it == [(PAPER.digits, True)]


@pytest.mark.parametrize("ahead_m", [2.5, 4.0, 5.0, 6.5, 7.5])
def test_a_codebook_without_the_plate_never_names_another(ahead_m: float) -> None:
    for seed in range(3):
        frame = shoot_plate(ahead_m=ahead_m, turn_deg=50.0 * seed, seed=seed)
        assert {digits for digits, _ in read(frame.image, NEIGHBOURS)} <= {PAPER.digits}


def test_a_plate_that_differs_in_one_digit_is_not_mistaken_for_the_registered_one() -> None:
    near = PlateCode("023792168412")
    for seed, ahead_m in enumerate((2.5, 3.5, 5.0, 6.0)):
        frame = shoot_plate(ahead_m=ahead_m, seed=seed)
        assert {digits for digits, _ in read(frame.image, (near, *NEIGHBOURS))} <= {PAPER.digits}


@pytest.mark.parametrize("name", ["adv_test1.jpg", "adv_test5.jpg", "p1_solidWhiteCurve.jpg", "vid_60.jpg"])
def test_a_codebook_makes_no_plate_of_a_road(name: str) -> None:
    assert read(road(name), (PAPER, *NEIGHBOURS)) == []


def test_codes_of_another_size_do_not_count() -> None:
    larger = PlateCode.from_position(114.1793123, 22.3045678, n=10)
    assert read(shoot_plate().image, (larger,)) == [(PAPER.digits, False)]
