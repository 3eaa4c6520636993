"""Weather of the hunt and the corpus: snow, sand, water that mirrors lights, dusk; shaking and very wide cameras.

It is a second model beside that of `weather`, on whose sets the decoder was tuned, and shares no code with it.

Each function takes a scene (and the photo behind it), and returns it changed; what it is called with draws everything.
Layers lie in the ground frame, on plate and road alike, so perspective, blur, noise and JPEG act on them as on paint.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from app.sensors.camera import Camera
from app.simulation.camera import Window, directions, linear_from_srgb
from app.simulation.plate_face import Colour, smooth_noise
from app.simulation.plate_scene import PlacedFace, PlateScene, face_truth
from app.values import Floats, Floats32

Image = npt.NDArray[np.uint8]

# === What lies on the road.

_CELL_M, _CELLS = 0.01, 800


@dataclass(frozen=True, slots=True)
class Layer:
    """Loose material on the road and on the plate that lies on it."""

    cover: float  # share of the plate that lies under at least half of the full opacity, 0 to 1
    albedo: Colour  # diffuse reflectance in blue, green, red
    patch_m: float  # [m] size of its patches
    # of the cover's field: 0 is patches anywhere, 1 a bank with one edge; where it comes from, clockwise from ahead
    bank: float = 0.5
    from_deg: float = 90.0
    edge: float = 0.06  # how gradual its edge is, as a share of the field's range
    opacity: float = 1.0  # of its full depth
    grain: float = 0.05  # standard deviation of its brightness from centimetre to centimetre, relative
    seed: int = 0  # of its places


def snow(cover: float, seed: int, *, bank: float = 0.5, from_deg: float = 90.0, patch_m: float = 0.15) -> Layer:
    """Snow, opaque, brighter than the plate's white, slush at its edges."""
    return Layer(cover, (0.9, 0.87, 0.85), patch_m, bank, from_deg, edge=0.05, grain=0.04, seed=seed)


def sand(cover: float, seed: int, *, depth: float = 0.85, from_deg: float = 90.0, patch_m: float = 0.12) -> Layer:
    """Wind-blown sand or dry dust: `depth` 0 to 1 is its opacity where it is deepest, its edges are gradual."""
    return Layer(cover, (0.16, 0.25, 0.34), patch_m, 0.35, from_deg, edge=0.25, opacity=depth, grain=0.12, seed=seed)


def lay(scene: PlateScene, background: Image, layer: Layer) -> tuple[PlateScene, Image]:
    """A scene, and the photo behind it, with a layer on the first face and on the road around it.

    Parameters
    ----------
    scene : PlateScene
        Whose first face is covered; reflectance and emission are hidden alike.
    background : ndarray of uint8, shape (H, W, 3)
        Of the camera's size; its road has the scene's ``road_reflectance``. It is not changed.
    layer : Layer

    Returns
    -------
    scene : PlateScene
        Its road reflectance is that of the covered road, so that the same light falls on the plate as before.
    background : ndarray of uint8, shape (H, W, 3)
    """
    if layer.cover <= 0:
        return scene, background
    first, field = scene.faces[0], _field(scene.faces[0], layer)
    face = first.face
    opacity, material = field.seen_at(_ground_of_texels(first))
    covered = face.reflectance + (material - face.reflectance) * opacity
    emission = None if face.emission is None else np.ascontiguousarray(face.emission * (1 - opacity))
    placed = replace(first, face=replace(face, reflectance=np.ascontiguousarray(covered), emission=emission))
    ground, road = _ground_of_pixels(scene)
    opacity, material = field.seen_at(ground)
    linear = linear_from_srgb()[background]
    shown = linear + (material * _light(scene, linear) - linear) * opacity * road[..., None]
    changed = _relit(scene, linear, shown)
    return replace(scene, faces=(placed, *scene.faces[1:]), road_reflectance=changed), _photo(shown)


@dataclass(frozen=True, slots=True)
class _Field:
    """Depth of a layer around the first face."""

    layer: Layer
    # float32, shape (N, N), columns ahead, rows to the left, repeated beyond by mirroring: -1 to 1, and relative
    # brightness of the material
    patches: Floats32
    grain: Floats32
    # shape (2, 3) to columns and rows; shape (2,): increase of the bank [1/m], from the first face's centre [m]
    cell_from_ground: Floats
    bank_per_m: Floats
    centre_m: Floats
    # depth of half opacity, and width of the edge
    limit: float = 0.0
    width: float = 1.0

    def depth(self, ground_m: Floats) -> Floats32:
        """Depth at spots of the road, shape (...,)."""
        bank = np.clip((ground_m - self.centre_m) @ self.bank_per_m, -2, 2)
        patches = _at(self.patches, self.cell_from_ground, ground_m)
        return np.asarray((1 - self.layer.bank) * patches + self.layer.bank * bank, np.float32)

    def seen_at(self, ground_m: Floats) -> tuple[Floats32, Floats32]:
        """Opacity, shape (..., 1), and reflectance, shape (..., 3), at spots of the road."""
        share = 1 / (1 + np.exp(-np.clip(4 * (self.depth(ground_m) - self.limit) / self.width, -40, 40)))
        grain = 1 + self.layer.grain * _at(self.grain, self.cell_from_ground, ground_m)
        albedo = np.array(self.layer.albedo, np.float32)
        return np.asarray(self.layer.opacity * share[..., None], np.float32), albedo * grain[..., None]


