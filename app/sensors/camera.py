"""A camera on a vehicle: pinhole with the OpenCV distortion model, and its mount."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter


@dataclass(frozen=True, slots=True)
class Camera:
    """Intrinsics and mount of a camera.

    Parameters
    ----------
    width_px, height_px : int
        Image size. [px]
    fx_px, fy_px, cx_px, cy_px : float
        Focal lengths and principal point; pixel centres at integers. [px]
    distortion : tuple of float
        OpenCV's k1, k2, p1, p2[, k3[, k4, k5, k6]]; empty for none.
    height_m : float
        Above the road. [m]
    depression_deg : float
        Optical axis below the horizontal. [deg]
    azimuth_deg : float
        Optical axis clockwise (to the right) from straight ahead. [deg]
    roll_deg : float
        Clockwise about the optical axis, seen from behind the camera. [deg]
    forward_m, left_m : float
        Optical centre in the vehicle frame (ISO 8855) from the vehicle's reference point on the road. [m]
    readout_s : float
        Rolling shutter: time from the first row's exposure to the last's; 0 is a global shutter. [s]
    """

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, ...] = ()
    height_m: float = 1.57
    depression_deg: float = 23.0
    azimuth_deg: float = 0.0
    roll_deg: float = 0.0
    forward_m: float = 0.0
    left_m: float = 0.0
    readout_s: float = 0.0

    def __post_init__(self) -> None:
        if self.width_px < 1 or self.height_px < 1:
            raise InvalidParameter("an image has at least one pixel a side", field="camera.width_px", limit=">= 1 px")
        for name in ("fx_px", "fy_px", "height_m"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise InvalidParameter(f"{name} must be positive", field=f"camera.{name}", limit="> 0")
        if not 0 <= self.readout_s <= 1:
            raise InvalidParameter("readout_s is 0 to 1 s", field="camera.readout_s", limit="0 to 1 s")
        if len(self.distortion) not in (0, 4, 5, 8):
            raise InvalidParameter(
                "distortion has 0, 4, 5 or 8 coefficients", field="camera.distortion", limit="0, 4, 5 or 8 values"
            )

    @classmethod
    def from_field_of_view(
        cls,
        width_px: int,
        height_px: int,
        horizontal_fov_deg: float,
        *,
        height_m: float = 1.57,
        depression_deg: float = 23.0,
        azimuth_deg: float = 0.0,
        roll_deg: float = 0.0,
        forward_m: float = 0.0,
        left_m: float = 0.0,
        readout_s: float = 0.0,
    ) -> Camera:
        """Camera with square pixels and a centred principal point from its horizontal field of view. [deg]"""
        if not 1 <= horizontal_fov_deg < 179:
            raise InvalidParameter(
                "the horizontal field of view is 1 to 179 degrees",
                field="camera.horizontal_fov_deg",
                limit="1 to 179 deg",
            )
        focal_px = width_px / 2 / math.tan(math.radians(horizontal_fov_deg) / 2)
        return cls(
            width_px, height_px, focal_px, focal_px, (width_px - 1) / 2, (height_px - 1) / 2, (),
            height_m, depression_deg, azimuth_deg, roll_deg, forward_m, left_m, readout_s,
        )  # fmt: skip

    @property
    def matrix(self) -> npt.NDArray[np.float64]:
        """Intrinsic matrix K, shape (3, 3). [px]"""
        return np.array([[self.fx_px, 0, self.cx_px], [0, self.fy_px, self.cy_px], [0, 0, 1.0]])

    @property
    def camera_from_vehicle(self) -> npt.NDArray[np.float64]:
        """Rotation from the vehicle frame (x forward, y left, z up) to the camera frame, shape (3, 3)."""
        axes = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # level, straight ahead
        a, d, r = (math.radians(v) for v in (self.azimuth_deg, self.depression_deg, self.roll_deg))
        # turning the camera right by a = rotating the world left about its y (down) axis, and so on
        yaw = np.array([[math.cos(a), 0, -math.sin(a)], [0, 1, 0], [math.sin(a), 0, math.cos(a)]])
        pitch = np.array([[1, 0, 0], [0, math.cos(d), -math.sin(d)], [0, math.sin(d), math.cos(d)]])
        roll = np.array([[math.cos(r), math.sin(r), 0], [-math.sin(r), math.cos(r), 0], [0, 0, 1]])
        rotation: npt.NDArray[np.float64] = roll @ pitch @ yaw @ axes
        return rotation

    @property
    def position_vehicle_m(self) -> npt.NDArray[np.float64]:
        """Optical centre in the vehicle frame, shape (3,). [m]"""
        return np.array([self.forward_m, self.left_m, self.height_m])
