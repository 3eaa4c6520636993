"""Photos of a calibration board -> a calibration that is kept, ready to be put into a vehicle's camera."""

from __future__ import annotations

from datetime import timedelta
from typing import Literal

from pydantic import ConfigDict, Field, JsonValue

from app import __version__
from app.calibration.board_view import CameraCalibration, ViewReport
from app.calibration.calibrate import VERSION
from app.errors import UnreadableUpload, UploadTooLarge
from app.formats.format import SpooledFile
from app.formats.images import ImageLimits
from app.inputs import Declaration
from app.registry.column_types import new_id
from app.registry.database import Database
from app.registry.vehicles import CALIBRATIONS, CalibrationRow
from app.sensors.camera import DICTIONARY, CalibrationBoard
from app.services.access.access import Caller
from app.services.access.audit import log_change
from app.services.documents import document_of
from app.services.fleet.documents import (
    Board,
    CalibratedCamera,
    CalibrationDocument,
    CalibrationPage,
    CalibrationResult,
    CalibrationView,
    CameraSigma,
)
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
        result = calibration_result(found, board)
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
    result: CalibrationResult = row.result
    return {"id": row.id, "created_at": row.created_at, "who": row.who, **result}


def calibration_result(found: CameraCalibration, board: CalibrationBoard) -> CalibrationResult:
    """What is kept of a calibration; `camera` has the members of a context's camera."""
    used = [view for view in found.views if view.fault is None]
    return {
        "decoder": f"waymark {__version__} {VERSION}",
        "summary": f"{len(used)} of {len(found.views)} photos used, reprojection error {found.rms_px:.3f} px, "
        f"focal length {found.parameters['fx_px']:.1f} ± {found.sigma['fx_px']:.1f} px, "
        f"{found.coverage:.0%} of the image covered",
        "camera": _camera(found),
        "sigma": _sigma(found),
        "rms_px": found.rms_px,
        "coverage": {"share": found.coverage, "cells": found.covered.astype(int).tolist()},
        "tilt_spread_deg": found.tilt_spread_deg,
        "board": document_of(Board, board, dictionary=DICTIONARY),
        "views": [_view(view) for view in found.views],
    }


def _camera(found: CameraCalibration) -> CalibratedCamera:
    return {
        "width_px": found.width_px,
        "height_px": found.height_px,
        "fx_px": found.parameters["fx_px"],
        "fy_px": found.parameters["fy_px"],
        "cx_px": found.parameters["cx_px"],
        "cy_px": found.parameters["cy_px"],
        "distortion": list(found.distortion),
    }


def _sigma(found: CameraCalibration) -> CameraSigma:
    return {
        "fx_px": found.sigma["fx_px"],
        "fy_px": found.sigma["fy_px"],
        "cx_px": found.sigma["cx_px"],
        "cy_px": found.sigma["cy_px"],
        "distortion": list(found.distortion_sigma),
    }


def _view(view: ViewReport) -> CalibrationView:
    figures = {name: _rounded(getattr(view, name)) for name in ("rms_px", "tilt_deg", "edge_width_px")}
    reason, detail = str(view.fault) if view.fault is not None else None, view.detail or None
    return document_of(CalibrationView, view, used=view.fault is None, reason=reason, detail=detail, **figures)


def _rounded(figure: float | None) -> float | None:
    return None if figure is None else round(figure, 3)


def _check_count(photos: tuple[tuple[str, SpooledFile], ...]) -> None:
    if not photos:
        raise UnreadableUpload(
            "there is no photo in the form", field="photos", limit="one ZIP, or several photos", cure="send 12 to 20"
        )
    if len(photos) > MAX_PHOTOS:
        raise UploadTooLarge(
            f"there are {len(photos)} photos", field="photos", limit=f"{MAX_PHOTOS} photos", cure="send 12 to 20"
        )
