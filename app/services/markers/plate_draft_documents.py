"""Documents of plates that are not registered: their code and dimensions, and passes of a camera over them."""

from __future__ import annotations

from typing_extensions import TypedDict

from app.encoders.plate import PlateOrder
from app.encoders.plate.artwork import tile_mm
from app.encoders.plate.colours import COLOURS, INKS
from app.encoders.plate.margin import UNIT_TOLERANCE_MM
from app.encoders.plate.quality import dimension_limits_mm
from app.families.plate.coding import CodedPlate
from app.families.plate.documents import PlateGeometryDocument
from app.markers.plate import PlateScheme, plate_capacity
from app.planning.predict.camera_pass import CameraPass, PassFrame
from app.planning.rules import PredictionRules
from app.services.documents import document_of

_MIN_READ_RATE = PredictionRules().min_read_rate


class DraftCodeDocument(TypedDict):
    """Code of a draft; `registry_number` is hexadecimal; where `example` is true, none is allocated."""

    scheme: str
    digits: str
    grouped_digits: str
    check_digits: int | None
    registry_number: str | None
    digits_match_position: bool | None
    example: bool
    bits: float
    data_symbols: int
    correctable_cells: int
    correctable_erasures: int


class DraftPlaceDocument(TypedDict):
    """Position of a draft in WGS 84."""

    lon_deg: float
    lat_deg: float


class DimensionDocument(TypedDict):
    """A dimension; without a tolerance it follows from others."""

    name: str
    value_mm: float
    tolerance_mm: float | None


class PlateColourDocument(TypedDict):
    """Colour of an area."""

    layer: str
    area: str
    screen: str
    ral: str
    sheeting: str


class PlateSheetDocument(TypedDict):
    """Sheet of the artwork."""

    width_mm: float
    height_mm: float


class PlateDraftDocument(TypedDict):
    """A plate as it would be made. `units` has a text for each row from the top: 1 is dark, 0 light, - a marker's."""

    code: DraftCodeDocument
    position: DraftPlaceDocument | None
    geometry: PlateGeometryDocument
    units: list[str]
    dimensions: list[DimensionDocument]
    colours: list[PlateColourDocument]
    sheet: PlateSheetDocument


class PassFrameDocument(TypedDict):
    """A frame of a pass."""

    ahead_m: float
    unit_px: float
    plate_width_px: float
    plate_height_px: float
    blur_px: float
    read_probability: float


class PassRateDocument(TypedDict):
    """How often a pass is predicted to read the plate."""

    condition: str
    read_rate: float
    will_be_read: bool


class CameraPassDocument(TypedDict):
    """A pass of a camera over a plate. `frames` are those with units of a pixel or more, one in `listed_every`."""

    speed_kmh: float
    step_m: float
    near_m: float | None
    far_m: float | None
    readable_frames_per_pass: float
    best_unit_px: float
    blur_mm: float
    blur_units: float
    frames: list[PassFrameDocument]
    listed_every: int
    read_rates: list[PassRateDocument]
    min_read_rate: float


def plate_draft_document(
    coded: CodedPlate, order: PlateOrder, place_deg: tuple[float, float] | None, *, example: bool
) -> PlateDraftDocument:
    """A draft as clients see it."""
    code, geometry = order.code, order.geometry
    capacity = plate_capacity(code.n, code.scheme, code.check_digits)
    width_mm, height_mm = tile_mm(geometry)
    return {
        "code": {
            "scheme": str(code.scheme),
            "digits": code.digits,
            "grouped_digits": order.grouped_digits,
            "check_digits": code.check_digits if code.scheme is PlateScheme.POSITION_CHECK else None,
            "registry_number": f"{code.registry_number:X}" if code.scheme is PlateScheme.ID else None,
            "digits_match_position": coded.digits_match_position,
            "example": example,
            "bits": round(capacity.bits, 1),
            "data_symbols": capacity.data_symbols,
            "correctable_cells": capacity.correctable_cells,
            "correctable_erasures": capacity.correctable_erasures,
        },
        "position": None if place_deg is None else {"lon_deg": place_deg[0], "lat_deg": place_deg[1]},
        "geometry": document_of(PlateGeometryDocument, geometry),
        "units": _unit_rows(order),
        "dimensions": _dimensions(order),
        "colours": [
            document_of(PlateColourDocument, colour, layer=str(colour.layer), screen=INKS[colour.layer].hex)
            for colour in COLOURS
        ],
        "sheet": {"width_mm": width_mm, "height_mm": height_mm},
    }


def camera_pass_document(found: CameraPass, speed_kmh: float) -> CameraPassDocument:
    """A pass as clients see it."""
    return {
        "speed_kmh": speed_kmh,
        "step_m": found.step_m,
        "near_m": found.near_m,
        "far_m": found.far_m,
        "readable_frames_per_pass": round(found.readable_frames, 2),
        "best_unit_px": found.best_unit_px,
        "blur_mm": found.blur_m * 1000,
        "blur_units": found.blur_units,
        "frames": [_frame(frame) for frame in found.frames],
        "listed_every": found.listed_every,
        "read_rates": [
            {"condition": name, "read_rate": round(rate, 4), "will_be_read": rate >= _MIN_READ_RATE}
            for name, rate in found.read_rates.items()
        ],
        "min_read_rate": _MIN_READ_RATE,
    }


def _frame(frame: PassFrame) -> PassFrameDocument:
    return document_of(PassFrameDocument, frame)


def _unit_rows(order: PlateOrder) -> list[str]:
    n, units = order.geometry.n, order.code.units

    def is_marker(row: int, column: int) -> bool:
        return (row < 2 or row >= n - 2) and (column < 2 or column >= n - 2)

    return ["".join("-" if is_marker(r, c) else str(int(units[r, c])) for c in range(n)) for r in range(n)]


def _dimensions(order: PlateOrder) -> list[DimensionDocument]:
    geometry = order.geometry
    width_mm, height_mm = tile_mm(geometry)
    limits = {name: (value, tolerance) for name, value, tolerance in dimension_limits_mm(geometry)}
    rows: list[tuple[str, float, float | None]] = [
        ("side", *limits["outer edge"]),
        ("unit", *limits["unit"]),
        ("gap", *limits["gap"]),
        ("border", geometry.gap_mm, UNIT_TOLERANCE_MM),
        ("pitch", geometry.pitch_mm, None),
        ("marker", *limits["marker"]),
        ("thickness", *limits["thickness"]),
        ("diagonal", geometry.side_mm * 2**0.5, None),
        ("diagonal-difference", *limits["diagonals differ"]),
        ("sheet-width", width_mm, None),
        ("sheet-height", height_mm, None),
    ]
    return [{"name": name, "value_mm": round(value, 3), "tolerance_mm": limit} for name, value, limit in rows]
