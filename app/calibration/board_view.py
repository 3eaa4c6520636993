"""One photo to the corners of the board in it, or why it is left out; the results of a calibration."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from app.sensors.camera import CalibrationBoard, board_dictionary
from app.values import Floats

Grey = npt.NDArray[np.uint8]

MIN_CORNERS, MIN_SHARE = 8, 0.2
"""[corners, 1] of the board that a photo must show, the larger of both. Source: a view has six unknowns, a corner gives
two equations."""
MAX_EDGE_PX, EDGE_PHOTO_PX, MAX_EDGE_SHARE = 8.0, 2000, 0.25
"""[px, px, square] width of an edge above which a photo is blurred, on photos of this size (more on larger ones), and
relative to a square, the smaller of both. Commit `large photos may have wider edges`."""
SEARCH_PX = 2400
"""[px] longer side to which photos are scaled down for the search; corners are refined at full size. For speed."""
MIN_PX = 64
"""[px] least side of a photo in the search."""
MIN_MARKERS = 4
"""[markers] from which a mirrored or another board is recognised."""
MAX_SHARPEST_PX = 10.0
"""[px] width of the sharpest edges above which a photo without a marker is blurred. Source: road photos have 4 to 8
(commit `a photo of a road is not called blurred`)."""
MIN_PHOTO_CONTRAST, MIN_BOARD_CONTRAST = 40, 10
"""[grey levels] of a photo and of the board in it, below which the width of edges is not measured."""
RANSAC_SHARE, MAX_MARKER_OFFSET, MIN_FITTING = 0.02, 0.5, 0.7
"""[extent of the markers, squares, 1] threshold of RANSAC, distance of a marker from its place up to which it fits, and
the share of markers that must. A wide lens bends a board by less."""
FREE_SHARE, WINDOW_PX, MAX_CORNER_SHIFT = 0.8, (2, 12), 0.5
"""[1, px, 1] share of the space between corner and marker that the window of the refinement fills, limits of its half
side, and the corner's shift as a share of that half side."""
_OTHER_DICTIONARIES = ("DICT_4X4_1000", "DICT_5X5_1000", "DICT_6X6_1000", "DICT_7X7_1000", "DICT_ARUCO_ORIGINAL")


class ViewFault(StrEnum):
    """Why a photo is left out."""

    NO_BOARD = "no-board"
    WRONG_BOARD = "wrong-board"
    MIRRORED = "mirrored"
    TOO_FEW_CORNERS = "too-few-corners"
    BLURRED = "blurred"
    OTHER_SIZE = "other-size"
    ALIKE = "alike"
    DOES_NOT_FIT = "does-not-fit"
    NOT_A_PICTURE = "not-a-picture"
    UNREADABLE = "unreadable"
    TOO_LARGE = "too-large"


@dataclass(frozen=True, slots=True, eq=False)
class BoardView:
    """The board in a photo."""

    corner: npt.NDArray[np.intp]  # shape (K,): which inner corners, counted row by row from the upper left
    corners_px: Floats  # shape (K, 2): [px] pixel centres at integers
    # [px] of edges between black and white, the wider of both directions; NaN without corners
    edge_width_px: float = float("nan")
    fault: ViewFault | None = None  # why it cannot be used
    detail: str = ""  # the reason in words, with figures


