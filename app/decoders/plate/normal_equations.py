"""The normal equations of the shapes' values and of the pose, summed over a plate's pixels."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from app.compiled import kernel, loop, routine, step
from app.decoders.plate.synthesis import (
    FIRST_GAP,
    FIRST_ROAD,
    POSE,
    PixelPlace,
    PixelRow,
    PlateModel,
    PlatePatch,
    Quadrature,
    Scratch,
    blur_on_plate,
    field_light,
    lens_blur,
    place_pixel,
    set_pose_derivatives,
    synthesize,
)
from app.values import Floats, Ints

# === Small symmetric positive definite systems on one thread.
#
# LAPACK would do, but its threads cost more than they give at this size, and a caller cannot turn them off per call.


Array = npt.NDArray[np.float64]


@routine
def subtract_rows(flat: npt.NDArray[Any], i: int, columns: int) -> None:
    """Subtract the rows before row i of a transposed Cholesky factor from it, four at a time, from column i on.

    `flat` has the rows one after the other, of `columns` each. Indices are unsigned, and there are no views of rows:
    the loops over columns are then compiled to vector instructions, and cost no reference counts.
    """
    row = np.uint64(i * columns + i)
    size = columns - i
    for block in range(i // 4):
        first = 4 * block * columns + i
        p, q = np.uint64(first), np.uint64(first + columns)
        r, s = np.uint64(first + 2 * columns), np.uint64(first + 3 * columns)
        a, b, c, d = flat[p], flat[q], flat[r], flat[s]
        for column in range(size):
            k = np.uint64(column)
            flat[row + k] -= a * flat[p + k] + b * flat[q + k] + c * flat[r + k] + d * flat[s + k]
    for j in range(i // 4 * 4, i):
        p = np.uint64(j * columns + i)
        a = flat[p]
        for column in range(size):
            k = np.uint64(column)
            flat[row + k] -= a * flat[p + k]


@routine
def factorize(matrix: Array) -> Array:
    """Cholesky factor of the symmetric matrix with this lower triangle; empty if it is not positive."""
    n = matrix.shape[0]
    upper = np.empty(n * n)
    for i in range(n):
        for j in range(i + 1):
            upper[np.uint64(j * n + i)] = matrix[i, j]
    for i in range(n):
        subtract_rows(upper, i, n)
        row = np.uint64(i * n + i)
        if not upper[row] > 0.0:
            return np.empty((0, 0))
        scale = 1.0 / math.sqrt(upper[row])
        for column in range(n - i):
            upper[row + np.uint64(column)] *= scale
    factor = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1):
            factor[i, j] = upper[np.uint64(j * n + i)]
    return factor


@routine
def substitute(factor: Array, rhs: Array) -> Array:
    """Forward half of the solution, shape (n,): its squares are what the unknowns up to each one take off a sum."""
    n = factor.shape[0]
    half = rhs.copy()
    for i in range(n):
        total = half[i]
        for k in range(i):
            total -= factor[i, k] * half[k]
        half[i] = total / factor[i, i]
    return half


@routine
def solve_factorized(factor: Array, half: Array, min_last: float) -> Array:
    """Solution of the system whose factor this is, shape (n,); the last unknown is held at `min_last` or above."""
    n = factor.shape[0]
    solution = half.copy()
    solution[n - 1] = max(solution[n - 1], min_last * factor[n - 1, n - 1])
    for i in range(n - 1, -1, -1):
        solution[i] /= factor[i, i]
        value = solution[i]
        for k in range(i):
            solution[k] -= factor[i, k] * value
    return solution


@kernel
def invert(matrix: Array) -> Array:
    """Inverse of a symmetric positive definite matrix; empty if it is not positive."""
    factor = factorize(matrix)
    n = factor.shape[0]
    inverse = np.zeros((n, n))
    lower = np.zeros((n, n))
    for i in range(n):
        for k in range(i):
            scale = factor[i, k]
            for j in range(k + 1):
                lower[i, j] -= scale * lower[k, j]
        down = 1.0 / factor[i, i]
        for j in range(i):
            lower[i, j] *= down
        lower[i, i] = down
    for k in range(n):
        for i in range(k + 1):
            scale = lower[k, i]
            for j in range(i + 1):
                inverse[i, j] += scale * lower[k, j]
    for i in range(n):
        for j in range(i):
            inverse[j, i] = inverse[i, j]
    return inverse


# === The normal equations of the shapes' values and of the pose, summed over a plate's pixels.


ROAD_WEIGHT = 0.3
"""[1] weight of a pixel of the road against one of the plate: four values cannot explain a road."""
ROAD_SPREAD = 0.1
"""[light] scale of the Cauchy weight 1 / (1 + r^2) of road pixels: what is further off, as a lane line, counts less.
Commit `a lane line beside a plate does not spoil its fit`."""


class PatchArea(NamedTuple):
    """The pixels of a patch that are used; changes in place."""

    box: Ints  # shape (4,): first column and row, and those after the last
    margin: Floats  # shape (2,): [plate sides] how far around the plate pixels are used, along u and v
    extents: Floats  # shape (2,): [px] width and height of the plate's image


class NormalEquations(NamedTuple):
    """Sums over the pixels of weight times products of derivatives; only lower triangles are used."""

    matrix: Floats  # shape (shapes + 10, shapes + 10): shapes first, then the pose
    cross: Floats  # shape (shapes, 10): the block of shapes and pose, with rows that lie together in memory
    pose: Floats  # shape (10, 10): the block of the pose
    rhs: Floats  # shape (shapes + 10,): right side: weight times derivative times light
    # shape (n, n, 2): weight of the pixels on each unit with its half of the gaps around it, and their squared
    # residuals
    misfit: Floats


class PixelSums(NamedTuple):
    """Sums over pixels: their number and squared light, then of those on the plate."""

    # `pixels`, `inside`: number of pixels, and of those on the plate
    pixels: float
    # `weight`, `light`, `light2`: weight of all pixels, weighted light and squared light
    weight: float
    light: float
    light2: float
    inside: float
    # `inside_weight`, `inside_light`, `inside_light2`, `inside_residual2`: the same of the pixels on the plate, and
    # their weighted squared residuals
    inside_weight: float
    inside_light: float
    inside_light2: float
    inside_residual2: float


@step
def _is_used(pixel: PixelPlace, margin: Floats) -> bool:
    """Whether a pixel lies in front of the camera, on the plate or within the margin around it."""
    return (
        pixel.inverse_depth > 0.0
        and -margin[0] <= pixel.u <= 1.0 + margin[0]
        and -margin[1] <= pixel.v <= 1.0 + margin[1]
    )


@step
def _add_misfit(pixel: PixelPlace, model: PlateModel, weight: float, residual2: float, misfit: Floats) -> None:
    """Add a pixel's squared residual to the unit on which it lies."""
    n = model.edges.shape[0]
    pitch = model.edges[1, 0] - model.edges[0, 0]
    border = 0.5 * (model.edges[0, 0] + model.edges[0, 1] - pitch)  # where the first unit's half of the gap begins
    row = min(max(int((pixel.v - border) / pitch), 0), n - 1)
    column = min(max(int((pixel.u - border) / pitch), 0), n - 1)
    misfit[row, column, 0] += weight
    misfit[row, column, 1] += residual2


