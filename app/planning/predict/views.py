"""Pictures of what a camera sees, as values; app/planning/predict/camera_view.py renders them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from app.errors import InvalidParameter
from app.planning.rules import CameraRules

MAX_VIEW_PIXELS = 9_000_000
"""Pixels of a picture at most. Source: chosen by hand: 3840 x 2160, two seconds of a processor."""


class ViewReading(StrEnum):
    """How the plate was read in a picture."""

    ALONE = "alone"
    WITH_REGISTRY = "with-registry"
    NOT_READ = "not-read"


@dataclass(frozen=True, slots=True)
class CameraView:
    """A picture and what was read in it.

    Attributes
    ----------
    jpeg : bytes
    corners_px : tuple of (x, y)
        Outer corners of the plate, clockwise from the triangle's; empty where it is not in view. [px]
    reading : ViewReading
        Read from the picture alone; or only by a vehicle that knows the plate and its neighbours; or not.
    confidence : float
        Of the reading, 0 to 1.
    exposure_s : float
        Of the camera; by night at least as long as the light requires. [s]
    """

    jpeg: bytes
    corners_px: tuple[tuple[float, float], ...]
    reading: ViewReading
    confidence: float
    exposure_s: float


def check_view_size(rules: CameraRules) -> None:
    """Refuse a camera whose pictures are too large to render.

    Raises
    ------
    InvalidParameter
        They are.
    """
    pixels = rules.width_px * rules.height_px
    if pixels > MAX_VIEW_PIXELS:
        raise InvalidParameter(
            f"the picture would have {pixels / 1e6:.1f} million pixels",
            field="camera.width_px",
            limit=f"{MAX_VIEW_PIXELS / 1e6:g} million pixels",
            cure="choose a smaller width and height",
        )
