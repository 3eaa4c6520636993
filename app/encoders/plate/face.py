"""The plate itself: base, units, boundary markers, and what lies under them.

Plate frame of app/markers/plate.py, millimetres from the plate's centre, y up.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import shapely
from shapely.geometry import LineString, Polygon, box

from app.encoders.plate.drawing import Boxes, FloatArray, Layer, Part, Shape, box_points
from app.encoders.plate.order import ArtworkOptions
from app.markers.plate import PlateCode, PlateGeometry, unit_index

LED_SIDE_MM = 5.0
TRACK_MM = 3.0
_TRACK_GAP_MM = 2.0
_HEATER_INSET_MM = 2.0
_TERMINAL_GAP_MM = 6.0


@lru_cache(maxsize=64)
def unit_boxes_mm(geometry: PlateGeometry) -> FloatArray:
    """Left, bottom, right, top of every unit, row by row from the top, shape (n * n, 4). [mm]"""
    start = -geometry.side_mm / 2 + geometry.gap_mm + geometry.pitch_mm * np.arange(geometry.n)
    left, top = np.meshgrid(start, -start)
    boxes = np.stack([left, top - geometry.unit_mm, left + geometry.unit_mm, top], axis=-1).reshape(-1, 4)
    boxes.flags.writeable = False
    return boxes


@lru_cache(maxsize=64)
def marker_shapes_mm(geometry: PlateGeometry) -> tuple[FloatArray, ...]:
    """Corner areas clockwise from the red triangle (3 points, its right angle first), then three squares. [mm]

    A marker covers its two by two units and the gap between them.
    """
    side = 2 * geometry.unit_mm + geometry.gap_mm
    edge = geometry.side_mm / 2 - geometry.gap_mm
    triangle = np.array([(-edge, edge), (-edge + side, edge), (-edge, edge - side)])
    return (
        triangle,
        box_points(edge - side, edge - side, edge, edge),
        box_points(edge - side, -edge, edge, -edge + side),
        box_points(-edge, -edge, -edge + side, -edge + side),
    )


@lru_cache(maxsize=64)
def fixed_face(geometry: PlateGeometry, options: ArtworkOptions) -> tuple[Part, ...]:
    """What every plate of a geometry has, whatever its code."""
    half = geometry.side_mm / 2
    triangle, *squares = marker_shapes_mm(geometry)
    parts: list[Part] = [
        Boxes(Layer.BASE, np.array([[-half, -half, half, half]])),
        Shape(Layer.MARK_RED, triangle),
        Boxes(Layer.MARK_GREEN, np.array([[*square.min(axis=0), *square.max(axis=0)] for square in squares])),
    ]
    if options.heaters:
        parts += [Shape(Layer.HEATER, _heater_loop(marker)) for marker in (triangle, *squares)]
    if options.leds:
        parts.append(_marker_leds(geometry))
    return tuple(parts)


def code_face(code: PlateCode, geometry: PlateGeometry, options: ArtworkOptions) -> tuple[Part, ...]:
    """Units of one code, and the heaters and light sources under them."""
    coded = unit_index(geometry.n).reshape(-1)
    dark = code.units.reshape(-1)[coded] == 1
    boxes = unit_boxes_mm(geometry)[coded]
    parts: list[Part] = [Boxes(Layer.CODE_LIGHT, boxes[~dark]), Boxes(Layer.CODE_DARK, boxes[dark])]
    if options.heaters:
        track = _heater_track(geometry.unit_mm)
        parts += [Shape(Layer.HEATER, track + _centres(row[None])[0]) for row in boxes[dark]]
    if options.leds:
        parts.append(Boxes(Layer.LED, _led_boxes(_quarter_points(boxes[~dark], geometry.unit_mm))))
    return tuple(part for part in parts if not isinstance(part, Boxes) or len(part.boxes_mm))


def _centres(boxes: FloatArray) -> FloatArray:
    return (boxes[:, :2] + boxes[:, 2:]) / 2


def _quarter_points(boxes: FloatArray, unit_mm: float) -> FloatArray:
    offsets = np.array([(-1, 1), (1, 1), (-1, -1), (1, -1)]) * unit_mm / 4
    return (_centres(boxes)[:, None, :] + offsets).reshape(-1, 2)


def _led_boxes(centres: FloatArray) -> FloatArray:
    half = LED_SIDE_MM / 2
    return np.hstack([centres - half, centres + half])


def _marker_leds(geometry: PlateGeometry) -> Boxes:
    """One light source at the centre of each unit that a marker covers whole, clear of the heater's loop."""
    markers = marker_shapes_mm(geometry)
    reach = _HEATER_INSET_MM + TRACK_MM + 1.0
    centres = _centres(unit_boxes_mm(geometry))
    boxes = _led_boxes(centres)
    keep = np.zeros(len(boxes), dtype=bool)
    for marker in markers:
        inner = Polygon(marker).buffer(-reach, join_style="mitre")
        keep |= np.array([inner.covers(box(*b)) for b in boxes])
    return Boxes(Layer.LED, boxes[keep])


@lru_cache(maxsize=64)
def _heater_track(unit_mm: float) -> FloatArray:
    """Outline of a meandering track round the origin that fills a unit."""
    half = unit_mm / 2 - _HEATER_INSET_MM - TRACK_MM / 2
    legs = max(int(2 * half // (TRACK_MM + _TRACK_GAP_MM)), 2)
    legs -= legs % 2  # both ends on the same side, where the terminals are
    x = np.linspace(-half, half, legs)
    points = [(x[i // 2], half if (i // 2 + i) % 2 else -half) for i in range(2 * legs)]
    track = LineString(points).buffer(TRACK_MM / 2, cap_style="square", join_style="mitre")
    return _outline(track)


def _heater_loop(marker: FloatArray) -> FloatArray:
    """Outline of an open loop inside the edge of a marker; it leaves the middle to the light sources."""
    area = Polygon(marker)
    outer = area.buffer(-_HEATER_INSET_MM, join_style="mitre")
    inner = area.buffer(-_HEATER_INSET_MM - TRACK_MM, join_style="mitre")
    low_x, low_y, _, _ = outer.bounds
    middle = low_y + (outer.bounds[3] - low_y) / 2
    terminal = box(low_x - 1, middle - _TERMINAL_GAP_MM / 2, low_x + TRACK_MM + 1, middle + _TERMINAL_GAP_MM / 2)
    return _outline(outer.difference(inner).difference(terminal))


def _outline(area: Polygon) -> FloatArray:
    """Outer ring of a polygon without holes, its last point left out."""
    return np.asarray(shapely.get_coordinates(area.exterior)[:-1], dtype=np.float64)
