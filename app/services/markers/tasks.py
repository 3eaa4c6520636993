"""Artwork, print grades and camera views of plates in a decoder process."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

from app.encoders.plate import BundleOptions
from app.encoders.plate.bundle import plate_files, sheet_files
from app.encoders.plate.face import PlateOrder
from app.formats.format import SpooledFile
from app.formats.images import ImageLimits, load_image
from app.markers.plate import PlateCode, PlateGeometry
from app.planning.predict.rates import CameraView
from app.planning.proof.report import Condition
from app.planning.rules import CameraRules
from app.services.decoder_tasks import decoder_task
from app.services.markers.print_documents import NOTES, PrintGradeDocument, print_grade_document
from app.services.plans.tasks import read_face
from app.values import JsonObject

Files = list[tuple[str, bytes]]
_KMH = 3.6  # km/h in a metre a second


@decoder_task("plate", "select fewer plates")
def draw_plate(order: PlateOrder, name: str, options: BundleOptions) -> tuple[Files, JsonObject]:
    """Draw a plate, read it back, and write its files under this name: these, and its entry in the manifest."""
    return plate_files(order, name, options, read_face)


@decoder_task("sheet", "select fewer plates")
def write_sheets(orders: tuple[PlateOrder, ...], options: BundleOptions) -> Files:
    """Write the sheets to nest all plates on, and the quality sheets."""
    return sheet_files(orders, options)


@dataclass(frozen=True, slots=True)
class PrintedPlate:
    """What is known of a printed plate."""

    code: PlateCode | None  # what it should be; None: what the photo shows
    geometry: PlateGeometry | None  # of the drawing
    marker_id: str | None = None  # where the code and the geometry are from


@dataclass(frozen=True, slots=True)
class GradedPhoto:
    """The grade of a photo."""

    document: PrintGradeDocument
    pdf: bytes = b""  # empty unless it was asked for


@decoder_task("photo", "send a photo of 12 megapixels or fewer", is_long=False)
def grade_photo(
    photo: SpooledFile,
    at: datetime,
    plate: PrintedPlate,
    camera: CameraRules,
    speed_kmh: float,
    as_pdf: bool = False,
    limits: ImageLimits = ImageLimits(),
) -> GradedPhoto:
    """Load a JPEG or PNG, grade the plate in it, and predict whether it is read at the design speed.

    `at` is the time of the request.
    """
    from app.decoders.plate.print_grade import grade_print
    from app.planning.predict.printed_plate import DesignSpeed, predict_print
    from app.plots.print_report import PrintReport, write_print_report

    frame = load_image(photo.read(), limits)
    grade = grade_print(frame.pixels, code=plate.code, geometry=plate.geometry, focal_35mm=frame.header.focal_35mm)
    design = DesignSpeed(camera, speed_kmh / _KMH)
    prediction = predict_print(grade.reflectance, grade.code, grade.geometry, design)
    document = print_grade_document(
        grade, prediction, frame.header, sha256=photo.sha256, at=at, marker_id=plate.marker_id
    )
    if not as_pdf:
        return GradedPhoto(document)
    report = PrintReport(grade, prediction, camera, photo.sha256, at, plate.marker_id, document["decoder"], NOTES)
    return GradedPhoto(document, write_print_report(report))


@decoder_task("picture", "choose a camera with fewer pixels", is_long=False)
def render_camera_view(
    code: PlateCode,
    geometry: PlateGeometry,
    camera: CameraRules,
    speed_m_s: float,
    ahead_m: float,
    left_m: float,
    condition: Condition,
) -> CameraView:
    """Render a plate as a camera sees it, whose centre is so far ahead and to the left, and decode it."""
    from app.planning.predict.printed_plate import render_view

    return render_view(code, geometry, camera, speed_m_s=speed_m_s, ahead_m=ahead_m, left_m=left_m, condition=condition)
