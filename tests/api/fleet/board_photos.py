"""Photos of a printed calibration board, rendered ray by ray through a known camera."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from app.encoders.calibration_board import encode_board
from app.encoders.plate import write_png
from app.sensors.camera import CalibrationBoard

BOARD = CalibrationBoard()
_PX_PER_MM = 10
_SUB = 2


@dataclass(frozen=True)
class TrueCamera:
    """What the photos are taken with."""

    width_px: int = 960
    height_px: int = 720
    fx_px: float = 754.0
    fy_px: float = 756.5
    cx_px: float = 474.0
    cy_px: float = 365.0
    distortion: tuple[float, ...] = (-0.21, 0.06, 0.0008, -0.0005)

    @property
    def matrix(self) -> npt.NDArray[np.float64]:
        return np.array([[self.fx_px, 0, self.cx_px], [0, self.fy_px, self.cy_px], [0, 0, 1.0]])


@dataclass(frozen=True)
class Pose:
    """How the board is held: tilts and roll in degrees, its middle in the image as shares of its half sides, size."""

    pitch: float = 0.0
    yaw: float = 0.0
    roll: float = 0.0
    right: float = 0.0
    down: float = 0.0
    fill: float = 0.8


def poses(count: int, seed: int = 1) -> list[Pose]:
    """Poses as a careful person takes them: tilted to all sides, all over the image."""
    rng = np.random.default_rng(seed)
    spots = [(0, 0), (-0.55, -0.5), (0.55, -0.5), (-0.55, 0.5), (0.55, 0.5), (0, -0.4), (0, 0.4), (-0.5, 0), (0.5, 0)]
    found = []
    for k in range(count):
        right, down = spots[k % len(spots)]
        angle = 2.4 * k
        tilt = (25, 38)[k % 2]
        found.append(
            Pose(
                tilt * np.cos(angle), tilt * np.sin(angle), rng.uniform(-25, 25) + (90 if k % 3 == 0 else 0),
                right + rng.uniform(-0.05, 0.05), down + rng.uniform(-0.05, 0.05), rng.uniform(0.62, 0.8),
            )
        )  # fmt: skip
    return found


def photo(
    camera: TrueCamera, pose: Pose, *, board: CalibrationBoard = BOARD, blur_px: float = 0.6, noise: float = 2.5,
    seed: int = 1,
) -> npt.NDArray[np.uint8]:  # fmt: skip
    """Grey photo of the board."""
    rays = _rays(camera)
    rotation, shift = _placed(camera, pose, board)
    # the board's plane is z = 0 of its frame: R (x, y, 0) + t = depth * ray
    normal = rotation[:, 2]
    depth = (normal @ shift) / (rays @ normal)
    points = (rays * depth[..., None] - shift) @ rotation
    texture, left_mm, top_mm = _texture(board)
    x = ((points[..., 0] + left_mm) * _PX_PER_MM - 0.5).astype(np.float32)
    y = ((points[..., 1] + top_mm) * _PX_PER_MM - 0.5).astype(np.float32)
    x[depth <= 0] = -1e6
    fine = cv2.remap(texture, x, y, cv2.INTER_AREA, borderMode=cv2.BORDER_CONSTANT, borderValue=95)
    grey = fine.reshape(camera.height_px, _SUB, camera.width_px, _SUB).astype(np.float32).mean(axis=(1, 3))
    if blur_px:
        grey = cv2.GaussianBlur(grey, (0, 0), blur_px)
    across = np.linspace(0.85, 1.0, camera.width_px, dtype=np.float32)  # light from one side
    grey = 20 + 0.8 * grey * across
    grey += np.random.default_rng(seed).normal(0, noise, grey.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


@lru_cache(maxsize=1)
def good_photos() -> tuple[npt.NDArray[np.uint8], ...]:
    """Photos that calibrate `TrueCamera`: with noise, a little out of focus, all over the image."""
    return tuple(photo(TrueCamera(), pose, seed=k, blur_px=0.9, noise=3.0) for k, pose in enumerate(poses(14)))


def true_corners_px(camera: TrueCamera, pose: Pose, board: CalibrationBoard = BOARD) -> npt.NDArray[np.float64]:
    """Where the board's corners are in the photo."""
    rotation, shift = _placed(camera, pose, board)
    corners = np.column_stack([board.corners_mm, np.zeros(board.corner_count)])
    image, _ = cv2.projectPoints(corners, cv2.Rodrigues(rotation)[0], shift, camera.matrix, np.array(camera.distortion))
    return np.asarray(image, float).reshape(-1, 2)


def jpeg(grey: npt.NDArray[np.uint8], quality: int = 92) -> bytes:
    """A photo as cameras write it."""
    return bytes(cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, quality])[1])


@lru_cache(maxsize=2)
def _rays(camera: TrueCamera) -> npt.NDArray[np.float64]:
    columns = (np.arange(camera.width_px * _SUB) + 0.5) / _SUB - 0.5
    rows = (np.arange(camera.height_px * _SUB) + 0.5) / _SUB - 0.5
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT, 30, 0)
    rays = cv2.undistortPoints(pixels, camera.matrix, np.array(camera.distortion), None, None, None, criteria)
    flat = rays.reshape(camera.height_px * _SUB, camera.width_px * _SUB, 2)
    return np.concatenate([flat, np.ones((*flat.shape[:2], 1))], axis=2)


@lru_cache(maxsize=4)
def _texture(board: CalibrationBoard) -> tuple[npt.NDArray[np.uint8], float, float]:
    drawing = encode_board(board)
    png = write_png(drawing, dpi=_PX_PER_MM * 25.4)
    texture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE)
    boxes = drawing.parts[0].boxes_mm  # type: ignore[union-attr]
    left, top = float(boxes[:, 0].min()), float(drawing.height_mm - boxes[:, 3].max())
    return np.asarray(texture, np.uint8), left, top


def _placed(
    camera: TrueCamera, pose: Pose, board: CalibrationBoard
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    pitch, yaw, roll = np.radians([pose.pitch, pose.yaw, pose.roll])
    turn = lambda axis, angle: cv2.Rodrigues(np.array(axis, float) * angle)[0]  # noqa: E731
    rotation = turn((1, 0, 0), pitch) @ turn((0, 1, 0), yaw) @ turn((0, 0, 1), roll)
    size_mm = np.array([board.columns, board.rows]) * board.square_mm
    distance = camera.fx_px * float(size_mm.max()) / (pose.fill * camera.height_px)
    right = pose.right * camera.width_px / 2 / camera.fx_px
    down = pose.down * camera.height_px / 2 / camera.fy_px
    middle = np.array([right, down, 1.0]) * distance
    return rotation, middle - rotation @ np.array([*size_mm / 2, 0.0])
