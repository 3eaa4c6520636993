"""Plates that are not registered: how they will look, their artwork, and what a camera sees. Nothing is stored."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pydantic import ConfigDict, Field, JsonValue
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
from app.families.documents import POSITION_EXAMPLE, PositionIn, place_input
from app.families.family import ArtworkProof
from app.families.plate.plates import (
    CodedPlate,
    CodeInput,
    GeometryIn,
    PlateGeometryDocument,
    coded_plate,
    plate_geometry_document,
)
from app.inputs import Flag, Number, StrictModel
from app.markers.plate import PlateCode, PlateGeometry, PlateScheme, plate_capacity
from app.planning.predict.rates import CameraPass, CameraView, camera_pass, check_view_size
from app.planning.proof.report import Condition
from app.planning.rules import CameraRules
from app.services.documents import document_of
from app.services.markers.tasks import render_camera_view
from app.services.ports import DecoderProcesses

# === Documents of plates that are not registered: their code and dimensions.


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
        "geometry": plate_geometry_document(geometry),
        "units": _unit_rows(order),
        "dimensions": _dimensions(order),
        "colours": [
            document_of(PlateColourDocument, colour, layer=str(colour.layer), screen=INKS[colour.layer].hex)
            for colour in COLOURS
        ],
        "sheet": {"width_mm": width_mm, "height_mm": height_mm},
    }


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


_PLACE: dict[str, JsonValue] = {name: POSITION_EXAMPLE[name] for name in ("lon_deg", "lat_deg")}
_EXAMPLES: list[JsonValue] = [
    {"position": _PLACE, "code": {"scheme": "position-robust"}},
    {"code": {"scheme": "id", "registry_number": 3237998146}, "geometry": {"unit_mm": 40.0}},
]
_PASS_EXAMPLE: dict[str, JsonValue] = {"camera": {"height_m": 1.4, "exposure_s": 0.002}, "speed_kmh": 50.0}


class PlateDraft(StrictModel):
    """A plate to see before it is registered."""

    model_config = ConfigDict(json_schema_extra={"examples": _EXAMPLES})

    position: PositionIn | None = Field(None, description="Centre of the plate; the position schemes need it.")
    code: CodeInput = Field(default_factory=CodeInput)
    geometry: GeometryIn = Field(default_factory=GeometryIn)

    @property
    def plate(self) -> PlateGeometry:
        """The dimensions of the plate, all of them."""
        return self.geometry.of_scheme(self.code.scheme)


class DraftToDraw(PlateDraft):
    """A plate to draw before it is registered."""

    heaters: Flag = Field(False, description="Heating tracks under dark units.")
    leds: Flag = Field(False, description="Light sources under light units.")
    resolution_dpi: Annotated[float, Field(ge=20, le=300, allow_inf_nan=False)] = Field(
        150.0, description="Of a PNG. [1/inch]"
    )


class DraftToPass(PlateDraft):
    """A camera that passes a plate."""

    model_config = ConfigDict(json_schema_extra={"examples": [_PASS_EXAMPLE]})

    camera: CameraRules = Field(default_factory=CameraRules, description="As in the rules of a plan.")
    speed_kmh: Number = Field(60.0, ge=2.0, le=250.0, description="Speed of the vehicle. [km/h]")
    left_m: Number = Field(0.0, ge=-5.0, le=5.0, description="Plate's centre left of the camera's path. [m]")


class DraftToView(DraftToPass):
    """One frame of a pass."""

    model_config = ConfigDict(json_schema_extra={"examples": [{**_PASS_EXAMPLE, "ahead_m": 4.0}]})

    ahead_m: Number = Field(4.0, ge=0.2, le=18.0, description="From the camera to the plate's centre. [m]")
    condition: Annotated[Condition, Field(description="Light, weather or state of the plate, as in a proof.")] = (
        Condition.DAY
    )


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

    def artwork(self, draft: DraftToDraw, form: ArtworkFormat) -> DraftArtwork:
        """Artwork of a draft at true size, proved; raises as `document`.

        Raises
        ------
        ProofFailed
            The drawing did not read back as its own code.
        """
        _coded, order = self._order(draft)
        drawing = encode_plate(order, ArtworkOptions(heaters=draft.heaters, leds=draft.leds))
        proof = prove_plate(drawing, order.code, order.geometry, self._read)
        written = write_artwork(drawing, form, dpi=draft.resolution_dpi)
        name = f"draft-{order.code.digits}.{form}"
        return DraftArtwork(written.content, written.media_type, name, ArtworkProof(proof.digits, proof.confidence))

    def camera_pass(self, draft: DraftToPass) -> CameraPass:
        """Frames, blur and read rates of a pass over a draft; the code need not be known."""
        return camera_pass(draft.plate, draft.camera, draft.speed_kmh, draft.left_m)

    def view(self, draft: DraftToView) -> CameraView:
        """Picture of a draft as a camera sees it, decoded; raises as `document`.

        Raises
        ------
        Unavailable
            The decoder processes are busy.
        """
        check_view_size(draft.camera)
        _coded, order = self._order(draft)
        return self._processes.run(
            render_camera_view,
            order.code,
            order.geometry,
            draft.camera,
            draft.speed_kmh / _KMH,
            draft.ahead_m,
            draft.left_m,
            draft.condition,
            wait_s=_BUSY_WAIT_S,
        )

    def _order(self, draft: PlateDraft) -> tuple[CodedPlate, PlateOrder]:
        placed = None if draft.position is None else place_input(draft.position, self._accuracy_m)
        plate, place_deg = draft.plate, None if placed is None else (placed.lon_deg, placed.lat_deg)
        coded = coded_plate(
            draft.code, plate.n, place_deg, lambda: PlateCode.from_registry_number(EXAMPLE_NUMBER, n=plate.n)
        )
        order = PlateOrder(
            plate_id=coded.code.digits,
            code=coded.code,
            geometry=plate,
            lon_deg=None if placed is None else placed.lon_deg,
            lat_deg=None if placed is None else placed.lat_deg,
            crs="" if placed is None else reference_text(placed.realization, placed.epoch),
            registered=False,
        )
        return coded, order
