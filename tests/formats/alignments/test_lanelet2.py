"""Maps of lanelet2: against what the lanelet2 library reads, and small maps made here."""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from app.errors import UnreadableUpload, WaymarkError
from app.formats.alignments.geometry import AlignmentFile, BoundaryStyle, EventKind, LaneGeometry
from app.formats.alignments.lanelet2 import read_lanelet2
from app.formats.alignments.read import read_alignment
from app.values import Floats
from tests.formats.alignments.mutations import damaged

DATA = Path(__file__).resolve().parents[2] / "data" / "lanelet2"
DEGREE_M = 111_319.5


@lru_cache
def karlsruhe() -> AlignmentFile:
    return read_lanelet2((DATA / "karlsruhe.osm").read_bytes())


def tags(**values: str) -> str:
    return "".join(f'<tag k="{key}" v="{value}"/>' for key, value in values.items())


def node(number: int, x: float, y: float, extra: str = "") -> str:
    """A node at x metres east, y metres north of 0 N, 8 E."""
    return f'<node id="{number}" lat="{y / DEGREE_M!r}" lon="{8 + x / DEGREE_M!r}">{extra}</node>'


def way(number: int, *nodes: int, **values: str) -> str:
    refs = "".join(f'<nd ref="{ref}"/>' for ref in nodes)
    return f'<way id="{number}">{refs}{tags(**values)}</way>'


def lanelet(number: int, left: int, right: int, members: str = "", **values: str) -> str:
    sides = f'<member type="way" ref="{left}" role="left"/><member type="way" ref="{right}" role="right"/>'
    kinds = {"type": "lanelet", "subtype": "road", **values}
    return f'<relation id="{number}">{sides}{members}{tags(**kinds)}</relation>'


def osm(*parts: str) -> bytes:
    return f'<?xml version="1.0"?><osm version="0.6">{"".join(parts)}</osm>'.encode()


def rule(number: int, **values: str) -> tuple[str, str]:
    """The member of a lanelet, and the opening of a regulatory element."""
    member = f'<member type="relation" ref="{number}" role="regulatory_element"/>'
    return member, f'<relation id="{number}">{tags(type="regulatory_element", **values)}'