def _field(first: PlacedFace, layer: Layer) -> _Field:
    rng = np.random.default_rng(layer.seed)
    shape = (_CELLS, _CELLS)
    patches = 0.75 * smooth_noise(shape, layer.patch_m / _CELL_M, rng)
    patches += 0.25 * smooth_noise(shape, max(layer.patch_m / _CELL_M / 4, 2), rng)
    grain = 2.8 * cv2.GaussianBlur(rng.standard_normal(shape, dtype=np.float32), (0, 0), 0.8)  # blurred by 1 / 2.8
    angle, centre = math.radians(layer.from_deg), np.array([first.ahead_m, first.left_m])
    towards = np.array([math.cos(angle), -math.sin(angle)]) / first.face.side_m
    matrix = np.column_stack([np.eye(2) / _CELL_M, _CELLS / 2 - 0.5 - centre / _CELL_M])
    field = _Field(layer, np.asarray(2 * patches - 1, np.float32), grain, matrix, towards, centre)
    on_face = field.depth(_ground_of_texels(first))
    limit = float(np.quantile(on_face, 1 - min(layer.cover, 1.0)))
    return replace(field, limit=limit, width=max(layer.edge * float(np.ptp(on_face)), 1e-3))


def _ground_of_texels(placed: PlacedFace) -> Floats:
    """Ground coordinates of the centres of a face's texels, shape (T, T, 2). [m]"""
    size = placed.face.reflectance.shape[0]
    ground_from_texel = cv2.invertAffineTransform(placed.texel_from_ground)
    cols, rows = np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5)
    return np.asarray(np.stack([cols, rows], -1) @ ground_from_texel[:, :2].T + ground_from_texel[:, 2])


def _at(field: Floats32, cell_from_ground: Floats, ground_m: Floats) -> Floats32:
    """Bilinear lookup of a field that goes on as its mirror image."""
    cells = ground_m @ cell_from_ground[:, :2].T + cell_from_ground[:, 2]
    cells = np.clip(cells, -30_000, 30_000) % (2 * (_CELLS - 1))
    cells = np.asarray(np.minimum(cells, 2 * (_CELLS - 1) - cells), np.float32)
    return np.asarray(cv2.remap(field, cells[..., 0].copy(), cells[..., 1].copy(), cv2.INTER_LINEAR), np.float32)


def _light(scene: PlateScene, linear: Floats32) -> Floats32:
    """Radiance of a white diffuser in the photo, as the renderer estimates it."""
    road = np.median(linear[_beside(scene).slices].reshape(-1, 3), axis=0)
    return np.asarray((0.5 * road + 0.5 * road.mean()) / scene.road_reflectance, np.float32)


def _relit(scene: PlateScene, before: Floats32, after: Floats32) -> float:
    """Reflectance of the changed road with which the same light falls on the plate."""
    part = _beside(scene).slices
    medians = [float(np.median(linear[part].reshape(-1, 3), axis=0).mean()) for linear in (before, after)]
    return scene.road_reflectance * medians[1] / max(medians[0], 1e-4)


def _beside(scene: PlateScene) -> Window:
    """The part of the photo from which the renderer takes the light on the first face."""
    truth = face_truth(scene, scene.faces[0])
    width, height = scene.camera.width_px, scene.camera.height_px
    x, y = np.clip(np.nanmean(truth.corners_px, axis=0), 0, (width - 1, height - 1))
    reach_x, reach_y = max(truth.width_px, 24), max(truth.height_px, 16)
    return Window(
        max(int(x - reach_x), 0), max(int(y - reach_y), 0), min(int(x + reach_x) + 1, width),
        min(int(y + reach_y) + 1, height),
    )  # fmt: skip


def _ground_of_pixels(scene: PlateScene) -> tuple[Floats, Floats32]:
    """Where each pixel looks at the road, shape (H, W, 2) [m], and the share of it that is road, 0 at the horizon."""
    rays = _pixel_directions(scene)
    down = np.maximum(-rays[..., 2], 1e-3)
    road = np.clip((-rays[..., 2] / np.linalg.norm(rays, axis=-1) - 0.02) / 0.03, 0, 1)
    return rays[..., :2] * (scene.camera.height_m / down)[..., None], np.asarray(road, np.float32)


