"""OpenDRIVE: geometry against pyxodr's points and against quadrature, lanes, events, reference systems."""

from __future__ import annotations

import json
import math
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from scipy.special import fresnel

from app.formats.alignments.geometry import AlignmentFile, BoundaryStyle, EventKind, LaneGeometry
from app.formats.alignments.opendrive import read_opendrive
from app.formats.alignments.opendrive.road import parse_road
from app.formats.alignments.read import read_alignment
from app.formats.xml_tree import parse_xml
from app.values import Floats
from tests.formats.alignments.xodr import LANE, LEFT, RIGHT, document, road, section

DATA = Path(__file__).resolve().parents[2] / "data" / "opendrive"
FILES = ("curves_elevation", "e6mini", "fabriksgatan", "jolengatan", "two_plus_one")
UTM = "+proj=utm +zone=32 +datum=WGS84 +units=m +no_defs"


@lru_cache
def example(name: str) -> AlignmentFile:
    return read_opendrive((DATA / f"{name}.xodr").read_bytes())


def lanes(file: AlignmentFile) -> dict[str, LaneGeometry]:
    return {lane.name: lane for lane in file.lanes}


def centre(lane: LaneGeometry) -> Floats:
    assert lane.centre is not None
    return lane.centre


def values(array: Floats | None) -> Floats:
    assert array is not None
    return array


def nearest(points: Floats, line: Floats) -> tuple[Floats, Floats]:
    """Distance of points from a polyline in the plane, and the height of its nearest places."""
    a, b = line[:-1], line[1:]
    length = np.hypot(*(b - a)[:, :2].T)
    a, b = a[length > 0], b[length > 0]
    along = ((points[:, None, :2] - a[:, :2]) * (b - a)[:, :2]).sum(-1) / ((b - a)[:, :2] ** 2).sum(-1)
    place = a + np.clip(along, 0, 1)[..., None] * (b - a)
    distance = np.hypot(*np.moveaxis(points[:, None, :2] - place[..., :2], 2, 0))
    best = distance.argmin(axis=1)
    return distance.min(axis=1), place[np.arange(len(points)), best, 2]


@pytest.mark.parametrize("name", FILES)
def test_lanes_are_where_pyxodr_computes_them(name: str) -> None:
    rows = json.loads((DATA / "pyxodr.json").read_text())[name]
    compared = 0
    for row in rows:
        points = np.array(row["xyz_m"])
        of_road = [lane for lane in example(name).lanes if f"road {row['road']} " in lane.name]
        found = [nearest(points, centre(lane)) for lane in of_road]
        if name == "two_plus_one":  # where a lane begins or ends, its first metres are narrower than 5 cm
            narrow = row["section"] in (1, 3) and row["lane"] in (1, -1)
            off = np.minimum.reduce([distance for distance, _ in found])
            used = np.hypot(*(points - points[0])[:, :2].T) > 4 if narrow else np.ones(len(points), bool)
            used &= np.hypot(*(points - points[-1])[:, :2].T) > 4 if narrow else used
            assert off[used].max() < 0.006
        else:
            off, height = min(found, key=lambda pair: float(pair[0].max()))
            lane = of_road[[pair[0] is off for pair in found].index(True)]
            assert lane.name.endswith(f"road {row['road']} lane {row['lane']}")
            assert off.max() < 0.006
            assert np.hypot(*(points[0] - centre(lane)[0])[:2]) < 0.1, "the direction of travel differs"
            if np.isfinite(height).all():
                assert np.abs(height - points[:, 2]).max() < 0.006
        compared += len(points)
    assert compared > 40


@pytest.mark.parametrize("name", FILES)
def test_geometries_meet(name: str) -> None:
    root = parse_xml((DATA / f"{name}.xodr").read_bytes(), "OpenDRIVE")
    for element in root.iterfind("road"):
        curve = parse_road(element).curve
        ends = curve.evaluate(curve.s + curve.length, np.arange(len(curve.s)))
        assert np.hypot(ends.x[:-1] - curve.x[1:], ends.y[:-1] - curve.y[1:]).max(initial=0.0) < 50e-6
        turn = (ends.hdg[:-1] - curve.hdg[1:] + np.pi) % (2 * np.pi) - np.pi
        assert np.abs(turn).max(initial=0.0) < 1e-3


