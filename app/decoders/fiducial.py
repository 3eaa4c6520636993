"""Frames -> readings of fiducial signs.

A value without a source beside it is ours; tests/families/fiducial/test_fiducial_frames.py reads rendered
frames with all of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, ClassVar

import cv2
import numpy as np
import numpy.typing as npt

from app.decoders.snapshot import Snapshot, SnapshotMarker
from app.markers.fiducial import (
    FiducialCode,
    FiducialGeometry,
    KnownFiducial,
    Mounting,
    SignImage,
    codewords,
    get_dictionary,
)
from app.markers.reading import PlatePose
from app.sensors.camera import Camera
from app.values import Floats

# === What was read of a fiducial sign in a frame.


class FiducialOutcome(StrEnum):
    """Result of a candidate. Only READ carries a code."""

    READ = "read"
    UNSURE = "unsure"


@dataclass(frozen=True, slots=True)
class FiducialReading:
    """One candidate sign in a frame."""

    family: ClassVar[str] = "fiducial"
    outcome: FiducialOutcome
    # shape (4, 2): [px] outer corners of the border, clockwise from the sign's upper left, pixel centres at integers;
    # where `turned_deg` is None from the upper left of OpenCV's image
    corners_px: npt.NDArray[np.float64]
    code: FiducialCode | None
    confidence: float  # posterior probability of the most likely code, 0 to 1
    bit_errors: int  # modules that differ from the most likely code
    contrast: float  # [grey levels] quiet zone minus border
    side_px: float  # [px] mean length of the sides
    # of a sign whose dimensions are known, in a frame whose camera is known. Its axes are x right, y travel, z up, as a
    # plate's, whatever the sign's mounting.
    pose: PlatePose | None = None
    reason: str = ""  # why the code was refused, or why there is no pose
    # [deg] clockwise rotation of OpenCV's image on the sign: 0, 90, 180 or 270; of an upright sign as it was seen, of a
    # lying one as it is registered. None where it is not known, as without a camera.
    turned_deg: int | None = None


# === Frame -> candidate squares -> the grey values of their modules.


Image = npt.NDArray[np.uint8]

_CELL_PX = 8  # [px] of a module in the rectified picture; its inner half is sampled; 16 samples a module
_NEXT_SQUARE = 0.02  # [-] of the perimeter: a border inside the edge of its panel is a square of its own
_SAME_SQUARE = 0.1  # [-] candidates whose corners are nearer than this share of the side are one
_CLEAR_BORDER = 0.9  # [-] least share of the border's modules that are dark
_PROFILE_STEP_PX = 0.5  # [px] between samples across an edge; half a pixel
_MIN_EDGE_POINTS = 5  # [-] of an edge, to fit a line; more than the two that define it
_MIN_CONTRAST = 20.0  # [grey levels] of 255 between border and quiet zone


@dataclass(frozen=True, slots=True)
class SampledSquare:
    """A candidate with the values of its modules."""

    corners_px: Floats  # shape (4, 2): [px] clockwise from any corner
    darkness: Floats  # shape (n, n): 0 is the level of the quiet zone, 1 that of the border
    spread: float  # standard deviation of border and quiet zone in the same unit
    contrast: float  # [grey levels]
    middle: float  # grey value between the levels of border and quiet zone


def detect_squares(grey: Image) -> list[Floats]:
    """Corners of dark squares by OpenCV's detector, clockwise, whatever they hold; shape (4, 2) each. [px]"""
    parameters = cv2.aruco.DetectorParameters()
    parameters.minMarkerDistanceRate = _NEXT_SQUARE
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    accepted, _numbers, rejected = cv2.aruco.ArucoDetector(words, parameters).detectMarkers(grey)
    squares: list[Floats] = []
    for found in (*accepted, *rejected):
        corners = np.asarray(found, dtype=np.float64).reshape(4, 2)
        if not any(_is_same(corners, other) for other in squares):
            squares.append(corners)
    return squares


