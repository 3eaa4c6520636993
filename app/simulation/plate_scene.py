"""What is in front of the camera: squares on the road, light, air, sensor; and the truth about it.

Ground frame: origin on the road below the camera at mid-exposure, x ahead (the vehicle's heading), y left, z up. [m]
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import cv2
import numpy as np
import numpy.typing as npt

from app.sensors.camera import Camera
from app.simulation.plate_face import Face
from app.values import Floats


@dataclass(frozen=True, slots=True)
class PlacedFace:
    """A square lying on the road."""

    face: Face
    # `ahead_m`, `left_m`: [m] its centre in the ground frame
    ahead_m: float
    left_m: float = 0.0
    rotation_deg: float = 0.0  # [deg] clockwise, seen from above, from the vehicle's heading to the face's up direction

    @property
    def ground_from_face(self) -> Floats:
        """Rotation (columns: the face's right, up, out of the road) in the ground frame, shape (3, 3)."""
        a = math.radians(self.rotation_deg)
        return np.array([[-math.sin(a), math.cos(a), 0], [-math.cos(a), -math.sin(a), 0], [0, 0, 1.0]])

    @property
    def corners_ground_m(self) -> Floats:
        """Outer corners, clockwise from top-left, shape (4, 3). [m]"""
        half = self.face.side_m / 2
        corners = np.array([(-half, half, 0), (half, half, 0), (half, -half, 0), (-half, -half, 0)])
        placed: Floats = corners @ self.ground_from_face.T + (self.ahead_m, self.left_m, 0)
        return placed

    @property
    def texel_from_ground(self) -> Floats:
        """Affine map from ground x, y to columns, rows of the face's texture, shape (2, 3)."""
        size = self.face.reflectance.shape[0]
        scale = size / self.face.side_m
        right, up = self.ground_from_face[:2, 0], self.ground_from_face[:2, 1]
        linear = np.stack([right * scale, -up * scale])
        return np.column_stack([linear, size / 2 - linear @ (self.ahead_m, self.left_m)])


@dataclass(frozen=True, slots=True)
class Shadow:
    """Shadows on road and plate, fixed to the first face's centre."""

    edge_light: float = 1.0  # share of light behind a straight shadow edge; 1 is no edge
    # `edge_angle_deg`, `edge_offset_m`, `penumbra_m`: direction of the edge's normal from ahead, its distance from the
    # face's centre, half width of its soft border
    edge_angle_deg: float = 0.0
    edge_offset_m: float = 0.0
    penumbra_m: float = 0.02
    dapple_light: float = 1.0  # share of light in the darkest spot below leaves; 1 is none
    # `dapple_m`, `dapple_softness`: size of the spots [m], and how gradual they are, 0.02 to 0.5
    dapple_m: float = 0.15
    dapple_softness: float = 0.15
    seed: int = 0  # of the spots' places

    @property
    def is_none(self) -> bool:
        """No shadow at all."""
        return self.edge_light >= 1 and self.dapple_light >= 1


@dataclass(frozen=True, slots=True)
class Air:
    """Between road and lens."""

    haze: float = 0.0  # share of the light replaced by airlight, 0 to 1
    airlight: float = 0.7  # radiance of the haze, as a share of saturation
    # radiance of the mirrored sky or sun on the first face at the lobe's centre, as a share of saturation
    glare: float = 0.0
    # `glare_at_m`, `glare_size_m`: [m] centre (right, up from the face's centre) and radii (across, along) of the lobe
    glare_at_m: tuple[float, float] = (0.0, 0.0)
    glare_size_m: tuple[float, float] = (0.2, 0.4)


@dataclass(frozen=True, slots=True)
class Sensor:
    """Lens, sensor and image pipeline."""

    blur_px: float = 0.7  # [px] standard deviation of the lens's Gaussian point spread
    # `full_well_e`, `read_noise_e`: [e-] Electrons at saturation and read noise
    full_well_e: float = 6000.0
    read_noise_e: float = 4.0
    gain: float = 1.0  # exposure relative to the photo's
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)  # gains on blue, green, red
    gamma: float = 2.2  # encoding exponent is 1 / gamma above the linear toe
    shoulder: float = 0.8  # radiance, as a share of saturation, from which highlights are compressed; 1 clips hard
    bayer: bool = True  # sample one colour a pixel and interpolate
    sharpen: float = 0.0  # amount of unsharp masking that the pipeline adds
    colour_shift_px: float = 0.0  # [px] sideways shift between red and blue (lateral chromatic aberration)
    readout_s: float = 0.0  # [s] rolling shutter: time from the first row's exposure to the last's
    jpeg_quality: int | None = 92  # 4:2:0 JPEG round trip; None leaves it out


@dataclass(frozen=True, slots=True)
class Occluder:
    """Something between camera and plate: everything on one side of a line in the image."""

    angle_deg: float  # [deg] direction in the image, clockwise from right, towards the hidden side
    share: float  # how much of the first face's extent along that direction is hidden, 0 to 1
    radiance: float = 0.05  # as a share of saturation
    softness_px: float = 1.5  # [px] half width of its blurred edge


