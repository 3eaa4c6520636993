"""Cameras of the simulated vehicles, and real road photos as they see them."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from app.sensors.camera import Camera
from app.simulation.backgrounds import road_background

Image = npt.NDArray[np.uint8]
BACKGROUNDS = Path(__file__).parent.parent / "backgrounds"


@lru_cache(maxsize=1)
def read_photos() -> tuple[Image, ...]:
    """Real road photos."""
    paths = sorted(BACKGROUNDS.glob("*.jpg"))
    return tuple(np.asarray(cv2.imread(str(path)), np.uint8) for path in paths)


def draw_camera(rng: np.random.Generator) -> Camera:
    return Camera.from_field_of_view(
        1920,
        1080,
        float(rng.uniform(60, 90)),
        height_m=float(rng.uniform(1.2, 2.0)),
        depression_deg=float(rng.uniform(12, 45)),
        azimuth_deg=float(rng.normal(0, 8)),
        roll_deg=float(rng.normal(0, 1)),
    )


def draw_background(camera: Camera, rng: np.random.Generator) -> Image:
    """A road photo seen by the camera."""
    photos = read_photos()
    return road_background(photos[int(rng.integers(len(photos)))], camera, rng, grain=float(rng.uniform(0.01, 0.05)))


def draw_crop(camera: Camera, rng: np.random.Generator) -> Image:
    """Part of a photo at the frame's size, perhaps mirrored, with its colours changed."""
    photos = read_photos()
    photo = photos[int(rng.integers(len(photos)))]
    share = float(rng.uniform(0.35, 1.0))
    height, width = int(photo.shape[0] * share), int(photo.shape[1] * share)
    top, left = (int(rng.integers(0, n - m + 1)) for n, m in zip(photo.shape[:2], (height, width), strict=True))
    part = photo[top : top + height, left : left + width]
    if rng.random() < 0.5:
        part = part[:, ::-1]
    size_px = (camera.width_px, camera.height_px)
    part = np.asarray(cv2.resize(np.ascontiguousarray(part), size_px, interpolation=cv2.INTER_LINEAR), np.uint8)
    gain = rng.uniform(0.7, 1.3, 3) * rng.uniform(0.6, 1.3)
    table = np.clip(np.arange(256)[:, None] * gain + rng.uniform(-20, 20), 0, 255).astype(np.uint8)
    hsv = cv2.cvtColor(cv2.LUT(part, table[:, None, :].reshape(256, 1, 3)), cv2.COLOR_BGR2HSV)
    hsv[..., 1] = cv2.convertScaleAbs(hsv[..., 1], alpha=float(rng.uniform(0.3, 2.0)))
    return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR), np.uint8)
