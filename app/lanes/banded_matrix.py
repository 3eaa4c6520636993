"""Least squares with unknowns along a line: the matrices are banded, so the cost is linear in the line's length.

LAPACK is called directly: the checks of scipy.linalg cost more than matrices of this size.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy

from app.compiled import ieee_kernel

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

_DIFFERENCES = ([1.0], [-1.0, 1.0], [1.0, -2.0, 1.0], [-1.0, 3.0, -3.0, 1.0])
_LIFT, _LIFT_OF_LARGEST = 1e-9, 1e-12  # diagonal shares added against rounding; source: above float64, 2.2e-16


def gram(index: Ints, value: Floats, weight: Floats, size: int, band: int) -> Floats:
    """Weighted sum of the outer products of sparse rows, in LAPACK's lower banded form, shape (band + 1, size).

    Parameters
    ----------
    index : ndarray of int, shape (R, M)
        Unknowns of each row, no two further apart than `band`.
    value : ndarray, shape (R, M)
        Their coefficients.
    weight : ndarray, shape (R,)
    """
    total = np.zeros((band + 1) * size)
    for a in range(index.shape[1]):
        for b in range(a + 1):
            low, high = np.minimum(index[:, a], index[:, b]), np.maximum(index[:, a], index[:, b])
            total += np.bincount((high - low) * size + low, weight * value[:, a] * value[:, b], (band + 1) * size)
    return total.reshape(band + 1, size)


def gather(index: Ints, value: Floats, target: Floats, size: int) -> Floats:
    """Sum of sparse rows times their (weighted) targets, shape (size,)."""
    return np.asarray(np.bincount(index.ravel(), (value * target[:, None]).ravel(), size), float)


def difference_gram(order: int, count: int, band: int) -> Floats:
    """Sum of the squared differences of an order of `count` unknowns, as a banded matrix, shape (band + 1, count)."""
    value = np.array(_DIFFERENCES[order])
    k = np.arange(count - order)[:, None] + np.arange(order + 1)
    return gram(k, np.broadcast_to(value, k.shape), np.ones(len(k)), count, band)


def apply(index: Ints, value: Floats, x: Floats) -> Floats:
    """Sparse rows times x, shape (R,)."""
    return np.asarray(np.sum(value * x[index], 1))


def log_determinant(cholesky: Floats) -> float:
    """Log determinant of the matrix with this banded Cholesky factor."""
    return 2.0 * float(np.sum(np.log(cholesky[0])))


def factor(matrix: Floats) -> Floats:
    """Banded Cholesky factor, lower form, of a matrix that is positive definite except for rounding."""
    found, info = scipy.linalg.lapack.dpbtrf(matrix, lower=1)
    if info:
        lifted = matrix.copy()
        lifted[0] *= 1 + _LIFT
        lifted[0] += _LIFT_OF_LARGEST * matrix[0].max()
        found, info = scipy.linalg.lapack.dpbtrf(lifted, lower=1)
    if info:
        raise np.linalg.LinAlgError("normal matrix is not positive definite")
    return np.asarray(found)


def solve(cholesky: Floats, right: Floats) -> Floats:
    """Solution for one right-hand side (N,) or many (N, G)."""
    solved, _ = scipy.linalg.lapack.dpbtrs(cholesky, right, lower=1)
    return np.asarray(solved)


@ieee_kernel
def inverse_band(cholesky: Floats) -> Floats:
    """The elements of inv(A) within the band of A, in the same form as its Cholesky factor, shape (band + 1, N).

    Source: Takahashi, Fagan and Chen (1973), Formation of a sparse bus impedance matrix; with A = L L' and l = the part
    of a column of L below its diagonal over its diagonal d, the inverse Z has the column -Z l below the diagonal and
    1 / d^2 + l' Z l on it.
    """
    band, size = cholesky.shape[0] - 1, cholesky.shape[1]
    inverse = np.zeros((band + 1, size))
    share = np.zeros(band + 1)
    for j in range(size - 1, -1, -1):
        below = min(band, size - 1 - j)
        for q in range(1, below + 1):
            share[q] = cholesky[q, j] / cholesky[0, j]
        total = 1.0 / cholesky[0, j] ** 2
        for p in range(1, below + 1):
            column = 0.0
            for q in range(1, below + 1):
                column += inverse[abs(p - q), j + min(p, q)] * share[q]
            inverse[p, j] = -column
            total += share[p] * column
        inverse[0, j] = total
    return inverse


def variances(inverse: Floats, index: Ints, value: Floats) -> Floats:
    """a' inv(A) a for sparse rows a, by the band of inv(A) that they are within, shape (R,)."""
    low = np.minimum(index[:, :, None], index[:, None, :])
    high = np.maximum(index[:, :, None], index[:, None, :])
    return np.asarray(np.einsum("ra,rb,rab->r", value, value, inverse[high - low, low]))
