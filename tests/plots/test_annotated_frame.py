"""A lane drawn over a frame."""

from __future__ import annotations

import numpy as np

from app.lanes.overlay import VehiclePose, lane_in_frame
from app.plots.annotated_frame import draw_lane
from app.sensors.camera import Camera

CAMERA = Camera.from_field_of_view(960, 540, 80.0, height_m=1.4, depression_deg=6.0)
HERE = VehiclePose((0.0, 0.0, 0.0), 0.0)


def overlay(first_m=-20.0, last_m=90.0, markers=()):
    north = np.linspace(first_m, last_m, 30)
    sides = [np.column_stack([north, np.full(30, east), np.zeros(30)]) for east in (-1.75, 1.75, 0.0)]
    return lane_in_frame(*sides, pose=HERE, camera=CAMERA, markers_ned_m=markers).visible()


def row_at(ahead_m: float) -> int:
    depression = np.arctan2(CAMERA.height_m, ahead_m) - np.radians(CAMERA.depression_deg)
    return round(CAMERA.cy_px + CAMERA.fy_px * np.tan(depression))


def test_area_lines_and_markers_are_where_the_lane_is():
    grey = np.full((540, 960), 100, np.uint8)
    picture = draw_lane(grey, overlay(markers=[(12.0, -1.75, 0.0)]))
    assert picture.shape == (540, 960, 3)
    assert (grey == 100).all()
    changed = (picture != 100).any(axis=2)
    row = row_at(6.0)
    scale = CAMERA.fx_px / (6.0 / np.cos(np.radians(CAMERA.depression_deg)))  # about: at 6 m ahead
    half = 1.75 * scale
    across = np.flatnonzero(changed[row])
    assert across.min() == np.clip(across.min(), 479.5 - half - 12, 479.5 - half + 12)
    assert across.max() == np.clip(across.max(), 479.5 + half - 12, 479.5 + half + 12)
    assert changed[row, across.min() : across.max()].all()
    assert not changed[: row_at(95.0) - 6].any()  # nothing above where the lane ends
    blue, green, red = picture[row, round(479.5 - half / 2)].astype(int)
    assert green > 110 > max(blue, red)  # the area
    assert picture[row, 478:482].max() > 220  # the centre line
    left, right = picture[row, across.min() : across.min() + 10], picture[row, across.max() - 9 : across.max() + 1]
    assert (left[:, 0].astype(int) - left[:, 2]).max() > 100  # blue
    assert (right[:, 2].astype(int) - right[:, 0]).max() > 100  # orange
    without = draw_lane(grey, overlay())
    rows, cols = np.nonzero((picture != without).any(axis=2))
    assert abs(rows.mean() - row_at(12.0)) < 1.5
    assert abs(cols.mean() - (479.5 - 1.75 * CAMERA.fx_px / 12.0)) < 3


def test_a_lane_behind_leaves_the_frame_as_it_is():
    colour = np.full((540, 960, 3), 7, np.uint8)
    np.testing.assert_array_equal(draw_lane(colour, overlay(-90.0, -2.0)), colour)
