"""DXF drawings: arcs are true, layers decide, texts name lanes."""

from __future__ import annotations

import io
import math
from typing import Any

import ezdxf
import numpy as np
import pytest

from app.errors import UnreadableUpload, WaymarkError
from app.formats.alignments.geometry import AlignmentFile, EventKind, LaneGeometry
from app.formats.alignments.read import read_alignment

BULGE_90 = math.tan(math.pi / 8)


def _drawing(unit: int = 6) -> tuple[Any, Any]:
    document = ezdxf.new("R2010")
    document.header["$INSUNITS"] = unit
    return document, document.modelspace()


def _read(document: Any) -> AlignmentFile:
    stream = io.StringIO()
    document.write(stream)
    return read_alignment(stream.getvalue().encode())


def _on_circle(lane: LaneGeometry, centre: tuple[float, float], radius: float) -> float:
    """Greatest distance of the vertices with curvature from a circle."""
    assert lane.centre is not None
    assert lane.curvature_per_m is not None
    arc = lane.centre[lane.curvature_per_m != 0]
    assert len(arc) > 5
    return float(np.abs(np.hypot(*(arc[:, :2] - centre).T) - radius).max())


def _chord_error(lane: LaneGeometry, radius: float) -> float:
    assert lane.centre is not None
    assert lane.curvature_per_m is not None
    arc = lane.centre[lane.curvature_per_m != 0]
    chord = np.hypot(*np.diff(arc[:, :2], axis=0).T).max()
    return radius - math.sqrt(radius**2 - chord**2 / 4)


@pytest.mark.parametrize("radius", [20.0, 100.0, 500.0])
@pytest.mark.parametrize("sign", [1, -1])
def test_bulges_are_true_arcs(radius: float, sign: int) -> None:
    """ezdxf's Bezier of the same bulge is 5, 27 and 136 mm off."""
    document, space = _drawing()
    points = [(0, 0, 0), (100, 0, sign * BULGE_90), (100 + radius, sign * radius, 0), (100 + radius, sign * 900, 0)]
    space.add_lwpolyline(points, format="xyb", dxfattribs={"layer": "A"})
    (lane,) = _read(document).lanes
    assert _on_circle(lane, (100, sign * radius), radius) < 1e-9
    assert _chord_error(lane, radius) < 0.001
    assert lane.curvature_per_m is not None
    assert set(np.round(lane.curvature_per_m * radius, 9)) == {0.0, float(sign)}
    assert lane.centre is not None
    jumps = np.flatnonzero(np.diff(lane.curvature_per_m))
    assert len(jumps) == 2
    np.testing.assert_array_equal(lane.centre[jumps], lane.centre[jumps + 1])


def test_lines_and_arcs_that_meet_are_one_lane_with_the_name_of_the_text() -> None:
    document, space = _drawing()
    for k, name in enumerate(("N1", "N2")):
        y = 100.0 * k
        space.add_line((0, 10 + y), (50, 10 + y), dxfattribs={"layer": "B"})
        space.add_line((70, 30 + y), (70, 60 + y), dxfattribs={"layer": "B"})
        space.add_arc((50, 30 + y), 20, 270, 360, dxfattribs={"layer": "B"})
        space.add_arc((90, 60 + y), 20, 90, 180, dxfattribs={"layer": "B"})  # drawn from its end to its start
        space.add_text(name, dxfattribs={"layer": "B", "insert": (20, 12 + y)})
    file = _read(document)
    assert [lane.name for lane in file.lanes] == ["N1", "N2"]
    lane = file.lanes[0]
    assert lane.centre is not None
    assert lane.curvature_per_m is not None
    assert lane.centre[[0, -1], :2].tolist() == [[0, 10], pytest.approx([90, 80])]
    assert lane.curvature_per_m.max() == pytest.approx(1 / 20)
    assert lane.curvature_per_m.min() == pytest.approx(-1 / 20)


def test_polylines_without_arcs_have_no_curvature_and_names_of_their_layer() -> None:
    document, space = _drawing()
    space.add_lwpolyline([(0, 0), (50, 0), (90, 5)], dxfattribs={"layer": "lane 1", "elevation": 4.0})
    space.add_polyline3d([(0, 9, 1), (50, 9, 2), (90, 9, 3)], dxfattribs={"layer": "lane 2"})
    space.add_polyline3d([(0, 19, 1), (50, 19, 2)], dxfattribs={"layer": "lane 2"})
    file = _read(document)
    assert [lane.name for lane in file.lanes] == ["lane 1", "lane 2 1", "lane 2 2"]
    assert [lane.curvature_per_m for lane in file.lanes] == [None] * 3
    assert file.lanes[0].centre is not None
    assert file.lanes[0].centre[:, 2].tolist() == [4.0] * 3
    assert file.lanes[1].centre is not None
    assert file.lanes[1].centre[:, 2].tolist() == [1.0, 2.0, 3.0]


def test_old_polylines_have_arcs_too() -> None:
    document, space = _drawing()
    space.add_polyline2d([(0, 0, 0), (100, 0, BULGE_90), (120, 20, 0)], format="xyb", dxfattribs={"layer": "A"})
    assert _on_circle(_read(document).lanes[0], (100, 20), 20) < 1e-9