def find_board(grey: Grey, board: CalibrationBoard) -> BoardView:
    """Find the inner corners of a board in a photo.

    Parameters
    ----------
    grey : ndarray of uint8, shape (H, W)

    Returns
    -------
    BoardView
        With `fault` where it cannot be used: no marker of the board, markers of another one, a mirrored or blurred
        photo, too few corners.
    """
    scale = min(1.0, SEARCH_PX / max(grey.shape))
    if min(grey.shape) * scale < MIN_PX:
        return _without_corners(ViewFault.NO_BOARD, f"the photo is {grey.shape[1]} x {grey.shape[0]} px")
    small = grey
    if scale < 1:
        small = np.asarray(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
    corners, ids, marks, numbers = _detector(board).detectBoard(small)
    if numbers is None or len(numbers) < 2:
        return _without_corners(*_explain_no_marker(small, board))
    if other := _is_other_board(marks, numbers, board):
        return _without_corners(ViewFault.WRONG_BOARD, other)
    count = 0 if ids is None else len(ids)
    min_corners = max(MIN_CORNERS, int(np.ceil(MIN_SHARE * board.corner_count)))
    if count < min_corners:
        detail = f"{count} of {board.corner_count} corners of the board are visible, {min_corners} are needed"
        return _without_corners(ViewFault.TOO_FEW_CORNERS, detail)
    corner = np.asarray(ids, np.intp).ravel()
    rough = (np.asarray(corners, float).reshape(-1, 2) + 0.5) / scale - 0.5
    square_px = _square_px(corner, rough, board)
    refined = _refine(grey, corner, rough, board)
    width_px = edge_width_px(grey, corner, refined, board)
    limit_px = min(MAX_EDGE_PX * max(1.0, max(grey.shape) / EDGE_PHOTO_PX), MAX_EDGE_SHARE * square_px)
    if not width_px <= limit_px:
        detail = f"edges are {width_px:.1f} px wide, the limit is {limit_px:.1f} px"
        return BoardView(corner, refined, width_px, ViewFault.BLURRED, detail)
    return BoardView(corner, refined, width_px)


@lru_cache(maxsize=8)
def _detector(board: CalibrationBoard) -> Any:
    size = (board.columns, board.rows)
    charuco = cv2.aruco.CharucoBoard(size, board.square_mm, board.marker_mm, board_dictionary())
    return cv2.aruco.CharucoDetector(charuco)


def _without_corners(fault: ViewFault, detail: str) -> BoardView:
    return BoardView(np.empty(0, np.intp), np.empty((0, 2)), fault=fault, detail=detail)


def _explain_no_marker(small: Grey, board: CalibrationBoard) -> tuple[ViewFault, str]:
    """Why no marker of the board was found, from what else the photo shows."""
    detector = _detector(board)
    flipped = detector.detectBoard(np.ascontiguousarray(small[:, ::-1]))[3]
    if flipped is not None and len(flipped) >= MIN_MARKERS:
        return ViewFault.MIRRORED, "the board is mirrored: its markers can only be read in a mirror"
    if (width_px := _steepest_px(small)) > MAX_SHARPEST_PX:
        return ViewFault.BLURRED, f"no marker was found, and the sharpest edges are {width_px:.0f} px wide"
    for name in _OTHER_DICTIONARIES:
        other = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)))
        found = other.detectMarkers(small)[1]
        if found is not None and len(found) >= MIN_MARKERS:
            return ViewFault.WRONG_BOARD, f"its markers are of {name}, those of the board of DICT_5X5_100"
    return ViewFault.NO_BOARD, "no marker of the board was found: is it whole, flat, lit and in focus?"


def _steepest_px(grey: Grey) -> float:
    """Width of a photo's steepest edges across the direction in which they are widest; 0 without contrast. [px]"""
    half = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA).astype(np.float32)
    low, high = np.percentile(half, (2, 98))
    if high - low < MIN_PHOTO_CONTRAST:
        return 0.0
    across = cv2.Sobel(half, cv2.CV_32F, 1, 0, scale=1 / 8)
    down = cv2.Sobel(half, cv2.CV_32F, 0, 1, scale=1 / 8)
    turned = ((1.0, 0.0), (0.7071, 0.7071), (0.0, 1.0), (-0.7071, 0.7071))
    slopes = [float(np.percentile(np.abs(x * across + y * down), 99.99)) for x, y in turned]
    return 2 * float(high - low) / max(min(slopes), 1e-3)


def _is_other_board(marks: Any, numbers: object, board: CalibrationBoard) -> str | None:
    """Why the markers are not this board's: numbers that it does not have, or places that do not fit."""
    found = np.asarray(numbers).ravel()
    known = found < len(board.marker_squares)
    if not known.all():
        return f"it has marker {found.max()}, the board's go to {len(board.marker_squares) - 1}"
    if len(found) < MIN_MARKERS:
        return None
    image = np.concatenate([np.asarray(mark, float).reshape(4, 2) for mark in marks])
    plane = np.concatenate([board.marker_corners_mm(int(number)) for number in found])
    homography: Any = cv2.findHomography(plane, image, cv2.RANSAC, RANSAC_SHARE * float(np.ptp(image, axis=0).max()))[0]
    if homography is None:
        return "its markers are not in the places of the board's"
    back = cv2.perspectiveTransform(image.reshape(-1, 1, 2), np.linalg.pinv(homography)).reshape(-1, 2)
    off = np.linalg.norm(back - plane, axis=1) / board.square_mm
    fits = float((off < MAX_MARKER_OFFSET).mean())
    return None if fits > MIN_FITTING else f"{1 - fits:.0%} of its markers are not in the places of the board's"


