"""Frames of a fiducial sign that was printed from its artwork."""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt

from app.sensors.camera import Camera
from app.values import Floats

Image = npt.NDArray[np.uint8]

_FINE = 4


def upright_axes(turn_deg: float) -> Floats:
    """Axes of a sign (x right, y up, z to the viewer) in the vehicle frame; at 0 deg it faces the vehicle. Columns."""
    turn = math.radians(turn_deg)
    z, y = np.array([-math.cos(turn), -math.sin(turn), 0.0]), np.array([0.0, 0.0, 1.0])
    return np.column_stack([np.cross(y, z), y, z])


def lying_axes(turn_deg: float) -> Floats:
    """Axes of a sign on the road whose upper edge points ahead, turned to the left. Columns."""
    turn = math.radians(turn_deg)
    y = np.array([math.cos(turn), math.sin(turn), 0.0])
    return np.column_stack([np.array([y[1], -y[0], 0.0]), y, np.array([0.0, 0.0, 1.0])])


def square_px(camera: Camera, axes: Floats, centre_m: Floats, side_m: float) -> Floats:
    """Corners of a square in a frame, clockwise from the upper left. [px]"""
    half = side_m / 2
    corners = np.array([(-half, half, 0.0), (half, half, 0.0), (half, -half, 0.0), (-half, -half, 0.0)])
    in_camera = (corners @ axes.T + centre_m - camera.position_vehicle_m) @ camera.camera_from_vehicle.T
    projected = in_camera @ camera.matrix.T
    return np.asarray(projected[:, :2] / projected[:, 2:], dtype=np.float64)


def render_sign(
    camera: Camera, panel: Image, axes: Floats, centre_m: Floats, panel_m: float, rng: np.random.Generator
) -> Image:
    """A frame of a printed panel: with perspective, a soft lens and noise; its corner tells stand-ins to obey."""
    corners = square_px(camera, axes, centre_m, panel_m)
    frame = np.full((camera.height_px, camera.width_px), 110.0)
    middle, reach = corners.mean(axis=0), int(np.abs(corners - corners.mean(axis=0)).max()) + 12
    x, y = int(middle[0]) - reach, int(middle[1]) - reach
    size, edge = 2 * reach, len(panel)
    target = ((corners - (x, y)) + 0.5) * _FINE - 0.5
    source = np.array([(0, 0), (edge, 0), (edge, edge), (0, edge)]) - 0.5
    warp = cv2.getPerspectiveTransform(source.astype(np.float32), target.astype(np.float32))
    fine = cv2.warpPerspective(panel, warp, (size * _FINE, size * _FINE), borderValue=(110,))
    patch = cv2.resize(fine, (size, size), interpolation=cv2.INTER_AREA)
    top, left = max(y, 0), max(x, 0)
    bottom, right = min(y + size, camera.height_px), min(x + size, camera.width_px)
    frame[top:bottom, left:right] = patch[top - y : bottom - y, left - x : right - x]
    frame = cv2.GaussianBlur(frame, (5, 5), 0.7) + rng.normal(0.0, 3.0, frame.shape)
    frame[:16, :16] = 10.0
    return np.clip(frame, 0, 255).astype(np.uint8)
