"""The driven lane among several marked ones."""

from __future__ import annotations

import numpy as np
import pytest

from app.lanes.estimate import fit_lane
from app.lanes.types import LaneMarkers, LeftOutReason
from app.plots.lane import picture_of_lane, plot_lane
from app.simulation.radio.drive import Multipath, SatelliteReceiver
from benchmarks.cerpm.path_errors import place_errors
from benchmarks.cerpm.scenes import markers_for_lane, track
from benchmarks.cerpm.topologies import TOPOLOGIES, make_topology


@pytest.mark.parametrize("name", list(TOPOLOGIES))
def test_the_driven_lane_is_found_with_rtk(name: str) -> None:
    rng = np.random.default_rng([71, list(TOPOLOGIES).index(name)])
    road = make_topology(name, rng)
    lane = fit_lane(markers_for_lane(road.installed), track(road.lane, rng))
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
