"""Small symmetric positive definite systems on one thread.

LAPACK would do, but its threads cost more than they give at this size, and a caller cannot turn them off per call.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from app.compiled import kernel, routine

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