def _pixel_directions(scene: PlateScene) -> Floats:
    """Directions of all pixels, by every fourth one, shape (H, W, 3)."""
    height, width = scene.camera.height_px, scene.camera.width_px
    coarse = directions(scene, *np.meshgrid(np.arange(0, width + 4, 4.0), np.arange(0, height + 4, 4.0)))
    cols, rows = np.meshgrid(np.arange(width, dtype=np.float32) / 4, np.arange(height, dtype=np.float32) / 4)
    return np.asarray(cv2.remap(coarse.astype(np.float32), cols, rows, cv2.INTER_LINEAR), np.float64)


def _photo(linear: Floats32) -> Image:
    """A photo of a radiance: inverse of `linear_from_srgb`."""
    v = np.clip(linear, 0, 1)
    encoded = np.where(v <= 0.0031308, 12.92 * v, 1.055 * np.power(np.maximum(v, 1e-6), 1 / 2.4) - 0.055)
    return np.asarray(255 * encoded + 0.5, np.uint8)


# === Water.


@dataclass(frozen=True, slots=True)
class Lamp:
    """A lamp ahead whose light the wet road mirrors: of a traffic light, a sign, a car."""

    # `ahead_m`, `left_m`, `up_m`: [m] in the ground frame
    ahead_m: float
    left_m: float
    up_m: float
    radiance: Colour  # mirrored at the brightest spot of a smooth plate, blue, green, red, as a share of saturation


@dataclass(frozen=True, slots=True)
class Water:
    """A film of water on road and plate."""

    darkening: float = 0.4  # share of its reflectance that porous asphalt loses; the plate's paint loses a quarter
    # radiance of the sky above the horizon ahead, as a share of a white diffuser's on the road: 1 if overcast, less
    # where the film has gaps
    sky: float = 0.5
    # standard deviation of the surface's slopes: of the plate, where drops and ripples are low, and of the asphalt
    plate_slope: float = 0.04
    road_slope: float = 0.12


def wet(scene: PlateScene, background: Image, water: Water, lamps: tuple[Lamp, ...] = ()) -> tuple[PlateScene, Image]:
    """A scene, and the photo behind it, under water: darker, veiled by the mirrored sky, with mirrored lamps.

    Parameters
    ----------
    scene : PlateScene
        Whose first face is wet; what it mirrors is added to its emission.
    background : ndarray of uint8, shape (H, W, 3)
        It is not changed.

    Returns
    -------
    scene : PlateScene
        Its road reflectance is chosen so that the same light falls on the plate as before.
    background : ndarray of uint8, shape (H, W, 3)

    Notes
    -----
    Schlick's approximation of Fresnel's reflectance of water (n = 1.33), and Beckmann's lobe of slopes without its
    normalization: the half vector between eye and lamp tilts by the slope that mirrors the lamp.
    """
    first, night = scene.faces[0], 1.0 if scene.night_light is None else scene.night_light
    ground, road = _ground_of_pixels(scene)
    linear = linear_from_srgb()[background]
    sky = water.sky * _light(scene, linear)
    mirrored = _mirrored(scene, ground, water.road_slope, sky, lamps, 1 / night)
    shown = np.asarray(linear + (mirrored - linear * water.darkening) * road[..., None], np.float32)
    face = first.face
    emission = _mirrored(scene, _ground_of_texels(first), water.plate_slope, sky * night, lamps, 1.0)
    emission = emission if face.emission is None else emission + face.emission
    reflectance = np.ascontiguousarray(face.reflectance * np.float32(1 - water.darkening / 4))
    placed = replace(first, face=replace(face, reflectance=reflectance, emission=np.ascontiguousarray(emission)))
    changed = _relit(scene, linear, shown)
    return replace(scene, faces=(placed, *scene.faces[1:]), road_reflectance=changed), _photo(shown)


def _mirrored(
    scene: PlateScene, ground_m: Floats, slope: float, sky: Floats32, lamps: tuple[Lamp, ...], scale: float
) -> Floats32:
    """Radiance that spots of the road mirror towards the camera, shape (..., 3)."""
    to_eye = np.concatenate([-ground_m, np.full((*ground_m.shape[:-1], 1), scene.camera.height_m)], -1)
    to_eye /= np.linalg.norm(to_eye, axis=-1, keepdims=True)
    fresnel = 0.02 + 0.98 * (1 - np.clip(to_eye[..., 2], 0, 1)) ** 5
    total = np.asarray(fresnel[..., None] * sky, np.float32)
    for lamp in lamps:
        to_lamp = np.array([lamp.ahead_m, lamp.left_m, lamp.up_m]) - np.concatenate(
            [ground_m, np.zeros((*ground_m.shape[:-1], 1))], -1
        )
        to_lamp /= np.linalg.norm(to_lamp, axis=-1, keepdims=True)
        half = to_eye + to_lamp
        tilt2 = (half[..., :2] ** 2).sum(-1) / np.maximum(half[..., 2], 1e-6) ** 2
        lobe = np.exp(-np.minimum(tilt2 / (2 * slope**2), 40)) * min(1.0, (0.04 / slope) ** 2)
        total += np.asarray(lobe[..., None] * np.array(lamp.radiance) * scale, np.float32)
    return total


