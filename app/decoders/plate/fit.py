"""Analysis by synthesis: the homography, the blur and the value of every unit that best explain a plate's pixels.

The plate is a sum of blurred shapes, each with a free value: linear. Where they lie and how they are blurred is not:
plate_from_image (8 parameters), the lens blur and the length of the motion blur. Gauss-Newton runs on both at once,
first on an image of two or three pixels a unit, then on one of more.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from app.decoders.plate.gauss_newton import MOTION_PRIOR, FitQuality, minimize
from app.decoders.plate.homography import corner_jacobian, homography_from_points, plate_from_image, set_corners
from app.decoders.plate.layout import marker_centroids, unit_edges, unit_shapes
from app.decoders.plate.linear import invert
from app.decoders.plate.normal_equations import NormalEquations
from app.decoders.plate.patch import cut_patch
from app.decoders.plate.profiles import NORMAL_TABLE
from app.decoders.plate.synthesis import BLUR, FIRST_GAP, FIRST_ROAD, MOTION, POSE, SINGLES, PlateModel
from app.markers.plate import PlateGeometry

Array = npt.NDArray[Any]

FIRST_BLUR = 0.2
"""[units] blur to begin with. Source: chosen by hand: an edge is then felt from half a unit away."""
FIRST_BLUR_PX = (0.7, 2.5)
"""[px] least and greatest blur to begin with. Source: chosen by hand."""
CORNER_SCATTER = 3.0
"""[1] variance of the corners over that of even, independent noise: JPEG, optics, worn edges. Source: chosen by hand;
`tests/decoders/plate/test_pose.py` checks the covariances of poses that follow."""
FINE_CORNER_SCATTER = 4.5
"""[1] the same where more pixels are used: neighbours share the errors of the colour mosaic, of sharpening and of JPEG.
Source: half as much again as that of the coarser stages, so that 95 % of the positions' errors are below two standard
deviations (decision record 0012; chosen on seeds 301 to 304, checked on 401 to 403)."""


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
        Number of pixels that were used.
    model : PlateModel
        What was fitted.
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
    model: PlateModel

    @property
    def unit_px(self) -> float:
        """Size of a unit in the image across its shorter direction. [px]"""
        right = (self.corners_px[1] + self.corners_px[2] - self.corners_px[0] - self.corners_px[3]) / 2
        down = (self.corners_px[2] + self.corners_px[3] - self.corners_px[0] - self.corners_px[1]) / 2
        # the smaller singular value of the two vectors, from the sum and the product of both squares
        half_sum = (float(right @ right) + float(down @ down)) / 2
        product = float(right[0] * down[1] - right[1] * down[0]) ** 2
        larger = half_sum + math.sqrt(max(half_sum**2 - product, 0.0))
        return math.sqrt(product / max(larger, 1e-300)) / len(self.units)


@dataclass(frozen=True, slots=True)
class _Stage:
    """Pixels a unit, where the image has more; quadrature nodes on each side of the middle; most steps; whether the
    blur may be skewed against rows and columns (`quadrature`)."""

    unit_px: float
    nodes: int
    steps: int
    is_skewed: bool = False


_QUICK = (_Stage(1.8, 1, 6), _Stage(2.8, 4, 4))
"""Stages of colour frames. Source: two, then three pixels a unit (decision record 0010, rule 3); steps chosen by
hand."""
_THOROUGH = (_Stage(2.4, 2, 6), _Stage(3.5, 4, 4))
"""Stages of thermal frames, whose plates are few and faint. Source: chosen by hand."""

_FINE = _Stage(4.5, 4, 2, is_skewed=True)
"""Stage of the corners of read plates. Source: decision record 0012; 6 px a unit take 0.7 ms more, and only plates of
48 rows and more gain by it."""


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
        Called after the coarse stage with plate_from_image and the share explained; False ends the fit.

    Returns
    -------
    PlateFit or None
        None when the steps leave the image, the plate degenerates, or it explains too little of what is there.
    """
    model = _start_model(centroids_px, geometry)
    if model is None:
        return None
    equations = _empty_equations(geometry.n, len(model.values))
    corners = np.empty((4, 2))
    quality = FitQuality(False, 0.0, 0.0, 0)
    for number, stage in enumerate(_THOROUGH if linear else _QUICK):
        is_coarse = number == 0
        if not set_corners(model.pose, model.frame, corners):
            return None
        patch = cut_patch(image, corners, geometry.n * stage.unit_px, linear)
        if patch is None:
            return None
        if is_coarse:
            model.values[:] = patch.light.mean()
        quality = minimize(patch, model, equations, stage.nodes, stage.steps, is_coarse, stage.is_skewed)
        if not quality.is_plate:
            return None
        if not is_coarse or promising is None:
            continue
        if not promising(plate_from_image(model.pose, model.frame), quality.explained):
            return None
    covariance = invert(equations.matrix) * quality.variance
    if not covariance.size:
        return None
    return _result(model, covariance, equations.misfit, quality)


