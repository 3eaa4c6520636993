"""Documents of print grades."""

from __future__ import annotations

from datetime import datetime

import numpy as np
import numpy.typing as npt
from typing_extensions import TypedDict

from app import __version__
from app.decoders.plate import DECODER_VERSION
from app.formats.images import ImageHeader
from app.markers.print_grade import LETTERS, PrintGrade, PrintParameter, PrintPrediction, PrintView

NOTES = (
    "Graded after ISO/IEC 15415; no conformance is claimed: a photo by hand is no calibrated reflectance scan.",
    "Reflectances are relative to the white of the plate: a white that is grey as a whole does not show.",
    "Lengths are relative to the drawing: a print at another scale does not show. Measure one side.",
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
    """The photo."""

    sha256: str
    width_px: int
    height_px: int
    taken_at: str | None


class PrintReadingDocument(TypedDict):
    """What the decoder reads from the photo without a registry."""

    outcome: str
    digits: str | None


class PrintGridDocument(TypedDict):
    """Units of the grid, row by row; null in the corner cells."""

    reflectance_margin: list[list[float | None]]
    wrong: list[list[bool]]


class PrintGradeDocument(TypedDict):
    """Grade of a printed plate by a photo. Nothing of it is stored."""

    graded_at: datetime
    decoder: str
    grade: float
    letter: str
    limited_by: list[str]
    plate: PrintedPlateDocument
    photo: PrintPhotoDocument
    view: PrintView
    reading: PrintReadingDocument
    parameters: list[PrintParameter]
    units: PrintGridDocument
    prediction: PrintPrediction
    notes: list[str]


def print_grade_document(
    grade: PrintGrade,
    prediction: PrintPrediction,
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
        "photo": {
            "sha256": sha256,
            "width_px": header.width_px,
            "height_px": header.height_px,
            "taken_at": header.taken,
        },
        "view": grade.view,
        "reading": {"outcome": str(grade.outcome), "digits": grade.read},
        "parameters": list(grade.parameters),
        "units": {"reflectance_margin": _grid(grade.modulation), "wrong": grade.wrong.tolist()},
        "prediction": prediction,
        "notes": list(NOTES),
    }


def _grid(values: npt.NDArray[np.float64]) -> list[list[float | None]]:
    return [[None if np.isnan(value) else round(float(value), 3) for value in row] for row in values]
