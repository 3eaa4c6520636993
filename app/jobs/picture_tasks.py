"""Pictures that are no frames of a drive, inside a decoder process: boards, prints, views, photos, artwork."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np

from app.calibration.board_view import BoardView, CameraCalibration, Photo, ViewFault, find_board
from app.calibration.calibrate import calibrate_camera
from app.decoders.plate.print_grade import grade_print
from app.encoders.plate.bundle import plate_files, sheet_files
from app.errors import UnreadableUpload, UnsupportedUpload, UploadTooLarge, WaymarkError
from app.formats.format import SpooledFile, is_archive, read_members
from app.formats.images import load_image
from app.jobs.frame_tasks import memory_is_the_limit
from app.jobs.plan_tasks import read_face
from app.planning.predict.printed_plate import DesignSpeed, predict_print, render_view
from app.planning.predict.rates import CameraView
from app.plots.print_report import PrintReport, write_print_report
from app.services.fleet.calibrations import MAX_PHOTOS, CalibrationTask
from app.services.markers.print_documents import NOTES, print_grade_document
from app.services.markers.tasks import (
    CameraViewTask,
    DrawPlateTask,
    Files,
    GradedPhoto,
    PrintGradeTask,
    WriteSheetsTask,
)
from app.services.public_pages.pages import JPEG_QUALITY, MAX_SIDE_PX, ReportPhotoTask

# === Photos of a calibration board, read and calibrated inside a decoder process.


PROCESSOR_S = 30.0
"""Time for all photos of a calibration. [s] A second each of more than are needed."""
WITHOUT_BOARD = 8
"""Photos after which it is clear that none shows the board. Two thirds of those that are needed."""
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


# === Photos of printed plates, graded inside a decoder process.


_KMH = 3.6  # km/h in a metre a second


def grade_photo(task: PrintGradeTask, _before: None) -> GradedPhoto:
    """Load a photo, grade the plate in it, and predict whether it is read at the design speed."""
    with memory_is_the_limit("photo", "send a photo of 12 megapixels or fewer"):
        frame = load_image(task.photo.read(), task.limits)
        grade = grade_print(frame.pixels, code=task.code, geometry=task.geometry, focal_35mm=frame.header.focal_35mm)
        design = DesignSpeed(task.camera, task.speed_kmh / _KMH)
        prediction = predict_print(grade.reflectance, grade.code, grade.geometry, design)
        document = print_grade_document(
            grade, prediction, design, frame.header,
            sha256=task.photo.sha256, at=task.at, marker_id=task.marker_id,
        )  # fmt: skip
        if not task.as_pdf:
            return GradedPhoto(document)
        report = PrintReport(
            grade, prediction, design, task.photo.sha256, task.at, task.marker_id, document["decoder"],
            document["prediction"]["basis"], NOTES,
        )  # fmt: skip
        return GradedPhoto(document, write_print_report(report))


# === Pictures of what a camera sees, rendered and decoded inside a decoder process.


def render_camera_view(task: CameraViewTask, _before: None) -> CameraView:
    """Render one frame and decode it."""
    with memory_is_the_limit("picture", "choose a camera with fewer pixels"):
        return render_view(
            task.code, task.geometry, task.camera, speed_mps=task.speed_mps, ahead_m=task.ahead_m, left_m=task.left_m,
            condition=task.condition,
        )  # fmt: skip


# === Photos of damage reports, written anew inside a decoder process.


def write_report_photo(task: ReportPhotoTask, _before: None) -> bytes:
    """Decode a photo and encode its pixels: nothing else of the file remains, EXIF with its position least of all."""
    with memory_is_the_limit("photo", "send a photo of 12 megapixels or fewer"):
        pixels: cv2.typing.MatLike = load_image(task.photo.read(), task.limits).pixels
        factor = MAX_SIDE_PX / max(pixels.shape[:2])
        if factor < 1.0:
            size = tuple(max(1, round(side * factor)) for side in pixels.shape[1::-1])
            pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
        done, content = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise UnreadableUpload("the photo cannot be written as a JPEG", field="photo")
    return content.tobytes()


# === Artwork of many plates, inside a decoder process.


def draw_plate(task: DrawPlateTask, _before: None) -> tuple[Files, dict[str, Any]]:
    """Draw a plate, read it back, and write its files."""
    return plate_files(task.order, task.name, task.options, read_face)


def write_sheets(task: WriteSheetsTask, _before: None) -> Files:
    """Write the sheets of all plates."""
    with memory_is_the_limit("sheet", "select fewer plates"):
        return sheet_files(task.orders, task.options)
