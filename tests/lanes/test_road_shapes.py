"""Paths on lanes that open, merge, shift and turn back, against the true centre line."""

from __future__ import annotations

import numpy as np
import pytest

from app.errors import InvalidParameter
from app.lanes.estimate import fit_lane
from app.simulation.radio.drive import SatelliteReceiver
from benchmarks.cerpm import scenes
from benchmarks.cerpm.path_errors import path_errors
from benchmarks.scenes.road_shapes import RoadShape, lane_of_shape

SHAPES = {
    "turning lane": RoadShape(extra_m=3.4, extra_start=0.3, taper_m=25.0),
    "lane that stays": RoadShape(extra_m=3.4, extra_start=0.5, taper_m=40.0, extra_stays=True, extra_on_left=True),
    "hairpin": RoadShape(radius_m=12.0, turn_deg=175.0, clothoid_m=10.0, widening_m2=25.0, length_m=300.0),
    "shift around an island": RoadShape(shift_m=3.0, shift_length_m=30.0),
}


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("labelled", [True, False])
def test_lanes_whose_width_changes_are_followed(name, labelled):
    rng = np.random.default_rng(len(name))
    lane = lane_of_shape(SHAPES[name])
    installed = scenes.install(lane, rng)
    installed = installed if labelled else installed.without_sides()
    path = fit_lane(scenes.markers_for_lane(installed), scenes.track(lane, rng))
    errors = path_errors(lane, path, float(installed.chainage_m.min()), float(installed.chainage_m.max()))
    assert path.left_out == ()
    assert errors.rms_m < 0.035
    assert errors.worst_m < 0.25
    assert errors.coverage == 1.0


def test_a_misplaced_marker_beside_a_taper_is_named():
    rng = np.random.default_rng(5)
    lane = lane_of_shape(SHAPES["turning lane"])
    installed = scenes.install(lane, rng)
    markers, row = scenes.markers_for_lane(installed), 14
    yaw = np.interp(installed.chainage_m[row], lane.chainage_m, lane.yaw_rad)
    aside = np.array([-np.sin(yaw), np.cos(yaw)])
    moved = lane.enu_from_wgs84(markers.lon_deg[[row]], markers.lat_deg[[row]]) + 1.2 * aside
    markers.lon_deg[row], markers.lat_deg[row] = (value[0] for value in lane.wgs84_from_enu(moved))
    path = fit_lane(markers, scenes.track(lane, rng))
    assert [one.row for one in path.left_out] == [row]


def test_a_receiver_that_is_off_by_a_lane_does_not_turn_the_sides():
    rng = np.random.default_rng(6)
    lane = lane_of_shape(RoadShape())
    markers = scenes.markers_for_lane(scenes.install(lane, rng))
    off = SatelliteReceiver(0.1, 0.0, 40.0, 1.5, 2.0)
    track = scenes.track(lane, rng, off)
    south = track.lat_deg - 3.0 / 111_000.0
    track.lat_deg[:] = south
    path = fit_lane(markers, track)
    assert path.refusal is None
    assert not any("other direction" in warning for warning in path.localization_warnings)


@pytest.mark.parametrize(
    ("name", "value"), [("length_m", 1.0), ("radius_m", 1.0), ("width_m", 9.0), ("taper_m", float("nan"))]
)
def test_shapes_out_of_bounds_are_refused(name, value):
    with pytest.raises(InvalidParameter) as caught:
        RoadShape(**{name: value})
    assert caught.value.field == name
