"""The DXF is read by ezdxf and measured in millimetres."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Callable

import ezdxf
import numpy as np
import pytest
from ezdxf.audit import Auditor
from shapely.geometry import Polygon

from app.encoders.plate import ArtworkOptions, PlateOrder, encode_plate, write_dxf
from app.markers.plate import PlateCode, PlateGeometry

ALL = ArtworkOptions(heaters=True, leds=True)


def _read(content: bytes) -> ezdxf.document.Drawing:
    return ezdxf.read(io.StringIO(content.decode()))


def _closed(document: ezdxf.document.Drawing, layer: str) -> list[Polygon]:
    lines = document.modelspace().query(f'LWPOLYLINE[layer=="{layer}"]')
    assert all(line.closed for line in lines)
    return [Polygon([(x, y) for x, y, *_ in line.get_points()]) for line in lines]


@pytest.mark.parametrize(
    "geometry", [PlateGeometry(), PlateGeometry(10, 20, 2), PlateGeometry(12, 32.5, 4.5)], ids=lambda g: f"n{g.n}"
)
def test_layers_hold_closed_lines_at_true_size(geometry: PlateGeometry, make_order: Callable[..., PlateOrder]) -> None:
    n, unit, gap = geometry.n, geometry.unit_mm, geometry.gap_mm
    code = PlateCode.from_position(114.1793123, 22.3045678, n=n)
    drawing = encode_plate(make_order(code, geometry), ALL)
    document = _read(write_dxf(drawing))
    assert document.header["$INSUNITS"] == 4
    names = {layer.dxf.name for layer in document.layers}
    assert {"CUT", "CODE_DARK", "MARK_RED", "MARK_GREEN", "ENGRAVE", "HEATER", "NOTE"} <= names

    (cut,) = _closed(document, "CUT")
    assert cut.bounds == pytest.approx(drawing.trim_mm[0])
    left, top = cut.bounds[0], cut.bounds[3]
    dark = _closed(document, "CODE_DARK")
    assert len(dark) == sum(int(d).bit_count() for d in code.digits)
    grid = np.zeros((n, n), dtype=int)
    for square in dark:
        assert square.area == pytest.approx(unit**2)
        col, row = (square.bounds[0] - left - gap) / (unit + gap), (top - gap - square.bounds[3]) / (unit + gap)
        assert (row, col) == pytest.approx((round(row), round(col)), abs=1e-6)
        grid[round(row), round(col)] = 1
    assert (grid == code.units).all()

    marker = 2 * unit + gap
    (triangle,) = _closed(document, "MARK_RED")
    assert triangle.area == pytest.approx(marker**2 / 2)
    assert triangle.bounds == pytest.approx((left + gap, top - gap - marker, left + gap + marker, top - gap))
    assert [p.area for p in _closed(document, "MARK_GREEN")] == pytest.approx([marker**2] * 3)


def test_a_heater_lies_under_every_dark_unit_and_marker_and_leds_under_the_light(
    make_order: Callable[..., PlateOrder],
) -> None:
    document = _read(write_dxf(encode_plate(make_order(), ALL)))
    dark, light = _closed(document, "CODE_DARK"), _closed(document, "CODE_LIGHT")
    markers = _closed(document, "MARK_RED") + _closed(document, "MARK_GREEN")
    heaters, leds = _closed(document, "HEATER"), _closed(document, "LED")
    assert all(heater.is_valid for heater in heaters)
    assert len(heaters) == len(dark) + len(markers)
    assert all(sum(area.covers(heater) for heater in heaters) == 1 for area in dark + markers)
    assert all(sum(area.covers(led) for led in leds) == 4 for area in light)
    assert all(sum(area.covers(led) for led in leds) >= 1 for area in markers)
    assert not any(heater.intersects(led) for heater in heaters for led in leds)
    assert [led.area for led in leds] == pytest.approx([25.0] * len(leds))


def test_engraved_qr_is_merged_and_keeps_its_area(make_order: Callable[..., PlateOrder]) -> None:
    drawing = encode_plate(make_order())
    document = _read(write_dxf(drawing))
    engraved = _closed(document, "ENGRAVE")
    right, bottom = drawing.trim_mm[0][2], drawing.trim_mm[0][1]
    qr = [p for p in engraved if p.bounds[0] >= right - 26.001 and p.bounds[1] >= bottom - 27 - 26.001]
    area = 0.0
    for ring in sorted(qr, key=lambda p: -p.area):  # even-odd: rings inside rings are holes
        depth = sum(other.contains(ring.representative_point()) for other in qr if other is not ring)
        area += ring.area if depth % 2 == 0 else -ring.area
    modules = area / (26 / 37) ** 2
    assert modules == pytest.approx(round(modules), abs=1e-3)
    assert 0.4 < modules / 37**2 < 0.6
    assert len(qr) < 300  # runs of a row would be more


def test_it_audits_clean_and_writing_twice_gives_the_same_bytes(make_order: Callable[..., PlateOrder]) -> None:
    content = write_dxf(encode_plate(make_order(), ALL))
    auditor: Auditor = _read(content).audit()
    assert not auditor.errors
    assert content == write_dxf(encode_plate(make_order(), ALL))


def test_without_options_nothing_lies_under_the_face(make_order: Callable[..., PlateOrder]) -> None:
    space = _read(write_dxf(encode_plate(make_order()))).modelspace()
    layers = Counter(entity.dxf.layer for entity in space)
    assert "HEATER" not in layers
    assert "LED" not in layers
    assert layers["MARK_GREEN"] == 3
