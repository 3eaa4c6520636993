"""Scene -> frame: what a camera on a vehicle sees of plates on the road.

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
from app.simulation.plate_face import smooth_noise
from app.simulation.plate_scene import FaceTruth, PlacedFace, PlateScene, Sensor, Shadow, face_truth
from app.simulation.raster import accumulate_face, expose_photo, shade_rays

FloatArray = npt.NDArray[np.float32]
Image = npt.NDArray[np.uint8]
Matrix = npt.NDArray[np.float64]
_SHADE_LEVELS = 64
_NOISE_LENGTH = 1 << 20
_NO_EMISSION = np.empty((0, 0, 3), np.float32)


@dataclass(frozen=True, slots=True)
class RenderedFrame:
    """A frame and the truth about it.

    Attributes
    ----------
    image : ndarray of uint8, shape (H, W, 3)
        Blue, green, red; after the JPEG round trip if there is one.
    jpeg : bytes
        The coded frame; empty without a JPEG round trip.
    truths : tuple of FaceTruth
        One for each of the scene's faces, in order.
    """

    image: Image
    jpeg: bytes
    truths: tuple[FaceTruth, ...]


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
    shade, shade_from_ground = shade_map(scene)
    image = _expose_background(scene, background, shade, shade_from_ground, rng)
    truths = tuple(face_truth(scene, placed) for placed in scene.faces)
    for window, members in _windows(scene, truths):
        faces = [(scene.faces[k], _light(scene, background, truths[k])) for k in members]
        smear = max(_smear_px(scene, scene.faces[k]) for k in members)
        ground = _linear_from_srgb()[background[window.slices]] * np.float32(_photo_gain(scene))
        if shade.size > 1:
            ground *= _window_shade(scene, window, shade, shade_from_ground)[..., None]
        image[window.slices] = _paint(scene, faces, window, smear, ground, rng, (shade, shade_from_ground))
    if scene.sensor.jpeg_quality is None:
        return RenderedFrame(image, b"", truths)
    jpeg = encode_jpeg(image, scene.sensor.jpeg_quality)
    return RenderedFrame(np.asarray(cv2.imdecode(jpeg, cv2.IMREAD_COLOR), np.uint8), jpeg.tobytes(), truths)


def encode_jpeg(image: Image, quality: int) -> Image:
    """JPEG with colour at half resolution (4:2:0), as cameras write it."""
    sampling = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420]
    done, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality, *sampling])
    if not done:
        raise InvalidParameter("the image cannot be coded as JPEG", field="image")
    return np.asarray(jpeg, np.uint8)


# --- light --------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def _linear_from_srgb() -> FloatArray:
    v = np.arange(256) / 255
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4).astype(np.float32)


def tone(radiance: FloatArray, sensor: Sensor) -> FloatArray:
    """Encoded value, 0 to 255 and not rounded, of a radiance after gains: shoulder, clipping, gamma."""
    knee = sensor.shoulder
    x = np.clip(radiance, 0, None)
    if knee < 1:
        x = np.where(x > knee, knee + (1 - knee) * (1 - np.exp(-(x - knee) / (1 - knee))), x)
    x = np.minimum(x, 1)
    toe = 0.0031308
    encoded = np.where(x <= toe, 12.92 * x, 1.055 * np.power(np.maximum(x, toe), 1 / (sensor.gamma + 0.2)) - 0.055)
    return np.asarray(255 * encoded, np.float32)


def noise_sigma(radiance: FloatArray, sensor: Sensor) -> FloatArray:
    """Standard deviation of the sensor's noise before gains, as a share of saturation: shot and read noise."""
    electrons = np.clip(radiance, 0, None) * sensor.full_well_e + sensor.read_noise_e**2
    return np.asarray(np.sqrt(electrons) / sensor.full_well_e, np.float32)


