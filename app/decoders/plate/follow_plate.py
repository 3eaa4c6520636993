"""Views of a plate in earlier frames, in which its colours were not found.

Once a plate is found, its pose and the vehicle's speed predict where it was before. Its image, warped to that place, is
compared with the frame, and the plate is fitted where the two agree best.
"""

from __future__ import annotations

import cv2
import numpy as np

from app.decoders.plate import Array
from app.decoders.plate.evidence import PlateEvidence
from app.decoders.plate.fit import fit_plate, project
from app.decoders.plate.pose import marker_centroids
from app.decoders.plate.unit_likelihoods import unit_log_likelihoods
from app.markers.plate import PlateGeometry
from app.markers.reading import PlatePose
from app.sensors.camera import Camera

REACH_PX = 14
"""[px] from the predicted place within which a plate is searched. 0.5 degrees of pitch at a focal length of 1400 px."""
MIN_LIKENESS = 0.6
"""[1] normalised correlation with the plate's image in the other frame from which it is the plate. Plates in the drives
of `python -m benchmarks.video` have 0.8 to 0.97."""
MIN_UNIT_PX = 2.0
"""[px] size of a unit below which a view adds hardly anything. Source: `python -m benchmarks.video`: half of the
units differ from the plate's there, in compressed videos."""
MIN_EXPLAINED = 0.85
"""[1] share of the variance from which a view that was found so counts."""
SMOOTHING = 0.4
"""[px] blur of the warped image, for each pixel of the smaller one."""
_UNIT_SQUARE = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)


def predict_corners(pose: PlatePose, geometry: PlateGeometry, camera: Camera, advance_m: float) -> Array | None:
    """Corners in a frame that was taken some way further along, shape (4, 2); None where they are not ahead. [px]

    Parameters
    ----------
    pose, geometry, camera
        Of the plate in the frame where it was found.
    advance_m : float
        By which the vehicle had come nearer to the plate; negative in an earlier frame. [m]
    """
    object_m = np.column_stack([geometry.corners_mm / 1000, np.zeros(4)])
    in_camera = object_m @ pose.rotation.T + pose.translation_m - advance_m * camera.camera_from_vehicle[:, 0]
    if in_camera[:, 2].min() <= geometry.side_mm / 1000:
        return None
    zero, distortion = np.zeros(3), np.array(camera.distortion or (0.0,) * 4)
    return np.asarray(cv2.projectPoints(in_camera, zero, zero, camera.matrix, distortion)[0].reshape(-1, 2))


def is_large_enough(corners_px: Array, known: PlateEvidence) -> bool:
    """Whether a plate with these corners is of use."""
    sides_px = np.linalg.norm(np.roll(corners_px, -1, axis=0) - corners_px, axis=1)
    return bool(np.isfinite(sides_px).all() and np.sort(sides_px)[1] >= 0.9 * MIN_UNIT_PX * known.geometry.n)


def view_elsewhere(known: PlateEvidence, image: Array, other: Array, corners_px: Array) -> PlateEvidence | None:
    """Evidence of a plate in another frame than the one that it was found in.

    Parameters
    ----------
    known : PlateEvidence
        Of the plate in `image`.
    image, other : ndarray of uint8, shape (H, W, 3) or (H, W)
    corners_px : ndarray, shape (4, 2)
        About where it is in `other`. [px]

    Returns
    -------
    PlateEvidence or None
        None where it is not seen, out of view, or too small. It has no colours.
    """
    geometry = known.geometry
    shift = _best_shift(_grey(image), known.corners_px, _grey(other), corners_px)
    if shift is None:
        return None
    image_from_plate = cv2.getPerspectiveTransform(_UNIT_SQUARE, (corners_px + shift).astype(np.float32))
    fit = fit_plate(other, project(np.asarray(image_from_plate, float), marker_centroids(geometry)), geometry)
    if fit is None or fit.explained < MIN_EXPLAINED or fit.unit_px < MIN_UNIT_PX:
        return None
    if (fit.corners_px < 0).any() or (fit.corners_px > np.array([other.shape[1], other.shape[0]]) - 1).any():
        return None
    units = unit_log_likelihoods(fit, thermal=known.thermal)
    if units is None:
        return None
    extent_px = float(np.ptp(fit.corners_px, axis=0).min())
    return PlateEvidence(
        units, geometry, fit.corners_px, fit.corners_covariance_px2, fit.explained, fit.unit_px, extent_px,
        thermal=known.thermal,
    )  # fmt: skip


def _best_shift(image: Array, from_px: Array, other: Array, to_px: Array) -> Array | None:
    """Where the plate's image lies best, from the predicted place on, in whole pixels."""
    low = np.floor(to_px.min(axis=0)).astype(int) - 2
    size = np.ceil(to_px.max(axis=0)).astype(int) + 3 - low
    first = np.maximum(low - REACH_PX, 0)
    last = np.minimum(low + size + REACH_PX, [other.shape[1], other.shape[0]])
    if (last - first < size).any():
        return None
    areas = [max(cv2.contourArea(corners.astype(np.float32)), 1.0) for corners in (from_px, to_px)]
    shrinks = (areas[1] / areas[0]) ** 0.5
    around = _cut(image, from_px)
    pixels, origin = around
    if shrinks < 1:
        pixels = cv2.GaussianBlur(pixels, (0, 0), SMOOTHING / shrinks)
    warp = cv2.getPerspectiveTransform((from_px - origin).astype(np.float32), (to_px - low).astype(np.float32))
    template = cv2.warpPerspective(pixels, warp, (int(size[0]), int(size[1])), borderMode=cv2.BORDER_REPLICATE)
    scores = cv2.matchTemplate(other[first[1] : last[1], first[0] : last[0]], template, cv2.TM_CCOEFF_NORMED)
    _least, best, _where, at = cv2.minMaxLoc(scores)
    return np.array(at) + first - low if best >= MIN_LIKENESS else None


def _cut(image: Array, corners_px: Array) -> tuple[Array, Array]:
    """The image around a plate, and the pixel that it begins with."""
    margin = 0.3 * np.ptp(corners_px, axis=0) + 8
    low = np.maximum(np.floor(corners_px.min(axis=0) - margin), 0).astype(int)
    high = np.minimum(np.ceil(corners_px.max(axis=0) + margin), [image.shape[1], image.shape[0]]).astype(int)
    return image[low[1] : high[1], low[0] : high[0]], low


def _grey(image: Array) -> Array:
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
