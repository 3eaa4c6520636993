"""Scene to frame: the image of plates on the road in a camera on a vehicle.

Radiance is linear, 1 = the sensor's saturation. Only the surroundings of the squares on the road are integrated over
pixel area and exposure; the rest of the frame is the photo behind them, given the same light, tone and noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter
from app.simulation.footprint import (
    Window,
    directions,
    exposure_samples,
    list_windows,
    motion_blur_px,
    pixel_rays,
    sample_count,
)
from app.simulation.plate_scene import FaceTruth, PlateScene, face_truth
from app.simulation.raster import accumulate_face, expose_photo, shade_rays
from app.simulation.sensor import (
    blurred,
    develop,
    encode_jpeg,
    linear_from_srgb,
    noise_sigma,
    shift_colours,
    through_air,
    tone,
)
from app.simulation.shade import Shade, shade_map

FloatArray = npt.NDArray[np.float32]
Image = npt.NDArray[np.uint8]
Matrix = npt.NDArray[np.float64]
_SHADE_STEPS = 129
_NOISE_LENGTH = 1 << 20
_NO_EMISSION = np.empty((0, 0, 3), np.float32)


@dataclass(frozen=True, slots=True)
class RenderedFrame:
    """A frame and the truth about it.

    Attributes
    ----------
    image : ndarray of uint8, shape (H, W, 3) or, thermal, (H, W)
        Blue, green, red; after the JPEG round trip if there is one.
    jpeg : bytes
        The coded frame; empty without a JPEG round trip.
    truths : tuple of FaceTruth
        One for each of the scene's faces, in order.
    """

    image: Image
    jpeg: bytes
    truths: tuple[FaceTruth, ...]


def render_plate_scene(scene: PlateScene, background: Image | None, rng: np.random.Generator) -> RenderedFrame:
    """Render one exposure.

    Parameters
    ----------
    scene : PlateScene
    background : ndarray of uint8, shape (H, W, 3), or None
        Photo of the camera's size (blue, green, red, sRGB); None is an even grey road.
    rng : numpy.random.Generator
        Draws the noise.

    Raises
    ------
    InvalidParameter
        The photo is not of the camera's size.
    """
    camera = scene.camera
    if background is None:
        background = np.full((camera.height_px, camera.width_px, 3), 110, np.uint8)
    if background.shape != (camera.height_px, camera.width_px, 3):
        raise InvalidParameter(
            f"the photo is {background.shape}, the camera {camera.height_px} x {camera.width_px}", field="background"
        )
    shade = shade_map(scene)
    image = _expose_background(scene, background, shade, rng)
    truths = tuple(face_truth(scene, placed) for placed in scene.faces)
    for window, members in list_windows(scene, truths):
        lights = [_light(scene, background, truths[k]) for k in members]
        image[window.slices] = _paint(scene, members, lights, window, background, shade, rng)
    if scene.sensor.jpeg_quality is None:
        return RenderedFrame(image, b"", truths)
    jpeg = encode_jpeg(image, scene.sensor.jpeg_quality)
    return RenderedFrame(np.asarray(cv2.imdecode(jpeg, cv2.IMREAD_COLOR), np.uint8), jpeg.tobytes(), truths)


# --- light and background -----------------------------------------------------------------------------------------


def _photo_gain(scene: PlateScene) -> np.float32:
    """Radiance of the scene's photo relative to the one it was taken at."""
    return np.float32(1.0 if scene.night_light is None else scene.night_light)


def _light(scene: PlateScene, background: Image, truth: FaceTruth) -> FloatArray:
    """Radiance of a white diffuser where a face lies, from the brightness of the road around it."""
    if scene.night_light is not None:
        return np.full(3, scene.night_light, np.float32)
    x, y = np.clip(np.nanmean(truth.corners_px, axis=0), 0, (background.shape[1] - 1, background.shape[0] - 1))
    reach_x, reach_y = max(truth.width_px, 24), max(truth.height_px, 16)
    rows = slice(max(int(y - reach_y), 0), int(y + reach_y) + 1)
    cols = slice(max(int(x - reach_x), 0), int(x + reach_x) + 1)
    step = max(int(min(reach_x, reach_y) / 16), 1)
    road = linear_from_srgb()[np.median(background[rows, cols][::step, ::step], axis=(0, 1)).astype(int)]
    grey = 0.5 * road + 0.5 * road.mean()  # much of the photo's tint is the road's own colour
    return np.asarray(np.maximum(grey, 0.01) / scene.road_reflectance, np.float32)


def _expose_background(scene: PlateScene, photo: Image, shade: Shade, rng: np.random.Generator) -> Image:
    """The whole photo in the camera's tone and noise."""
    share, steps = np.ones((1, 1), np.float32), np.ones(1, np.float32)
    if shade.varies:
        share = _shade_at(scene, shade, np.arange(0, photo.shape[0] + 4, 4), np.arange(0, photo.shape[1] + 4, 4))
        steps = np.linspace(0, 1, _SHADE_STEPS, dtype=np.float32)
    radiance = steps[:, None, None] * linear_from_srgb()[None, None, :] * _photo_gain(scene)
    encode, sigma = _encoded_with_noise(scene, np.repeat(radiance, 3, axis=1))
    rows, cols = photo.shape[:2]
    offsets = rng.integers(0, _NOISE_LENGTH - 3 * cols, rows)
    image = np.empty_like(photo)
    expose_photo(photo, share, encode, sigma, _normal_numbers(int(rng.integers(4))), offsets, image)
    return image


