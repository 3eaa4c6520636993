"""Photos of printed plates, graded inside a decoder process."""

from __future__ import annotations

from app.decoders.plate.print_grade import grade_print
from app.formats.images import load_image
from app.jobs.memory_limit import memory_is_the_limit
from app.planning.predict.printed_plate import DesignSpeed, predict_print
from app.plots.print_report import PrintReport, write_print_report
from app.services.markers.print_documents import NOTES, print_grade_document
from app.services.markers.print_task import GradedPhoto, PrintGradeTask

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
