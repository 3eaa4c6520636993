"""The test of a stretch of road over drives: which displacements of all its markers are reported, and which are not."""

from __future__ import annotations

import math

import numpy as np
import pytest

from app.health import Fault, StretchDrive, StretchState, Verdict, stretch_drive, update_stretch
from app.health.stretches import TURN_REACH_M
from app.values import Floats

RTK_M, PLAIN_M = 0.02, 2.0
EAST_DEG = 90.0


def _drive(
    left_m: float = 0.0, heading_deg: float = EAST_DEG, accuracy_m: float = RTK_M,
    shift_m: tuple[float, float] = (0.0, 0.0), turn_m: float = 0.0,
) -> StretchDrive:  # fmt: skip
    """A drive `left_m` to the left of the middle of a straight lane, whose markers are shifted east and north, and
    turned by an offset at its ends.
    """
    along = np.arange(0.0, 500.0, 5.0)
    yaw = math.radians(90.0 - heading_deg)
    ahead, left = np.array([math.cos(yaw), math.sin(yaw)]), np.array([-math.sin(yaw), math.cos(yaw)])
    lane = (along - along.mean())[:, None] * ahead
    turned = np.stack([-lane[:, 1], lane[:, 0]], axis=1) * turn_m / TURN_REACH_M
    normal = np.tile(left, (len(along), 1))
    found = stretch_drive(lane + left_m * left, lane + np.array(shift_m) + turned, normal, along, accuracy_m)
    return StretchDrive(8.0, 50.0, heading_deg, *found)


def _run(drives: list[StretchDrive], vehicles: list[str] | None = None) -> tuple[int, Verdict | None]:
    """Drives until something is reported, and what; 0 if nothing is."""
    state = StretchState(8.0, 50.0, EAST_DEG)
    for number, drive in enumerate(drives):
        verdict = update_stretch(state, drive, vehicles[number] if vehicles else f"v{number}", 3600.0 * (number + 1))
        state = StretchState.from_document(state.document())  # as it is stored between two uploads
        if verdict is not None:
            return number + 1, verdict
    return 0, None


def test_a_shift_is_found_by_a_few_drives_with_rtk_and_stated_across_the_road() -> None:
    drives, verdict = _run([_drive(shift_m=(0.7, 1.0))] * 10)
    assert 3 <= drives <= 5
    assert verdict is not None
    assert verdict.fault is Fault.SHIFTED
    found = verdict.displacement
    assert found is not None
    assert found.north_m == pytest.approx(1.0, abs=0.15)
    assert found.sigma_m < 0.25
    assert abs(found.east_m) < 0.05  # along a straight road nothing is seen of it
    assert found.east_sigma_m > 5.0
    assert found.north_sigma_m < 0.25
    assert found.directions == 1


def test_an_ordinary_receiver_needs_many_drives() -> None:
    rng = np.random.default_rng(3)
    errors = rng.normal(0.0, PLAIN_M, 400)
    drives, verdict = _run([_drive(error, accuracy_m=PLAIN_M, shift_m=(0.0, 1.0)) for error in errors.tolist()])
    assert 20 < drives < 400
    assert verdict is not None
    assert verdict.offset_m is not None
    assert verdict.offset_m[1] == pytest.approx(1.0, abs=0.5)


def test_a_habit_is_distinguished_from_a_shift_by_drives_in_both_directions() -> None:
    """All drivers keep half a metre to the left: in both directions that is no shift, in one it may be."""
    both = [_drive(-0.5, heading) for _ in range(60) for heading in (EAST_DEG, EAST_DEG + 180.0)]
    assert _run(both) == (0, None)
    drives, verdict = _run([_drive(shift_m=(0.0, 0.7), heading_deg=EAST_DEG + 180.0 * (k % 2)) for k in range(30)])
    assert drives > 0
    assert verdict is not None
    assert verdict.displacement is not None
    assert verdict.displacement.directions == 2
    one_way = [_drive(0.2) for _ in range(200)]  # what drivers may have in common
    assert _run(one_way) == (0, None)


