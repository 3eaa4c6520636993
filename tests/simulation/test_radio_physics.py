"""The options of the radio simulation against closed forms, and drives without them against recorded ones."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from app.errors import InvalidParameter
from app.planning.cerpm_placement import place_markers
from app.simulation.radio.drive import (
    Driver,
    Multipath,
    SatelliteReceiver,
    SimulatedDrive,
    draw_multipath_m,
    drive_past,
)
from app.simulation.radio.lanes import InstalledMarkers, TrueLane, install_markers, make_lane
from app.simulation.radio.link import AntennaPattern, Notch, Radio, TwoRay, mean_rssi_dbm
from benchmarks.cerpm.physics import ROWS, Row, add_drive

LOSSLESS = TwoRay(permittivity=5.0, conductivity_s_m=0.0)


def test_the_road_reflects_as_fresnel_says() -> None:
    grazing, brewster, above = LOSSLESS.reflection([1e-6, math.atan(1 / math.sqrt(5.0)), math.pi / 2])
    assert grazing == pytest.approx(-1, abs=1e-4)
    assert abs(brewster) < 1e-9
    assert above == pytest.approx((math.sqrt(5) - 1) / (math.sqrt(5) + 1))  # (n - 1) / (n + 1) at normal incidence
    assert abs(TwoRay(conductivity_s_m=10.0).reflection(math.radians(30))) > 0.7  # a metal


def test_two_rays_fall_with_the_fourth_power_far_away_and_alone_with_the_second() -> None:
    far = TwoRay(antenna_m=1.5, marker_m=0.3).mean_rssi_dbm([500.0, 5000.0])
    assert far[0] - far[1] == pytest.approx(40, abs=1.0)
    air = TwoRay(permittivity=1.0, conductivity_s_m=0.0, marker_m=1.5).mean_rssi_dbm([50.0, 500.0])
    assert air[0] - air[1] == pytest.approx(20, abs=1e-6)
    assert air[0] == pytest.approx(-108)  # the paper's level at 50 m


def test_two_rays_add_and_cancel_where_their_lengths_say() -> None:
    """Between elevated antennas maxima and minima are half a wavelength of detour apart: Rappaport, section 4.6."""
    model, wavelength_m = TwoRay(antenna_m=3.0, marker_m=3.0), 299_792_458.0 / 915e6
    ground = np.linspace(8.0, 60.0, 20_000)
    detour = (np.hypot(ground, 6.0) - ground) / wavelength_m
    level = model.mean_rssi_dbm(ground) + 20 * np.log10(ground)
    lowest = (level[1:-1] < level[:-2]) & (level[1:-1] < level[2:])
    # well beyond the Brewster angle's distance the road turns the phase by half a wave: minima at whole wavelengths
    far = ground[1:-1][lowest] > 1.25 * 6.0 * math.sqrt(5.0)
    assert far.sum() == 3
    assert np.abs(detour[1:-1][lowest][far] - np.round(detour[1:-1][lowest][far])).max() < 0.03


@pytest.mark.parametrize("how", [{"marker_m": 0.0}, {"permittivity": 0.5}, {"frequency_hz": 1e6}])
def test_two_rays_that_cannot_be_are_refused(how: dict[str, float]) -> None:
    with pytest.raises(InvalidParameter):
        TwoRay(**how)


def test_an_antenna_is_weak_in_its_notches_only_and_all_around_the_circle() -> None:
    pattern = AntennaPattern((Notch(180.0, 12.0, 20.0), Notch(-90.0, 6.0, 10.0)))
    assert pattern.gain_db([180.0, -180.0, 540.0, -90.0, 270.0]) == pytest.approx([-12, -12, -12, -6, -6], abs=0.01)
    assert pattern.gain_db([0.0, 90.0]) == pytest.approx([0, 0], abs=0.01)
    assert pattern.gain_db(200.0) == pytest.approx(-12 * math.exp(-0.5))
    assert pattern.gain_db(-160.0) == pytest.approx(-12 * math.exp(-0.5))
    with pytest.raises(InvalidParameter):
        AntennaPattern((Notch(0.0, -3.0, 20.0),))


@pytest.fixture(scope="module")
def lane() -> TrueLane:
    return make_lane(np.random.default_rng(1040), length_m=300)


@pytest.fixture(scope="module")
def installed(lane: TrueLane) -> InstalledMarkers:
    return install_markers(lane, place_markers(lane.left_m, lane.right_m), np.random.default_rng(1041))


def _drive(
    lane: TrueLane, markers: InstalledMarkers, radio: Radio | None = None, receiver: SatelliteReceiver | None = None
) -> SimulatedDrive:
    rng = np.random.default_rng(1042)
    return drive_past(lane, markers, rng, sign=None, radio=radio, receiver=receiver)


def test_markers_behind_and_beside_the_vehicle_lose_what_the_pattern_says(
    lane: TrueLane, installed: InstalledMarkers
) -> None:
    base = _drive(lane, installed)
    weak = _drive(lane, installed, Radio(antenna_pattern=AntennaPattern((Notch(180.0, 10.0, 30.0),))))
    lost = base.strength_dbm - weak.strength_dbm
    drive, sent_s = base.drive, base.sent.start_s
    at = np.stack([np.interp(sent_s, drive.time_s, drive.point_m[:, k]) for k in range(2)], 1)
    ahead = np.stack([np.interp(sent_s, drive.time_s, f(drive.yaw_rad)) for f in (np.cos, np.sin)], 1)
    to_marker = installed.point_m[base.sent.sender] - at
    cosine = np.sum(ahead * to_marker, axis=1) / np.linalg.norm(to_marker, axis=1)
    behind, before = cosine < math.cos(math.radians(170)), cosine > math.cos(math.radians(80))
    assert min(behind.sum(), before.sum()) > 30
    assert lost[behind].min() > 10 * math.exp(-((10 / 30) ** 2) / 2) - 0.1
    assert lost[before].max() < 10 * math.exp(-((100 / 30) ** 2) / 2) + 0.1


def test_two_rays_replace_the_mean_and_nothing_else(lane: TrueLane, installed: InstalledMarkers) -> None:
    base, model = _drive(lane, installed), TwoRay()
    other = _drive(lane, installed, Radio(two_ray=model))
    ground = np.sqrt(base.distance_m**2 - 1.5**2)
    assert np.array_equal(base.sent.start_s, other.sent.start_s)
    assert np.array_equal(base.track.lon_deg, other.track.lon_deg)
    spread = base.strength_dbm - mean_rssi_dbm(base.distance_m)
    np.testing.assert_allclose(other.strength_dbm - model.mean_rssi_dbm(ground), spread, atol=1e-6)


def test_multipath_has_its_deviation_its_memory_and_steps_that_come_and_go() -> None:
    time_s = np.arange(0.0, 4000.0, 0.1)
    noise = draw_multipath_m(Multipath(0.05, 2.0, steps_per_min=0.0), time_s, np.random.default_rng(1))
    assert noise.std() == pytest.approx(0.05, rel=0.05)
    assert np.corrcoef(noise[:-20, 0], noise[20:, 0])[0, 1] == pytest.approx(2 / math.e, abs=0.05)
    assert np.abs(np.diff(noise, axis=0)).max() < 0.05 * 0.1 / 2.0 * 6  # six times its mean rate of change
    steps = draw_multipath_m(Multipath(0.0, 2.0, 0.3, 1.5, 5.0), time_s, np.random.default_rng(2))
    jumps = np.linalg.norm(np.diff(steps, axis=0), axis=1)
    assert 2 * 100 * 0.75 < (jumps > 0).sum() < 2 * 100 * 1.25  # 1.5 a minute begin, and end
    assert np.sqrt(np.mean(jumps[jumps > 0] ** 2)) == pytest.approx(0.3 * math.sqrt(2), rel=0.15)
    there = np.abs(steps).max(axis=1) > 1e-9
    assert there.mean() == pytest.approx(1 - math.exp(-1.5 / 60 * 5.0), rel=0.25)
    with pytest.raises(InvalidParameter):
        Multipath(sd_m=-0.1)


def test_multipath_moves_the_track_and_leaves_the_packets(lane: TrueLane, installed: InstalledMarkers) -> None:
    clean = _drive(lane, installed)
    moved = _drive(lane, installed, receiver=replace(SatelliteReceiver.rtk(), multipath=Multipath(0.2, 3.0)))
    assert clean.packets == moved.packets
    assert np.array_equal(clean.track.heading_deg, moved.track.heading_deg)
    off = lane.enu_from_wgs84(clean.track.lon_deg, clean.track.lat_deg)
    off = off - lane.enu_from_wgs84(moved.track.lon_deg, moved.track.lat_deg)
    assert 0.1 < np.sqrt(np.mean(off**2)) < 0.6


def test_without_options_a_drive_is_the_one_recorded_before_they_existed(
    lane: TrueLane, installed: InstalledMarkers
) -> None:
    """Recorded at commit 76a3225: the generator's next number, and sums over the drive."""
    rng = np.random.default_rng(1043)
    drive = drive_past(lane, installed, rng, sign=None, driver=Driver())
    assert rng.integers(2**60) == 1081479662889206614
    assert (len(drive.packets), len(drive.track.time_s)) == (464, 684)
    assert drive.strength_dbm.sum() == pytest.approx(-147304.77959035, rel=1e-9)
    assert (drive.track.lat_deg - 42.3).sum() == pytest.approx(-0.3695230143, rel=1e-6)


def test_the_benchmark_fits_a_steeper_path_loss_to_two_rays(lane: TrueLane) -> None:
    exponents = []
    for physics in ROWS[:2]:
        row = Row()
        for seed in (1, 2):
            add_drive(row, physics, lane, np.random.default_rng(seed))
        exponents.append(float(np.mean(row.exponents)))
        assert row.path.rms_m < 0.05
        assert row.path.share_within_two_sigma > 0.8
    assert exponents[0] == pytest.approx(2.04, abs=0.4)
    assert exponents[1] > exponents[0] + 0.7
