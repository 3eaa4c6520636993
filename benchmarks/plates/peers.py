"""Tags that a user would pick instead of a plate, through cv2.aruco with default parameters."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from app.simulation.conditions import Conditions
from app.simulation.plate_face import Face, grid_face
from app.simulation.plate_scene import FaceTruth

SIDE_M = 0.325  # footprint of the plate, the tag's white margin of one module included


@dataclass(frozen=True, slots=True)
class TagFamily:
    """A dictionary of cv2.aruco."""

    name: str
    dictionary: int
    modules: int


FAMILIES = (
    TagFamily("ArUco 4x4", cv2.aruco.DICT_4X4_50, 6),
    TagFamily("AprilTag 36h11", cv2.aruco.DICT_APRILTAG_36h11, 8),
)


def tag_face(family: TagFamily, number: int, conditions: Conditions, rng: np.random.Generator) -> Face:
    """A tag of the plate's footprint, materials, wear and light sources."""
    bits = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(family.dictionary), number, family.modules)
    white = np.pad(bits > 0, 1, constant_values=True)[..., None]
    cells = np.where(white, np.array(conditions.look.light), np.array(conditions.look.dark))
    return grid_face(cells, SIDE_M, conditions.wear, rng, conditions.look.led)


@lru_cache
def detector(family: TagFamily) -> cv2.aruco.ArucoDetector:
    """Detector with default parameters."""
    return cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(family.dictionary))


def reads_tag(family: TagFamily, number: int, image: npt.NDArray[np.uint8], truth: FaceTruth) -> bool:
    """Whether the detector names this tag at its place."""
    corners, numbers, _ = detector(family).detectMarkers(image)
    if not len(corners):
        return False
    centre, reach = truth.corners_px.mean(axis=0), max(truth.width_px, truth.height_px) / 2
    return any(
        int(found) == number and float(np.linalg.norm(quad[0].mean(axis=0) - centre)) < reach
        for quad, found in zip(corners, np.ravel(numbers), strict=True)
    )
