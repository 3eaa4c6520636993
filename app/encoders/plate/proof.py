"""Self-proof: before an artwork is handed out its drawing is rendered and read back.

The reader is handed in, since encoders know no decoders; the services wire the two.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from app.encoders.plate.drawing import FACE_LAYERS, Drawing, FloatArray
from app.encoders.plate.raster import Image, paint
from app.errors import ProofFailed
from app.markers.plate import PlateCode, PlateGeometry
from app.markers.reading import PlateOutcome, PlateReading

PlateReader = Callable[[Image, PlateGeometry], Sequence[PlateReading]]
"""Reads an image, (H, W, 3) BGR, given the geometry to expect."""

UNIT_PX = 12.0
_ROAD_PX = 36
_ROAD_GREY = 96
_OVERSAMPLING = 2
_CORNER_TOLERANCE_PX = 1.5


@dataclass(frozen=True, slots=True)
class PlateProof:
    """What the reader made of a rendered plate.

    Attributes
    ----------
    digits : str
        As read.
    confidence : float
        The reader's, 0 to 1.
    corner_error_px : float
        Largest distance of a corner from where it was drawn; NaN where the reader gives no corners. [px]
    """

    digits: str
    confidence: float
    corner_error_px: float


def render_face(drawing: Drawing, *, px_per_mm: float, plate: int = 0) -> tuple[Image, FloatArray]:
    """What a camera straight above sees of a plate that lies in asphalt.

    Parameters
    ----------
    drawing : Drawing
        The same that is given to the writers.
    px_per_mm : float
        Scale. [px/mm]
    plate : int
        Which of the sheet's plates.

    Returns
    -------
    image : ndarray of uint8, shape (H, W, 3)
        BGR, without anything of the margin, with 36 px of road round the plate.
    corners_px : ndarray, shape (4, 2)
        Outer corners clockwise from the upper left, pixel centres at integers. [px]
    """
    left, bottom, right, top = drawing.trim_mm[plate]
    fine = px_per_mm * _OVERSAMPLING
    face = np.empty((round((top - bottom) * fine), round((right - left) * fine), 3), dtype=np.uint8)
    paint(face, drawing, FACE_LAYERS, fine, (left, top))
    height, width = (max(1, round(side / _OVERSAMPLING)) for side in face.shape[:2])
    image = np.full((height + 2 * _ROAD_PX, width + 2 * _ROAD_PX, 3), _ROAD_GREY, dtype=np.uint8)
    shrunk = cv2.resize(face, (width, height), interpolation=cv2.INTER_AREA)
    image[_ROAD_PX:-_ROAD_PX, _ROAD_PX:-_ROAD_PX] = shrunk
    low, far_x, far_y = _ROAD_PX - 0.5, _ROAD_PX + width - 0.5, _ROAD_PX + height - 0.5
    return image, np.array([(low, low), (far_x, low), (far_x, far_y), (low, far_y)])


def prove_plate(
    drawing: Drawing, code: PlateCode, geometry: PlateGeometry, read: PlateReader, *, plate: int = 0
) -> PlateProof:
    """Render a drawing's face and demand that it reads back as its own code, in place and the right way up.

    Raises
    ------
    ProofFailed
        Nothing, more than one plate, other digits, or corners away from where they were drawn.
    """
    image, corners_px = render_face(drawing, px_per_mm=UNIT_PX / geometry.unit_mm, plate=plate)
    readings = [r for r in read(image, geometry) if r.outcome is PlateOutcome.READ]
    if len(readings) != 1:
        raise _failure(drawing, f"{len(readings)} plates were read instead of one")
    reading = readings[0]
    if reading.digits != code.digits:
        raise _failure(drawing, f"it reads {reading.digits} instead of {code.digits}")
    error_px = float("nan")
    if reading.corners_px is not None:
        error_px = float(np.linalg.norm(reading.corners_px - corners_px, axis=1).max())
        if error_px > _CORNER_TOLERANCE_PX:
            raise _failure(drawing, f"its corners are {error_px:.1f} px from where they were drawn")
    return PlateProof(code.digits, reading.confidence, error_px)


def _failure(drawing: Drawing, what: str) -> ProofFailed:
    return ProofFailed(
        f"the artwork of {drawing.title} failed its proof: {what}",
        field="artwork",
        limit="the drawing must read back as its own code",
        cure="nothing was handed out; report this with the plate's id",
    )
