"""Fiducial sign -> artwork at true size, written by the writers of `app.encoders.plate`."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from app.encoders.plate.drawing import Boxes, Drawing, Layer, Part, Stroke, Text, box_points, fitted_height_mm, moved
from app.encoders.plate.face import (
    BLEED_MM,
    BOTTOM_MARGIN_MM,
    HAIRLINE_MM,
    SIDE_MARGIN_MM,
    TOP_MARGIN_MM,
    crop_marks,
    dimension,
    no_qr_code,
    qr_code,
)
from app.encoders.plate.proof import render_face
from app.errors import ProofFailed
from app.markers.fiducial import FiducialCode, FiducialGeometry, Mounting, SignImage, get_dictionary

# === A fiducial sign as a drawing in millimetres: its panel, its modules, and a margin for the workshop.


_TEXT_MM = 2.4
_ROW_MM = 5.2
_QR_SIDE_MM = 26.0
_UP = {Mounting.UPRIGHT: "this edge is up", Mounting.LYING: "this edge points in the direction of travel"}


@dataclass(frozen=True, slots=True)
class FiducialOrder:
    """One sign to make."""

    sign_id: str  # the registry's name for it
    code: FiducialCode
    geometry: FiducialGeometry
    record_url: str = ""  # address of the marker's public page, for the QR code on the margin; empty for none
    revision: int = 1  # revision of the record that the artwork shows


def encode_fiducial(order: FiducialOrder) -> Drawing:
    """Draw a sign at true size on a sheet with its margin.

    Returns
    -------
    Drawing
        The panel is the trim: the sign with its quiet zone. [mm]
    """
    panel = order.geometry.side_mm + 2 * order.geometry.quiet_mm
    width = max(panel, _QR_SIDE_MM + 60.0) + 2 * SIDE_MARGIN_MM
    left, bottom = (width - panel) / 2, BOTTOM_MARGIN_MM
    parts = moved((*_face(order), *_margin(order, panel / 2)), left + panel / 2, bottom + panel / 2)
    return Drawing(
        title=f"{order.sign_id} r{order.revision} {order.code.text}",
        width_mm=width,
        height_mm=panel + TOP_MARGIN_MM + BOTTOM_MARGIN_MM,
        parts=parts,
        trim_mm=((left, bottom, left + panel, bottom + panel),),
        bleed_mm=BLEED_MM,
    )


def _face(order: FiducialOrder) -> tuple[Part, ...]:
    """The white panel and the dark modules, as runs along the rows."""
    geometry = order.geometry
    modules = np.rot90(order.code.modules, 2) if geometry.image is SignImage.APRILTAG else order.code.modules
    half = geometry.side_mm / 2 + geometry.quiet_mm
    pitch = geometry.side_mm / len(modules)
    edges = np.diff(np.pad(modules.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    rows, starts = np.nonzero(edges == 1)
    ends = np.nonzero(edges == -1)[1]
    x, y = -geometry.side_mm / 2, geometry.side_mm / 2
    dark = np.stack([x + starts * pitch, y - (rows + 1) * pitch, x + ends * pitch, y - rows * pitch], axis=1)
    return Boxes(Layer.CODE_LIGHT, np.array([[-half, -half, half, half]])), Boxes(Layer.CODE_DARK, dark)


def _margin(order: FiducialOrder, half: float) -> tuple[Part, ...]:
    geometry = order.geometry
    room = 2 * half + 2 * SIDE_MARGIN_MM
    lines = (
        f"{order.code.text} of {order.code.dictionary}, {geometry.mounting}",
        f"black border {geometry.side_mm:g} mm, quiet zone {geometry.quiet_mm:g} mm, revision {order.revision}",
    )
    parts: list[Part] = [
        Stroke(Layer.CUT, box_points(-half, -half, half, half), HAIRLINE_MM, closed=True),
        *crop_marks(half),
        *dimension(half, f"{2 * half:g} mm panel"),
        Text(Layer.NOTE, order.sign_id, 0.0, half + 26.0, fitted_height_mm(order.sign_id, 4.0, room), "middle"),
        Text(Layer.NOTE, _UP[geometry.mounting], 0.0, half + 18.0, _TEXT_MM, "middle"),
    ]
    for k, line in enumerate(lines):
        y = -half - 28.0 - k * _ROW_MM
        parts.append(Text(Layer.NOTE, line, 0.0, y, fitted_height_mm(line, _TEXT_MM, room), "middle"))
    if order.record_url:
        parts.append(qr_code(order.record_url, -_QR_SIDE_MM / 2, -half - 38.0))
    else:
        parts += no_qr_code(0.0, -half - 38.0 - _QR_SIDE_MM / 2, "middle")
    return tuple(parts)


# === Self-proof: a sign's drawing is rendered and read back by OpenCV's detector before it is handed out.


_MODULE_PX = 12.0
"""Of a module in the rendering. [px]"""
_CORNER_TOLERANCE_PX = 1.5
"""The same as of plates (app.encoders.plate.proof). [px]"""


def prove_fiducial(drawing: Drawing, code: FiducialCode, geometry: FiducialGeometry) -> None:
    """Render a drawing's face and demand that OpenCV reads its code, in place and the right way up.

    Raises
    ------
    ProofFailed
        Nothing, more than one sign, another code, or corners away from where they were drawn.
    """
    dictionary = get_dictionary(code.dictionary)
    px_per_mm = _MODULE_PX * (dictionary.modules + 2) / geometry.side_mm
    image, panel_px = render_face(drawing, px_per_mm=px_per_mm)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary.opencv))
    corners, numbers, _rejected = cv2.aruco.ArucoDetector(words, parameters).detectMarkers(image)
    found = [] if numbers is None else [int(number) for number in numbers.ravel()]
    if found != [code.number]:
        raise _failure(drawing, f"OpenCV reads {found or 'nothing'} instead of {code.number}")
    inset_px = geometry.quiet_mm * px_per_mm
    drawn_px = panel_px + inset_px * np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)])
    if geometry.image is SignImage.APRILTAG:
        drawn_px = np.roll(drawn_px, 2, axis=0)
    error_px = float(np.linalg.norm(corners[0].reshape(4, 2) - drawn_px, axis=1).max())
    if error_px > _CORNER_TOLERANCE_PX:
        raise _failure(drawing, f"its corners are {error_px:.1f} px from where they were drawn")


def _failure(drawing: Drawing, what: str) -> ProofFailed:
    return ProofFailed(
        f"the artwork of {drawing.title} failed its proof: {what}",
        field="artwork",
        limit="the drawing must read back as its own code",
        cure="widen quiet_mm to one module at least; otherwise report this with the sign's id",
    )
