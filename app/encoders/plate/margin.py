"""The margin around a plate on its sheet: its id, size, orientation and position, and a QR code to its record.

Frame: millimetres from the plate's centre, y up, a margin and its face move together.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from app.encoders.plate.drawing import Anchor, Boxes, Layer, Modules, Part, Shape, Stroke, Text, box_points
from app.encoders.plate.lettering import fitted_height_mm, text_width_mm
from app.encoders.plate.order import PlateOrder
from app.encoders.plate.qr import qr_modules
from app.markers.plate import PlateGeometry

SIDE_MARGIN_MM = 20.0
TOP_MARGIN_MM = 36.0
BOTTOM_MARGIN_MM = 72.0
BLEED_MM = 5.0
SCALE_BAR_MM = 100.0
QR_SIDE_MM = 26.0
SIDE_TOLERANCE_MM = 0.5
UNIT_TOLERANCE_MM = 0.3

_CROP_FROM_MM, _CROP_TO_MM = 7.0, 15.0
HAIRLINE_MM = 0.2
_LABEL_WIDTH_MM = 20.0
_ROW_MM = 5.2
_TEXT_MM = 2.4


@lru_cache(maxsize=64)
def fixed_margin(geometry: PlateGeometry) -> tuple[Part, ...]:
    """What the margin of every plate of a geometry shows."""
    half = geometry.side_mm / 2
    return (
        Stroke(Layer.CUT, box_points(-half, -half, half, half), HAIRLINE_MM, closed=True),
        *crop_marks(half),
        *_travel_arrow(half),
        *dimension(half, f"{geometry.side_mm:g} mm ± {SIDE_TOLERANCE_MM:g} outer edge, border gap included"),
        *_scale_bar(-half, -half - 66.0),
        *_arrow(Layer.ENGRAVE, half - QR_SIDE_MM - 7.0, -half - 27.0 - QR_SIDE_MM / 2 - 6.0, 5.0, 12.0),
        Text(Layer.NOTE, "Engrave on the back", half, -half - 62.2, 1.8, "end"),
    )


def plate_margin(order: PlateOrder) -> tuple[Part, ...]:
    """The margin's parts that depend on the plate."""
    half = order.geometry.side_mm / 2
    room = order.geometry.side_mm / 2 - 22.0
    id_mm = fitted_height_mm(order.plate_id, 5.0, room)
    digits_mm = fitted_height_mm(order.grouped_digits, 5.0, room)
    parts: list[Part] = [
        Text(Layer.NOTE, order.plate_id, -half, half + 23.0, id_mm),
        Text(Layer.NOTE, f"revision {order.revision}", -half, half + 17.5, _TEXT_MM),
        Text(Layer.NOTE, order.grouped_digits, half, half + 23.0, digits_mm, "end"),
        Text(Layer.NOTE, _scheme_line(order), half, half + 17.5, _TEXT_MM, "end"),
        *_data_rows(order, -half, -half - 29.0),
        *_back_mark(order, half, -half - 27.0),
    ]
    return tuple(parts)


def _scheme_line(order: PlateOrder) -> str:
    return f"{order.code.scheme}, {order.code.n} x {order.code.n} units"


def _data_rows(order: PlateOrder, left: float, top: float) -> list[Part]:
    geometry = order.geometry
    position = "not placed yet"
    if order.lon_deg is not None and order.lat_deg is not None:
        position = f"longitude {order.lon_deg:.8f}°, latitude {order.lat_deg:.8f}°"
    rows = (
        ("Position", position),
        ("CRS", order.crs or "not stated"),
        ("Plate size", f"unit {geometry.unit_mm:g} mm, gap {geometry.gap_mm:g} mm, {geometry.thickness_mm:g} mm thick"),
    )
    room = geometry.side_mm - QR_SIDE_MM - 14.0 - _LABEL_WIDTH_MM
    parts: list[Part] = []
    for i, (label, value) in enumerate(rows):
        y = top - i * _ROW_MM
        parts.append(Text(Layer.NOTE, label, left, y, _TEXT_MM))
        value_mm = fitted_height_mm(value, _TEXT_MM, room)
        parts.append(Text(Layer.NOTE, value, left + _LABEL_WIDTH_MM, y, value_mm))
    return parts


