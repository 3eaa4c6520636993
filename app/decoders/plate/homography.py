"""Homographies between the image and the plate, and the corners that follow from them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from app.compiled import kernel, routine

Array = npt.NDArray[np.float64]

_SQUARE = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])


def homography_from_points(source: Array, target: Array) -> Array:
    """First eight entries of the homography that takes four points to four others, the ninth is 1."""
    rows, rhs = [], []
    for (x, y), (u, v) in zip(source, target, strict=True):
        rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]
        rhs += [u, v]
    solution: Array = np.linalg.solve(np.array(rows), np.array(rhs))
    return solution


def plate_from_image(pose: Array, frame: Array) -> Array:
    """Homography from pixels of the image to plate coordinates, shape (3, 3); arguments as in `PlateModel`."""
    normalise = np.array([[1 / frame[2], 0, -frame[0] / frame[2]], [0, 1 / frame[2], -frame[1] / frame[2]], [0, 0, 1]])
    matrix: Array = np.append(pose[:8], 1.0).reshape(3, 3) @ normalise
    return matrix


def project(matrix: Array, points: Array) -> Array:
    """Homography applied to points, shape (N, 2)."""
    w = points @ matrix[2, :2] + matrix[2, 2]
    projected: Array = (points @ matrix[:2, :2].T + matrix[:2, 2]) / w[:, None]
    return projected


@routine
def _inverse(pose: Array) -> Array:
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
def set_corners(pose: Array, frame: Array, corners: Array) -> bool:
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


def corner_jacobian(pose: Array, frame: Array, corners_px: Array) -> Array:
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
