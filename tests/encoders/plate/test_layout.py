"""Nothing overlaps on a sheet, nothing leaves it, and nested plates keep apart."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest
import segno
from shapely import MultiPoint
from shapely.geometry import Polygon, box

from app.encoders.plate import ArtworkOptions, Drawing, PlateOrder, encode_plate, encode_sheets, quality_sheets
from app.encoders.plate.drawing import Boxes, Layer, Modules, Shape, Stroke, Text, contours_mm
from app.encoders.plate.face import qr_modules
from app.markers.plate import PlateCode, PlateGeometry

SMALLEST = PlateGeometry(8, 20, 2, 5)


def _extents(drawing: Drawing) -> list[tuple[str, Polygon]]:
    """What each thing of the margin covers, by name."""
    extents = []
    for part in drawing.parts:
        if part.layer not in (Layer.NOTE, Layer.ENGRAVE):
            continue
        if isinstance(part, Text):
            extents.append((part.text, box(*MultiPoint(np.vstack(contours_mm(part))).bounds)))
        elif isinstance(part, Modules):
            quiet = 4 * part.module_mm
            extents.append(("QR", box(*part.boxes_mm.min(axis=0)[:2], *part.boxes_mm.max(axis=0)[2:]).buffer(quiet)))
        elif isinstance(part, Boxes):
            extents.append(("scale bar", box(*part.boxes_mm.min(axis=0)[:2], *part.boxes_mm.max(axis=0)[2:])))
        elif isinstance(part, Shape):
            extents.append(("arrow", box(*MultiPoint(part.points_mm).bounds)))
    return extents


@pytest.mark.parametrize(
    ("code", "geometry"),
    [
        (PlateCode("023792168411"), SMALLEST),
        (PlateCode("023792168411"), PlateGeometry()),
        (PlateCode.from_registry_number(2**48 - 1, n=10), PlateGeometry(10, 20, 2)),
        (PlateCode.from_registry_number(2**64 - 1, n=12), PlateGeometry(12, 20, 2)),
    ],
    ids=["8-small", "8", "10", "12"],
)
@pytest.mark.parametrize("plate_id", ["A", "W" * 64], ids=["short", "long"])
@pytest.mark.parametrize("without_qr", [{}, {"record_url": ""}], ids=["QR", "no QR"])
def test_the_margin_is_uncluttered(
    code: PlateCode,
    geometry: PlateGeometry,
    plate_id: str,
    without_qr: dict[str, str],
    make_order: Callable[..., PlateOrder],
) -> None:
    drawing = encode_plate(make_order(code, geometry, plate_id=plate_id, crs="W" * 80, **without_qr))
    extents = _extents(drawing)
    assert len(extents) > 15
    sheet, face = box(0, 0, drawing.width_mm, drawing.height_mm), box(*drawing.trim_mm[0])
    for name, extent in extents:
        assert sheet.covers(extent), name
        assert not face.buffer(drawing.bleed_mm).intersects(extent), name
    for (first, a), (second, b) in itertools.combinations(extents, 2):
        assert not a.intersects(b), (first, second)


def test_crop_marks_point_at_the_corners_and_stay_out_of_the_bleed(make_order: Callable[..., PlateOrder]) -> None:
    drawing = encode_plate(make_order())
    left, bottom, right, top = drawing.trim_mm[0]
    marks = [part.points_mm for part in drawing.parts if isinstance(part, Stroke) and part.layer is Layer.CROP]
    assert len(marks) == 8
    bleed = box(left - 5, bottom - 5, right + 5, top + 5)
    for mark in marks:
        on_x, on_y = np.ptp(mark[:, 0]) == 0, np.ptp(mark[:, 1]) == 0
        assert on_x != on_y
        assert (mark[0, 0] in (left, right)) if on_x else (mark[0, 1] in (bottom, top))
        assert bleed.distance(MultiPoint(mark)) >= 1.0


def test_the_quality_sheet_is_uncluttered(make_order: Callable[..., PlateOrder]) -> None:
    orders = [make_order(plate_id=f"{k} " + "W" * 60) for k in range(4)]
    pages = quality_sheets(orders)
    assert len(pages) == 3
    for page in pages:
        extents = [(n, e) for n, e in _extents(page) if n not in ("arrow", "scale bar")]
        for (first, a), (second, b) in itertools.combinations(extents, 2):
            assert not a.intersects(b), (first, second)
        assert all(box(10, 10, 200, 290).covers(extent) for _, extent in extents)


def test_sheets_hold_every_plate_once_and_apart(make_order: Callable[..., PlateOrder]) -> None:
    codes = [PlateCode.from_registry_number(k) for k in range(1, 8)]
    orders = [make_order(code, plate_id=f"P{k}") for k, code in enumerate(codes)]
    sheets = encode_sheets(orders, width_mm=800, height_mm=900, options=ArtworkOptions(leds=True))
    assert [len(sheet.trim_mm) for sheet in sheets] == [4, 3]
    for sheet in sheets:
        plates = [box(*trim) for trim in sheet.trim_mm]
        whole = box(0, 0, sheet.width_mm, sheet.height_mm)
        assert all(whole.covers(plate) for plate in plates)
        assert all(a.distance(b) >= 2 * sheet.bleed_mm for a, b in itertools.combinations(plates, 2))
    ids = [part.text for sheet in sheets for part in sheet.parts if isinstance(part, Text) and part.height_mm == 5.0]
    assert [text for text in ids if text.startswith("P")] == [f"P{k}" for k in range(7)]


def test_plates_of_different_sizes_share_a_sheet(make_order: Callable[..., PlateOrder]) -> None:
    orders = [make_order(), make_order(geometry=SMALLEST), make_order()]
    (sheet,) = encode_sheets(orders, width_mm=1100, height_mm=500)
    assert [round(right - left) for left, _, right, _ in sheet.trim_mm] == [325, 178, 325]
    extents = _extents(sheet)
    for (first, a), (second, b) in itertools.combinations(extents, 2):
        assert not a.intersects(b), (first, second)


def test_qr_codes_of_a_selection_are_those_of_segno() -> None:
    rng = np.random.default_rng(7)
    for k in range(150):
        url = "https://waymark.example/v1/markers/" + rng.bytes(5).hex() + ("~" if k % 2 else "/")
        direct = segno.make(url, error="m", mode="byte", micro=False, mask=2, boost_error=False)
        assert np.array_equal(qr_modules(url), np.array(direct.matrix)), url