def test_lanes_of_a_junction_begin_and_end_where_the_linked_lanes_do() -> None:
    found = lanes(example("fabriksgatan"))
    assert sum(name.startswith("junction 4 road ") for name in found) == 12
    # connection 0: road 0 lane 1 leads to road 8 lane -1; that one leads to road 1 lane -1
    connecting = centre(found["junction 4 road 8 lane -1"])
    assert np.abs(centre(found["road 0 lane 1"])[-1, :2] - connecting[0, :2]).max() < 1e-3
    assert np.abs(connecting[-1, :2] - centre(found["road 1 lane -1"])[0, :2]).max() < 1e-3
    ends = [(event.kind, event.lane) for event in example("fabriksgatan").events]
    assert (EventKind.JUNCTION, "road 0 lane 1") in ends
    assert (EventKind.JUNCTION, "road 2 lane -1") in ends
    assert not any(lane == "road 0 lane -1" for _, lane in ends)


def arc_file(k: float, length: float = 60.0) -> bytes:
    plan = f'<geometry s="0" x="0" y="0" hdg="0" length="{length}"><arc curvature="{k}"/></geometry>'
    return document(road(plan, length=length))


@pytest.mark.parametrize("k", [1 / 500, 1 / 50, -1 / 12])
def test_chords_stay_within_a_millimetre_with_few_vertices(k: float) -> None:
    for lane in read_opendrive(arc_file(k)).lanes:
        radius = abs(1 / k) + (1.75 if ("lane -1" in lane.name) == (k > 0) else -1.75)
        line = centre(lane)[:, :2]
        about = np.array([0.0, 1 / k])
        assert np.abs(np.hypot(*(line - about).T) - radius).max() < 1e-9
        chords = np.hypot(*np.diff(line, axis=0).T)
        sagitta = chords**2 / (8 * radius)
        assert sagitta.max() <= 1.001e-3
        assert chords.max() <= 2.0 * radius * abs(k) + 1e-9
        needed = 60.0 * max(1 / 2.0, math.sqrt((abs(1 / k) + 1.75) / (0.008 * (1 / k) ** 2)))
        assert len(line) <= needed + 2
        left = 1.0 if "lane -1" in lane.name else -1.0
        np.testing.assert_allclose(values(lane.curvature_per_m), left * math.copysign(1 / radius, k), rtol=1e-9)


@pytest.mark.parametrize(("k0", "k1"), [(0.0, 0.02), (0.02, 0.0), (-0.01, 0.03), (0.01, -0.03), (0.004, 0.0040000001)])
def test_spirals_are_clothoids(k0: float, k1: float) -> None:
    length, hdg = 80.0, 0.3
    spiral = f'<spiral curvStart="{k0}" curvEnd="{k1}"/>'
    plan = f'<geometry s="0" x="5" y="-2" hdg="{hdg}" length="{length}">{spiral}</geometry>'
    file = read_opendrive(document(road(plan, length=length, lanes=section(left="") + laneoffset(1.75))))
    lane = file.lanes[0]
    s, rate = values(lane.station_m), (k1 - k0) / length
    # planning.md, section 2: the standard clothoid with a = sqrt(|rate| / pi), shifted by s0 = k0 / rate
    a, s0 = math.sqrt(abs(rate) / math.pi), k0 / rate
    v, u = fresnel(a * (s + s0))
    v0, u0 = fresnel(a * s0)
    sign = math.copysign(1.0, rate)
    x, y = (u - u0) / a, sign * (v - v0) / a
    turn = hdg - rate * s0**2 / 2
    expected = np.stack([5 + x * np.cos(turn) - y * np.sin(turn), -2 + x * np.sin(turn) + y * np.cos(turn)], axis=1)
    assert np.abs(centre(lane)[:, :2] - expected).max() < (1e-8 if abs(rate) > 1e-6 else 1e-4)
    np.testing.assert_allclose(values(lane.curvature_per_m), k0 + rate * s, atol=1e-12)


def laneoffset(a: float) -> str:
    return f'<laneOffset s="0" a="{a}" b="0" c="0" d="0"/>'


