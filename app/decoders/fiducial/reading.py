"""What was read of a fiducial sign in a frame."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from app.markers.fiducial import FiducialCode
from app.markers.reading import PlatePose


class FiducialOutcome(StrEnum):
    """Result of a candidate. Only READ carries a code."""

    READ = "read"
    UNSURE = "unsure"


@dataclass(frozen=True, slots=True)
class FiducialReading:
    """One candidate sign in a frame.

    Attributes
    ----------
    outcome : FiducialOutcome
    corners_px : ndarray, shape (4, 2)
        Outer corners of the border, clockwise from the sign's upper left, pixel centres at integers. [px]
    code : FiducialCode or None
    confidence : float
        Posterior probability of the most likely code, 0 to 1.
    bit_errors : int
        Modules that differ from the most likely code.
    contrast : float
        Quiet zone minus border. [grey levels]
    side_px : float
        Mean length of the sides. [px]
    pose : PlatePose or None
        Of a sign whose dimensions are known, in a frame whose camera is known. Its axes are x right, y travel, z up,
        as a plate's, whatever the sign's mounting.
    reason : str
        Why the code was refused.
    """

    family: ClassVar[str] = "fiducial"
    outcome: FiducialOutcome
    corners_px: npt.NDArray[np.float64]
    code: FiducialCode | None
    confidence: float
    bit_errors: int
    contrast: float
    side_px: float
    pose: PlatePose | None = None
    reason: str = ""
