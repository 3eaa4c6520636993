"""Corners of a sign and the camera -> pose of the sign.

IPPE gives the two poses of a square in closed form (Collins and Bartoli, IJCV 109, 2014). Signs are mounted plumb or
flat, and the mount says how the camera is held, so the pose that fits both is taken, and a few Gauss-Newton steps weigh
the corners against the mounting.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt

from app.markers.fiducial import FiducialGeometry, Mounting
from app.markers.reading import PlatePose
from app.sensors.camera import Camera

Array = npt.NDArray[np.float64]

CORNER_SIGMA_PX = 0.1
"""Of a corner in each direction. [px] Source: chosen by hand; tests/families/fiducial/test_fiducial_frames.py prints
0.035 on rendered frames, and the rest is left for lenses."""
TILT_SIGMA_RAD = math.radians(1.5)
"""Of a sign's mounting and the vehicle's springs together; chosen by hand, no measurement kept. [rad]"""
_STEP = 1e-6  # [m], [rad] for differences; source: the root of double precision, rounded up, for lengths of metres
_ROUNDS = 10  # of Gauss-Newton; source: by hand, two or three suffice

# axes of a plate (x right, y travel, z up) in the frame of an upright sign (x right, y up, z to the viewer)
_SIGN_FROM_PLATE = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def locate_fiducial(corners_px: Array, geometry: FiducialGeometry, camera: Camera) -> PlatePose | None:
    """Pose of a sign from the corners of its border.

    Parameters
    ----------
    corners_px : ndarray, shape (4, 2)
        Clockwise from the sign's upper left. [px]
    geometry : FiducialGeometry
    camera : Camera

    Returns
    -------
    PlatePose or None
        Axes x right, y travel, z up, as a plate's; None when no pose in front of the camera projects to the corners.
    """
    object_m = np.column_stack([geometry.corners_mm / 1000, np.zeros(4)])
    distortion = np.array(camera.distortion or (0.0,) * 4)
    found, rotations, translations, _ = cv2.solvePnPGeneric(
        object_m, corners_px.reshape(4, 1, 2), camera.matrix, distortion, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    if not found:
        return None
    starts = [np.concatenate([r.ravel(), t.ravel()]) for r, t in zip(rotations, translations, strict=True)]
    refined = [_refine(start, corners_px, object_m, geometry.mounting, camera, distortion) for start in starts]
    best = min((r for r in refined if r is not None), key=lambda r: r[0], default=None)
    if best is None:
        return None
    _cost, pose, information = best
    rotation = np.asarray(cv2.Rodrigues(pose[:3])[0], dtype=np.float64)
    if geometry.mounting is Mounting.UPRIGHT:
        rotation = rotation @ _SIGN_FROM_PLATE
    residual = _corner_residuals(pose, corners_px, object_m, camera, distortion)
    return PlatePose(
        rotation=rotation,
        translation_m=pose[3:].copy(),
        covariance=np.asarray(np.linalg.inv(information), dtype=np.float64),
        reprojection_rms_px=float(np.sqrt(np.mean(np.sum(residual.reshape(4, 2) ** 2, axis=1)))),
    )


def _refine(
    pose: Array, corners_px: Array, object_m: Array, mounting: Mounting, camera: Camera, distortion: Array
) -> tuple[float, Array, Array] | None:
    """Gauss-Newton on corners and mounting: cost, pose (rotation vector, translation), information.

    Small rotations are about the camera's axes, to the left of the pose's rotation.
    """

    def residuals(at: Array) -> Array:
        corners = _corner_residuals(at, corners_px, object_m, camera, distortion) / CORNER_SIGMA_PX
        return np.concatenate([corners, _tilt(at, mounting, camera) / TILT_SIGMA_RAD])

    information = np.eye(6)
    for _ in range(_ROUNDS):
        if pose[5] <= 0.05:
            return None
        now = residuals(pose)
        jacobian = np.empty((len(now), 6))
        for k in range(6):
            step = np.zeros(6)
            step[k] = _STEP
            jacobian[:, k] = (residuals(_moved(pose, step)) - now) / _STEP
        information = jacobian.T @ jacobian
        change = np.asarray(-np.linalg.solve(information, jacobian.T @ now), dtype=np.float64)
        pose = _moved(pose, change)
        if np.abs(change).max() < 1e-8:
            break
    if pose[5] <= 0.05:
        return None
    last = residuals(pose)
    cost = float(last @ last)
    return (cost, pose, information) if math.isfinite(cost) else None


def _moved(pose: Array, step: Array) -> Array:
    rotation = cv2.Rodrigues(step[:3])[0] @ cv2.Rodrigues(pose[:3])[0]
    return np.concatenate([cv2.Rodrigues(rotation)[0].ravel(), pose[3:] + step[3:]])


def _corner_residuals(pose: Array, corners_px: Array, object_m: Array, camera: Camera, distortion: Array) -> Array:
    projected = cv2.projectPoints(object_m, pose[:3], pose[3:], camera.matrix, distortion)[0]
    return np.asarray(projected, dtype=np.float64).reshape(8) - corners_px.reshape(8)


def _tilt(pose: Array, mounting: Mounting, camera: Camera) -> Array:
    """How far the axis of the sign that should be vertical leans forward and to the left of the vehicle. [rad]"""
    rotation = np.asarray(cv2.Rodrigues(pose[:3])[0], dtype=np.float64)
    axis = rotation[:, 1] if mounting is Mounting.UPRIGHT else rotation[:, 2]
    in_vehicle = camera.camera_from_vehicle.T @ axis
    # beyond a quarter turn the lean must keep growing, or an upside-down sign would cost nothing
    lean = np.arctan2(np.hypot(in_vehicle[0], in_vehicle[1]), in_vehicle[2])
    length = np.hypot(in_vehicle[0], in_vehicle[1])
    scale = lean / length if length > 1e-12 else 1.0
    return np.array([in_vehicle[0] * scale, in_vehicle[1] * scale])