@pytest.mark.parametrize("p_range", ['pRange="normalized"', "", 'pRange="arcLength"'])
def test_parametric_cubics(p_range: str) -> None:
    u, v = np.array([0.0, 38.0, 3.0, -1.0]), np.array([0.0, 0.0, 12.0, -5.0])
    p = np.linspace(0.0, 1.0, 20001)
    x, y = (c[1] * p + c[2] * p**2 + c[3] * p**3 for c in (u, v))
    length = float(np.hypot(np.diff(x), np.diff(y)).sum())
    scale = length ** -np.arange(4.0) if "arc" in p_range else np.ones(4)
    names = [f"{k}{axis}" for axis in "UV" for k in "abcd"]
    text = " ".join(f'{n}="{c!r}"' for n, c in zip(names, [*(u * scale).tolist(), *(v * scale).tolist()], strict=True))
    plan = f'<geometry s="0" x="0" y="0" hdg="0" length="{length}"><paramPoly3 {text} {p_range}/></geometry>'
    file = read_opendrive(document(road(plan, length=length, lanes=laneoffset(1.75) + section(left=""))))
    lane = file.lanes[0]
    assert file.warnings == ()
    distance = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    at = values(lane.station_m)
    expected = np.stack([np.interp(at, distance, x), np.interp(at, distance, y)], axis=1)
    assert np.abs(centre(lane)[:, :2] - expected).max() < 1e-5, "stations are distances along the curve"
    heading = np.unwrap(np.arctan2(np.diff(y), np.diff(x)))
    middle = (distance[1:] + distance[:-1]) / 2
    numeric = np.interp(at[1:-1], (middle[1:] + middle[:-1]) / 2, np.diff(heading) / np.diff(middle))
    np.testing.assert_allclose(values(lane.curvature_per_m)[1:-1], numeric, atol=1e-6)


def test_poly3_ends_at_its_length_along_the_curve() -> None:
    c, d, length = 4e-3, -2e-5, 100.0
    plan = f'<geometry s="0" x="0" y="0" hdg="0" length="{length}"><poly3 a="0" b="0" c="{c}" d="{d}"/></geometry>'
    file = read_opendrive(document(road(plan, lanes=laneoffset(1.75) + section(left=""))))
    line = centre(file.lanes[0])
    assert np.abs(line[:, 1] - (c * line[:, 0] ** 2 + d * line[:, 0] ** 3)).max() < 1e-9
    x = np.linspace(0.0, line[-1, 0], 100_001)
    assert np.hypot(1.0, 2 * c * x + 3 * d * x * x).mean() * line[-1, 0] == pytest.approx(length, abs=1e-4)


def test_curvature_of_lanes_that_shift_sideways() -> None:
    """The formula of the offset curve agrees with the circle through three neighbouring vertices."""
    wide = LANE.format(-1, "").replace('a="3.5" b="0" c="0" d="0"', 'a="3" b="0.4" c="0.006" d="-0.00008"')
    plan = '<geometry s="0" x="0" y="0" hdg="1" length="50"><spiral curvStart="0.01" curvEnd="-0.02"/></geometry>'
    lane = lanes(read_opendrive(document(road(plan, length=50.0, lanes=section(right=wide)))))["road 7 lane -1"]
    a, b, c = (centre(lane)[i : len(centre(lane)) - 2 + i, :2] for i in range(3))
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    sides = [np.hypot(*(q - p).T) for p, q in ((a, b), (b, c), (a, c))]
    numeric = 2.0 * area / (sides[0] * sides[1] * sides[2])
    np.testing.assert_allclose(values(lane.curvature_per_m)[1:-1], numeric, atol=2e-4)
    np.testing.assert_allclose(
        values(lane.width_m)[[0, -1]], [3.0, 3.0 + 0.4 * 50 + 0.006 * 2500 - 0.00008 * 125000], atol=1e-9
    )


def test_curvature_jumps_between_two_vertices_at_one_place() -> None:
    plan = (
        '<geometry s="0" x="0" y="0" hdg="0" length="20"><line/></geometry>'
        '<geometry s="20" x="20" y="0" hdg="0" length="20"><arc curvature="0.01"/></geometry>'
    )
    lane = lanes(read_opendrive(document(road(plan, length=40.0))))["road 7 lane 1"]
    twice = np.flatnonzero(np.all(np.diff(centre(lane)[:, :2], axis=0) == 0.0, axis=1))
    assert len(twice) == 1
    radius = 100.0 - 1.75
    np.testing.assert_allclose(values(lane.curvature_per_m)[[twice[0], twice[0] + 1]], [-1 / radius, 0.0], atol=1e-12)


