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

from app.compiled import kernel, step
from app.errors import InvalidParameter
from app.simulation.plate_face import smooth_noise
from app.simulation.plate_scene import Air, FaceTruth, PlacedFace, PlateScene, Sensor, Shadow, face_truth
from app.values import Floats, Floats32

# === Shadows: how much light arrives on each spot of the road.


_CELLS, _CELL_M = 600, 0.015


@dataclass(frozen=True, slots=True)
class Shade:
    """Light on a square patch of road; beyond it the values of its border hold."""

    share: Floats32  # float32, shape (N, N): of the full light, 0 to 1; a single value is everywhere
    cell_from_ground: Floats  # shape (2, 3): affine map from the ground frame to columns and rows

    @property
    def varies(self) -> bool:
        """There are shadows."""
        return self.share.size > 1


NO_SHADE = Shade(np.ones((1, 1), np.float32), np.zeros((2, 3)))


def shade_map(scene: PlateScene) -> Shade:
    """Light on the road around a scene's first face."""
    if scene.shadow.is_none or not scene.faces:
        return NO_SHADE
    first = scene.faces[0]
    centre = np.array([_CELLS / 2 - first.ahead_m / _CELL_M, _CELLS / 2 - first.left_m / _CELL_M])
    return Shade(_shade_field(scene.shadow), np.column_stack([np.eye(2) / _CELL_M, centre]))


@lru_cache(maxsize=8)
def _shade_field(shadow: Shadow) -> Floats32:
    """Share of light, columns ahead, rows to the left."""
    at_m = (np.arange(_CELLS, dtype=np.float32) - _CELLS / 2) * np.float32(_CELL_M)
    field = np.ones((_CELLS, _CELLS), np.float32)
    if shadow.edge_light < 1:
        angle = math.radians(shadow.edge_angle_deg)
        across = at_m[None, :] * math.cos(angle) + at_m[:, None] * math.sin(angle) - shadow.edge_offset_m
        lit = 1 / (1 + np.exp(np.clip(-across / max(shadow.penumbra_m / 2, 1e-3), -40, 40)))
        field *= np.asarray(shadow.edge_light + (1 - shadow.edge_light) * lit, np.float32)
    if shadow.dapple_light < 1:
        rng = np.random.default_rng(shadow.seed)
        leaves = 0.7 * smooth_noise((_CELLS, _CELLS), shadow.dapple_m / _CELL_M, rng)
        leaves += 0.3 * smooth_noise((_CELLS, _CELLS), max(shadow.dapple_m / _CELL_M / 2.5, 2), rng)
        gaps = 1 / (1 + np.exp(-(leaves - 0.5) / max(shadow.dapple_softness, 0.02) * 2))
        field *= np.asarray(shadow.dapple_light + (1 - shadow.dapple_light) * gaps, np.float32)
    return field


# === Compiled inner loops of the camera simulation: area sampling of squares on the road, and the sensor's noise.


