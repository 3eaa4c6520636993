"""Photos of a calibration board -> a calibration that is kept, ready to be put into a vehicle's camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from datetime import timedelta
from typing import Any, Protocol

from app import __version__
from app.decoders.archives import ArchiveLimits
from app.decoders.calibration.calibrate import COEFFICIENTS, VERSION
from app.decoders.calibration.results import CameraCalibration, ViewReport
from app.decoders.images import ImageLimits
from app.errors import InvalidParameter, UnreadableUpload, UploadTooLarge
from app.registry import vehicles as store
from app.registry.database import Database
from app.registry.ids import new_id
from app.registry.vehicles import Row
from app.sensors.calibration_board import DICTIONARY, CalibrationBoard
from app.services.access import Caller
from app.services.audit import log_change
from app.services.idempotency import IdempotencyKey, find_answer, keep_answer
from app.services.ports import Clock

MAX_PHOTOS = 60
_BUSY_WAIT_S = 10.0


@dataclass(frozen=True, slots=True)
class CalibrationTask:
    """What goes to a decoder process.

    Attributes
    ----------
    photos : tuple of (str, bytes)
        Names and contents; a ZIP stands for the photos in it.
    board : CalibrationBoard
    coefficients : int or None
        Of the distortion.
    images : ImageLimits
        Of each photo.
    archives : ArchiveLimits
    """

    photos: tuple[tuple[str, bytes], ...]
    board: CalibrationBoard
    coefficients: int | None = None
    images: ImageLimits = field(default_factory=ImageLimits)
    archives: ArchiveLimits = field(default_factory=lambda: ArchiveLimits(members=MAX_PHOTOS))


class PendingCalibration(Protocol):
    """Photos on their way through a decoder process."""

    def result(self) -> CameraCalibration:
        """Wait for it."""


class Calibrator(Protocol):
    """Decoder processes, as this use case sees them."""

    def start_calibration(self, task: CalibrationTask, *, wait_s: float = 0.0) -> PendingCalibration:
        """Hand photos over; raises `Unavailable` where too much is waiting already."""


class Calibrations:
    """Use cases on calibrations.

    Parameters
    ----------
    database : Database
    clock : Clock
    calibrator : Calibrator
    images : ImageLimits
        Of each photo.
    idempotency_ttl : timedelta
    """

    def __init__(
        self,
        database: Database,
        clock: Clock,
        calibrator: Calibrator,
        images: ImageLimits | None = None,
        idempotency_ttl: timedelta = timedelta(hours=24),
    ) -> None:
        self._database = database
        self._clock = clock
        self._calibrator = calibrator
        self._images = images or ImageLimits()
        self._ttl = idempotency_ttl

    def run(
        self,
        caller: Caller,
        photos: tuple[tuple[str, bytes], ...],
        board: CalibrationBoard,
        coefficients: int | None = None,
        key: IdempotencyKey | None = None,
    ) -> tuple[dict[str, Any], bool]:
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
        with self._database.read() as connection:
            answer = find_answer(connection, caller.agency_id, key, now)
        if answer is not None:
            return answer, True
        if coefficients is not None and coefficients not in COEFFICIENTS:
            raise InvalidParameter(f"{coefficients} coefficients", field="coefficients", limit="4, 5 or 8")
        _check_count(photos)
        task = CalibrationTask(photos, board, coefficients, self._images)
        found = self._calibrator.start_calibration(task, wait_s=_BUSY_WAIT_S).result()
        result = calibration_result(found, board)
        row: dict[str, Any] = {"id": new_id(now), "who": caller.label, "result": result, "created_at": now}
        with self._database.write() as connection:
            answer = find_answer(connection, caller.agency_id, key, now)
            if answer is not None:
                return answer, True
            store.add_calibration(connection, caller.agency_id, row)
            document = calibration_document(row)
            log_change(connection, caller, "calibration.made", now=now, subject=row["id"], document=row["result"])
            keep_answer(connection, caller.agency_id, key, document, now, self._ttl)
        return document, False

    def get(self, caller: Caller, calibration_id: str) -> dict[str, Any]:
        """One calibration."""
        with self._database.read() as connection:
            return calibration_document(store.get_calibration(connection, caller.agency_id, calibration_id))

    def page(
        self, caller: Caller, *, before: str | None = None, limit: int = 100
    ) -> tuple[list[dict[str, Any]], str | None]:
        """A page of calibrations, newest first, and the id to continue before if there may be more."""
        with self._database.read() as connection:
            rows = store.list_calibrations(connection, caller.agency_id, before=before, limit=limit + 1)
        page = [calibration_document(row) for row in rows[:limit]]
        return page, page[-1]["id"] if len(rows) > limit else None


def calibration_document(row: Row | Mapping[str, Any]) -> dict[str, Any]:
    """A calibration as clients see it."""
    return {"id": row["id"], "created_at": row["created_at"], "who": row["who"], **row["result"]}


def calibration_result(found: CameraCalibration, board: CalibrationBoard) -> dict[str, Any]:
    """What is kept of a calibration; `camera` has the members of a context's camera."""
    used = [view for view in found.views if view.fault is None]
    return {
        "decoder": f"waymark {__version__} {VERSION}",
        "summary": f"{len(used)} of {len(found.views)} photos used, reprojection error {found.rms_px:.3f} px, "
        f"focal length {found.parameters['fx_px']:.1f} ± {found.sigma['fx_px']:.1f} px, "
        f"{found.coverage:.0%} of the image covered",
        "camera": {
            "width_px": found.width_px,
            "height_px": found.height_px,
            **found.parameters,
            "distortion": list(found.distortion),
        },
        "sigma": {**found.sigma, "distortion": list(found.distortion_sigma)},
        "rms_px": found.rms_px,
        "coverage": {"share": found.coverage, "cells": found.covered.astype(int).tolist()},
        "tilt_spread_deg": found.tilt_spread_deg,
        "board": {**asdict(board), "dictionary": DICTIONARY},
        "views": [_view(view) for view in found.views],
    }


def _view(view: ViewReport) -> dict[str, Any]:
    figures = {"rms_px": view.rms_px, "tilt_deg": view.tilt_deg, "edge_width_px": view.edge_width_px}
    return {
        "photo": view.photo,
        "name": view.name,
        "used": view.fault is None,
        "reason": str(view.fault) if view.fault is not None else None,
        "detail": view.detail or None,
        "corners": view.corners,
        **{name: None if value is None else round(value, 3) for name, value in figures.items()},
    }


def _check_count(photos: tuple[tuple[str, bytes], ...]) -> None:
    if not photos:
        raise UnreadableUpload(
            "there is no photo in the form", field="photos", limit="one ZIP, or several photos", cure="send 12 to 20"
        )
    if len(photos) > MAX_PHOTOS:
        raise UploadTooLarge(
            f"there are {len(photos)} photos", field="photos", limit=f"{MAX_PHOTOS} photos", cure="send 12 to 20"
        )