def shade_map(scene: PlateScene) -> tuple[FloatArray, Matrix]:
    """Share of the light that arrives on the road, and the affine map to its cells from the ground frame."""
    if scene.shadow.is_none or not scene.faces:
        return np.ones((1, 1), np.float32), np.zeros((2, 3))
    field, cell_m = _shade_field(scene.shadow)
    first = scene.faces[0]
    centre = field.shape[0] / 2
    along = np.array(
        [[1 / cell_m, 0, centre - first.ahead_m / cell_m], [0, 1 / cell_m, centre - first.left_m / cell_m]]
    )
    return field, along


@lru_cache(maxsize=8)
def _shade_field(shadow: Shadow) -> tuple[FloatArray, float]:
    """Shade on a square patch of road, rows to the left, columns ahead; its cells are 1.5 cm."""
    size, cell_m = 600, 0.015
    at_m = (np.arange(size, dtype=np.float32) - size / 2) * np.float32(cell_m)
    field = np.ones((size, size), np.float32)
    if shadow.edge_light < 1:
        angle = math.radians(shadow.edge_angle_deg)
        across = at_m[None, :] * math.cos(angle) + at_m[:, None] * math.sin(angle) - shadow.edge_offset_m
        lit = 1 / (1 + np.exp(np.clip(-across / max(shadow.penumbra_m / 2, 1e-3), -40, 40)))
        field *= shadow.edge_light + (1 - shadow.edge_light) * lit.astype(np.float32)
    if shadow.dapple_light < 1:
        rng = np.random.default_rng(shadow.seed)
        leaves = 0.7 * smooth_noise(field.shape, shadow.dapple_m / cell_m, rng)
        leaves += 0.3 * smooth_noise(field.shape, max(shadow.dapple_m / cell_m / 2.5, 2), rng)
        gaps = 1 / (1 + np.exp(-(leaves - 0.5) / max(shadow.dapple_softness, 0.02) * 2))
        field *= shadow.dapple_light + (1 - shadow.dapple_light) * gaps
    return field, cell_m


def _photo_gain(scene: PlateScene) -> float:
    """Radiance of the scene's photo relative to the one it was taken at."""
    return 1.0 if scene.night_light is None else scene.night_light * scene.road_reflectance


def _light(scene: PlateScene, background: Image, truth: FaceTruth) -> FloatArray:
    """Radiance of a white diffuser where a face lies, from the brightness of the road around it."""
    if scene.night_light is not None:
        return np.full(3, scene.night_light, np.float32)
    x, y = np.clip(np.nanmean(truth.corners_px, axis=0), 0, (background.shape[1] - 1, background.shape[0] - 1))
    reach_x, reach_y = max(truth.width_px, 24), max(truth.height_px, 16)
    rows = slice(max(int(y - reach_y), 0), int(y + reach_y) + 1)
    cols = slice(max(int(x - reach_x), 0), int(x + reach_x) + 1)
    step = max(int(min(reach_x, reach_y) / 16), 1)
    road = _linear_from_srgb()[np.median(background[rows, cols][::step, ::step], axis=(0, 1)).astype(int)]
    grey = 0.5 * road + 0.5 * road.mean()  # much of the photo's tint is the road's own colour
    return np.asarray(np.maximum(grey, 0.01) / scene.road_reflectance, np.float32)


# --- background ---------------------------------------------------------------------------------------------------


def _expose_background(
    scene: PlateScene, photo: Image, shade: FloatArray, shade_from_ground: Matrix, rng: np.random.Generator
) -> Image:
    """The whole photo in the camera's tone and noise."""
    levels, shares = _shade_levels(scene, shade, shade_from_ground)
    radiance = shares[:, None, None] * _linear_from_srgb()[None, None, :] * np.float32(_photo_gain(scene))
    radiance = np.repeat(radiance, 3, axis=1)
    encode, sigma = _encoded_with_noise(scene, radiance)
    noise = _normal_numbers(int(rng.integers(4)))
    rows, cols = photo.shape[:2]
    offsets = rng.integers(0, _NOISE_LENGTH - 3 * cols, rows)
    image = np.empty_like(photo)
    expose_photo(photo, levels, encode, sigma, noise, offsets, image)
    return image


