"""Markers and tracks that no lane can be made of, and places where longitudes and loops are awkward."""

from __future__ import annotations

import numpy as np
import pytest

from app.lanes.estimate import LaneMarkers, LeftOutReason, fit_lane
from app.sensors.pose_track import PoseTrack
from tests.lanes.lanes import Road, chosen, drive, in_plane, markers_at, on_globe, place, straight

METHODS = ("waymark", "paper")
NOWHERE = markers_at(np.empty((0, 2)), 0)


def still(track, lon=None):
    return PoseTrack(
        track.time_s, np.full(len(track.time_s), lon or track.lon_deg[0]), np.full(len(track.time_s), track.lat_deg[0]),
        track.heading_deg, track.accuracy_m,
    )  # fmt: skip


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    "markers",
    [
        NOWHERE,
        markers_at([[0, 0]], 1),
        markers_at(np.zeros((50, 2)), 0),
        markers_at(np.zeros((2000, 2)), 1, number=np.ones(2000, int)),
        markers_at([[0, 0], [12, 0]], 1),
        markers_at([[0, 1.6], [0, -1.6]], [1, 2]),
    ],
)
def test_no_lane(markers, method):
    assert_refused(fit_lane(markers, method=method), markers)


def test_one_row_without_sides_is_no_lane():
    """The paper's method has no such check: it splits the row by rounding errors."""
    markers = markers_at(np.c_[np.linspace(0, 100, 11), np.zeros(11)], 0)
    assert_refused(fit_lane(markers, method="waymark"), markers)


def assert_refused(lane, markers):
    assert lane.refusal
    assert len(lane.station_m) == len(lane.sigma_m) == len(lane.left_enu_m) == 0
    assert len(lane.side) == len(lane.residual_m) == len(markers)


@pytest.mark.parametrize("method", METHODS)
def test_what_is_no_place_is_named(method):
    rng = np.random.default_rng(31)
    markers = place(straight(), rng)
    lon, lat, sigma = markers.lon_deg.copy(), markers.lat_deg.copy(), markers.sigma_m.copy()
    lon[3], lat[5], lat[6], sigma[7:9] = np.nan, 95.0, np.inf, (np.nan, -1)
    lane = fit_lane(LaneMarkers(markers.number, lon, lat, markers.side, sigma, markers.speed_limit_kmh), method=method)
    assert lane.refusal is None
    assert [(out.row, out.reason) for out in lane.left_out] == [(k, LeftOutReason.NOT_A_PLACE) for k in (3, 5, 6)]
    nothing = LaneMarkers(markers.number, lon * np.nan, lat, markers.side, sigma, markers.speed_limit_kmh)
    refused = fit_lane(nothing, method=method)
    assert refused.refusal
    assert len(refused.left_out) == len(markers)


def test_two_thousand_rows_of_two_markers():
    track = drive(straight(), np.random.default_rng(32))
    road = straight()
    points = np.concatenate([road.beside(np.array([50.0]), 1.6), road.beside(np.array([80.0]), -1.6)])
    lane = fit_lane(markers_at(np.tile(points, (1000, 1)), np.tile([1, 2], 1000), number=np.tile([1, 2], 1000)), track)
    assert lane.refusal is None
    assert (lane.side == np.tile([1, 2], 1000)).all()
    assert lane.left_out == ()


@pytest.mark.parametrize("bad", ["still", "far", "short"])
def test_a_track_that_says_nothing(bad):
    rng = np.random.default_rng(33)
    road = straight()
    track = drive(road, rng)
    track = {
        "still": still(track),
        "far": still(track, 9.0),
        "short": PoseTrack(*(getattr(track, name)[:2] for name in PoseTrack.__slots__)),
    }[bad]
    lane = fit_lane(place(road, rng), track)
    assert any("not used" in warning for warning in lane.localization_warnings)
    assert np.abs(road.errors(lane)).max() < 0.1