def test_a_turn_is_found_and_stated_anticlockwise() -> None:
    drives, verdict = _run([_drive(turn_m=1.0)] * 10)
    assert drives >= 3
    assert verdict is not None
    assert verdict.fault is Fault.TURNED
    assert verdict.displacement is not None
    assert verdict.displacement.turn_deg == pytest.approx(math.degrees(1.0 / TURN_REACH_M), rel=0.15)
    assert 0.0 < verdict.displacement.turn_sigma_deg < 0.05


def test_a_bend_shows_both_axes() -> None:
    along = np.arange(0.0, 500.0, 5.0)
    yaw = along / 200.0
    lane = 200.0 * np.stack([np.sin(yaw), 1.0 - np.cos(yaw)], axis=1)
    normal = np.stack([-np.sin(yaw), np.cos(yaw)], axis=1)
    found = stretch_drive(lane, lane + np.array([0.8, -0.8]), normal, along, RTK_M)
    _drives, verdict = _run([StretchDrive(8.0, 50.0, 18.0, *found)] * 10)
    assert verdict is not None
    assert verdict.offset_m == pytest.approx((0.8, -0.8), abs=0.2)
    assert verdict.displacement is not None
    assert max(verdict.displacement.east_sigma_m, verdict.displacement.north_sigma_m) < 0.4


@pytest.mark.parametrize("shift_m", [1.0, 5.0])
def test_neither_one_vehicle_nor_two_report_a_stretch(shift_m: float) -> None:
    drive = _drive(shift_m=(0.0, shift_m))
    assert _run([drive] * 40, ["only"] * 40) == (0, None)
    assert _run([drive] * 40, ["one", "other"] * 20) == (0, None)


def test_two_vehicles_with_a_wrong_datum_among_many_report_nothing() -> None:
    wrong = _drive(shift_m=(0.0, 1.5))
    names = [f"wrong{k // 7 % 2}" if k % 7 == 0 else f"v{k % 30}" for k in range(300)]
    assert _run([wrong if name.startswith("wrong") else _drive() for name in names], names) == (0, None)


def test_a_shift_that_begins_after_many_drives_is_found() -> None:
    drives, verdict = _run([_drive(0.02 * (k % 5 - 2)) for k in range(150)] + [_drive(shift_m=(0.0, 1.0))] * 30)
    assert 150 < drives < 180
    assert verdict is not None
    assert verdict.fault is Fault.SHIFTED


def test_correct_stretches_are_accepted_by_receivers_that_err_as_they_state() -> None:
    rng = np.random.default_rng(8)
    for accuracy_m in (RTK_M, PLAIN_M):
        errors = rng.normal(0.0, math.hypot(accuracy_m, 0.2), 300)
        headings = EAST_DEG + 180.0 * rng.integers(0, 2, 300)
        driven = zip(errors.tolist(), headings.tolist(), strict=True)
        assert _run([_drive(off_m, heading_deg, accuracy_m) for off_m, heading_deg in driven]) == (0, None)


def test_an_inaccurate_survey_that_says_so_is_no_shift() -> None:
    drives = [_drive(0.0, EAST_DEG + 180.0 * (k % 2), shift_m=(0.0, 0.6)) for k in range(60)]
    assert _run(drives)[0] > 0
    for drive in drives:
        drive.survey_m = 0.5
    assert _run(drives) == (0, None)


def test_evidence_about_another_point_is_the_same_evidence() -> None:
    """A turn about a point 100 m further east is a turn about the first one and a shift."""
    drive = _drive(turn_m=1.0, shift_m=(0.0, 0.3))
    east_deg = 100.0 / (111_320.0 * math.cos(math.radians(50.0)))
    information, weighted = drive.about(8.0 + east_deg, 50.0)
    ours: Floats = np.linalg.solve(information + 1e-6 * np.eye(4), weighted)
    own: Floats = np.linalg.solve(drive.information + 1e-6 * np.eye(4), drive.weighted)
    assert own[2] == pytest.approx(1.0, abs=0.02)
    assert ours[2] == pytest.approx(own[2], abs=0.02)
    # the markers of the other point are displaced by the turn too; a habit shares what is across the road
    assert (ours[1] - ours[3]) - (own[1] - own[3]) == pytest.approx(100.0 / TURN_REACH_M, abs=0.05)