@kernel
def accumulate_face(
    rays: Floats,
    samples: Floats,
    row_time_s: Floats,
    motion: Floats,
    spin: Floats,
    height_m: float,
    face_from_ground: Floats,
    reflectance: Floats32,
    emission: Floats32,
    light: Floats32,
    shade: Floats32,
    shade_from_ground: Floats,
    out: Floats32,
    cover: Floats32,
) -> None:  # pragma: no cover - compiled
    """Integrate what each pixel sees of a square on the road over its area and the exposure.

    Parameters
    ----------
    rays : float64 (H, W, 3, 3)
        Of each pixel in the vehicle frame: direction at its centre, and its derivatives by column and by row.
    samples : float64 (S, 3)
        Column and row offset within the pixel [px], time from mid-exposure [s].
    row_time_s : float64 (H,)
        Mid-exposure of each row. [s]
    motion, spin : float64 (3,)
        Velocity [m/s] and angular rate [rad/s] of the camera, vehicle frame.
    height_m : float
        Camera above the road. [m]
    face_from_ground : float64 (2, 3)
        To columns and rows of the texture, texel edges at integers.
    reflectance, emission : float32 (T, T, 3)
        ``emission`` may have no texels.
    light : float32 (3,)
        Radiance of a white diffuser in full light.
    shade : float32 (N, N), shade_from_ground : float64 (2, 3)
        Share of the light that arrives, by bilinear lookup.
    out, cover : float32 (H, W, 3), (H, W)
        Added to: radiance from the square, and the share of the footprint that it fills.
    """
    rows, cols = out.shape[0], out.shape[1]
    count, size = samples.shape[0], reflectance.shape[0]
    glows = emission.shape[0] > 0
    weight = 1.0 / count
    begin, end = samples[:, 2].min(), samples[:, 2].max()
    for i in range(rows):
        for j in range(cols):
            if _misses(rays[i, j], row_time_s[i], begin, end, motion, spin, height_m, face_from_ground, size):
                continue
            blue = green = red = hit = 0.0
            for s in range(count):
                du, dv, t = samples[s, 0], samples[s, 1], samples[s, 2] + row_time_s[i]
                gx, gy = _ground(rays[i, j], du, dv, t, motion, spin, height_m)
                fx = face_from_ground[0, 0] * gx + face_from_ground[0, 1] * gy + face_from_ground[0, 2]
                fy = face_from_ground[1, 0] * gx + face_from_ground[1, 1] * gy + face_from_ground[1, 2]
                if fx < 0 or fy < 0 or fx >= size or fy >= size:
                    continue
                a, b = int(fy), int(fx)
                lit = weight * _bilinear(shade, shade_from_ground, gx, gy)
                blue += lit * light[0] * reflectance[a, b, 0]
                green += lit * light[1] * reflectance[a, b, 1]
                red += lit * light[2] * reflectance[a, b, 2]
                if glows:
                    blue += weight * emission[a, b, 0]
                    green += weight * emission[a, b, 1]
                    red += weight * emission[a, b, 2]
                hit += weight
            if hit > 0:
                out[i, j, 0] += blue
                out[i, j, 1] += green
                out[i, j, 2] += red
                cover[i, j] += hit


@step
def _ground(
    ray: Floats, du: float, dv: float, t: float, motion: Floats, spin: Floats, height_m: float
) -> tuple[float, float]:  # pragma: no cover - compiled
    """Where a spot of a pixel looks at the road at time t; far away above the horizon."""
    dx = ray[0, 0] + du * ray[1, 0] + dv * ray[2, 0]
    dy = ray[0, 1] + du * ray[1, 1] + dv * ray[2, 1]
    dz = ray[0, 2] + du * ray[1, 2] + dv * ray[2, 2]
    ex = dx + t * (spin[1] * dz - spin[2] * dy)
    ey = dy + t * (spin[2] * dx - spin[0] * dz)
    ez = dz + t * (spin[0] * dy - spin[1] * dx)
    scale = (height_m + motion[2] * t) / max(-ez, 1e-6)
    return ex * scale + motion[0] * t, ey * scale + motion[1] * t


@kernel
def _misses(
    ray: Floats,
    row_time_s: float,
    begin: float,
    end: float,
    motion: Floats,
    spin: Floats,
    height_m: float,
    face_from_ground: Floats,
    size: int,
) -> bool:  # pragma: no cover - compiled
    """Whether the corners of a pixel's footprint at both ends of the exposure all lie beyond one side of the face."""
    low_x = low_y = 1e30  # fastmath knows no infinity
    high_x = high_y = -1e30
    for du in (-0.6, 0.6):
        for dv in (-0.6, 0.6):
            for t in (begin, end):
                gx, gy = _ground(ray, du, dv, row_time_s + t, motion, spin, height_m)
                fx = face_from_ground[0, 0] * gx + face_from_ground[0, 1] * gy + face_from_ground[0, 2]
                fy = face_from_ground[1, 0] * gx + face_from_ground[1, 1] * gy + face_from_ground[1, 2]
                low_x, high_x = min(low_x, fx), max(high_x, fx)
                low_y, high_y = min(low_y, fy), max(high_y, fy)
    return high_x < 0 or high_y < 0 or low_x > size or low_y > size


