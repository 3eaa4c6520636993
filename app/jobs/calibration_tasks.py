"""Photos of a calibration board, read and calibrated inside a decoder process."""

from __future__ import annotations

import time
from collections.abc import Iterator

import cv2
import numpy as np

from app.calibration.board_view import BoardView, ViewFault, find_board
from app.calibration.calibrate import calibrate_camera
from app.calibration.results import CameraCalibration, Photo
from app.errors import UnsupportedUpload, UploadTooLarge, WaymarkError
from app.formats.archives import is_archive, read_members
from app.formats.images import load_image
from app.formats.spooled_file import SpooledFile
from app.jobs.memory_limit import memory_is_the_limit
from app.services.fleet.calibrations import MAX_PHOTOS, CalibrationTask

PROCESSOR_S = 30.0
"""Time for all photos of a calibration. [s] Source: by hand, a second each of more than are needed."""
WITHOUT_BOARD = 8
"""Photos after which it is clear that none shows the board. Source: by hand, two thirds of those that are needed."""
_PHOTO = ("photo", "send photos at the camera's resolution")


def calibrate_photos(task: CalibrationTask, _before: None) -> CameraCalibration:
    """Find the board in each photo, one after the other, and calibrate the camera that took them.

    The others are not looked at if none of the first eight shows the board: agencies share this process.

    Raises
    ------
    CalibrationRefused
        The photos do not calibrate the camera.
    UploadTooLarge
        There are too many, or they take too long.
    """
    photos: list[Photo] = []
    last_s = time.process_time() + PROCESSOR_S
    for name, content in _each(task):
        if len(photos) == MAX_PHOTOS:
            raise UploadTooLarge(
                "there are too many photos", field="photos", limit=f"{MAX_PHOTOS} photos", cure="send 12 to 20"
            )
        if time.process_time() > last_s:
            raise UploadTooLarge(
                f"the first {len(photos)} photos took all of the time",
                field="photos",
                limit=f"{PROCESSOR_S:g} s of a processor",
                cure="send 12 to 20 photos that show the board",
            )
        photos.append(_look(name, content, task))
        if len(photos) == WITHOUT_BOARD and all(photo.view.fault is not None for photo in photos):
            break
    with memory_is_the_limit(*_PHOTO):
        return calibrate_camera(photos, task.board, coefficients=task.coefficients)


def _each(task: CalibrationTask) -> Iterator[tuple[str, bytes | WaymarkError]]:
    for name, file in task.photos:
        if not is_archive(file.head()):
            yield name, _whole(file, task)
            continue
        for member in read_members(file, task.archives):
            if not member.name.startswith("."):  # what a desktop leaves in a ZIP
                yield member.name, member.error or member.data


def _whole(file: SpooledFile, task: CalibrationTask) -> bytes | WaymarkError:
    if file.size > task.images.file_bytes:
        return UploadTooLarge("the photo is too large", limit=f"{task.images.file_bytes} bytes")
    return file.read()


def _look(name: str, content: bytes | WaymarkError, task: CalibrationTask) -> Photo:
    try:
        if isinstance(content, WaymarkError):
            raise content
        with memory_is_the_limit(*_PHOTO):
            frame = load_image(content, task.images)
            grey = cv2.cvtColor(frame.pixels, cv2.COLOR_BGR2GRAY)
            view = find_board(np.asarray(grey, np.uint8), task.board)
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