def _is_same(corners: Floats, other: Floats) -> bool:
    side = np.linalg.norm(other[0] - other[2]) / np.sqrt(2)
    return bool(np.linalg.norm(corners.mean(axis=0) - other.mean(axis=0)) < _SAME_SQUARE * side) and bool(
        abs(np.linalg.norm(corners[0] - corners[2]) / np.sqrt(2) - side) < _SAME_SQUARE * side
    )


def sample_square(grey: Image, corners_px: Floats, n: int) -> SampledSquare | None:
    """Values of the n x n modules inside a square's border.

    Returns
    -------
    SampledSquare or None
        None where the square has no dark border on a lighter ground.
    """
    modules = n + 4  # with border and quiet zone on both sides
    inner, outer = 1.0 * _CELL_PX, (modules - 1.0) * _CELL_PX
    target = np.array([(inner, inner), (outer, inner), (outer, outer), (inner, outer)]) - 0.5
    square_from_image = cv2.getPerspectiveTransform(corners_px.astype(np.float32), target.astype(np.float32))
    side = modules * _CELL_PX
    flat = cv2.warpPerspective(grey, square_from_image, (side, side), flags=cv2.INTER_LINEAR)
    cells = flat.reshape(modules, _CELL_PX, modules, _CELL_PX).astype(np.float64)
    quarter = _CELL_PX // 4
    values = cells[:, quarter:-quarter, :, quarter:-quarter].mean(axis=(1, 3))
    ring = _ring(values[1:-1, 1:-1])
    quiet = _ring(values)
    dark, light = float(np.median(ring)), float(np.median(quiet))
    contrast = light - dark
    if contrast < _MIN_CONTRAST or np.mean(ring < (dark + light) / 2) < _CLEAR_BORDER:
        return None
    spread = float(np.hypot(_robust_std(ring), _robust_std(quiet))) / contrast
    return SampledSquare(corners_px, (light - values[2:-2, 2:-2]) / contrast, spread, contrast, (dark + light) / 2)


def _ring(values: Floats) -> Floats:
    return np.concatenate([values[0], values[-1], values[1:-1, 0], values[1:-1, -1]])


def _robust_std(values: Floats) -> float:
    """Standard deviation by the median absolute deviation of a normal distribution."""
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def refine_corners(grey: Image, square: SampledSquare) -> Floats:
    """Corners to parts of a pixel: the border's four edges are fitted as lines, which meet in the corners.

    Each edge is located on profiles across it, where the grey value passes the middle between border and quiet zone;
    unlike the gradient's maximum near a corner, that place does not move when the picture is blurred.
    """
    corners = square.corners_px
    lines = []
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        points = _edge_points(grey, start, end, square)
        if len(points) < _MIN_EDGE_POINTS:
            return corners
        direction_x, direction_y, x, y = cv2.fitLine(points.astype(np.float32), cv2.DIST_HUBER, 0, 0.01, 0.01).ravel()
        normal = np.array([-direction_y, direction_x], dtype=np.float64)
        lines.append((normal, float(normal @ np.array([x, y]))))
    refined = [_crossing(lines[k - 1], lines[k]) for k in range(4)]
    if any(point is None for point in refined):
        return corners
    found: Floats = np.array(refined, dtype=np.float64)
    module_px = _module_px(corners, len(square.darkness))
    return found if float(np.abs(found - corners).max()) < max(module_px, 3.0) else corners


