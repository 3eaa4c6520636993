"""Thermal frames: temperatures instead of light, heated plates, a slow sensor, one channel."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from app.markers.plate import PlateCode, PlateGeometry
from app.simulation.camera import NO_SHADE, RenderedFrame, blurred, encode_jpeg, gather_faces, list_windows, pixel_rays
from app.simulation.plate_face import Face, material_shares, smooth_noise
from app.simulation.plate_scene import PlateScene, face_truth
from app.values import Floats32

Image = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class PlateWarmth:
    """Temperature of a plate's parts above the road's. [K]

    The red triangle and the green squares carry heaters like the dark units.
    """

    dark_k: float = 12.0
    light_k: float = 1.0
    gap_k: float = 1.5
    marker_k: float = 12.0
    spread_mm: float = 4.0


def warm_face(code: PlateCode, geometry: PlateGeometry, warmth: PlateWarmth, rng: np.random.Generator) -> Face:
    """Face of a heated plate for a thermal camera: its emission is temperature above the road's. [K]

    Parameters
    ----------
    code : PlateCode
        Of the geometry's size.
    geometry : PlateGeometry
    warmth : PlateWarmth
    rng : numpy.random.Generator
        Draws how unevenly the heaters work (10 %).
    """
    size = round(geometry.side_mm)
    shares = material_shares(code, geometry, size)
    levels = (warmth.gap_k, warmth.dark_k, warmth.light_k, warmth.marker_k, warmth.marker_k, warmth.light_k)
    temperature = np.tensordot(shares, np.array(levels, np.float32), axes=(0, 0))
    uneven = 1 + 0.2 * (smooth_noise((size, size), size / 6, rng) - 0.5)
    spread = cv2.GaussianBlur((temperature * uneven).astype(np.float32), (0, 0), warmth.spread_mm)
    nothing = np.zeros((size, size, 3), np.float32)
    return Face(geometry.side_mm / 1000, nothing, np.repeat(spread[..., None], 3, axis=2))


def draw_thermal(rng: np.random.Generator) -> tuple[PlateWarmth, ThermalSensor]:
    """A heated plate and a bolometer."""
    heat = rng.uniform(6, 20)
    warmth = PlateWarmth(
        dark_k=heat,
        light_k=rng.uniform(0, 0.25) * heat,
        gap_k=rng.uniform(0, 0.3) * heat,
        marker_k=heat * rng.uniform(0.85, 1.15),
        spread_mm=rng.uniform(2, 6),
    )
    sensor = ThermalSensor(
        lag_s=rng.uniform(0.006, 0.012),
        blur_px=rng.uniform(0.8, 1.8),
        netd_k=rng.uniform(0.03, 0.12),
        span_k=heat * rng.uniform(1.5, 3.0),
        road_k=rng.uniform(0.3, 1.5),
    )
    return warmth, sensor


@dataclass(frozen=True, slots=True)
class ThermalSensor:
    """Uncooled bolometer."""

    lag_s: float = 0.01  # [s] thermal time constant of a pixel: it forgets exponentially, which draws a trail
    blur_px: float = 1.2  # [px] standard deviation of the lens's Gaussian point spread
    netd_k: float = 0.06  # [K] noise, and a tenth of it as fixed stripes of columns
    span_k: float = 25.0  # [K] Temperatures that the 256 grey levels cover
    road_k: float = 0.8  # [K] standard deviation of the road's own differences
    road_level: float = 85.5  # [grey levels] of the road's mean: a third of the range, so that warm things fit in
    jpeg_quality: int | None = None  # None keeps the frame as it is


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
) -> Floats32:
    """Temperatures of the road relative to its mean. [K]"""
    field = smooth_noise(shape, shape[1] / 8, rng) - 0.5
    field = field + 0.5 * (smooth_noise(shape, 12, rng) - 0.5)
    if background is not None:
        grey = cv2.resize(cv2.cvtColor(background, cv2.COLOR_BGR2GRAY), (shape[1], shape[0])).astype(np.float32)
        field = field + (grey - grey.mean()) / max(float(grey.std()), 1.0) * 0.3
    return np.asarray(field * (sensor.road_k / max(float(field.std()), 1e-6)), np.float32)


def _grey(temperature: Floats32, sensor: ThermalSensor, rng: np.random.Generator) -> Image:
    """Noise and the linear range of grey levels."""
    noise = rng.standard_normal(temperature.shape, dtype=np.float32)
    stripes = 0.1 * rng.standard_normal((1, temperature.shape[1]), dtype=np.float32)
    noisy = temperature + np.float32(sensor.netd_k) * (noise + stripes)
    return np.asarray(np.clip(sensor.road_level + noisy * (255 / sensor.span_k), 0, 255), np.uint8)
