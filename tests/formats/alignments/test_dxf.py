"""DXF drawings: arcs are true, layers decide, texts name lanes."""

from __future__ import annotations

import io
import math
from typing import Any

import ezdxf
import numpy as np
import pytest

from app.errors import UnreadableUpload, WaymarkError
from app.formats.alignments.geometry import AlignmentDeclaration, AlignmentFile, EventKind, LaneGeometry
from app.formats.alignments.read import read_alignment

BULGE_90 = math.tan(math.pi / 8)


def _drawing(unit: int = 6) -> tuple[Any, Any]:
    document = ezdxf.new("R2010")
    document.header["$INSUNITS"] = unit
    return document, document.modelspace()


def _read(document: Any, **declared: Any) -> AlignmentFile:
    stream = io.StringIO()
    document.write(stream)
    return read_alignment(stream.getvalue().encode(), declaration=AlignmentDeclaration(**declared))


def _centres(file: AlignmentFile) -> dict[str, list[list[float]]]:
    """Ends of the centre lines of all lanes, in the plane."""
    found = {}
    for lane in file.lanes:
        assert lane.centre is not None
        found[lane.name] = np.round(lane.centre[[0, -1], :2], 6).tolist()
    return found


def _heights(file: AlignmentFile) -> dict[str, list[float]]:
    return {lane.name: lane.centre[:, 2].tolist() for lane in file.lanes if lane.centre is not None}


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
    assert "left out: splines (1 in all), the first on layer S" in file.warnings[1]
    document, space = _drawing(0)
    space.add_line((0, 0), (90, 0))
    unstated = _read(document)
    assert unstated.unit_m is None
    assert "no unit" in unstated.warnings[0]


# --- what is drawn ----------------------------------------------------------------------------------------------------


def test_layers_that_are_not_drawn_are_left_out() -> None:
    document, space = _drawing()
    document.layers.add("Old").freeze()
    document.layers.add("OFF").off()
    document.layers.add("viewport").dxf.flags = 2  # frozen in new viewports only
    document.layers.add("locked").lock()
    for k, layer in enumerate(("LANE", "OLD", "off", "viewport", "locked")):
        space.add_lwpolyline([(0, 9 * k), (90, 9 * k)], dxfattribs={"layer": layer})
    space.add_line((0, 99), (90, 99), dxfattribs={"layer": "LANE", "invisible": 1})
    space.add_text("70", dxfattribs={"layer": "OFF", "insert": (10, 1)})
    file = _read(document)
    assert [lane.name for lane in file.lanes] == ["LANE", "viewport", "locked"]
    (warning,) = file.warnings
    assert warning.startswith("The layers OFF, OLD are frozen or switched off")


def test_a_drawing_whose_lines_are_all_hidden_is_refused_with_the_cure() -> None:
    document, space = _drawing()
    document.layers.add("OLD").freeze()
    space.add_line((0, 0), (90, 0), dxfattribs={"layer": "OLD"})
    with pytest.raises(UnreadableUpload, match="layer OLD is frozen or switched off") as caught:
        _read(document)
    assert "thaw" in (caught.value.cure or "")


def test_blocks_are_read_where_they_are_inserted() -> None:
    document, space = _drawing()
    inner = document.blocks.new("INNER")
    inner.add_line((0, 0), (50, 0), dxfattribs={"layer": "nested"})
    outer = document.blocks.new("OUTER", base_point=(10, 0))
    outer.add_lwpolyline([(10, 0), (110, 0)], dxfattribs={"layer": "own"})
    outer.add_line((10, 4), (110, 4))  # on layer 0: on the layer of the reference
    outer.add_blockref("INNER", (10, 8), dxfattribs={"rotation": 90})
    space.add_blockref(
        "OUTER", (1000, 500), dxfattribs={"layer": "host", "rotation": 90, "xscale": 2, "yscale": 2, "zscale": 2}
    )
    found = _centres(_read(document))
    assert found["own"] == [[1000, 500], [1000, 700]]
    assert found["host"] == [[992, 500], [992, 700]]
    assert found["nested"] == [[984, 500], [884, 500]]


