"""Plates that are not registered: how they will look, their artwork, and what a camera sees. Nothing is stored."""

from __future__ import annotations

from dataclasses import dataclass

from app.encoders.plate import (
    ArtworkFormat,
    ArtworkOptions,
    PlateOrder,
    PlateReader,
    encode_plate,
    prove_plate,
    write_artwork,
)
from app.encoders.plate.order import reference_text
from app.families.files import ArtworkProof
from app.families.inputs import PositionIn
from app.families.plate.coding import CodedPlate, coded_plate
from app.families.plate.registration import CodeInput
from app.families.positions import place_input
from app.markers.plate import PlateCode, PlateGeometry, PlateScheme
from app.planning.predict.camera_pass import camera_pass
from app.planning.predict.views import CameraView, check_view_size
from app.planning.proof.terms import Condition
from app.planning.rules import CameraRules
from app.services.decoder_processes import DecoderProcesses
from app.services.markers.plate_draft_documents import (
    CameraPassDocument,
    PlateDraftDocument,
    camera_pass_document,
    plate_draft_document,
)
from app.services.markers.view_task import CameraViewTask

EXAMPLE_NUMBER = 0xC0FFEE42
"""Registry number of a draft without one. Source: docs/artwork.md."""
_KMH = 3.6  # km/h in a metre a second
_BUSY_WAIT_S = 10.0


@dataclass(frozen=True, slots=True)
class PlateDraft:
    """A plate that is asked about.

    Attributes
    ----------
    code : CodeInput
    geometry : PlateGeometry
    position : PositionIn or None
    """

    code: CodeInput
    geometry: PlateGeometry
    position: PositionIn | None


@dataclass(frozen=True, slots=True)
class Pass:
    """A camera that passes a plate.

    Attributes
    ----------
    camera : CameraRules
    speed_kmh : float
        [km/h]
    left_m : float
        Plate's centre left of the camera's path. [m]
    """

    camera: CameraRules
    speed_kmh: float
    left_m: float


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
    processes : DecoderProcesses
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
        task = CameraViewTask(
            order.code, order.geometry, way.camera, way.speed_kmh / _KMH, ahead_m, way.left_m, condition
        )
        return self._processes.submit(task, wait_s=_BUSY_WAIT_S).result()

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