@pytest.mark.parametrize(("rule", "east"), [("", "-1"), ('rule="RHT"', "-1"), ('rule="LHT"', "1")])
def test_direction_of_travel(rule: str, east: str) -> None:
    mark = '<roadMark sOffset="0" type="solid"/>'
    painted = section(left=LANE.format(1, mark), right=LANE.format(-1, mark), centre='<roadMark type="broken"/>')
    file = read_opendrive(document(road(lanes=painted, attributes=f'id="7" {rule}')))
    for lane in file.lanes:
        eastwards = lane.name == f"road 7 lane {east}"
        assert (centre(lane)[-1, 0] > centre(lane)[0, 0]) == eastwards
        assert (values(lane.station_m)[-1] > 50.0) == eastwards
        styles = (BoundaryStyle.DASHED, BoundaryStyle.SOLID)
        assert (lane.left_style, lane.right_style) == (styles if "LHT" not in rule else styles[::-1])


@pytest.mark.parametrize(
    ("mark", "left_lane", "right_lane"),
    [
        ("solid broken", BoundaryStyle.SOLID, BoundaryStyle.DASHED),
        ("broken solid", BoundaryStyle.DASHED, BoundaryStyle.SOLID),
        ("solid solid", BoundaryStyle.SOLID, BoundaryStyle.SOLID),
        ("botts dots", BoundaryStyle.DASHED, BoundaryStyle.DASHED),
        ("none", BoundaryStyle.NONE, BoundaryStyle.NONE),
        ("curb", BoundaryStyle.UNKNOWN, BoundaryStyle.UNKNOWN),
    ],
)
def test_of_a_double_line_the_near_one_counts(mark: str, left_lane: BoundaryStyle, right_lane: BoundaryStyle) -> None:
    found = lanes(read_opendrive(document(road(lanes=section(centre=f'<roadMark sOffset="0" type="{mark}"/>')))))
    assert found["road 7 lane 1"].left_style == left_lane
    assert found["road 7 lane -1"].left_style == right_lane


def test_sections_are_joined_where_linked() -> None:
    found = lanes(example("two_plus_one"))
    through = centre(found["road 1 lane -1"])  # its number is -2 between 125 m and 375 m
    assert through[0, :2] == pytest.approx([0.0, -1.75])
    assert through[-1, :2] == pytest.approx([500.0, -1.75])
    assert np.abs(through[:, 1] + 1.75).max() < 1e-9
    added = found["road 1 lane -1 from s 125"]
    assert values(added.width_m).max() == pytest.approx(3.5)
    assert values(added.width_m).min() >= 0.05
    assert any("from s 125.000 to 127." in warning for warning in example("two_plus_one").warnings)


def test_heights_superelevation_and_offset() -> None:
    profile = (
        '<elevationProfile><elevation s="0" a="10" b="0.02" c="0" d="0"/></elevationProfile>'
        '<lateralProfile><superelevation s="0" a="0.05" b="0" c="0" d="0"/></lateralProfile>'
    )
    header = f'<geoReference>{UTM}</geoReference><offset x="500000" y="5400000" z="100" hdg="{math.pi / 2}"/>'
    file = read_opendrive(document(road(extra=profile), header=header))
    assert file.crs == "EPSG:32632"
    right, left = lanes(file)["road 7 lane -1"], lanes(file)["road 7 lane 1"]
    # turned by 90 degrees: along the road is north, right of it is east
    expected = [500_000 + 1.75 * math.cos(0.05), 5_400_100, 112 - 1.75 * math.sin(0.05)]
    assert centre(right)[-1] == pytest.approx(expected, abs=1e-6)
    assert values(right.superelevation_rad)[0] == pytest.approx(0.05)
    assert values(left.superelevation_rad)[0] == pytest.approx(-0.05)
    assert centre(left)[0, 2] == pytest.approx(112 + 1.75 * math.sin(0.05))
    assert np.isnan(centre(read_opendrive(document()).lanes[0])[:, 2]).all()


def test_speed_limits_of_roads_and_lanes() -> None:
    types = (
        '<type s="0" type="rural"><speed max="70" unit="km/h"/></type>'
        '<type s="40" type="town"><speed max="30" unit="mph"/></type>'
    )
    slow = LANE.format(-1, "").replace("</lane>", '<speed sOffset="60" max="5"/></lane>')
    file = read_opendrive(document(road(extra=types, lanes=section(right=slow))))
    right, left = lanes(file)["road 7 lane -1"], lanes(file)["road 7 lane 1"]
    speed, station = values(right.speed_limit_m_s), values(right.station_m)
    mph = 30 * 0.44704
    np.testing.assert_allclose(speed[station < 39.9], 70 / 3.6)
    np.testing.assert_allclose(speed[(station > 40.1) & (station < 59.9)], mph)
    np.testing.assert_allclose(speed[station > 60.1], 5.0)
    np.testing.assert_allclose(values(left.speed_limit_m_s)[[0, -1]], [mph, 70 / 3.6])
    events = {(event.lane, event.value, round(event.point[0])) for event in file.events}
    assert events == {
        ("road 7 lane -1", 48.3, 40),
        ("road 7 lane -1", 18.0, 60),
        ("road 7 lane 1", 70.0, 40),
    }


