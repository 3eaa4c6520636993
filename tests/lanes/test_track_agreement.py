"""Markers that are all in the wrong place alike, against the vehicle's track."""

from __future__ import annotations

import numpy as np
import pytest

from app.lanes.estimate import fit_lane
from app.lanes.track_agreement import compare_with_track
from app.simulation.radio.drive import SatelliteReceiver
from benchmarks.cerpm import scenes
from benchmarks.scenes.road_shapes import RoadShape, lane_of_shape

BENDY = RoadShape(turn_deg=90.0, radius_m=80.0, second_turn_deg=60.0, second_radius_m=60.0, straight_m=30.0)


ONE_BEND = RoadShape(turn_deg=40.0, radius_m=150.0, second_turn_deg=0.0, second_radius_m=60.0, straight_m=60.0)


def drive(seed, *, shift_m=(0.0, 0.0), turn_deg=0.0, scale=1.0, receiver=None, shape=BENDY):
    rng = np.random.default_rng(seed)
    lane = lane_of_shape(shape)
    markers = scenes.markers_for_lane(scenes.install(lane, rng))
    points = lane.enu_from_wgs84(markers.lon_deg, markers.lat_deg)
    middle, turn = points.mean(0), np.radians(turn_deg)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    moved = middle + scale * (points - middle) @ rotation.T + np.array(shift_m)
    markers.lon_deg[:], markers.lat_deg[:] = lane.wgs84_from_enu(moved)
    track = scenes.track(lane, rng, receiver)
    return fit_lane(markers, track), track


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("receiver", [SatelliteReceiver.rtk(), SatelliteReceiver.plain()])
def test_honest_markers_agree(seed, receiver):
    lane, _ = drive(seed, receiver=receiver)
    assert lane.refusal is None
    assert lane.track_agreement is not None
    assert not lane.track_agreement.disagrees
    assert lane.track_agreement.significance < 4


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("shift_m", [(2.0, 0.0), (0.0, -2.5), (3.0, 3.0)])
def test_a_common_shift_is_measured(seed, shift_m):
    found = drive(seed, shift_m=shift_m)[0].track_agreement
    assert found.disagrees
    assert (found.east_m, found.north_m) == pytest.approx(shift_m, abs=0.7)
    assert "datum" in found.reason


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("shift_m", [(0.0, 3.0), (-1.5, 2.0)])
def test_a_shift_that_a_turn_could_replace_is_seen(seed, shift_m):
    """Along one bend shift, turn and scale are uncertain one by one, but together they are not 0."""
    found = drive(seed, shift_m=shift_m, shape=ONE_BEND)[0].track_agreement
    assert np.hypot(found.east_m, found.north_m) < 4.5 * found.shift_sigma_m
    assert found.disagrees
    assert drive(seed, shape=ONE_BEND)[0].track_agreement.significance < 4


def test_a_turn_and_a_scale_are_measured():
    turned = drive(1, turn_deg=1.4)[0].track_agreement
    assert turned.disagrees
    assert turned.turn_deg == pytest.approx(1.4, abs=0.25)
    assert "turned" in turned.reason
    scaled = drive(2, scale=1.03)[0].track_agreement
    assert scaled.disagrees
    assert scaled.scale_ppm == pytest.approx(30_000, abs=6_000)


def test_a_coarse_receiver_accuses_nobody():
    found = drive(3, shift_m=(1.5, 0.0), receiver=SatelliteReceiver.plain())[0].track_agreement
    assert not found.disagrees


def test_what_cannot_be_compared_is_not():
    lane, track = drive(4)
    standing = track.time_s < track.time_s[0] + 0.5
    few = type(track)(
        *(getattr(track, name)[standing] for name in ("time_s", "lon_deg", "lat_deg", "heading_deg", "accuracy_m"))
    )
    assert compare_with_track(lane, few) is None
    assert (
        fit_lane(
            scenes.markers_for_lane(scenes.install(lane_of_shape(BENDY), np.random.default_rng(4)))
        ).track_agreement
        is None
    )


@pytest.mark.parametrize("receiver", [SatelliteReceiver.rtk(), SatelliteReceiver.plain()])
def test_a_path_far_from_the_track_is_not_sure(receiver):
    lane, _ = drive(5, shift_m=(300.0, -700.0), receiver=receiver)
    assert lane.refusal is None
    assert lane.track_agreement is None
    assert lane.track_apart
    assert any("does not run beside the path" in text for text in lane.localization_warnings)


@pytest.mark.parametrize("seed", range(3))
def test_a_short_track_beside_the_path_is_no_evidence_against_it(seed):
    built = lane_of_shape(BENDY)
    rng = np.random.default_rng(seed)
    markers = scenes.markers_for_lane(scenes.install(built, rng))
    track = scenes.track(built, rng)
    along = np.hypot(*np.diff(built.enu_from_wgs84(track.lon_deg, track.lat_deg), axis=0).T).cumsum()
    start = np.concatenate([[True], along < 25.0])
    names = ("time_s", "lon_deg", "lat_deg", "heading_deg", "accuracy_m")
    lane = fit_lane(markers, type(track)(*(getattr(track, name)[start] for name in names)))
    assert lane.refusal is None
    assert lane.track_agreement is None
    assert not lane.track_apart
