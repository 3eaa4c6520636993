"""Photos of a calibration board -> a calibration that is kept, ready to be put into a vehicle's camera."""

from __future__ import annotations

from dataclasses import asdict
from datetime import timedelta
from typing import Literal, cast

from pydantic import ConfigDict, Field, JsonValue

from app import __version__
from app.calibration.board_view import CameraCalibration
from app.calibration.calibrate import VERSION
from app.errors import UnreadableUpload, UploadTooLarge
from app.formats.format import SpooledFile
from app.formats.images import ImageLimits
from app.inputs import Declaration
from app.registry.column_types import new_id
from app.registry.database import Database
from app.registry.vehicles import CALIBRATIONS, CalibrationRow
from app.sensors.camera import CalibrationBoard
from app.services.access.access import Caller
from app.services.access.audit import log_change
from app.services.fleet.documents import CalibrationDocument, CalibrationPage
from app.services.fleet.tasks import MAX_PHOTOS, calibrate_photos
from app.services.idempotency import IdempotencyKey, find_earlier, write_once
from app.services.ports import Clock, DecoderProcesses

_BUSY_WAIT_S = 10.0
DECLARATION_EXAMPLE: dict[str, JsonValue] = {
    "board": {"columns": 7, "rows": 10, "square_mm": 25.0, "marker_mm": 18.0},
}


class CalibrationDeclaration(Declaration):
    """What is declared of the photos."""

    model_config = ConfigDict(json_schema_extra={"examples": [DECLARATION_EXAMPLE]})

    board: CalibrationBoard = CalibrationBoard()
    coefficients: Literal[4, 5, 8] | None = Field(None, description="Of the distortion; chosen if left out.")


class Calibrations:
    """Use cases on calibrations.

    Parameters
    ----------
    images : ImageLimits
        Of each photo.
    """

    def __init__(
        self,
        database: Database,
        clock: Clock,
        processes: DecoderProcesses,
        images: ImageLimits | None = None,
        idempotency_ttl: timedelta = timedelta(hours=24),
    ) -> None:
        self._database = database
        self._clock = clock
        self._processes = processes
        self._images = images or ImageLimits()
        self._ttl = idempotency_ttl

    def run(
        self,
        caller: Caller,
        photos: tuple[tuple[str, SpooledFile], ...],
        declared: CalibrationDeclaration,
        key: IdempotencyKey | None = None,
    ) -> tuple[CalibrationDocument, bool]:
        """Calibrate a camera. The photos are not kept.

        Returns
        -------
        calibration : dict
        replayed : bool
            The request had been made before under the same Idempotency-Key; nothing was stored now.

        Raises
        ------
        CalibrationRefused
            The photos do not calibrate the camera well enough; nothing is stored.
        UnreadableUpload, UploadTooLarge, InvalidParameter
            There is no photo, there are too many, or an archive is damaged.
        Unavailable
            The decoder processes are busy.
        """
        now = self._clock()
        if earlier := find_earlier(self._database, caller.agency_id, key, now):
            return earlier, True
        _check_count(photos)
        board, coefficients = declared.board, declared.coefficients
        found = self._processes.run(calibrate_photos, photos, board, coefficients, self._images, wait_s=_BUSY_WAIT_S)
        result = calibration_result(found)
        row = CalibrationRow(id=new_id(now), who=caller.label, result=result, created_at=now)
        with write_once(self._database, caller.agency_id, key, now, self._ttl) as (connection, answer):
            if answer.replayed:
                return answer.response, True
            CALIBRATIONS.add(connection, caller.agency_id, row._asdict())
            document = answer.store(calibration_document(row))
            log_change(connection, caller, "calibration.made", now=now, subject=row.id, document=result)
        return document, False

    def get(self, caller: Caller, calibration_id: str) -> CalibrationDocument:
        """One calibration."""
        with self._database.read() as connection:
            return calibration_document(CALIBRATIONS.get(connection, caller.agency_id, calibration_id))

    def page(
        self, caller: Caller, *, before: str | None = None, limit: int = 100
    ) -> tuple[CalibrationPage, str | None]:
        """A page of calibrations, newest first, and the id to continue before if there may be more."""
        with self._database.read() as connection:
            rows, last = CALIBRATIONS.page(connection, caller.agency_id, beyond=before, limit=limit, newest_first=True)
        return CalibrationPage(items=[calibration_document(row) for row in rows]), last


def calibration_document(row: CalibrationRow) -> CalibrationDocument:
    """A calibration as clients see it."""
    return cast("CalibrationDocument", {"id": row.id, "created_at": row.created_at, "who": row.who, **row.result})


def calibration_result(found: CameraCalibration) -> dict[str, object]:
    """What is stored of a calibration; `camera` has the members of a context's camera."""
    used = sum(view.used for view in found.views)
    return {
        "decoder": f"waymark {__version__} {VERSION}",
        "summary": f"{used} of {len(found.views)} photos used, reprojection error {found.rms_px:.3f} px, "
        f"focal length {found.camera.fx_px:.1f} ± {found.sigma.fx_px:.1f} px, "
        f"{found.coverage.share:.0%} of the image covered",
        **asdict(found),
    }


def _check_count(photos: tuple[tuple[str, SpooledFile], ...]) -> None:
    if not photos:
        raise UnreadableUpload(
            "there is no photo in the form", field="photos", limit="one ZIP, or several photos", cure="send 12 to 20"
        )
    if len(photos) > MAX_PHOTOS:
        raise UploadTooLarge(
            f"there are {len(photos)} photos", field="photos", limit=f"{MAX_PHOTOS} photos", cure="send 12 to 20"
        )
