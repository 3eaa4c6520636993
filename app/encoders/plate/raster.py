"""Drawing to pixels, for the PNG writer and for the proof."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
import numpy.typing as npt

from app.encoders.plate.colours import INKS
from app.encoders.plate.drawing import Boxes, Drawing, FloatArray, Layer, Modules, Part, Shape, Stroke
from app.encoders.plate.lettering import contours_mm

Image = npt.NDArray[np.uint8]
_SHIFT = 4
_SUBPIXELS = 1 << _SHIFT


def paint(
    image: Image, drawing: Drawing, layers: Iterable[Layer], px_per_mm: float, origin_mm: tuple[float, float]
) -> None:
    """Paint some layers of a drawing into an image.

    Parameters
    ----------
    image : ndarray of uint8, shape (H, W, 3), BGR
        Painted in place.
    drawing : Drawing
    layers : iterable of Layer
        Bottom to top.
    px_per_mm : float
        Scale. [px/mm]
    origin_mm : (x, y)
        Point of the sheet at the image's upper left corner (the outer corner of its first pixel). [mm]

    Notes
    -----
    Edges of rectangles fall on rounded positions measured from the origin, never on accumulated rounded sizes.
    """
    by_layer = drawing.by_layer()
    for layer in layers:
        for part in by_layer.get(layer, ()):
            _paint_part(image, part, px_per_mm, origin_mm)


def _paint_part(image: Image, part: Part, px_per_mm: float, origin_mm: tuple[float, float]) -> None:
    bgr = INKS[part.layer].rgb[::-1]
    if isinstance(part, (Boxes, Modules)):
        boxes = part.boxes_mm
        left, top = _edges_px(boxes[:, [0, 3]], px_per_mm, origin_mm).T.tolist()
        right, bottom = _edges_px(boxes[:, [2, 1]], px_per_mm, origin_mm).T.tolist()
        for x0, y0, x1, y1 in zip(left, top, right, bottom, strict=True):
            image[max(y0, 0) : max(y1, 0), max(x0, 0) : max(x1, 0)] = bgr
    elif isinstance(part, Shape):
        _fill(image, [part.points_mm], bgr, px_per_mm, origin_mm)
    elif isinstance(part, Stroke):
        points = _subpixels(part.points_mm, px_per_mm, origin_mm)
        thickness = max(1, round(part.width_mm * px_per_mm))
        cv2.polylines(image, [points], part.closed, bgr, thickness, cv2.LINE_AA, _SHIFT)
    else:
        _fill(image, contours_mm(part), bgr, px_per_mm, origin_mm)


def _edges_px(points_mm: FloatArray, px_per_mm: float, origin_mm: tuple[float, float]) -> npt.NDArray[np.intp]:
    """Rounded positions of edges from the image's corner, halves up."""
    offsets = (points_mm - np.array(origin_mm)) * np.array([px_per_mm, -px_per_mm])
    edges: npt.NDArray[np.intp] = np.floor(offsets + 0.5 + 1e-9).astype(np.intp)
    return edges


def _subpixels(points_mm: FloatArray, px_per_mm: float, origin_mm: tuple[float, float]) -> npt.NDArray[np.int32]:
    """Positions with pixel centres at integers, in fixed point for OpenCV."""
    offsets = (points_mm - np.array(origin_mm)) * np.array([px_per_mm, -px_per_mm]) - 0.5
    points: npt.NDArray[np.int32] = np.round(offsets * _SUBPIXELS).astype(np.int32)
    return points


def _fill(
    image: Image,
    contours: list[FloatArray],
    bgr: tuple[int, ...],
    px_per_mm: float,
    origin_mm: tuple[float, float],
) -> None:
    if contours:
        polygons = [_subpixels(contour, px_per_mm, origin_mm) for contour in contours]
        cv2.fillPoly(image, polygons, bgr, cv2.LINE_AA, _SHIFT)