def test_signals_and_objects_become_events_and_areas() -> None:
    furniture = (
        '<objects><object id="1" type="crosswalk" s="50" t="0" hdg="0" orientation="none" zOffset="0"><outline>'
        '<cornerLocal u="-2" v="-3.5"/><cornerLocal u="2" v="-3.5"/>'
        '<cornerLocal u="2" v="3.5"/><cornerLocal u="-2" v="3.5"/>'
        '</outline></object><object id="2" type="roadMark" name="StopLine" s="44" t="-1.75" orientation="+"/>'
        '<bridge id="3" s="70" length="10" type="concrete"/></objects><signals>'
        '<signal id="4" s="60" t="4" type="206" country="DE" orientation="-" dynamic="no"/>'
        '<signal id="5" s="20" t="-4" type="274" country="DE" value="50" orientation="+" dynamic="no"/>'
        '<signal id="6" s="90" t="4" type="1000001" orientation="-" dynamic="yes"/></signals>'
    )
    file = read_opendrive(document(road().replace("</road>", furniture + "</road>")))
    found = {(event.kind, event.lane, event.point, event.value) for event in file.events}
    assert found == {
        (EventKind.CROSSING, "road 7 lane -1", (48.0, -1.75), None),
        (EventKind.CROSSING, "road 7 lane 1", (52.0, 1.75), None),
        (EventKind.STOP_LINE, "road 7 lane -1", (44.0, -1.75), None),
        (EventKind.STOP_LINE, "road 7 lane 1", (60.0, 1.75), None),
        (EventKind.SPEED_LIMIT, "road 7 lane -1", (20.0, -1.75), 50.0),
    }
    crossing, bridge = file.areas
    assert (crossing.kind, bridge.kind) == ("crossing", "bridge")
    np.testing.assert_allclose(crossing.ring[:, 0], [48, 52, 52, 48, 48])
    assert (bridge.ring[:, 0].min(), bridge.ring[:, 0].max()) == pytest.approx((70, 80))
    assert (bridge.ring[:, 1].min(), bridge.ring[:, 1].max()) == pytest.approx((-3.5, 3.5))


@pytest.mark.parametrize(
    ("reference", "cure"),
    [
        ("", "states no reference system"),
        ("<geoReference/>", "is empty"),
        ("<geoReference><![CDATA[  ]]></geoReference>", "is empty"),
        ("<geoReference>+lat_0=4.9e1 +lon_0=8.0e0</geoReference>", "--origin 8.0e0,4.9e1"),
        (f"<geoReference>{UTM} +geoidgrids=egm96_15.gtx</geoReference>", "egm96_15.gtx"),
        (f"<geoReference>{UTM}</geoReference>", "are local ones"),
        (f"<geoReference>{UTM} +lat_0=37.3 +lon_0=-122.0</geoReference>", "are local ones"),
        ("<geoReference>+proj=tmerc +lat_0=0 +lon_0=0 +datum=WGS84</geoReference>", "are local ones"),
        ("<geoReference>EPSG:4326</geoReference>", "metres on a plane"),
        ("<geoReference>EPSG:2227</geoReference>", "not in metres"),
        ("<geoReference>+proj=pipeline +step +proj=utm</geoReference>", "refers to a file"),
        ("<geoReference>somewhere</geoReference>", "is not a reference system"),
    ],
)
def test_an_unusable_reference_system_names_the_cure(reference: str, cure: str) -> None:
    file = read_opendrive(document(header=f'{reference}<offset x="100" y="0" z="0" hdg="0"/>'))
    assert file.crs is None
    assert file.crs_problem is not None
    assert cure in file.crs_problem
    assert "origin" in file.crs_problem
    assert centre(lanes(file)["road 7 lane -1"])[0, 0] == pytest.approx(0.0), "local coordinates stay near the origin"
    assert any("offset is not applied" in warning for warning in file.warnings)


@pytest.mark.parametrize("name", FILES)
def test_the_examples_are_not_placed_on_earth(name: str) -> None:
    assert example(name).crs is None
    assert "--origin" in (example(name).crs_problem or "")


