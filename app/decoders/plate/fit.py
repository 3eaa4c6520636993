"""Analysis by synthesis: the homography, the blur and the value of every unit that best explain a plate's pixels.

The plate is a sum of blurred shapes, each with a free value: linear. Where they lie and how they are blurred is not:
plate_from_image (8 parameters), the lens blur and the length of the motion blur. Gauss-Newton runs on both at once,
first on an image of two or three pixels a unit, then on one of more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from app.compiled import ieee_routine, kernel, routine, step
from app.decoders.plate import Array
from app.decoders.plate.hypotheses import cut_patch
from app.decoders.plate.normal_equations import (
    NormalEquations,
    PatchArea,
    PixelSums,
    factorize,
    invert,
    set_normal_equations,
    solve_factorized,
    substitute,
)
from app.decoders.plate.pose import marker_centroids, unit_edges, unit_shapes
from app.decoders.plate.synthesis import (
    BLUR,
    FIRST_GAP,
    FIRST_ROAD,
    MOTION,
    NORMAL_TABLE,
    POSE,
    SINGLES,
    PlateModel,
    PlatePatch,
    blur_quadrature,
    new_scratch,
)
from app.markers.plate import PlateGeometry
from app.values import Floats

# === Homographies between the image and the plate, and the corners that follow from them.


PlaneArray = npt.NDArray[np.float64]

_SQUARE = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])


def homography_from_points(source: PlaneArray, target: PlaneArray) -> PlaneArray:
    """First eight entries of the homography that takes four points to four others, the ninth is 1."""
    rows, rhs = [], []
    for (x, y), (u, v) in zip(source, target, strict=True):
        rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]
        rhs += [u, v]
    solution: PlaneArray = np.linalg.solve(np.array(rows), np.array(rhs))
    return solution


def plate_from_image(pose: PlaneArray, frame: PlaneArray) -> PlaneArray:
    """Homography from pixels of the image to plate coordinates, shape (3, 3); arguments as in `PlateModel`."""
    normalise = np.array([[1 / frame[2], 0, -frame[0] / frame[2]], [0, 1 / frame[2], -frame[1] / frame[2]], [0, 0, 1]])
    matrix: PlaneArray = np.append(pose[:8], 1.0).reshape(3, 3) @ normalise
    return matrix


def project(matrix: PlaneArray, points: PlaneArray) -> PlaneArray:
    """Homography applied to points, shape (N, 2)."""
    w = points @ matrix[2, :2] + matrix[2, 2]
    projected: PlaneArray = (points @ matrix[:2, :2].T + matrix[:2, 2]) / w[:, None]
    return projected


@routine
def _inverse(pose: PlaneArray) -> PlaneArray:
    """Inverse of the homography with these eight entries, up to scale, shape (3, 3)."""
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


@kernel
def set_corners(pose: PlaneArray, frame: PlaneArray, corners: PlaneArray) -> bool:
    """Set the plate's corners in the image, shape (4, 2) [px]; False where one is not in front of the camera."""
    m = _inverse(pose)
    sign = 1.0 if m[2, 0] * 0.5 + m[2, 1] * 0.5 + m[2, 2] > 0 else -1.0
    for k in range(4):
        u = 1.0 if k == 1 or k == 2 else 0.0
        v = 1.0 if k >= 2 else 0.0
        w = sign * (m[2, 0] * u + m[2, 1] * v + m[2, 2])
        if w < 1e-9:
            return False
        corners[k, 0] = sign * (m[0, 0] * u + m[0, 1] * v + m[0, 2]) / w * frame[2] + frame[0]
        corners[k, 1] = sign * (m[1, 0] * u + m[1, 1] * v + m[1, 2]) / w * frame[2] + frame[1]
    return True


def corner_jacobian(pose: PlaneArray, frame: PlaneArray, corners_px: PlaneArray) -> PlaneArray:
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
    stacked: PlaneArray = np.concatenate(rows)
    return stacked


# === Gauss-Newton on the shapes' values, the pose and the blur at once.
#
# The shapes' values are linear in the pixels, so a step finds them exactly for the present pose; the pose follows by
# its derivatives. Steps end early on anything that is no plate: even the best values leave too much of it unexplained.


