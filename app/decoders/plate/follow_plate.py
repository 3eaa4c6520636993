"""Views of a plate in earlier frames, in which its colours were not found.

Once a plate is found, its pose and the vehicle's speed predict where it was before. Its image, warped to that place, is
compared with the frame, and the plate is fitted where the two agree best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np

from app.decoders.plate import Array
from app.decoders.plate.confirm import Expected, with_unseen_damage
from app.decoders.plate.detect_blobs import difference_signal, half_planes
from app.decoders.plate.evidence import PlateEvidence, read_evidence
from app.decoders.plate.fit import fit_plate, project
from app.decoders.plate.marker_colours import measure_marker_colours
from app.decoders.plate.pose import marker_centroids, unit_edges, with_pose
from app.decoders.plate.unit_likelihoods import unit_log_likelihoods, with_hidden_markers
from app.markers.plate import PlateCode, PlateGeometry
from app.markers.reading import PlateOutcome, PlatePose, PlateReading
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
MIN_EXPECTED_UNIT_PX = 1.2
"""[px] height of a unit in the image from which on a plate is expected to be seen."""
MIN_EXPECTED_LIKENESS = 0.35
"""[1] normalised correlation with a plate's pattern from which on it is fitted. For speed: its units decide."""
PATTERN_UNIT_PX, DARK_GREY, LIGHT_GREY, GAP_GREY, MARKER_GREY = 6, 60, 200, 110, 120
"""[px, grey levels] resolution of a pattern, and its greys: a dark and a light unit, gaps, and markers."""
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
    return camera.project(in_camera)


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


@dataclass(frozen=True, slots=True)
class ExpectedPlate:
    """A plate that another frame of a drive shows, and where it may be in this one."""

    code: PlateCode
    geometry: PlateGeometry
    is_registered: bool  # a registered plate has its code
    # shape (K, 4, 2): [px] its corners under each hypothesis of how far the vehicle has come
    places_px: Array
    number: int  # of the other frame


def expect_plate(expected: Expected, camera: Camera) -> ExpectedPlate | None:
    """Where a plate that was read in one frame may be in another; None where it is out of view there."""
    reading = expected.reading
    code, geometry, pose = reading.code, reading.geometry, reading.pose
    if code is None or geometry is None or pose is None:
        return None
    placed = [predict_corners(pose, geometry, camera, advance_m) for advance_m in expected.advances_m]
    high = (camera.width_px - 1, camera.height_px - 1)
    seen = [one for one in placed if one is not None and (one >= 0).all() and (one <= high).all()]
    seen = [one for one in seen if np.ptp(one[:, 1]) >= MIN_EXPECTED_UNIT_PX * geometry.n]
    if not seen:
        return None
    return ExpectedPlate(code, geometry, reading.is_registered, np.array(seen), expected.number)


def find_expected(image: Array, expected: ExpectedPlate, camera: Camera | None = None) -> PlateReading | None:
    """The reading of a plate that is expected in a frame, by its pattern; None where it is not seen.

    Its units must show the code as those of a registered plate must (`decode_symbols`). No colours are needed, so that
    markers may be covered, mirrored over or too weak to be found.
    """
    corners_px = _most_alike(image, expected)
    if corners_px is None:
        return None
    missing = PlateOutcome.UNSURE, "found by the plate that another frame shows"
    reading, _evidence = read_pattern(image, corners_px, expected.geometry, (expected.code,), missing) or (None, None)
    if reading is None or reading.code is None or reading.code.digits != expected.code.digits:
        return None
    # the code came from another frame, not from the registry: it is as sure as there
    reading = replace(
        reading, from_codebook=False, is_registered=expected.is_registered, frames=(expected.number,)
    )  # fmt: skip
    return with_pose(with_unseen_damage(reading), camera)