def _square_px(corner: npt.NDArray[np.intp], corners_px: Floats, board: CalibrationBoard) -> float:
    """Side of a square in the photo, the middle of those along rows and columns. [px]"""
    sides = [np.linalg.norm(corners_px[b] - corners_px[a], axis=1) for a, b in _neighbours(corner, board)]
    both = np.concatenate(sides)
    return float(np.median(both)) if len(both) else 0.0


def _neighbours(
    corner: npt.NDArray[np.intp], board: CalibrationBoard
) -> tuple[tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]], ...]:
    """Indices of corners beside each other along a row, and along a column."""
    across = board.columns - 1
    at = np.full(board.corner_count, -1)
    at[corner] = np.arange(len(corner))
    grid = at.reshape(board.rows - 1, across)
    pairs = ((grid[:, :-1], grid[:, 1:]), (grid[:-1], grid[1:]))
    found = []
    for first, second in pairs:
        both = (first >= 0) & (second >= 0)
        found.append((first[both], second[both]))
    return tuple(found)


def _refine(grey: Grey, corner: npt.NDArray[np.intp], corners_px: Floats, board: CalibrationBoard) -> Floats:
    """Corners to a fraction of a pixel, each in a window that holds no marker, however the board is tilted."""
    free = (board.square_mm - board.marker_mm) / 2 / board.square_mm
    half = np.clip((FREE_SHARE * free * _heights_px(corner, corners_px, board)).astype(int), *WINDOW_PX)
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
    refined = corners_px.copy()
    for size in np.unique(half):
        at = half == size
        points = corners_px[at].astype(np.float32).reshape(-1, 1, 2)
        found = cv2.cornerSubPix(grey, points, (int(size), int(size)), (-1, -1), criteria)
        refined[at] = np.asarray(found, float).reshape(-1, 2)
    moved = np.linalg.norm(refined - corners_px, axis=1)
    return np.where((moved <= MAX_CORNER_SHIFT * half)[:, None], refined, corners_px)


def _heights_px(corner: npt.NDArray[np.intp], corners_px: Floats, board: CalibrationBoard) -> Floats:
    """Least height of the squares about each corner, taken as parallelograms. [px]"""
    steps = []
    for first, second in _neighbours(corner, board):
        step = np.full((2, len(corner), 2), np.nan)
        step[0, first] = corners_px[second] - corners_px[first]
        step[1, second] = corners_px[second] - corners_px[first]
        steps.append(step)
    heights = np.full(len(corner), np.inf)
    for along in steps[0]:
        for down in steps[1]:
            area = np.abs(along[:, 0] * down[:, 1] - along[:, 1] * down[:, 0])
            longest = np.maximum(np.linalg.norm(along, axis=1), np.linalg.norm(down, axis=1))
            heights = np.fmin(heights, area / longest)
    return np.where(np.isfinite(heights), heights, 0.0)