def _edge_points(grey: Image, start: Floats, end: Floats, square: SampledSquare) -> Floats:
    """Where profiles across an edge pass the middle grey value, shape (K, 2). [px]"""
    along = end - start
    outward = np.array([along[1], -along[0]]) / np.linalg.norm(along)  # corners go clockwise in the picture
    reach = min(max(0.7 * _module_px(square.corners_px, len(square.darkness)), 2.0), 8.0)
    offsets = np.arange(-reach, reach + 1e-9, _PROFILE_STEP_PX)
    shares = np.linspace(0.08, 0.92, min(max(int(np.linalg.norm(along)), 8), 48))
    places = start + shares[:, None] * along
    grid = places[:, None, :] + offsets[None, :, None] * outward
    maps = grid.astype(np.float32)
    values = cv2.remap(grey, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    above = values.astype(np.float64) - square.middle
    rising = (above[:, :-1] < 0) & (above[:, 1:] >= 0)
    rows = np.flatnonzero(rising.sum(axis=1) == 1)  # a profile that crosses twice has met something else
    columns = rising[rows].argmax(axis=1)
    low, high = above[rows, columns], above[rows, columns + 1]
    at = offsets[columns] - low / (high - low) * _PROFILE_STEP_PX
    return np.asarray(places[rows] + at[:, None] * outward, dtype=np.float64)


def _crossing(one: tuple[Floats, float], other: tuple[Floats, float]) -> Floats | None:
    normals = np.array([one[0], other[0]])
    if abs(np.linalg.det(normals)) < 1e-3:
        return None
    return np.asarray(np.linalg.solve(normals, np.array([one[1], other[1]])), dtype=np.float64)


def _module_px(corners_px: Floats, n: int) -> float:
    return float(np.linalg.norm(corners_px - np.roll(corners_px, 1, axis=0), axis=1).min()) / (n + 2)


# === Corners of a sign and the camera -> pose of the sign.
#
# The camera sees which edge of an upright sign is the upper one, because its sides are vertical in the vehicle's frame.
# So neither the image that it shows matters, nor whether it was hung on its side. A lying sign has no upper edge.
#
# IPPE gives the two poses of a square in closed form (Collins and Bartoli, IJCV 109, 2014). Signs are mounted plumb or
# flat, and the mount gives the camera's attitude: the pose that fits both is taken, and a few Gauss-Newton steps
# weigh the corners against the mounting.


CORNER_SIGMA_PX = 0.1
"""Of a corner in each direction. [px] The rest over 0.035 on rendered frames, as
tests/families/fiducial/test_fiducial_frames.py prints it, is left for lenses."""
TILT_SIGMA_RAD = math.radians(1.5)
"""Of a sign's mounting and the vehicle's springs together. [rad]"""
MAX_LEAN_RAD = math.radians(20.0)
"""Of an upright sign's axis from the vertical, for which its pose is returned. [rad] Signs and vehicles lean by a few
degrees; a sign that was hung by a corner leans by 45."""
_STEP = 1e-6  # [m], [rad] for differences; source: the root of double precision, rounded up, for lengths of metres
_ROUNDS = 10  # of Gauss-Newton; two or three suffice

# axes of a plate (x right, y travel, z up) in the frame of an upright sign (x right, y up, z to the viewer)
_SIGN_FROM_PLATE = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def stand_upright(corners_px: Floats, camera: Camera) -> tuple[Floats, int]:
    """Corners of an upright sign, clockwise from its upper left, and by how many quarter turns they were renumbered.

    Parameters
    ----------
    corners_px : ndarray, shape (4, 2)
        Clockwise from any corner. [px]
    """
    rays = camera.undistort(corners_px)
    up, centre = camera.camera_from_vehicle[:, 2], rays.mean(axis=0)
    vertical = up[:2] - centre * up[2]  # the direction in which the image of a point moves as the point moves up
    sides = [rays[k] - rays[k - 1] + rays[(k + 1) % 4] - rays[(k + 2) % 4] for k in range(4)]
    upright = [float(side @ vertical) / max(float(np.linalg.norm(side)), 1e-12) for side in sides]
    first = int(np.argmax(upright))
    return np.roll(corners_px, -first, axis=0), -first % 4


def lean_rad(pose: PlatePose, camera: Camera) -> float:
    """Angle between the vertical and the upward axis of an upright sign. [rad]"""
    up = camera.camera_from_vehicle.T @ pose.rotation[:, 2]
    return math.acos(min(max(float(up[2]), -1.0), 1.0))


def locate_fiducial(corners_px: Floats, geometry: FiducialGeometry, camera: Camera) -> PlatePose | None:
    """Pose of a sign from the corners of its border.

    Parameters
    ----------
    corners_px : ndarray, shape (4, 2)
        Clockwise from the sign's upper left. [px]

    Returns
    -------
    PlatePose or None
        Axes x right, y travel, z up, as a plate's; None when no pose in front of the camera projects to the corners.
    """
    object_m = np.column_stack([geometry.corners_mm / 1000, np.zeros(4)])
    found, rotations, translations, _ = cv2.solvePnPGeneric(
        object_m, camera.undistort(corners_px), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    if not found:
        return None
    starts = [np.concatenate([r.ravel(), t.ravel()]) for r, t in zip(rotations, translations, strict=True)]
    refined = [_refine(start, corners_px, object_m, geometry.mounting, camera) for start in starts]
    best = min((r for r in refined if r is not None), key=lambda r: r[0], default=None)
    if best is None:
        return None
    _cost, pose, information = best
    rotation = np.asarray(cv2.Rodrigues(pose[:3])[0], dtype=np.float64)
    if geometry.mounting is Mounting.UPRIGHT:
        rotation = rotation @ _SIGN_FROM_PLATE
    residual = _corner_residuals(pose, corners_px, object_m, camera)
    return PlatePose(
        rotation=rotation,
        translation_m=pose[3:].copy(),
        covariance=np.asarray(np.linalg.inv(information), dtype=np.float64),
        reprojection_rms_px=float(np.sqrt(np.mean(np.sum(residual.reshape(4, 2) ** 2, axis=1)))),
    )


def _refine(
    pose: Floats, corners_px: Floats, object_m: Floats, mounting: Mounting, camera: Camera
) -> tuple[float, Floats, Floats] | None:
    """Gauss-Newton on corners and mounting: cost, pose (rotation vector, translation), information.

    Small rotations are about the camera's axes, to the left of the pose's rotation.
    """

    def residuals(at: Floats) -> Floats:
        corners = _corner_residuals(at, corners_px, object_m, camera) / CORNER_SIGMA_PX
        return np.concatenate([corners, _tilt(at, mounting, camera) / TILT_SIGMA_RAD])

    information = np.eye(6)
    for _ in range(_ROUNDS):
        if pose[5] <= 0.05:
            return None
        now = residuals(pose)
        jacobian = np.empty((len(now), 6))
        for k in range(6):
            step = np.zeros(6)
            step[k] = _STEP
            jacobian[:, k] = (residuals(_moved(pose, step)) - now) / _STEP
        information = jacobian.T @ jacobian
        change = np.asarray(-np.linalg.solve(information, jacobian.T @ now), dtype=np.float64)
        pose = _moved(pose, change)
        if np.abs(change).max() < 1e-8:
            break
    if pose[5] <= 0.05:
        return None
    last = residuals(pose)
    cost = float(last @ last)
    return (cost, pose, information) if math.isfinite(cost) else None


def _moved(pose: Floats, step: Floats) -> Floats:
    rotation = cv2.Rodrigues(step[:3])[0] @ cv2.Rodrigues(pose[:3])[0]
    return np.concatenate([cv2.Rodrigues(rotation)[0].ravel(), pose[3:] + step[3:]])


def _corner_residuals(pose: Floats, corners_px: Floats, object_m: Floats, camera: Camera) -> Floats:
    projected = cv2.projectPoints(object_m, pose[:3], pose[3:], camera.matrix, camera.lens)[0]
    return np.asarray(projected, dtype=np.float64).reshape(8) - corners_px.reshape(8)


def _tilt(pose: Floats, mounting: Mounting, camera: Camera) -> Floats:
    """How far the axis of the sign that should be vertical leans forward and to the left of the vehicle. [rad]"""
    rotation = np.asarray(cv2.Rodrigues(pose[:3])[0], dtype=np.float64)
    axis = rotation[:, 1] if mounting is Mounting.UPRIGHT else rotation[:, 2]
    in_vehicle = camera.camera_from_vehicle.T @ axis
    # beyond a quarter turn the lean must keep growing, or an upside-down sign would cost nothing
    lean = np.arctan2(np.hypot(in_vehicle[0], in_vehicle[1]), in_vehicle[2])
    length = np.hypot(in_vehicle[0], in_vehicle[1])
    scale = lean / length if length > 1e-12 else 1.0
    return np.array([in_vehicle[0] * scale, in_vehicle[1] * scale])


# === Grey values of modules -> the most likely code, with its posterior probability.
#
# A square is a sign with one of the codewords that are looked for, or it is something else: an edge of a window, a road
# marking, a plate. Each module votes with the likelihood of its grey value, so a damaged or blurred module costs little
# and a clean one that contradicts the codeword costs much. What is not a sign is either noise (each module dark or
# light at random) or a smooth pattern (neighbouring modules mostly alike), and the more squares a frame has, the
# likelier one of them looks like a codeword by chance. So small dictionaries, such as AprilTag 16h5, are only read
# where the registry expects the sign, and large ones also elsewhere; there is no other threshold.


VERSION = "fiducial/2"
SURE = 0.99
"""Least posterior probability at which a code is returned. Source: as of plates with check digits."""
DEFAULT_DICTIONARIES = ("apriltag-36h11", "aruco-mip-36h12", "aruco-6x6-250", "aruco-5x5-250", "apriltag-25h9")
"""Looked for besides the registered ones: dictionaries that are strong enough to be read without a registry."""
_EXPECTED = 0.9  # [-] prior share of the registered signs nearby among the signs in view
_MIN_SPREAD = 0.1  # [-] of a module's darkness: blur and uneven print
_DAMAGED = 0.02  # [-] probability that a module shows nothing of its code: dirt, reflections
_MIN_SQUARES = 20  # [-] squares for each sign that a frame has at least, a priori
_CHANGE = 0.15  # [-] probability that neighbouring modules of a smooth pattern differ
_WORTH_NAMING = 0.5  # [-] candidates whose best code is less likely are left out; source: more likely no sign than one


@dataclass(frozen=True, slots=True)
class _Best:
    """The most likely code of a square."""

    code: FiducialCode
    turns: int
    posterior: float
    bit_errors: int


def decode_fiducials(
    pixels: npt.NDArray[np.uint8],
    *,
    known: Sequence[KnownFiducial] = (),
    camera: Camera | None = None,
    dictionaries: Sequence[str] = DEFAULT_DICTIONARIES,
) -> list[FiducialReading]:
    """Fiducial signs in a frame.

    Parameters
    ----------
    pixels : ndarray of uint8, shape (H, W, 3) BGR or (H, W) grey
    known : sequence of KnownFiducial
        Signs that are registered nearby; only these have poses.
    camera : Camera, optional
        Of the frame; without it there are no poses.
    dictionaries : sequence of str
        Looked for besides those of the known signs.

    Returns
    -------
    list of FiducialReading
        In the order of their codes; candidates that are probably no signs are left out.
    """
    grey = pixels if pixels.ndim == 2 else np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    squares = detect_squares(grey)
    names = tuple(dict.fromkeys((*(sign.code.dictionary for sign in known), *dictionaries)))
    readings = [
        reading
        for corners in squares
        if (reading := _read_square(grey, corners, names, known, camera, squares=len(squares))) is not None
    ]
    return sorted(_nearest_copies(readings), key=lambda reading: (reading.code is None, _text(reading)))


def _text(reading: FiducialReading) -> str:
    return reading.code.text if reading.code is not None else ""


def _nearest_copies(readings: Sequence[FiducialReading]) -> list[FiducialReading]:
    """The readings without those whose centre lies inside a surer one: a border has an inner edge too."""
    kept: list[FiducialReading] = []
    for reading in sorted(readings, key=lambda reading: -reading.confidence):
        centre = reading.corners_px.mean(axis=0)
        if not any(_holds(other.corners_px, centre) for other in kept):
            kept.append(reading)
    return kept


def _holds(corners_px: Floats, point_px: Floats) -> bool:
    return cv2.pointPolygonTest(corners_px.astype(np.float32), (float(point_px[0]), float(point_px[1])), False) >= 0


def _read_square(
    grey: Image,
    corners_px: Floats,
    names: Sequence[str],
    known: Sequence[KnownFiducial],
    camera: Camera | None,
    *,
    squares: int,
) -> FiducialReading | None:
    """The reading of a square; None of one that is probably no sign."""
    best: _Best | None = None
    sampled: SampledSquare | None = None
    for n in sorted({get_dictionary(name).modules for name in names}):
        square = sample_square(grey, corners_px, n)
        if square is None:
            continue
        found = _most_likely(square, [name for name in names if get_dictionary(name).modules == n], known, squares)
        if best is None or found.posterior > best.posterior:
            best, sampled = found, square
    if best is None or sampled is None or best.posterior < _WORTH_NAMING:
        return None
    refined = np.roll(refine_corners(grey, sampled), -best.turns, axis=0)
    is_sure = best.posterior >= SURE
    sign = next((sign for sign in known if sign.code.text == best.code.text), None)
    code = sign.code if sign is not None else best.code
    pose, turned_deg, reason = None, None, ""
    if not is_sure:
        reason = f"{best.code.text} at {best.posterior:.3f}, {SURE:g} is needed"
    elif sign is not None and camera is not None:
        refined, pose, turned_deg, reason = _place(refined, sign, camera)
    return FiducialReading(
        outcome=FiducialOutcome.READ if is_sure else FiducialOutcome.UNSURE,
        corners_px=refined,
        code=code if is_sure else None,
        confidence=best.posterior,
        bit_errors=best.bit_errors,
        contrast=sampled.contrast,
        side_px=float(np.linalg.norm(refined - np.roll(refined, 1, axis=0), axis=1).mean()),
        pose=pose,
        reason=reason,
        turned_deg=turned_deg,
    )


def _place(corners_px: Floats, sign: KnownFiducial, camera: Camera) -> tuple[Floats, PlatePose | None, int | None, str]:
    """Corners from the sign's upper left, its pose, how OpenCV's image is turned on it, and why there is no pose.

    Parameters
    ----------
    corners_px : ndarray, shape (4, 2)
        Clockwise from the upper left of OpenCV's image. [px]
    """
    geometry, is_known = sign.geometry, True
    if geometry.mounting is Mounting.UPRIGHT:
        corners_px, turns = stand_upright(corners_px, camera)
    else:
        turns = 2 if geometry.image is SignImage.APRILTAG else 0
        corners_px = np.roll(corners_px, turns, axis=0)
        is_known = geometry.image is not None or not sign.code.has_two_images
    turned_deg = 90 * turns if is_known else None
    pose = locate_fiducial(corners_px, geometry, camera)
    if pose is not None and (lean := lean_rad(pose, camera)) > MAX_LEAN_RAD:
        why = f"the sign would lean by {math.degrees(lean):.0f} degrees, so that its position is not used"
        return corners_px, None, turned_deg, why
    return corners_px, pose, turned_deg, ""


def _most_likely(square: SampledSquare, names: Sequence[str], known: Sequence[KnownFiducial], squares: int) -> _Best:
    """Posterior of the best code among the codewords, noise and smooth patterns."""
    dark, light = _log_likelihoods(square)
    words = np.concatenate([codewords(name) for name in names]).astype(np.float64)
    owners = [(name, number) for name in names for number in range(len(codewords(name)))]
    priors = _log_priors(owners, known)
    # a square's corners may begin at any corner: the darkness is turned back by each number of quarter turns
    scores = np.stack(
        [
            np.tensordot(words, np.rot90(dark, turns), 2) + np.tensordot(1.0 - words, np.rot90(light, turns), 2)
            for turns in range(4)
        ]
    )
    scores += priors - math.log(4.0)
    turns, index = np.unravel_index(int(np.argmax(scores)), scores.shape)
    rivals = np.array([*_log_other(dark, light, squares), _log_sum(_without_copies(scores, words, index))])
    best = float(scores[turns, index])
    read = np.rot90(square.darkness, int(turns)) > 0.5
    return _Best(
        FiducialCode(*owners[int(index)]),
        int(turns),
        float(1.0 / (1.0 + np.exp(rivals - best).sum())),
        int(np.count_nonzero(read != (words[index] > 0.5))),
    )


def _log_likelihoods(square: SampledSquare) -> tuple[Floats, Floats]:
    """Log-likelihood of each module's value if it is dark, and if it is light; shape (n, n) each."""
    spread = max(square.spread, _MIN_SPREAD)

    def of(level: float) -> Floats:
        fits = np.exp(-0.5 * ((square.darkness - level) / spread) ** 2)
        return np.log((1 - _DAMAGED) * fits + _DAMAGED * 0.5)

    return of(1.0), of(0.0)


def _log_priors(owners: Sequence[tuple[str, int]], known: Sequence[KnownFiducial]) -> Floats:
    """Prior of each codeword: the registered signs nearby share 0.9, all codewords the rest."""
    expected = {sign.code.text for sign in known}
    texts = [f"{get_dictionary(name).series}-{number}" for name, number in owners]
    is_expected = np.array([text in expected for text in texts])
    rest = (1.0 - _EXPECTED if is_expected.any() else 1.0) / len(owners)
    share = _EXPECTED / len(expected) if expected else 0.0
    return np.log(np.where(is_expected, share + rest, rest))


def _log_other(dark: Floats, light: Floats, squares: int) -> tuple[float, float]:
    """Log-evidence that a square is noise, and that it is a smooth pattern, by how many squares the frame has."""
    odds = math.log(max(squares, _MIN_SQUARES))
    noise = float(np.logaddexp(dark, light).sum()) + dark.size * math.log(0.5)
    smooth = math.log(0.5)
    ahead = np.array([dark[0, 0], light[0, 0]])  # forward pass over the modules, row by row, of a two-state chain
    step = np.log(np.array([[1 - _CHANGE, _CHANGE], [_CHANGE, 1 - _CHANGE]]))
    for row in range(len(dark)):
        columns = range(len(dark)) if row % 2 == 0 else range(len(dark) - 1, -1, -1)  # there and back: neighbours touch
        for column in columns:
            if row == column == 0:
                continue
            values = np.array([dark[row, column], light[row, column]])
            ahead = np.logaddexp(ahead[0] + step[0], ahead[1] + step[1]) + values
    smooth += float(np.logaddexp(*ahead))
    return noise + odds + math.log(0.5), smooth + odds + math.log(0.5)


def _without_copies(scores: Floats, words: Floats, index: Any) -> Floats:
    """Scores of the codewords that look different from the best one."""
    others = np.any(words != words[index], axis=(1, 2))
    return np.asarray(scores[:, others].ravel(), dtype=np.float64)


def _log_sum(values: Floats) -> float:
    return float(np.logaddexp.reduce(values)) if len(values) else -math.inf


# === Fiducial signs of a snapshot: what a vehicle without a connection expects and matches.


FAMILY = "fiducial"


def known_fiducials(snapshot: Snapshot, lon_deg: float, lat_deg: float, reach_m: float) -> tuple[KnownFiducial, ...]:
    """Signs for `decode_fiducials(..., known=)`, within a distance."""
    return tuple(_known(marker) for marker in snapshot.near(FAMILY, lon_deg, lat_deg, reach_m))


def match_fiducial(
    snapshot: Snapshot, code: FiducialCode, lon_deg: float, lat_deg: float, reach_m: float
) -> SnapshotMarker | None:
    """The nearest sign with a code within reach."""
    found = snapshot.near(FAMILY, lon_deg, lat_deg, reach_m)
    return next((marker for marker in found if marker.code == code.text), None)


def _known(marker: SnapshotMarker) -> KnownFiducial:
    kind = marker.kind
    image = SignImage(kind["image"]) if kind.get("image") else None
    geometry = FiducialGeometry(kind["side_mm"], kind["quiet_mm"], Mounting(kind["mounting"]), image)
    return KnownFiducial(FiducialCode.from_text(marker.code, kind["scheme"]), geometry)
