"""The fit of a lane on lanes whose centre is known, and what it says of what it cannot tell."""

from __future__ import annotations

import numpy as np
import pytest
import scipy
from pydantic import ValidationError

from app.errors import InvalidParameter
from app.lanes.estimate import LaneMarkers, LaneRules, LeftOutReason, fit_lane, preview_m
from app.sensors.pose_track import PoseTrack
from tests.lanes.lanes import bendy, chosen, drive, markers_at, moved, on_globe, place, straight


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize("labelled", [True, False])
def test_path_of_a_bendy_lane(labelled):
    rng = np.random.default_rng(11)
    road = bendy()
    lane = fit_lane(place(road, rng, labelled=labelled), drive(road, rng))
    assert lane.refusal is None
    assert lane.left_out == ()
    errors = road.errors(lane)
    assert rms(errors) < 0.025
    assert np.abs(errors).max() < 0.1
    assert np.nanmax(np.abs(lane.width_m - 3.2)) < 0.15
    assert lane.station_m[-1] > road.at[-1] - 2
    assert 0.4 < rms(errors) / rms(lane.sigma_m) < 2
    assert (lane.confidence > 0.9).mean() > 0.9
    beyond = 2 * scipy.stats.t.sf(0.25, df=2.4, scale=0.61 * lane.sigma_m)
    np.testing.assert_allclose(1 - lane.confidence, beyond, rtol=1e-6)


def test_heading_curvature_and_frames():
    rng = np.random.default_rng(12)
    road = bendy()
    lane = fit_lane(place(road, rng), drive(road, rng))
    at = np.interp(lane.station_m, [0, lane.station_m[-1]], [0, road.at[-1]])
    heading = 90 - np.degrees(np.interp(at, road.at, road.yaw))
    assert np.abs((lane.heading_deg - heading + 180) % 360 - 180).max() < 2.0
    assert rms(lane.curvature_per_m - np.interp(at, road.at, road.curvature)) < 0.003
    assert np.array_equal(lane.position_enu_m, np.stack([lane.east_m, lane.north_m], 1))
    assert (lane.down_m == 0).all()
    step = np.hypot(*np.diff(lane.position_enu_m, axis=0).T)
    assert np.allclose(np.diff(lane.station_m), step, atol=0.01)
    across = np.hypot(*(lane.left_enu_m - lane.right_enu_m).T)
    assert np.allclose(across, lane.width_m, atol=1e-6)


def test_lost_markers_and_a_gap_on_one_side():
    rng = np.random.default_rng(13)
    road = bendy()
    markers = place(road, rng)
    track = drive(road, rng)
    lost = chosen(markers, rng.random(len(markers)) > 0.4)
    assert rms(road.errors(fit_lane(lost, track))) < 0.06
    left = np.flatnonzero(markers.side == 1)
    order = left[np.argsort(markers.number[left])]
    gap = np.setdiff1d(np.arange(len(markers)), order[8:13])
    bridged = fit_lane(chosen(markers, gap), track)
    assert rms(road.errors(bridged)) < 0.04
    assert np.isfinite(bridged.left_enu_m).all()


def test_ten_markers_a_side_without_a_track():
    rng = np.random.default_rng(14)
    road = bendy(400.0)
    lane = fit_lane(place(road, rng, spacing=400 / 9))
    assert rms(road.errors(lane)) < 0.15
    assert lane.localization_warnings == ()


@pytest.mark.parametrize("away", [30.0, 3.0, -1.2])
def test_a_marker_off_the_line_is_named(away):
    rng = np.random.default_rng(15)
    road = bendy()
    markers = place(road, rng)
    k = 7
    lane = fit_lane(moved(markers, k, away * road.normal[400]), drive(road, rng))
    named = [out for out in lane.left_out if out.number == markers.number[k]]
    assert len(lane.left_out) == 1
    assert named[0].row == k
    assert named[0].reason in (LeftOutReason.OFF_THE_LINE, LeftOutReason.WRONG_SIDE)
    assert lane.side[k] == 0
    assert np.isnan(lane.residual_m[k])
    assert rms(road.errors(lane)) < 0.04


@pytest.mark.parametrize(("noise_m", "fewest", "most"), [(0.02, 0, 1), (0.06, 5, 8)])
def test_markers_that_scatter_more_than_stated(noise_m, fewest, most):
    z, warnings = [], 0
    for seed in range(8):
        rng = np.random.default_rng([seed, 91])
        road = bendy()
        lane = fit_lane(place(road, rng, noise=noise_m), drive(road, rng))
        z.append(rms(road.errors(lane)) / rms(lane.sigma_m))
        warnings += any("from smooth boundaries" in warning for warning in lane.localization_warnings)
    assert fewest <= warnings <= most
    assert 0.5 < rms(np.array(z)) < 1.4