BLUR_PRIOR = (math.log(0.7), 0.35)
"""[log px] mean and standard deviation of the lens blur's logarithm. The simulated cameras have 0.4 to 1.2 px
(`simulation.conditions`)."""
MOTION_PRIOR = (0.001, 0.02)
"""[plate sides^2] mean and standard deviation of the square of the motion's length. 50 km/h at 1/500 s are 0.028 m,
0.007 plate sides squared; at dusk exposures are two to three times as long."""
MIN_COARSE_EXPLAINED = (0.3, 0.74, 0.8, 0.83, 0.85, 0.85)
"""[1] share of the pixels' variance that the best values explain in each of the first steps on anything that is a
plate."""
MIN_FINE_EXPLAINED = 0.7
"""[1] the same of the values and the pose found, from the second fine step on."""
MAX_STEP = 0.06
"""[extent of the plate's image] by which a step may move a corner. Source: decision record 0010, rule 3."""
NEAR, LOST = 0.02, 0.03
"""[extent of the plate's image] corners that move less are near rest; that move more in the last coarse step, lost."""
REST_PX = 0.25
"""[px] corners rest when they move less in one step."""
MIN_EXTENT_PX, MAX_EXTENT_PX = 3.0, 1.0e5
"""[px] width and height of a plate's image beyond which the steps have left it."""
VALUE_PRIOR_SPREAD = 1.2
"""[mean light of the units] standard deviation of a shape's light about it."""
POSE_RIDGE = 1e-6
"""[residual variance] added to the homography's diagonal, for a factor that exists."""
FLAT_NOISE = 0.02
"""[variance of the plate's light] noise that the first step assumes, before there is a residual."""
MAX_BLUR_STEP = 0.4
"""[log px] by which a step may change the lens blur."""
MAX_MOTION2_STEP = 0.03
"""[plate sides^2] by which a step may lengthen the motion's square."""
PATCH_MARGIN = 0.03
"""[plate sides] around the plate from which pixels are used, and two pixels more."""
GREY_LEVEL = 1.0 / 255
"""[light] least residual. Source: one level of 8 bits."""


class FitQuality(NamedTuple):
    """How well the shapes explain the pixels."""

    is_plate: bool  # False where the steps were given up
    variance: float  # [1] weighted mean squared residual of the pixels on the plate, at least one grey level squared
    explained: float  # share of their variance that the shapes explain
    pixels: int  # pixels that were used


class Move(NamedTuple):
    """How far a step moved the corners: [px], and as a share of the plate's image; negative where it failed."""

    shift_px: float
    share: float


@step
def _add_priors(equations: NormalEquations, model: PlateModel, variance: float) -> None:
    """Add what is known beforehand: values near their mean, lens blur and motion near the usual."""
    matrix = equations.matrix
    shapes = model.values.shape[0]
    mean = 0.0
    for i in range(shapes - SINGLES):
        mean += model.values[i]
    mean = min(max(mean / (shapes - SINGLES), 0.01), 2.0)
    ridge = variance / (VALUE_PRIOR_SPREAD * VALUE_PRIOR_SPREAD * mean * mean)
    for i in range(shapes):
        matrix[i, i] += ridge
        equations.rhs[i] += ridge * mean
    for i in range(shapes, shapes + 8):
        matrix[i, i] += POSE_RIDGE * variance
    weight = variance / (BLUR_PRIOR[1] * BLUR_PRIOR[1])
    matrix[shapes + BLUR, shapes + BLUR] += weight
    equations.rhs[shapes + BLUR] += weight * (BLUR_PRIOR[0] - model.pose[BLUR])
    weight = variance / (MOTION_PRIOR[1] * MOTION_PRIOR[1])
    matrix[shapes + MOTION, shapes + MOTION] += weight
    equations.rhs[shapes + MOTION] += weight * (MOTION_PRIOR[0] - model.pose[MOTION])


@step
def _fix_pose(equations: NormalEquations, shapes: int) -> None:
    """Let only the shapes' values follow from the equations."""
    for i in range(shapes, shapes + POSE):
        equations.matrix[i, i] = 1e6 * (1.0 + equations.matrix[i, i])