@step
def _add_row(row: PixelRow, entries: int, light: float, weight: float, equations: NormalEquations) -> None:
    """Add a pixel's row to the normal equations and clear its shares."""
    shapes = equations.cross.shape[0]
    for e in range(entries):
        j = np.uint64(row.shape[e])
        b = weight * row.share[j]
        equations.rhs[j] += b * light
        for f in range(e + 1):
            i = np.uint64(row.shape[f])
            equations.matrix[max(i, j), min(i, j)] += b * row.share[i]
        for p in range(POSE):
            equations.cross[j, p] += b * row.by_pose[p]
    for p in range(POSE):
        b = weight * row.by_pose[p]
        equations.rhs[shapes + p] += b * light
        for q in range(POSE):
            equations.pose[p, q] += b * row.by_pose[q]
    for e in range(entries):
        row.share[row.shape[e]] = 0.0


@step
def _clear(equations: NormalEquations) -> None:
    equations.matrix[:] = 0.0
    equations.cross[:] = 0.0
    equations.pose[:] = 0.0
    equations.rhs[:] = 0.0
    equations.misfit[:] = 0.0


@step
def _join_blocks(equations: NormalEquations) -> None:
    """Copy the blocks of the pose into the matrix."""
    shapes = equations.cross.shape[0]
    for p in range(POSE):
        for j in range(shapes):
            equations.matrix[shapes + p, j] = equations.cross[j, p]
        for q in range(POSE):
            equations.matrix[shapes + p, shapes + q] = equations.pose[p, q]


