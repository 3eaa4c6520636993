"""OpenDRIVE maps, checked by ASAM's schema and evaluated by the equations of the standard."""

from __future__ import annotations

from collections import Counter
from copy import deepcopy
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scenariogeneration
from lxml import etree
from pyproj import Transformer

from app.errors import InvalidParameter
from app.formats.alignments.geometry import AlignmentDeclaration, BoundaryStyle
from app.formats.alignments.read import read_alignment
from app.planning.alignment import Alignment, Lane
from app.planning.build_alignment import build_alignment
from app.planning.outputs.hd_map import HdMap, MapMarker, map_of_plan
from app.planning.outputs.hd_opendrive import write_opendrive
from app.planning.placement import place_plan
from app.planning.rules import PlanRules
from tests.planning.roads import GEOD, START_DEG, bend, lane_of_curvature, opposite, road, straight

# ASAM's schema is under ASAM's licence and comes with the wheel of scenariogeneration; it is not part of this project
SCHEMA = Path(scenariogeneration.__file__).parents[1] / "schemas" / "opendrive_17_core.xsd"


@pytest.fixture(scope="module")
def schema() -> Any:
    return etree.XMLSchema(etree.parse(SCHEMA))


def hilly(lane: Lane) -> Lane:
    """With a crest, a widening and superelevation in the bends."""
    x = lane.chainage_m
    height = 100 + 12 * np.sin(x / 150)
    return replace(
        lane,
        height_m=height,
        grade=np.gradient(height, x),
        superelevation_rad=np.clip(-lane.curvature_per_m * 4, -0.06, 0.06),
        width_m=3.5 + np.clip((x - 300) / 100, 0, 0.5),
        design_speed_m_s=np.where(x < 350, 25.0, 50 / 3.6),
    )


def map_of(alignment: Alignment, **rules: object) -> HdMap:
    return map_of_plan(place_plan(alignment, PlanRules.model_validate({"version": 1, **rules}), name="A <b> & c"))


def cubic(element: Any, at: float) -> float:
    a, b, c, d = (float(element.get(name)) for name in "abcd")
    return a + b * at + c * at**2 + d * at**3


class Road:
    """A road of a file, evaluated as the standard's chapters 7 to 9 define it."""

    def __init__(self, root: Any, number: int) -> None:
        self.element = root.findall("road")[number]
        self.length = float(self.element.get("length"))
        text = root.findtext("header/geoReference")
        self.lonlat = Transformer.from_crs(text, "EPSG:4326", always_xy=True)

    def row(self, path: str, s: float, along: str = "s") -> tuple[Any, float]:
        rows = [row for row in self.element.findall(path) if float(row.get(along)) <= s + 1e-9]
        return rows[-1], s - float(rows[-1].get(along))

    def value(self, path: str, s: float, along: str = "s") -> float:
        return cubic(*self.row(path, s, along))

    def point(self, s: float, t: float) -> tuple[float, float, float]:
        """Longitude, latitude and heading in the plane."""
        geometry, ds = self.row("planView/geometry", s)
        curve = geometry.find("paramPoly3")
        assert curve.get("pRange") == "normalized"
        p = ds / float(geometry.get("length"))
        (u, v), (du, dv) = (
            [sum(float(curve.get(n + axis)) * f for n, f in zip("abcd", powers, strict=True)) for axis in "UV"]
            for powers in ((1, p, p**2, p**3), (0, 1, 2 * p, 3 * p**2))
        )
        hdg = float(geometry.get("hdg"))
        x = float(geometry.get("x")) + u * np.cos(hdg) - v * np.sin(hdg)
        y = float(geometry.get("y")) + u * np.sin(hdg) + v * np.cos(hdg)
        heading = hdg + np.arctan2(dv, du)
        return (*self.lonlat.transform(x - t * np.sin(heading), y + t * np.cos(heading)), heading)


@pytest.fixture(scope="module")
def content() -> HdMap:
    lane = hilly(bend(100, straight_m=340))
    return map_of(road(lane, opposite(lane, "2")), plates={"max_grade": 0.2}, lines={}, tags={}, cerpm={})


@pytest.fixture(scope="module")
def root(content: HdMap) -> Any:
    return etree.fromstring(write_opendrive(content))