@ieee_routine
def _move(
    pose: Floats, start: Floats, solution: Floats, frame: Floats, corners: Floats, moved: Floats, extents: Floats
) -> Move:
    """Add a step to the pose, shortened where it moves the corners too far; `start` is the pose before it.

    IEEE 754 arithmetic: a step may be infinite.
    """
    first = solution.shape[0] - POSE
    pose[BLUR] += min(max(solution[first + BLUR], -MAX_BLUR_STEP), MAX_BLUR_STEP)
    pose[MOTION] = min(max(pose[MOTION] + solution[first + MOTION], 0.0), pose[MOTION] + MAX_MOTION2_STEP)
    share = 1.0
    for _ in range(6):
        total = pose[BLUR] + pose[MOTION]
        for i in range(8):
            pose[i] = start[i] + share * solution[first + i]
            total += pose[i]
        if np.isfinite(total) and set_corners(pose, frame, moved):
            shift_x = 0.0
            shift_y = 0.0
            for k in range(4):
                shift_x = max(shift_x, abs(moved[k, 0] - corners[k, 0]))
                shift_y = max(shift_y, abs(moved[k, 1] - corners[k, 1]))
            far = max(shift_x / extents[0], shift_y / extents[1])
            if far < MAX_STEP * 1.01:
                return Move(max(shift_x, shift_y), far)
            share *= max(MAX_STEP / far, 0.25)
        else:
            share *= 0.25
    return Move(-1.0, -1.0)


@ieee_routine
def _set_area(corners: Floats, patch: PlatePatch, area: PatchArea) -> bool:
    """Set the pixels of the patch around these corners; False where the plate's image is too small or too large."""
    for axis in range(2):
        low = min(min(corners[0, axis], corners[1, axis]), min(corners[2, axis], corners[3, axis]))
        high = max(max(corners[0, axis], corners[1, axis]), max(corners[2, axis], corners[3, axis]))
        extent = high - low
        area.extents[axis] = extent
        if not (MIN_EXTENT_PX < extent < MAX_EXTENT_PX):
            return False
        pitch = patch.grid[2 + axis]
        reach = PATCH_MARGIN * extent + 2.0 * pitch
        area.margin[axis] = PATCH_MARGIN + 2.0 * pitch / extent
        size = patch.light.shape[1 - axis]
        area.box[axis] = min(max(int((low - reach - patch.grid[axis]) / pitch), 0), size)
        area.box[axis + 2] = min(max(int((high + reach - patch.grid[axis]) / pitch) + 2, 0), size)
    return True


@step
def _flat_variance(sums: PixelSums) -> float:
    """Variance of the light of the pixels on the plate about its mean."""
    light2 = sums.inside_light * sums.inside_light / max(sums.inside_weight, 1e-300)
    return (sums.inside_light2 - light2) / max(sums.inside, 1.0)


@step
def _reachable_share(sums: PixelSums, half: Floats, shapes: int) -> float:
    """Share of all pixels' variance that the best values explain, before they are computed.

    The squares of the forward substitution are what the unknowns up to each one take off the sum of squares.
    """
    left = sums.light2
    for i in range(shapes):
        left -= half[i] * half[i]
    variance = sums.light2 - sums.light * sums.light / max(sums.weight, 1e-300)
    return 1.0 - left / max(variance, 1e-12)


class Stage(NamedTuple):
    """One stage of a fit: how many pixels it uses, and how long it goes on."""

    unit_px: float  # pixels a unit, where the image has more
    nodes: int  # of the blur's quadrature on each side of the middle
    max_steps: int
    is_coarse: bool = False  # the first step finds the values alone, and what is no plate ends early
    is_skewed: bool = False  # the blur of an upright plate may be skewed against its rows and columns; takes longer


