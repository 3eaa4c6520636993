"""The driven lane among several marked ones."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import scipy

from app.lanes.driven_lane import find_registered_lines
from app.lanes.estimate import fit_lane
from app.lanes.types import NO_LINE, Lane, LaneMarkers, LeftOutReason, PacketStrengths
from app.plots.lane import picture_of_lane, plot_lane
from app.simulation.radio.drive import Multipath, SatelliteReceiver, drive_past
from benchmarks.cerpm.path_errors import place_errors
from benchmarks.cerpm.scenes import markers_for_lane, track
from benchmarks.cerpm.topologies import TOPOLOGIES, Topology, make_topology


@pytest.mark.parametrize("name", list(TOPOLOGIES))
def test_the_driven_lane_is_found_with_rtk(name: str) -> None:
    rng = np.random.default_rng([71, list(TOPOLOGIES).index(name)])
    road = make_topology(name, rng)
    lane = fit_lane(markers_for_lane(road.installed), track(road.course, rng))
    assert lane.refusal is None
    errors = place_errors(road.lane, lane, 30.0, road.lane.length_m - 30.0)
    assert errors is not None
    assert errors.rms_m < 0.045
    assert errors.worst_m < 0.2


def test_lanes_that_a_coarse_receiver_cannot_tell_apart_are_named() -> None:
    rng = np.random.default_rng(72)
    road = make_topology("two lanes, shared line", rng)
    lane = fit_lane(markers_for_lane(road.installed), track(road.lane, rng, SatelliteReceiver.plain()))
    assert lane.refusal is not None
    assert "equally likely" in lane.refusal
    assert not len(lane.station_m)


def test_markers_of_the_other_lane_are_said_to_be_its_own() -> None:
    rng = np.random.default_rng(73)
    road = make_topology("frontage road", rng)
    lane = fit_lane(markers_for_lane(road.installed), track(road.lane, rng))
    assert lane.of_other_lanes == set(road.installed.number.tolist()) - road.own
    drawn = plot_lane(picture_of_lane(lane, markers_for_lane(road.installed)))
    assert f"{len(lane.of_other_lanes)} of other lanes" in drawn
    assert "left out;" not in drawn


def test_markers_that_were_left_out_before_stay_listed() -> None:
    rng = np.random.default_rng(74)
    road = make_topology("three lanes", rng)
    markers = markers_for_lane(road.installed)
    twice = np.append(np.arange(len(markers)), 0)  # the first number is received in a second place
    lat_deg = markers.lat_deg[twice]
    lat_deg[-1] += 1e-4
    columns = (markers.number, markers.lon_deg, lat_deg, markers.side, markers.sigma_m, markers.speed_limit_kmh)
    heard = LaneMarkers(*(column if column is lat_deg else column[twice] for column in columns))
    lane = fit_lane(heard, track(road.lane, rng))
    assert lane.refusal is None
    reasons = {out.number: out.reason for out in lane.left_out}
    assert reasons[int(markers.number[0])] is LeftOutReason.TWO_PLACES
    assert LeftOutReason.OTHER_LANE in reasons.values()


def test_a_track_that_jumps_between_lanes_gives_no_path_in_the_wrong_one() -> None:
    jumping = SatelliteReceiver(0.008, 0.018, 20.0, 0.3, 0.02, 20.0, multipath=Multipath(step_sd_m=1.5))
    worst_m = []
    for seed in range(75, 81):
        rng = np.random.default_rng(seed)
        road = make_topology("two lanes, shared line", rng)
        lane = fit_lane(markers_for_lane(road.installed), track(road.lane, rng, jumping))
        errors = place_errors(road.lane, lane, 30.0, road.lane.length_m - 30.0) if lane.refusal is None else None
        worst_m.append(0.0 if errors is None else errors.worst_m)
    assert max(worst_m) < 1.0


@pytest.mark.parametrize(("name", "lanes"), [("lane change", 2), ("overtaking", 3)])
def test_each_stretch_says_in_which_lane_the_vehicle_was(name: str, lanes: int) -> None:
    rng = np.random.default_rng(81)
    road = make_topology(name, rng)
    lane = fit_lane(markers_for_lane(road.installed), track(road.course, rng))
    assert lane.refusal is None
    stays = [stretch.lane for stretch in lane.stretches if not stretch.changing]
    assert len(stays) == lanes
    assert stays[-1] == 0
    assert [abs(stay) for stay in stays[-2::-1]] == [1, 0][: lanes - 1]
    assert lane.stretches[0].from_m == 0
    assert lane.stretches[-1].to_m == pytest.approx(lane.station_m[-1])
    assert all(a.to_m == b.from_m for a, b in itertools.pairwise(lane.stretches))
    # where the vehicle was in the path's lane, its true way runs along the path
    here = road.lane.enu_from_wgs84(lane.lon_deg, lane.lat_deg)
    away, _ = scipy.spatial.cKDTree(road.course.centre_m).query(here)
    for stretch in lane.stretches:
        inside = (lane.station_m > max(stretch.from_m, 40.0)) & (
            lane.station_m < min(stretch.to_m, lane.station_m[-1] - 40.0)
        )
        if stretch.changing or not inside.any():
            continue
        assert (away[inside] < 1.5).all() == (stretch.lane == 0), stretch


def test_other_lanes_have_their_own_paths() -> None:
    rng = np.random.default_rng(82)
    road = make_topology("three lanes", rng)
    lane = fit_lane(markers_for_lane(road.installed), track(road.lane, rng))
    places = sorted(other.position for other in lane.beside)
    assert places in ([1, 2], [-1, 1], [-2, -1])
    width_m = float(np.median(lane.width_m))
    for other in lane.beside:
        line = scipy.spatial.cKDTree(other.lane.position_enu_m)
        inner = (lane.station_m > 40.0) & (lane.station_m < lane.station_m[-1] - 40.0)
        away, _ = line.query(lane.position_enu_m[inner])
        assert float(np.sqrt(np.mean((away - abs(other.position) * width_m) ** 2))) < 0.15
        assert float(np.median(other.lane.sigma_m)) < 0.03


def test_an_oncoming_lane_runs_the_other_way() -> None:
    rng = np.random.default_rng(83)
    road = make_topology("oncoming lane", rng)
    lane = fit_lane(markers_for_lane(road.installed), track(road.lane, rng))
    (other,) = [one for one in lane.beside if one.position == 1]
    assert other.direction == "oncoming"
    middle = len(other.lane.heading_deg) // 2
    nearest = int(scipy.spatial.cKDTree(lane.position_enu_m).query(other.lane.position_enu_m[middle])[1])
    turned = (float(other.lane.heading_deg[middle]) - float(lane.heading_deg[nearest])) % 360.0
    assert turned == pytest.approx(180.0, abs=5.0)


def test_the_strength_of_passed_markers_shows_the_lane_to_a_coarse_receiver() -> None:
    refused = {True: 0, False: 0}
    for seed in range(84, 90):
        rng = np.random.default_rng(seed)
        road = make_topology("two lanes, shared line", rng)
        heard = drive_past(road.course, road.installed, rng, sign=None, receiver=SatelliteReceiver.plain())
        strengths = PacketStrengths(
            road.installed.number[heard.sender],
            np.array([packet.received_at_s for packet in heard.packets]),
            np.array([packet.rssi_dbm for packet in heard.packets]),
        )
        markers = markers_for_lane(road.installed.chosen(np.isin(np.arange(len(road.installed)), heard.sender)))
        for known in (True, False):
            lane = fit_lane(markers, heard.track, strengths=strengths if known else None)
            refused[known] += lane.refusal is not None
            if lane.refusal is None:
                errors = place_errors(road.lane, lane, 30.0, road.lane.length_m - 30.0)
                assert errors is not None
                assert errors.rms_m < 0.1
    assert refused[True] < refused[False]


def test_a_path_that_turns_aside_where_the_vehicle_does_not_is_unfit() -> None:
    rng = np.random.default_rng(91)
    road = make_topology("frontage road", rng)
    own = road.installed.chosen(np.isin(road.installed.number, list(road.own)))
    markers = markers_for_lane(own)
    right = fit_lane(markers, track(road.lane, np.random.default_rng(92)))
    assert not right.track_apart
    k = len(road.lane.chainage_m) // 2
    aside_m = 1.9 * np.array([-math.sin(road.lane.yaw_rad[k]), math.cos(road.lane.yaw_rad[k])])
    half = own.chainage_m > own.chainage_m.mean()
    lon_deg, lat_deg = road.lane.wgs84_from_enu(own.point_m + half[:, None] * aside_m)
    moved = replace(markers, lon_deg=lon_deg, lat_deg=lat_deg)
    wrong = fit_lane(moved, track(road.lane, np.random.default_rng(92)))
    assert wrong.refusal is not None or wrong.track_apart
    assert wrong.refusal is not None or any("turns aside" in text for text in wrong.localization_warnings)


def fitted_with_lines(road: Topology, line: list[int] | np.ndarray, seed: int, receiver: SatelliteReceiver) -> Lane:
    """The path of a drive whose packets have the strengths that the receiver hears."""
    heard = drive_past(road.course, road.installed, np.random.default_rng(seed), sign=None, receiver=receiver)
    strengths = PacketStrengths(
        road.installed.number[heard.sender],
        np.array([packet.received_at_s for packet in heard.packets]),
        np.array([packet.rssi_dbm for packet in heard.packets]),
    )
    was_heard = np.isin(np.arange(len(road.installed)), heard.sender)
    markers = replace(markers_for_lane(road.installed.chosen(was_heard)), line=np.asarray(line)[was_heard])
    return fit_lane(markers, heard.track, strengths=strengths)


def test_registered_lines_decide_drives_that_markers_alone_do_not() -> None:
    refused = {True: 0, False: 0}
    for seed in range(301, 307):
        road = make_topology("two lanes, shared line", np.random.default_rng(seed))
        for known in (True, False):
            line = road.line if known else np.full(len(road.line), NO_LINE)
            lane = fitted_with_lines(road, line, seed, SatelliteReceiver.plain())
            refused[known] += lane.refusal is not None
            if lane.refusal is None:
                errors = place_errors(road.lane, lane, 30.0, road.lane.length_m - 30.0)
                assert errors is not None
                assert errors.rms_m < 0.1
            assert not any("registered" in text for text in lane.localization_warnings)
    assert refused[True] < refused[False]


@pytest.mark.parametrize("wrong", ["tenth", "all", "one line"])
def test_lines_that_are_registered_wrongly_give_a_warning_and_no_other_path(wrong: str) -> None:
    rng = np.random.default_rng(95)
    road = make_topology("three lanes", rng)
    markers, driven = markers_for_lane(road.installed), track(road.lane, rng)
    drawn = rng.choice(np.unique(road.line), len(road.line))
    share = {"tenth": 0.1, "all": 1.0, "one line": 0.0}[wrong]
    line = np.where(rng.random(len(drawn)) < share, drawn, 0 if wrong == "one line" else road.line)
    lane = fit_lane(replace(markers, line=line), driven)
    assert any("contradict the lines of the road" in text for text in lane.localization_warnings)
    errors = place_errors(road.lane, lane, 30.0, road.lane.length_m - 30.0)
    assert errors is not None
    assert errors.rms_m < 0.045


def test_registered_lines_run_where_markers_are_missing() -> None:
    along = np.concatenate([np.arange(0.0, 100.0, 12.0), [150.0, 250.0]])
    lines = find_registered_lines(along, 0.01 * along, np.full(len(along), 4))
    station, left = lines.points(np.array([-5.0, 30.0, 125.0, 200.0, 260.0]))
    assert station.tolist() == [30.0, 125.0]  # neither beyond its ends nor through a gap of 100 m
    assert left == pytest.approx(0.01 * station)
    assert (lines.known_share, lines.contradicted) == (1.0, 0)
    assert not len(find_registered_lines(along, along, np.full(len(along), NO_LINE)).start)


def test_lines_that_cross_and_markers_off_their_line_are_not_used() -> None:
    along = np.arange(0.0, 200.0, 20.0)
    left = np.where(along < 90, 1.7, -1.7)  # two lines whose registrations are swapped halfway
    both = find_registered_lines(np.tile(along, 2), np.concatenate([left, -left]), np.repeat([1, 2], len(along)))
    assert both.contradicted == 2
    assert not len(both.points(np.array([90.0]))[0])
    assert len(both.points(np.array([50.0, 150.0]))[0]) == 4
    mixed = find_registered_lines(np.tile(along, 2), np.repeat([1.7, -1.7], len(along)), np.tile([1, 2], len(along)))
    assert mixed.contradicted > 4
    assert (mixed.known_share, len(mixed.start)) == (0.0, 0)
    off = np.where(along == 100, 3.4, 0.0)
    one = find_registered_lines(along, off, np.ones(len(along), np.int64))
    assert one.contradicted == 1
    assert one.points(np.array([90.0]))[1] == pytest.approx([0.0])
