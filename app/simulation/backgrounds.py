"""Road photos as another camera would see them: the road is projected to the ground and rendered again."""

from __future__ import annotations

from functools import lru_cache
from importlib.resources import files

import cv2
import numpy as np
import numpy.typing as npt

from app.sensors.camera import Camera

Image = npt.NDArray[np.uint8]
_PHOTO_HORIZON = 0.585  # of the photo's height: dash cameras of the photos used look almost level
_PHOTO_FOCAL = 0.9  # of the photo's width
_PHOTO_HEIGHT_M = 1.3
_PHOTOS = ("p1_solidWhiteCurve.jpg", "p1_whiteCarLaneSwitch.jpg", "vid_60.jpg")


@lru_cache(maxsize=1)
def road_photos() -> tuple[Image, ...]:
    """Real photos of a dash camera; sources in app/simulation/data/SOURCES.md."""
    folder = files("app.simulation") / "data"
    coded = [np.frombuffer((folder / name).read_bytes(), np.uint8) for name in _PHOTOS]
    return tuple(np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8) for data in coded)


def road_background(photo: Image, camera: Camera, rng: np.random.Generator, *, grain: float = 0.04) -> Image:
    """Frame-sized background from a dash-camera photo.

    Parameters
    ----------
    photo : ndarray of uint8, shape (h, w, 3)
    camera : Camera
        Whose ground is to be covered. The photo shows no road nearer than about 6 m, so its road is pulled closer.
    rng : numpy.random.Generator
        Draws the part of the road, mirroring and the asphalt's grain.
    grain : float
        Standard deviation of the asphalt's fine texture, relative to its brightness.

    Returns
    -------
    ndarray of uint8, shape (height_px, width_px, 3)
    """
    if rng.random() < 0.5:
        photo = np.ascontiguousarray(photo[:, ::-1])
    ahead_m, left_m = float(rng.uniform(4.5, 8.0)), float(rng.uniform(-1.5, 1.5))
    return _render_road(photo, camera, rng, (ahead_m, left_m), grain)


def moving_backgrounds(
    photo: Image, camera: Camera, rng: np.random.Generator, step_m: float, frames: int, *, grain: float = 0.04
) -> list[Image]:
    """Backgrounds of successive frames in which the road comes nearer.

    Parameters
    ----------
    photo, camera, rng, grain
        As in `road_background`.
    step_m : float
        That the vehicle advances from frame to frame. [m]
    frames : int
        The photo shows about 30 m of road in enough detail.
    """
    ahead_m, left_m = 4.5, float(rng.uniform(-1.5, 1.5))
    return [_render_road(photo, camera, rng, (ahead_m + k * step_m, left_m), grain) for k in range(frames)]


def _render_road(
    photo: Image, camera: Camera, rng: np.random.Generator, ground_m: tuple[float, float], grain: float
) -> Image:
    shape = (camera.height_px, camera.width_px)
    rows, cols = np.mgrid[0 : shape[0] + 7 : 8, 0 : shape[1] + 7 : 8].astype(np.float64)
    ideal = np.stack([(cols - camera.cx_px) / camera.fx_px, (rows - camera.cy_px) / camera.fy_px], axis=-1)
    rays = ideal @ camera.camera_from_vehicle[:2] + camera.camera_from_vehicle[2]
    map_x, map_y = _photo_points(rays, camera.height_m, *ground_m, (photo.shape[0], photo.shape[1]))
    size = (map_x.shape[1] * 8, map_x.shape[0] * 8)
    full_x, full_y = (cv2.resize(m, size, interpolation=cv2.INTER_LINEAR) for m in (map_x, map_y))
    view = cv2.remap(
        photo, full_x[: shape[0], : shape[1]], full_y[: shape[0], : shape[1]], cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REFLECT_101,
    )  # fmt: skip
    if grain > 0:
        texture = cv2.GaussianBlur(rng.standard_normal(shape, dtype=np.float32), (0, 0), 1.1)
        texture = 1 + np.float32(3.8 * grain) * texture  # blurring left 1 / 3.8 of the deviation
        view = cv2.multiply(view, cv2.merge([texture] * 3), dtype=cv2.CV_8U)
    return np.asarray(view, np.uint8)


def _photo_points(
    rays: npt.NDArray[np.float64], height_m: float, ahead_m: float, left_m: float, shape: tuple[int, int]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Where the photo shows what lies along rays of the vehicle frame."""
    focal, horizon, middle = _PHOTO_FOCAL * shape[1], _PHOTO_HORIZON * shape[0], shape[1] / 2
    down = np.maximum(-rays[..., 2], 1e-3 * rays[..., 0])
    x, y = rays[..., 0] * height_m / down + ahead_m, rays[..., 1] * height_m / down + left_m
    ground = np.stack([middle - focal * y / x, horizon + focal * _PHOTO_HEIGHT_M / x], axis=-1)
    far = np.stack(
        [middle - focal * rays[..., 1] / rays[..., 0], horizon - focal * rays[..., 2] / rays[..., 0]], axis=-1
    )
    share = np.clip((-rays[..., 2] / rays[..., 0] - 0.01) / 0.03, 0, 1)[..., None]
    points = (share * ground + (1 - share) * far).astype(np.float32)
    return np.ascontiguousarray(points[..., 0]), np.ascontiguousarray(points[..., 1])