@pytest.mark.parametrize(("xscale", "yscale"), [(1, -1), (-1, 1), (-2, 2)])
def test_arcs_of_mirrored_blocks_turn_to_the_other_side(xscale: int, yscale: int) -> None:
    document, space = _drawing()
    block = document.blocks.new("B")
    block.add_lwpolyline([(0, 0, 0), (100, 0, BULGE_90), (120, 20, 0)], format="xyb", dxfattribs={"layer": "A"})
    block.add_line((0, 50), (100, 50), dxfattribs={"layer": "L"})
    block.add_arc((100, 70), 20, 270, 360, dxfattribs={"layer": "L"})
    space.add_blockref("B", (1000, 0), dxfattribs={"xscale": xscale, "yscale": yscale, "zscale": abs(xscale)})
    size = abs(xscale)
    for lane, y in zip(_read(document).lanes, (20, 70), strict=True):
        assert _on_circle(lane, (1000 + 100 * xscale, y * yscale), 20 * size) < 1e-6
        assert lane.curvature_per_m is not None
        turns = lane.curvature_per_m[lane.curvature_per_m != 0]
        np.testing.assert_allclose(turns, -1 / (20 * size), rtol=1e-9)


def test_rows_of_a_block_are_lanes_beside_each_other() -> None:
    document, space = _drawing()
    document.blocks.new("LANE").add_line((0, 0), (90, 0), dxfattribs={"layer": "A"})
    space.add_blockref("LANE", (0, 0), dxfattribs={"row_count": 3, "row_spacing": 3.5})
    assert [ends[0][1] for ends in _centres(_read(document)).values()] == [0.0, 3.5, 7.0]


def test_rows_of_a_block_are_scaled_with_the_block_that_holds_them() -> None:
    document, space = _drawing()
    document.blocks.new("LANE").add_line((0, 0), (90, 0), dxfattribs={"layer": "A"})
    rows = {"row_count": 3, "row_spacing": 3.5}
    document.blocks.new("LANES").add_blockref("LANE", (0, 0), dxfattribs=rows)
    space.add_blockref("LANES", (0, 0), dxfattribs={"xscale": 2, "yscale": -2})
    assert [ends[0][1] for ends in _centres(_read(document)).values()] == [0.0, -7.0, -14.0]


def test_turned_blocks_in_a_block_with_unequal_scales_are_refused() -> None:
    """They are sheared; ezdxf scales them along the wrong axis."""
    document, space = _drawing()
    document.blocks.new("LANE").add_line((0, 0), (90, 0), dxfattribs={"layer": "A"})
    inner = document.blocks.new("LANES").add_blockref("LANE", (0, 0))
    space.add_blockref("LANES", (0, 0), dxfattribs={"xscale": 2})
    assert _centres(_read(document)) == {"A": [[0.0, 0.0], [180.0, 0.0]]}
    inner.dxf.rotation = 90
    with pytest.raises(UnreadableUpload, match="holds blocks that are turned"):
        _read(document)


def test_events_in_rows_and_in_mirrored_planes_are_where_they_are_drawn() -> None:
    document, space = _drawing()
    space.add_line((0, 0), (90, 0), dxfattribs={"layer": "A"})
    document.blocks.new("SIGN").add_circle((0, 0), 0.3)
    rows = {"layer": "stop_line", "column_count": 2, "column_spacing": 10.0, "extrusion": (0, 0, -1)}
    space.add_blockref("SIGN", (-30, 1), dxfattribs=rows)
    assert [event.point for event in _read(document).events] == [(30.0, 1.0), (20.0, 1.0)]


@pytest.mark.parametrize(
    "attributes",
    [{"insert": (-45, 2), "extrusion": (0, 0, -1)}, {"insert": (0, 900), "align_point": (45, 2), "halign": 1}],
)
def test_mirrored_and_aligned_texts_name_the_lane_beside_them(attributes: dict[str, Any]) -> None:
    document, space = _drawing()
    space.add_line((0, 0), (90, 0), dxfattribs={"layer": "A"})
    space.add_text("N7", dxfattribs={"layer": "A", **attributes})
    assert [lane.name for lane in _read(document).lanes] == ["N7"]