def test_a_local_projection_places_a_road() -> None:
    reference = "<geoReference>+proj=tmerc +lat_0=49 +lon_0=8 +k=1 +datum=WGS84 +units=m +no_defs</geoReference>"
    file = read_opendrive(document(header=reference))
    assert file.crs_problem is None
    assert file.crs is not None
    assert file.crs.startswith("PROJCRS")


def test_lane_types_that_are_not_driven_on_are_left_out() -> None:
    right = (
        RIGHT + LANE.format(-2, "").replace("driving", "sidewalk") + LANE.format(-3, "").replace("driving", "onRamp")
    )
    found = lanes(read_opendrive(document(road(lanes=section(right=right)))))
    assert set(found) == {"road 7 lane -1", "road 7 lane 1", "road 7 lane -3"}
    assert centre(found["road 7 lane -3"])[0, 1] == pytest.approx(-8.75)


def test_the_format_is_detected() -> None:
    assert read_alignment((DATA / "e6mini.xodr").read_bytes(), "road.bin").format == "opendrive"
    assert read_alignment(b"\xef\xbb\xbf <!-- made by hand -->" + document()[21:]).format == "opendrive"


def test_names_of_roads_where_unique() -> None:
    two = document(road(attributes='id="1" name="Elm Street"'), road(attributes='id="2"'))
    assert {lane.road for lane in read_opendrive(two).lanes} == {"Elm Street", "road 2"}
    assert len({lane.name for lane in read_opendrive(two).lanes}) == 4
    assert LEFT in two.decode()


# --- records that begin after the start of the road -------------------------------------------------------------------


def test_the_lane_offset_is_zero_before_its_first_record() -> None:
    offset = '<laneOffset s="50" a="0" b="0" c="0.0042" d="-0.000056"/><laneOffset s="100" a="3.5" b="0" c="0" d="0"/>'
    (lane,) = read_alignment(document(road(lanes=offset + section(left=""), length=200.0))).lanes
    xy = centre(lane)[:, :2]
    np.testing.assert_allclose(xy[xy[:, 0] <= 50.0, 1], -1.75, atol=1e-9)
    np.testing.assert_allclose(np.interp([75.0, 100.0, 150.0], *xy.T), [0.0, 1.75, 1.75], atol=1e-3)
    assert np.hypot(*np.diff(xy, axis=0).T).sum() == pytest.approx(200.15, abs=0.02)


def test_the_lane_offset_of_a_bridge_is_zero_before_its_first_record() -> None:
    bridge = '<objects><bridge id="3" s="0" length="30"/></objects>'
    offset = '<laneOffset s="50" a="9" b="-0.3" c="0" d="0"/>'
    file = read_alignment(document(road(lanes=offset + section(), extra=bridge)))
    assert np.abs(file.areas[0].ring[:, 1]).max() == pytest.approx(3.5)


def test_a_lane_without_a_width_is_absent() -> None:
    late = LANE.format(-1, "").replace('sOffset="0" a="3.5" b="0"', 'sOffset="40" a="0" b="0.07"')
    outside = LANE.format(-2, "")
    file = read_alignment(document(road(lanes=section(left="", right=late + outside))))
    inner, outer = (lanes(file)[f"road 7 lane {number}"] for number in (-1, -2))
    assert values(inner.station_m)[0] == pytest.approx(40.0, abs=2.0)
    assert values(inner.width_m).min() >= 0.05
    assert any("road 7 lane -1" in warning and "left out" in warning for warning in file.warnings)
    assert np.interp([0.0, 39.0, 90.0], *centre(outer)[:, :2].T) == pytest.approx([-1.75, -1.75, -5.25], abs=1e-6)


def test_elevation_and_superelevation_are_zero_before_their_first_record() -> None:
    extra = (
        '<elevationProfile><elevation s="60" a="0" b="0.02" c="0" d="0"/></elevationProfile>'
        '<lateralProfile><superelevation s="80" a="0" b="0.001" c="0" d="0"/></lateralProfile>'
    )
    file = read_alignment(document(road(lanes=section(left=""), extra=extra)))
    (lane,) = file.lanes
    s, z, roll = values(lane.station_m), centre(lane)[:, 2], values(lane.superelevation_rad)
    assert np.interp([0.0, 60.0, 80.0], s, z) == pytest.approx([0.0, 0.0, 0.4], abs=1e-9)
    assert np.interp([0.0, 80.0, 100.0], s, roll) == pytest.approx([0.0, 0.0, 0.02], abs=1e-9)
    assert any("no elevation before s 60.000 m" in warning for warning in file.warnings)
    step = document(road(lanes=section(left=""), extra=extra.replace('s="60" a="0"', 's="60" a="120"')))
    assert [round(float(centre(lane)[0, 2])) for lane in read_alignment(step).lanes] == [0, 120], "divided at the step"