@kernel
def _bilinear(field: Floats32, field_from_ground: Floats, gx: float, gy: float) -> float:  # pragma: no cover - compiled
    size = field.shape[0]
    if size == 1:
        return float(field[0, 0])
    u = field_from_ground[0, 0] * gx + field_from_ground[0, 1] * gy + field_from_ground[0, 2]
    v = field_from_ground[1, 0] * gx + field_from_ground[1, 1] * gy + field_from_ground[1, 2]
    u, v = min(max(u, 0.0), size - 1.001), min(max(v, 0.0), size - 1.001)
    c, r = int(u), int(v)
    p, q = u - c, v - r
    top = field[r, c] * (1 - p) + field[r, c + 1] * p
    low = field[r + 1, c] * (1 - p) + field[r + 1, c + 1] * p
    return float(top * (1 - q) + low * q)


@kernel
def shade_rays(
    rays: Floats, height_m: float, shade: Floats32, shade_from_ground: Floats, out: Floats32
) -> None:  # pragma: no cover - compiled
    """Share of the light that arrives where each ray meets the road; 1 above the horizon. ``out``: float32 (H, W)."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            dz = rays[i, j, 2]
            if dz > -0.02:
                out[i, j] = 1.0
                continue
            scale = height_m / -dz
            out[i, j] = _bilinear(shade, shade_from_ground, rays[i, j, 0] * scale, rays[i, j, 1] * scale)


@kernel
def expose_photo(
    photo: npt.NDArray[np.uint8],
    share: Floats32,
    encode: Floats32,
    sigma: Floats32,
    noise: Floats32,
    offsets: npt.NDArray[np.int64],
    out: npt.NDArray[np.uint8],
) -> None:  # pragma: no cover - compiled
    """Give a photo the camera's tone and noise.

    Parameters
    ----------
    share : float32 (h, w)
        Light that arrives, 0 to 1, at every fourth row and column; a single value stands for all.
    encode, sigma : float32 (L, C, 256)
        Encoded value and noise of a photo's value at L even steps of light from 0 to 1. [grey levels]
    noise : float32 (M,)
        Standard normal numbers; ``offsets`` : int64 (H,), where each row starts in them.
    """
    rows, cols, channels = photo.shape
    top_level = encode.shape[0] - 1
    even = share.size == 1
    level = int(share[0, 0] * top_level + 0.5)
    for i in range(rows):
        k = offsets[i]
        r, q = i >> 2, (i & 3) * 0.25
        for j in range(cols):
            if not even:
                c0, p = j >> 2, (j & 3) * 0.25
                top = share[r, c0] * (1 - p) + share[r, c0 + 1] * p
                low = share[r + 1, c0] * (1 - p) + share[r + 1, c0 + 1] * p
                level = int((top * (1 - q) + low * q) * top_level + 0.5)
            for c in range(channels):
                v = photo[i, j, c]
                x = encode[level, c, v] + sigma[level, c, v] * noise[k] + 0.5
                k += 1
                out[i, j, c] = 0 if x < 0 else (255 if x >= 255.5 else int(x))


# === The part of the road that each pixel sees, and when.


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
    def grid(self) -> tuple[Floats, Floats]:
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
def _unit_samples(count: int) -> Floats:
    """Points spread evenly over the unit cube (Kronecker sequence of the plastic number), mean exactly 0.5."""
    g = 1.2207440846057596
    points = np.mod(0.5 + np.arange(1, count + 1)[:, None] / g ** np.arange(1, 4), 1.0)
    points += 0.5 - points.mean(axis=0)
    return points


def exposure_samples(count: int, exposure_s: float, lag_s: float = 0.0) -> Floats:
    """Where and when a pixel gathers light.

    Parameters
    ----------
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


