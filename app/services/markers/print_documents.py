"""Documents of print grades."""

from __future__ import annotations

from datetime import datetime
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from typing_extensions import TypedDict

from app import __version__
from app.decoders.plate import DECODER_VERSION
from app.formats.images import ImageHeader
from app.markers.print_grade import LETTERS, THRESHOLDS, PrintGrade, PrintParameter, PrintView
from app.services.documents import document_of

if TYPE_CHECKING:
    from app.planning.predict.printed_plate import DesignSpeed, PrintPrediction

NOTES = (
    "Graded after ISO/IEC 15415; no conformance is claimed: a photo by hand is no calibrated reflectance scan.",
    "Reflectances are relative to the white of the plate: a white that is grey as a whole does not show.",
    "Lengths are relative to the drawing: a print at another scale does not show. Measure one side.",
)
_BASIS = (
    "{read} of {frames} frames of {passes} simulated passes by day, with the face as photographed and a white of "
    "{white:.0%}, were read with the registry, {alone} without; the fitted model of plans turns them into the rate. No "
    "rain, night or dirt."
)


class PrintedPlateDocument(TypedDict):
    """What the plate should be."""

    source: str
    marker_id: str | None
    scheme: str
    digits: str
    n: int
    unit_mm: float
    gap_mm: float


class PrintPhotoDocument(TypedDict):
    """The photo, and how it shows the plate."""

    sha256: str
    width_px: int
    height_px: int
    taken_at: str | None
    side_px: float
    tilt_deg: float
    edge_mm: float
    light_ratio: float
    white_level: float
    focal_length_source: str


class PrintReadingDocument(TypedDict):
    """What the decoder reads from the photo without a registry."""

    outcome: str
    digits: str | None


class ThresholdsDocument(TypedDict):
    """Values at which the grades end."""

    A: float
    B: float
    C: float
    D: float
    higher_is_better: bool
    source: str


class PrintParameterDocument(TypedDict):
    """A graded parameter."""

    name: str
    value: float
    unit: str
    grade: float
    letter: str
    thresholds: ThresholdsDocument
    finding: str
    cure: str | None
    row: int | None
    column: int | None


class PrintGridDocument(TypedDict):
    """Units of the grid, row by row; null in the corner cells."""

    reflectance_margin: list[list[float | None]]
    wrong: list[list[bool]]


class PrintPredictionDocument(TypedDict):
    """Whether vehicles that know the registry will read the plate."""

    speed_kmh: float
    camera: str
    condition: str
    readable_frames_per_pass: float
    simulated_frames: int
    frames_read: int
    frames_read_alone: int
    frames_wrong: int
    unit_height_ratio: float
    read_rate: float
    faultless_read_rate: float
    will_be_read: bool
    basis: str


class PrintGradeDocument(TypedDict):
    """Grade of a printed plate by a photo. Nothing of it is stored."""

    graded_at: datetime
    decoder: str
    grade: float
    letter: str
    limited_by: list[str]
    plate: PrintedPlateDocument
    photo: PrintPhotoDocument
    reading: PrintReadingDocument
    parameters: list[PrintParameterDocument]
    units: PrintGridDocument
    prediction: PrintPredictionDocument
    notes: list[str]


def print_grade_document(
    grade: PrintGrade,
    prediction: PrintPrediction,
    design: DesignSpeed,
    header: ImageHeader,
    *,
    sha256: str,
    at: datetime,
    marker_id: str | None,
) -> PrintGradeDocument:
    """A grade and a prediction as clients see them."""
    code, geometry = grade.code, grade.geometry
    return {
        "graded_at": at,
        "decoder": f"waymark {__version__} {DECODER_VERSION}",
        "grade": grade.overall,
        "letter": grade.letter,
        "limited_by": [] if grade.overall == len(LETTERS) - 1 else [str(name) for name in grade.limited_by],
        "plate": {
            "source": "marker" if marker_id else "declaration" if grade.expected else "photo",
            "marker_id": marker_id,
            "scheme": str(code.scheme),
            "digits": code.digits,
            "n": geometry.n,
            "unit_mm": geometry.unit_mm,
            "gap_mm": geometry.gap_mm,
        },
        "photo": _photo(grade.view, header, sha256),
        "reading": {"outcome": str(grade.outcome), "digits": grade.read},
        "parameters": [_parameter(parameter) for parameter in grade.parameters],
        "units": {"reflectance_margin": _grid(grade.modulation), "wrong": grade.wrong.tolist()},
        "prediction": _prediction(prediction, design),
        "notes": list(NOTES),
    }


def _photo(view: PrintView, header: ImageHeader, sha256: str) -> PrintPhotoDocument:
    return {
        "sha256": sha256,
        "width_px": header.width_px,
        "height_px": header.height_px,
        "taken_at": header.taken,
        "side_px": round(view.side_px, 1),
        "tilt_deg": round(view.tilt_deg, 1),
        "edge_mm": round(view.edge_mm, 2),
        "light_ratio": round(view.light_ratio, 2),
        "white_level": view.white_level,
        "focal_length_source": "exif" if view.focal_known else "assumed",
    }


def _parameter(parameter: PrintParameter) -> PrintParameterDocument:
    thresholds = THRESHOLDS[parameter.name]
    a, b, c, d = thresholds.limits
    row, column = parameter.unit_at or (None, None)
    return {
        "name": str(parameter.name),
        "value": parameter.value,
        "unit": thresholds.unit,
        "grade": parameter.grade,
        "letter": parameter.letter,
        "thresholds": {
            "A": a, "B": b, "C": c, "D": d, "higher_is_better": thresholds.rising, "source": thresholds.source,
        },
        "finding": parameter.finding,
        "cure": parameter.cure or None,
        "row": row,
        "column": column,
    }  # fmt: skip


def _grid(values: npt.NDArray[np.float64]) -> list[list[float | None]]:
    return [[None if np.isnan(value) else round(float(value), 3) for value in row] for row in values]


def _prediction(found: PrintPrediction, design: DesignSpeed) -> PrintPredictionDocument:
    basis = _BASIS.format(
        read=found.read, alone=found.read_alone, frames=found.frames, passes=found.passes, white=found.white_reflectance
    )
    return document_of(
        PrintPredictionDocument,
        found,
        speed_kmh=round(design.speed_m_s * 3.6, 3),
        camera=design.camera.name,
        condition="day",
        readable_frames_per_pass=round(found.readable_frames, 1),
        simulated_frames=found.frames,
        frames_read=found.read,
        frames_read_alone=found.read_alone,
        frames_wrong=found.wrong,
        unit_height_ratio=round(found.height_ratio, 2),
        read_rate=round(found.read_rate, 3),
        faultless_read_rate=round(found.faultless_read_rate, 3),
        basis=basis,
    )
