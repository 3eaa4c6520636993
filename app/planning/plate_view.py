"""Plates in the image of a camera: its geometry alone, on a flat road."""

from __future__ import annotations

import numpy as np

from app.markers.plate import PlateGeometry
from app.planning.rules import CameraRules
from app.sensors.camera import Camera
from app.values import Floats


def camera_of(rules: CameraRules) -> Camera:
    """The camera that rules describe."""
    return Camera.from_field_of_view(
        rules.width_px,
        rules.height_px,
        rules.horizontal_fov_deg,
        height_m=rules.height_m,
        depression_deg=rules.depression_deg,
    )


def project_road(
    camera: Camera, ahead_m: Floats, left_m: float | Floats, up_m: float | Floats = 0.0
) -> tuple[Floats, Floats]:
    """Columns and rows of places ahead of the camera on the road, each of shape (K,); NaN behind it. [px]"""
    left, up = np.broadcast_to(left_m, ahead_m.shape), np.broadcast_to(up_m, ahead_m.shape)
    vehicle = np.stack([ahead_m, left, up - camera.height_m], axis=1)
    x, y, z = (camera.camera_from_vehicle @ vehicle.T).astype(float)
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = camera.fx_px * x / z + camera.cx_px, camera.fy_px * y / z + camera.cy_px
    return np.where(z > 0.05, u, np.nan), np.where(z > 0.05, v, np.nan)


def unit_heights_px(camera: Camera, geometry: PlateGeometry, ahead_m: Floats, left_m: float | Floats = 0.0) -> Floats:
    """Height of a unit's image when a plate's centre is at distances ahead, shape (K,); 0 where it is not in view. [px]

    The height of the whole plate's image over its number of units, as the proof has it.
    """
    side = geometry.side_mm / 1000
    corners = [(forward, across) for forward in (-side / 2, side / 2) for across in (-side / 2, side / 2)]
    columns, rows = zip(
        *(project_road(camera, ahead_m + forward, left_m + across) for forward, across in corners), strict=True
    )
    u, v = np.stack(columns), np.stack(rows)
    with np.errstate(invalid="ignore"):
        inside = ((u >= -0.5) & (u <= camera.width_px - 0.5) & (v >= -0.5) & (v <= camera.height_px - 0.5)).all(axis=0)
    return np.where(inside, (v.max(axis=0) - v.min(axis=0)) / geometry.n, 0.0)