def _back_mark(order: PlateOrder, right: float, top: float) -> list[Part]:
    """Id and QR that are engraved on the back, since the face carries no text."""
    id_mm = fitted_height_mm(order.plate_id, 2.4, QR_SIDE_MM + 10.0)
    parts: list[Part] = [Text(Layer.ENGRAVE, order.plate_id, right, top - QR_SIDE_MM - 5.6, id_mm, "end")]
    if order.record_url:
        parts.append(qr_code(order.record_url, right - QR_SIDE_MM, top))
    else:
        why = "no public address" if order.registered else "a draft, not registered"
        parts += no_qr_code(right, top - QR_SIDE_MM / 2, "end", why)
    return parts


def no_qr_code(x: float, y: float, anchor: Anchor, why: str = "no public address") -> list[Part]:
    """The note in place of a QR code, which is not engraved."""
    lines = ("No QR code:", why)
    return [Text(Layer.NOTE, line, x, y - k * 3.6, 2.0, anchor) for k, line in enumerate(lines)]


def qr_code(url: str, left: float, top: float) -> Modules:
    """QR code of an address, by the place of its upper left corner."""
    modules = qr_modules(url).astype(np.int8)
    edges = np.diff(np.pad(modules, ((0, 0), (1, 1))), axis=1)
    row, start = np.nonzero(edges == 1)
    count = np.nonzero(edges == -1)[1] - start
    runs = tuple(zip(row.tolist(), start.tolist(), count.tolist(), strict=True))
    return Modules(Layer.ENGRAVE, runs, QR_SIDE_MM / len(modules), left, top)


def crop_marks(half: float) -> list[Part]:
    """Marks at the corners of a square of this half side."""
    marks: list[Part] = []
    for sx in (-1, 1):
        for sy in (-1, 1):
            for ends in (
                [(sx * half, sy * (half + _CROP_FROM_MM)), (sx * half, sy * (half + _CROP_TO_MM))],
                [(sx * (half + _CROP_FROM_MM), sy * half), (sx * (half + _CROP_TO_MM), sy * half)],
            ):
                marks.append(Stroke(Layer.CROP, np.array(ends, dtype=np.float64), HAIRLINE_MM))
    return marks


def _arrow(layer: Layer, x: float, bottom: float, width: float, height: float) -> list[Part]:
    shaft, head = width / 6, height / 2
    outline = [
        (x, bottom + height),
        (x + width / 2, bottom + height - head),
        (x + shaft, bottom + height - head),
        (x + shaft, bottom),
        (x - shaft, bottom),
        (x - shaft, bottom + height - head),
        (x - width / 2, bottom + height - head),
    ]
    return [Shape(layer, np.array(outline, dtype=np.float64))]


def _travel_arrow(half: float) -> list[Part]:
    bottom = half + 14.0
    return [*_arrow(Layer.NOTE, 0.0, bottom, 8.0, 14.0), Text(Layer.NOTE, "travel", 0.0, bottom - 4.0, 2.0, "middle")]


def dimension(half: float, label: str) -> list[Part]:
    """Dimension line under the plate, broken by its label, with arrowheads that touch the plate's edges."""
    y, height = -half - 20.0, 2.4
    clear = text_width_mm(label, height) / 2 + 3.0
    parts: list[Part] = [Text(Layer.NOTE, label, 0.0, y - height / 2, height, "middle")]
    for side in (-1.0, 1.0):
        tip = side * half
        parts += [
            Stroke(Layer.NOTE, np.array([(tip - side * 3.0, y), (side * clear, y)]), HAIRLINE_MM),
            Shape(Layer.NOTE, np.array([(tip, y), (tip - side * 3.0, y + 0.8), (tip - side * 3.0, y - 0.8)])),
            Stroke(Layer.NOTE, np.array([(tip, y + 2.5), (tip, y - 2.5)]), HAIRLINE_MM),
        ]
    return parts


def _scale_bar(left: float, bottom: float) -> list[Part]:
    """100 mm in ten blocks, every other one filled."""
    blocks = left + 20.0 * np.arange(5)
    boxes = np.stack([blocks, np.full(5, bottom), blocks + 10.0, np.full(5, bottom + 2.5)], axis=1)
    frame = box_points(left, bottom, left + SCALE_BAR_MM, bottom + 2.5)
    labels = [Text(Layer.NOTE, f"{x}", left + x, bottom + 4.0, 1.8, "middle") for x in (50, 100)]
    return [
        Boxes(Layer.NOTE, boxes),
        Stroke(Layer.NOTE, frame, HAIRLINE_MM, closed=True),
        Text(Layer.NOTE, "0", left, bottom + 4.0, 1.8, "middle"),
        *labels,
        Text(Layer.NOTE, "mm", left + SCALE_BAR_MM + 3.0, bottom + 0.4, 1.8),
    ]
