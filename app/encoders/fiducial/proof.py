"""Self-proof: a sign's drawing is rendered and read back by OpenCV's detector before it is handed out."""

from __future__ import annotations

import cv2
import numpy as np

from app.encoders.plate.drawing import Drawing
from app.encoders.plate.proof import render_face
from app.errors import ProofFailed
from app.markers.fiducial import FiducialCode, FiducialGeometry, get_dictionary

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