def test_the_case_of_names_of_layers_does_not_count() -> None:
    document, space = _drawing()
    space.add_line((0, 0), (90, 0), dxfattribs={"layer": "Lane"})
    space.add_line((90, 0), (180, 5), dxfattribs={"layer": "LANE"})
    assert _centres(_read(document)) == {"Lane": [[0.0, 0.0], [180.0, 5.0]]}


def test_lines_at_height_0_beside_others_with_heights_have_none() -> None:
    document, space = _drawing()
    space.add_line((0, 0), (90, 0), dxfattribs={"layer": "A"})
    assert _heights(_read(document)) == {"A": [0.0, 0.0]}, "a drawing in plan; build_alignment drops its heights"
    space.add_line((0, 9, 210), (90, 9, 211), dxfattribs={"layer": "B"})
    file = _read(document)
    heights = _heights(file)
    assert np.isnan(heights["A"]).all()
    assert heights["B"] == [210, 211]
    assert any("1 line at height 0 read without heights" in warning for warning in file.warnings)


def test_units_that_no_survey_has_need_a_declared_one() -> None:
    document, space = _drawing(13)
    space.add_line((0, 0), (90, 0))
    with pytest.raises(UnreadableUpload, match="INSUNITS is 13"):
        _read(document)
    assert _read(document, unit="m").unit_m == 1.0
    document.header["$INSUNITS"] = 23
    assert _read(document).unit_m == pytest.approx(3600 / 3937)


def test_characters_beside_the_code_page_are_read() -> None:
    document, space = _drawing()
    space.add_line((0, 0), (90, 0), dxfattribs={"layer": "O_ L_ka"})
    stream = io.StringIO()
    document.write(stream)
    data = stream.getvalue().replace("O_ L_ka", "O\\U+015B \\U+0141\\U+00F3dka").encode()
    assert [lane.name for lane in read_alignment(data).lanes] == ["Oś Łódka"]


def test_layers_of_bound_references_have_their_own_names() -> None:
    document, space = _drawing()
    block = document.blocks.new("plan")
    block.add_line((0, 3.5), (90, 3.5), dxfattribs={"layer": "plan$0$Lane3_left"})
    block.add_line((0, 0), (90, 0), dxfattribs={"layer": "plan$0$Lane3_right"})
    block.add_line((40, -2), (40, 2), dxfattribs={"layer": "base$1$plan$0$stop-line"})
    block.add_circle((20, 0), 0.4, dxfattribs={"layer": "plan$0$Manholes"})
    space.add_blockref("plan", (500, 0))
    file = _read(document)
    (lane,) = file.lanes
    assert lane.name == "Lane3"
    assert lane.left is not None
    assert lane.left[0, :2].tolist() == [500, 3.5]
    assert [(event.kind, event.point) for event in file.events] == [(EventKind.STOP_LINE, (540.0, 0.0))]
    assert [area.kind for area in file.areas] == ["manholes"]


def test_symbols_are_no_lanes_but_events_and_areas() -> None:
    document, space = _drawing()
    space.add_line((0, 0), (90, 0), dxfattribs={"layer": "road"})
    arrow = document.blocks.new("ARROW")
    arrow.add_line((0, 0), (0, 2))
    arrow.add_attdef("VALUE", (0, 0))
    cover = document.blocks.new("COVER")
    cover.add_circle((0, 0), 0.4)
    space.add_blockref("ARROW", (10, 30), dxfattribs={"layer": "symbols"})
    space.add_blockref("ARROW", (30, 0), dxfattribs={"layer": "arrow"}).add_attrib("VALUE", "left", (30, 0))
    space.add_blockref("COVER", (50, 0), dxfattribs={"layer": "manholes"})
    space.add_blockref("NOWHERE", (50, 50))
    file = _read(document)
    assert [lane.name for lane in file.lanes] == ["road"]
    assert [(event.kind, event.point, event.value) for event in file.events] == [(EventKind.ARROW, (30.0, 0.0), "left")]
    assert [area.ring.mean(axis=0).round(1).tolist() for area in file.areas] == [[50.0, 0.0]]
    assert [warning for warning in file.warnings if "symbols" in warning] == list(file.warnings)