@loop
def set_normal_equations(
    patch: PlatePatch,
    area: PatchArea,
    model: PlateModel,
    quadrature: Quadrature,
    scratch: Scratch,
    equations: NormalEquations,
) -> PixelSums:
    """Set the normal equations of the shapes' values and the pose from every pixel in an area.

    The light of a pixel is a sum over shapes, values times shares, linear in the values; its derivatives by the pose
    are taken at the model's present values. Each pixel adds w d d^T to the matrix and w d light to the right side,
    where d are its shares and its derivatives by the pose.
    """
    row, along_u, along_v = scratch
    lens = lens_blur(model.pose, patch.grid)
    sums = PixelSums(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    _clear(equations)
    for y in range(area.box[1], area.box[3]):
        for x in range(area.box[0], area.box[2]):
            pixel = place_pixel(model.pose, model.frame, patch.grid, x, y)
            if not _is_used(pixel, area.margin):
                continue
            variance_u, variance_v = blur_on_plate(pixel, lens, quadrature)
            u = min(max(pixel.u, 0.0), 1.0)
            v = min(max(pixel.v, 0.0), 1.0)
            gap_light = field_light(model, FIRST_GAP, u, v)
            road_light = field_light(model, FIRST_ROAD, u, v)
            entries, slopes = synthesize(
                pixel, variance_u, variance_v, model, quadrature, gap_light, road_light, row, along_u, along_v
            )
            set_pose_derivatives(pixel, variance_u, variance_v, lens, slopes, quadrature, row.by_pose)
            light = np.float64(patch.light[y, x])
            weight = np.float64(patch.weights[y, x])
            if 0.0 <= pixel.u <= 1.0 and 0.0 <= pixel.v <= 1.0:
                residual = light
                for e in range(entries):
                    residual -= model.values[row.shape[e]] * row.share[row.shape[e]]
                residual2 = weight * residual * residual
                _add_misfit(pixel, model, weight, residual2, equations.misfit)
                sums = _add_inside(sums, light, weight, residual2)
            else:
                off = (light - road_light) / ROAD_SPREAD
                weight *= ROAD_WEIGHT / (1.0 + off * off)
            sums = _add_pixel(sums, light, weight)
            _add_row(row, entries, light, weight, equations)
    _join_blocks(equations)
    return sums


@step
def _add_pixel(sums: PixelSums, light: float, weight: float) -> PixelSums:
    return PixelSums(
        sums.pixels + 1.0, sums.weight + weight, sums.light + weight * light, sums.light2 + weight * light * light,
        sums.inside, sums.inside_weight, sums.inside_light, sums.inside_light2, sums.inside_residual2,
    )  # fmt: skip


@step
def _add_inside(sums: PixelSums, light: float, weight: float, residual2: float) -> PixelSums:
    return PixelSums(
        sums.pixels, sums.weight, sums.light, sums.light2,
        sums.inside + 1.0, sums.inside_weight + weight, sums.inside_light + weight * light,
        sums.inside_light2 + weight * light * light, sums.inside_residual2 + residual2,
    )  # fmt: skip
