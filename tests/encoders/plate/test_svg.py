"""The SVG is parsed and measured in millimetres."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Callable

import numpy as np
import pytest

from app.encoders.plate import ArtworkOptions, PlateOrder, encode_plate, write_svg
from app.markers.plate import PlateCode, PlateGeometry

SVG = "{http://www.w3.org/2000/svg}"
GEOMETRIES = [
    PlateGeometry(),
    PlateGeometry(8, 20, 2, 5),
    PlateGeometry(8, 50, 10, 50),
    PlateGeometry(10, 37.5, 2.5),
    PlateGeometry(12, 35, 5),
]


def _group(root: ET.Element, layer: str) -> ET.Element:
    found = root.findall(f"{SVG}g[@id='{layer}']")
    assert len(found) == 1
    return found[0]


def _boxes(path: str) -> set[tuple[float, float, float, float]]:
    """(left, top, width, height) of the rectangles of a path."""
    boxes = set()
    for piece in re.findall(r"M([^MZ]*)Z", path):
        x, y, right, bottom, back = (float(v) for v in re.split(r"[ HV]", piece))
        assert back == x
        boxes.add((round(x, 3), round(y, 3), round(right - x, 3), round(bottom - y, 3)))
    return boxes


def _polygons(path: str) -> list[np.ndarray]:
    return [
        np.array([[float(v) for v in point.split()] for point in piece.split("L")])
        for piece in re.findall(r"M([^MZ]*)Z", path)
    ]


@pytest.mark.parametrize("geometry", GEOMETRIES, ids=lambda g: f"{g.n}x{g.unit_mm}+{g.gap_mm}")
def test_every_unit_lies_where_the_geometry_says(
    geometry: PlateGeometry, make_order: Callable[..., PlateOrder]
) -> None:
    n, unit, gap = geometry.n, geometry.unit_mm, geometry.gap_mm
    code = PlateCode.from_registry_number(0xC0FFEE42, n=n)
    root = ET.fromstring(write_svg(encode_plate(make_order(code, geometry))))
    width, height = (float(root.attrib[k].removesuffix("mm")) for k in ("width", "height"))
    assert root.attrib["width"].endswith("mm")
    assert [float(v) for v in root.attrib["viewBox"].split()] == [0, 0, width, height]

    cut = _polygons(_group(root, "CUT").find(f"{SVG}path").attrib["d"])[0]
    left, top = cut.min(axis=0)
    side = n * unit + (n + 1) * gap
    assert np.ptp(cut, axis=0) == pytest.approx([side, side], abs=1e-3)

    dark, light = (_boxes(_group(root, k).find(f"{SVG}path").attrib["d"]) for k in ("CODE_DARK", "CODE_LIGHT"))
    expected: dict[bool, set[tuple[float, float, float, float]]] = {True: set(), False: set()}
    cells = [(r, c) for r in range(n // 2) for c in range(n // 2)]
    corners = {(r, c) for r in (0, n // 2 - 1) for c in (0, n // 2 - 1)}
    for digit, (r, c) in zip(code.digits, [cell for cell in cells if cell not in corners], strict=True):
        for k, bit in enumerate(f"{int(digit, 16):04b}"):
            x = left + gap + (2 * c + k % 2) * (unit + gap)
            y = top + gap + (2 * r + k // 2) * (unit + gap)
            expected[bit == "1"].add((round(x, 3), round(y, 3), round(unit, 3), round(unit, 3)))
    assert dark == expected[True]
    assert light == expected[False]


def test_markers_cover_two_units_and_their_gap(make_order: Callable[..., PlateOrder]) -> None:
    drawing = encode_plate(make_order())
    root = ET.fromstring(write_svg(drawing))
    left, top = drawing.trim_mm[0][0], drawing.height_mm - drawing.trim_mm[0][3]
    (triangle,) = _polygons(_group(root, "MARK_RED").find(f"{SVG}path").attrib["d"])
    assert sorted((triangle - [left, top]).tolist()) == [[5, 5], [5, 80], [80, 5]]  # right angle at the corner
    squares = _boxes(_group(root, "MARK_GREEN").find(f"{SVG}path").attrib["d"])
    bounds = sorted((x - left, y - top, width, height) for x, y, width, height in squares)
    assert np.array(bounds) == pytest.approx(np.array([[5, 245, 75, 75], [245, 5, 75, 75], [245, 245, 75, 75]]))


def test_scale_bar_is_100_mm(make_order: Callable[..., PlateOrder]) -> None:
    root = ET.fromstring(write_svg(encode_plate(make_order())))
    frames = [
        np.ptp(polygon, axis=0)
        for path in _group(root, "NOTE").findall(f"{SVG}path[@stroke]")
        for polygon in _polygons(path.attrib["d"])
    ]
    assert any(frame == pytest.approx([100, 2.5]) for frame in frames)


def test_no_text_needs_a_font_and_none_is_on_the_face(make_order: Callable[..., PlateOrder]) -> None:
    order = make_order(plate_id="<b>&\"'", crs="Ω <&> é")
    drawing = encode_plate(order, ArtworkOptions(heaters=True, leds=True))
    root = ET.fromstring(write_svg(drawing))
    assert not root.findall(f".//{SVG}text")
    left, bottom, right, top = drawing.trim_mm[0]
    for path in root.findall(f".//{SVG}path[@transform]"):
        *_, x, y = (float(v) for v in path.attrib["transform"][7:-1].split())
        assert not (left < x < right and bottom < drawing.height_mm - y < top)


def test_writing_twice_gives_the_same_bytes(make_order: Callable[..., PlateOrder]) -> None:
    assert write_svg(encode_plate(make_order())) == write_svg(encode_plate(make_order()))