def read_pattern(
    image: Array,
    corners_px: Array,
    geometry: PlateGeometry,
    codebook: Sequence[PlateCode],
    missing: tuple[PlateOutcome, str],
    tries: int = 1,
) -> tuple[PlateReading, PlateEvidence] | None:
    """The reading of a plate whose colours need not show, and its evidence; None where nothing is like a plate.

    Parameters
    ----------
    corners_px : ndarray, shape (4, 2)
        Where it may be, to half a unit. [px]
    codebook : sequence of PlateCode
        Codes that it may have.
    missing : tuple of PlateOutcome and str
        Why its digits do not count where no code of these, and no check, confirms them.
    tries : int
        As of `PlateEvidence`.
    """
    image_from_plate = cv2.getPerspectiveTransform(_UNIT_SQUARE, corners_px.astype(np.float32))
    fit = fit_plate(image, project(np.asarray(image_from_plate, float), marker_centroids(geometry)), geometry)
    units = None if fit is None else unit_log_likelihoods(fit)
    if fit is None or units is None:
        return None
    colours = measure_marker_colours(difference_signal(half_planes(image)), fit.plate_from_image, geometry)
    units = with_hidden_markers(units, colours.tints, geometry.n)
    extent_px = np.ptp(fit.corners_px, axis=0)
    evidence = PlateEvidence(
        units, geometry, fit.corners_px, fit.corners_covariance_px2, fit.explained, fit.unit_px, float(extent_px.min()),
        weakest_marker=float(colours.margins.min()), colours=colours, missing=missing, tries=tries,
    )  # fmt: skip
    reading = PlateReading(
        PlateOutcome.UNSURE, fit.corners_px, fit.corners_covariance_px2, geometry=geometry,
        width_px=float(extent_px[0]), height_px=float(extent_px[1]),
    )  # fmt: skip
    reading, _decoded = read_evidence(reading, evidence, codebook)
    return reading, evidence


def _most_alike(image: Array, expected: ExpectedPlate) -> Array | None:
    """Corners where the frame is most like the plate's pattern, of the places where it may be, shape (4, 2). [px]"""
    geometry = expected.geometry
    grey, pattern = _grey(image), _grey_pattern(expected.code, geometry)
    ends = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float32) * len(pattern)
    matches = [(*_best_match(grey, pattern, ends, place), place) for place in expected.places_px]
    likeness, shift, place = max(matches, key=lambda match: match[0])
    return place + shift if likeness >= MIN_EXPECTED_LIKENESS else None


@lru_cache(maxsize=16)
def _grey_pattern(code: PlateCode, geometry: PlateGeometry) -> Array:
    """Grey levels of a plate's face in even light, uint8, square."""
    size = PATTERN_UNIT_PX * geometry.n
    at = (np.arange(size) + 0.5) / size
    edges = unit_edges(geometry)
    place = np.clip(np.searchsorted(edges[:, 1], at), 0, geometry.n - 1)
    is_unit = at >= edges[place, 0]
    grey = np.where(code.units[np.ix_(place, place)] > 0, DARK_GREY, LIGHT_GREY)
    corner = (place < 2) | (place >= geometry.n - 2)
    is_corner = corner[:, None] & corner[None]
    grey = np.where(is_unit[:, None] & is_unit[None] | is_corner, grey, GAP_GREY)
    return np.where(is_corner, MARKER_GREY, grey).astype(np.uint8)


def _best_match(grey: Array, pattern: Array, ends: Array, to_px: Array) -> tuple[float, Array]:
    """Highest normalised correlation of a pattern around a place, and by how far it is shifted there. [px]"""
    low = np.floor(to_px.min(axis=0)).astype(int) - 1
    size = np.ceil(to_px.max(axis=0)).astype(int) + 2 - low
    first = np.maximum(low - REACH_PX, 0)
    last = np.minimum(low + size + REACH_PX, [grey.shape[1], grey.shape[0]])
    if (last - first < size).any():
        return -1.0, np.zeros(2)
    scale = len(pattern) / max(cv2.contourArea(to_px.astype(np.float32)), 1.0) ** 0.5
    smooth = cv2.GaussianBlur(pattern, (0, 0), max(SMOOTHING * scale, 0.5))
    warp = cv2.getPerspectiveTransform(ends, (to_px - low).astype(np.float32))
    shape = (int(size[0]), int(size[1]))
    template = cv2.warpPerspective(smooth, warp, shape)
    mask = cv2.warpPerspective(np.full_like(pattern, 255), warp, shape, flags=cv2.INTER_NEAREST)
    scores = cv2.matchTemplate(grey[first[1] : last[1], first[0] : last[0]], template, cv2.TM_CCOEFF_NORMED, mask=mask)
    scores[~np.isfinite(scores)] = -1.0
    _least, best, _where, at = cv2.minMaxLoc(scores)
    return float(best), np.array(at) + first - low


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