def _shade_levels(scene: PlateScene, shade: FloatArray, shade_from_ground: Matrix) -> tuple[Image, FloatArray]:
    """Light on a grid of 4 x 4 pixels as an index, and the share that each index means."""
    camera = scene.camera
    grid = (-(-camera.height_px // 4), -(-camera.width_px // 4))
    if shade.size == 1:
        return np.zeros(grid, np.uint8), np.ones(1, np.float32)
    rows, cols = np.mgrid[0 : grid[0], 0 : grid[1]] * 4 + 1.5
    directions = _directions(scene, cols, rows)
    share = np.empty(grid, np.float32)
    shade_rays(directions, camera.height_m, shade, shade_from_ground, share)
    return np.round(share * _SHADE_LEVELS).astype(np.uint8), np.arange(
        _SHADE_LEVELS + 1, dtype=np.float32
    ) / _SHADE_LEVELS


def _window_shade(scene: PlateScene, window: Window, shade: FloatArray, shade_from_ground: Matrix) -> FloatArray:
    rows, cols = np.mgrid[window.top : window.bottom, window.left : window.right]
    share = np.empty(rows.shape, np.float32)
    shade_rays(_directions(scene, cols, rows), scene.camera.height_m, shade, shade_from_ground, share)
    return share


def _encoded_with_noise(scene: PlateScene, radiance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Encoded values and their noise [grey levels] of radiances, channels on axis 1."""
    sensor = scene.sensor
    through_air = radiance * (1 - scene.air.haze) + scene.air.airlight * scene.air.haze
    gains = np.array(sensor.white_balance, np.float32)[None, :, None] * np.float32(sensor.gain)
    sigma = noise_sigma(through_air * sensor.gain, sensor)
    signal = through_air * gains
    encoded = tone(signal, sensor)
    slope = (tone(signal + 2e-3, sensor) - tone(np.maximum(signal - 2e-3, 0), sensor)) / (
        2e-3 + np.minimum(signal, 2e-3)
    )
    return encoded, np.asarray(sigma * slope * gains / sensor.gain, np.float32)


@lru_cache(maxsize=4)
def _normal_numbers(seed: int) -> FloatArray:
    """A fixed row of standard normal numbers; frames start at random places in it, a hundred times faster."""
    return np.random.default_rng(7_000 + seed).standard_normal(_NOISE_LENGTH, dtype=np.float32)


# --- squares on the road --------------------------------------------------------------------------------------------


def _windows(scene: PlateScene, truths: tuple[FaceTruth, ...]) -> list[tuple[Window, list[int]]]:
    """Parts of the image that faces touch, with the faces in each; those that overlap are one."""
    groups: list[tuple[Window, list[int]]] = []
    for index, (placed, truth) in enumerate(zip(scene.faces, truths, strict=True)):
        window, members = _window(scene, placed, truth), [index]
        if window is None:
            continue
        for other in [g for g in groups if g[0].overlaps(window)]:
            groups.remove(other)
            window, members = window.union(other[0]), other[1] + members
        groups.append((window, members))
    return groups


def _window(scene: PlateScene, placed: PlacedFace, truth: FaceTruth) -> Window | None:
    """Part of the image that a face touches during the exposure, with room for the lens's blur."""
    if not truth.partly_in_view:
        return None
    margin = _smear_px(scene, placed) / 2 + 4 * scene.sensor.blur_px + abs(scene.sensor.colour_shift_px) + 6
    low, high = truth.corners_px.min(axis=0) - margin, truth.corners_px.max(axis=0) + margin
    left, top = max(int(low[0]) // 2 * 2, 0), max(int(low[1]) // 2 * 2, 0)
    right, bottom = min(int(high[0]) + 2, scene.camera.width_px), min(int(high[1]) + 2, scene.camera.height_px)
    right, bottom = right - (right - left) % 2, bottom - (bottom - top) % 2
    return Window(left, top, right, bottom) if right - left > 1 and bottom - top > 1 else None


def _smear_px(scene: PlateScene, placed: PlacedFace) -> float:
    """Longest way that a corner goes in the image during the exposure. [px]"""
    if not scene.speed_m_s and not any(scene.spin_deg_s):
        return 0.0
    corners = placed.corners_ground_m
    half = np.full(4, scene.exposure_s / 2)
    way = np.linalg.norm(scene.project_at(corners, half) - scene.project_at(corners, -half), axis=1)
    return min(float(np.nanmax(way)), 400.0) if np.isfinite(way).any() else 0.0


def _paint(
    scene: PlateScene,
    faces: list[tuple[PlacedFace, FloatArray]],
    window: Window,
    smear_px: float,
    ground_light: FloatArray,
    rng: np.random.Generator,
    shade: tuple[FloatArray, Matrix],
) -> Image:
    """Expose a window: ``faces`` with the light on each, over ``ground_light``, the photo's radiance."""
    rays = _rays(scene, window)
    radiance = np.zeros((*rays.shape[:2], 3), np.float32)
    cover = np.zeros(rays.shape[:2], np.float32)
    samples = exposure_samples(_sample_count(cover.size, smear_px), scene.exposure_s)
    row_time = scene.row_time_s(np.arange(window.top, window.bottom))
    motion, spin = np.array([scene.speed_m_s, 0.0, 0.0]), np.radians(scene.spin_deg_s)
    for placed, light in faces:
        emission = placed.face.emission
        accumulate_face(
            rays, samples, row_time, motion, spin, scene.camera.height_m, placed.texel_from_ground,
            placed.face.reflectance, _NO_EMISSION if emission is None else emission, light, *shade, radiance, cover,
        )  # fmt: skip
    if scene.air.glare > 0:
        radiance += _glare(scene, rays)[..., None] * cover[..., None]
    blur = scene.sensor.blur_px
    if blur > 0:
        radiance = cv2.GaussianBlur(radiance, (0, 0), blur, borderType=cv2.BORDER_REPLICATE)
        cover = cv2.GaussianBlur(cover, (0, 0), blur, borderType=cv2.BORDER_REPLICATE)
    radiance += ground_light * (1 - np.minimum(cover, 1))[..., None]
    if scene.sensor.colour_shift_px:
        radiance = _shift_colours(radiance, scene.sensor.colour_shift_px)
    if scene.occluder is not None:
        radiance = _occlude(radiance, scene, window)
    return _develop(radiance, scene, rng)


def _sample_count(pixels: int, smear_px: float) -> int:
    """Samples a pixel: at least four for each pixel of motion, more where a window is small."""
    return int(np.clip(max(3_000_000 / max(pixels, 1), 4 * smear_px + 12), 24, 96))


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
        Time constant with which a slow sensor forgets; 0 is none. [s]

    Returns
    -------
    ndarray, shape (count, 3)
        Column and row offset from the pixel's centre [px], time from mid-exposure [s].
    """
    unit = _unit_samples(count)
    when = (unit[:, 2] - 0.5) * exposure_s
    if lag_s > 0:
        order = np.random.default_rng(1).permutation(count)
        when = when + lag_s * np.log(np.clip((order + 0.5) / count, 1e-6, 1))
    return np.column_stack([unit[:, :2] - 0.5, when])


def _directions(scene: PlateScene, cols: Matrix, rows: Matrix) -> Matrix:
    """Direction in the ground frame of image points, any shape (...,) to (..., 3)."""
    camera = scene.camera
    points = np.stack([cols, rows], axis=-1).astype(np.float64)
    if camera.distortion:
        ideal = cv2.undistortPoints(points.reshape(-1, 1, 2), camera.matrix, np.array(camera.distortion))
        ideal = ideal.reshape(points.shape)
    else:
        ideal = (points - (camera.cx_px, camera.cy_px)) / (camera.fx_px, camera.fy_px)
    rotation = scene.camera_from_ground
    directions: Matrix = ideal @ rotation[:2] + rotation[2]
    return directions


def _rays(scene: PlateScene, window: Window) -> Matrix:
    """Directions of a window's pixels and their derivatives by column and row, shape (H, W, 3, 3)."""
    cols = np.arange(window.left, window.right + 1) - 0.5
    rows = np.arange(window.top, window.bottom + 1) - 0.5
    edges = _directions(scene, *np.meshgrid(cols, rows))
    rays = np.empty((len(rows) - 1, len(cols) - 1, 3, 3))
    a, b, c, d = edges[:-1, :-1], edges[:-1, 1:], edges[1:, :-1], edges[1:, 1:]
    rays[:, :, 0] = (a + b + c + d) / 4
    rays[:, :, 1] = (b + d - a - c) / 2
    rays[:, :, 2] = (c + d - a - b) / 2
    return rays


def _glare(scene: PlateScene, rays: Matrix) -> FloatArray:
    """Mirrored light of the first face at each pixel."""
    ground = rays[:, :, 0, :2] * (scene.camera.height_m / np.maximum(-rays[:, :, 0, 2], 1e-6))[..., None]
    first = scene.faces[0]
    at_m = (ground - (first.ahead_m, first.left_m)) @ first.ground_from_face[:2, :2]
    scaled = (at_m - scene.air.glare_at_m) / scene.air.glare_size_m
    return np.asarray(scene.air.glare * np.exp(-0.5 * (scaled**2).sum(axis=-1)), np.float32)


def _shift_colours(radiance: FloatArray, shift_px: float) -> FloatArray:
    out = radiance.copy()
    size = (radiance.shape[1], radiance.shape[0])
    for channel, sign in ((0, 0.5), (2, -0.5)):
        move = np.array([[1, 0, sign * shift_px], [0, 1, 0]])
        plane = np.ascontiguousarray(radiance[..., channel])
        out[..., channel] = cv2.warpAffine(plane, move, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return out


def _occlude(radiance: FloatArray, scene: PlateScene, window: Window) -> FloatArray:
    occluder = scene.occluder
    assert occluder is not None
    angle = math.radians(occluder.angle_deg)
    towards = np.array([math.cos(angle), math.sin(angle)])
    along = face_truth(scene, scene.faces[0]).corners_px @ towards
    border = along.max() - occluder.share * (along.max() - along.min())
    rows, cols = np.mgrid[window.top : window.bottom, window.left : window.right]
    depth = (cols * towards[0] + rows * towards[1] - border) / max(occluder.softness_px, 0.1)
    alpha = (1 / (1 + np.exp(np.clip(-2 * depth, -40, 40)))).astype(np.float32)[..., None]
    return np.asarray(radiance * (1 - alpha) + occluder.radiance * alpha, np.float32)


def _develop(radiance: FloatArray, scene: PlateScene, rng: np.random.Generator) -> Image:
    """Sensor and image pipeline: air, noise, colour mosaic, gains, tone, sharpening."""
    sensor = scene.sensor
    light = (radiance * (1 - scene.air.haze) + scene.air.airlight * scene.air.haze) * np.float32(sensor.gain)
    gains = np.array(sensor.white_balance, np.float32)
    if sensor.bayer:
        raw = _mosaic(light)
        raw = raw + noise_sigma(raw, sensor) * rng.standard_normal(raw.shape, dtype=np.float32)
        raw = raw * _mosaic(np.broadcast_to(gains, light.shape))
        codes = np.clip(raw * 16000 + 2000.5, 0, 65535).astype(np.uint16)  # an offset keeps the noise of black
        light = (cv2.cvtColor(codes, cv2.COLOR_BayerRGGB2BGR_EA).astype(np.float32) - 2000) / 16000
    else:
        light = light + noise_sigma(light, sensor) * rng.standard_normal(light.shape, dtype=np.float32)
        light = light * gains
    encoded = tone(light, sensor)
    if sensor.sharpen:
        encoded = encoded + sensor.sharpen * (encoded - cv2.GaussianBlur(encoded, (0, 0), 1.0))
    return np.clip(encoded + 0.5, 0, 255).astype(np.uint8)


def _mosaic(light: FloatArray) -> FloatArray:
    """One colour a pixel: red top-left, blue bottom-right, green else."""
    raw = light[..., 1].copy()
    raw[0::2, 0::2] = light[0::2, 0::2, 2]
    raw[1::2, 1::2] = light[1::2, 1::2, 0]
    return raw
