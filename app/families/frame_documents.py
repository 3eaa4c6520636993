"""Parts of readings as clients see them, which every family has."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from typing_extensions import TypedDict

from app.markers.reading import PlatePose


class PoseDocument(TypedDict):
    """Pose of a marker in the camera frame; the covariance is of rotation vector [rad] and translation [m]."""

    rotation: list[list[float]]
    translation_m: list[float]
    covariance: list[list[float]]
    reprojection_rms_px: float


def pose_document(pose: PlatePose | None) -> PoseDocument | None:
    """A pose, if there is one."""
    if pose is None:
        return None
    return {
        "rotation": pose.rotation.tolist(),
        "translation_m": pose.translation_m.tolist(),
        "covariance": pose.covariance.tolist(),
        "reprojection_rms_px": float(pose.reprojection_rms_px),
    }


def rounded(values: npt.NDArray[np.float64] | None, places: int) -> list[list[float]] | None:
    """The rows of an array, rounded."""
    return None if values is None else np.round(values, places).tolist()