def test_mirrored_polylines_turn_to_the_other_side() -> None:
    document, space = _drawing()
    line = [(0, 0, 0), (-100, 0, -BULGE_90), (-120, 20, 0)]
    space.add_lwpolyline(line, format="xyb", dxfattribs={"layer": "A", "extrusion": (0, 0, -1)})
    (lane,) = _read(document).lanes
    assert _on_circle(lane, (100, 20), 20) < 1e-9
    assert lane.curvature_per_m is not None
    assert lane.curvature_per_m.max() == pytest.approx(1 / 20)


@pytest.mark.parametrize(
    ("left", "right"), [("Lane3_left", "Lane3_right"), ("Lane3-L", "Lane3-R"), ("lane3 LEFT", "lane3 RIGHT")]
)
def test_layers_of_boundaries(left: str, right: str) -> None:
    document, space = _drawing()
    space.add_line((0, 3.5), (90, 3.5), dxfattribs={"layer": left})
    space.add_line((0, 0), (90, 0), dxfattribs={"layer": right})
    (lane,) = _read(document).lanes
    assert lane.name.lower() == "lane3"
    assert lane.left is not None
    assert lane.left[0, 1] == 3.5


def test_layers_of_areas_and_events() -> None:
    document, space = _drawing()
    space.add_line((0, 0), (90, 0), dxfattribs={"layer": "road"})
    space.add_circle((30, 0), 0.4, dxfattribs={"layer": "Manholes"})
    space.add_line((40, -2), (40, 2), dxfattribs={"layer": "JOINTS"})
    space.add_lwpolyline([(50, -5), (60, -5), (60, 5), (50, 5)], close=True, dxfattribs={"layer": "bridge"})
    space.add_line((80, -2), (80, 2), dxfattribs={"layer": "stop-line"})
    space.add_point((70, 0), dxfattribs={"layer": "junction"})
    space.add_text("70", dxfattribs={"layer": "Speed Limit", "insert": (10, 1)})
    file = _read(document)
    assert len(file.lanes) == 1
    assert [area.kind for area in file.areas] == ["manholes", "joints", "bridges"]
    assert np.hypot(*(file.areas[0].ring - (30, 0)).T) == pytest.approx(0.4)
    assert np.ptp(file.areas[1].ring[:, 0]) == pytest.approx(0.01)
    found = {event.kind: (event.point, event.value) for event in file.events}
    assert found[EventKind.STOP_LINE] == ((80.0, 0.0), None)
    assert found[EventKind.JUNCTION] == ((70.0, 0.0), None)
    assert found[EventKind.SPEED_LIMIT] == ((10.0, 1.0), 70.0)


def test_units_and_what_is_left_out() -> None:
    document, space = _drawing(2)
    space.add_lwpolyline([(0, 0, 0), (300, 0, BULGE_90), (400, 100, 0)], format="xyb", dxfattribs={"layer": "A"})
    space.add_spline([(0, 0, 0), (10, 5, 0), (20, 0, 0)], dxfattribs={"layer": "S"})
    file = _read(document)
    assert file.unit_m == 0.3048
    curvature = file.lanes[0].curvature_per_m
    assert curvature is not None
    assert curvature.max() == pytest.approx(1 / 30.48)
    assert "splines" in file.warnings[0]
    document, space = _drawing(0)
    space.add_line((0, 0), (90, 0))
    unstated = _read(document)
    assert unstated.unit_m is None
    assert "no unit" in unstated.warnings[0]


def test_what_cannot_be_read() -> None:
    document, space = _drawing()
    with pytest.raises(UnreadableUpload, match="no lanes"):
        _read(document)
    space.add_lwpolyline([(0, 0), (1, 1)], dxfattribs={"extrusion": (1, 0, 0)})
    with pytest.raises(UnreadableUpload, match="does not lie flat"):
        _read(document)
    with pytest.raises(UnreadableUpload, match="DXF cannot be used"):
        read_alignment(b"0\nSECTION\n2\nENTITIES\n0\nLINE\n10\nabc\n0\nENDSEC\n0\nEOF\n")
    with pytest.raises(UnreadableUpload, match="INSUNITS"):
        _read(_drawing(3)[0])


def test_damaged_drawings_raise_nothing_else() -> None:
    document, space = _drawing()
    space.add_lwpolyline([(0, 0, 1e-17), (100, 0, BULGE_90), (120, 20, 0)], format="xyb", dxfattribs={"layer": "A"})
    space.add_arc((50, 30), 20, 270, 360, dxfattribs={"layer": "B"})
    space.add_text("70", dxfattribs={"layer": "Speed Limit", "insert": (10, 1)})
    space.add_circle((30, 0), 0.4, dxfattribs={"layer": "Manholes"})
    stream = io.StringIO()
    document.write(stream)
    good = stream.getvalue()
    assert len(read_alignment(good.encode()).lanes) == 2
    start = good.index("ENTITIES")
    lines = good[start:].split("\n")
    rng = np.random.default_rng(6)
    read = 0
    for _ in range(40):
        damaged = list(lines)
        for at in rng.integers(0, len(lines), 2):
            damaged[at] = str(rng.choice(["1e308", "nan", "inf", "-1", "0", "x", "1e-300", "", "42"]))
        try:
            read_alignment((good[:start] + "\n".join(damaged)).encode())
            read += 1
        except WaymarkError:
            continue
    assert read > 0
