"""Analysis by synthesis: the homography, the blur and the value of every unit that best explain a plate's pixels.

The plate is a sum of blurred shapes, each with a free value: linear. Where they lie and how they are blurred is not:
plate_from_image (8 parameters), the lens blur and the length of the motion blur. Gauss-Newton runs on both at once,
first on an image of two or three pixels a unit, then on one of more.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numba as nb
import numpy as np
import numpy.typing as npt

from app.decoders.plate.linear import factorize, invert, solve_factorized, substitute
from app.decoders.plate.synthesis import NORMAL_TABLE, POSE, SINGLES, accumulate, blur_nodes
from app.markers.plate import PlateGeometry

Array = npt.NDArray[Any]

GAMMA = 2.2
BLUR_PRIOR = (math.log(0.7), 0.35)  # log of the lens blur [px], and its spread
MOTION_PRIOR = (0.001, 0.0045)  # square of the motion blur's length [plate sides^2], and its spread
FIRST_BLUR = 0.2  # units
# share of the pixels' variance that shapes of the best values explain in the first steps on anything that is a plate
HOPELESS = (0.3, 0.74, 0.8, 0.83, 0.85, 0.85)
LEAST_FINE = 0.7  # the same of the values and the pose found, from the second fine step on
LEAST_STEP = 1.25  # px, below which averaging gives nothing
MOST_STEP = 0.06  # of the plate's image: how far a step may move a corner
NEAR, LOST = 0.02, 0.03  # of the plate's image: corners that move less are near rest, that move more are lost
REST_PX = 0.25  # corners rest when they move less in one step
CORNER_SCATTER = 3.0  # of the corners against what even, independent noise would give: JPEG, optics, worn edges
_LEVELS = np.linspace(0.0, 1.0, 256)
_LIGHT = (_LEVELS**GAMMA).astype(np.float32)
_LINEAR = _LEVELS.astype(np.float32)
_WEIGHTS = ((GAMMA * np.maximum(_LEVELS ** (1 / GAMMA), 0.18) ** (GAMMA - 1)) ** -2.0).astype(np.float32)  # by light


@dataclass(slots=True)
class PlateFit:
    """What explains a plate's pixels.

    Attributes
    ----------
    plate_from_image : ndarray, shape (3, 3)
        Pixels to plate coordinates: (0, 0) at the triangle's corner, (1, 1) opposite.
    units : ndarray, shape (n, n)
        Light that each unit sends, linear, corners NaN. [1]
    units_covariance : ndarray, shape (cells * 4, cells * 4)
        Of the units in the order of `unit_order`, everything else free.
    unit_order : ndarray of int
        Flat indices into the grid.
    unit_misfit : ndarray, shape (n, n)
        Mean squared residual of the pixels on each unit and its halves of the gaps. [1]
    markers : ndarray, shape (5,)
        Triangle, its other half, squares clockwise. [1]
    gap, road : float
        Mean light of the gaps and of the road around. [1]
    corners_px : ndarray, shape (4, 2)
    corners_covariance_px2 : ndarray, shape (8, 8)
    residual : float
        Root mean square residual on the camera's scale. [1]
    explained : float
        Share of the pixels' variance that the model explains, at most 1.
    blur_px, motion : float
        Standard deviation of the lens blur [px], length of the motion [plate sides].
    pixels : int
        How many pixels spoke.
    """

    plate_from_image: Array
    units: Array
    units_covariance: Array
    unit_order: npt.NDArray[np.intp]
    unit_misfit: Array
    markers: Array
    gap: float
    road: float
    corners_px: Array
    corners_covariance_px2: Array
    residual: float
    explained: float
    blur_px: float
    motion: float
    pixels: int

    @property
    def unit_px(self) -> float:
        """Size of a unit in the image across its shorter direction. [px]"""
        right = (self.corners_px[1] + self.corners_px[2] - self.corners_px[0] - self.corners_px[3]) / 2
        down = (self.corners_px[2] + self.corners_px[3] - self.corners_px[0] - self.corners_px[1]) / 2
        shorter = np.linalg.svd(np.stack([right, down]), compute_uv=False)[1]
        return float(shorter) / len(self.units)


@lru_cache
def unit_edges(geometry: PlateGeometry) -> Array:
    """Low and high edge of every unit along a side, in plate sides, shape (n, 2)."""
    low = (geometry.gap_mm + np.arange(geometry.n) * geometry.pitch_mm) / geometry.side_mm
    return np.stack([low, low + geometry.unit_mm / geometry.side_mm], axis=1)


@lru_cache
def marker_centroids(geometry: PlateGeometry) -> Array:
    """Centroids of the triangle and the three squares, clockwise, in plate sides, shape (4, 2)."""
    edges = unit_edges(geometry)
    low, side = edges[0, 0], edges[1, 1] - edges[0, 0]
    near, far = low + side / 2, 1 - low - side / 2
    tip = low + side / 3
    return np.array([(tip, tip), (far, near), (far, far), (near, far)])


@lru_cache
def unit_centres(geometry: PlateGeometry) -> Array:
    """Centres of the units that carry the code, in plate sides, shape (units, 2)."""
    middle = unit_edges(geometry).mean(axis=1)
    rows, columns = np.nonzero(_slots(geometry.n) >= 0)
    return np.stack([middle[columns], middle[rows]], axis=1)


@dataclass(frozen=True, slots=True)
class _Patch:
    """Linear light around a plate, its weights, and the grid of its pixels in the frame (`synthesis.accumulate`)."""

    light: Array
    weights: Array
    grid: Array


@dataclass(frozen=True, slots=True)
class _Stage:
    """Pixels a unit, where the image has more; quadrature nodes on each side of the middle; most steps."""

    unit_px: float
    nodes: int
    steps: int


_QUICK = (_Stage(1.8, 1, 6), _Stage(2.8, 4, 4))
_THOROUGH = (_Stage(2.4, 2, 6), _Stage(3.5, 4, 4))  # a thermal camera's plates are few and faint


def fit_plate(
    image: npt.NDArray[Any],
    centroids_px: Array,
    geometry: PlateGeometry,
    *,
    linear: bool = False,
    promising: Callable[[Array, float], bool] | None = None,
) -> PlateFit | None:
    """Fit a plate whose marker centroids are roughly known.

    Parameters
    ----------
    image : ndarray of uint8, shape (H, W, 3) or (H, W)
        Blue, green, red, of which the luma counts; or grey levels.
    centroids_px : ndarray, shape (4, 2)
        Triangle and squares, clockwise. [px]
    geometry : PlateGeometry
    linear : bool
        The levels are proportional to what is seen, as a thermal camera's; else they are gamma encoded.
    promising : callable, optional
        Asked after the coarse stage with plate_from_image and the share explained; when it says no, that is all.

    Returns
    -------
    PlateFit or None
        None when the steps leave the image, the plate degenerates, or it explains too little of what is there.
    """
    centre = centroids_px.mean(axis=0)
    frame = np.array([centre[0], centre[1], max(float(np.ptp(centroids_px, axis=0).max()), 4.0)])
    edges, slot = unit_edges(geometry), _slots(geometry.n)
    try:
        start = _homography((centroids_px - centre) / frame[2], marker_centroids(geometry))
    except np.linalg.LinAlgError:
        return None
    pose = np.concatenate([start, [math.log(_first_blur(centroids_px, geometry.n)), MOTION_PRIOR[0]]])
    coef = np.zeros(geometry.n**2 - 16 + SINGLES)
    normal = np.empty((len(coef) + POSE, len(coef) + POSE))
    corners = np.empty((4, 2))
    misfit = np.empty((geometry.n, geometry.n, 2))
    variance, explained, pixels = 0.0, 0.0, 0
    for number, stage in enumerate(_THOROUGH if linear else _QUICK):
        first = number == 0
        if not _corners(pose, frame, corners):
            return None
        patch = _cut_patch(image, corners, geometry.n * stage.unit_px, linear)
        if patch is None:
            return None
        if first:
            coef[:] = patch.light.mean()
        ok, variance, explained, pixels = _gauss_newton(
            patch.light, patch.weights, patch.grid, NORMAL_TABLE, frame, pose, edges, slot, coef, normal, misfit,
            stage.nodes, stage.steps, first,
        )  # fmt: skip
        if not ok or (first and promising is not None and not promising(_matrix(pose, frame), explained)):
            return None
    covariance = invert(normal) * variance
    if not covariance.size:
        return None
    return _result(frame, pose, slot, coef, covariance, misfit, math.sqrt(variance), explained, pixels)


def _first_blur(points_px: Array, n: int) -> float:
    """Blur to begin with: wide enough that an edge is felt from half a unit away. [px]"""
    right, down = points_px[1] - points_px[0], points_px[3] - points_px[0]
    unit = math.sqrt(max(abs(float(right[0] * down[1] - right[1] * down[0])), 1.0)) / (0.75 * n)
    return float(np.clip(FIRST_BLUR * unit, 0.7, 2.5))


def _cut_patch(image: npt.NDArray[Any], corners_px: Array, wanted_px: float, linear: bool) -> _Patch | None:
    """The image around a plate, averaged down to about this many pixels along its sides; None outside the image."""
    low, high = corners_px.min(axis=0), corners_px.max(axis=0)
    extent = high - low
    if not (extent > 3.0).all() or not (extent < 2 * max(image.shape)).all():
        return None
    turned = math.sqrt(float(extent.prod()) / max(cv2.contourArea(corners_px.astype(np.float32)), 1.0))
    step = extent / (wanted_px * min(turned, 1.5))
    pad = 0.15 * extent + 2 * step
    x0, y0 = (int(v) for v in np.maximum(low - pad, 0))
    x1, y1 = (int(v) for v in np.minimum(high + pad + 1, [image.shape[1], image.shape[0]]))
    wide, tall = ((far - near if s < LEAST_STEP else round((far - near) / s))
                  for near, far, s in ((x0, x1, step[0]), (y0, y1, step[1])))  # fmt: skip
    if min(wide, tall) < 4:
        return None
    step = np.array([(x1 - x0) / wide, (y1 - y0) / tall])
    patch = image[y0:y1, x0:x1]
    luma = cv2.cvtColor(patch, cv2.COLOR_BGR2GRAY) if patch.ndim == 3 else np.ascontiguousarray(patch)
    light = cv2.LUT(luma, _LINEAR if linear else _LIGHT)
    if (tall, wide) != light.shape:
        light = cv2.resize(light, (wide, tall), interpolation=cv2.INTER_AREA)
    weights = np.ones_like(light) if linear else _WEIGHTS[(light * 255 + 0.5).astype(np.uint8)]
    grid = np.array([x0 + (step[0] - 1) / 2, y0 + (step[1] - 1) / 2, step[0], step[1]])
    return _Patch(light, weights, grid)


def _homography(source: Array, target: Array) -> Array:
    """First eight entries of the homography that takes four points to four others, the ninth is 1."""
    rows, rhs = [], []
    for (x, y), (u, v) in zip(source, target, strict=True):
        rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]
        rhs += [u, v]
    solution: Array = np.linalg.solve(np.array(rows), np.array(rhs))
    return solution


@lru_cache
def _slots(n: int) -> npt.NDArray[np.int64]:
    """Column of every unit in the normal equations, row by row; -1 in the corner cells, shape (n, n)."""
    corner = np.zeros((n, n), dtype=bool)
    corner[np.ix_([0, 1, n - 2, n - 1], [0, 1, n - 2, n - 1])] = True
    slot = np.full((n, n), -1, dtype=np.int64)
    slot[~corner] = np.arange(n * n - 16)
    return slot


def _matrix(pose: Array, frame: Array) -> Array:
    """plate_from_image for pixels, shape (3, 3)."""
    normalise = np.array([[1 / frame[2], 0, -frame[0] / frame[2]], [0, 1 / frame[2], -frame[1] / frame[2]], [0, 0, 1]])
    matrix: Array = np.append(pose[:8], 1.0).reshape(3, 3) @ normalise
    return matrix


def project(matrix: Array, points: Array) -> Array:
    """Homography applied to points, shape (N, 2)."""
    w = points @ matrix[2, :2] + matrix[2, 2]
    projected: Array = (points @ matrix[:2, :2].T + matrix[:2, 2]) / w[:, None]
    return projected


@nb.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _inverse(pose):  # type: ignore[no-untyped-def]
    """Inverse of the homography with these eight entries, up to scale."""
    a, b, c, d, e, f, g, h = pose[0], pose[1], pose[2], pose[3], pose[4], pose[5], pose[6], pose[7]
    inverse = np.empty((3, 3))
    inverse[0, 0] = e - f * h
    inverse[0, 1] = c * h - b
    inverse[0, 2] = b * f - c * e
    inverse[1, 0] = f * g - d
    inverse[1, 1] = a - c * g
    inverse[1, 2] = c * d - a * f
    inverse[2, 0] = d * h - e * g
    inverse[2, 1] = b * g - a * h
    inverse[2, 2] = a * e - b * d
    return inverse


@nb.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _corners(pose, frame, out):  # type: ignore[no-untyped-def]
    """Corners of the plate in pixels; False behind the camera."""
    m = _inverse(pose)
    sign = 1.0 if m[2, 0] * 0.5 + m[2, 1] * 0.5 + m[2, 2] > 0 else -1.0
    for k in range(4):
        u = 1.0 if k == 1 or k == 2 else 0.0
        v = 1.0 if k >= 2 else 0.0
        w = sign * (m[2, 0] * u + m[2, 1] * v + m[2, 2])
        if w < 1e-9:
            return False
        out[k, 0] = sign * (m[0, 0] * u + m[0, 1] * v + m[0, 2]) / w * frame[2] + frame[0]
        out[k, 1] = sign * (m[1, 0] * u + m[1, 1] * v + m[1, 2]) / w * frame[2] + frame[1]
    return True


@nb.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _hold_open_ends(normal, rhs, pose, coef, variance):  # type: ignore[no-untyped-def]
    """Hold what the pixels leave open: values near their mean, blur near the usual."""
    shapes = coef.shape[0]
    mean = 0.0
    for i in range(shapes - SINGLES):
        mean += coef[i]
    mean = min(max(mean / (shapes - SINGLES), 0.01), 2.0)
    ridge = variance / (1.44 * mean * mean)
    for i in range(shapes):
        normal[i, i] += ridge
        rhs[i] += ridge * mean
    for i in range(shapes, shapes + 8):
        normal[i, i] += 1e-6 * variance
    hold = variance / (BLUR_PRIOR[1] * BLUR_PRIOR[1])
    normal[shapes + 8, shapes + 8] += hold
    rhs[shapes + 8] += hold * (BLUR_PRIOR[0] - pose[8])
    hold = variance / (MOTION_PRIOR[1] * MOTION_PRIOR[1])
    normal[shapes + 9, shapes + 9] += hold
    rhs[shapes + 9] += hold * (MOTION_PRIOR[0] - pose[9])


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _move(pose, step, frame, corners, moved, extents):  # type: ignore[no-untyped-def]
    """Add a step to the pose, shortened where it carries the corners too far.

    Returns how far they went, in pixels and as a share of the plate's image; -1 for nowhere.
    """
    start = pose.copy()
    pose[8] += min(max(step[8], -0.4), 0.4)
    pose[9] = min(max(pose[9] + step[9], 0.0), pose[9] + 0.01)
    share = 1.0
    for _ in range(6):
        for i in range(8):
            pose[i] = start[i] + share * step[i]
        if np.isfinite(pose.sum()) and _corners(pose, frame, moved):
            shift = np.abs(moved - corners)
            far = max(shift[:, 0].max() / extents[0], shift[:, 1].max() / extents[1])
            if far < MOST_STEP * 1.01:
                return shift.max(), far
            share *= max(MOST_STEP / far, 0.25)
        else:
            share *= 0.25
    return -1.0, -1.0


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _box_around(corners, grid, shape, box, margin, extents):  # type: ignore[no-untyped-def]
    """Pixels of the patch around these corners, and how far around the plate they count; False when there are none."""
    for axis in range(2):
        low = corners[:, axis].min()
        high = corners[:, axis].max()
        extents[axis] = high - low
        if not (3.0 < extents[axis] < 1.0e5):
            return False
        step = grid[2 + axis]
        reach = 0.03 * extents[axis] + 2.0 * step
        margin[axis] = 0.03 + 2.0 * step / extents[axis]
        size = shape[1 - axis]
        box[axis] = min(max(int((low - reach - grid[axis]) / step), 0), size)
        box[axis + 2] = min(max(int((high + reach - grid[axis]) / step) + 2, 0), size)
    return True


@nb.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _gauss_newton(  # type: ignore[no-untyped-def]
    light, weights, grid, table, frame, pose, edges, slot, coef, normal, misfit, most_nodes, steps, first,
):  # fmt: skip
    """Move pose and shape values until the corners rest.

    Returns whether there is a plate, the residual's variance, the share of variance explained, and the pixels used.
    """
    shapes = coef.shape[0]
    rhs = np.empty(shapes + POSE)
    cross = np.empty((shapes, POSE))
    inner = np.empty((POSE, POSE))
    corners = np.empty((4, 2))
    moved = np.empty((4, 2))
    box = np.empty(4, np.int64)
    margin = np.empty(2)
    extents = np.empty(2)
    sums = np.empty(8)
    variance = 0.0
    explained = 0.0
    pixels = 0
    for k in range(steps):
        if not _corners(pose, frame, corners) or not _box_around(corners, grid, light.shape, box, margin, extents):
            return False, variance, explained, pixels
        nodes, node_weights, direction, by_spread = blur_nodes(pose, frame, grid, most_nodes)
        normal[:] = 0.0
        cross[:] = 0.0
        inner[:] = 0.0
        rhs[:] = 0.0
        accumulate(
            light, weights, grid, box, frame, pose, edges, slot, coef, nodes, node_weights, direction, by_spread,
            margin, table, normal, cross, inner, rhs[:shapes], rhs[shapes:], sums, misfit,
        )  # fmt: skip
        normal[shapes:, :shapes] = cross.T
        normal[shapes:, shapes:] = inner
        pixels = int(sums[0])
        if pixels < shapes:
            return False, variance, explained, pixels
        inside = max(sums[1], 1.0)
        total = sums[3] / inside
        variance = max(total, (1.0 / 255) ** 2)
        flat = (sums[5] - sums[4] * sums[4] / max(sums[2], 1e-300)) / inside
        explained = 1.0 - total / max(flat, 1e-12)
        blind = first and k == 0  # no values yet: nothing says how they move with the pose
        _hold_open_ends(normal, rhs, pose, coef, 0.02 * flat if blind else variance)
        if blind:
            for i in range(shapes, shapes + POSE):
                normal[i, i] = 1e6 * (1.0 + normal[i, i])
        if not first and k > 0 and explained < LEAST_FINE:
            return False, variance, explained, pixels
        factor = factorize(normal)
        if factor.shape[0] == 0:
            return False, variance, explained, pixels
        half = substitute(factor, rhs)
        best = 1.0 - (sums[7] - (half[:shapes] ** 2).sum()) / max(sums[6], 1e-12)
        # what is explained counts the plate's own pixels only: a lane line may lie beside it
        if first and k < len(HOPELESS) and max(best, explained) < HOPELESS[k]:
            return False, variance, explained, pixels
        solution = solve_factorized(factor, half, -pose[9])
        coef[:] = solution[:shapes]
        if blind:
            continue
        shift, far = _move(pose, solution[shapes:], frame, corners, moved, extents)
        if shift < 0.0:
            return False, variance, explained, pixels
        if shift < REST_PX or (first and far < NEAR):
            break
        if first and k == steps - 1 and far > LOST:
            return False, variance, explained, pixels
    return True, variance, explained, pixels


def _result(
    frame: Array, pose: Array, slot: npt.NDArray[np.int64], coef: Array, covariance: Array, misfit: Array,
    residual: float, explained: float, pixels: int,
) -> PlateFit:  # fmt: skip
    n, shapes = len(slot), len(coef)
    units = np.full((n, n), np.nan)
    order = np.flatnonzero(slot.reshape(-1) >= 0)
    units.reshape(-1)[order] = coef[: len(order)]
    corners = np.empty((4, 2))
    _corners(pose, frame, corners)
    jacobian = _corner_jacobian(pose, frame, corners)
    return PlateFit(
        plate_from_image=_matrix(pose, frame),
        units=units,
        units_covariance=covariance[: len(order), : len(order)],
        unit_order=order,
        unit_misfit=misfit[..., 1] / np.maximum(misfit[..., 0], 1e-12),
        markers=coef[shapes - SINGLES : shapes - 8],
        gap=float(coef[shapes - 8 : shapes - 4].mean()),
        road=float(coef[shapes - 4 :].mean()),
        corners_px=corners,
        corners_covariance_px2=CORNER_SCATTER
        * (jacobian @ covariance[shapes : shapes + 8, shapes : shapes + 8] @ jacobian.T),
        residual=residual,
        explained=explained,
        blur_px=math.exp(pose[8]),
        motion=math.sqrt(pose[9]),
        pixels=pixels,
    )


_SQUARE = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])


def _corner_jacobian(pose: Array, frame: Array, corners_px: Array) -> Array:
    """Derivative of the flattened corners [px] by the homography's eight entries, shape (8, 8)."""
    rows = []
    for (u, v), (x, y) in zip(_SQUARE, (corners_px - frame[:2]) / frame[2], strict=True):
        w = pose[6] * x + pose[7] * y + 1
        by_pose = np.array([[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]) / w
        by_point = (
            np.array([[pose[0] - u * pose[6], pose[1] - u * pose[7]], [pose[3] - v * pose[6], pose[4] - v * pose[7]]])
            / w
        )
        rows.append(-np.linalg.solve(by_point, by_pose) * frame[2])
    stacked: Array = np.concatenate(rows)
    return stacked
