"""The plate itself: base, units, boundary markers, and what lies under them.

Plate frame of app/markers/plate.py, millimetres from the plate's centre, y up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from threading import Lock

import numpy as np
import numpy.typing as npt
import segno
import shapely
from shapely.geometry import LineString, Polygon, box

from app.encoders.plate.drawing import (
    Anchor,
    Boxes,
    Drawing,
    Layer,
    Modules,
    Part,
    Shape,
    Stroke,
    Text,
    box_points,
    fitted_height_mm,
    moved,
    text_width_mm,
)
from app.errors import CodeMismatch, InvalidParameter
from app.geodesy import check_lon_lat
from app.markers.plate import PlateCode, PlateGeometry, unit_index
from app.values import Floats

# === What a fabricator is asked to make.


MAX_ID_LENGTH = 64
MAX_NOTE_LENGTH = 80
MAX_URL_LENGTH = 150


@dataclass(frozen=True, slots=True)
class PlateOrder:
    """One plate to make.

    Raises
    ------
    InvalidParameter
        A value is outside these limits, or the code is for another size of plate.
    """

    plate_id: str  # the registry's name for it, 1 to 64 characters
    code: PlateCode
    geometry: PlateGeometry = field(default_factory=PlateGeometry)  # its ``n`` is the code's
    # address of the marker's public page, for the QR code on the margin; printable ASCII, at most 150 characters.
    # Empty: there is no QR code, and the margin states that.
    record_url: str = ""
    revision: int = 1  # revision of the record that the artwork shows, >= 1
    # `lon_deg`, `lat_deg`: [deg] surveyed or planned position
    lon_deg: float | None = None
    lat_deg: float | None = None
    crs: str = ""  # its coordinate reference system, realization and epoch, for the margin, at most 80 characters
    # whether the plate is in the registry; a draft is not, and the margin gives that as the reason for no QR code
    registered: bool = True

    def __post_init__(self) -> None:
        if self.code.n != self.geometry.n:
            raise InvalidParameter(
                f"the code is for {self.code.n} x {self.code.n} units, the geometry has {self.geometry.n}",
                field="geometry.n",
                limit=f"{self.code.n}",
                cure="give the code and the plate the same number of units along a side",
            )
        if not self.code.units.any():
            raise CodeMismatch(
                f"the face of {self.code.digits} is blank: no unit is dark, a bare plate looks the same",
                field="digits",
                limit="at least one dark unit",
                cure="move the plate by a micro-degree, add check digits, or use the scheme id with another number",
            )
        _check_text("plate_id", self.plate_id, 1, MAX_ID_LENGTH)
        _check_text("crs", self.crs, 0, MAX_NOTE_LENGTH)
        _check_text("record_url", self.record_url, 0, MAX_URL_LENGTH)
        if not self.record_url.isascii():
            raise InvalidParameter(
                "record_url has characters outside ASCII",
                field="record_url",
                limit="printable ASCII",
                cure="percent-encode the address",
            )
        if self.revision < 1:
            raise InvalidParameter(f"revision is {self.revision}", field="revision", limit="1 or more")
        if (self.lon_deg is None) != (self.lat_deg is None):
            raise InvalidParameter("a position has a longitude and a latitude", field="position", limit="both or none")
        if self.lon_deg is not None and self.lat_deg is not None:
            check_lon_lat(self.lon_deg, self.lat_deg)

    @property
    def grouped_digits(self) -> str:
        """The code for people: longitude and latitude apart, or groups of four."""
        digits = self.code.digits
        size = 6 if self.code.n == 8 and not self.code.scheme.corrects else 4
        return " ".join(digits[i : i + size] for i in range(0, len(digits), size))


def _check_text(name: str, text: str, shortest: int, longest: int) -> None:
    if not shortest <= len(text) <= longest or not text.isprintable() or text != text.strip():
        raise InvalidParameter(
            f"{name} has {len(text)} characters, or some that cannot be printed",
            field=name,
            limit=f"{shortest} to {longest} printable characters without spaces at the ends",
        )


def reference_text(realization: str | None, epoch: float | None, warning: str | None = None) -> str:
    """Reference system for the margin: frame and epoch of the position, and a warning if it is only approximate."""
    text = " ".join(str(realization or "WGS 84").split()) + (f" @ {epoch:.2f}" if epoch is not None else "")
    if warning is not None:
        text = f"{text[: MAX_NOTE_LENGTH - len(warning) - 3]} ({warning})"
    return "".join(c if c.isprintable() and c.isascii() else "?" for c in text)[:MAX_NOTE_LENGTH].strip()


@dataclass(frozen=True, slots=True)
class ArtworkOptions:
    """What else a drawing shows."""

    heaters: bool = False  # Heating tracks under dark units and markers, on the layer HEATER
    leds: bool = False  # light sources under light units and markers, on the layer LED


# === QR codes of many addresses that differ in a few characters.
#
# For one length and one mask a QR symbol is an affine function of its message's bits over GF(2): Reed-Solomon codes are
# linear and the mask is a constant. So a symbol whose message is a sum of known messages is the sum of their symbols,
# and after a few dozen plates of a selection segno, which takes about a millisecond a symbol, is hardly called any
# more.


_MASK = 2  # any mask reads; a fixed one keeps the function affine and saves the eightfold trial


def qr_modules(text: str) -> npt.NDArray[np.uint8]:
    """Modules of the QR code (level M) of an ASCII text, dark = 1, without quiet zone, shape (K, K)."""
    return _book(len(text)).modules(text)


class _Book:
    """Basis of the messages of one length seen so far, each with its symbol, in echelon form."""

    def __init__(self, length: int) -> None:
        self._constant = 1 << (8 * length)  # makes the affine function a linear one
        self._basis: dict[int, tuple[int, int]] = {}
        self._side = 0
        self._lock = Lock()

    def modules(self, text: str) -> npt.NDArray[np.uint8]:
        with self._lock:
            symbol = self._symbol(text)
        packed = np.frombuffer(symbol.to_bytes(-(-(self._side**2) // 8), "big"), dtype=np.uint8)
        return np.unpackbits(packed)[-(self._side**2) :].reshape(self._side, self._side)

    def _symbol(self, text: str) -> int:
        message, symbol = self._constant | int.from_bytes(text.encode("ascii"), "big"), 0
        while message:
            leading = message.bit_length()
            if leading not in self._basis:
                full = self._encode(text)
                self._basis[leading] = (message, symbol ^ full)
                return full
            known, change = self._basis[leading]
            message ^= known
            symbol ^= change
        return symbol

    def _encode(self, text: str) -> int:
        code = segno.make(text, error="m", mode="byte", micro=False, mask=_MASK, boost_error=False)
        modules = np.array(code.matrix, dtype=np.uint8)
        self._side = len(modules)
        bits = np.packbits(np.pad(modules.reshape(-1), (-modules.size % 8, 0)))
        return int.from_bytes(bits.tobytes(), "big")


@lru_cache(maxsize=16)
def _book(length: int) -> _Book:
    return _Book(length)


# === The plate itself.


LED_SIDE_MM = 5.0
TRACK_MM = 3.0
_TRACK_GAP_MM = 2.0
_HEATER_INSET_MM = 2.0
_TERMINAL_GAP_MM = 6.0


@lru_cache(maxsize=64)
def unit_boxes_mm(geometry: PlateGeometry) -> Floats:
    """Left, bottom, right, top of every unit, row by row from the top, shape (n * n, 4). [mm]"""
    start = -geometry.side_mm / 2 + geometry.gap_mm + geometry.pitch_mm * np.arange(geometry.n)
    left, top = np.meshgrid(start, -start)
    boxes = np.stack([left, top - geometry.unit_mm, left + geometry.unit_mm, top], axis=-1).reshape(-1, 4)
    boxes.flags.writeable = False
    return boxes


@lru_cache(maxsize=64)
def marker_shapes_mm(geometry: PlateGeometry) -> tuple[Floats, ...]:
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


def _centres(boxes: Floats) -> Floats:
    return (boxes[:, :2] + boxes[:, 2:]) / 2


def _quarter_points(boxes: Floats, unit_mm: float) -> Floats:
    offsets = np.array([(-1, 1), (1, 1), (-1, -1), (1, -1)]) * unit_mm / 4
    return (_centres(boxes)[:, None, :] + offsets).reshape(-1, 2)


def _led_boxes(centres: Floats) -> Floats:
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
def _heater_track(unit_mm: float) -> Floats:
    """Outline of a meandering track round the origin that fills a unit."""
    half = unit_mm / 2 - _HEATER_INSET_MM - TRACK_MM / 2
    legs = max(int(2 * half // (TRACK_MM + _TRACK_GAP_MM)), 2)
    legs -= legs % 2  # both ends on the same side, where the terminals are
    x = np.linspace(-half, half, legs)
    points = [(x[i // 2], half if (i // 2 + i) % 2 else -half) for i in range(2 * legs)]
    track = LineString(points).buffer(TRACK_MM / 2, cap_style="square", join_style="mitre")
    return _outline(track)


def _heater_loop(marker: Floats) -> Floats:
    """Outline of an open loop inside the edge of a marker; it leaves the middle to the light sources."""
    area = Polygon(marker)
    outer = area.buffer(-_HEATER_INSET_MM, join_style="mitre")
    inner = area.buffer(-_HEATER_INSET_MM - TRACK_MM, join_style="mitre")
    low_x, low_y, _, _ = outer.bounds
    middle = low_y + (outer.bounds[3] - low_y) / 2
    terminal = box(low_x - 1, middle - _TERMINAL_GAP_MM / 2, low_x + TRACK_MM + 1, middle + _TERMINAL_GAP_MM / 2)
    return _outline(outer.difference(inner).difference(terminal))


def _outline(area: Polygon) -> Floats:
    """Outer ring of a polygon without holes, its last point left out."""
    return np.asarray(shapely.get_coordinates(area.exterior)[:-1], dtype=np.float64)


# === The margin around a plate on its sheet: its id, size, orientation and position, and a QR code to its record.
#
# Frame: millimetres from the plate's centre, y up, a margin and its face move together.


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


# === Orders to drawings: one plate on its sheet, or many nested on sheets of a chosen size.


PLAIN = ArtworkOptions()
MAX_SHEET_MM = 5000.0


def tile_mm(geometry: PlateGeometry) -> tuple[float, float]:
    """Width and height of a plate with its margins. [mm]"""
    return geometry.side_mm + 2 * SIDE_MARGIN_MM, geometry.side_mm + TOP_MARGIN_MM + BOTTOM_MARGIN_MM


def encode_plate(order: PlateOrder, options: ArtworkOptions = PLAIN) -> Drawing:
    """Draw one plate at true size, with the information for the workshop in its margin.

    Parameters
    ----------
    options : ArtworkOptions
        Heaters and light sources under the face.

    Returns
    -------
    Drawing
        A sheet that is 20 mm wider than the plate on both sides, 36 mm above and 72 mm below. [mm]
    """
    width, height = tile_mm(order.geometry)
    left, bottom = SIDE_MARGIN_MM, BOTTOM_MARGIN_MM
    side = order.geometry.side_mm
    return Drawing(
        title=f"{order.plate_id} r{order.revision} {order.code.digits}",
        width_mm=width,
        height_mm=height,
        parts=_plate_parts(order, options, left, bottom),
        trim_mm=((left, bottom, left + side, bottom + side),),
        bleed_mm=BLEED_MM,
    )


def encode_sheets(
    orders: Sequence[PlateOrder], *, width_mm: float, height_mm: float, options: ArtworkOptions = PLAIN
) -> list[Drawing]:
    """Nest many plates on sheets, in a grid of the largest plate's size, row by row from the top.

    Parameters
    ----------
    width_mm, height_mm : float
        The sheet, at most 5000. [mm]

    Raises
    ------
    InvalidParameter
        The sheet is too small for one plate with its margins, or there are no plates.
    """
    if not orders:
        raise InvalidParameter("there are no plates to nest", field="plates", limit="1 or more")
    tiles = [tile_mm(order.geometry) for order in orders]
    tile_width, tile_height = max(w for w, _ in tiles), max(h for _, h in tiles)
    for name, value, minimum in (("width_mm", width_mm, tile_width), ("height_mm", height_mm, tile_height)):
        if not minimum <= value <= MAX_SHEET_MM:
            raise InvalidParameter(
                f"{name} of the sheet is {value:g} mm, the largest plate needs {minimum:g} mm with its margins",
                field=f"sheet.{name}",
                limit=f"{minimum:g} to {MAX_SHEET_MM:g} mm",
                cure="choose a larger sheet, or smaller plates",
            )
    columns, rows = int(width_mm // tile_width), int(height_mm // tile_height)
    per_sheet = columns * rows
    batches = [orders[i : i + per_sheet] for i in range(0, len(orders), per_sheet)]
    sheets = []
    for number, batch in enumerate(batches, start=1):
        parts: list[Part] = []
        trims = []
        for k, order in enumerate(batch):
            left = (k % columns) * tile_width + SIDE_MARGIN_MM
            bottom = height_mm - (k // columns + 1) * tile_height + BOTTOM_MARGIN_MM
            side = order.geometry.side_mm
            parts += _plate_parts(order, options, left, bottom)
            trims.append((left, bottom, left + side, bottom + side))
        title = f"sheet {number} of {len(batches)}, {len(batch)} plates"
        sheets.append(Drawing(title, width_mm, height_mm, tuple(parts), tuple(trims), BLEED_MM))
    return sheets


def _plate_parts(order: PlateOrder, options: ArtworkOptions, left: float, bottom: float) -> tuple[Part, ...]:
    x, y = left + order.geometry.side_mm / 2, bottom + order.geometry.side_mm / 2
    own = (*code_face(order.code, order.geometry, options), *plate_margin(order))
    return (*_fixed_parts(order.geometry, options, x, y), *moved(own, x, y))


@lru_cache(maxsize=256)
def _fixed_parts(geometry: PlateGeometry, options: ArtworkOptions, x: float, y: float) -> tuple[Part, ...]:
    return moved((*fixed_face(geometry, options), *fixed_margin(geometry)), x, y)