@kernel
def minimize(patch: PlatePatch, model: PlateModel, equations: NormalEquations, stage: Stage) -> FitQuality:
    """Move pose and values, which change in place, until the corners rest.

    Parameters
    ----------
    equations : NormalEquations
        Memory for the normal equations; holds those of the last step afterwards.

    Returns
    -------
    FitQuality
    """
    shapes = model.values.shape[0]
    corners = np.empty((4, 2))
    moved = np.empty((4, 2))
    start = np.empty(POSE)
    scratch = new_scratch(shapes, model.edges.shape[0])
    area = PatchArea(np.empty(4, np.int64), np.empty(2), np.empty(2))
    quality = FitQuality(False, 0.0, 0.0, 0)
    for k in range(stage.max_steps):
        # the normal equations at the present pose, and what the present values explain
        if not set_corners(model.pose, model.frame, corners) or not _set_area(corners, patch, area):
            return quality
        quadrature = blur_quadrature(model.pose, model.frame, patch.grid, stage.nodes, stage.is_skewed)
        sums = set_normal_equations(patch, area, model, quadrature, scratch, equations)
        if sums.pixels < shapes:
            return FitQuality(False, quality.variance, quality.explained, int(sums.pixels))
        residual2 = sums.inside_residual2 / max(sums.inside, 1.0)
        flat = _flat_variance(sums)
        explained = 1.0 - residual2 / max(flat, 1e-12)
        quality = FitQuality(False, max(residual2, GREY_LEVEL * GREY_LEVEL), explained, int(sums.pixels))
        if not stage.is_coarse and k > 0 and explained < MIN_FINE_EXPLAINED:
            return quality
        # the first step has no values yet, which say how the light moves with the pose
        values_only = stage.is_coarse and k == 0
        _add_priors(equations, model, FLAT_NOISE * flat if values_only else quality.variance)
        if values_only:
            _fix_pose(equations, shapes)
        factor = factorize(equations.matrix)
        if factor.shape[0] == 0:
            return quality
        half = substitute(factor, equations.rhs)
        # `explained` counts the plate's own pixels only: a lane line may lie beside it
        reachable = max(_reachable_share(sums, half, shapes), explained)
        if stage.is_coarse and k < len(MIN_COARSE_EXPLAINED) and reachable < MIN_COARSE_EXPLAINED[k]:
            return quality
        solution = solve_factorized(factor, half, -model.pose[MOTION])
        for i in range(shapes):
            model.values[i] = solution[i]
        if values_only:
            continue
        # the pose follows, as far as a step may go
        for i in range(POSE):
            start[i] = model.pose[i]
        move = _move(model.pose, start, solution, model.frame, corners, moved, area.extents)
        if move.shift_px < 0.0:
            return quality
        if move.shift_px < REST_PX or (stage.is_coarse and move.share < NEAR):
            break
        if stage.is_coarse and k == stage.max_steps - 1 and move.share > LOST:
            return quality
    return FitQuality(True, quality.variance, quality.explained, quality.pixels)


# === Analysis by synthesis.


FIRST_BLUR = 0.2
"""[units] blur to begin with. An edge is then felt from half a unit away."""
FIRST_BLUR_PX = (0.7, 2.5)
"""[px] least and greatest blur to begin with."""
CORNER_SCATTER = 3.0
"""[1] variance of the corners over that of even, independent noise: JPEG, optics, worn edges.
`tests/decoders/plate/test_pose.py` checks the covariances of poses that follow."""
FINE_CORNER_SCATTER = 4.5
"""[1] the same where more pixels are used: neighbours share the errors of the colour mosaic, of sharpening and of JPEG.
Source: half as much again as that of the coarser stages, so that 95 % of the positions' errors are below two standard
deviations (decision record 0012; chosen on seeds 301 to 304, checked on 401 to 403)."""


@dataclass(slots=True)
class PlateFit:
    """What explains a plate's pixels."""

    # shape (3, 3): pixels to plate coordinates: (0, 0) at the triangle's corner, (1, 1) opposite
    plate_from_image: Array
    units: Array  # shape (n, n): [1] light that each unit sends, linear, corners NaN
    # shape (cells * 4, cells * 4): of the units in the order of `unit_order`, everything else free
    units_covariance: Array
    unit_order: npt.NDArray[np.intp]  # flat indices into the grid
    unit_misfit: Array  # shape (n, n): [1] mean squared residual of the pixels on each unit and its halves of the gaps
    markers: Array  # shape (5,): [1] triangle, its other half, squares clockwise
    # `gap`, `road`: [1] mean light of the gaps and of the road around
    gap: float
    road: float
    corners_px: Array  # shape (4, 2)
    corners_covariance_px2: Array  # shape (8, 8)
    residual: float  # [1] root mean square residual on the camera's scale
    explained: float  # share of the pixels' variance that the model explains, at most 1
    # `blur_px`, `motion`: standard deviation of the lens blur [px], length of the motion [plate sides]
    blur_px: float
    motion: float
    pixels: int  # number of pixels that were used
    model: PlateModel  # what was fitted

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


_COARSE, _FINE = Stage(1.8, 1, 6, is_coarse=True), Stage(2.8, 3, 4)
"""Of colour frames: two, then three pixels a unit (decision record 0010, rule 3)."""
_THERMAL_COARSE, _THERMAL_FINE = Stage(2.4, 2, 6, is_coarse=True), Stage(3.5, 4, 4)
"""Of thermal frames, whose plates are few and faint."""
_CORNERS = Stage(4.5, 4, 2, is_skewed=True)
"""Corners of read plates (decision record 0012); 6 px a unit take 0.7 ms more, and only plates of 48 rows and more gain
by it."""