def mirrored_lamp(
    scene: PlateScene, radiance: Colour, *, away_m: float = 12.0, right_m: float = 0.0, along_m: float = 0.0
) -> Lamp:
    """The lamp whose mirror image lies on the first face, or so far beside (to the right, ahead) its centre. [m]"""
    first = scene.faces[0]
    x, y = first.ahead_m + along_m, first.left_m - right_m
    factor = away_m / max(math.hypot(x, y), 0.1)
    return Lamp(x + factor * x, y + factor * y, factor * scene.camera.height_m, radiance)


# === Dusk, shaking, lenses.


def dusk(scene: PlateScene, light: float, *, longest_exposure_s: float = 1 / 250) -> PlateScene:
    """A scene with a share of the day's light: the camera exposes for longer, and amplifies what is then missing.

    Parameters
    ----------
    light : float
        Share of the light, 0 to 1: 0.1 below heavy clouds, 0.01 at sunset, 0.001 at the end of civil twilight.
    longest_exposure_s : float
        That the camera allows; motion blurs accordingly. [s]
    """
    exposure_s = max(min(scene.exposure_s / light, longest_exposure_s), scene.exposure_s)
    missing = min(scene.exposure_s / exposure_s / light, 1 / light)
    sensor = scene.sensor
    blue = min(1.0, math.log10(1 / light) / 3)  # twilight is bluer than white balance assumes
    blue_gain, green_gain, red_gain = sensor.white_balance
    gains = (blue_gain * (1 + 0.2 * blue), green_gain, red_gain * (1 - 0.15 * blue))
    # amplified: fewer electrons at saturation, while the read noise, in electrons, stays
    darker = replace(sensor, full_well_e=max(sensor.full_well_e / max(missing, 1.0), 60.0), white_balance=gains)
    return replace(scene, exposure_s=exposure_s, sensor=darker)


def shaken(scene: PlateScene, level: float, rng: np.random.Generator) -> PlateScene:
    """A scene on a worse road: ``level`` 1 is what `scene_under` draws, 10 a pothole at the time of the exposure."""
    spin = level * rng.standard_normal(3) * (0.5, 1.5, 0.5)
    body = min(level, 4.0) * rng.standard_normal(3) * (0.3, 0.4, 0.1)
    return replace(
        scene,
        spin_deg_s=(float(spin[0]), float(spin[1]), float(spin[2])),
        body_deg=(float(body[0]), float(body[1]), float(body[2])),
    )


def wide_camera(width_px: int, height_px: int, fov_deg: float, bend: float, **mount: float) -> Camera:
    """A camera whose lens bends straight lines, as a pinhole with OpenCV's rational distortion.

    Parameters
    ----------
    fov_deg : float
        From the left to the right edge, up to 130 degrees. [deg]
    bend : float
        0 is a pinhole, 0.5 stereographic, 1 equidistant: the distance from the centre is that of
        ``f tan((1 - bend) angle) / (1 - bend)``.
    mount : float
        Of `Camera`.
    """
    b = 1 - bend

    def radius(angle: Floats) -> Floats:
        return np.asarray(np.tan(b * angle) / b if b > 1e-6 else angle)

    half = math.radians(fov_deg) / 2
    focal = width_px / 2 / float(radius(np.array(half)))
    corner = math.hypot(width_px, height_px) / 2 / focal
    widest = min(math.atan(b * corner) / b if b > 1e-6 else corner, 1.45)
    angle = np.linspace(0.01, widest, 300)
    square = np.tan(angle) ** 2
    ratio = radius(angle) / np.tan(angle)
    powers = np.stack([square, square**2, square**3], 1)
    k1, k2, k3, k4, k5, k6 = np.linalg.lstsq(np.hstack([powers, -ratio[:, None] * powers]), ratio - 1, rcond=None)[0]
    return Camera(
        width_px, height_px, focal, focal, (width_px - 1) / 2, (height_px - 1) / 2,
        tuple(float(v) for v in (k1, k2, 0, 0, k3, k4, k5, k6)) if bend > 0 else (), **mount,
    )  # fmt: skip
