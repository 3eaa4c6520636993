"""Gauss-Newton on the shapes' values, the pose and the blur at once.

The shapes' values are linear in the pixels, so a step finds them exactly for the present pose; the pose follows by its
derivatives. Steps end early on anything that is no plate: even the best values leave too much of it unexplained.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from app.compiled import ieee_routine, kernel, step
from app.decoders.plate.homography import set_corners
from app.decoders.plate.linear import factorize, solve_factorized, substitute
from app.decoders.plate.normal_equations import NormalEquations, PatchArea, PixelSums, set_normal_equations
from app.decoders.plate.profiles import Floats
from app.decoders.plate.quadrature import blur_quadrature
from app.decoders.plate.synthesis import BLUR, MOTION, POSE, SINGLES, PlateModel, PlatePatch, new_scratch

BLUR_PRIOR = (math.log(0.7), 0.35)
"""[log px] mean and standard deviation of the lens blur's logarithm. Source: chosen by hand; the simulated cameras have
0.4 to 1.2 px (`simulation.conditions`)."""
MOTION_PRIOR = (0.001, 0.0045)
"""[plate sides^2] mean and standard deviation of the square of the motion's length. Source: chosen by hand; 50 km/h at
1/500 s are 0.028 m, 0.007 plate sides squared."""
MIN_COARSE_EXPLAINED = (0.3, 0.74, 0.8, 0.83, 0.85, 0.85)
"""[1] share of the pixels' variance that the best values explain in each of the first steps on anything that is a
plate. Source: chosen by hand."""
MIN_FINE_EXPLAINED = 0.7
"""[1] the same of the values and the pose found, from the second fine step on. Source: chosen by hand."""
MAX_STEP = 0.06
"""[extent of the plate's image] by which a step may move a corner. Source: decision record 0010, rule 3."""
NEAR, LOST = 0.02, 0.03
"""[extent of the plate's image] corners that move less are near rest; that move more in the last coarse step, lost.
Source: chosen by hand."""
REST_PX = 0.25
"""[px] corners rest when they move less in one step. Source: chosen by hand."""
MIN_EXTENT_PX, MAX_EXTENT_PX = 3.0, 1.0e5
"""[px] width and height of a plate's image beyond which the steps have left it. Source: chosen by hand."""
VALUE_PRIOR_SPREAD = 1.2
"""[mean light of the units] standard deviation of a shape's light about it. Source: chosen by hand."""
POSE_RIDGE = 1e-6
"""[residual variance] added to the homography's diagonal, for a factor that exists. Source: chosen by hand."""
FLAT_NOISE = 0.02
"""[variance of the plate's light] noise that the first step assumes, before there is a residual. Source: chosen by
hand."""
MAX_BLUR_STEP = 0.4
"""[log px] by which a step may change the lens blur. Source: chosen by hand."""
MAX_MOTION2_STEP = 0.01
"""[plate sides^2] by which a step may lengthen the motion's square. Source: chosen by hand."""
PATCH_MARGIN = 0.03
"""[plate sides] around the plate from which pixels are used, and two pixels more. Source: chosen by hand."""
GREY_LEVEL = 1.0 / 255
"""[light] least residual. Source: one level of 8 bits."""


class FitQuality(NamedTuple):
    """How well the shapes explain the pixels.

    Attributes
    ----------
    is_plate : bool
        False where the steps were given up.
    variance : float
        Weighted mean squared residual of the pixels on the plate, at least one grey level squared. [1]
    explained : float
        Share of their variance that the shapes explain.
    pixels : int
        Pixels that were used.
    """

    is_plate: bool
    variance: float
    explained: float
    pixels: int


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


@kernel
def minimize(
    patch: PlatePatch, model: PlateModel, equations: NormalEquations, max_nodes: int, steps: int, is_coarse: bool,
    is_skewed: bool,
) -> FitQuality:  # fmt: skip
    """Move pose and values, which change in place, until the corners rest.

    Parameters
    ----------
    patch : PlatePatch
    model : PlateModel
    equations : NormalEquations
        Memory for the normal equations; holds those of the last step afterwards.
    max_nodes : int
        Nodes of the blur's quadrature on each side of the middle.
    steps : int
        At most.
    is_coarse : bool
        First stage: the first step finds the values alone, and what is no plate ends early.
    is_skewed : bool
        The blur of an upright plate may be skewed against its rows and columns; it takes longer.

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
    for k in range(steps):
        # the normal equations at the present pose, and what the present values explain
        if not set_corners(model.pose, model.frame, corners) or not _set_area(corners, patch, area):
            return quality
        quadrature = blur_quadrature(model.pose, model.frame, patch.grid, max_nodes, is_skewed)
        sums = set_normal_equations(patch, area, model, quadrature, scratch, equations)
        if sums.pixels < shapes:
            return FitQuality(False, quality.variance, quality.explained, int(sums.pixels))
        residual2 = sums.inside_residual2 / max(sums.inside, 1.0)
        flat = _flat_variance(sums)
        explained = 1.0 - residual2 / max(flat, 1e-12)
        quality = FitQuality(False, max(residual2, GREY_LEVEL * GREY_LEVEL), explained, int(sums.pixels))
        if not is_coarse and k > 0 and explained < MIN_FINE_EXPLAINED:
            return quality
        # the first step has no values yet, which say how the light moves with the pose
        values_only = is_coarse and k == 0
        _add_priors(equations, model, FLAT_NOISE * flat if values_only else quality.variance)
        if values_only:
            _fix_pose(equations, shapes)
        factor = factorize(equations.matrix)
        if factor.shape[0] == 0:
            return quality
        half = substitute(factor, equations.rhs)
        # `explained` counts the plate's own pixels only: a lane line may lie beside it
        reachable = max(_reachable_share(sums, half, shapes), explained)
        if is_coarse and k < len(MIN_COARSE_EXPLAINED) and reachable < MIN_COARSE_EXPLAINED[k]:
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
        if move.shift_px < REST_PX or (is_coarse and move.share < NEAR):
            break
        if is_coarse and k == steps - 1 and move.share > LOST:
            return quality
    return FitQuality(True, quality.variance, quality.explained, quality.pixels)