def test_a_plan_that_begins_late_has_no_lanes_before() -> None:
    plan = '<geometry s="10" x="0" y="0" hdg="0" length="90"><line/></geometry>'
    file = read_alignment(document(road(plan, lanes=section(left=""))))
    (lane,) = file.lanes
    assert values(lane.station_m)[[0, -1]].tolist() == [10.0, 100.0]
    assert centre(lane)[[0, -1], 0].tolist() == [0.0, 90.0]
    assert any("planView begins at s 10.000 m" in warning for warning in file.warnings)
    sections = read_alignment(document(road(lanes=section(25.0, left=""))))
    assert values(sections.lanes[0].station_m)[0] == 25.0
    assert any("first lane section begins at s 25.000 m" in warning for warning in sections.warnings)


def test_geometries_without_length_are_left_out() -> None:
    shapes = [(0, 0, 50, "<line/>"), (50, 50, 0, "<line/>"), (50, 50, 0, '<arc curvature="0.01"/>')]
    shapes += [(50, 50, 0, '<spiral curvStart="0" curvEnd="0.01"/>'), (50, 50, 50, "<line/>")]
    plan = "".join(
        f'<geometry s="{s}" x="{x}" y="0" hdg="0" length="{length}">{shape}</geometry>'
        for s, x, length, shape in shapes
    )
    file = read_alignment(document(road(plan, lanes=section(left=""))))
    assert np.ptp(centre(file.lanes[0])[:, 0]) == 100.0
    assert file.warnings == ("road 7: geometries of zero length, which are left out: 3.",)


# --- directions and revisions of 1.8 ----------------------------------------------------------------------------------


def _revised(major: str, minor: str, one_road: str) -> AlignmentFile:
    text = document(one_road).decode()
    return read_alignment(text.replace('revMajor="1" revMinor="7"', f'revMajor="{major}" revMinor="{minor}"').encode())


def _directed(number: int, direction: str, inside: str = "") -> str:
    return LANE.format(number, inside).replace('type="driving"', f'type="driving" {direction}')


@pytest.mark.parametrize("rule", ["RHT", "LHT"])
@pytest.mark.parametrize("number", [-2, 2])
def test_reversed_lanes_run_against_their_side(rule: str, number: int) -> None:
    side = 1 if number > 0 else -1
    marks = '<roadMark sOffset="0" type="solid"/>'
    both = LANE.format(side, '<roadMark sOffset="0" type="broken"/>')
    both += _directed(number, 'direction="reversed"', marks)
    found = lanes(
        _revised("1", "8", road(
            lanes=section(left=both, right="") if number > 0 else section(left="", right=both),
            attributes=f'id="7" junction="-1" rule="{rule}"',
        ))
    )  # fmt: skip
    usual, against = (found[f"road 7 lane {n}"] for n in (side, number))
    eastward = (number < 0) == (rule == "RHT")
    assert np.sign(centre(usual)[-1, 0] - centre(usual)[0, 0]) == (1 if eastward else -1)
    assert np.sign(centre(against)[-1, 0] - centre(against)[0, 0]) == (-1 if eastward else 1)
    # The broken line lies between the two lanes: on the left of both vehicles, or on the right of both.
    outer_is_left = (centre(against)[-1, 0] > centre(against)[0, 0]) == (number > 0)
    expected = (BoundaryStyle.SOLID, BoundaryStyle.DASHED)
    assert (against.left_style, against.right_style) == (expected if outer_is_left else expected[::-1])


def test_a_lane_that_changes_its_direction_is_two_lanes() -> None:
    ahead = _directed(-1, 'direction="standard"', '<link><successor id="-1"/></link>')
    back = _directed(-1, 'direction="reversed"', '<link><predecessor id="-1"/></link>')
    found = lanes(_revised("1", "8", road(lanes=section(left="", right=ahead) + section(60, left="", right=back))))
    first, second = found.values()
    assert centre(first)[[0, -1], 0].tolist() == [0.0, 60.0]
    assert centre(second)[[0, -1], 0].tolist() == [100.0, 60.0]