def directions(scene: PlateScene, cols: Floats, rows: Floats) -> Floats:
    """Direction in the ground frame of image points, any shape (...,) to (..., 3)."""
    camera = scene.camera
    points = np.stack([cols, rows], axis=-1).astype(np.float64)
    if camera.distortion:
        # five steps, OpenCV's default, are up to 40 px short on the wide lenses of the rational model
        both = cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS
        stop = (cv2.TERM_CRITERIA_COUNT, 5, 0.01) if len(camera.distortion) < 8 else (both, 100, 1e-9)
        ideal = cv2.undistortPoints(
            points.reshape(-1, 1, 2), camera.matrix, np.array(camera.distortion), None, None, None, stop
        ).reshape(points.shape)
    else:
        ideal = (points - (camera.cx_px, camera.cy_px)) / (camera.fx_px, camera.fy_px)
    rotation = scene.camera_from_ground
    towards: Floats = ideal @ rotation[:2] + rotation[2]
    return towards


def pixel_rays(scene: PlateScene, window: Window) -> Floats:
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


# === Radiance to grey levels: noise, colour mosaic, gains, tone, sharpening, JPEG.
#
# Radiance is linear, 1 = the sensor's saturation; channels are blue, green, red.


Image = npt.NDArray[np.uint8]


@lru_cache(maxsize=1)
def linear_from_srgb() -> Floats32:
    """Radiance of each value of an 8-bit photo, shape (256,)."""
    v = np.arange(256) / 255
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4).astype(np.float32)


def tone(radiance: Floats32, sensor: Sensor) -> Floats32:
    """Encoded value, 0 to 255 and not rounded, of a radiance after gains: shoulder, clipping, gamma."""
    knee = sensor.shoulder
    x = np.clip(radiance, 0, None)
    if knee < 1:
        x = np.where(x > knee, knee + (1 - knee) * (1 - np.exp(-np.maximum(x - knee, 0) / (1 - knee))), x)
    x = np.minimum(x, 1)
    toe = 0.0031308
    encoded = np.where(x <= toe, 12.92 * x, 1.055 * np.power(np.maximum(x, toe), 1 / (sensor.gamma + 0.2)) - 0.055)
    return np.asarray(255 * encoded, np.float32)


def noise_sigma(radiance: Floats32, sensor: Sensor) -> Floats32:
    """Standard deviation of the sensor's noise before gains, as a share of saturation: shot and read noise."""
    electrons = np.clip(radiance, 0, None) * sensor.full_well_e + sensor.read_noise_e**2
    return np.asarray(np.sqrt(electrons) / sensor.full_well_e, np.float32)


def through_air(radiance: Floats32, air: Air) -> Floats32:
    """Radiance that reaches the lens through haze."""
    return np.asarray(radiance * (1 - air.haze) + air.airlight * air.haze, np.float32)


def develop(radiance: Floats32, air: Air, sensor: Sensor, rng: np.random.Generator) -> Image:
    """Frame of a radiance, shape (H, W, 3): air, noise, colour mosaic, gains, tone, sharpening.

    The mosaic's first pixel is red, so a part of a frame must start at an even row and column.
    """
    light = through_air(radiance, air) * np.float32(sensor.gain)
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
    return np.asarray(np.clip(encoded + 0.5, 0, 255), np.uint8)


def _mosaic(light: Floats32) -> Floats32:
    """One colour a pixel: red top-left, blue bottom-right, green else."""
    raw = light[..., 1].copy()
    raw[0::2, 0::2] = light[0::2, 0::2, 2]
    raw[1::2, 1::2] = light[1::2, 1::2, 0]
    return raw


def blurred(light: Floats32, sigma_px: float) -> Floats32:
    """Light spread by a Gaussian lens."""
    return np.asarray(cv2.GaussianBlur(light, (0, 0), sigma_px, borderType=cv2.BORDER_REPLICATE), np.float32)


