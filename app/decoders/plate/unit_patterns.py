"""The most likely pattern of dark units under a quadratic cost, and the cost of every symbol beside it.

With d the dark units (0 or 1), c the contrast, y the units' logarithms or levels and W the inverse of their covariance,
the cost of a pattern is r^T W r with r = y + c d: what light alone must explain.
"""

from __future__ import annotations

import numpy as np

from app.compiled import ieee_kernel, ieee_routine, step
from app.values import Floats

MIN_GAIN = 1e-9
"""[cost] by which a flip must lower the cost. Source: rounding."""
MAX_PAIR_COST = 60.0
"""[cost] of a single flip above which it is not tried in pairs. For speed."""
ROUNDS = 12
"""[rounds] of flips and contrast."""
MIN_CONTRAST_SHARE = 0.25
"""[expected contrast] least contrast."""


@ieee_routine
def _times(matrix: Floats, vector: Floats) -> Floats:
    """Product of a symmetric matrix and a vector, row by row."""
    product = np.zeros(vector.shape[0])
    for i in range(vector.shape[0]):
        for j in range(vector.shape[0]):
            product[j] += vector[i] * matrix[i, j]
    return product


@ieee_routine
def _dot(a: Floats, b: Floats) -> float:
    total = 0.0
    for i in range(a.shape[0]):
        total += a[i] * b[i]
    return total


@step
def _best_flip(weight: Floats, slope: Floats, dark: Floats, contrast: float, single: Floats) -> tuple[int, int]:
    """The unit whose flip lowers the cost most, or, when none does, the pair; -1 for none.

    Flipping unit i changes r by s = +-c at i: the cost by 2 s (W r)_i + s^2 W_ii, a pair's by 2 s_i s_j W_ij more.
    """
    units = dark.shape[0]
    best = -MIN_GAIN
    first = -1
    second = -1
    for i in range(units):
        change = contrast * (1.0 - 2.0 * dark[i])
        single[i] = 2.0 * change * slope[i] + change * change * weight[i, i]
        if single[i] < best:
            best = single[i]
            first = i
    if first >= 0:
        return first, second
    for i in range(units):
        if single[i] > MAX_PAIR_COST:
            continue
        change_i = contrast * (1.0 - 2.0 * dark[i])
        for j in range(i):
            change_j = contrast * (1.0 - 2.0 * dark[j])
            cost = single[i] + single[j] + 2.0 * change_i * change_j * weight[i, j]
            if cost < best:
                best = cost
                first = i
                second = j
    return first, second


@step
def _fit_contrast(weight: Floats, values: Floats, dark: Floats, prior: float, spread: float) -> float:
    """The contrast that lowers the cost most, with its prior; at least a quarter of it."""
    down = 1.0 / (spread * spread)
    wanted = prior * down - _dot(dark, _times(weight, values))
    contrast = wanted / (down + _dot(dark, _times(weight, dark)))
    return max(contrast, MIN_CONTRAST_SHARE * prior)


@ieee_kernel
def minimize_pattern(weight: Floats, values: Floats, dark: Floats, prior: float, spread: float) -> tuple[Floats, float]:
    """Flip units, alone and in pairs, while that lowers the cost; the contrast follows.

    Parameters
    ----------
    weight : ndarray, shape (units, units)
        Inverse covariance of the values.
    values : ndarray, shape (units,)
    dark : ndarray, shape (units,)
        Pattern to begin with, 1 where dark; changes in place.
    prior, spread : float
        Expected contrast and its standard deviation.

    Returns
    -------
    residual : ndarray, shape (units,)
        The values with the contrast taken off: values + contrast * dark.
    contrast : float
    """
    units = values.shape[0]
    contrast = prior
    residual = np.empty(units)
    single = np.empty(units)
    for _ in range(ROUNDS):
        contrast = _fit_contrast(weight, values, dark, prior, spread)
        for i in range(units):
            residual[i] = values[i] + contrast * dark[i]
        slope = _times(weight, residual)
        has_changed = False
        for _flip in range(2 * units):
            first, second = _best_flip(weight, slope, dark, contrast, single)
            if first < 0:
                break
            has_changed = True
            for k in (first, second):
                if k < 0:
                    continue
                change = contrast * (1.0 - 2.0 * dark[k])
                dark[k] = 1.0 - dark[k]
                residual[k] += change
                for i in range(units):
                    slope[i] += change * weight[k, i]
        if not has_changed:
            break
    return residual, contrast


@ieee_kernel
def cell_costs(weight: Floats, residual: Floats, dark: Floats, contrast: float, patterns: Floats) -> Floats:
    """Cost of each of 16 symbols in each cell, the other cells as in the pattern, shape (cells, 16).

    Parameters
    ----------
    weight, residual, dark, contrast
        As in and from `minimize_pattern`, four units a cell.
    patterns : ndarray, shape (16, 4)
        Dark units of each symbol.
    """
    cells = dark.shape[0] // 4
    costs = np.empty((cells, 16))
    slope = _times(weight, residual)
    change = np.empty(4)
    for c in range(cells):
        for p in range(16):
            total = 0.0
            for i in range(4):
                change[i] = contrast * (patterns[p, i] - dark[4 * c + i])
                total += 2.0 * change[i] * slope[4 * c + i]
            for i in range(4):
                for j in range(4):
                    total += change[i] * change[j] * weight[4 * c + i, 4 * c + j]
            costs[c, p] = total
    return costs
