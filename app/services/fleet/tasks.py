"""A camera calibrated from photos of a board, in a decoder process."""

from __future__ import annotations

import time
from collections.abc import Iterator

import cv2
import numpy as np

from app.calibration.board_view import BoardView, CameraCalibration, Photo, ViewFault, find_board
from app.calibration.calibrate import calibrate_camera
from app.errors import UnsupportedUpload, UploadTooLarge, WaymarkError
from app.formats.format import ArchiveLimits, SpooledFile, is_archive, read_members
from app.formats.images import ImageLimits, load_image
from app.sensors.camera import CalibrationBoard
from app.services.decoder_tasks import decoder_task, memory_is_the_limit

MAX_PHOTOS = 60
PROCESSOR_S = 30.0
"""Time for all photos of a calibration. [s] A second each of more than are needed."""
WITHOUT_BOARD = 8
"""Photos after which it is clear that none shows the board. Two thirds of those that are needed."""
_PHOTO = ("photo", "send photos at the camera's resolution")


@decoder_task(*_PHOTO)
def calibrate_photos(
    photos: tuple[tuple[str, SpooledFile], ...],
    board: CalibrationBoard,
    coefficients: int | None = None,
    limits: ImageLimits = ImageLimits(),
    archives: ArchiveLimits = ArchiveLimits(members=MAX_PHOTOS),
) -> CameraCalibration:
    """Find the board in each photo, one after the other, and calibrate the camera that took them.

    The others are not looked at if none of the first eight shows the board: agencies share this process.

    Parameters
    ----------
    photos : tuple of (str, SpooledFile)
        Names and contents; a ZIP stands for the photos in it.
    coefficients : int or None
        Of the distortion.
    limits : ImageLimits
        Of each photo.

    Raises
    ------
    CalibrationRefused
        The photos do not calibrate the camera.
    UploadTooLarge
        There are too many, or they take too long.
    """
    seen: list[Photo] = []
    last_s = time.process_time() + PROCESSOR_S
    for name, content in _each(photos, limits, archives):
        if len(seen) == MAX_PHOTOS:
            raise UploadTooLarge(
                "there are too many photos", field="photos", limit=f"{MAX_PHOTOS} photos", cure="send 12 to 20"
            )
        if time.process_time() > last_s:
            raise UploadTooLarge(
                f"the first {len(seen)} photos took all of the time",
                field="photos",
                limit=f"{PROCESSOR_S:g} s of a processor",
                cure="send 12 to 20 photos that show the board",
            )
        seen.append(_look(name, content, board, limits))
        if len(seen) == WITHOUT_BOARD and all(photo.view.fault is not None for photo in seen):
            break
    return calibrate_camera(seen, board, coefficients=coefficients)


def _each(
    photos: tuple[tuple[str, SpooledFile], ...], limits: ImageLimits, archives: ArchiveLimits
) -> Iterator[tuple[str, bytes | WaymarkError]]:
    for name, file in photos:
        if not is_archive(file.head()):
            yield name, _whole(file, limits)
            continue
        for member in read_members(file, archives):
            if not member.name.startswith("."):  # what a desktop leaves in a ZIP
                yield member.name, member.error or member.data


def _whole(file: SpooledFile, limits: ImageLimits) -> bytes | WaymarkError:
    if file.size > limits.file_bytes:
        return UploadTooLarge("the photo is too large", limit=f"{limits.file_bytes} bytes")
    return file.read()


def _look(name: str, content: bytes | WaymarkError, board: CalibrationBoard, limits: ImageLimits) -> Photo:
    try:
        if isinstance(content, WaymarkError):
            raise content
        with memory_is_the_limit(*_PHOTO):
            frame = load_image(content, limits)
            grey = cv2.cvtColor(frame.pixels, cv2.COLOR_BGR2GRAY)
            view = find_board(np.asarray(grey, np.uint8), board)
    except WaymarkError as error:
        fault = ViewFault.UNREADABLE
        if isinstance(error, UploadTooLarge):
            fault = ViewFault.TOO_LARGE
        elif isinstance(error, UnsupportedUpload):
            fault = ViewFault.NOT_A_PICTURE
        nothing = BoardView(np.empty(0, np.intp), np.empty((0, 2)), fault=fault, detail=error.message)
        return Photo(name, None, 0, nothing)
    header = frame.header
    return Photo(name, (header.width_px, header.height_px), header.orientation or 1, view)