def test_a_track_of_half_of_the_lane():
    rng = np.random.default_rng(34)
    road = straight()
    track = drive(road, rng)
    half = PoseTrack(*(getattr(track, name)[: len(track.time_s) // 3] for name in PoseTrack.__slots__))
    for labelled in (True, False):
        lane = fit_lane(place(road, rng, labelled=labelled), half)
        assert lane.station_m[-1] > 195
        assert lane.heading_deg[0] == pytest.approx(90 - np.degrees(0.3), abs=1)
        assert np.abs(road.errors(lane)).max() < 0.1


@pytest.mark.parametrize(("lon", "lat"), [(179.9995, 10.0), (-179.9999, -45.0), (8.0, 80.0), (8.0, -80.0)])
def test_awkward_places(lon, lat):
    rng = np.random.default_rng(35)
    road = straight()
    lane = fit_lane(place(road, rng, lon=lon, lat=lat), drive(road, rng, lon=lon, lat=lat))
    assert np.abs(road.errors(lane, lon=lon, lat=lat)).max() < 0.1
    assert (np.abs(lane.lon_deg) <= 180).all()
    turn = np.abs((np.diff(lane.heading_deg) + 180) % 360 - 180)
    assert turn.max() < 1
    assert lane.heading_deg[0] == pytest.approx(90 - np.degrees(0.3), abs=1)


@pytest.mark.parametrize("labelled", [True, False])
def test_a_lane_that_crosses_itself(labelled):
    rng = np.random.default_rng(36)
    at = np.arange(0, 400.1, 0.25)
    turn = np.interp(at, [0, 80, 100, 290, 310, 400], [0, 0, 1 / 45, 1 / 45, 0, 0])
    road = Road(turn, np.full(len(at), 3.2))
    lane = fit_lane(place(road, rng, labelled=labelled), drive(road, rng))
    assert lane.left_out == ()
    assert lane.station_m[-1] == pytest.approx(400, abs=3)
    assert np.abs(road.errors(lane)).max() < 0.15


def test_two_legs_side_by_side():
    """A turn back beside itself: clear with a track; without one it is refused rather than guessed."""
    rng = np.random.default_rng(37)
    at = np.arange(0, 240.1, 0.25)
    turn = np.interp(at, [0, 100, 101, 100 + 5 * np.pi, 101 + 5 * np.pi, 240], [0, 0, 0.2, 0.2, 0, 0])
    road = Road(turn, np.full(len(at), 3.2))
    markers = place(road, rng, spacing=8.0)
    lane = fit_lane(markers, drive(road, rng))
    assert lane.station_m[-1] == pytest.approx(240, abs=3)
    assert np.abs(road.errors(lane)).max() < 0.3
    alone = fit_lane(place(road, rng))
    assert alone.refusal or np.abs(road.errors(alone)).max() < 0.5


def test_markers_all_over_are_no_lane():
    for seed in range(5):
        rng = np.random.default_rng(seed)
        field = markers_at(rng.uniform(-300, 300, (80, 2)), rng.integers(0, 3, 80))
        assert fit_lane(field).refusal
        assert fit_lane(field, drive(straight(), rng)).refusal
    world = LaneMarkers(
        np.arange(50), rng.uniform(-180, 180, 50), rng.uniform(-90, 90, 50), rng.integers(0, 3, 50), np.full(50, 0.02),
        np.full(50, np.nan),
    )  # fmt: skip
    assert fit_lane(world).refusal


def test_cost_grows_with_the_length():
    """A lane of 20 km: what is quadratic would not end."""
    rng = np.random.default_rng(38)
    at = np.arange(0, 20000.1, 0.25)
    road = Road(np.sin(at / 300) / 400, np.full(len(at), 3.2))
    markers = place(road, rng)
    lane = fit_lane(markers)
    assert lane.refusal is None
    some = in_plane(lane.lon_deg[::500], lane.lat_deg[::500])
    true = in_plane(*on_globe(road.centre))
    gaps = [np.hypot(*(true - point).T).min() for point in some]
    assert max(gaps) < 0.2
    assert chosen(markers, [0]).number[0] == markers.number[0]
