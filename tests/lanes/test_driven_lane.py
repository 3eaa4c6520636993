"""The driven lane among several marked ones."""

from __future__ import annotations

import numpy as np
import pytest

from app.lanes.estimate import fit_lane
from app.lanes.types import LeftOutReason
from app.simulation.radio.drive import SatelliteReceiver
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
    assert errors.rms_m < 0.06
    assert errors.worst_m < 0.3


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
    others = {out.number for out in lane.left_out if out.reason is LeftOutReason.OTHER_LANE}
    assert others == set(road.installed.number.tolist()) - road.own