def test_a_marker_that_names_the_wrong_side():
    rng = np.random.default_rng(16)
    road = straight()
    markers = place(road, rng)
    side = markers.side.copy()
    side[4] = 3 - side[4]
    wrong = LaneMarkers(
        markers.number, markers.lon_deg, markers.lat_deg, side, markers.sigma_m, markers.speed_limit_kmh
    )
    for track in (drive(road, rng), None):
        lane = fit_lane(wrong, track)
        assert [(out.row, out.reason) for out in lane.left_out] == [(4, LeftOutReason.WRONG_SIDE)]


def test_a_number_with_two_positions():
    rng = np.random.default_rng(17)
    road = straight()
    markers = place(road, rng)
    number = markers.number.copy()
    number[3] = number[20]
    lane = fit_lane(
        LaneMarkers(number, markers.lon_deg, markers.lat_deg, markers.side, markers.sigma_m, markers.speed_limit_kmh)
    )
    assert sorted(out.row for out in lane.left_out) == [3, 20]
    assert {out.reason for out in lane.left_out} == {LeftOutReason.TWO_PLACES}
    assert rms(road.errors(lane)) < 0.04


def test_positions_of_two_metres_do_not_move_the_path():
    rng = np.random.default_rng(18)
    road = bendy()
    lane = fit_lane(
        place(road, rng, labelled=False), drive(road, rng, offset=np.array([1.6, -1.2]), noise=0.1, accuracy=2.0)
    )
    assert rms(road.errors(lane)) < 0.05


def test_a_track_that_runs_the_other_way_turns_the_lane():
    rng = np.random.default_rng(19)
    road = straight()
    track = drive(road, rng)
    back = type(track)(track.time_s, track.lon_deg[::-1], track.lat_deg[::-1], track.heading_deg, track.accuracy_m)
    forth, lane = (fit_lane(place(road, rng), each) for each in (track, back))
    turned = (lane.heading_deg[10] - forth.heading_deg[10]) % 360
    assert turned == pytest.approx(180, abs=2)
    assert any("other direction" in warning for warning in lane.localization_warnings)
    assert lane.left_out == ()


