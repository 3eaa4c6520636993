"""Poses of plates seen through a rolling shutter by a moving vehicle.

Each row of the image is exposed at its own time, so that the vehicle has moved between the corners of a plate, and
between a corner and the middle row, whose time is the frame's.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from app.decoders.plate.pose import locate_plate
from app.markers.plate import PlateGeometry
from app.markers.reading import PlatePose
from app.sensors.camera import Camera

Array = npt.NDArray[Any]

MAX_STEPS = 4
"""[steps] of alternating between pose and corners. Source: chosen by hand; the third changes less than 0.01 px."""
REST_PX = 0.005
"""[px] change of a corner below which the steps end. Source: chosen by hand."""


def row_time_s(rows_px: Array, camera: Camera) -> Array:
    """When rows are exposed, after the middle row of the frame. [s]"""
    share = (np.asarray(rows_px, float) - (camera.height_px - 1) / 2) / max(camera.height_px - 1, 1)
    return np.asarray(share * camera.readout_s)


def locate_moving_plate(
    corners_px: Array, covariance_px2: Array, geometry: PlateGeometry, camera: Camera, speed_m_s: float
) -> PlatePose | None:
    """Pose of a plate at the time of the frame's middle row, seen by a camera that drives straight ahead.

    Parameters
    ----------
    corners_px, covariance_px2, geometry, camera
        As in `locate_plate`; the camera has `readout_s`.
    speed_m_s : float
        Of the vehicle, forward. [m/s]

    Returns
    -------
    PlatePose or None
        None when no pose in front of the camera projects to the corners.
    """
    pose = locate_plate(corners_px, covariance_px2, geometry, camera)
    moved_m = speed_m_s * row_time_s(corners_px[:, 1], camera)
    if pose is None or not np.abs(moved_m).max() > 0:
        return pose
    object_m = np.column_stack([geometry.corners_mm / 1000, np.zeros(4)])
    forward = camera.camera_from_vehicle[:, 0]
    distortion = np.array(camera.distortion or (0.0,) * 4)
    shift = np.zeros((4, 2))
    for _step in range(MAX_STEPS):
        in_camera = object_m @ pose.rotation.T + pose.translation_m
        # where the vehicle was when the row of a corner was exposed, and so where that corner was seen
        then = in_camera - moved_m[:, None] * forward
        now, seen = _project(in_camera, camera, distortion), _project(then, camera, distortion)
        last, shift = shift, now - seen
        if np.abs(shift - last).max() < REST_PX:
            break
        moved = locate_plate(corners_px + shift, covariance_px2, geometry, camera)
        if moved is None:
            return None
        pose = moved
    return pose


def _project(points_m: Array, camera: Camera, distortion: Array) -> Array:
    zero = np.zeros(3)
    return np.asarray(cv2.projectPoints(points_m, zero, zero, camera.matrix, distortion)[0].reshape(-1, 2))
