"""Positions of the vehicle's own receiver beside markers: they help where there are none, and never spoil a track."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from app.geodesy.frames import metres_per_radian
from app.tracks import Clock, PositionFix, Track, TrackInput
from app.tracks.estimate import estimate_track
from tests.tracks.drives import T0_S, Truth, drive, recording

CLOCKS = (Clock("trace"), Clock("camera"), Clock("receiver"))


def positions(
    truth: Truth, sigma_m: float, *, bias_m: tuple[float, float] = (0.0, 0.0), late_s: float = 0.0, seed: int = 5
) -> tuple[PositionFix, ...]:
    """One in five seconds, with an error that stays for a minute, and a standard deviation that is stated for it."""
    rng, found = np.random.default_rng(seed), []
    error = rng.normal(0, sigma_m, 2)
    keep = math.exp(-5.0 / 60.0)
    for number, at_s in enumerate(np.arange(1.0, truth.time_s[-1] - T0_S - 1.0, 5.0)):
        error = keep * error + math.sqrt(1 - keep**2) * rng.normal(0, sigma_m, 2)
        lon, lat = (float(np.interp(T0_S + at_s, truth.time_s, values)) for values in (truth.lon, truth.lat))
        east, north = (float(value) for value in metres_per_radian(np.float64(lat)))
        found.append(
            PositionFix(
                "receiver", T0_S + at_s - late_s, math.degrees(lon + (error[0] + bias_m[0]) / east),
                math.degrees(lat + (error[1] + bias_m[1]) / north), (sigma_m**2, 0.0, sigma_m**2),
                decode_id="log", place=number,
            )
        )  # fmt: skip
    return tuple(found)


def with_outage(truth: Truth) -> TrackInput:
    """Markers every 5 s but for the two minutes in the middle of four."""
    seen = recording(truth).along(5.0, end_s=60.0, clock="trace").along(5.0, start_s=180.0, clock="trace")
    return seen.track_input(clocks=CLOCKS)


def errors_m(truth: Truth, track: Track, from_s: float, to_s: float) -> float:
    inside = (track.time_s > T0_S + from_s) & (track.time_s < T0_S + to_s)
    return float(np.sqrt((truth.errors_m(track)[inside] ** 2).sum(1).mean()))


def test_positions_bridge_an_outage_and_leave_the_rest_as_it_is() -> None:
    truth = drive(240)
    given = with_outage(truth)
    alone = estimate_track(given)
    both = estimate_track(replace(given, fixes=(*given.fixes, *positions(truth, 0.1, late_s=0.2))))
    assert errors_m(truth, both, 80, 160) < 0.7 * errors_m(truth, alone, 80, 160)
    assert errors_m(truth, both, 5, 55) < 1.1 * errors_m(truth, alone, 5, 55)
    (receiver,) = both.receivers
    assert (receiver.used, receiver.left_out) == (48, 0)
    assert receiver.stated_m == pytest.approx(0.1 * math.sqrt(2))
    assert receiver.assumed_m == receiver.stated_m
    clock = next(clock for clock in both.clocks if clock.clock == "receiver")
    assert abs(clock.offset_s - 0.2) < 4 * clock.sigma_s < 0.4
    assert {result.fix.marker_id for result in both.fixes} == {fix.marker_id for fix in given.fixes}


@pytest.mark.parametrize(("sigma_m", "bias_m"), [(0.02, 1.5), (2.0, 12.0), (0.5, 3000.0)])
def test_a_biased_receiver_does_not_spoil_the_track_where_markers_are(sigma_m: float, bias_m: float) -> None:
    truth = drive(240)
    given = with_outage(truth)
    alone = estimate_track(given)
    wrong = positions(truth, sigma_m, bias_m=(bias_m, -0.5 * bias_m))
    both = estimate_track(replace(given, fixes=(*given.fixes, *wrong)))
    assert all(result.used for result in both.fixes)
    assert errors_m(truth, both, 5, 55) < 1.2 * errors_m(truth, alone, 5, 55) + 0.01
    assert errors_m(truth, both, 185, 235) < 1.2 * errors_m(truth, alone, 185, 235) + 0.01
    assert errors_m(truth, both, 60, 180) < 1.2 * max(errors_m(truth, alone, 60, 180), 1.2 * bias_m)
    (receiver,) = both.receivers
    assert receiver.assumed_m > 0.5 * bias_m


def test_a_jump_of_the_receiver_is_left_out() -> None:
    truth = drive(240)
    given = with_outage(truth)
    good = positions(truth, 0.3)
    jumped = positions(truth, 0.3, bias_m=(40.0, 0.0))
    mixed = tuple(wrong if 20 <= k < 24 else right for k, (right, wrong) in enumerate(zip(good, jumped, strict=True)))
    track = estimate_track(replace(given, fixes=(*given.fixes, *mixed)))
    (receiver,) = track.receivers
    assert receiver.left_out == 4
    assert receiver.assumed_m == receiver.stated_m
    assert errors_m(truth, track, 80, 160) < 1.0


def test_a_receiver_alone_gives_a_track() -> None:
    truth = drive(120)
    given = recording(truth).track_input(clocks=CLOCKS)
    track = estimate_track(replace(given, fixes=positions(truth, 0.5)))
    assert errors_m(truth, track, 5, 115) < 1.5
    assert track.fixes == ()
    assert track.receivers[0].used == 24