def test_the_file_is_valid_by_the_schema_of_1_7(schema: Any, root: Any) -> None:
    schema.assertValid(root)
    header = root.find("header")
    assert (header.get("revMajor"), header.get("revMinor")) == ("1", "7")
    assert header.get("name") == "A <b> & c"
    assert header.find("offset") is None
    broken = deepcopy(root)
    broken.find("road").set("length", "-1")
    assert not schema.validate(broken)


def test_markers_stand_where_they_are_within_a_millimetre_as_objects_and_as_signals(content: HdMap, root: Any) -> None:
    markers = {marker.id: marker for marker in content.markers}
    for path in ("objects/object", "signals/signal"):
        names = []
        for number in range(2):
            line = Road(root, number)
            for element in line.element.findall(path):
                marker = markers[element.get("name")]
                names.append(marker.id)
                s, t = float(element.get("s")), float(element.get("t"))
                lon, lat, _ = line.point(s, t)
                assert GEOD.inv(lon, lat, marker.lon_deg, marker.lat_deg)[2] < 1e-3
                height = line.value("elevationProfile/elevation", s) + float(element.get("zOffset"))
                assert height == pytest.approx(marker.height_m, abs=1e-3)
                turn = float(element.get("hdg") or element.get("hOffset"))
                # a straight tag of 4 m at 100 m radius; markers on the line between the lanes may head the other way
                assert min(abs(turn), abs(abs(turn) - np.pi)) < 0.045
        assert sorted(names) == sorted(markers)


def test_plates_lie_on_the_elevation_and_carry_family_code_and_id(content: HdMap, root: Any) -> None:
    objects = root.findall("road/objects/object")
    signals = root.findall("road/signals/signal")
    assert Counter(element.get("subtype") for element in objects) == Counter(m.family for m in content.markers)
    assert Counter(element.get("type") for element in signals) == Counter(m.family for m in content.markers)
    codes = {marker.id: marker.code for marker in content.markers}
    for element in objects:
        data = {user.get("code"): user.get("value") for user in element.findall("userData")}
        assert codes[data["id"]] == data["code"]
        assert data["family"] == element.get("subtype")
        assert element.get("type") == "roadMark"
        if data["family"] == "plate":
            assert [element.get("length"), element.get("width")] == ["0.325", "0.325"]
            assert abs(float(element.get("zOffset"))) < 0.003
    assert all(codes[element.get("name")] == element.get("text") for element in signals)
    assert all(element.get("country") == "OpenDRIVE" for element in signals)


def test_lanes_are_within_a_centimetre_of_the_alignment(content: HdMap, root: Any) -> None:
    lane, line = content.lanes[0], Road(root, 0)
    assert line.length == pytest.approx(lane.length_m, abs=0.1)
    assert len(line.element.findall("planView/geometry")) < 60
    for s in np.linspace(0, line.length, 200):
        width = line.value("lanes/laneSection/right/lane/width", s, "sOffset")
        offset = line.value("lanes/laneOffset", s)
        chainage = np.array([s * lane.length_m / line.length])
        for t, side in ((offset, 0.5), (offset - width, -0.5)):
            expected = lane.position_at(chainage, side * lane.value_at(lane.width_m, chainage))
            lon, lat, _ = line.point(float(s), t)
            azimuth, _, away = GEOD.inv(lon, lat, expected[0][0], expected[1][0])
            across = away * np.sin(np.radians(azimuth - lane.heading_at(chainage)[0]))
            assert abs(across) < 0.01
        assert line.value("elevationProfile/elevation", s) == pytest.approx(
            lane.value_at(lane.height_m, chainage)[0], abs=0.01
        )
        assert line.value("lateralProfile/superelevation", s) == pytest.approx(
            lane.value_at(lane.superelevation_rad, chainage)[0], abs=0.004
        )


