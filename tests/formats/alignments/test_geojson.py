"""GeoJSON becomes lanes, events and areas by its properties."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import orjson
import pytest

from app.errors import InvalidParameter, ReferenceSystemError, UnreadableUpload, WaymarkError
from app.formats.alignments.geometry import AlignmentFile, BoundaryStyle, EventKind
from app.formats.alignments.read import read_alignment

LINE = [[8.4, 49.0], [8.401, 49.0], [8.402, 49.0]]


def _feature(coordinates: Any, shape: str = "LineString", /, **properties: Any) -> dict[str, Any]:
    geometry = {"type": shape, "coordinates": coordinates}
    return {"type": "Feature", "properties": properties, "geometry": geometry}


def _read(*features: Any, **document: Any) -> AlignmentFile:
    return read_alignment(orjson.dumps({"type": "FeatureCollection", "features": list(features)} | document))


def test_a_file_with_one_unnamed_line_is_one_lane() -> None:
    file = _read(_feature(LINE))
    assert file.format == "geojson"
    (lane,) = file.lanes
    assert lane.name == "1"
    assert lane.centre is not None
    assert lane.centre[:, :2].tolist() == LINE
    assert np.isnan(lane.centre[:, 2]).all()
    assert (lane.speed_limit_m_s, lane.width_m, lane.road, file.crs) == (None, None, None, None)
    assert lane.left_style is BoundaryStyle.UNKNOWN


def test_a_bare_geometry_and_a_bare_feature_are_roads() -> None:
    for document in (_feature(LINE), {"type": "LineString", "coordinates": LINE}):
        assert len(read_alignment(orjson.dumps(document)).lanes) == 1


def test_properties_of_a_lane() -> None:
    file = _read(
        _feature(LINE, lane="A", width_m=3.2, speed_limit_kmh=80, left_style="Solid", right_style="broken", road="B10"),
        _feature([[8.4, 49.1], [8.41, 49.1, 112.0]], lane=2, maxspeed="30 mph"),
    )
    first, second = file.lanes
    assert (first.name, first.road, second.name) == ("A", "B10", "2")
    assert first.width_m is not None
    assert first.width_m.tolist() == [3.2] * 3
    assert first.speed_limit_m_s == pytest.approx(np.full(3, 80 / 3.6))
    assert (first.left_style, first.right_style) == (BoundaryStyle.SOLID, BoundaryStyle.DASHED)
    assert second.speed_limit_m_s == pytest.approx(np.full(2, 30 * 0.44704))
    assert second.centre is not None
    assert np.isnan(second.centre[0, 2])
    assert second.centre[1, 2] == 112.0


@pytest.mark.parametrize(
    ("properties", "speed_kmh"),
    [
        ({"speed_limit_mph": 30}, 48.28032),
        ({"maxspeed": "50"}, 50),
        ({"maxspeed": "70 km/h"}, 70),
        ({"maxspeed": 100}, 100),
        ({"maxspeed": "DE:urban"}, None),
        ({"maxspeed": "none"}, None),
        ({"speed_limit_kmh": None}, None),
    ],
)
def test_speeds(properties: dict[str, Any], speed_kmh: float | None) -> None:
    speed = _read(_feature(LINE, **properties)).lanes[0].speed_limit_m_s
    if speed_kmh is None:
        assert speed is None
    else:
        assert speed == pytest.approx(np.full(3, speed_kmh / 3.6))


def test_properties_of_the_collection_hold_for_all_features() -> None:
    shared = {"speed_limit_mph": 25, "lane_width_m": 3.3, "crs": "EPSG:4326", "name": "route"}
    file = _read(_feature(LINE), _feature(LINE[::-1], speed_limit_kmh=30, lane="b"), properties=shared)
    assert file.crs == "EPSG:4326"
    assert [lane.road for lane in file.lanes] == ["route", "route"]
    assert file.lanes[0].width_m == pytest.approx(np.full(3, 3.3))
    speeds = [lane.speed_limit_m_s[0] for lane in file.lanes if lane.speed_limit_m_s is not None]
    assert speeds == pytest.approx([25 * 0.44704, 30 / 3.6])


@pytest.mark.parametrize(("left", "right"), [("L", "R"), ("left", "right"), ("LEFT", "r")])
def test_boundaries_are_one_lane(left: str, right: str) -> None:
    lower = [[x, y - 0.00003] for x, y in LINE[:2]]
    file = _read(_feature(LINE, side=left, style="dashed"), _feature(lower, side=right), properties={"maxspeed": 50})
    (lane,) = file.lanes
    assert lane.centre is None
    assert lane.left is not None
    assert lane.right is not None
    assert (len(lane.left), len(lane.right)) == (3, 2)
    assert lane.left_style is BoundaryStyle.DASHED
    assert lane.speed_limit_m_s is not None
    assert len(lane.speed_limit_m_s) == 3


def test_lanes_of_two_roads_may_have_the_same_number() -> None:
    file = _read(*(_feature(LINE, lane=1, road=road) for road in ("A 5", "A 8")))
    assert [lane.name for lane in file.lanes] == ["A 5/1", "A 8/1"]


def test_unnamed_lines_are_lanes_of_their_own() -> None:
    file = _read(_feature(LINE), _feature(LINE[::-1]), _feature(LINE, name="Hauptstrasse"))
    assert [lane.name for lane in file.lanes] == ["1", "2", "Hauptstrasse"]


def test_parts_are_joined_where_they_meet_in_any_order() -> None:
    file = _read(_feature([[[8.402, 49.0], [8.403, 49.0]], LINE[:2], LINE[1:]], "MultiLineString"))
    assert file.lanes[0].centre is not None
    assert file.lanes[0].centre[:, 0].tolist() == [8.4, 8.401, 8.402, 8.403]


def test_features_of_one_lane_are_joined_with_their_values() -> None:
    file = _read(_feature(LINE[1:], lane="a", maxspeed=30), _feature(LINE[:2], lane="a", maxspeed=50))
    (lane,) = file.lanes
    assert lane.speed_limit_m_s == pytest.approx(np.array([50, 50, 30]) / 3.6)


def test_parts_across_the_antimeridian_are_joined() -> None:
    """RFC 7946, section 3.1.9: such lines are cut in two."""
    file = _read(_feature([[[179.9, -17], [180.0, -17]], [[-180.0, -17], [-179.9, -17]]], "MultiLineString"))
    assert file.lanes[0].centre is not None
    assert file.lanes[0].centre[:, 0].tolist() == [179.9, 180.0, -179.9]


@pytest.mark.parametrize("parts", [[LINE[:2], [[8.40101, 49.0], [8.402, 49.0]]], [LINE[:2], LINE[:0:-1]]])
def test_gaps_and_opposite_directions_are_refused_with_their_place(parts: Any) -> None:
    with pytest.raises(
        InvalidParameter, match=r"feature 1: the parts of lane 1 do not join: .* m from .* at 8.4"
    ) as no:
        _read(_feature(parts, "MultiLineString"))
    assert no.value.cure


def test_direction_of_travel() -> None:
    forward, backward, both = (_read(_feature(LINE, oneway=value, speed_limit_kmh=50)) for value in ("yes", "-1", "no"))
    assert backward.lanes[0].centre is not None
    assert backward.lanes[0].centre[:, :2].tolist() == LINE[::-1]
    assert forward.warnings == ()
    assert "both directions" in both.warnings[0]


def test_events() -> None:
    file = _read(
        _feature(LINE, lane="a"),
        _feature([8.401, 49.0], "Point", kind="stop_line", lane="a"),
        _feature([8.401, 49.0], "Point", kind="Stop Line"),
        _feature([8.401, 49.0], "Point", kind="speed limit", value=70),
        _feature([8.401, 49.0], "Point", kind="speed_limit", speed_limit_mph=30),
        _feature([8.401, 49.0], "Point", kind="arrow", value="LEFT"),
        _feature([[8.401, 48.9], [8.401, 49.1]], kind="stop_line"),
        _feature([8.401, 49.0], "Point"),
    )
    kinds = [event.kind for event in file.events]
    assert kinds == [*[EventKind.STOP_LINE] * 2, *[EventKind.SPEED_LIMIT] * 2, EventKind.ARROW, EventKind.STOP_LINE]
    assert [event.lane for event in file.events[:2]] == ["a", None]
    assert file.events[2].value == 70
    assert file.events[3].value == pytest.approx(48.28032)
    assert file.events[4].value == "left"
    assert file.events[5].point == pytest.approx((8.401, 49.0))
    assert file.warnings == ("feature 8 is left out: it states no kind",)
    assert len(file.lanes) == 1


def test_areas() -> None:
    ring = [[8.4, 49.0], [8.4001, 49.0], [8.4001, 49.0001], [8.4, 49.0]]
    file = _read(
        _feature(LINE),
        _feature([ring], "Polygon", kind="bridge"),
        _feature([[ring], [ring]], "MultiPolygon", kind="manholes"),
        _feature([ring], "Polygon", kind="tram tracks"),
        _feature([[8.4005, 48.9999], [8.4005, 49.0001]], kind="joint"),
        _feature([8.4005, 49.0], "Point", kind="crossings"),
        _feature([ring], "Polygon", kind="crossing"),
    )
    assert [area.kind for area in file.areas] == [
        "bridges", "manholes", "manholes", "tram_tracks", "joints", "crossings",
    ]  # fmt: skip
    assert file.areas[0].ring.tolist() == ring
    joint = file.areas[4].ring
    assert np.ptp(joint[:, 0]) == pytest.approx(0.01 / 111_195, rel=0.01)
    assert [event.kind for event in file.events] == [EventKind.CROSSING]


@pytest.mark.parametrize(
    ("feature", "message"),
    [
        (_feature(LINE, side="M"), "feature 1: side is 'M'"),
        (_feature(LINE, side="L"), "feature 1: lane 1 has a left boundary and no right one"),
        (_feature(LINE, kind="kerb"), "feature 1: kind is 'kerb'"),
        (_feature(LINE, speed_limit_kmh=900), "feature 1: speed_limit_kmh is 900"),
        (_feature(LINE, speed_limit_kmh=0), "feature 1: speed_limit_kmh is 0"),
        (_feature(LINE, speed_limit_kmh="fast"), "feature 1: speed_limit_kmh is 'fast'"),
        (_feature(LINE, width_m="wide"), "feature 1: width_m is 'wide'"),
        (_feature([[8.4, 49.0], ["8.5", 49.0]]), "feature 1: the coordinates are not pairs of numbers"),
        (_feature([[8.4, 49.0], [None, 49.0]]), "feature 1: the coordinates are not pairs of numbers"),
        (_feature([[8.4, 49.0], [8.5]]), "feature 1"),
        (_feature([[8.4, 49.0], [1e999, 49.0]]), "feature 1"),
        (_feature([]), "feature 1"),
        (_feature([8.4, 49.0], "Point", kind="manhole"), "feature 1: the manholes are a point"),
        (_feature([8.4, 49.0], "Point", kind="gantry"), "feature 1: kind is 'gantry'"),
        (_feature([8.4, 49.0], "Point", kind="speed_limit"), "feature 1: the speed limit is None"),
        (_feature([[[8.4, 49.0], [8.5, 49.0]]], "Polygon", kind="bridge"), "feature 1: the area has fewer"),
    ],
)
def test_unusable_features_are_named(feature: Any, message: str) -> None:
    with pytest.raises(InvalidParameter, match=message) as refused:
        _read(feature)
    assert refused.value.cure


@pytest.mark.parametrize(
    "data",
    [
        b"{",
        b"{}",
        b'{"type": "FeatureCollection", "features": 3}',
        b'{"type": "FeatureCollection", "features": [3]}',
        b'{"type": "FeatureCollection", "features": []}',
        b'{"type": "Feature", "geometry": {"type": "Circle", "coordinates": []}}',
        b'{"type": "LineString", "coordinates": [[NaN, 1], [2, 3]]}',
        b'{"type": "Feature", "properties": {}, "geometry": null}',
    ],
)
def test_what_is_no_geojson_with_lanes_is_unreadable(data: bytes) -> None:
    with pytest.raises(UnreadableUpload):
        read_alignment(data)


def test_mixed_reference_systems_are_refused() -> None:
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}
    assert _read(_feature(LINE), crs=crs).crs == "urn:ogc:def:crs:EPSG::25832"
    with pytest.raises(ReferenceSystemError, match="mixes the CRSs EPSG:4326, urn:ogc:def:crs:EPSG::25832"):
        _read(_feature(LINE), _feature(LINE) | {"crs": crs}, properties={"crs": "EPSG:4326"})


def test_damaged_files_raise_nothing_else() -> None:
    good = orjson.dumps({"type": "FeatureCollection", "features": [
        _feature(LINE, lane="a", side="L"), _feature(LINE, lane="a", side="R"),
        _feature([8.4, 49], "Point", kind="arrow"),
        _feature([[LINE[0], LINE[1], [8.4, 49.1], LINE[0]]], "Polygon", kind="joint"),
    ]})  # fmt: skip
    rng = np.random.default_rng(3)
    read = 0
    for _ in range(800):
        data = bytearray(good)
        for at in rng.integers(0, len(data), rng.integers(1, 4)):
            data[at] = rng.choice(np.frombuffer(b'0123456789-.e[]{}",:abnulRL', dtype=np.uint8))
        try:
            read_alignment(bytes(data))
            read += 1
        except WaymarkError:
            continue
    assert read > 50


def test_formats_are_detected_and_declared() -> None:
    data = orjson.dumps(_feature(LINE))
    assert read_alignment(data, "road.json", format="geojson").format == "geojson"
    with pytest.raises(InvalidParameter, match="no format 'ifc'"):
        read_alignment(data, format="ifc")
    with pytest.raises(UnreadableUpload, match="no format that roads are read in") as refused:
        read_alignment(b"what is this", "notes.txt")
    assert "GeoPackage" in str(refused.value.limit)


def test_a_route_of_a_published_map() -> None:
    path = Path(__file__).parents[2] / "data" / "alignments" / "karlsruhe_moderate_1.geojson"
    file = read_alignment(path.read_bytes(), path.name)
    (lane,) = file.lanes
    assert lane.road == "karlsruhe_moderate_1"
    assert lane.left is not None
    assert lane.left[:, 0].mean() == pytest.approx(8.416, abs=0.005)
    assert lane.speed_limit_m_s is not None
    assert lane.speed_limit_m_s[0] == pytest.approx(30 * 0.44704)
    assert lane.width_m is None
    assert file.crs == "EPSG:4326"
    assert not math.isnan(lane.left[0, 0])


def test_a_style_that_is_none_is_refused() -> None:
    with pytest.raises(InvalidParameter) as refused:
        _read(_feature(LINE, lane="A", width_m=3.2, left_style="zigzag"))
    assert refused.value.field == "properties.left_style"
    assert _read(_feature(LINE, lane="A", width_m=3.2, style="blue")).lanes[0].left_style is BoundaryStyle.UNKNOWN
