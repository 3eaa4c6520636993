"""Frame -> candidate squares -> the grey values of their modules."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]
Floats = npt.NDArray[np.float64]

_CELL_PX = (
    8  # [px] of a module in the rectified picture; its inner half is sampled; source: by hand, 16 samples a module
)
_NEXT_SQUARE = (
    0.02  # [-] of the perimeter: a border inside the edge of its panel is a square of its own; source: by hand
)
_SAME_SQUARE = 0.1  # [-] candidates whose corners are nearer than this share of the side are one; chosen by hand
_CLEAR_BORDER = 0.9  # [-] least share of the border's modules that are dark; chosen by hand
_PROFILE_STEP_PX = 0.5  # [px] between samples across an edge; source: by hand, half a pixel
_MIN_EDGE_POINTS = 5  # [-] of an edge, to fit a line; source: by hand, more than the two that define it
_MIN_CONTRAST = 20.0  # [grey levels] of 255 between border and quiet zone; chosen by hand


@dataclass(frozen=True, slots=True)
class SampledSquare:
    """A candidate with the values of its modules.

    Attributes
    ----------
    corners_px : ndarray, shape (4, 2)
        Clockwise from any corner. [px]
    darkness : ndarray, shape (n, n)
        0 is the level of the quiet zone, 1 that of the border.
    spread : float
        Standard deviation of border and quiet zone in the same unit.
    contrast : float
        [grey levels]
    middle : float
        Grey value between the levels of border and quiet zone.
    """

    corners_px: Floats
    darkness: Floats
    spread: float
    contrast: float
    middle: float


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