def test_curves_join_in_position_and_heading_and_have_their_length(root: Any) -> None:
    line = Road(root, 0)
    geometry = line.element.findall("planView/geometry")
    for before, after in pairwise(geometry):
        s = float(after.get("s"))
        lon, lat, heading = line.point(s - 1e-7, 0.0)
        again = line.point(s, 0.0)
        assert GEOD.inv(lon, lat, *again[:2])[2] < 1e-5
        assert heading == pytest.approx(again[2], abs=1e-6)
        assert s == pytest.approx(float(before.get("s")) + float(before.get("length")), abs=1e-8)
    xy = np.array([line.lonlat.transform(*line.point(s, 0.0)[:2], direction="INVERSE") for s in np.arange(0, 785, 0.5)])
    assert np.linalg.norm(np.diff(xy, axis=0), axis=1).sum() == pytest.approx(784.5, abs=0.01)


def test_speeds_and_paint(root: Any) -> None:
    lane = root.find("road/lanes/laneSection/right/lane")
    speeds = [(float(e.get("sOffset")), e.get("max"), e.get("unit")) for e in lane.findall("speed")]
    assert speeds == [(0.0, "90", "km/h"), (pytest.approx(350, abs=0.1), "50", "km/h")]
    assert lane.find("roadMark").get("type") == "solid"
    assert root.find("road/lanes/laneSection/center/lane/roadMark").get("type") == "broken"


def test_roads_that_continue_one_another_are_linked_unless_they_branch(schema: Any) -> None:
    whole = straight(400)

    def part(name: str, first: int, last: int) -> Lane:
        cut = slice(first, last + 1)
        values = {
            field: getattr(whole, field)[cut]
            for field in (
                "lon_deg", "lat_deg", "height_m", "heading_deg", "curvature_per_m", "grade", "superelevation_rad",
                "width_m", "design_speed_m_s", "station_m",
            )
        }  # fmt: skip
        return replace(whole, name=name, chainage_m=whole.chainage_m[cut] - first, **values)

    first, second = part("a", 0, 200), part("b", 200, 400)
    root = etree.fromstring(write_opendrive(HdMap("two", (first, second), ())))
    schema.assertValid(root)
    links = [[(e.tag, e.get("elementId"), e.get("contactPoint")) for e in r.find("link")] for r in root.findall("road")]
    assert links == [[("successor", "2", "start")], [("predecessor", "1", "end")]]
    exit_lane = replace(second, name="c", left_style=BoundaryStyle.NONE)
    root = etree.fromstring(write_opendrive(HdMap("three", (first, second, exit_lane), ())))
    assert [len(r.find("link")) for r in root.findall("road")] == [0, 0, 0]


def test_signs_of_a_registry_without_heights(schema: Any) -> None:
    lane = replace(straight(100), height_m=np.full(101, np.nan))
    lon, lat = lane.position_at([50.0], -3.0)
    sign = MapMarker("m-1", "fiducial", "aruco-4x4-17", lon[0], lat[0], None, 80.0, "upright", 0.4, upright=True)
    root = etree.fromstring(write_opendrive(HdMap("registry", (lane,), (sign,))))
    schema.assertValid(root)
    element = root.find("road/objects/object")
    assert float(element.get("s")) == pytest.approx(50, abs=1e-3)
    assert float(element.get("t")) == pytest.approx(-3, abs=1e-3)
    assert [element.get(name) for name in ("zOffset", "width", "height", "length")] == ["0", "0.4", "0.4", None]
    assert root.find("road/elevationProfile/elevation") is None


def test_a_lane_whose_speed_is_not_known_everywhere_has_none(schema: Any) -> None:
    lane = straight(100)
    partly = replace(lane, name="2", design_speed_m_s=np.where(lane.chainage_m < 50, 25.0, np.nan))
    root = etree.fromstring(write_opendrive(HdMap("speeds", (lane, partly), ())))
    schema.assertValid(root)
    assert [len(list(element.iter("speed"))) for element in root.findall("road")] == [1, 0]


def test_a_road_of_many_bends_across_the_antimeridian(schema: Any) -> None:
    curvature = 0.02 * np.sin(np.arange(1500) / 40)
    lane = lane_of_curvature(curvature, start_deg=(179.995, -17.0), heading_deg=90)
    made = map_of(road(lane), plates={"spacing_m": 50})
    root = etree.fromstring(write_opendrive(made))
    schema.assertValid(root)
    line = Road(root, 0)
    for element, marker in zip(line.element.findall("objects/object"), made.markers, strict=True):
        lon, lat, _ = line.point(float(element.get("s")), float(element.get("t")))
        assert GEOD.inv(lon, lat, marker.lon_deg, marker.lat_deg)[2] < 1e-3
        assert float(element.get("hdg")) == pytest.approx(0, abs=0.005)
    assert max(abs(float(root.find("header").get(side))) for side in ("west", "east")) < 1500