def test_symbols_are_small_however_deep_blocks_are_nested() -> None:
    """Each level holds the one below a thousand times: measuring it as a symbol would not end."""
    document, space = _drawing()
    space.add_line((0, 0), (90, 0), dxfattribs={"layer": "road"})
    document.blocks.new("L0").add_line((0, 0), (0.001, 0))
    for level in range(1, 5):
        block = document.blocks.new(f"L{level}")
        block.add_blockref(f"L{level - 1}", (0, 0), dxfattribs={"row_count": 1000, "row_spacing": 1e-6})
    space.add_blockref("L4", (10, 0), dxfattribs={"layer": "plan"})
    with pytest.raises(UnreadableUpload, match="its blocks hold over"):
        _read(document)


def test_blocks_on_hidden_layers_are_left_out() -> None:
    document, space = _drawing()
    document.layers.add("frozen").freeze()
    document.layers.add("off").off()
    block = document.blocks.new("B")
    block.add_line((0, 0), (90, 0))
    block.add_line((0, 4), (90, 4), dxfattribs={"layer": "own"})
    space.add_blockref("B", (0, 0), dxfattribs={"layer": "frozen"})
    space.add_blockref("B", (0, 100), dxfattribs={"layer": "off"})  # as CAD: only entities on layer 0 are switched off
    file = _read(document)
    assert _centres(file) == {"own": [[0, 104], [90, 104]]}
    assert "The layers frozen, off are frozen or switched off" in file.warnings[0]


def test_blocks_that_cannot_be_read_are_reported() -> None:
    document, space = _drawing()
    space.add_line((0, 0), (90, 0), dxfattribs={"layer": "A"})
    document.add_xref_def("other.dwg", "other")
    space.add_blockref("other", (0, 0))
    block = document.blocks.new("B")
    block.add_lwpolyline([(0, 30, 0), (100, 30, BULGE_90), (120, 50, 0)], format="xyb", dxfattribs={"layer": "A"})
    space.add_blockref("B", (0, 0), dxfattribs={"xscale": 2})  # arcs become ellipses
    warnings = " ".join(_read(document).warnings)
    assert "1 reference to other drawings left out, the first is other; bind" in warnings
    assert "left out: ellipses (1 in all), the first on layer A" in warnings
    loop = document.blocks.new("LOOP")
    loop.add_line((0, 0), (90, 0))
    loop.add_blockref("LOOP", (9, 9))
    space.add_blockref("LOOP", (0, 0))
    with pytest.raises(UnreadableUpload, match="DXF cannot be used"):
        _read(document)


# --- fitted polylines -------------------------------------------------------------------------------------------------

_FRAME = [(0, 0), (70, 80), (130, -60), (200, 20)]


@pytest.mark.parametrize("three_d", [False, True])
def test_the_frame_of_a_spline_is_not_on_the_line(three_d: bool) -> None:
    """AutoCAD's PEDIT stores the fitted vertices (flag 8) after those of the frame (flag 16)."""
    document, space = _drawing()
    x = np.linspace(0, 200, 21)
    fitted = [(float(a), float(20 * np.sin(a / 32))) for a in x]
    add = space.add_polyline3d if three_d else space.add_polyline2d
    line = add([(*point, 0) if three_d else point for point in _FRAME + fitted], dxfattribs={"layer": "A"})
    line.dxf.flags |= 4
    for k, vertex in enumerate(line.vertices):
        vertex.dxf.flags |= 16 if k < len(_FRAME) else 8
    (lane,) = _read(document).lanes
    assert lane.centre is not None
    np.testing.assert_allclose(lane.centre[:, :2], fitted, atol=1e-9)