@dataclass(frozen=True, slots=True, eq=False)
class PlateScene:
    """One exposure."""

    camera: Camera  # intrinsics and mount
    faces: tuple[PlacedFace, ...]  # not overlapping; the first is the plate that shadows, glare and occluders refer to
    # `speed_m_s`, `exposure_s`: forward speed and exposure time
    speed_m_s: float = 0.0
    exposure_s: float = 0.001
    # [deg/s] roll, pitch (nose down) and yaw (left) rates of the vehicle during the exposure
    spin_deg_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    # [deg] roll, pitch (nose down) and yaw (left) of the vehicle against road and travel at mid-exposure
    body_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    # of the road in the photo: its brightness over this is the light that falls on the plate
    road_reflectance: float = 0.22
    # light on a white surface as a share of saturation, in place of the photo's; the photo is darkened too
    night_light: float | None = None
    shadow: Shadow = field(default_factory=Shadow)
    air: Air = field(default_factory=Air)
    sensor: Sensor = field(default_factory=Sensor)
    occluder: Occluder | None = None

    @property
    def camera_from_ground(self) -> Floats:
        """Rotation from the ground frame to the camera frame at mid-exposure, shape (3, 3)."""
        roll, pitch, yaw = (math.radians(v) for v in self.body_deg)
        ground_from_vehicle = cv2.Rodrigues(np.array([0, 0, yaw]))[0]
        ground_from_vehicle = ground_from_vehicle @ cv2.Rodrigues(np.array([0, pitch, 0.0]))[0]
        ground_from_vehicle = ground_from_vehicle @ cv2.Rodrigues(np.array([roll, 0, 0.0]))[0]
        rotation: Floats = self.camera.camera_from_vehicle @ ground_from_vehicle.T
        return rotation

    def row_time_s(self, rows: npt.ArrayLike) -> Floats:
        """Mid-exposure of image rows relative to the frame's. [s]"""
        share = (np.asarray(rows, float) - (self.camera.height_px - 1) / 2) / max(self.camera.height_px - 1, 1)
        times: Floats = share * self.sensor.readout_s
        return times

    def project(self, points_ground_m: Floats) -> Floats:
        """Image of points on the road at their rows' mid-exposure; behind the camera: NaN.

        Parameters
        ----------
        points_ground_m : ndarray, shape (N, 3)
            In the ground frame at the frame's mid-exposure. [m]

        Returns
        -------
        ndarray, shape (N, 2)
            [px]
        """
        times = np.zeros(len(points_ground_m))
        for _ in range(6 if self.sensor.readout_s else 1):
            image = self.project_at(points_ground_m, times)
            rows = np.nan_to_num(image[:, 1], nan=0.0)
            times = self.row_time_s(np.clip(rows, -self.camera.height_px, 2 * self.camera.height_px))
        return image

    def project_at(self, points_ground_m: Floats, times_s: Floats) -> Floats:
        """Image of points on the road at given times from mid-exposure [s]; behind the camera: NaN. [px]"""
        offset = points_ground_m - (0, 0, self.camera.height_m)
        offset = offset - times_s[:, None] * np.array([self.speed_m_s, 0, 0])
        spin = np.radians(self.spin_deg_s)
        turned = offset - times_s[:, None] * np.cross(spin, offset)
        in_camera = turned @ self.camera_from_ground.T
        image = np.full((len(in_camera), 2), np.nan)
        ahead = in_camera[:, 2] > 0.05
        if ahead.any():
            image[ahead] = self.camera.project(in_camera[ahead])
        return image


@dataclass(frozen=True, slots=True)
class FaceTruth:
    """Where a square really is."""

    # shape (4, 2): [px] outer corners at mid-exposure, clockwise from top-left; NaN behind the camera
    corners_px: Floats
    in_view: bool  # all four corners are inside the image
    partly_in_view: bool  # some of it is
    # `height_px`, `width_px`: [px] extent of the corners
    height_px: float
    width_px: float
    camera_from_face: Floats  # shape (3, 3): when the row that shows its centre is exposed, as are the next two
    translation_m: Floats  # shape (3,): [m] its centre in the camera frame
    camera_position_m: Floats  # shape (3,): [m] optical centre in the face's frame (x right, y up, z out of the road)


def face_truth(scene: PlateScene, placed: PlacedFace) -> FaceTruth:
    """Truth about one square of a scene."""
    corners = scene.project(placed.corners_ground_m)
    size = np.array([scene.camera.width_px, scene.camera.height_px])
    whole = bool(np.isfinite(corners).all())
    inside = whole & bool(((corners >= -0.5) & (corners <= size - 0.5)).all())
    partly = whole and bool(((corners.max(axis=0) > -0.5) & (corners.min(axis=0) < size - 0.5)).all())
    extent = corners.max(axis=0) - corners.min(axis=0) if whole else np.full(2, np.nan)
    rotation, translation = _pose_when_exposed(scene, placed)
    return FaceTruth(
        corners, inside, partly, float(extent[1]), float(extent[0]), rotation, translation, -rotation.T @ translation
    )


def _pose_when_exposed(scene: PlateScene, placed: PlacedFace) -> tuple[Floats, Floats]:
    """camera_from_face at the mid-exposure of the row that shows the face's centre."""
    centre = np.array([[placed.ahead_m, placed.left_m, 0.0]])
    row = np.nan_to_num(scene.project(centre)[0, 1], nan=0.0)
    time_s = float(scene.row_time_s(np.clip(row, 0, scene.camera.height_px - 1)))
    turn = cv2.Rodrigues(-time_s * np.radians(scene.spin_deg_s))[0]
    camera_from_ground = scene.camera_from_ground @ turn
    offset = centre[0] - (time_s * scene.speed_m_s, 0.0, scene.camera.height_m)
    return camera_from_ground @ placed.ground_from_face, camera_from_ground @ offset
