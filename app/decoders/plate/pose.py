"""Corners and camera to the pose of the plate, and that to position and heading of the vehicle.

IPPE gives the pose of a square in closed form (Collins and Bartoli, IJCV 109, 2014); a few Gauss-Newton steps then
weight the corners by their covariance, and the mount's height and level by how far springs move them. How well the
corners then fit a square scales the pose's covariance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from app.decoders.plate import Array
from app.geodesy import enu_from_heading, wgs84_from_enu
from app.markers.plate import PlateGeometry
from app.markers.reading import PlatePose, PlateReading
from app.sensors.camera import Camera
from app.values import Floats

# === Where the shapes of a plate lie, in plate sides: (0, 0) is the triangle's corner, (1, 1) the opposite one.


@lru_cache
def unit_edges(geometry: PlateGeometry) -> Floats:
    """Low and high edge of every unit along a side, in plate sides, shape (n, 2)."""
    low = (geometry.gap_mm + np.arange(geometry.n) * geometry.pitch_mm) / geometry.side_mm
    return np.stack([low, low + geometry.unit_mm / geometry.side_mm], axis=1)


@lru_cache
def marker_centroids(geometry: PlateGeometry) -> Floats:
    """Centroids of the triangle and the three squares, clockwise, in plate sides, shape (4, 2)."""
    edges = unit_edges(geometry)
    low, side = edges[0, 0], edges[1, 1] - edges[0, 0]
    near, far = low + side / 2, 1 - low - side / 2
    tip = low + side / 3
    return np.array([(tip, tip), (far, near), (far, far), (near, far)])


@lru_cache
def unit_centres(geometry: PlateGeometry) -> Floats:
    """Centres of the units that carry the code, in plate sides, shape (units, 2)."""
    middle = unit_edges(geometry).mean(axis=1)
    rows, columns = np.nonzero(unit_shapes(geometry.n) >= 0)
    return np.stack([middle[columns], middle[rows]], axis=1)


@lru_cache
def unit_shapes(n: int) -> npt.NDArray[np.int64]:
    """Number of every unit's shape, row by row; -1 in the corner cells, shape (n, n)."""
    corner = np.zeros((n, n), dtype=bool)
    corner[np.ix_([0, 1, n - 2, n - 1], [0, 1, n - 2, n - 1])] = True
    shapes = np.full((n, n), -1, dtype=np.int64)
    shapes[~corner] = np.arange(n * n - 16)
    return shapes


# === Corners and camera to the pose of the plate, and that to position and heading of the vehicle.


LEVEL_SPREAD_RAD = math.radians(0.4)
"""[rad] standard deviation of a vehicle's roll and pitch relative to the road. The simulated vehicles have 0.15 degrees
(`simulation.drive.Drive.sway_deg`)."""
HEIGHT_SPREAD_M = 0.02
"""[m] standard deviation of a camera's height: springs, load."""
MIN_DEPTH_M = 0.05
"""[m] depth of a plate in front of the camera."""
MAX_STEPS, REST = 6, 1e-7
"""[steps; rad, m] of Gauss-Newton at most, and the step below which it ends."""
CORNER_FLOOR_PX = 0.05
"""[px] standard deviation that is added to a corner's, for what the fit's covariance leaves out."""

REDUNDANT = 5
"""[1] residuals beyond the unknowns: eight of the corners and three of the mount determine six."""
SCATTER_WEIGHT = 5.0
"""[residuals] that the reported covariance of the corners counts for when the residuals of a pose scale it. Source: of
2, 5, 10, 20 and infinity, 2 and 5 make the position errors of seeds 111 and 112 likeliest (by 0.4 nats a frame over
infinity), and with 5 the error of 95 % is below two standard deviations on each axis (decision record 0012)."""


@dataclass(frozen=True, slots=True)
class VehicleFix:
    """Position and heading of a vehicle's reference point."""

    # `lon_deg`, `lat_deg`: [deg]
    lon_deg: float
    lat_deg: float
    height_m: float  # [m] of the road below the reference point, in the datum of the plate's height
    heading_deg: float  # [deg] clockwise from true north
    covariance: Array  # shape (4, 4): [rad] of east, north, up [m] and heading


