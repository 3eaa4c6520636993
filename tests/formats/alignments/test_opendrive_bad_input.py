"""OpenDRIVE that is damaged or contradicts itself: errors name place and cure, and nothing else is ever raised."""

from __future__ import annotations

import numpy as np
import pytest

from app.errors import UnreadableUpload, WaymarkError
from app.formats.alignments.opendrive import read_opendrive
from tests.formats.alignments.mutations import damaged
from tests.formats.alignments.xodr import LANE, LEFT, RIGHT, document, road, section

GEOMETRY = '<geometry s="{s}" x="{x}" y="0" hdg="0" length="{length}">{shape}</geometry>'
PIECES = GEOMETRY.format(s=0, x=0, length=50, shape="<line/>") + GEOMETRY.format(
    s=50, x=50.0, length=50, shape="<line/>"
)
WIDTH = '<width sOffset="0" a="3.5" b="0" c="0" d="0"/>'


def refused(data: bytes) -> UnreadableUpload:
    with pytest.raises(UnreadableUpload) as caught:
        read_opendrive(data)
    assert caught.value.cure
    assert caught.value.limit
    return caught.value


def piece(shape: str, length: str = "50") -> bytes:
    return document(road(GEOMETRY.format(s=0, x=0, length=length, shape=shape)))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (piece("<line/>", "0"), "road 7: the planView has geometries of zero length only"),
        (piece("<line/>", "-3"), "road 7, geometry at s 0: the length is -3 m"),
        (piece("<line/>", "nan"), "road 7, geometry at s 0: length is 'nan'"),
        (piece("<line/>", "1e8"), "needs 1.5e+08 vertices"),
        (piece("<arc/>"), "road 7, geometry at s 0: curvature is missing"),
        (piece('<arc curvature="inf"/>'), "road 7, geometry at s 0: curvature is 'inf'"),
        (piece('<arc curvature="1e8"/>'), "vertices"),
        (piece('<spiral curvStart="0" curvEnd="50"/>'), "turns more than twice around"),
        (piece("<bezier/>"), "road 7, geometry at s 0: the geometry is bezier"),
        (piece(""), "road 7, geometry at s 0: the geometry is nothing"),
        (piece("<line/><line/>"), "the geometry is line, line"),
        (piece('<paramPoly3 aU="0" bU="0" cU="0" dU="0" aV="0" bV="0" cV="0" dV="0"/>'), "stands still"),
        (piece('<paramPoly3 aU="0" bU="1" cU="0" dU="0" aV="0" bV="0" cV="0" dV="0"/>'), "1.000 m long"),
        (document(road("")), "road 7: the planView has no geometry"),
        (document(road(PIECES.replace("50.0", "50.2"))), "road 7, geometry at s 50: the element before ends away"),
        (document(road(PIECES.replace('s="50"', 's="50.2"'))), "road 7, geometry at s 50.2: s differs"),
        (document(road(lanes=section(left=LEFT.replace('"1"', '"one"')))), "road 7, lane one at s 0: the id is no"),
        (document(road(lanes=section(left=LEFT.replace(WIDTH, "")))), "road 7, lane 1 at s 0: the lane has no width"),
        (document(road(lanes=section() + section())), "lane sections are not in the order"),
        (document(road(lanes="")), "no lane that vehicles drive on"),
        (document(road(), road()), "the road id '7' occurs twice"),
        (document(road(extra='<type s="0"><speed max="9" unit="knots"/></type>')), "the unit of the speed is 'knots'"),
        (b"<OpenDRIVE/>", "the file has no road"),
        (b"<osm/>", "begins with the element 'osm'"),
        (document()[:-20], "not XML"),
        (b"", "not XML"),
        (b'<OpenDRIVE><q:road id="1"/></OpenDRIVE>', "not XML: unbound prefix"),
        (b'<?xml version="1.0" encoding="utf-77"?><OpenDRIVE/>', "declares the encoding 'utf-77'"),
        (b"\x00\xff" * 100, "not XML"),
        (b"<OpenDRIVE>" + b"<a>" * 200 + b"</a>" * 200 + b"</OpenDRIVE>", "nested too deeply"),
        (b'<!DOCTYPE o [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><OpenDRIVE>&b;</OpenDRIVE>', "document type"),
        (b'<!DOCTYPE o SYSTEM "http://127.0.0.1/o.dtd"><OpenDRIVE/>', "document type"),
    ],
)  # fmt: skip
def test_errors_name_the_place(data: bytes, message: str) -> None:
    assert message in refused(data).message


