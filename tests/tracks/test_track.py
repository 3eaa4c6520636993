"""Tracks of simulated drives against the truth."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from app.errors import InvalidParameter
from app.geodesy.frames import metres_per_radian
from app.plots.track import plot_track
from app.tracks import Clock, ClockState, LanePath, LeftOutReason, Samples, TrackInput, TrackRules
from app.tracks.estimate import estimate_track
from app.tracks.files import fix_marker, write_geojson
from tests.tracks.drives import T0_S, drive, recording


def test_scale_bias_and_offset_are_found_and_the_track_is_better_than_its_fixes() -> None:
    truth = drive(120)
    seen = recording(truth).along(6.0, clock="trace").along(4.0, start_s=5.0, late_s=0.3)
    track = estimate_track(seen.track_input())
    assert truth.rms_m(track) < 0.08
    camera = next(clock for clock in track.clocks if clock.clock == "camera")
    assert camera.state is ClockState.ESTIMATED
    assert abs(camera.offset_s - 0.3) < 4 * camera.sigma_s < 0.05
    assert abs(track.speed_scale[0] - 0.02) < 4 * track.speed_scale[1] < 0.02
    assert abs(track.heading_bias_deg[0] - 1.0) < 4 * track.heading_bias_deg[1] < 1.0
    assert all(result.used for result in track.fixes)
    assert track.gaps == ()


def test_errors_fit_their_covariance() -> None:
    squares = []
    for seed in range(12):
        truth = drive(60)
        seen = recording(truth, seed).along(7.0).along(9.0, clock="trace")
        track = estimate_track(seen.track_input())
        k = int(np.argmin(np.abs(track.time_s - T0_S - 31.7)))
        error = truth.errors_m(track)[k]
        east, cross, north = track.covariance_m2[k]
        squares.append(error @ np.linalg.solve([[east, cross], [cross, north]], error))
    assert 12.4 < sum(squares) < 39.4  # chi-square with 24 degrees of freedom, 2.5 % on both sides


def test_a_wrong_first_fix_does_not_lock_the_filter_in() -> None:
    truth = drive(60)
    seen = recording(truth)
    seen.see(2.0, off_m=(50.0, -30.0))
    seen.along(5.0, start_s=4.0, clock="trace")
    track = estimate_track(seen.track_input())
    assert seen.left_out(track) == seen.wrong
    assert truth.rms_m(track) < 0.2
    result = next(result for result in track.fixes if not result.used)
    assert result.reason is LeftOutReason.OUTLIER
    assert result.distance > 10
    assert math.hypot(result.along_m, result.across_m) == pytest.approx(math.hypot(50, 30), abs=1.5)


def test_a_cloned_marker_seen_in_three_frames_is_left_out() -> None:
    truth = drive(60)
    seen = recording(truth).along(5.0)
    for at in (31.0, 31.1, 31.2):
        seen.see(at, off_m=(-35.0, 36.0), marker="clone")
    track = estimate_track(seen.track_input())
    assert seen.left_out(track) == seen.wrong


def test_small_outliers_are_found_between_good_markers() -> None:
    truth = drive(90)
    seen = recording(truth).along(3.0)
    for at in (22.0, 40.0, 62.0):
        seen.see(at, off_m=(0.9, 0.9))
    assert seen.left_out(estimate_track(seen.track_input())) == seen.wrong


def test_the_offset_is_not_observable_at_constant_speed_without_another_marker_sensor() -> None:
    truth = drive(40, speed=lambda t: np.full(t.size, 15.0), turning=lambda t: np.full(t.size, 0.4))
    track = estimate_track(recording(truth).along(5.0).track_input())
    camera = next(clock for clock in track.clocks if clock.clock == "camera")
    assert camera.state is ClockState.NOT_OBSERVABLE
    assert camera.sigma_s > 0.25


def test_a_clock_that_is_set_during_the_drive_is_split_there() -> None:
    truth = drive(120)
    seen = recording(truth).along(6.0, clock="trace")
    seen.along(4.0, start_s=5.0, end_s=60.0).along(4.0, start_s=61.0, late_s=-0.8)
    track = estimate_track(seen.track_input())
    parts = [clock for clock in track.clocks if clock.clock == "camera"]
    assert [part.jumped for part in parts] == [False, True]
    assert parts[0].offset_s == pytest.approx(0.0, abs=0.05)
    assert parts[1].offset_s == pytest.approx(-0.8, abs=0.05)
    assert T0_S + 57.0 < parts[1].from_s < T0_S + 66.0
    assert all(result.used for result in track.fixes)


def test_times_that_run_backwards_start_a_new_part() -> None:
    truth = drive(120)
    seen = recording(truth).along(6.0, clock="trace")
    seen.along(4.0, start_s=5.0, end_s=60.0).along(4.0, start_s=61.0, late_s=1.6)
    late = [fix.time_s > T0_S + 59 and fix.clock == "camera" for fix in seen.fixes]
    seen.fixes = [
        replace(fix, time_s=fix.time_s - 4.0 * set_back) for fix, set_back in zip(seen.fixes, late, strict=True)
    ]
    track = estimate_track(seen.track_input(clocks=(Clock("trace"), Clock("camera", sigma_s=2.0))))
    parts = [clock for clock in track.clocks if clock.clock == "camera"]
    assert len(parts) == 2
    assert parts[1].offset_s == pytest.approx(5.6, abs=0.1)
    assert any("backwards" in warning for warning in track.warnings)


@pytest.mark.parametrize(("lon_deg", "lat_deg"), [(179.999, -17.0), (8.0, 84.0), (-179.999, 71.0), (0.0, 0.0)])
def test_the_antimeridian_and_high_latitudes(lon_deg: float, lat_deg: float) -> None:
    truth = drive(
        60, lon_deg=lon_deg, lat_deg=lat_deg, turning=lambda t: np.interp(t, [0, 25, 40, 60], [1.5, 1.5, 4.7, 4.7])
    )
    track = estimate_track(recording(truth).along(5.0).along(7.0, clock="trace").track_input())
    assert truth.rms_m(track) < 0.2
    assert np.abs(track.lon_deg).max() <= 180.0
    assert all(result.used for result in track.fixes)


def test_reversing_a_u_turn_and_standstill() -> None:
    def speed(t: np.ndarray) -> np.ndarray:
        return np.interp(t, [0, 20, 25, 35, 40, 55, 60, 90], [8, 8, 0, 0, -3, -3, 6, 6])

    truth = drive(90, speed=speed, turning=lambda t: np.interp(t, [0, 65, 75, 90], [3.0, 3.0, 6.14, 6.14]))
    track = estimate_track(recording(truth).along(4.0).along(6.0, clock="trace").track_input())
    assert truth.rms_m(track) < 0.12
    assert track.speed_m_s.min() == pytest.approx(-3.0, abs=0.2)
    assert all(result.used for result in track.fixes)


def test_the_order_of_the_input_has_no_effect() -> None:
    truth = drive(50)
    seen = recording(truth).along(4.0)
    seen.see(20.0)
    seen.see(20.0, off_m=(9.0, 9.0))
    given = seen.track_input()
    first = estimate_track(given)
    rng = np.random.default_rng(5)
    for _ in range(3):
        fixes = tuple(given.fixes[k] for k in rng.permutation(len(given.fixes)))
        order = rng.permutation(given.speeds[0].time_s.size)
        speeds = Samples("trace", given.speeds[0].time_s[order], given.speeds[0].value[order], 0.05)
        again = estimate_track(replace(given, fixes=fixes, speeds=(speeds,), clocks=given.clocks[::-1]))
        assert np.abs(again.lat_deg - first.lat_deg).max() < 1e-9
        assert seen.left_out(again) == seen.left_out(first)


def test_an_outage_is_a_stated_gap_with_an_honest_covariance() -> None:
    truth = drive(150)
    seen = recording(truth).along(5.0, end_s=45.0, clock="trace").along(5.0, start_s=110.0, clock="trace")
    track = estimate_track(seen.track_input(), TrackRules(max_sigma_m=0.3))
    (gap,) = track.gaps
    assert T0_S + 43 < gap.from_s < gap.to_s < T0_S + 112
    assert 500 < gap.length_m < 1200
    assert gap.max_sigma_m > 0.3
    assert track.in_gap.any()
    off = np.hypot(*truth.errors_m(track).T)
    assert (off < 4 * track.sigma_m).all()


def test_a_lane_path_holds_the_track_across_an_outage() -> None:
    truth = drive(150)
    seen = recording(truth).along(5.0, end_s=45.0).along(5.0, start_s=110.0)
    east, _north = metres_per_radian(truth.lat)
    left_m = 0.3  # of the lane's middle
    lon = truth.lon + left_m * np.cos(truth.heading) / east
    lat = truth.lat - left_m * np.sin(truth.heading) / _north
    path = LanePath("lane", np.degrees(lon[::50]), np.degrees(lat[::50]), 0.05)
    without = estimate_track(seen.track_input())
    held = estimate_track(replace(seen.track_input(), paths=(path,)))
    assert held.path_points > 50
    middle = (without.time_s > T0_S + 50) & (without.time_s < T0_S + 105)
    assert held.sigma_m[middle].max() < without.sigma_m[middle].max()
    assert truth.rms_m(held) < 0.5


def test_fixes_alone_give_a_track() -> None:
    truth = drive(60)
    track = estimate_track(recording(truth).along(1.0).track_input(samples=False))
    assert truth.rms_m(track) < 0.3


def test_one_fix_places_the_drive_and_none_is_an_error() -> None:
    truth = drive(30)
    seen = recording(truth)
    with pytest.raises(InvalidParameter, match="no fix"):
        estimate_track(seen.track_input())
    seen.see(10.0, clock="trace", sigma_m=0.05)
    track = estimate_track(seen.track_input())
    at = int(np.argmin(np.abs(track.time_s - T0_S - 10.0)))
    assert track.sigma_m[at] < 0.15
    assert truth.rms_m(track) < 20
    assert (np.hypot(*truth.errors_m(track).T) < 5 * track.sigma_m + 0.1).all()


def test_a_single_fix_without_anything_else() -> None:
    seen = recording(drive(5))
    seen.see(2.0, heading=False)
    track = estimate_track(seen.track_input(samples=False))
    assert len(track.time_s) >= 1
    assert np.isfinite(track.covariance_m2).all()


def test_a_fix_without_a_track_by_others_is_written_without_a_distance_from_it() -> None:
    seen = recording(drive(5))
    seen.see(2.0, heading=False)
    track = estimate_track(seen.track_input(samples=False))
    unknown = replace(track.fixes[0], distance=math.nan, along_m=math.nan, across_m=math.nan)
    marker = fix_marker(unknown)
    assert (marker.used, marker.distance, marker.along_m, marker.across_m) == (True, None, None, None)
    features = json.loads(write_geojson(track, "one", [marker]))["features"]
    assert [one["properties"]["distance"] for one in features if one["properties"]["kind"] == "marker"] == [None]
    assert "nan" not in plot_track(replace(track, fixes=(unknown,)), "one")


def test_many_fixes_of_one_marker_at_a_standstill_are_no_better_than_their_survey() -> None:
    truth = drive(30, speed=lambda t: np.zeros(t.size))
    seen = recording(truth).along(0.1, marker="one", sigma_m=0.1)
    seen.fixes = [replace(fix, common_m2=0.08**2) for fix in seen.fixes]
    track = estimate_track(seen.track_input())
    assert np.median(track.sigma_m) > 0.08


def test_sensors_that_do_not_overlap_are_refused_by_name() -> None:
    truth = drive(20)
    seen = recording(truth).along(3.0)
    given = seen.track_input()
    late = tuple(replace(fix, time_s=fix.time_s + 3600) for fix in given.fixes)
    with pytest.raises(InvalidParameter, match=r"trace ends .* before camera begins"):
        estimate_track(replace(given, fixes=late))
    with pytest.raises(InvalidParameter, match="not declared"):
        estimate_track(replace(given, clocks=(Clock("trace"),)))


def test_a_pause_of_all_sensors_is_a_stated_gap() -> None:
    truth = drive(120)
    given = recording(truth).along(4.0, end_s=40.0).along(4.0, start_s=80.0).track_input()
    kept = [(s.time_s < T0_S + 41) | (s.time_s > T0_S + 79) for s in (given.speeds[0], given.headings[0])]
    speeds = Samples("trace", given.speeds[0].time_s[kept[0]], given.speeds[0].value[kept[0]], 0.05)
    headings = Samples("trace", given.headings[0].time_s[kept[1]], given.headings[0].value[kept[1]], 0.3)
    track = estimate_track(TrackInput(given.clocks, given.fixes, (speeds,), (headings,)))
    assert any(gap.reason == "no sensor recorded" for gap in track.gaps)


def test_two_speeds_align_their_clocks() -> None:
    truth = drive(120)
    given = recording(truth).along(5.0, clock="trace").track_input(clocks=(Clock("trace"), Clock("gnss", sigma_s=2.0)))
    late = Samples("gnss", given.speeds[0].time_s[::10] - 4.2, given.speeds[0].value[::10], 0.1)
    track = estimate_track(replace(given, speeds=(*given.speeds, late)))
    gnss = next(clock for clock in track.clocks if clock.clock == "gnss")
    assert gnss.offset_s == pytest.approx(4.2, abs=0.1)


@pytest.mark.parametrize("seed", range(6))
def test_random_recordings_raise_or_return_finite_numbers(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = drive(float(rng.uniform(3, 40)), speed=lambda t: rng.choice([0.0, -4.0, 20.0]) + 0 * t)
    seen = recording(truth, seed)
    for _ in range(int(rng.integers(1, 40))):
        off = tuple(rng.normal(0, 10 ** rng.uniform(0, 4), 2)) if rng.random() < 0.4 else (0.0, 0.0)
        late_s, heading = float(rng.choice([0, 0.5, 30])), bool(rng.random() < 0.5)
        seen.see(float(rng.uniform(0, 40)), off_m=off, heading=heading, late_s=late_s)
    seen.fixes += [seen.fixes[0]] * 3
    track = estimate_track(seen.track_input(samples=bool(seed % 2)))
    for values in (track.lon_deg, track.lat_deg, track.heading_deg, track.speed_m_s, track.covariance_m2):
        assert np.isfinite(values).all()


def test_a_wrong_marker_is_left_out_with_all_its_frames() -> None:
    truth = drive(90)
    seen = recording(truth).along(6.0, clock="trace")
    for number, at in enumerate(np.arange(4.0, 84.0, 8.0)):
        off = (2.5, -2.0) if number == 5 else (0.0, 0.0)
        for later in (0.0, 0.2, 0.4):  # any two of them agree with the third
            seen.see(float(at) + later, off_m=off, marker=f"plate {number}", decode_id="upload")
    track = estimate_track(seen.track_input())
    assert len(seen.wrong) == 3
    assert seen.left_out(track) == seen.wrong
