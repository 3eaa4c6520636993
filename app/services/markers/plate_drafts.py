"""Plates that are not registered: how they will look, their artwork, and what a camera sees. Nothing is stored."""

from __future__ import annotations

from dataclasses import dataclass

from typing_extensions import TypedDict

from app.encoders.plate import (
    ArtworkFormat,
    ArtworkOptions,
    PlateOrder,
    PlateReader,
    encode_plate,
    prove_plate,
    write_artwork,
)
from app.encoders.plate.bundle import dimension_limits_mm
from app.encoders.plate.drawing import COLOURS, INKS
from app.encoders.plate.face import UNIT_TOLERANCE_MM, reference_text, tile_mm
from app.families.documents import PositionIn, place_input
from app.families.family import ArtworkProof
from app.families.plate.plates import CodedPlate, CodeInput, PlateGeometryDocument, coded_plate
from app.markers.plate import PlateCode, PlateGeometry, PlateScheme, plate_capacity
from app.planning.predict.rates import CameraPass, CameraView, PassFrame, camera_pass, check_view_size
from app.planning.proof.report import Condition
from app.planning.rules import CameraRules, PredictionRules
from app.services.documents import document_of
from app.services.markers.tasks import render_camera_view
from app.services.ports import DecoderProcesses

# === Documents of plates that are not registered: their code and dimensions, and passes of a camera over them.


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


# === Plates that are not registered.


EXAMPLE_NUMBER = 0xC0FFEE42
"""Registry number of a draft without one. Source: docs/artwork.md."""
_KMH = 3.6  # km/h in a metre a second
_BUSY_WAIT_S = 10.0


@dataclass(frozen=True, slots=True)
class PlateDraft:
    """A plate that is asked about."""

    code: CodeInput
    geometry: PlateGeometry
    position: PositionIn | None


@dataclass(frozen=True, slots=True)
class Pass:
    """A camera that passes a plate."""

    camera: CameraRules
    speed_kmh: float
    left_m: float  # [m] plate's centre left of the camera's path


@dataclass(frozen=True, slots=True)
class DraftArtwork:
    """Artwork of a draft with its proof."""

    content: bytes
    media_type: str
    file_name: str
    proof: ArtworkProof


class PlateDrafts:
    """Use cases on drafts of plates.

    Parameters
    ----------
    read : callable
        Decoder of the self-proof.
    crs_accuracy_m : float
        Stated accuracy from which a transformation to WGS 84 counts as exact. [m]
    """

    def __init__(self, processes: DecoderProcesses, *, read: PlateReader, crs_accuracy_m: float) -> None:
        self._processes, self._read, self._accuracy_m = processes, read, crs_accuracy_m

    def document(self, draft: PlateDraft) -> PlateDraftDocument:
        """Code, units and dimensions of a draft.

        Raises
        ------
        InvalidParameter, CodeMismatch, ReferenceSystemError
            The code or the position contradicts itself, or one the other.
        """
        coded, order = self._order(draft)
        place_deg = None if order.lon_deg is None or order.lat_deg is None else (order.lon_deg, order.lat_deg)
        example = not coded.is_explicit and coded.code.scheme is PlateScheme.ID
        return plate_draft_document(coded, order, place_deg, example=example)

    def artwork(self, draft: PlateDraft, form: ArtworkFormat, options: ArtworkOptions, dpi: float) -> DraftArtwork:
        """Artwork of a draft at true size, proved; raises as `document`.

        Raises
        ------
        ProofFailed
            The drawing did not read back as its own code.
        """
        _coded, order = self._order(draft)
        drawing = encode_plate(order, options)
        proof = prove_plate(drawing, order.code, order.geometry, self._read)
        written = write_artwork(drawing, form, dpi=dpi)
        name = f"draft-{order.code.digits}.{form}"
        return DraftArtwork(written.content, written.media_type, name, ArtworkProof(proof.digits, proof.confidence))

    def camera_pass(self, draft: PlateDraft, way: Pass) -> CameraPassDocument:
        """Frames, blur and read rates of a pass over a draft; the code need not be known."""
        found = camera_pass(draft.geometry, way.camera, way.speed_kmh / _KMH, way.left_m)
        return camera_pass_document(found, way.speed_kmh)

    def view(self, draft: PlateDraft, way: Pass, ahead_m: float, condition: Condition) -> CameraView:
        """Picture of a draft as a camera sees it, decoded; raises as `document`.

        Raises
        ------
        Unavailable
            The decoder processes are busy.
        """
        check_view_size(way.camera)
        _coded, order = self._order(draft)
        return self._processes.run(
            render_camera_view,
            order.code,
            order.geometry,
            way.camera,
            way.speed_kmh / _KMH,
            ahead_m,
            way.left_m,
            condition,
            wait_s=_BUSY_WAIT_S,
        )

    def _order(self, draft: PlateDraft) -> tuple[CodedPlate, PlateOrder]:
        placed = None if draft.position is None else place_input(draft.position, self._accuracy_m)
        n = draft.geometry.n
        coded = coded_plate(
            draft.code, n, None if placed is None else (placed.lon_deg, placed.lat_deg),
            lambda: PlateCode.from_registry_number(EXAMPLE_NUMBER, n=n),
        )  # fmt: skip
        order = PlateOrder(
            plate_id=coded.code.digits,
            code=coded.code,
            geometry=draft.geometry,
            lon_deg=None if placed is None else placed.lon_deg,
            lat_deg=None if placed is None else placed.lat_deg,
            crs="" if placed is None else reference_text(placed.realization, placed.epoch),
            registered=False,
        )
        return coded, order
