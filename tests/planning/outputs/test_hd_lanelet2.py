"""lanelet2 maps, read back by the lanelet2 library."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import lanelet2
import numpy as np
import numpy.typing as npt
import pytest
from lanelet2.core import GPSPoint
from lanelet2.io import Origin
from lanelet2.projection import UtmProjector

from app.formats.alignments.geometry import AlignmentDeclaration, BoundaryStyle, EventKind
from app.formats.alignments.read import read_alignment
from app.planning.alignment import Alignment, Lane, RoadEvent
from app.planning.build_alignment import build_alignment
from app.planning.outputs.hd_lanelet2 import write_lanelet2
from app.planning.outputs.hd_map import HdMap, MapMarker, map_of_plan
from app.planning.placement import place_plan
from app.planning.rules import PlanRules
from tests.planning.roads import GEOD, START_DEG, bend, opposite, road, straight

PROJECTOR = UtmProjector(Origin(START_DEG[1], START_DEG[0]))
STOP = RoadEvent(EventKind.STOP_LINE, "1", 700.0)


def two_way(lane: Lane) -> tuple[Lane, Lane]:
    """A lane and the opposite one, both with stations of one reference line."""
    return lane, replace(opposite(lane, "2"), station_m=lane.length_m - lane.chainage_m)


def map_of(alignment: Alignment, **rules: object) -> HdMap:
    return map_of_plan(
        place_plan(alignment, PlanRules.model_validate({"version": 1, **rules}), name='A <road> & "more"')
    )


def load(folder: Path, content: bytes) -> lanelet2.core.LaneletMap:
    path = folder / "map.osm"
    path.write_bytes(content)
    loaded, errors = lanelet2.io.loadRobust(str(path), PROJECTOR)
    assert list(errors) == []
    return loaded


def place_of(marker: MapMarker) -> npt.NDArray[np.float64]:
    point = PROJECTOR.forward(GPSPoint(marker.lat_deg, marker.lon_deg, marker.height_m or 0.0))
    return np.array([point.x, point.y, point.z])


def xyz(points: object) -> npt.NDArray[np.float64]:
    return np.array([(point.x, point.y, point.z) for point in points])  # type: ignore[attr-defined]


@pytest.fixture(scope="module")
def content() -> HdMap:
    lanes = two_way(bend(100, straight_m=340, grade=0.03))
    return map_of(road(*lanes, events=(STOP,)), plates={}, lines={}, tags={}, cerpm={})


@pytest.fixture
def loaded(content: HdMap, tmp_path: Path) -> lanelet2.core.LaneletMap:
    return load(tmp_path, write_lanelet2(content))


def test_lanelet2_keeps_every_marker_within_a_millimetre_also_after_writing_it_again(
    content: HdMap, loaded: lanelet2.core.LaneletMap, tmp_path: Path
) -> None:
    again = str(tmp_path / "again.osm")
    lanelet2.io.write(again, loaded, PROJECTOR)
    for read in (loaded, lanelet2.io.load(again, PROJECTOR)):
        places = {p.attributes["waymark_id"]: xyz([p])[0] for p in read.pointLayer if "waymark_id" in p.attributes}
        landmarks = [w for w in [*read.lineStringLayer, *read.polygonLayer] if "waymark_id" in w.attributes]
        places |= {w.attributes["waymark_id"]: xyz(w).mean(axis=0) for w in landmarks}
        assert len(places) == len(content.markers)
        for marker in content.markers:
            assert np.linalg.norm(places[marker.id] - place_of(marker)) < 1e-3
        codes = Counter(p.attributes["marker_id"] for p in read.pointLayer if "marker_id" in p.attributes)
        codes += Counter(w.attributes["marker_id"] for w in landmarks)
        assert codes == Counter(marker.code for marker in content.markers)


def test_plates_are_landmarks_with_x_to_the_right_and_y_forward(
    content: HdMap, loaded: lanelet2.core.LaneletMap
) -> None:
    plates = {marker.id: marker for marker in content.markers if marker.family == "plate"}
    landmarks = [w for w in [*loaded.lineStringLayer, *loaded.polygonLayer] if w.attributes["type"] == "pose_marker"]
    assert len(landmarks) == len(plates) > 5
    for landmark in landmarks:
        marker = plates[landmark.attributes["waymark_id"]]
        assert landmark.attributes["area"] == "yes"
        assert landmark.attributes["subtype"] == "plate"
        corners = xyz(landmark)
        assert corners.shape == (4, 3)
        x, y = corners[1] - corners[0], corners[2] - corners[1]
        assert marker.side_m == pytest.approx(0.325)
        # UTM's scale is 0.9997 here
        assert [np.linalg.norm(x), np.linalg.norm(y)] == pytest.approx([0.325, 0.325], rel=5e-4)
        assert x @ y == pytest.approx(0, abs=1e-4)
        assert np.cross(x, y)[2] > 0
        assert marker.heading_deg is not None
        convergence_deg = np.degrees(np.radians(START_DEG[0] - 9.0) * np.sin(np.radians(START_DEG[1])))
        heading = (np.degrees(np.arctan2(y[0], y[1])) - marker.heading_deg + convergence_deg + 180) % 360 - 180
        assert heading == pytest.approx(0, abs=0.1)
        assert y[2] / np.hypot(y[0], y[1]) == pytest.approx(marker.grade, abs=1e-3)
        assert abs(marker.grade) == pytest.approx(0.03)


def test_every_node_has_a_height_and_ids_are_unique(content: HdMap) -> None:
    root = ElementTree.fromstring(write_lanelet2(content))
    nodes = root.findall("node")
    assert all([tag.get("v") for tag in node if tag.get("k") == "ele"] != [] for node in nodes)
    ids = [element.get("id") for element in root if element.get("id")]
    assert len(ids) == len(set(ids))
    assert all(int(number or 0) > 0 for number in ids)
    assert root.findtext("note") == 'A <road> & "more"'


def test_lanelets_are_routable_and_have_1_to_50_metres(loaded: lanelet2.core.LaneletMap) -> None:
    rules = lanelet2.traffic_rules.create(
        lanelet2.traffic_rules.Locations.Germany, lanelet2.traffic_rules.Participants.Vehicle
    )
    graph = lanelet2.routing.RoutingGraph(loaded, rules)
    assert list(graph.checkValidity()) == []
    lanelets = sorted(loaded.laneletLayer, key=lambda lanelet: lanelet.id)
    assert len(lanelets) == 40
    lengths = [np.linalg.norm(np.diff(xyz(lanelet.centerline), axis=0), axis=1).sum() for lanelet in lanelets]
    assert min(lengths) >= 1
    assert max(lengths) <= 50
    assert sum(lengths) == pytest.approx(2 * 785, abs=6)
    assert [len(graph.following(lanelet)) for lanelet in lanelets] == [*[1] * 19, 0, *[1] * 19, 0]
    # the line between the lanes is one: 20 pieces of each of three lines, and the stop line
    assert len([w for w in loaded.lineStringLayer if w.attributes["type"] != "pose_marker"]) == 61
    assert all(rules.canPass(lanelet) for lanelet in lanelets)
    assert rules.speedLimit(lanelets[0]).speedLimit == pytest.approx(90)
    assert lanelets[0].attributes["location"] == "nonurban"


def test_lanes_of_one_direction_may_be_changed_over_dashed_lines_only(tmp_path: Path) -> None:
    right = straight(200, styles=(BoundaryStyle.DASHED, BoundaryStyle.SOLID))
    lon, lat = right.position_at(right.chainage_m, right.width_m)
    left = replace(
        right, name="2", lon_deg=lon, lat_deg=lat, left_style=BoundaryStyle.NONE, right_style=BoundaryStyle.DASHED
    )
    loaded = load(tmp_path, write_lanelet2(HdMap("lanes", (right, left), ())))
    rules = lanelet2.traffic_rules.create(
        lanelet2.traffic_rules.Locations.Germany, lanelet2.traffic_rules.Participants.Vehicle
    )
    graph = lanelet2.routing.RoutingGraph(loaded, rules)
    assert list(graph.checkValidity()) == []
    lanelets = sorted(loaded.laneletLayer, key=lambda lanelet: lanelet.id)
    first, beside = (next(x for x in lanelets if x.attributes["lane"] == name) for name in ("1", "2"))
    assert graph.left(first).id == beside.id
    assert graph.right(beside).id == first.id
    assert graph.left(beside) is None
    assert {w.attributes["type"] for w in loaded.lineStringLayer} == {"line_thin", "virtual"}


def test_boundaries_follow_the_lane(content: HdMap, loaded: lanelet2.core.LaneletMap) -> None:
    lane = content.lanes[0]
    lon, lat = lane.position_at(lane.chainage_m, 1.75)
    points = [PROJECTOR.forward(GPSPoint(y, x, 0.0)) for x, y in zip(lon, lat, strict=True)]
    truth = np.array([(p.x, p.y) for p in points])
    lanelets = sorted(loaded.laneletLayer, key=lambda lanelet: lanelet.id)
    pieces = [xyz(lanelet.leftBound)[:, :2] for lanelet in lanelets if lanelet.attributes["lane"] == "1"]
    line = np.concatenate(pieces)
    start, step = line[:-1], np.diff(line, axis=0)
    long = np.einsum("ij,ij->i", step, step) > 1e-6
    start, step = start[long], step[long]
    share = np.einsum("kij,ij->ki", truth[:, None] - start, step) / np.einsum("ij,ij->i", step, step)
    foot = start + np.clip(share, 0, 1)[..., None] * step
    away = np.linalg.norm(truth[:, None] - foot, axis=2).min(axis=1)
    assert away.max() < 0.006
    assert len(line) < len(truth) / 3


def test_a_stop_line_is_a_regulatory_element_across_its_lane(loaded: lanelet2.core.LaneletMap) -> None:
    (rule,) = loaded.regulatoryElementLayer
    assert isinstance(rule, lanelet2.core.TrafficSign)
    (line,) = rule.refLines()
    assert line.attributes["type"] == "stop_line"
    owner = [lanelet for lanelet in loaded.laneletLayer if list(lanelet.regulatoryElements)]
    assert len(owner) == 1
    ends = xyz(line)
    assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(3.5, rel=1e-3)
    middle = lanelet2.core.BasicPoint2d(*ends.mean(axis=0)[:2])
    assert lanelet2.geometry.inside(owner[0], middle)


def test_markers_of_a_registry_need_no_lanes(tmp_path: Path) -> None:
    lon, lat = START_DEG
    sign = MapMarker("m-1", "fiducial", "aruco-4x4-17", lon, lat, 102.0, 90.0, "upright", 0.4, upright=True)
    magnet = MapMarker("m\x002", "magnet", 'N_90 "<&>"', lon, lat + 1e-5)
    loaded = load(tmp_path, write_lanelet2(HdMap("registry", (), (sign, magnet))))
    (landmark,) = [*loaded.lineStringLayer, *loaded.polygonLayer]
    corners = xyz(landmark)
    x, y = corners[1] - corners[0], corners[2] - corners[1]
    # traffic drives east and sees the face: its right is south, its normal points back to the west
    assert x[1] == pytest.approx(-0.4, rel=1e-3)
    assert y == pytest.approx([0, 0, 0.4], abs=1e-6)
    assert np.cross(x, y)[0] < 0
    (dot,) = [p for p in loaded.pointLayer if "waymark_id" in p.attributes]
    assert dot.attributes["waymark_id"] == "m?2"
    assert dot.attributes["marker_id"] == 'N_90 "<&>"'
    assert dot.attributes["height"] == "unknown"
    assert np.linalg.norm(xyz([dot])[0] - place_of(magnet)) < 1e-3


def test_a_lane_in_a_town_without_heights_or_stations(tmp_path: Path) -> None:
    lane = straight(120)
    lane = replace(lane, height_m=np.full(121, np.nan), station_m=np.zeros(121))
    loaded = load(tmp_path, write_lanelet2(HdMap("town", (lane,), (), urban=True)))
    assert len(list(loaded.laneletLayer)) == 3
    assert {lanelet.attributes["location"] for lanelet in loaded.laneletLayer} == {"urban"}
    assert {point.z for point in loaded.pointLayer} == {0.0}


def test_lanelets_whose_speed_is_unknown_have_no_limit(tmp_path: Path) -> None:
    lane = straight(120)
    lane = replace(lane, design_speed_m_s=np.where(lane.chainage_m < 50, 25.0, np.nan))
    loaded = load(tmp_path, write_lanelet2(HdMap("speeds", (lane,), ())))
    tags = [lanelet.attributes for lanelet in loaded.laneletLayer]
    assert [found["speed_limit"] for found in tags if "speed_limit" in found] == ["90"]
    assert len(tags) == 3


def test_our_own_reader_gets_the_lane_and_its_stop_line_back(content: HdMap) -> None:
    declaration = AlignmentDeclaration(vertical_datum="ellipsoid")
    read = build_alignment(read_alignment(write_lanelet2(content), "map.osm"), declaration=declaration)
    assert len(read.lanes) == 2
    lane, again = content.lanes[0], read.lanes[0]
    assert again.length_m == pytest.approx(lane.length_m, abs=0.01)
    lon, lat = again.position_at(lane.chainage_m)
    assert GEOD.inv(lon, lat, lane.lon_deg, lane.lat_deg)[2].max() < 0.01
    assert np.abs(again.value_at(again.height_m, lane.chainage_m) - lane.height_m).max() < 0.01
    assert again.width_m == pytest.approx(3.5, abs=0.002)
    assert (again.left_style, again.right_style) == (BoundaryStyle.DASHED, BoundaryStyle.SOLID)
    (stop,) = [event for event in read.events if event.kind is EventKind.STOP_LINE]
    assert (stop.lane, stop.chainage_m) == (again.name, pytest.approx(700, abs=0.01))
