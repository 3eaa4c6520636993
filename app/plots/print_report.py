"""A print grade as a page in PDF: the plate rectified, its grid by grade, the table of parameters, the prediction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING

import cv2
import numpy as np

from app.encoders.pdf import Canvas, EmbeddedFont, PdfFile
from app.errors import InvalidParameter
from app.markers.print_grade import THRESHOLDS, PrintGrade, PrintParameter, PrintParameterName, PrintPrediction

if TYPE_CHECKING:
    from app.planning.rules import CameraRules

PAGE_MM = (210.0, 297.0)
_LEFT, _RIGHT = 15.0, 195.0
_REGULAR, _BOLD = "R", "B"
_BLACK, _GREY, _LIGHT = "#1a1a1a", "#666666", "#d9d9d9"
GRADE_COLOURS = ("#c0392b", "#e67e22", "#d4ac0d", "#7fb347", "#2e8b57")
"""Of the grades 0 to 4."""
_PICTURE_MM = 78.0
_PICTURE_TOP = 236.0
_COLUMNS = (_LEFT, 62.0, 80.0, 92.0)  # of the table: parameter, value, grade, finding
_JPEG_QUALITY = 90


@dataclass(frozen=True, slots=True)
class PrintReport:
    """What the page shows."""

    grade: PrintGrade
    prediction: PrintPrediction
    camera: CameraRules  # of the vehicles
    sha256: str  # of the photo
    at: datetime  # of the request
    marker_id: str | None
    decoder: str  # with its version
    notes: Sequence[str]  # what a photo does not show


def write_print_report(report: PrintReport) -> bytes:
    """One page in A4. The same report gives the same bytes."""
    fonts = {_REGULAR: EmbeddedFont(), _BOLD: EmbeddedFont(bold=True)}
    page = _Page(fonts)
    _draw_head(page, report)
    page.canvas.picture("Plate", _LEFT, _PICTURE_TOP - _PICTURE_MM, _PICTURE_MM, _PICTURE_MM)
    _draw_grid(page, report.grade, _RIGHT - _PICTURE_MM, _PICTURE_TOP)
    bottom = _draw_table(page, report.grade.parameters, _PICTURE_TOP - _PICTURE_MM - 13.0)
    bottom = _draw_prediction(page, report, bottom - 4.0)
    _draw_foot(page, report, bottom - 3.0)
    file = PdfFile(f"Print grade {report.grade.code.digits}")
    face = report.grade.face
    done, jpeg = cv2.imencode(".jpg", face, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    if not done:
        raise InvalidParameter("the plate's picture cannot be coded as JPEG", field="photo")
    picture = file.add_jpeg(jpeg.tobytes(), face.shape[1], face.shape[0])
    names = " ".join(f"/{name} {font.add_to(file)} 0 R" for name, font in fonts.items())
    resources = file.add(f"<< /Font << {names} >> /XObject << /Plate {picture} 0 R >> >>".encode())
    file.add_page({"MediaBox": (0.0, 0.0, *PAGE_MM)}, resources, page.canvas.content())
    return file.to_bytes()


class _Page:
    """Texts on a page, which wrap."""

    def __init__(self, fonts: dict[str, EmbeddedFont]) -> None:
        self._fonts = fonts
        self.canvas = Canvas(fonts)

    def text(self, x: float, y: float, text: str, points: float = 8.0, *, bold: bool = False, colour: str = _BLACK,
             anchor: str = "start") -> None:  # fmt: skip
        """A line."""
        font = _BOLD if bold else _REGULAR
        self.canvas.text(x, y, text, font=font, points=points, colour=colour, anchor=anchor)

    def paragraph(self, x: float, y: float, text: str, width_mm: float, points: float, colour: str = _BLACK) -> float:
        """Lines no wider than a width; returns the place of the next line."""
        line = ""
        for word in [*text.split(), ""]:
            longer = f"{line} {word}".strip()
            if not word or self._fonts[_REGULAR].width_mm(longer, points) > width_mm:
                self.text(x, y, line, points, colour=colour)
                y -= points * 0.46
                line = word
            else:
                line = longer
        return y


def _draw_head(page: _Page, report: PrintReport) -> None:
    grade, geometry = report.grade, report.grade.geometry
    page.text(_LEFT, 277.0, "Print grade", 16.0, bold=True)
    page.text(_LEFT, 270.0, f"Plate {grade.code.digits} ({grade.code.scheme})", 10.0)
    source = f"marker {report.marker_id}" if report.marker_id else "declared" if grade.expected else "as read"
    page.text(
        _LEFT, 264.5,
        f"{geometry.n} x {geometry.n} units of {geometry.unit_mm:g} mm, gaps of {geometry.gap_mm:g} mm; {source}", 8.0,
    )  # fmt: skip
    page.text(_LEFT, 260.0, f"{report.at:%Y-%m-%d %H:%M} UTC; {report.decoder}", 8.0, colour=_GREY)
    page.text(_LEFT, 255.5, f"photo SHA-256 {report.sha256}", 6.5, colour=_GREY)
    colour = GRADE_COLOURS[int(grade.overall)]
    page.canvas.box(_RIGHT - 32.0, 254.0, 32.0, 28.0, fill=colour)
    page.text(_RIGHT - 16.0, 264.0, grade.letter, 40.0, bold=True, colour="#ffffff", anchor="middle")
    page.text(_RIGHT - 16.0, 256.5, f"{grade.overall:.1f} of 4.0", 8.0, colour="#ffffff", anchor="middle")
    page.text(_LEFT, _PICTURE_TOP + 2.0, "The plate, rectified, in even light", 8.0, bold=True)
    page.text(_RIGHT - _PICTURE_MM, _PICTURE_TOP + 2.0, "Reflectance margin of the units [%]", 8.0, bold=True)


def _draw_grid(page: _Page, grade: PrintGrade, left: float, top: float) -> None:
    """The units coloured by their grades, with their margins; wrong ones are crossed out."""
    n = grade.geometry.n
    scale = _PICTURE_MM / grade.geometry.side_mm
    pitch, side, gap = (v * scale for v in (grade.geometry.pitch_mm, grade.geometry.unit_mm, grade.geometry.gap_mm))
    limits = THRESHOLDS[PrintParameterName.REFLECTANCE_MARGIN]
    for row, column in np.ndindex(n, n):
        x, y = left + gap + column * pitch, top - gap - row * pitch - side
        margin = float(grade.modulation[row, column])
        if np.isnan(margin):
            page.canvas.box(x, y, side, side, fill=_LIGHT)
            continue
        page.canvas.box(x, y, side, side, fill=GRADE_COLOURS[int(limits.grade(100 * margin))])
        page.text(
            x + side / 2, y + side / 2 - 1.0, f"{100 * max(margin, 0):.0f}", 6.5, colour="#ffffff", anchor="middle"
        )
        if grade.wrong[row, column]:
            for ends in (((x, y), (x + side, y + side)), ((x, y + side), (x + side, y))):
                page.canvas.lines(ends, width_mm=0.5, colour=_BLACK)
    for k, letter in enumerate("ABCDF"):
        x = left + 14.0 * k
        page.canvas.box(x, top - _PICTURE_MM - 5.0, 3.5, 3.5, fill=GRADE_COLOURS[4 - k])
        page.text(x + 4.5, top - _PICTURE_MM - 4.4, letter, 7.0)


def _draw_table(page: _Page, parameters: Sequence[PrintParameter], y: float) -> float:
    for x, label in zip(_COLUMNS, ("parameter", "value", "grade", "finding and cure"), strict=True):
        page.text(x, y, label, 7.5, bold=True)
    page.canvas.lines(((_LEFT, y - 1.5), (_RIGHT, y - 1.5)), width_mm=0.25, colour=_BLACK)
    y -= 5.5
    for parameter in parameters:
        value = f"{parameter.value:.1f} %" if parameter.unit == "%" else f"{parameter.value:.3g}"
        page.text(_COLUMNS[0], y, str(parameter.name).replace("-", " "), 7.5)
        page.text(_COLUMNS[1], y, value, 7.5)
        page.canvas.box(_COLUMNS[2], y - 0.9, 6.0, 3.8, fill=GRADE_COLOURS[int(parameter.grade)])
        page.text(_COLUMNS[2] + 3.0, y, parameter.letter, 7.5, bold=True, colour="#ffffff", anchor="middle")
        text = f"{parameter.finding}. Cure: {parameter.cure}" if parameter.cure else parameter.finding
        y = page.paragraph(_COLUMNS[3], y, text, _RIGHT - _COLUMNS[3], 6.8)
        page.canvas.lines(((_LEFT, y + 1.2), (_RIGHT, y + 1.2)), width_mm=0.1, colour=_LIGHT)
        y -= 1.6
    return y


def _draw_prediction(page: _Page, report: PrintReport, y: float) -> float:
    found, camera = report.prediction, report.camera
    sure = "will be read" if found.will_be_read else "will not be read reliably"
    page.text(_LEFT, y, f"At {found.speed_kmh:g} km/h the plate {sure}", 9.0, bold=True)
    text = (
        f"Camera {camera.name}, {camera.width_px} x {camera.height_px} px, "
        f"{camera.frames_per_s:g} frames/s: {found.readable_frames_per_pass:.1f} readable frames a pass; predicted "
        f"read rate {found.read_rate:.1%} (faultless plate {found.faultless_read_rate:.1%}); units must appear "
        f"{found.unit_height_ratio:.2f} times as high as a faultless plate's. {found.basis}"
    )
    return page.paragraph(_LEFT, y - 4.5, text, _RIGHT - _LEFT, 7.0)


def _draw_foot(page: _Page, report: PrintReport, y: float) -> None:
    view = report.grade.view
    focal = "of the EXIF" if view.focal_length_source == "exif" else "assumed"
    text = (
        f"Photo: the plate covers {view.side_px:.0f} px, tilt {view.tilt_deg:.1f} degrees (focal length {focal}), "
        f"edges {view.edge_mm:.2f} mm, light varies by the factor {view.light_ratio:.2f}."
    )
    for line in (text, *report.notes):
        y = page.paragraph(_LEFT, y, line, _RIGHT - _LEFT, 6.5, _GREY)