def _shade_at(scene: PlateScene, shade: Shade, rows: Matrix, cols: Matrix) -> FloatArray:
    """Share of the light that arrives where pixels of a grid look at the road."""
    share = np.empty((len(rows), len(cols)), np.float32)
    rays = directions(scene, *np.meshgrid(cols, rows))
    shade_rays(rays, scene.camera.height_m, shade.share, shade.cell_from_ground, share)
    return share


def _encoded_with_noise(scene: PlateScene, radiance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Encoded values and their noise [grey levels] of radiances, channels on axis 1."""
    sensor = scene.sensor
    gains = np.array(sensor.white_balance, np.float32)[None, :, None]
    light = through_air(radiance, scene.air) * np.float32(sensor.gain)
    signal, sigma = light * gains, noise_sigma(light, sensor) * gains
    spread = (tone(signal + sigma, sensor) - tone(signal - sigma, sensor)) / 2
    return tone(signal, sensor), np.asarray(spread, np.float32)


@lru_cache(maxsize=4)
def _normal_numbers(seed: int) -> FloatArray:
    """A fixed row of standard normal numbers: rows of a frame start at random places in it, for speed."""
    return np.random.default_rng(7_000 + seed).standard_normal(_NOISE_LENGTH, dtype=np.float32)


# --- squares on the road --------------------------------------------------------------------------------------------


def _paint(
    scene: PlateScene,
    members: list[int],
    lights: list[FloatArray],
    window: Window,
    background: Image,
    shade: Shade,
    rng: np.random.Generator,
) -> Image:
    """Expose a window: the faces in it with the light on each, over the photo's radiance."""
    rays = pixel_rays(scene, window)
    radiance, cover = gather_faces(scene, members, lights, window, rays, shade)
    if scene.air.glare > 0:
        radiance += _glare(scene, rays)[..., None] * cover[..., None]
    blur = scene.sensor.blur_px
    if blur > 0:
        radiance, cover = blurred(radiance, blur), blurred(cover, blur)
    ground = linear_from_srgb()[background[window.slices]] * _photo_gain(scene)
    if shade.varies:
        ground = ground * _shade_at(scene, shade, *window.grid)[..., None]
    radiance = radiance + ground * (1 - np.minimum(cover, 1))[..., None]
    if scene.sensor.colour_shift_px:
        radiance = shift_colours(radiance, scene.sensor.colour_shift_px)
    if scene.occluder is not None:
        radiance = _occlude(radiance, scene, window)
    return develop(radiance, scene.air, scene.sensor, rng)


def gather_faces(
    scene: PlateScene,
    members: list[int],
    lights: list[FloatArray],
    window: Window,
    rays: Matrix,
    shade: Shade,
    lag_s: float = 0.0,
) -> tuple[FloatArray, FloatArray]:
    """Radiance from faces and the share of each pixel that they fill, integrated over pixel area and exposure.

    Parameters
    ----------
    scene : PlateScene
    members : list of int
        Faces that touch the window, with the light on each in ``lights``, shape (3,).
    window : Window
    rays : ndarray, shape (H, W, 3, 3)
        Of the window's pixels.
    shade : Shade
    lag_s : float
        Time constant of a slow sensor. [s]

    Returns
    -------
    radiance : ndarray of float32, shape (H, W, 3)
    cover : ndarray of float32, shape (H, W)
    """
    radiance = np.zeros((*rays.shape[:2], 3), np.float32)
    cover = np.zeros(rays.shape[:2], np.float32)
    blur_px = max(motion_blur_px(scene, scene.faces[k], scene.exposure_s) for k in members)
    samples = exposure_samples(sample_count(cover.size, blur_px), scene.exposure_s, lag_s)
    row_time = scene.row_time_s(window.grid[0])
    motion, spin = np.array([scene.speed_m_s, 0.0, 0.0]), np.radians(scene.spin_deg_s)
    for k, light in zip(members, lights, strict=True):
        placed = scene.faces[k]
        emission = _NO_EMISSION if placed.face.emission is None else placed.face.emission
        accumulate_face(
            rays, samples, row_time, motion, spin, scene.camera.height_m, placed.texel_from_ground,
            placed.face.reflectance, emission, light, shade.share, shade.cell_from_ground, radiance, cover,
        )  # fmt: skip
    return radiance, cover


def _glare(scene: PlateScene, rays: Matrix) -> FloatArray:
    """Mirrored light of the first face at each pixel."""
    ground = rays[:, :, 0, :2] * (scene.camera.height_m / np.maximum(-rays[:, :, 0, 2], 1e-6))[..., None]
    first = scene.faces[0]
    at_m = (ground - (first.ahead_m, first.left_m)) @ first.ground_from_face[:2, :2]
    scaled = (at_m - scene.air.glare_at_m) / scene.air.glare_size_m
    return np.asarray(scene.air.glare * np.exp(-0.5 * (scaled**2).sum(axis=-1)), np.float32)


def _occlude(radiance: FloatArray, scene: PlateScene, window: Window) -> FloatArray:
    occluder = scene.occluder
    assert occluder is not None
    angle = math.radians(occluder.angle_deg)
    towards = np.array([math.cos(angle), math.sin(angle)])
    along = face_truth(scene, scene.faces[0]).corners_px @ towards
    border = along.max() - occluder.share * (along.max() - along.min())
    rows, cols = window.grid
    depth = (cols[None, :] * towards[0] + rows[:, None] * towards[1] - border) / max(occluder.softness_px, 0.1)
    alpha = (1 / (1 + np.exp(np.clip(-2 * depth, -40, 40)))).astype(np.float32)[..., None]
    return np.asarray(radiance * (1 - alpha) + occluder.radiance * alpha, np.float32)
