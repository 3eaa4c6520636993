"""Is the simulated road, its survey and its driver what they say they are?"""

from __future__ import annotations

import numpy as np
import pytest

from app.errors import InvalidParameter
from app.markers.cerpm import LaneSide
from app.planning.cerpm_placement import place_markers
from app.simulation.radio.drive import (
    Driver,
    SatelliteReceiver,
    drive_lane,
    matern_noise,
    observe_track,
    ornstein_noise,
)
from app.simulation.radio.lanes import TrueLane, install_markers, lane_between, lose_row, lose_share, make_lane


@pytest.fixture(scope="module")
def lane() -> TrueLane:
    return make_lane(np.random.default_rng(1001))


def test_a_made_lane_bends_as_its_curvature_says(lane: TrueLane) -> None:
    """Circles through three points 2 m apart, against the curvature told there."""
    a, b, c = lane.centre_m[:-16], lane.centre_m[8:-8], lane.centre_m[16:]
    cross = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    sides = [np.linalg.norm(p - q, axis=1) for p, q in ((a, b), (b, c), (c, a))]
    assert 2 * cross / np.prod(sides, axis=0) == pytest.approx(lane.curvature_per_m[8:-8], abs=6e-4)
    assert np.abs(lane.curvature_per_m).max() > 0.008


def test_made_lanes_are_as_sharp_and_as_wide_as_asked() -> None:
    lanes = [make_lane(np.random.default_rng(1100 + k)) for k in range(20)]
    sharpest = [np.abs(one.curvature_per_m).max() for one in lanes]
    assert max(sharpest) <= 0.04
    assert max(sharpest) > 0.034
    widths = np.concatenate([one.width_m for one in lanes])
    assert 2.7 - 1e-9 <= widths.min() < 2.8
    assert 3.5 < widths.max() <= 3.6 + 1e-9


def test_a_made_lane_never_crosses_itself() -> None:
    for k in range(10):
        lane = make_lane(np.random.default_rng(1200 + k), length_m=1000)
        points = lane.centre_m[::8]
        away = np.linalg.norm(points[:, None] - points[None], axis=2)
        far_along = np.abs(np.subtract.outer(lane.chainage_m[::8], lane.chainage_m[::8])) > 40
        assert away[far_along].min() > 8


def test_the_lane_between_polylines_of_a_made_lane_is_that_lane(lane: TrueLane) -> None:
    found = lane_between(lane.left_m, lane.right_m, lane.origin)
    nearest = np.linalg.norm(found.centre_m[::20, None] - lane.centre_m[None], axis=2).min(axis=1)
    assert nearest.max() < 0.13  # vertices of the true line are 0.25 m apart
    assert found.length_m == pytest.approx(lane.length_m, abs=0.6)


def test_positions_go_to_degrees_and_back(lane: TrueLane) -> None:
    lon, lat = lane.wgs84_from_enu(lane.left_m)
    assert lane.enu_from_wgs84(lon, lat) == pytest.approx(lane.left_m, abs=1e-3)


def test_surveys_are_off_by_what_they_say(lane: TrueLane) -> None:
    installed = install_markers(
        lane, place_markers(lane.left_m, lane.right_m, spacing_m=2.0), np.random.default_rng(1002), survey_sd_m=0.05
    )
    off = lane.enu_from_wgs84(installed.lon_deg, installed.lat_deg) - installed.point_m
    assert off.std() == pytest.approx(0.05, rel=0.08)
    line = np.where((installed.side == LaneSide.LEFT)[:, None, None], lane.left_m[None, ::1], lane.right_m[None, ::1])
    assert np.linalg.norm(line - installed.point_m[:, None], axis=2).min(axis=1).max() < 0.17  # installed on the lines
    assert (np.abs(installed.lon_deg * 1e7 - np.round(installed.lon_deg * 1e7)) < 1e-4).all()
    assert sorted(installed.number) == list(range(1, len(installed) + 1))
    assert (np.diff(installed.number) != 1).mean() > 0.9


def test_lost_shares_and_rows_are_exact(lane: TrueLane) -> None:
    rng = np.random.default_rng(1003)
    installed = install_markers(lane, place_markers(lane.left_m, lane.right_m), rng)
    assert len(lose_share(installed, 0.4, rng)) == len(installed) - round(0.4 * len(installed))
    for side in (LaneSide.LEFT, LaneSide.RIGHT):
        gapped = lose_row(installed, 5, rng, side)
        gone = np.setdiff1d(installed.number, gapped.number)
        rows = np.flatnonzero(np.isin(installed.number[installed.side == side], gone))
        assert list(np.diff(rows)) == [1, 1, 1, 1]
        assert rows[0] > 0
        assert rows[-1] < (installed.side == side).sum() - 1
    with pytest.raises(InvalidParameter):
        lose_row(installed, len(installed), rng)
    with pytest.raises(InvalidParameter):
        lose_share(installed, 1.5, rng)