def refine_corners(image: npt.NDArray[Any], fit: PlateFit, geometry: PlateGeometry) -> tuple[Array, Array] | None:
    """Corners of a fitted plate from more of its pixels, with the blur as the line of sight skews it.

    Parameters
    ----------
    image : ndarray of uint8, shape (H, W, 3)
        That was fitted.
    fit : PlateFit
        Its model stays as it is.
    geometry : PlateGeometry

    Returns
    -------
    corners_px : ndarray, shape (4, 2)
    covariance_px2 : ndarray, shape (8, 8)
        None in place of both where the steps leave the plate.
    """
    model = fit.model._replace(pose=fit.model.pose.copy(), values=fit.model.values.copy())
    equations = _empty_equations(geometry.n, len(model.values))
    patch = cut_patch(image, fit.corners_px, geometry.n * _FINE.unit_px, linear=False)
    if patch is None:
        return None
    quality = minimize(patch, model, equations, _FINE.nodes, _FINE.steps, False, _FINE.is_skewed)
    covariance = invert(equations.matrix) * quality.variance
    if not quality.is_plate or not covariance.size:
        return None
    return _corners(model, covariance, FINE_CORNER_SCATTER)


def _start_model(centroids_px: Array, geometry: PlateGeometry) -> PlateModel | None:
    """The plate as its marker centroids show it; None where they span no plate."""
    centre = centroids_px.mean(axis=0)
    frame = np.array([centre[0], centre[1], max(float(np.ptp(centroids_px, axis=0).max()), 4.0)])
    try:
        homography = homography_from_points((centroids_px - centre) / frame[2], marker_centroids(geometry))
    except np.linalg.LinAlgError:
        return None
    pose = np.concatenate([homography, [math.log(_first_blur(centroids_px, geometry.n)), MOTION_PRIOR[0]]])
    values = np.zeros(geometry.n**2 - 16 + SINGLES)
    return PlateModel(unit_edges(geometry), unit_shapes(geometry.n), frame, pose, values, NORMAL_TABLE)


def _empty_equations(n: int, shapes: int) -> NormalEquations:
    size = shapes + POSE
    return NormalEquations(
        np.empty((size, size)), np.empty((shapes, POSE)), np.empty((POSE, POSE)), np.empty(size), np.empty((n, n, 2))
    )


def _first_blur(points_px: Array, n: int) -> float:
    """Blur to begin with: wide enough that an edge is felt from half a unit away. [px]"""
    right, down = points_px[1] - points_px[0], points_px[3] - points_px[0]
    unit = math.sqrt(max(abs(float(right[0] * down[1] - right[1] * down[0])), 1.0)) / (0.75 * n)
    return float(np.clip(FIRST_BLUR * unit, *FIRST_BLUR_PX))


def _result(model: PlateModel, covariance: Array, misfit: Array, quality: FitQuality) -> PlateFit:
    n, shapes = len(model.unit_shape), len(model.values)
    units = np.full((n, n), np.nan)
    order = np.flatnonzero(model.unit_shape.reshape(-1) >= 0)
    units.reshape(-1)[order] = model.values[: len(order)]
    singles = model.values[shapes - SINGLES :]
    corners, corners_covariance = _corners(model, covariance, CORNER_SCATTER)
    return PlateFit(
        plate_from_image=plate_from_image(model.pose, model.frame),
        units=units,
        units_covariance=covariance[: len(order), : len(order)],
        unit_order=order,
        unit_misfit=misfit[..., 1] / np.maximum(misfit[..., 0], 1e-12),
        markers=singles[:FIRST_GAP],
        gap=float(singles[FIRST_GAP:FIRST_ROAD].mean()),
        road=float(singles[FIRST_ROAD:].mean()),
        corners_px=corners,
        corners_covariance_px2=corners_covariance,
        residual=math.sqrt(quality.variance),
        explained=quality.explained,
        blur_px=math.exp(model.pose[BLUR]),
        motion=math.sqrt(model.pose[MOTION]),
        pixels=quality.pixels,
        model=model,
    )


def _corners(model: PlateModel, covariance: Array, scatter: float) -> tuple[Array, Array]:
    """Corners of a fitted model [px] and their covariance [px^2]."""
    shapes = len(model.values)
    corners = np.empty((4, 2))
    set_corners(model.pose, model.frame, corners)
    jacobian = corner_jacobian(model.pose, model.frame, corners)
    homography_covariance = covariance[shapes : shapes + 8, shapes : shapes + 8]
    return corners, scatter * (jacobian @ homography_covariance @ jacobian.T)