class CoarseFit(NamedTuple):
    """A plate after the first stage: roughly where it is, and what share of its pixels' variance that explains [1]."""

    model: PlateModel
    equations: NormalEquations
    explained: float

    @property
    def plate_from_image(self) -> Array:
        """Homography from pixels to plate coordinates, shape (3, 3)."""
        return plate_from_image(self.model.pose, self.model.frame)


def fit_plate(image: Array, centroids_px: Array, geometry: PlateGeometry, *, linear: bool = False) -> PlateFit | None:
    """Fit a plate whose marker centroids are roughly known.

    Parameters
    ----------
    image : ndarray of uint8, shape (H, W, 3) or (H, W)
        Blue, green, red, of which the luma counts; or grey levels.
    centroids_px : ndarray, shape (4, 2)
        Triangle and squares, clockwise. [px]
    linear : bool
        The levels are proportional to what is seen, as a thermal camera's; else they are gamma encoded.

    Returns
    -------
    PlateFit or None
        None when the steps leave the image, the plate degenerates, or it explains too little of what is there.
    """
    coarse = fit_coarsely(image, centroids_px, geometry, linear=linear)
    return None if coarse is None else finish_fit(image, coarse, geometry, linear=linear)


def fit_coarsely(
    image: Array, centroids_px: Array, geometry: PlateGeometry, *, linear: bool = False
) -> CoarseFit | None:
    """First stage of `fit_plate`; most of what is no plate is given up here."""
    model = _start_model(centroids_px, geometry)
    if model is None:
        return None
    equations = _empty_equations(geometry.n, len(model.values))
    quality = _run_stage(image, model, equations, _THERMAL_COARSE if linear else _COARSE, linear)
    return CoarseFit(model, equations, quality.explained) if quality.is_plate else None


def finish_fit(image: Array, coarse: CoarseFit, geometry: PlateGeometry, *, linear: bool = False) -> PlateFit | None:
    """Second stage of `fit_plate`; it moves the model of the first."""
    model, equations, _explained = coarse
    quality = _run_stage(image, model, equations, _THERMAL_FINE if linear else _FINE, linear)
    if not quality.is_plate:
        return None
    covariance = invert(equations.matrix) * quality.variance
    return _result(model, covariance, equations.misfit, quality) if covariance.size else None


def refit_plate(image: Array, fit: PlateFit, geometry: PlateGeometry, *, linear: bool = False) -> PlateFit | None:
    """Second stage of `fit_plate` from a fit in another version of the image, whose model stays as it is."""
    model = fit.model._replace(pose=fit.model.pose.copy(), values=fit.model.values.copy())
    coarse = CoarseFit(model, _empty_equations(geometry.n, len(model.values)), fit.explained)
    return finish_fit(image, coarse, geometry, linear=linear)


def _run_stage(image: Array, model: PlateModel, equations: NormalEquations, stage: Stage, linear: bool) -> FitQuality:
    """Cut the plate out of the image where the model has it, and move the model until its corners rest."""
    lost = FitQuality(False, 0.0, 0.0, 0)
    corners = np.empty((4, 2))
    if not set_corners(model.pose, model.frame, corners):
        return lost
    patch = cut_patch(image, corners, len(model.unit_shape) * stage.unit_px, linear)
    if patch is None:
        return lost
    if stage.is_coarse:
        model.values[:] = patch.light.mean()
    return minimize(patch, model, equations, stage)


def refine_corners(image: Array, fit: PlateFit, geometry: PlateGeometry) -> tuple[Array, Array] | None:
    """Corners of a fitted plate from more of its pixels, with the blur as the line of sight skews it.

    Parameters
    ----------
    image : ndarray of uint8, shape (H, W, 3)
        That was fitted.
    fit : PlateFit
        Its model stays as it is.

    Returns
    -------
    corners_px : ndarray, shape (4, 2)
    covariance_px2 : ndarray, shape (8, 8)
        None in place of both where the steps leave the plate.
    """
    model = fit.model._replace(pose=fit.model.pose.copy(), values=fit.model.values.copy())
    equations = _empty_equations(geometry.n, len(model.values))
    quality = _run_stage(image, model, equations, _CORNERS, linear=False)
    if not quality.is_plate:
        return None
    covariance = invert(equations.matrix) * quality.variance
    return _corners(model, covariance, FINE_CORNER_SCATTER) if covariance.size else None


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