# Two lanelets eastwards, 3 m wide, the first from 0 to 50 m, the second to 100 m. The ways of the first are stored
# westwards.
NODES = "".join(node(i, 50.0 * (i % 3), 3.0 * (i // 3)) for i in range(6))
FIRST = way(10, 4, 3, type="line_thin", subtype="dashed") + way(11, 1, 0, type="line_thick", subtype="solid_dashed")
SECOND = way(12, 4, 5, type="line_thin", subtype="dashed") + way(13, 1, 2, type="line_thick", subtype="dashed_solid")
WAYS = FIRST + SECOND


def lanes(file: AlignmentFile) -> dict[str, LaneGeometry]:
    return {lane.name: lane for lane in file.lanes}


def values(array: Floats | None) -> Floats:
    assert array is not None
    return array


def test_lanelets_are_turned_and_chained_as_by_lanelet2() -> None:
    chains = json.loads((DATA / "lanelet2.json").read_text())
    found = lanes(karlsruhe())
    assert set(found) == {f"lanelet {chain['lanelets'][0]}" for chain in chains}
    assert len(found) == 24
    for chain in chains:
        lane = found[f"lanelet {chain['lanelets'][0]}"]
        left, right = values(lane.left), values(lane.right)
        cut = chain["left"][0] == chain["right"][0]  # 45068 begins where its boundaries are apart
        assert cut == (lane.name == "lanelet 45068")
        ends = [-1] if cut else [0, -1]
        assert np.abs(left[ends, :2] - np.array(chain["left"])[ends]).max() < 2e-9
        assert np.abs(right[ends, :2] - np.array(chain["right"])[ends]).max() < 2e-9
        assert cut or [len(left), len(right)] == chain["points"]
    assert karlsruhe().crs == "EPSG:4326"


def test_stop_lines_and_crosswalks_of_the_map() -> None:
    found = {(event.kind, event.lane) for event in karlsruhe().events}
    # Three lanes of one approach, with one stop line before one crosswalk.
    assert {(EventKind.STOP_LINE, f"lanelet {number}") for number in (44962, 44964, 44966)} <= found
    assert {(EventKind.CROSSING, f"lanelet {number}") for number in (44962, 44964, 44966)} <= found
    assert [area.kind for area in karlsruhe().areas] == ["crossing"] * 4
    for area in karlsruhe().areas:
        assert (area.ring[0] == area.ring[-1]).all()


def test_successive_lanelets_are_one_lane_with_styles_and_heights() -> None:
    high = NODES.replace("></node>", f">{tags(ele='12.5')}</node>", 1)
    file = read_lanelet2(osm(high, WAYS, lanelet(20, 10, 11), lanelet(21, 12, 13)))
    (lane,) = file.lanes
    assert lane.name == "lanelet 20"
    np.testing.assert_allclose((values(lane.left)[:, 0] - 8) * DEGREE_M, [0, 50, 100], atol=1e-6)
    np.testing.assert_allclose(values(lane.left)[:, 1] * DEGREE_M, 3.0, atol=1e-6)
    np.testing.assert_allclose(values(lane.right)[:, 2], [12.5, np.nan, np.nan])
    # Of both double lines the dashed one is nearer to the lane: one is stored westwards.
    assert (lane.left_style, lane.right_style) == (BoundaryStyle.DASHED, BoundaryStyle.DASHED)
    assert lane.speed_limit_m_s is None


@pytest.mark.parametrize(
    ("kind", "subtype", "style"),
    [
        ("line_thin", "solid", BoundaryStyle.SOLID),
        ("line_thick", "dashed", BoundaryStyle.DASHED),
        ("line_thin", "", BoundaryStyle.UNKNOWN),
        ("virtual", "", BoundaryStyle.NONE),
        ("curbstone", "high", BoundaryStyle.NONE),
        ("zig-zag", "", BoundaryStyle.UNKNOWN),
    ],
)
def test_line_styles(kind: str, subtype: str, style: BoundaryStyle) -> None:
    plain = way(10, 3, 4, type=kind, subtype=subtype) + way(11, 0, 1, type="virtual")
    (lane,) = read_lanelet2(osm(NODES, plain, lanelet(20, 10, 11))).lanes
    assert (lane.left_style, lane.right_style) == (style, BoundaryStyle.NONE)


def test_a_fork_ends_a_lane() -> None:
    fork = node(6, 100, 20) + node(7, 100, 17) + way(14, 4, 6) + way(15, 1, 7)
    file = read_lanelet2(osm(NODES, fork, WAYS, *(lanelet(20 + i, 10 + 2 * i, 11 + 2 * i) for i in range(3))))
    assert set(lanes(file)) == {"lanelet 20", "lanelet 21", "lanelet 22"}


def test_a_ring_is_one_lane() -> None:
    corners = [(0, 0), (60, 0), (60, 60), (0, 60)]
    outer = "".join(node(i, x, y) for i, (x, y) in enumerate(corners))
    inner = "".join(node(4 + i, 3 + x * 0.9, 3 + y * 0.9) for i, (x, y) in enumerate(corners))
    ways = "".join(way(10 + i, i, (i + 1) % 4) + way(20 + i, 4 + i, 4 + (i + 1) % 4) for i in range(4))
    (lane,) = read_lanelet2(osm(outer, inner, ways, *(lanelet(30 + i, 20 + i, 10 + i) for i in range(4)))).lanes
    assert lane.name == "lanelet 30"
    assert len(values(lane.left)) == 5


@pytest.mark.parametrize(
    ("text", "speed_m_s"),
    [("50", 50 / 3.6), ("50 km/h", 50 / 3.6), ("30mph", 13.4112), ("13.9 m/s", 13.9), ("de274-70", 70 / 3.6)],
)
@pytest.mark.parametrize("regulatory", [False, True])
def test_speed_limits(text: str, speed_m_s: float, regulatory: bool) -> None:
    member, opening = rule(30, subtype="speed_limit", sign_type=text)
    limited = lanelet(21, 12, 13, member) if regulatory else lanelet(21, 12, 13, speed_limit=text)
    (lane,) = read_lanelet2(osm(NODES, WAYS, lanelet(20, 10, 11), limited, opening + "</relation>")).lanes
    np.testing.assert_allclose(values(lane.speed_limit_m_s), [np.nan, speed_m_s, speed_m_s])


def test_speed_limit_by_a_sign_and_one_that_is_not_understood() -> None:
    member, opening = rule(30, subtype="speed_limit")
    sign = way(40, 0, 3, type="traffic_sign", subtype="de274-30")
    refers = '<member type="way" ref="40" role="refers"/></relation>'
    (lane,) = read_lanelet2(osm(NODES, WAYS, sign, lanelet(20, 10, 11, member), opening + refers)).lanes
    np.testing.assert_allclose(values(lane.speed_limit_m_s), 30 / 3.6)
    file = read_lanelet2(osm(NODES, WAYS, lanelet(20, 10, 11, speed_limit="walk")))
    assert file.lanes[0].speed_limit_m_s is None
    assert file.warnings == ("Lanelet 20: the speed limit 'walk' is not understood.",)


@pytest.mark.parametrize(("x", "found"), [(40.0, [40.0]), (99.6, [99.6]), (100.5, [100.0]), (0.3, []), (120.0, [])])
def test_stop_lines_across_a_lane(x: float, found: list[float]) -> None:
    line = node(8, x, 0.2) + node(9, x, 2.8) + way(40, 8, 9, type="stop_line")
    file = read_lanelet2(osm(NODES, line, WAYS, lanelet(20, 10, 11), lanelet(21, 12, 13)))
    assert all(event.kind is EventKind.STOP_LINE and event.lane == "lanelet 20" for event in file.events)
    assert [(event.point[0] - 8) * DEGREE_M for event in file.events] == pytest.approx(found, abs=1e-6)
    assert any("1 stop lines lie on no lane" in warning for warning in file.warnings) == (not found)


def test_stop_lines_along_a_lane_and_referenced_ones() -> None:
    along = node(8, 20, 1.5) + node(9, 30, 1.6) + way(40, 8, 9, type="stop_line")
    assert read_lanelet2(osm(NODES, along, WAYS, lanelet(20, 10, 11))).events == ()
    member, opening = rule(30, subtype="traffic_light")
    ref = '<member type="way" ref="40" role="ref_line"/></relation>'
    beyond = node(8, 53, 0) + node(9, 53, 3) + way(40, 8, 9, type="stop_line")
    (event,) = read_lanelet2(osm(NODES, beyond, FIRST, lanelet(20, 10, 11, member), opening + ref)).events
    assert event.lane == "lanelet 20"
    yields, opening = rule(30, subtype="right_of_way")
    has_way = read_lanelet2(osm(NODES, beyond, FIRST, lanelet(20, 10, 11, yields), opening + ref))
    assert has_way.events == ()
    role = '<member type="relation" ref="20" role="yield"/>'
    (event,) = read_lanelet2(osm(NODES, beyond, FIRST, lanelet(20, 10, 11, yields), opening + role + ref)).events
    assert event.kind is EventKind.STOP_LINE


def test_crosswalks_and_arrows() -> None:
    corners = [(70, -2), (70, 5), (74, -2), (74, 5)]
    walk = "".join(node(50 + i, x, y) for i, (x, y) in enumerate(corners)) + way(60, 50, 51) + way(61, 53, 52)
    arrow = node(54, 20, 1.5) + node(55, 24, 1.5) + way(62, 54, 55, type="arrow", subtype="straight_left")
    file = read_lanelet2(
        osm(
            NODES, walk, arrow, WAYS, lanelet(20, 10, 11), lanelet(21, 12, 13), lanelet(22, 60, 61, subtype="crosswalk")
        )
    )
    events = {(event.kind, event.lane, event.value, round((event.point[0] - 8) * DEGREE_M, 3)) for event in file.events}
    assert events == {
        (EventKind.CROSSING, "lanelet 20", None, 70.0),
        (EventKind.ARROW, None, "straight-left", 22.0),
    }
    ring = file.areas[0].ring
    area = 0.5 * abs(np.sum(ring[:-1, 0] * ring[1:, 1] - ring[1:, 0] * ring[:-1, 1])) * DEGREE_M**2
    assert area == pytest.approx(28.0, rel=1e-6), "the ring does not cross itself"


@pytest.mark.parametrize("placeholder", ["", 'lat="" lon=""', 'lat="0" lon="0"'])
def test_local_coordinates_need_an_origin(placeholder: str) -> None:
    nodes = "".join(
        f'<node id="{i}" {placeholder}>{tags(local_x=str(50.0 * (i % 3)), local_y=str(3.0 * (i // 3)))}</node>'
        for i in range(6)
    )
    file = read_lanelet2(osm(nodes, WAYS, lanelet(20, 10, 11)))
    assert file.crs is None
    assert "--origin" in (file.crs_problem or "")
    assert values(file.lanes[0].right)[:, 0].tolist() == [0.0, 50.0]


def test_lat_and_lon_are_used_beside_local_coordinates() -> None:
    both = NODES.replace("></node>", f">{tags(local_x='1', local_y='2')}</node>")
    assert read_lanelet2(osm(both, WAYS, lanelet(20, 10, 11))).crs == "EPSG:4326"


def test_what_vehicles_do_not_drive_on_is_left_out() -> None:
    others = [lanelet(21, 12, 13, subtype="bicycle_lane"), lanelet(22, 12, 13, **{"participant:vehicle": "no"})]
    others.append(lanelet(24, 12, 13, **{"participant:bicycle": "yes", "participant:pedestrian": "yes"}))
    others.append(lanelet(23, 12, 13, subtype="shared_walkway"))
    file = read_lanelet2(osm(NODES, WAYS, lanelet(20, 10, 11, one_way="no"), *others))
    assert set(lanes(file)) == {"lanelet 20"}
    assert file.warnings == ("1 lanelets are two-way; they are used in the direction of their boundaries alone.",)


def test_a_lanelet_without_two_sides_is_left_out() -> None:
    stub = way(14, 2)
    file = read_lanelet2(osm(NODES, WAYS, stub, lanelet(20, 10, 11), lanelet(21, 12, 14), lanelet(22, 12, 99)))
    assert set(lanes(file)) == {"lanelet 20"}
    assert [warning[:11] for warning in file.warnings] == ["Lanelet 21:", "Lanelet 22:"]


@pytest.mark.parametrize("at_end", [False, True])
def test_a_lane_whose_boundaries_meet_begins_where_they_are_apart(at_end: bool) -> None:
    """3 m at 100 m, so 1.75 m apart at 58.3 m."""
    wedge = [node(0, 0, 0, tags(ele="1")), node(1, 100, 0, tags(ele="3")), node(2, 100, 3, tags(ele="3"))]
    ways = (way(10, 1, 0), way(11, 2, 0)) if at_end else (way(10, 0, 2), way(11, 0, 1))
    file = read_lanelet2(osm(*wedge, *ways, lanelet(20, 10, 11, speed_limit="50")))
    (lane,) = file.lanes
    ends = (values(lane.right)[[0, -1], 0] - 8) * DEGREE_M
    assert ends.tolist() == pytest.approx([100.0, 58.4] if at_end else [58.4, 100.0], abs=0.3)
    assert values(lane.left)[[0, -1], 2].tolist() == pytest.approx([3.0, 2.17] if at_end else [2.17, 3.0], abs=0.01)
    np.testing.assert_allclose(values(lane.speed_limit_m_s), 50 / 3.6)
    assert "Lanelet 20: its boundaries meet at an end" in file.warnings[0]


def test_a_lane_whose_boundaries_are_never_apart_is_left_out() -> None:
    thin = node(30, 0, 9) + node(31, 50, 9.5) + node(32, 50, 8.5) + way(33, 30, 31) + way(34, 30, 32)
    file = read_lanelet2(osm(NODES, thin, WAYS, lanelet(20, 10, 11), lanelet(21, 33, 34)))
    assert set(lanes(file)) == {"lanelet 20"}
    assert file.warnings == ("Lanelet 21: its boundaries are nowhere 1.75 m apart; it is left out.",)


def test_the_format_is_detected() -> None:
    assert read_alignment((DATA / "karlsruhe.osm").read_bytes()).format == "lanelet2"


PLAIN = osm(NODES, WAYS, lanelet(20, 10, 11))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (osm(NODES, WAYS), "no lanelet that vehicles drive on"),
        (osm(WAYS, lanelet(20, 10, 11)), "way 10: the node 4 is missing"),
        (PLAIN.replace(b'lon="8.0"', b'lon="NaN"', 1), "node 0: lon is 'NaN'"),
        (PLAIN.replace(b'lon="8.0"', b'lon="188"', 1), "node 0: lat 0, lon 188 is no place on Earth"),
        (PLAIN.replace(b'lon="8.0"', b"", 1), "node 0: it has neither lat and lon nor local_x and local_y"),
        (PLAIN.replace(b'relation id="20"', b'relation id="x"'), "the id 'x' of a relation is no number"),
        (PLAIN[:-9], "not XML"),
        (b'<!DOCTYPE x [<!ENTITY a "b">]><osm>&a;</osm>', "document type"),
        (b"<LandXML/>", "begins with the element 'LandXML'"),
    ],
)
def test_errors_name_the_place(data: bytes, message: str) -> None:
    with pytest.raises(UnreadableUpload) as caught:
        read_lanelet2(data)
    assert message in caught.value.message
    assert caught.value.cure
    assert caught.value.limit


def test_damaged_maps_are_read_or_refused() -> None:
    member, opening = rule(30, subtype="traffic_light")
    ref = '<member type="way" ref="40" role="ref_line"/></relation>'
    line = node(8, 40, 0) + node(9, 40, 3) + way(40, 8, 9, type="stop_line")
    walk = (
        "".join(node(50 + i, 70 + 4 * (i // 2), -2 + 7 * (i % 2)) for i in range(4)) + way(60, 50, 51) + way(61, 52, 53)
    )
    whole = osm(
        NODES, line, walk, WAYS, lanelet(20, 10, 11, member, speed_limit="50"), lanelet(21, 12, 13), opening + ref,
        lanelet(22, 60, 61, subtype="crosswalk"),
    )  # fmt: skip
    assert len(read_lanelet2(whole).events) == 2
    outcomes = {"read": 0, "refused": 0}
    for data in damaged(whole, 500):
        try:
            file = read_lanelet2(data)
        except WaymarkError:
            outcomes["refused"] += 1
            continue
        outcomes["read"] += 1
        for lane in file.lanes:
            assert np.isfinite(values(lane.left)[:, :2]).all()
    assert min(outcomes.values()) > 20