def test_a_driver_alone_scores_what_drivers_score() -> None:
    """0.18 m RMS over drives, slowly: no lateral jumps."""
    squares, steps = [], []
    for k in range(40):
        rng = np.random.default_rng(1300 + k)
        drive = drive_lane(make_lane(rng, length_m=400), Driver(), rng)
        squares.append(np.mean(drive.left_m**2))
        steps.append(np.abs(np.diff(drive.left_m)).max() / 0.05)
    assert np.sqrt(np.mean(squares)) == pytest.approx(0.18, abs=0.02)
    assert max(steps) < 0.5  # m/s across the lane
    assert np.sqrt(squares).max() > 0.22


def test_a_driver_slows_down_for_bends(lane: TrueLane) -> None:
    drive = drive_lane(lane, Driver(speed_m_s=25), np.random.default_rng(1004))
    inside = (drive.chainage_m > 0) & (drive.chainage_m < lane.length_m)
    curvature = np.abs(np.interp(drive.chainage_m[inside], lane.chainage_m, lane.curvature_per_m))
    assert (drive.speed_m_s[inside] ** 2 * curvature).max() < 3.6
    moved = np.linalg.norm(np.diff(drive.point_m, axis=0), axis=1) / np.diff(drive.time_s)
    assert moved == pytest.approx(drive.speed_m_s[1:], rel=0.05)


@pytest.mark.parametrize(
    ("receiver", "sd_m", "heading_deg"), [(SatelliteReceiver.rtk(), 0.0197, 0.3), (SatelliteReceiver.plain(), 2.0, 1.5)]
)
def test_tracks_are_off_by_what_their_receiver_is(receiver: SatelliteReceiver, sd_m: float, heading_deg: float) -> None:
    lane = make_lane(np.random.default_rng(1005), length_m=300)
    off, turned, rates = [], [], []
    for k in range(60):
        rng = np.random.default_rng(1400 + k)
        drive = drive_lane(lane, Driver(), rng)
        track = observe_track(lane, drive, receiver, rng)
        true = np.stack([np.interp(track.time_s, drive.time_s, drive.point_m[:, i]) for i in range(2)], 1)
        off.append(lane.enu_from_wgs84(track.lon_deg, track.lat_deg) - true)
        heading = 90 - np.degrees(np.interp(track.time_s, drive.time_s, drive.yaw_rad))
        turned.append((track.heading_deg - heading + 180) % 360 - 180)
        rates.append(np.median(np.diff(track.time_s)))
    assert np.concatenate(off).std() == pytest.approx(sd_m, rel=0.12)
    assert np.concatenate(turned).std() == pytest.approx(heading_deg, rel=0.1)
    assert np.median(rates) == pytest.approx(1 / receiver.rate_hz, rel=0.05)
    assert np.median([np.std(one, axis=0).mean() for one in off]) < 0.75 * sd_m  # most of it stays for a drive


def test_noises_have_their_deviation_and_memory() -> None:
    slow = ornstein_noise(200_000, 0.1, 2.0, np.random.default_rng(1006))[:, 0]
    smooth = matern_noise(200_000, 0.1, 2.0, np.random.default_rng(1007))
    assert slow.std() == pytest.approx(1, abs=0.05)
    assert smooth.std() == pytest.approx(1, abs=0.05)
    assert np.corrcoef(slow[:-20], slow[20:])[0, 1] == pytest.approx(np.exp(-1), abs=0.04)
    assert np.corrcoef(smooth[:-20], smooth[20:])[0, 1] == pytest.approx(2 * np.exp(-1), abs=0.04)


def test_the_same_seed_is_the_same_drive(lane: TrueLane) -> None:
    tracks = [
        observe_track(lane, drive_lane(lane, Driver(), rng), SatelliteReceiver.rtk(), rng)
        for rng in (np.random.default_rng(7), np.random.default_rng(7))
    ]
    assert (tracks[0].lon_deg == tracks[1].lon_deg).all()


@pytest.mark.parametrize("how", [{"length_m": 10}, {"max_curvature_per_m": 0.5}, {"width_m": (3, 2)}])
def test_lanes_that_cannot_be_are_refused(how: dict[str, object]) -> None:
    with pytest.raises(InvalidParameter):
        make_lane(np.random.default_rng(0), **how)  # type: ignore[arg-type]
