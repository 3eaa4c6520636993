"""The picture of a decoded lane."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

from app.lanes.estimate import fit_lane
from app.lanes.types import LaneMarkers
from app.plots.lane import LanePicture, SignalPicture, picture_of_lane, plot_lane
from app.sensors.pose_track import PoseTrack

SVG = "{http://www.w3.org/2000/svg}"
BLUE, ORANGE, VIOLET, RED = "#1f5fa8", "#d68910", "#7d3c98", "#c0392b"
NONE = np.empty((0, 2))


def picture(length_m: float = 300.0, heading_deg: float = 90.0, step_m: float = 12.0) -> LanePicture:
    """A straight lane 3.2 m wide, driven 0.5 m left of its centre."""
    station = np.arange(0.0, length_m + 0.25, 0.5)
    h = math.radians(heading_deg)
    ahead, left = np.array([math.sin(h), math.cos(h)]), np.array([-math.cos(h), math.sin(h)])
    centre = 1000 + station[:, None] * ahead
    at = centre[:: int(step_m / 0.5)]
    markers = np.vstack([at + 1.6 * left, at - 1.6 * left])
    return LanePicture(
        centre, centre + 1.6 * left, centre - 1.6 * left, station, np.full(len(station), 0.02),
        np.full(len(station), 0.99), markers, np.arange(1, len(markers) + 1), np.repeat([1, 2], len(at)),
        track_m=centre + 0.5 * left,
    )  # fmt: skip


def parsed(svg: str) -> ElementTree.Element:
    root = ElementTree.fromstring(svg)
    assert "nan" not in svg
    assert "inf" not in svg
    width, height = (float(v) for v in root.attrib["viewBox"].split()[2:])
    for element in root.iter():
        for name in ("x", "cx", "x1", "x2"):
            assert -1 <= float(element.attrib.get(name, 0)) <= width
        for name in ("y", "cy", "y1", "y2"):
            assert -1 <= float(element.attrib.get(name, 0)) <= height
    return root


def circles(root: ElementTree.Element, colour: str) -> np.ndarray:
    found = [c for c in root.iter(f"{SVG}circle") if c.attrib["fill"] == colour]
    return np.array([(float(c.attrib["cx"]), float(c.attrib["cy"])) for c in found])


def texts(root: ElementTree.Element) -> list[str]:
    return ["".join(t.itertext()) for t in root.iter(f"{SVG}text")]


def crosses(root: ElementTree.Element) -> list[tuple[float, float, str]]:
    found = []
    for path in root.iter(f"{SVG}path"):
        if path.attrib.get("stroke") == RED and "m0 -8" in path.attrib["d"]:
            x, y = (float(v) + 4 for v in re.match(r"M([\d.]+) ([\d.]+)", path.attrib["d"]).groups())
            found.append((x, y, path[0].text))
    return found


@pytest.mark.parametrize("heading_deg", [0.0, 90.0, 213.0])
def test_plan_lies_along_the_page_at_one_scale_with_left_above(heading_deg):
    root = parsed(plot_lane(picture(heading_deg=heading_deg)))
    left, right = circles(root, BLUE)[:26], circles(root, ORANGE)[:26]  # the plan comes first
    scale = (left[-1, 0] - left[0, 0]) / 300
    assert scale > 3
    np.testing.assert_allclose(left[:, 1], left[0, 1], atol=0.1)
    np.testing.assert_allclose(right[:, 1] - left[:, 1], 3.2 * scale, atol=0.15)
    assert texts(root)[0] == "Lane of 300 m: 52 markers; ± 2.0 cm, at worst ± 2 cm"


def test_north_points_north():
    def arrow(heading_deg: float) -> float:
        path = next(p for p in parsed(plot_lane(picture(heading_deg=heading_deg))).iter(f"{SVG}path")
                    if p.attrib.get("stroke-width") == "1.5" and p.attrib["stroke"] == "#555")  # fmt: skip
        x0, y0, x1, y1 = (float(v) for v in re.findall(r"-?[\d.]+", path.attrib["d"]))
        return math.degrees(math.atan2(x1 - x0, y0 - y1)) % 360

    # the lane runs to the right, so north is to the left of it by its heading less 90
    assert arrow(90.0) == pytest.approx(0.0, abs=1.0)
    assert arrow(0.0) == pytest.approx(90.0, abs=1.0)
    assert arrow(135.0) == pytest.approx(315.0, abs=1.0)


def test_markers_left_out_are_crossed_out_with_number_and_reason():
    lane = picture()
    markers = lane.marker_m.copy()
    markers[5] += (0.0, 30.0)
    markers[9] += (0.0, 5000.0)
    markers[11] = math.nan
    out = {5: "off the line", 9: "off <the> line", 11: "not a place"}
    root = parsed(plot_lane(replace(lane, marker_m=markers, left_out=out)))
    assert texts(root)[0].startswith("Lane of 300 m: 49 markers, 3 left out")
    assert len(circles(root, BLUE)) == 2 * 23
    plan, far, *_ = crosses(root)
    assert plan[2] == "marker 6: off the line"
    assert far[2] == "marker 10: off <the> line (beyond)"
    blue = circles(root, BLUE)
    scale = (blue[:23, 0].max() - blue[:23, 0].min()) / 300
    assert blue[0, 1] - plan[1] == pytest.approx(30 * scale, abs=0.3)
    assert far[1] < blue[0, 1]  # at the border it lies beyond
    assert texts(root).count("6: off the line") == 2  # the text and the white under it
    assert texts(root).count("6: off the line (beyond)") == 2  # and in the straightened lane, where 30 m don't fit
    assert "12: not a place" in texts(root)


def test_labels_do_not_cover_each_other():
    lane = picture()
    out = dict.fromkeys(range(5, 15), "off the line")
    markers = lane.marker_m.copy()
    markers[5:15] = markers[5] + np.random.default_rng(0).uniform(-3, 3, (10, 2))
    root = parsed(plot_lane(replace(lane, marker_m=markers, left_out=out)))
    boxes = []
    for text in root.iter(f"{SVG}text"):
        if text.attrib.get("fill") == RED and text.text and "off the line" in text.text:
            x, y, width = float(text.attrib["x"]), float(text.attrib["y"]), 6.0 * len(text.text)
            boxes.append((x - width if text.attrib["text-anchor"] == "end" else x, y))
    assert len(boxes) > 6
    for i, (x, y) in enumerate(boxes):
        assert all(abs(x - a) > 80 or abs(y - b) > 11 for a, b in boxes[:i])


def test_straightened_lane_shows_metres_beside_the_centre_line():
    lane = picture(heading_deg=120.0)
    coarse = {name: getattr(lane, name)[::4] for name in ("centre_m", "left_m", "right_m", "station_m", "sigma_m")}
    lane = replace(lane, **coarse, confidence=lane.confidence[::4])
    root = parsed(plot_lane(lane))
    left, right = circles(root, BLUE)[26:], circles(root, ORANGE)[26:]
    track = [p for p in root.iter(f"{SVG}polyline") if p.attrib["stroke"] == "#1e8449"][1]
    ys = np.array([float(pair.split(",")[1]) for pair in track.attrib["points"].split()])
    y_track = ys[50]
    np.testing.assert_allclose(ys, y_track, atol=0.2)
    middle = (left[3, 1] + right[3, 1]) / 2
    assert left[3, 1] < middle
    assert (middle - y_track) / (middle - left[3, 1]) == pytest.approx(0.5 / 1.6, abs=0.02)
    np.testing.assert_allclose(np.diff(left[:, 0]), (left[-1, 0] - left[0, 0]) / 25, atol=0.2)


def test_unknown_boundaries_break_lines_and_area():
    lane = picture()
    left = lane.left_m.copy()
    left[200:300] = math.nan
    whole, broken = (parsed(plot_lane(replace(lane, left_m=line))) for line in (lane.left_m, left))

    def count(root: ElementTree.Element, kind: str, colour: str) -> int:
        return sum(e.attrib.get("stroke", e.attrib.get("fill")) == colour for e in root.iter(SVG + kind))

    assert count(broken, "polyline", BLUE) == 2 * count(whole, "polyline", BLUE) == 4
    assert count(broken, "polyline", ORANGE) == 2
    assert count(broken, "polygon", "#edf3ee") == 2 * count(whole, "polygon", "#edf3ee") == 4


def test_markers_without_a_side_are_violet_and_doubt_shows():
    lane = picture()
    side, sigma = lane.marker_side.copy(), lane.sigma_m.copy()
    side[3], sigma[300] = 0, 0.31
    root = parsed(plot_lane(replace(lane, marker_side=side, sigma_m=sigma)))
    assert len(circles(root, VIOLET)) == 2
    assert texts(root)[0].endswith("± 2.0 cm, at worst ± 31 cm")
    assert "50 cm" in texts(root)


def test_rssi_falls_on_a_straight_line_with_the_logarithm_of_distance():
    distance = np.array([10.0, 50.0, 340.0, math.nan, -1.0])
    rssi = -108 - 25 * np.log10(distance / 50, where=distance > 0, out=np.full(5, math.nan))
    signals = SignalPicture(distance, rssi, at_1m_dbm=-108 + 25 * math.log10(50), exponent=2.5)
    root = parsed(plot_lane(picture(), signals))
    assert "fitted: −108 dBm at 50 m, exponent 2.50" in texts(root)
    marks = next(p.attrib["d"] for p in root.iter(f"{SVG}path") if p.attrib.get("stroke-linecap") == "round")
    dots = [(float(x), float(y)) for x, y in re.findall(r"M([\d.]+) ([\d.]+)h", marks)]
    assert len(dots) == 3
    line = [p for p in root.iter(f"{SVG}polyline") if p.attrib["stroke"] == RED][-1]
    along = np.array([[float(v) for v in pair.split(",")] for pair in line.attrib["points"].split()])
    for x, y in dots:
        assert np.interp(x, along[:, 0], along[:, 1]) == pytest.approx(y, abs=0.2)
    assert "no path loss fitted" in texts(parsed(plot_lane(picture(), SignalPicture(distance, rssi))))


def test_no_lane_is_said_with_what_there_is():
    empty = np.empty(0)
    two = LanePicture(NONE, NONE, NONE, empty, empty, empty, np.array([(0.0, 0.0), (12.0, 0.0)]), np.array([7, 8]),
                      np.array([1, 1]), refusal="two markers & no track")  # fmt: skip
    root = parsed(plot_lane(two, SignalPicture(empty, empty)))
    assert texts(root)[0] == "No lane: two markers & no track; 2 markers"
    assert len(circles(root, BLUE)) == 2
    nothing = LanePicture(NONE, NONE, NONE, empty, empty, empty, NONE, empty.astype(int), empty.astype(int))
    assert texts(parsed(plot_lane(nothing)))[0] == "No lane: no path; 0 markers"


@pytest.mark.parametrize("length_m", [12.0, 40_000.0])
def test_short_and_long_lanes_stay_legible_and_small(length_m):
    svg = plot_lane(picture(length_m))
    root = parsed(svg)
    assert len(svg) < 700_000
    assert float(root.attrib["height"]) < 700
    ticks = [t for t in texts(root) if re.fullmatch(r"\d+(\.\d+)? m", t)]
    assert 5 < len(ticks) < 25


def test_a_decoded_lane_and_its_spoofed_marker():
    degree_m = 111_320.0
    along = np.repeat(np.arange(0, 240, 12.0), 2)
    side = np.tile([1, 2], 20)
    north = np.where(side == 1, 1.6, -1.6)
    north[11] += 30.0
    lat, lon = 0.0 + north / degree_m, 10.0 + along / degree_m
    lat[30] = math.nan
    markers = LaneMarkers(np.arange(101, 141), lon, lat, side, np.full(40, 0.02), np.full(40, math.nan))
    t = np.arange(0, 25, 0.5)
    track = PoseTrack(t, 10.0 + (10 * t - 5) / degree_m, np.zeros(50), np.full(50, 90.0), np.full(50, 0.02))
    shown = picture_of_lane(fit_lane(markers, track), markers, track)
    assert shown.left_out == {11: "off the line", 30: "not a place"}
    root = parsed(plot_lane(shown))
    assert "112: off the line" in texts(root)
    assert "131: not a place" in texts(root)
    assert texts(root)[0].startswith("Lane of 2")
    assert len(circles(root, BLUE)) == 2 * 19
    assert len(circles(root, ORANGE)) == 2 * 19
    refused = picture_of_lane(
        fit_lane(LaneMarkers(*(getattr(markers, n)[:1] for n in LaneMarkers.__slots__))),
        LaneMarkers(*(getattr(markers, n)[:1] for n in LaneMarkers.__slots__)),
    )
    assert texts(parsed(plot_lane(refused)))[0].startswith("No lane: there are no two markers")
