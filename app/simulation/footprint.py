"""The part of the road that each pixel sees, and when."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from app.simulation.plate_scene import FaceTruth, PlacedFace, PlateScene

Matrix = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Window:
    """Part of an image, half open. [px]"""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Rows and columns."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

    @property
    def grid(self) -> tuple[Matrix, Matrix]:
        """Row and column numbers."""
        return np.arange(self.top, self.bottom, dtype=float), np.arange(self.left, self.right, dtype=float)

    def overlaps(self, other: Window) -> bool:
        """Whether the two share pixels."""
        across = self.left < other.right and other.left < self.right
        return across and self.top < other.bottom and other.top < self.bottom

    def union(self, other: Window) -> Window:
        """Smallest window around both."""
        return Window(
            min(self.left, other.left), min(self.top, other.top), max(self.right, other.right),
            max(self.bottom, other.bottom),
        )  # fmt: skip


def list_windows(scene: PlateScene, truths: tuple[FaceTruth, ...]) -> list[tuple[Window, list[int]]]:
    """Parts of the image that faces touch, with the faces in each; those that overlap are one."""
    groups: list[tuple[Window, list[int]]] = []
    for index, (placed, truth) in enumerate(zip(scene.faces, truths, strict=True)):
        window, members = _window(scene, placed, truth), [index]
        if window is None:
            continue
        while other := next((g for g in groups if g[0].overlaps(window)), None):
            groups.remove(other)
            window, members = window.union(other[0]), other[1] + members
        groups.append((window, members))
    return groups


def _window(scene: PlateScene, placed: PlacedFace, truth: FaceTruth) -> Window | None:
    """Part of the image that a face touches during the exposure, with room for the lens's blur."""
    if not truth.partly_in_view:
        return None
    margin = (
        motion_blur_px(scene, placed, scene.exposure_s)
        + 4 * scene.sensor.blur_px
        + abs(scene.sensor.colour_shift_px)
        + 6
    )
    low, high = truth.corners_px.min(axis=0) - margin, truth.corners_px.max(axis=0) + margin
    left, top = max(int(low[0]) // 2 * 2, 0), max(int(low[1]) // 2 * 2, 0)
    right, bottom = min(int(high[0]) + 2, scene.camera.width_px), min(int(high[1]) + 2, scene.camera.height_px)
    right, bottom = right - (right - left) % 2, bottom - (bottom - top) % 2
    return Window(left, top, right, bottom) if right - left > 1 and bottom - top > 1 else None


def motion_blur_px(scene: PlateScene, placed: PlacedFace, exposure_s: float) -> float:
    """Longest path of a corner in the image during an exposure. [px]"""
    if not scene.speed_m_s and not any(scene.spin_deg_s):
        return 0.0
    corners = placed.corners_ground_m
    half = np.full(4, exposure_s / 2)
    way = np.linalg.norm(scene.project_at(corners, half) - scene.project_at(corners, -half), axis=1)
    return min(float(np.nanmax(way)), 400.0) if np.isfinite(way).any() else 0.0


def sample_count(pixels: int, blur_px: float) -> int:
    """Samples a pixel: at least four for each pixel of motion, more where a window is small, fewer where it is vast."""
    wanted = max(3_000_000 / max(pixels, 1), 4 * blur_px + 12, 24)
    return int(max(min(wanted, 160, 16_000_000 / max(pixels, 1)), 16))


@lru_cache(maxsize=64)
def _unit_samples(count: int) -> Matrix:
    """Points spread evenly over the unit cube (Kronecker sequence of the plastic number), mean exactly 0.5."""
    g = 1.2207440846057596
    points = np.mod(0.5 + np.arange(1, count + 1)[:, None] / g ** np.arange(1, 4), 1.0)
    points += 0.5 - points.mean(axis=0)
    return points


def exposure_samples(count: int, exposure_s: float, lag_s: float = 0.0) -> Matrix:
    """Where and when a pixel gathers light.

    Parameters
    ----------
    count : int
    exposure_s : float
        Light is gathered evenly over it. [s]
    lag_s : float
        Time constant with which a slow sensor forgets, in place of the exposure; 0 is none. [s]

    Returns
    -------
    ndarray, shape (count, 3)
        Column and row offset from the pixel's centre [px], time from mid-exposure [s].
    """
    unit = _unit_samples(count)
    when = lag_s * np.log(np.clip(unit[:, 2], 1e-6, 1)) if lag_s > 0 else (unit[:, 2] - 0.5) * exposure_s
    return np.column_stack([unit[:, :2] - 0.5, when])


def directions(scene: PlateScene, cols: Matrix, rows: Matrix) -> Matrix:
    """Direction in the ground frame of image points, any shape (...,) to (..., 3)."""
    camera = scene.camera
    points = np.stack([cols, rows], axis=-1).astype(np.float64)
    if camera.distortion:
        ideal = cv2.undistortPoints(points.reshape(-1, 1, 2), camera.matrix, np.array(camera.distortion))
        ideal = ideal.reshape(points.shape)
    else:
        ideal = (points - (camera.cx_px, camera.cy_px)) / (camera.fx_px, camera.fy_px)
    rotation = scene.camera_from_ground
    towards: Matrix = ideal @ rotation[:2] + rotation[2]
    return towards


def pixel_rays(scene: PlateScene, window: Window) -> Matrix:
    """Directions of a window's pixels and their derivatives by column and row, shape (H, W, 3, 3)."""
    cols = np.arange(window.left, window.right + 1) - 0.5
    rows = np.arange(window.top, window.bottom + 1) - 0.5
    edges = directions(scene, *np.meshgrid(cols, rows))
    rays = np.empty((len(rows) - 1, len(cols) - 1, 3, 3))
    a, b, c, d = edges[:-1, :-1], edges[:-1, 1:], edges[1:, :-1], edges[1:, 1:]
    rays[:, :, 0] = (a + b + c + d) / 4
    rays[:, :, 1] = (b + d - a - c) / 2
    rays[:, :, 2] = (c + d - a - b) / 2
    return rays
