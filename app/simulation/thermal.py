"""Scene to thermal frame: temperatures instead of light, a slow sensor, one channel."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.resources import files

import cv2
import numpy as np
import numpy.typing as npt

from app.sensors.camera import Camera
from app.simulation.camera import NO_SHADE, RenderedFrame, blurred, encode_jpeg, gather_faces, list_windows, pixel_rays
from app.simulation.plate_face import smooth_noise
from app.simulation.plate_scene import PlateScene, face_truth

# === Road photos as another camera would see them: the road is projected to the ground and rendered again.


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


# === Scene to thermal frame.


FloatArray = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class ThermalSensor:
    """Uncooled bolometer.

    Parameters
    ----------
    lag_s : float
        Thermal time constant of a pixel: it forgets exponentially, which draws a trail. [s]
    blur_px : float
        Standard deviation of the lens's Gaussian point spread. [px]
    netd_k : float
        Noise, and a tenth of it as fixed stripes of columns. [K]
    span_k : float
        Temperatures that the 256 grey levels cover. [K]
    road_k : float
        Standard deviation of the road's own differences. [K]
    jpeg_quality : int or None
        None keeps the frame as it is.
    """

    lag_s: float = 0.01
    blur_px: float = 1.2
    netd_k: float = 0.06
    span_k: float = 25.0
    road_k: float = 0.8
    jpeg_quality: int | None = None


def render_thermal_scene(
    scene: PlateScene, sensor: ThermalSensor, background: Image | None, rng: np.random.Generator
) -> RenderedFrame:
    """Render one thermal frame, shape (H, W), white hot.

    Parameters
    ----------
    scene : PlateScene
        Its faces' emission is temperature above the road's [K]; light, air and the photographic sensor don't count.
        The instant of the frame takes the place of mid-exposure.
    sensor : ThermalSensor
    background : ndarray of uint8, shape (H, W, 3), or None
        Photo whose brightness stands for what the sun has warmed.
    rng : numpy.random.Generator
        Draws the noise and the road's temperatures.
    """
    shape = (scene.camera.height_px, scene.camera.width_px)
    scene = replace(scene, exposure_s=8 * sensor.lag_s)
    temperature = _road(shape, sensor, background, rng)
    truths = tuple(face_truth(scene, placed) for placed in scene.faces)
    for window, members in list_windows(scene, truths):
        dark = [np.zeros(3, np.float32)] * len(members)
        warmth, cover = gather_faces(
            scene, members, dark, window, pixel_rays(scene, window), NO_SHADE, lag_s=sensor.lag_s
        )
        kept = temperature[window.slices] * (1 - np.minimum(cover, 1))
        temperature[window.slices] = kept + warmth[..., 0]
    image = _grey(blurred(temperature, sensor.blur_px), sensor, rng)
    if sensor.jpeg_quality is None:
        return RenderedFrame(image, b"", truths)
    jpeg = encode_jpeg(image, sensor.jpeg_quality)
    return RenderedFrame(np.asarray(cv2.imdecode(jpeg, cv2.IMREAD_GRAYSCALE), np.uint8), jpeg.tobytes(), truths)


def _road(
    shape: tuple[int, int], sensor: ThermalSensor, background: Image | None, rng: np.random.Generator
) -> FloatArray:
    """Temperatures of the road relative to its mean. [K]"""
    field = smooth_noise(shape, shape[1] / 8, rng) - 0.5
    field = field + 0.5 * (smooth_noise(shape, 12, rng) - 0.5)
    if background is not None:
        grey = cv2.resize(cv2.cvtColor(background, cv2.COLOR_BGR2GRAY), (shape[1], shape[0])).astype(np.float32)
        field = field + (grey - grey.mean()) / max(float(grey.std()), 1.0) * 0.3
    return np.asarray(field * (sensor.road_k / max(float(field.std()), 1e-6)), np.float32)


def _grey(temperature: FloatArray, sensor: ThermalSensor, rng: np.random.Generator) -> Image:
    """Noise and the linear range of grey levels, the road's mean at a third of it."""
    noise = rng.standard_normal(temperature.shape, dtype=np.float32)
    stripes = 0.1 * rng.standard_normal((1, temperature.shape[1]), dtype=np.float32)
    noisy = temperature + np.float32(sensor.netd_k) * (noise + stripes)
    return np.asarray(np.clip(85.5 + noisy * (255 / sensor.span_k), 0, 255), np.uint8)