def edge_width_px(grey: Grey, corner: npt.NDArray[np.intp], corners_px: Floats, board: CalibrationBoard) -> float:
    """Width of the board's edges: contrast over the steepest slope, the wider of both directions.

    A Gaussian blur of sigma gives 2.5 sigma; a sharp edge about 1.5 px. Inf where nothing can be measured.
    """
    low, high = np.percentile(grey[_region(corners_px, grey.shape)], (5, 95)).astype(float)
    if high - low < MIN_BOARD_CONTRAST:
        return float("inf")
    reach = (board.square_mm - board.marker_mm) / 2 / board.square_mm
    widths = []
    for first, second in _neighbours(corner, board):
        if not len(first):
            continue
        start, end = corners_px[first], corners_px[second]
        along = end - start
        length = np.linalg.norm(along, axis=1)
        normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / length[:, None]
        offsets = np.linspace(-1, 1, 25)[None] * np.clip(reach * length, 1.5, 25)[:, None]
        # several places of an edge, each with its own profile across it
        places = start[:, None] + np.array([0.3, 0.4, 0.5, 0.6, 0.7])[None, :, None] * along[:, None]
        points = places[:, :, None] + offsets[:, None, :, None] * normal[:, None, None]
        values = cv2.remap(
            grey, points[..., 0].reshape(len(first), -1).astype(np.float32),
            points[..., 1].reshape(len(first), -1).astype(np.float32), cv2.INTER_LINEAR,
        ).reshape(*points.shape[:3]).astype(float).mean(axis=1)  # fmt: skip
        slope = np.abs(np.gradient(values, axis=1) / np.gradient(offsets, axis=1)).max(axis=1)
        widths.append(float(np.median((high - low) / np.maximum(slope, 1e-6))))
    return max(widths) if widths else float("inf")


def _region(corners_px: Floats, shape: tuple[int, ...]) -> tuple[slice, slice]:
    left, top = np.floor(corners_px.min(axis=0)).astype(int)
    right, bottom = np.ceil(corners_px.max(axis=0)).astype(int) + 1
    return slice(max(int(top), 0), min(int(bottom), shape[0])), slice(max(int(left), 0), min(int(right), shape[1]))


# === Photos and rules of a calibration, and its result.


@dataclass(frozen=True, slots=True)
class CalibrationRules:
    """When a calibration is good enough.

    Notes
    -----
    Source: all chosen by hand, no measurement was kept; Zhang's method (`calibrate_camera`) needs three views at least.
    """

    min_views: int = 6
    # mean shift of the corners from one view to another over the image's diagonal, below which the second is left out
    alike_share: float = 0.01
    min_tilt_deg: float = 20.0  # [deg] largest angle between two views of the board
    min_coverage: float = 0.4  # share of the image's 6 x 8 cells with a corner in them
    max_rms_px: float = 1.0  # [px] reprojection error over all views
    max_focal_share: float = 0.005  # standard deviation of the focal length over itself
    # `outlier_px`, `outlier_factor`: [px] a view is left out when its error is above both: absolute, and times the
    # median view's
    outlier_px: float = 0.5
    outlier_factor: float = 3.0


@dataclass(frozen=True, slots=True)
class ViewReport:
    """A photo: whether it was used, or the reason why it was not."""

    photo: int  # from 0, as they were sent
    name: str
    used: bool
    reason: ViewFault | None
    detail: str | None
    corners: int = 0
    # `rms_px`, `tilt_deg`: reprojection error; angle between the board and the image plane. Of views that were used.
    # [px, deg]
    rms_px: float | None = None
    tilt_deg: float | None = None
    edge_width_px: float | None = None

    def left_out(self, reason: ViewFault, detail: str) -> ViewReport:
        """The photo that is not used."""
        return replace(self, used=False, reason=reason, detail=detail)


@dataclass(frozen=True, slots=True)
class Photo:
    """A photo after the search for the board."""

    name: str
    size_px: tuple[int, int] | None  # width and height, upright; None where it could not be read
    orientation: int  # of its EXIF data: photos that were turned differently are not of one image plane
    view: BoardView


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """Parameters of a camera, or their standard deviations; pixel centres at integers."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, ...]  # OpenCV's k1, k2, p1, p2[, k3[, k4, k5, k6]]


@dataclass(frozen=True, slots=True)
class CalibratedCamera(Intrinsics):
    """Intrinsics and distortion, in the members of a decode's camera."""

    width_px: int
    height_px: int


@dataclass(frozen=True, slots=True)
class Coverage:
    """Cells of the image, 6 rows of 8, that have a corner in them."""

    share: float
    cells: list[list[int]]


@dataclass(frozen=True, slots=True)
class CameraCalibration:
    """A calibrated camera."""

    camera: CalibratedCamera
    sigma: Intrinsics
    rms_px: float  # [px] reprojection error over all views
    coverage: Coverage
    tilt_spread_deg: float  # [deg] largest angle between two views of the board
    board: CalibrationBoard
    views: tuple[ViewReport, ...]  # one a photo
