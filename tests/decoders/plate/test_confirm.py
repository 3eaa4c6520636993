"""Tentative readings: what makes one, and which frames confirm it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from app.decoders.plate.confirm import MAX_JOINT_ERROR, UNCHECKED_CONFIDENCE, UnitVerification, confirm_frames
from app.decoders.plate.evidence import MAX_ERROR, MAX_TENTATIVE_ERROR
from app.markers.plate import PlateCode
from app.markers.reading import Certainty, PlateOutcome, PlateReading

CODE, OTHER, ELSEWHERE = PlateCode("023792168411"), PlateCode("023792168418"), PlateCode("623754300719")


def likelihoods(spot: float = -3.0) -> np.ndarray:
    """Of units that look as read but for the first, which a spot of paint explains by so much better. [log]"""
    found = np.tile([0.0, -40.0, -12.0, -30.0, -8.0], (48, 1))
    found[0, 4] = spot
    return found


def tentative(code: PlateCode = CODE, spot: float = 1.0, height_px: float = 30.0) -> PlateReading:
    return PlateReading(
        PlateOutcome.UNSURE, likely_code=code, doubtful_cells=(0,), confidence=0.9, height_px=height_px,
        unit_log_likelihoods=likelihoods(spot), reason="a stain may hide units",
    )  # fmt: skip


def approached(spot: float, number: int) -> PlateReading:
    """A tentative reading from the nearer, the greater the number of the frame."""
    return tentative(spot=spot, height_px=30.0 * 1.2**number)


def sure(code: PlateCode = CODE, height_px: float = 36.0) -> PlateReading:
    return PlateReading(PlateOutcome.READ, code=code, confidence=0.9999, height_px=height_px)


def test_the_certainty_follows_from_the_digits() -> None:
    assert (sure().certainty, tentative().certainty) == (Certainty.UNCHECKED, Certainty.TENTATIVE)
    assert replace(sure(), is_registered=True).certainty is Certainty.SURE
    checked = PlateCode.from_registry_number(0xDEADBEEF)
    assert replace(sure(), code=checked).certainty is Certainty.SURE
    assert tentative().digits is None
    assert PlateReading(PlateOutcome.UNSURE).certainty is None


def test_evidence_that_is_too_weak_in_one_frame_adds_up_over_three() -> None:
    alone = UnitVerification(likelihoods(-3.0)).error_probability
    assert alone > MAX_JOINT_ERROR
    frames = [(k, [approached(-3.0, k)]) for k in (4, 7, 8)]
    confirmed = confirm_frames(frames)
    assert sorted(confirmed) == [4, 7, 8]
    for [reading] in confirmed.values():
        assert (reading.outcome, reading.code, reading.likely_code) == (PlateOutcome.READ, CODE, None)
        assert reading.frames == (4, 7, 8)
        assert reading.certainty is Certainty.UNCHECKED  # tape is in all of them
        assert reading.confidence == UNCHECKED_CONFIDENCE
        assert reading.doubtful_cells == ()


def test_a_spot_that_is_in_every_frame_adds_up_too() -> None:
    assert MAX_ERROR < UnitVerification(likelihoods(4.0)).error_probability < MAX_TENTATIVE_ERROR
    assert confirm_frames([(k, [approached(4.0, k)]) for k in range(4)]) == {}


def test_frames_of_a_standing_vehicle_count_as_one() -> None:
    assert confirm_frames([(k, [tentative(spot=-3.0)]) for k in range(20)]) == {}
    both = [(0, [tentative(spot=-3.0)]), (1, [tentative(spot=-3.0)]), (2, [approached(-3.0, 2)])]
    assert sorted(confirm_frames(both)) == [0, 1, 2]


def test_a_sure_frame_confirms_a_tentative_one() -> None:
    confirmed = confirm_frames([(0, [tentative()]), (1, [sure()])])
    assert [reading.code for reading in confirmed[0]] == [CODE]
    assert 1 not in confirmed


def test_a_sure_frame_does_not_confirm_a_larger_one_that_is_unsure() -> None:
    """A far plate hides a stain that a near one shows."""
    far = sure(height_px=15.0)
    assert confirm_frames([(0, [far]), (1, [tentative(height_px=30.0)])]) == {}
    near = sure(height_px=60.0)
    assert set(confirm_frames([(0, [far]), (1, [tentative(height_px=30.0)]), (2, [near])])) == {1}


@pytest.mark.parametrize("between", [tentative(OTHER), sure(OTHER)])
def test_frames_that_show_about_the_same_digits_confirm_nothing(between: PlateReading) -> None:
    seen = [(0, [tentative(spot=-3.0)]), (1, [between]), (2, [approached(-3.0, 2)])]
    assert confirm_frames(seen) == {}
    apart = [(0, [tentative(spot=-3.0)]), (1, [replace(between, code=None, likely_code=ELSEWHERE)]),
             (2, [approached(-3.0, 2)])]  # fmt: skip
    assert sorted(confirm_frames(apart)) == [0, 2]


def test_one_frame_and_frames_far_apart_confirm_nothing() -> None:
    assert confirm_frames([(0, [tentative(spot=-3.0)])]) == {}
    assert (
        confirm_frames([(0, [tentative(spot=-3.0)]), *((k, []) for k in range(1, 6)), (6, [approached(-3.0, 6)])]) == {}
    )


def test_readings_whose_pixels_were_not_compared_add_nothing() -> None:
    bare = replace(tentative(), unit_log_likelihoods=None)
    assert confirm_frames([(0, [bare]), (1, [bare])]) == {}
