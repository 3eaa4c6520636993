"""Least squares whose unknowns lie along a line: banded matrices, so that cost grows with the line's length only.

LAPACK is called directly: the checks of scipy.linalg cost more than matrices of this size.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.linalg.lapack import dpbtrf, dpbtrs

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


def gram(index: Ints, value: Floats, weight: Floats, size: int, band: int) -> Floats:
    """Weighted sum of the outer products of sparse rows, in LAPACK's lower banded form, shape (band + 1, size).

    Parameters
    ----------
    index : ndarray of int, shape (R, M)
        Unknowns that each row touches, no two further apart than `band`.
    value : ndarray, shape (R, M)
        Their coefficients.
    weight : ndarray, shape (R,)
    """
    touched = index.shape[1]
    total = np.zeros((band + 1) * size)
    for a in range(touched):
        for b in range(a + 1):
            low, high = np.minimum(index[:, a], index[:, b]), np.maximum(index[:, a], index[:, b])
            total += np.bincount((high - low) * size + low, weight * value[:, a] * value[:, b], (band + 1) * size)
    return total.reshape(band + 1, size)


def gather(index: Ints, value: Floats, target: Floats, size: int) -> Floats:
    """Sum of sparse rows times their (weighted) targets, shape (size,)."""
    return np.asarray(np.bincount(index.ravel(), (value * target[:, None]).ravel(), size), float)


def apply(index: Ints, value: Floats, x: Floats) -> Floats:
    """Sparse rows times x, shape (R,)."""
    return np.asarray(np.sum(value * x[index], 1))


def log_determinant(cholesky: Floats) -> float:
    """Of the matrix whose banded Cholesky factor this is."""
    return 2.0 * float(np.sum(np.log(cholesky[0])))


def factor(matrix: Floats) -> Floats:
    """Banded Cholesky factor, lower form; of a matrix that is positive definite but for rounding."""
    found, info = dpbtrf(matrix, lower=1)
    if info:
        lifted = matrix.copy()
        lifted[0] *= 1 + 1e-9
        lifted[0] += 1e-12 * matrix[0].max()
        found, info = dpbtrf(lifted, lower=1)
    if info:
        raise np.linalg.LinAlgError("normal matrix is not positive definite")
    return np.asarray(found)


def solve(cholesky: Floats, right: Floats) -> Floats:
    """Solution for one right side (N,) or many (N, G)."""
    solved, _ = dpbtrs(cholesky, right, lower=1)
    return np.asarray(solved)


def covariances(
    cholesky: Floats, index: Ints, probe: Floats, value: Floats, group: Ints, size: int, groups: int
) -> Floats:
    """a' inv(A) b for sparse rows a (`value`) and b (`probe`) on the same unknowns, shape (R,).

    Rows of one group are solved for together: they must lie so far apart that they do not feel each other.
    """
    right = np.zeros((size, groups))
    np.add.at(right, (index, group[:, None]), probe)
    solved = solve(cholesky, right)
    return np.asarray(np.sum(value * solved[index, group[:, None]], 1))