def test_vertices_of_fitted_arcs_are_on_the_line() -> None:
    document, space = _drawing()
    points = [(0, 0, BULGE_90 / 2), (100, 0, BULGE_90), (120, 20, 0)]
    line = space.add_polyline2d(points, format="xyb", dxfattribs={"layer": "A"})
    line.dxf.flags |= 2
    line.vertices[1].dxf.flags |= 1
    (lane,) = _read(document).lanes
    assert lane.centre is not None
    assert lane.centre[0, :2].tolist() == [0, 0]
    assert np.abs(lane.centre[:, :2] - (100, 0)).sum(axis=1).min() == 0.0


def test_multilines_are_reported() -> None:
    document, space = _drawing()
    space.add_line((0, 0), (90, 0))
    space.add_mline([(0, 9), (90, 9)], dxfattribs={"layer": "M"})
    space.add_ellipse((0, 50), (40, 0), 0.5, dxfattribs={"layer": "E"})
    assert _read(document).warnings[0].startswith("left out: multilines and ellipses (2 in all), the first on layer M")


@pytest.mark.parametrize(
    ("page", "encoding", "name"),
    [("ANSI_936", "gbk", "车道"), ("ANSI_932", "cp932", "車線"), ("ANSI_1251", "cp1251", "Полоса")],
)
def test_names_of_old_drawings_are_in_their_code_page(page: str, encoding: str, name: str) -> None:
    document = ezdxf.new("R2000")
    document.modelspace().add_line((0, 0), (90, 0), dxfattribs={"layer": "LANE"})
    stream = io.StringIO()
    document.write(stream)
    text = stream.getvalue().replace("ANSI_1252", page).replace("LANE", name)
    (lane,) = read_alignment(text.encode(encoding)).lanes
    assert lane.name == name


# --- units ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("code", "declared", "metres", "note"),
    [
        (2, {"crs": "EPSG:6539"}, 1200 / 3937, "read as ft-us, the unit of NAD83(2011) / New York Long Island (ftUS)"),
        (1, {"crs": "EPSG:6539"}, 100 / 3937, "read as ft-us"),
        (2, {"crs": "EPSG:2222"}, 0.3048, "read as ft-intl, the unit of NAD83 / Arizona East (ft)"),
        (2, {"crs": "EPSG:26918"}, 0.3048, "read as ft-intl, because the CRS is not in feet"),
        (2, {"origin": (8.4, 49.0)}, 0.3048, "read as ft-intl, because"),
        (2, {"crs": "EPSG:6539", "unit": "ft-intl"}, 0.3048, ""),
        (2, {"crs": "EPSG:26918", "unit": "ft-us"}, 1200 / 3937, ""),
        (21, {"crs": "EPSG:2222"}, 1200 / 3937, ""),
        (4, {"unit": "m"}, 1.0, "unit of the drawing is 0.001 m ($INSUNITS 4); the coordinates were read in the decl"),
        (2, {"unit": "m"}, 1.0, "unit of the drawing is 0.3048 m ($INSUNITS 2)"),
        (0, {"unit": "ft-us"}, 1200 / 3937, ""),
        (6, {"unit": "m"}, 1.0, ""),
    ],
)
def test_feet_are_those_of_the_crs_and_a_declared_unit_counts_more(
    code: int, declared: dict[str, Any], metres: float, note: str
) -> None:
    document, space = _drawing(code)
    space.add_lwpolyline([(0, 0, 0), (300, 0, BULGE_90), (400, 100, 0)], format="xyb", dxfattribs={"layer": "A"})
    file = _read(document, **declared)
    assert file.unit_m == pytest.approx(metres, rel=1e-12)
    assert len(file.warnings) == bool(note)
    assert note in "".join(file.warnings)
    assert _chord_error(file.lanes[0], 100.0) * metres < 0.001, "arcs are sampled in the unit that is used"


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
        _read(_drawing(11)[0])


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