@pytest.mark.parametrize(("gap", "warned"), [(0.005, False), (0.05, True)])
def test_small_gaps_warn(gap: float, warned: bool) -> None:
    file = read_opendrive(document(road(PIECES.replace("50.0", f"{50 + gap}"))))
    assert any("road 7, geometry at s 50" in warning for warning in file.warnings) == warned


@pytest.mark.parametrize(
    ("a", "b", "left_out"),
    [
        ("0", "0", "from s 0.000 to 100.000 m"),
        ("-1", "0", "to 100.000 m"),
        ("3", "-0.06", "from s 50.000 to 100.000 m"),
    ],
)
def test_lanes_of_zero_width_are_left_out(a: str, b: str, left_out: str) -> None:
    narrow = LANE.format(-1, "").replace('a="3.5" b="0"', f'a="{a}" b="{b}"')
    file = read_opendrive(document(road(lanes=section(right=narrow))))
    assert any("road 7 lane -1" in warning and left_out in warning for warning in file.warnings)
    for lane in file.lanes:
        assert lane.width_m is not None
        assert lane.width_m.min() >= 0.05


def test_a_lane_that_jumps_sideways_is_divided() -> None:
    linked = LANE.format(-1, '<link><successor id="-1"/></link>')
    shifted = '<laneOffset s="0" a="0" b="0" c="0" d="0"/><laneOffset s="60" a="0.5" b="0" c="0" d="0"/>'
    file = read_opendrive(document(road(lanes=shifted + section(left="", right=linked) + section(60, left=""))))
    assert [lane.name for lane in file.lanes] == ["road 7 lane -1", "road 7 lane -1 from s 60"]
    assert any("jumps by 0.500 m at s 60" in warning for warning in file.warnings)


def test_a_lane_at_the_centre_of_a_bend_is_left_out() -> None:
    plan = '<geometry s="0" x="0" y="0" hdg="0" length="5"><arc curvature="0.6"/></geometry>'
    file = read_opendrive(document(road(plan, length=5.0)))
    assert [lane.name for lane in file.lanes] == ["road 7 lane -1"]
    assert any("road 7 lane 1" in warning and "centre of a bend" in warning for warning in file.warnings)


RICH_PLAN = "".join(
    GEOMETRY.format(s=s, x=s, length=length, shape=shape).replace('y="0"', f'y="{y}"')
    for s, length, y, shape in (
        (0, 40, 0.0, "<line/>"),
        (40, 20, 0.0, '<spiral curvStart="0" curvEnd="0.0001"/>'),
        (60, 20, 0.006, '<paramPoly3 aU="0" bU="20" cU="0" dU="0" aV="0" bV="0" cV="0" dV="0" pRange="normalized"/>'),
        (80, 10, 0.02, '<poly3 a="0" b="0" c="0.001" d="0"/>'),
        (90, 10, 0.12, '<arc curvature="0.02"/>'),
    )
)
RICH = document(
    road(
        RICH_PLAN,
    lanes=section(0, LEFT, RIGHT, '<roadMark sOffset="0" type="solid broken"/>')
        + section(50, LANE.format(1, '<link><predecessor id="1"/></link><speed sOffset="3" max="30" unit="mph"/>')),
        extra='<type s="0" type="rural"><speed max="70" unit="km/h"/></type><elevationProfile><elevation s="0" a="1" '
        'b="0.1" c="0" d="0"/></elevationProfile><lateralProfile><superelevation s="0" a="0.1" b="0" c="0" d="0"/>'
        '</lateralProfile><objects><object id="1" type="crosswalk" s="50" t="0" hdg="0" length="3" width="7"/>'
        '<bridge id="3" s="70" length="10"/></objects><signals><signal id="5" s="20" t="-4" type="274" country="DE" '
        'value="50" orientation="+"><validity fromLane="-1" toLane="-1"/></signal></signals>',
    ),
    header="<geoReference>+proj=utm +zone=32 +datum=WGS84</geoReference>"
    '<offset x="500000" y="5400000" z="0" hdg="0"/>',
)  # fmt: skip


def test_damaged_files_are_read_or_refused() -> None:
    assert len(read_opendrive(RICH).lanes) == 3
    outcomes = {"read": 0, "refused": 0}
    for data in damaged(RICH, 400):
        try:
            file = read_opendrive(data)
        except WaymarkError:
            outcomes["refused"] += 1
            continue
        outcomes["read"] += 1
        for lane in file.lanes:
            assert lane.centre is not None
            assert np.isfinite(lane.centre[:, :2]).all()
            assert lane.curvature_per_m is not None
            assert np.isfinite(lane.curvature_per_m).all()
    assert min(outcomes.values()) > 20


def test_cut_files_are_refused() -> None:
    for length in range(0, len(RICH) - 1, 97):
        refused(RICH[:length])