def test_a_map_without_lanes_and_a_marker_beside_none_are_refused() -> None:
    marker = MapMarker("m-7", "cerpm", "12", START_DEG[0], START_DEG[1] + 0.01)
    with pytest.raises(InvalidParameter, match="without lanes") as refused:
        write_opendrive(HdMap("nothing", (), (marker,)))
    assert refused.value.cure
    with pytest.raises(InvalidParameter, match=r"m-7 at 8\.400000, 49\.010000 lies beside no lane"):
        write_opendrive(HdMap("far", (straight(100),), (marker,)))
    behind = replace(marker, lat_deg=START_DEG[1], lon_deg=START_DEG[0] - 0.0001)
    with pytest.raises(InvalidParameter, match="beside no lane"):
        write_opendrive(HdMap("behind", (straight(100),), (behind,)))


def test_a_marker_beyond_the_end_of_the_nearest_lane_is_beside_the_next_one(schema: Any) -> None:
    first = straight(100, heading_deg=80.0)
    end = (float(first.lon_deg[-1]), float(first.lat_deg[-1]))
    second = replace(straight(100, heading_deg=120.0, start_deg=end), name="2")
    lon, lat = second.position_at([0.2], 6.0)  # 6 m to the left, where the first lane is nearer
    marker = MapMarker("m", "cerpm", "12", float(lon[0]), float(lat[0]))
    root = etree.fromstring(write_opendrive(HdMap("two", (first, second), (marker,))))
    schema.assertValid(root)
    assert [len(element.findall("objects/object")) for element in root.findall("road")] == [0, 1]
    assert float(root.find("road/objects/object").get("t")) == pytest.approx(6.0, abs=1e-3)


def test_markers_beside_no_lane_can_be_left_out_and_the_file_names_them(schema: Any) -> None:
    near = MapMarker("m-1", "cerpm", "12", *START_DEG)
    far = replace(near, id="m-2", lat_deg=START_DEG[1] + 0.01)
    root = etree.fromstring(write_opendrive(HdMap("some", (straight(100),), (near, far)), leave_out=True))
    schema.assertValid(root)
    assert [element.get("name") for element in root.iter("signal")] == ["m-1"]
    said = {element.get("code"): element.get("value") for element in root.findall("header/userData")}
    assert said["left_out"] == "m-2"


@pytest.mark.parametrize("radius_m", [62.5, 250.0])
def test_our_own_reader_gets_the_lane_back_within_a_centimetre(radius_m: float) -> None:
    lane = replace(hilly(bend(radius_m, straight_m=200)), width_m=bend(radius_m, straight_m=200).width_m)
    content = write_opendrive(HdMap("road", (lane,), (), vertical_datum="ellipsoid"))
    declaration = AlignmentDeclaration(vertical_datum="ellipsoid")
    read = build_alignment(read_alignment(content, "road.xodr"), declaration=declaration)
    (again,) = read.lanes
    assert read.surveyed
    assert again.length_m == pytest.approx(lane.length_m, abs=0.01)
    lon, lat = again.position_at(lane.chainage_m)
    assert GEOD.inv(lon, lat, lane.lon_deg, lane.lat_deg)[2].max() < 0.01
    assert np.abs(again.value_at(again.height_m, lane.chainage_m) - lane.height_m).max() < 0.01
    assert np.abs(again.value_at(again.width_m, lane.chainage_m) - lane.width_m).max() < 0.005
    assert (again.left_style, again.right_style) == (lane.left_style, lane.right_style)
    # crown and speeds jump in the lane; they are those of the file away from the jumps
    x = np.array([50.0, 300.0])
    assert again.value_at(again.superelevation_rad, x) == pytest.approx(
        lane.value_at(lane.superelevation_rad, x), abs=2e-3
    )
    assert again.design_speed_m_s[0] == pytest.approx(25.0)
