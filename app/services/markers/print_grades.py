"""Photos of printed plates -> grades. Nothing is stored."""

from __future__ import annotations

from dataclasses import dataclass

from app.decoding.frames import plate_code, plate_geometry
from app.errors import InvalidParameter, UnreadableUpload, UploadTooLarge
from app.families.plate.plates import PLATE
from app.formats.format import SpooledFile
from app.formats.images import FIELD, ImageLimits, is_picture, unknown_picture
from app.markers.plate import PlateCode, PlateGeometry
from app.planning.rules import CameraRules
from app.registry import markers as store
from app.registry.database import Database
from app.services.access.access import Caller
from app.services.markers.tasks import GradedPhoto, PrintedPlate, grade_photo
from app.services.ports import Clock, DecoderProcesses

_BUSY_WAIT_S = 10.0
_SIGNATURE_BYTES = 16


@dataclass(frozen=True, slots=True)
class PrintDeclaration:
    """What is declared of a photo."""

    # the registered plate that was printed; without it, `code` and `geometry` may say what it should be
    marker_id: str | None
    code: PlateCode | None
    geometry: PlateGeometry | None
    camera: CameraRules  # of the vehicles
    speed_kmh: float  # [km/h] design speed


class PrintGrades:
    """Use case on print grades."""

    def __init__(
        self, database: Database, clock: Clock, processes: DecoderProcesses, images: ImageLimits | None = None
    ) -> None:
        self._database, self._clock, self._processes = database, clock, processes
        self._images = images or ImageLimits()

    def grade(
        self, caller: Caller, photo: SpooledFile, declared: PrintDeclaration, *, as_pdf: bool = False
    ) -> GradedPhoto:
        """Grade a photo in a decoder process.

        Raises
        ------
        PrintNotGraded
            The photo does not show one plate well enough.
        UnreadableUpload, UploadTooLarge, UnsupportedUpload
            The file is no picture, damaged or too large.
        NotFound
            There is no such marker.
        InvalidParameter
            The marker is no plate.
        Unavailable
            The decoder processes are busy.
        """
        code, geometry = declared.code, declared.geometry
        if declared.marker_id is not None:
            code, geometry = self._registered(caller, declared.marker_id)
        head = photo.head(_SIGNATURE_BYTES)
        if head and not is_picture(head):
            error = unknown_picture(head)
            error.field = "photo"
            raise error
        if photo.size > self._images.file_bytes:
            raise UploadTooLarge("the photo is too large", field="photo", limit=f"{self._images.file_bytes} bytes")
        plate = PrintedPlate(code, geometry, declared.marker_id)
        try:
            return self._processes.run(
                grade_photo,
                photo,
                self._clock(),
                plate,
                declared.camera,
                declared.speed_kmh,
                as_pdf,
                self._images,
                wait_s=_BUSY_WAIT_S,
            )
        except UnreadableUpload as error:
            error.field = "photo" if error.field == FIELD else error.field  # the form's name of the file
            raise

    def _registered(self, caller: Caller, marker_id: str) -> tuple[PlateCode, PlateGeometry]:
        with self._database.read() as connection:
            row = store.get_marker(connection, caller.agency_id, marker_id)
        if row.family != PLATE.name:
            raise InvalidParameter(
                f"the marker {marker_id} is no plate but of the family {row.family}",
                field="marker_id",
                limit="the id of a plate",
                cure="name the plate that was printed",
            )
        return plate_code(row), plate_geometry(row)
