"""Self-proof: before an artwork is handed out its drawing is rendered and read back.

The reader is handed in, since encoders know no decoders; the services wire the two.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import ceil, floor

import cv2
import numpy as np
import numpy.typing as npt

from app.encoders.plate.drawing import FACE_LAYERS, INKS, Boxes, Drawing, Shape, box_points
from app.encoders.plate.writers import Image
from app.errors import ProofFailed
from app.markers.plate import PlateCode, PlateGeometry
from app.markers.reading import PlateOutcome, PlateReading
from app.values import Floats

PlateReader = Callable[[Image, PlateGeometry], Sequence[PlateReading]]
"""Reads an image, (H, W, 3) BGR, given the geometry to expect."""

UNIT_PX = 12.0
_ROAD_PX = 36
_ROAD_GREY = 96
_LENS_PX = 0.7
_FINE = 4
_CORNER_TOLERANCE_PX = 1.5


@dataclass(frozen=True, slots=True)
class PlateProof:
    """What the reader made of a rendered plate."""

    digits: str  # as read
    confidence: float  # the reader's, 0 to 1
    # [px] largest distance of a corner from where it was drawn; NaN where the reader gives no corners
    corner_error_px: float


def render_face(drawing: Drawing, *, px_per_mm: float, plate: int = 0) -> tuple[Image, Floats]:
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
        BGR, without anything of the margin, with 36 px of road round the plate, through a slightly soft lens.
    corners_px : ndarray, shape (4, 2)
        Outer corners clockwise from the upper left, pixel centres at integers. [px]
    """
    left, bottom, right, top = drawing.trim_mm[plate]
    shape = (ceil((top - bottom) * px_per_mm) + 2 * _ROAD_PX, ceil((right - left) * px_per_mm) + 2 * _ROAD_PX)
    image = np.full((*shape, 3), _ROAD_GREY, dtype=np.float32)

    def pixels(points_mm: Floats) -> Floats:
        corner_mm, scale = np.array([left, top]), np.array([px_per_mm, -px_per_mm])
        points_px: Floats = (points_mm - corner_mm) * scale + (_ROAD_PX - 0.5)
        return points_px

    by_layer = drawing.by_layer()
    for layer in FACE_LAYERS:
        colour = np.array(INKS[layer].rgb[::-1], dtype=np.float32)
        for part in by_layer.get(layer, ()):
            if isinstance(part, Boxes):
                inside = (part.boxes_mm >= [left, bottom, left, bottom]) & (part.boxes_mm <= [right, top, right, top])
                boxes = part.boxes_mm[inside.all(axis=1)]
                _blend_boxes(image, pixels(boxes[:, [0, 3]]), pixels(boxes[:, [2, 1]]), colour)
            elif isinstance(part, Shape):
                centre_x, centre_y = part.points_mm.mean(axis=0)
                if left < centre_x < right and bottom < centre_y < top:
                    _blend_shape(image, pixels(part.points_mm), colour)
            else:
                raise TypeError(f"a face has areas only, not {type(part).__name__}")
    soft = cv2.GaussianBlur(np.round(image).astype(np.uint8), (5, 5), _LENS_PX)
    return np.asarray(soft, dtype=np.uint8), pixels(box_points(left, bottom, right, top))


def _blend_boxes(
    image: npt.NDArray[np.float32],
    upper_left_px: Floats,
    lower_right_px: Floats,
    colour: npt.NDArray[np.float32],
) -> None:
    """Paint rectangles; a pixel at an edge takes the share that is covered, exactly."""
    for (x0, y0), (x1, y1) in zip(upper_left_px.tolist(), lower_right_px.tolist(), strict=True):
        row, rows = _cover_span(y0, y1)
        column, columns = _cover_span(x0, x1)
        region = image[row : row + len(rows), column : column + len(columns)]
        region += (rows[:, None] * columns)[:, :, None] * (colour - region)


def _blend_shape(image: npt.NDArray[np.float32], points_px: Floats, colour: npt.NDArray[np.float32]) -> None:
    """Paint a polygon; the share of a pixel that is covered is counted on a finer grid."""
    low, high = np.floor(points_px.min(axis=0)).astype(int), np.ceil(points_px.max(axis=0)).astype(int)
    width, height = (high - low + 1).tolist()
    fine = np.zeros((height * _FINE, width * _FINE), dtype=np.uint8)
    points = (points_px - low + 0.5) * _FINE - 0.5
    cv2.fillPoly(fine, [np.round(points * 16).astype(np.int32)], (255,), cv2.LINE_8, 4)
    cover = cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32) / 255
    region = image[low[1] : low[1] + height, low[0] : low[0] + width]
    region += cover[:, :, None] * (colour - region)


@lru_cache(maxsize=4096)
def _cover_span(low: float, high: float) -> tuple[int, npt.NDArray[np.float32]]:
    """First pixel that lies between two positions at all, and the shares of it and those that follow."""
    first, last = floor(low + 0.5), ceil(high - 0.5)
    shares = np.ones(last - first + 1, dtype=np.float32)
    shares[0] -= low + 0.5 - first
    shares[-1] -= last + 0.5 - high
    return first, shares


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
