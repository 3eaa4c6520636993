"""Simulated photos of printed plates for tests."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from app.markers.plate import PlateCode, PlateGeometry
from app.simulation.plate_face import PlateLook
from benchmarks.scenes.printed_plate import PrintFaults, photograph_print, printed_face

GEOMETRY = PlateGeometry()
CODE = PlateCode("023792168411")
LOOK = PlateLook()
PHOTO_PX = (1600, 1200)


def photo_of(
    code: PlateCode = CODE,
    look: PlateLook = LOOK,
    faults: PrintFaults | None = None,
    *,
    geometry: PlateGeometry = GEOMETRY,
    seed: int = 1,
    side_px: float = 800.0,
    **view: Any,
) -> bytes:
    """A JPEG of a printed plate."""
    face = printed_face(code, geometry, look, faults or PrintFaults())
    view = {"size_px": PHOTO_PX, "tilt_deg": 6.0, "turn_deg": 17.0} | view
    return photograph_print(face, np.random.default_rng(seed), side_px=side_px, **view)


def pixels(photo: bytes) -> npt.NDArray[np.uint8]:
    """A photo decoded."""
    return np.asarray(cv2.imdecode(np.frombuffer(photo, np.uint8), cv2.IMREAD_COLOR), np.uint8)