def shift_colours(radiance: Floats32, shift_px: float) -> Floats32:
    """Move blue and red sideways against each other."""
    out = radiance.copy()
    size = (radiance.shape[1], radiance.shape[0])
    for channel, sign in ((0, 0.5), (2, -0.5)):
        move = np.array([[1, 0, sign * shift_px], [0, 1, 0]])
        plane = np.ascontiguousarray(radiance[..., channel])
        out[..., channel] = cv2.warpAffine(plane, move, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return out


def encode_jpeg(image: Image, quality: int) -> Image:
    """JPEG with colour at half resolution (4:2:0), as cameras write it."""
    sampling = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420]
    done, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality, *sampling])
    if not done:
        raise InvalidParameter("the image cannot be coded as JPEG", field="image")
    return np.asarray(jpeg, np.uint8)


# === Scene to frame.


_SHADE_STEPS = 129
_NOISE_LENGTH = 1 << 20
_NO_EMISSION = np.empty((0, 0, 3), np.float32)


@dataclass(frozen=True, slots=True)
class RenderedFrame:
    """A frame and the truth about it."""

    # uint8, shape (H, W, 3) or, thermal, (H, W): blue, green, red; after the JPEG round trip if there is one
    image: Image
    jpeg: bytes  # the coded frame; empty without a JPEG round trip
    truths: tuple[FaceTruth, ...]  # one for each of the scene's faces, in order


def render_plate_scene(scene: PlateScene, background: Image | None, rng: np.random.Generator) -> RenderedFrame:
    """Render one exposure.

    Parameters
    ----------
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


def _light(scene: PlateScene, background: Image, truth: FaceTruth) -> Floats32:
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


def _shade_at(scene: PlateScene, shade: Shade, rows: Floats, cols: Floats) -> Floats32:
    """Share of the light that arrives where pixels of a grid look at the road."""
    share = np.empty((len(rows), len(cols)), np.float32)
    rays = directions(scene, *np.meshgrid(cols, rows))
    shade_rays(rays, scene.camera.height_m, shade.share, shade.cell_from_ground, share)
    return share


def _encoded_with_noise(scene: PlateScene, radiance: Floats32) -> tuple[Floats32, Floats32]:
    """Encoded values and their noise [grey levels] of radiances, channels on axis 1."""
    sensor = scene.sensor
    gains = np.array(sensor.white_balance, np.float32)[None, :, None]
    light = through_air(radiance, scene.air) * np.float32(sensor.gain)
    signal, sigma = light * gains, noise_sigma(light, sensor) * gains
    spread = (tone(signal + sigma, sensor) - tone(signal - sigma, sensor)) / 2
    return tone(signal, sensor), np.asarray(spread, np.float32)


@lru_cache(maxsize=4)
def _normal_numbers(seed: int) -> Floats32:
    """A fixed row of standard normal numbers: rows of a frame start at random places in it, for speed."""
    return np.random.default_rng(7_000 + seed).standard_normal(_NOISE_LENGTH, dtype=np.float32)


# --- squares on the road --------------------------------------------------------------------------------------------


def _paint(
    scene: PlateScene,
    members: list[int],
    lights: list[Floats32],
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
    lights: list[Floats32],
    window: Window,
    rays: Floats,
    shade: Shade,
    lag_s: float = 0.0,
) -> tuple[Floats32, Floats32]:
    """Radiance from faces and the share of each pixel that they fill, integrated over pixel area and exposure.

    Parameters
    ----------
    members : list of int
        Faces that touch the window, with the light on each in ``lights``, shape (3,).
    rays : ndarray, shape (H, W, 3, 3)
        Of the window's pixels.
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


def _glare(scene: PlateScene, rays: Floats) -> Floats32:
    """Mirrored light of the first face at each pixel."""
    ground = rays[:, :, 0, :2] * (scene.camera.height_m / np.maximum(-rays[:, :, 0, 2], 1e-6))[..., None]
    first = scene.faces[0]
    at_m = (ground - (first.ahead_m, first.left_m)) @ first.ground_from_face[:2, :2]
    scaled = (at_m - scene.air.glare_at_m) / scene.air.glare_size_m
    return np.asarray(scene.air.glare * np.exp(-0.5 * (scaled**2).sum(axis=-1)), np.float32)


def _occlude(radiance: Floats32, scene: PlateScene, window: Window) -> Floats32:
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
