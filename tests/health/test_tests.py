"""Sequential tests of markers: what is found, and what must not be."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest

from app.health import (
    Evidence,
    Fault,
    HealthRules,
    MarkerState,
    Pass,
    VehicleState,
    Verdict,
    judge_drive,
    update_marker,
    update_unregistered,
)
from app.health.marker_tests import item_priority, missing_gain, moved_ratios

DAY_S = 86_400.0


def _seen(**values: object) -> Evidence:
    return Evidence(**{"marker_id": "m", "family": "plate", "read": True, "read_probability": 0.9, **values})  # type: ignore[arg-type]


def _run(evidence: Evidence, vehicles: Iterator[str], state: MarkerState | None = None) -> tuple[int, list[Verdict]]:
    """Passes until something is suspected, at most 60."""
    state = state or MarkerState.new(evidence.family)
    for count, vehicle in enumerate(vehicles, 1):
        verdicts = update_marker(state, evidence, vehicle, count * DAY_S)
        if verdicts:
            return count, verdicts
        if count >= 60:
            break
    return 0, []


def _fleet() -> Iterator[str]:
    yield from (f"v{k}" for k in range(100))


@pytest.mark.parametrize("distance_m", [1.0, 1.5, 4.0, 12.0, 30.0])
def test_a_marker_that_moved_is_found_after_at_most_five_vehicles(distance_m: float) -> None:
    count, verdicts = _run(_seen(offset_m=(distance_m, 0.0), sigma_m=0.18), _fleet())
    assert 3 <= count <= 5
    assert [verdict.fault for verdict in verdicts] == [Fault.MOVED]
    offset_m = verdicts[0].offset_m
    assert offset_m is not None
    assert offset_m[0] == pytest.approx(distance_m, abs=0.15)
    assert verdicts[0].vehicles == count


def test_a_survey_error_of_a_hand_is_no_move() -> None:
    assert _run(_seen(offset_m=(0.25, 0.0), sigma_m=0.1), _fleet()) == (0, [])


def test_a_registered_position_that_is_inaccurate_is_no_move() -> None:
    assert _run(_seen(offset_m=(0.9, 0.0), sigma_m=0.1, survey_m=0.5), _fleet()) == (0, [])


def test_outliers_in_all_directions_are_no_move() -> None:
    state, rng = MarkerState.new("plate"), np.random.default_rng(5)
    for count, turn in enumerate(rng.uniform(0, 2 * math.pi, 200)):
        far_m = rng.uniform(1.0, 6.0) if rng.random() < 0.1 else 0.05
        seen = _seen(offset_m=(far_m * math.cos(turn), far_m * math.sin(turn)), sigma_m=0.18)
        assert update_marker(state, seen, f"v{count}", count * DAY_S) == []


@pytest.mark.parametrize(
    "evidence",
    [
        _seen(offset_m=(3.0, 0.0), sigma_m=0.1),
        _seen(read=False),
        _seen(reversed=True),
        _seen(quality=-6.0),
        _seen(elsewhere=(10.0, 50.0), read_probability=0.0),
        _seen(two_places=True),
    ],
)
def test_one_vehicle_alone_never_makes_a_suspect_nor_do_two(evidence: Evidence) -> None:
    assert _run(evidence, iter(["only"] * 60)) == (0, [])
    assert _run(evidence, iter(["one", "other"] * 30)) == (0, [])
    assert _run(evidence, _fleet())[0] >= 3


def test_a_marker_that_is_gone_is_found_and_a_reading_starts_the_test_anew() -> None:
    gone = _seen(family="magnet", read=False)
    assert 5 <= _run(gone, _fleet())[0] <= 12
    state = MarkerState.new("magnet")
    for count in range(60):
        evidence = gone if count % 4 else _seen(family="magnet")
        assert update_marker(state, evidence, f"v{count}", count * DAY_S) == []


def test_a_plate_that_is_dirty_takes_longer_than_a_magnet() -> None:
    assert _run(_seen(read=False), _fleet())[0] > 2 * _run(_seen(family="magnet", read=False), _fleet())[0]


def test_passes_that_say_nothing_change_nothing() -> None:
    state = MarkerState.new("plate")
    assert update_marker(state, _seen(read=False, read_probability=0.0), "v", DAY_S) == []
    assert state.ratios == {}


def test_a_code_far_away_is_a_clone_where_its_own_place_shows_it_too() -> None:
    far = _seen(elsewhere=(10.0, 50.0), read_probability=0.0)
    assert _run(far, _fleet())[1][0].fault is Fault.MOVED
    state = MarkerState.new("plate")
    found: list[Verdict] = []
    for count in range(12):
        update_marker(state, _seen(), f"home{count}", count * DAY_S)
        found += update_marker(state, far, f"far{count}", count * DAY_S)
    assert {verdict.fault for verdict in found} == {Fault.CLONED}
    assert found[0].elsewhere == (10.0, 50.0)


def test_far_readings_at_different_places_are_misreads() -> None:
    state = MarkerState.new("plate")
    for count in range(20):
        far = _seen(elsewhere=(10.0 + 0.01 * count, 50.0), read_probability=0.0)
        assert update_marker(state, far, f"v{count}", count * DAY_S) == []


def test_a_code_that_nobody_registered_is_found() -> None:
    state = MarkerState.new("plate")
    counts = [len(update_unregistered(state, 0.999, f"v{k}", k * DAY_S)) for k in range(5)]
    assert counts[:2] == [0, 0]
    assert counts[-1] == 1


def test_a_decision_starts_a_test_anew() -> None:
    state = MarkerState.new("plate")
    moved = _seen(offset_m=(2.0, 0.0), sigma_m=0.15)
    count, _ = _run(moved, _fleet(), state)
    state.reset(Fault.MOVED)
    assert state.ratios == {}
    assert _run(moved, _fleet(), state)[0] == count


def test_a_state_survives_being_stored() -> None:
    state = MarkerState.new("plate")
    for count in range(4):
        update_marker(state, _seen(offset_m=(2.0, 0.1), sigma_m=0.3, reversed=True, quality=-1.0), f"v{count}", 9.0)
        update_marker(state, _seen(elsewhere=(1.0, 2.0)), f"v{count}", 9.0)
    again = MarkerState.from_document(state.document())
    assert again == state
    assert {type(name) for name in state.document()["ratios"]} == {str}


def test_the_limit_follows_the_traffic() -> None:
    rules = HealthRules()
    missing, moved = Fault.MISSING, Fault.MOVED
    assert rules.upper(missing, 10_000.0) - rules.upper(missing, 1000.0) == pytest.approx(math.log(10))
    assert rules.upper(missing, 1.0) == rules.upper(missing, 100.0) == pytest.approx(math.log(5 * 100 / 1e-3))
    assert rules.upper(missing, 500.0) - rules.upper(moved, 500.0) == pytest.approx(math.log(100))


def test_ratios_of_many_markers_are_those_of_each() -> None:
    rng = np.random.default_rng(3)
    offset, sigma = rng.normal(0, 1, (20, 6, 2)), rng.uniform(0.1, 0.4, (20, 6))
    used, disc = rng.random((20, 6)) < 0.8, np.full(20, 0.25)
    together, _ = moved_ratios(offset, sigma, used, disc, 5.0)
    for k in range(20):
        alone, _ = moved_ratios(offset[k : k + 1], sigma[k : k + 1], used[k : k + 1], disc[:1], 5.0)
        assert alone[0] == pytest.approx(together[k])
    assert (np.abs(together) <= 7.0 * 6).all()


def test_a_miss_says_little_of_a_marker_that_is_seldom_read() -> None:
    sure, _ = missing_gain(0.95, [1.0], (1.0,), 0.002)
    seldom, levels = missing_gain(0.95, [0.0, 0.0, 1.0], (1.0, 0.6, 0.3), 0.002)
    assert sure == pytest.approx(math.log(0.998 / 0.05), rel=1e-6)
    assert 0.2 < seldom < 0.4
    assert levels == pytest.approx([0.0, 0.0, 1.0])


# --- drives -----------------------------------------------------------------------------------------------------------


def _drive(count: int = 12, **values: object) -> list[Pass]:
    common = {"expected": 0.95, "sigma_m": 0.08, "position_sigma_m": 0.1, "heading_deg": 90.0, **values}
    return [Pass(f"m{k}", "plate", True, along=float(k), **common) for k in range(count)]  # type: ignore[arg-type]


def test_a_wrong_calibration_accuses_no_marker() -> None:
    judged = judge_drive(_drive(offset_m=(0.0, 1.8)), VehicleState(), 0.0)
    assert all(one.offset_m == pytest.approx((0.0, 0.0), abs=1e-9) for one in judged.evidence)
    assert judged.shift_m == pytest.approx((0.0, 1.8))


def test_one_marker_that_moved_stands_out_of_a_wrong_calibration() -> None:
    passes = _drive(offset_m=(0.0, 1.8))
    passes[5] = Pass("m5", "plate", True, 0.95, 5.0, (1.5, 1.8), 0.08, 0.1, heading_deg=90.0)
    found = judge_drive(passes, VehicleState(), 0.0).evidence
    assert found[5].offset_m == pytest.approx((1.5, 0.0), abs=1e-9)
    assert found[4].offset_m == pytest.approx((0.0, 0.0), abs=1e-9)


def test_the_shift_of_a_lone_marker_is_the_vehicles_own_record() -> None:
    vehicle = VehicleState()
    first = judge_drive(_drive(1, offset_m=(0.0, 1.0)), vehicle, 0.0).evidence[0]
    for _ in range(30):
        judge_drive(_drive(1, offset_m=(0.0, 1.0)), vehicle, 0.0)
    last = judge_drive(_drive(1, offset_m=(0.0, 1.0)), vehicle, 0.0).evidence[0]
    assert first.sigma_m > 0.5
    assert last.sigma_m < 0.25
    assert last.offset_m is not None
    assert math.hypot(*last.offset_m) < 0.2


def test_fog_and_a_dead_sensor_say_nothing_of_missing_markers() -> None:
    nothing = [Pass(f"m{k}", "plate", False, 0.95, float(k)) for k in range(12)]
    assert {one.read_probability for one in judge_drive(nothing, VehicleState(), 0.0).evidence} == {0.0}
    half = [Pass(f"m{k}", "plate", k % 4 == 0, 0.95, float(k)) for k in range(12)]
    assert max(one.read_probability for one in judge_drive(half, VehicleState(), 0.0).evidence) < 0.5
    clear = [Pass(f"m{k}", "plate", k != 5, 0.95, float(k)) for k in range(12)]
    assert judge_drive(clear, VehicleState(), 0.0).evidence[5].read_probability > 0.8


def test_a_single_frame_rests_on_the_vehicles_last_minutes() -> None:
    vehicle, miss = VehicleState(), [Pass("m", "plate", False, 0.95)]
    assert judge_drive(miss, vehicle, 0.0).evidence[0].read_probability == 0.0
    for k in range(6):
        judge_drive([Pass(f"o{k}", "plate", True, 0.95)], vehicle, 10.0 + k)
    assert judge_drive(miss, vehicle, 20.0).evidence[0].read_probability > 0.5
    assert judge_drive(miss, vehicle, 20.0 + 7200).evidence[0].read_probability == 0.0


def test_a_lone_cerpm_that_nobody_receives_is_missing_after_many_drives() -> None:
    def missed(family: str) -> Evidence:
        return judge_drive([Pass("m", family, False, 0.9)], VehicleState(), 0.0).evidence[0]

    assert missed("plate").read_probability == 0.0
    state = MarkerState.new("cerpm")
    assert _run(missed("cerpm"), _fleet(), state) == (0, [])
    count, verdicts = _run(missed("cerpm"), (f"w{k}" for k in range(100)), state)
    assert verdicts[0].fault is Fault.MISSING
    assert 60 + count < 80
    silent = [Pass(f"m{k}", "cerpm", False, 0.9, float(k)) for k in range(4)]
    assert {one.read_probability for one in judge_drive(silent, VehicleState(), 0.0).evidence} == {0.0}


def test_a_driver_on_the_wrong_way_accuses_no_marker_but_one_that_is_reversed_does_stand_out() -> None:
    judged = judge_drive(_drive(reversed=True), VehicleState(), 0.0)
    assert judged.wrong_way
    assert not judged.only_one
    assert not any(one.reversed for one in judged.evidence)
    passes = _drive(reversed=False)
    passes[3] = Pass("m3", "plate", True, along=3.0, reversed=True)
    judged = judge_drive(passes, VehicleState(), 0.0)
    assert not judged.wrong_way
    assert [one.marker_id for one in judged.evidence if one.reversed] == ["m3"]


def test_a_dark_drive_fades_no_marker() -> None:
    passes = _drive(quality=-5.0)
    passes[3] = Pass("m3", "plate", True, along=3.0, quality=-9.0)
    found = judge_drive(passes, VehicleState(), 0.0).evidence
    assert found[2].quality == pytest.approx(0.0)
    assert found[3].quality == pytest.approx(-4.0)


def test_a_message_has_no_vehicles_error() -> None:
    passes = [*_drive(offset_m=(0.0, 1.0)), Pass("c", "cerpm", True, offset_m=(1.5, 0), offset_is_absolute=True)]
    assert judge_drive(passes, VehicleState(), 0.0).evidence[-1].offset_m == (1.5, 0.0)


def test_wrong_way_drivers_come_first_and_busy_roads_before_quiet_ones() -> None:
    usual = {"acted_on": False, "ratio": 14.0, "limit": 13.0}
    quiet, busy = (item_priority("moved", **usual, month_passes=n) for n in (3.0, 3000.0))  # type: ignore[arg-type]
    stop = item_priority("moved", **{**usual, "acted_on": True}, month_passes=3000.0)  # type: ignore[arg-type]
    driver = item_priority("wrong-way-driver", acted_on=True, ratio=0.0, limit=0.0, month_passes=0.0)
    assert 0 < quiet < busy < stop < driver == 1.0