def test_one_side_only():
    rng = np.random.default_rng(20)
    road = straight()
    markers = place(road, rng)
    left = chosen(markers, markers.side == 1)
    alone = fit_lane(left)
    assert alone.refusal is None
    assert any("one side" in warning for warning in alone.localization_warnings)
    assert (alone.sigma_m / 2 > 0.15).all()
    assert np.isfinite(alone.left_enu_m).all()
    assert np.isnan(alone.right_enu_m).all()
    assert np.isnan(alone.width_m).all()
    tracked = fit_lane(left, drive(road, rng))
    assert tracked.sigma_m.max() < alone.sigma_m.min()
    slow = fit_lane(left, drive(road, rng, offset=1.5, noise=0.1, accuracy=2.0))
    assert (
        rms(road.errors(slow) / np.interp(np.linspace(0, 1, len(road.errors(slow))), [0, 1], slow.sigma_m[[0, -1]])) < 2
    )
    unnamed = chosen(place(road, rng, labelled=False), slice(None))
    points = np.flatnonzero(unnamed.number <= len(unnamed) // 2)
    assert "without a known side" in str(fit_lane(chosen(unnamed, points)).refusal)


def test_speed_limits_along_the_way():
    road = straight(120.0)
    at = np.arange(0, 121, 12.0)
    points = np.concatenate([road.beside(at, 1.6), road.beside(at, -1.6)])
    markers = markers_at(points, np.repeat([1, 2], len(at)))
    limit = np.tile(np.where(at < 55, 50.0, 30.0), 2)
    limit[2] = 40.0
    lane = fit_lane(LaneMarkers(markers.number, markers.lon_deg, markers.lat_deg, markers.side, markers.sigma_m, limit))
    assert lane.speed_limit_kmh[[5, 20, 30, 40, 80]].tolist() == [50, 50, 40, 50, 30]
    assert any("speed limits" in warning for warning in lane.localization_warnings)
    assert np.isnan(fit_lane(markers).speed_limit_kmh).all()


def test_preview():
    road = straight(120.0)
    rng = np.random.default_rng(21)
    lane = fit_lane(place(road, rng, spacing=12.0))
    assert preview_m(lane, float(lane.lon_deg[20]), float(lane.lat_deg[20])) == pytest.approx(
        lane.station_m[-1] - 20, abs=1
    )
    assert preview_m(lane, float(lane.lon_deg[-1]), float(lane.lat_deg[-1])) == 0
    with pytest.raises(InvalidParameter):
        preview_m(lane, 400.0, 0.0)


def test_paper_method():
    rng = np.random.default_rng(22)
    road = bendy()
    markers = place(road, rng, noise=0.001)
    lane = fit_lane(markers, drive(road, rng), method="paper")
    assert lane.method == "paper"
    assert rms(road.errors(lane)) < 0.1
    assert np.isnan(lane.sigma_m).all()
    spoofed = fit_lane(moved(markers, 7, 30 * road.normal[400]), drive(road, rng), method="paper")
    assert spoofed.left_out == ()
    assert np.abs(road.errors(spoofed)).max() > 3
    assert "no two markers" in str(fit_lane(chosen(markers, markers.side == 1), method="paper").refusal)


def test_what_is_refused_as_a_call():
    markers = place(straight(), np.random.default_rng(23))
    with pytest.raises(InvalidParameter):
        fit_lane(markers, method="other")
    with pytest.raises(InvalidParameter):
        LaneMarkers(
            markers.number, markers.lon_deg[:3], markers.lat_deg, markers.side, markers.sigma_m, markers.sigma_m
        )
    with pytest.raises(InvalidParameter):
        LaneMarkers(
            markers.number, markers.lon_deg, markers.lat_deg, markers.side + 5, markers.sigma_m, markers.sigma_m
        )
    with pytest.raises(ValidationError):
        LaneRules(usual_width_m=float("nan"))
    with pytest.raises(ValidationError):
        LaneRules(bridge_m=-1.0)


@pytest.mark.parametrize(("wave_m", "seed"), [(80.0, 1100), (80.0, 1102), (150.0, 1101), (150.0, 1103)])
def test_a_row_that_a_coarse_track_crosses_is_not_two_sides(wave_m, seed):
    rng = np.random.default_rng(seed)
    road = bendy(400.0)
    points = road.beside(np.arange(0, road.at[-1], 12.2), -1.6)
    row = markers_at(points + rng.normal(0, 0.02, points.shape), 0)
    at = road.at[::4]
    wave = 2.0 * np.sin(2 * np.pi * at / wave_m + rng.uniform(0, 2 * np.pi))
    lon_deg, lat_deg = on_globe(road.beside(at, wave - 1.6))
    count = len(at)
    track = PoseTrack(1.7e9 + 0.1 * np.arange(count), lon_deg, lat_deg, np.full(count, np.nan), np.full(count, 2.0))
    lane = fit_lane(row, track)
    assert lane.refusal is not None
    assert "side" in lane.refusal


def test_two_unlabelled_rows_beside_a_coarse_track_are_two_sides():
    rng = np.random.default_rng(1104)
    road = bendy(400.0)
    markers = place(road, rng, labelled=False)
    kept = chosen(markers, rng.random(len(markers)) > 0.3)
    lane = fit_lane(kept, drive(road, rng, wander=0.8, accuracy=2.0))
    assert lane.refusal is None
    assert rms(road.errors(lane)) < 0.1


@pytest.mark.parametrize("with_track", [True, False])
@pytest.mark.parametrize("stagger_m", [0.3, 0.6, 1.2])
def test_a_row_that_stands_a_little_ahead_of_the_other_does_not_wind_the_path(stagger_m, with_track):
    rng = np.random.default_rng(1105)
    road = bendy(400.0)
    at = np.arange(0, road.at[-1] - 2, 12.2)
    points = np.concatenate([road.beside(at, 1.6), road.beside(at + stagger_m, -1.6)])
    markers = markers_at(points + rng.normal(0, 0.02, points.shape), np.repeat([1, 2], len(at)))
    lane = fit_lane(markers, drive(road, rng) if with_track else None)
    assert lane.refusal is None
    assert np.abs(road.errors(lane)).max() < 0.2


@pytest.mark.parametrize("with_track", [True, False])
@pytest.mark.parametrize("laid_m", [0.1, 0.3])
def test_pairs_that_are_laid_carelessly_do_not_wind_the_path(laid_m, with_track):
    rng = np.random.default_rng(1106)
    road = bendy(400.0)
    at = np.arange(2, road.at[-1] - 2, 12.2)
    left, right = at + rng.normal(0, laid_m, (2, len(at)))
    points = np.concatenate([road.beside(left, 1.6), road.beside(right, -1.6)])
    markers = markers_at(points + rng.normal(0, 0.02, points.shape), np.repeat([1, 2], len(at)))
    lane = fit_lane(markers, drive(road, rng) if with_track else None)
    assert lane.refusal is None
    assert np.abs(road.errors(lane)).max() < 0.15


@pytest.mark.parametrize("labelled", [True, False])
def test_several_markers_off_the_line_lower_the_confidence(labelled):
    rng = np.random.default_rng(1071)
    road = straight(200.0)
    markers = place(road, rng, labelled=labelled)
    at = np.linspace(70, 120, 5)  # the edge of a ramp that joins from the right
    ramp = markers_at(road.beside(at, -1.6 - np.linspace(6, 3, 5)), 2 if labelled else 0, number=900 + np.arange(5))
    both = LaneMarkers(*(np.append(getattr(markers, name), getattr(ramp, name)) for name in LaneMarkers.__slots__))
    lane = fit_lane(both, drive(road, rng))
    assert lane.refusal is None
    assert any("off the line" in warning for warning in lane.localization_warnings), lane.localization_warnings
    beside = (lane.station_m > 75) & (lane.station_m < 115)
    assert lane.confidence[beside].max() < 0.5
    assert lane.confidence[lane.station_m < 25].min() > 0.9
    assert fit_lane(markers, drive(road, rng)).confidence.mean() > 0.9