@pytest.mark.parametrize(
    ("direction", "warning"),
    [
        ('direction="both"', "drive on it both ways"),
        ('direction="sideways"', "this direction is not known"),
        ('dynamicLaneDirection="true"', "direction of travel changes"),
        ('dynamicLaneDirection="false" direction="standard"', ""),
    ],
)
def test_other_directions_are_reported(direction: str, warning: str) -> None:
    file = _revised("1", "8", road(lanes=section(left="", right=_directed(-1, direction))))
    assert centre(file.lanes[0])[0, 0] == 0.0
    assert [one for one in file.warnings if "road 7, lane -1 at s 0" in one and warning in one] == list(file.warnings)
    assert len(file.warnings) == bool(warning)


@pytest.mark.parametrize(
    ("major", "minor", "newer"),
    [("1", "4", False), ("1", "8", False), ("1", "9", True), ("2", "0", True), ("1", "x", False), ("", "", False)],
)
def test_newer_revisions_are_reported(major: str, minor: str, newer: bool) -> None:
    file = _revised(major, minor, road())
    assert [f"revision {major}.{minor} of OpenDRIVE" in warning for warning in file.warnings] == [True] * newer


@pytest.mark.parametrize("extra", ['<userData code="a"/>', "<dataQuality/>", '<include file="b.xml"/>'])
def test_additional_data_of_a_geometry_is_skipped(extra: str) -> None:
    plan = f'<geometry s="0" x="0" y="0" hdg="0" length="100"><line/>{extra}</geometry>'
    assert len(read_alignment(document(road(plan))).lanes) == 2


def test_borders_are_the_outer_edges_of_lanes() -> None:
    """A lane with widths beside them is measured from the border before it."""
    edges = '<border sOffset="0" a="-3" b="-0.01" c="0" d="0"/>', '<border sOffset="0" a="-7" b="0" c="0" d="0"/>'
    right = "".join(f'<lane id="-{n}" type="driving">{edge}</lane>' for n, edge in enumerate(edges, 1))
    right += LANE.format(-3, "")
    file = read_alignment(document(road(lanes=section(right=right))))
    lanes = {lane.name: lane for lane in file.lanes}
    for name, start, end, width in (("-1", -1.5, -2, 3), ("-2", -5, -5.5, 4), ("-3", -8.75, -8.75, 3.5)):
        lane = lanes[f"road 7 lane {name}"]
        assert lane.centre is not None
        assert lane.width_m is not None
        np.testing.assert_allclose(lane.centre[[0, -1], 1], [start, end])
        assert lane.width_m[0] == pytest.approx(width)


def test_level_and_raised_lanes_are_not_on_the_inclined_road() -> None:
    """A level lane and those outside of it begin at the edge of the inclined lane before, and lie flat."""
    roll = math.asin(0.05)
    right = RIGHT + LANE.format(-2, '<height sOffset="0" inner="0.1" outer="0.2"/>').replace(
        'type="driving"', 'type="driving" level="true"'
    )
    profile = '<elevationProfile><elevation s="0" a="100" b="0" c="0" d="0"/></elevationProfile>'
    profile += f'<lateralProfile><superelevation s="0" a="{roll!r}" b="0" c="0" d="0"/></lateralProfile>'
    file = read_alignment(document(road(lanes=section(right=right), extra=profile)))
    inner, outer = (next(lane for lane in file.lanes if lane.name.endswith(f"lane -{n}")) for n in (1, 2))
    assert inner.centre is not None
    assert outer.centre is not None
    assert inner.superelevation_rad is not None
    assert outer.superelevation_rad is not None
    np.testing.assert_allclose(inner.centre[0, 1:], [-1.75 * math.cos(roll), 100 - 1.75 * 0.05])
    np.testing.assert_allclose(outer.centre[0, 1:], [-3.5 * math.cos(roll) - 1.75, 100 - 3.5 * 0.05 + 0.15])
    assert inner.superelevation_rad[0] == pytest.approx(roll)
    assert outer.superelevation_rad[0] == 0.0
    assert file.warnings == ()


def test_lanes_go_on_where_a_section_has_a_single_side() -> None:
    only = '<center><lane id="0" type="none"/></center><right>{}</right>'
    lanes = (
        section() + f'<laneSection s="40" singleSide="true">{only.format(RIGHT + LANE.format(-2, ""))}</laneSection>'
    )
    lanes += section(70.0)
    file = read_alignment(document(road(lanes=lanes)))
    spans = [sorted(lane.station_m[[0, -1]].tolist()) for lane in file.lanes if lane.station_m is not None]
    assert sorted(spans) == [[0, 40], [0, 70], [40, 70], [40, 70], [70, 100], [70, 100]]