def locate_plate(corners_px: Array, covariance_px2: Array, geometry: PlateGeometry, camera: Camera) -> PlatePose | None:
    """Pose of a plate from its outer corners.

    Parameters
    ----------
    corners_px : ndarray, shape (4, 2)
        Clockwise from the triangle's. [px]
    covariance_px2 : ndarray, shape (8, 8)
        Of the flattened corners. [px2]

    Returns
    -------
    PlatePose or None
        None when no pose in front of the camera projects to the corners.
    """
    object_m = np.column_stack([geometry.corners_mm / 1000, np.zeros(4)])
    found, rotations, translations, _ = cv2.solvePnPGeneric(
        object_m, camera.undistort(corners_px), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    if not found:
        return None
    weight = np.linalg.inv(covariance_px2 + CORNER_FLOOR_PX**2 * np.eye(8))
    best: tuple[float, Array, Array] | None = None
    for rotation, translation in zip(rotations, translations, strict=True):
        pose = np.concatenate([rotation.ravel(), translation.ravel()])
        refined = _refine(pose, corners_px, weight, object_m, camera)
        if refined is not None and (best is None or refined[0] < best[0]):
            best = refined
    if best is None:
        return None
    cost, pose, information = best
    # corners that no pose projects to err by more than they report, and so does the pose
    scale = (SCATTER_WEIGHT + cost) / (SCATTER_WEIGHT + REDUNDANT)
    projected = cv2.projectPoints(object_m, pose[:3], pose[3:], camera.matrix, camera.lens)[0].reshape(4, 2)
    return PlatePose(
        rotation=np.asarray(cv2.Rodrigues(pose[:3])[0], dtype=float),
        translation_m=pose[3:].copy(),
        covariance=scale * np.linalg.inv(information),
        reprojection_rms_px=float(np.sqrt(np.mean(np.sum((projected - corners_px) ** 2, axis=1)))),
    )


def with_pose(reading: PlateReading, camera: Camera | None) -> PlateReading:
    """A read plate with its pose; as it is where it has one or no digits, or where no camera is known."""
    corners, covariance, geometry = reading.corners_px, reading.corners_covariance_px2, reading.geometry
    if reading.code is None or reading.pose is not None or camera is None:
        return reading
    if corners is None or covariance is None or geometry is None:
        return reading
    return replace(reading, pose=locate_plate(corners, covariance, geometry, camera))


def _refine(
    pose: Array, corners_px: Array, weight: Array, object_m: Array, camera: Camera
) -> tuple[float, Array, Array] | None:
    """Gauss-Newton on corners and mount: cost, pose (rotation vector left of the first, translation), information."""
    cost, information = math.inf, np.eye(6)
    for _ in range(MAX_STEPS):
        rotation = cv2.Rodrigues(pose[:3])[0]
        if pose[5] <= MIN_DEPTH_M:
            return None
        in_camera = object_m @ rotation.T
        projected, jacobian = cv2.projectPoints(in_camera, np.zeros(3), pose[3:], camera.matrix, camera.lens)
        by_pose = jacobian[:, :6]
        residual = corners_px.reshape(8) - projected.reshape(8)
        mount, by_mount, mount_weight = _mount_residual(rotation, pose[3:], camera)
        information = by_pose.T @ weight @ by_pose + by_mount.T @ mount_weight @ by_mount
        step = np.linalg.solve(information, by_pose.T @ weight @ residual - by_mount.T @ mount_weight @ mount)
        cost = float(residual @ weight @ residual + mount @ mount_weight @ mount)
        pose = np.concatenate([cv2.Rodrigues(cv2.Rodrigues(step[:3])[0] @ rotation)[0].ravel(), pose[3:] + step[3:]])
        if np.abs(step).max() < REST:
            break
    return (cost, pose, information) if math.isfinite(cost) else None


def _mount_residual(rotation: Array, translation: Array, camera: Camera) -> tuple[Array, Array, Array]:
    """Departure of the plate from the road's plane as the mount sees it: two tilts [rad] and a height [m].

    The derivative is by a small rotation about the camera's axes and the translation.
    """
    vehicle_from_camera = camera.camera_from_vehicle.T
    normal = vehicle_from_camera @ rotation[:, 2]
    height = -float(rotation[:, 2] @ translation)
    residual = np.array([normal[0], normal[1], height - camera.height_m])
    derivative = np.zeros((3, 6))
    turn = -_cross(rotation[:, 2])  # of the plate's normal in the camera frame
    derivative[:2, :3] = (vehicle_from_camera @ turn)[:2]
    derivative[2, :3] = -translation @ turn
    derivative[2, 3:] = -rotation[:, 2]
    weight = np.diag([1 / LEVEL_SPREAD_RAD**2, 1 / LEVEL_SPREAD_RAD**2, 1 / HEIGHT_SPREAD_M**2])
    return residual, derivative, weight


def _cross(v: Array) -> Array:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def camera_position_m(pose: PlatePose) -> Array:
    """Optical centre in the plate frame (x right, y travel, z up), shape (3,). [m]"""
    position: Array = -pose.rotation.T @ pose.translation_m
    return position


def fix_vehicle(
    pose: PlatePose,
    camera: Camera,
    *,
    lon_deg: float,
    lat_deg: float,
    height_m: float,
    heading_deg: float,
    horizontal_rmse_m: float,
    vertical_rmse_m: float,
    heading_rmse_deg: float,
) -> VehicleFix:
    """Position and heading of the vehicle from a plate whose survey is known.

    Parameters
    ----------
    pose : PlatePose
        As seen by the camera.
    lon_deg, lat_deg, height_m : float
        Surveyed centre of the plate. [deg, m]
    heading_deg : float
        Of the plate's up direction, clockwise from true north. [deg]
    horizontal_rmse_m, vertical_rmse_m, heading_rmse_deg : float
        Accuracy of the survey; the horizontal one is radial. [m, m, deg]

    Returns
    -------
    VehicleFix
    """
    enu_from_plate = enu_from_heading(heading_deg)

    def vehicle(rotation: Array, translation: Array) -> Array:
        """East, north, up from the plate's centre [m] and heading against the plate's [rad]."""
        plate_from_vehicle = rotation.T @ camera.camera_from_vehicle
        position = -rotation.T @ translation - plate_from_vehicle @ camera.position_vehicle_m
        forward = plate_from_vehicle[:, 0]
        return np.append(enu_from_plate @ position, math.atan2(forward[0], forward[1]))

    state = vehicle(pose.rotation, pose.translation_m)
    jacobian = np.empty((4, 6))
    for k in range(6):
        step = np.zeros(6)
        step[k] = 1e-6
        moved = vehicle(cv2.Rodrigues(step[:3])[0] @ pose.rotation, pose.translation_m + step[3:])
        jacobian[:, k] = (moved - state) / 1e-6
    covariance = jacobian @ pose.covariance @ jacobian.T
    by_heading = np.array([state[1], -state[0], 0.0, 1.0])  # clockwise turn of the plate about its centre
    covariance += np.diag([horizontal_rmse_m**2 / 2, horizontal_rmse_m**2 / 2, vertical_rmse_m**2, 0.0])
    covariance += math.radians(heading_rmse_deg) ** 2 * np.outer(by_heading, by_heading)
    lon, lat, height = wgs84_from_enu(state[:3], (lon_deg, lat_deg, height_m))
    return VehicleFix(lon, lat, height, (heading_deg + math.degrees(state[3])) % 360.0 % 360.0, covariance)


# === Poses of plates seen through a rolling shutter by a moving vehicle.
#
# Each row of the image is exposed at its own time, so that the vehicle has moved between the corners of a plate, and
# between a corner and the middle row, whose time is the frame's.


MAX_SHUTTER_STEPS = 4
"""[steps] of alternating between pose and corners. The third changes less than 0.01 px."""
REST_PX = 0.005
"""[px] change of a corner below which the steps end."""


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
    shift = np.zeros((4, 2))
    for _step in range(MAX_SHUTTER_STEPS):
        in_camera = object_m @ pose.rotation.T + pose.translation_m
        # where the vehicle was when the row of a corner was exposed, and so where that corner was seen
        then = in_camera - moved_m[:, None] * forward
        now, seen = camera.project(in_camera), camera.project(then)
        last, shift = shift, now - seen
        if np.abs(shift - last).max() < REST_PX:
            break
        moved = locate_plate(corners_px + shift, covariance_px2, geometry, camera)
        if moved is None:
            return None
        pose = moved
    return pose
