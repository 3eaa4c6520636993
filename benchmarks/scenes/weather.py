"""Weather that covers plates and mirrors lights: snow, sand, a wet road, dusk.

A layer of snow or sand lies on the plate and on the road around it alike. Mirrored lights of a wet road add to what the
plate sends, and stay where the lamp is mirrored while the plate passes below.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from app.simulation.camera import linear_from_srgb, tone
from app.simulation.conditions import Conditions, draw_daylight
from app.simulation.plate_face import Face, smooth_noise
from app.simulation.plate_scene import Air, PlateScene, Sensor
from app.values import Floats, Floats32

Image = npt.NDArray[np.uint8]
WEATHER = ("snow", "wet", "dusk", "sand")
LAYER_M, TEXEL_MM = 1.3, 2.0
"""[m, mm] side of the square around the plate that a layer covers, and its resolution."""
PLATE_M = 0.325
_PHOTO = Sensor(gamma=2.2, shoulder=1.0)
"""Encodes radiance as photos do; `linear_from_srgb` decodes it."""
_LAMPS = ((0.15, 1.0, 0.45), (0.15, 1.0, 0.45), (0.08, 0.12, 1.0), (0.08, 0.12, 1.0), (0.1, 0.6, 1.0), (0.8, 0.9, 1.0))
"""Colours of lamps in blue, green, red: traffic lights, tail lights, amber ones, headlights."""


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """What lies on the plate and on the road around it, in the plate's own directions."""

    opacity: Floats32  # shape (T, T): 0 to 1, over a square of `LAYER_M` whose middle is the plate's
    reflectance: Floats32  # shape (T, T, 3)


@dataclass(frozen=True, slots=True)
class MirroredLamp:
    """The streak that a lamp ahead gives on a wet road."""

    colour: tuple[float, float, float]  # radiance in blue, green, red, as a share of saturation
    over_m: float  # distance ahead of the camera at which the plate lies below the streak's middle
    left_m: float  # of the plate's centre, there
    height_m: float  # of the lamp
    size_m: tuple[float, float]  # standard deviations along and across


@dataclass(frozen=True, slots=True, eq=False)
class Weather:
    """One drive's weather."""

    conditions: Conditions
    layer: Layer | None = None
    wet_reflectance: float = 1.0  # of the road and the plate over that in the dry
    lamps: tuple[MirroredLamp, ...] = ()

    def on_face(self, face: Face) -> Face:
        """The plate under the layer of snow or sand, or the film of water."""
        reflectance = face.reflectance * np.float32(1 - 0.3 * (1 - self.wet_reflectance))
        if self.layer is not None:
            size, middle = face.reflectance.shape[0], len(self.layer.opacity) / 2
            half = face.side_m / LAYER_M * len(self.layer.opacity) / 2
            part = slice(round(middle - half), round(middle + half))
            shape = (size, size)
            opacity = cv2.resize(self.layer.opacity[part, part], shape, interpolation=cv2.INTER_LINEAR)[..., None]
            cover = cv2.resize(self.layer.reflectance[part, part], shape, interpolation=cv2.INTER_LINEAR)
            reflectance = reflectance + (cover - reflectance) * opacity
        return replace(face, reflectance=np.ascontiguousarray(reflectance, np.float32))

    def in_scene(self, scene: PlateScene) -> PlateScene:
        """The scene with what is mirrored on its first face at that moment."""
        placed = scene.faces[0]
        if not self.lamps:
            return scene
        size = placed.face.reflectance.shape[0]
        at = ((np.arange(size) + 0.5) / size - 0.5) * placed.face.side_m
        right, down = np.meshgrid(at, at)
        on_face = np.stack([right, -down, np.zeros_like(right)], axis=-1)
        ground = on_face @ placed.ground_from_face.T + (placed.ahead_m, placed.left_m, 0)
        emission = np.ascontiguousarray(self._mirrored(scene, ground[..., :2]), np.float32)
        return replace(scene, faces=(replace(placed, face=replace(placed.face, emission=emission)), *scene.faces[1:]))

    def on_road(self, scene: PlateScene, photo: Image) -> Image:
        """The photo with a wet or covered road."""
        if self.layer is None and not self.lamps:
            return photo
        light = linear_from_srgb()[photo]
        if self.layer is not None:
            light = _under_layer(light, scene, self.layer)
        if self.lamps:
            rows, columns = np.mgrid[0 : photo.shape[0] : 8, 0 : photo.shape[1] : 8].astype(float)
            camera = scene.camera
            points = np.stack([(columns - camera.cx_px) / camera.fx_px, (rows - camera.cy_px) / camera.fy_px], axis=-1)
            rays = points @ scene.camera_from_ground[:2] + scene.camera_from_ground[2]
            on_ground = rays[..., 2] < -0.02
            reach = camera.height_m / np.maximum(-rays[..., 2], 0.02)
            streaks = self._mirrored(scene, rays[..., :2] * reach[..., None]) * on_ground[..., None]
            size = (photo.shape[1], photo.shape[0])
            road = cv2.resize(on_ground.astype(np.float32), size)[..., None]
            light = light * (1 - (1 - self.wet_reflectance) * road)
            light += cv2.resize(streaks.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
        return np.asarray(tone(np.asarray(light, np.float32), _PHOTO) + 0.5, np.uint8)

    def _mirrored(self, scene: PlateScene, ground_m: Floats) -> Floats:
        """Radiance mirrored at points of the road, shape (..., 2) to (..., 3)."""
        height_m, ahead_m = scene.camera.height_m, scene.faces[0].ahead_m
        total = np.zeros((*ground_m.shape[:-1], 3))
        for lamp in self.lamps:
            # the lamp is on the road's far side, fixed to it; its mirror image comes nearer more slowly than the road
            beyond_m = lamp.over_m * lamp.height_m / height_m
            middle_m = (ahead_m + beyond_m) * height_m / (height_m + lamp.height_m)
            left_m = scene.faces[0].left_m + lamp.left_m * middle_m / lamp.over_m
            along = (ground_m[..., 0] - middle_m) / lamp.size_m[0]
            across = (ground_m[..., 1] - left_m * ground_m[..., 0] / middle_m) / lamp.size_m[1]
            total += np.exp(-0.5 * (along**2 + across**2))[..., None] * np.array(lamp.colour)
        return total


def draw_weather(name: str, rng: np.random.Generator) -> Weather:
    """The weather of one drive."""
    conditions = draw_daylight(rng)
    if name == "snow":
        return Weather(conditions, _draw_snow(rng))
    if name == "sand":
        road = replace(conditions, road_reflectance=float(rng.uniform(0.24, 0.36)))
        return Weather(road, _draw_sand(rng))
    if name == "wet":
        film = Air(haze=float(rng.uniform(0.02, 0.2)), airlight=float(rng.uniform(0.4, 0.8)))
        if rng.random() < 0.5:
            at_m = (float(rng.uniform(-0.2, 0.2)), float(rng.uniform(-0.2, 0.2)))
            size_m = (float(rng.uniform(0.06, 0.2)), float(rng.uniform(0.15, 0.5)))
            film = replace(film, glare=float(rng.uniform(0.05, 0.3)), glare_at_m=at_m, glare_size_m=size_m)
        wet = float(rng.uniform(0.4, 0.7))
        dark = replace(conditions, air=film, road_reflectance=conditions.road_reflectance * wet)
        return Weather(dark, None, wet, tuple(_draw_lamp(rng) for _ in range(int(rng.integers(2, 5)))))
    return Weather(_at_dusk(conditions, rng))


def _at_dusk(conditions: Conditions, rng: np.random.Generator) -> Conditions:
    """Little light: the camera exposes for longer, and amplifies its noise."""
    light = float(np.exp(rng.uniform(math.log(0.03), math.log(0.15))))
    amplified = min(float(rng.uniform(0.3, 0.7)) / light, 6.0)
    tint = float(rng.uniform(0.85, 1.15))
    sensor = replace(
        conditions.sensor,
        blur_px=float(rng.uniform(0.5, 1.2)),
        full_well_e=float(rng.uniform(1500, 6000)),
        read_noise_e=float(rng.uniform(3, 8)),
        gain=1.0,
        white_balance=(amplified / tint, amplified, amplified * tint),
        jpeg_quality=int(rng.integers(75, 93)),
    )
    exposure_s = 1 / float(np.exp(rng.uniform(math.log(90), math.log(350))))
    return replace(conditions, sensor=sensor, exposure_s=exposure_s, night_light=light)


def _draw_lamp(rng: np.random.Generator) -> MirroredLamp:
    colour = np.array(_LAMPS[int(rng.integers(len(_LAMPS)))]) * float(
        np.exp(rng.uniform(math.log(0.08), math.log(0.6)))
    )
    blue, green, red = (float(v) for v in colour)
    return MirroredLamp(
        (blue, green, red),
        over_m=float(rng.uniform(1.5, 6.0)),
        left_m=float(rng.uniform(-0.22, 0.22)),
        height_m=float(rng.choice([0.8, 0.8, 2.5, 5.0])),
        size_m=(float(rng.uniform(0.4, 2.0)), float(rng.uniform(0.03, 0.1))),
    )


# === Layers of snow and sand.


def _draw_snow(rng: np.random.Generator) -> Layer:
    """Patches of snow with ragged, soft edges, one of them on a corner of the plate."""
    size = round(LAYER_M * 1000 / TEXEL_MM)
    corner = PLATE_M / 2 - 0.04
    signs = (((-1, -1), (1, -1), (1, 1), (-1, 1))[int(rng.integers(4))],)
    patches = [(signs[0][0] * corner + float(rng.normal(0, 0.012)), signs[0][1] * corner + float(rng.normal(0, 0.012)),
                float(rng.uniform(0.045, 0.09)))]  # fmt: skip
    for _ in range(int(rng.integers(0, 3))):
        patches.append((*rng.uniform(-0.18, 0.18, 2), float(rng.uniform(0.015, 0.05))))
    for _ in range(int(rng.integers(4, 10))):  # beside the plate
        angle, away = float(rng.uniform(0, 2 * math.pi)), float(rng.uniform(0.3, 0.7))
        patches.append((away * math.cos(angle), away * math.sin(angle), float(rng.uniform(0.04, 0.12))))
    at = (np.arange(size) + 0.5) * TEXEL_MM / 1000 - LAYER_M / 2
    x, y = np.meshgrid(at, at)
    ragged = smooth_noise((size, size), 22 / TEXEL_MM, rng) - 0.5 + 0.5 * (smooth_noise((size, size), 4, rng) - 0.5)
    inside = np.full((size, size), -1e9)
    for left, top, radius in patches:
        wide = float(rng.uniform(0.75, 1.3))
        distance = np.hypot((x - left) * wide, (y - top) / wide)
        inside = np.maximum(inside, radius - distance + 0.8 * radius * ragged)
    softness = float(rng.uniform(0.002, 0.012))
    opacity = float(rng.uniform(0.9, 1.0)) / (1 + np.exp(np.clip(-inside / softness, -40, 40)))
    dusting = float(rng.uniform(0, 0.12)) * smooth_noise((size, size), 60 / TEXEL_MM, rng)
    opacity = np.maximum(opacity, dusting)
    return Layer(opacity.astype(np.float32), _surface(size, (0.88, 0.86, 0.83), 0.05, 0.12, rng))


def _draw_sand(rng: np.random.Generator) -> Layer:
    """A thin, uneven layer of warm sand that thickens to a dune over one edge or corner."""
    size = round(LAYER_M * 1000 / TEXEL_MM)
    at = (np.arange(size) + 0.5) * TEXEL_MM / 1000 - LAYER_M / 2
    x, y = np.meshgrid(at, at)
    thin = smooth_noise((size, size), float(rng.uniform(40, 140)) / TEXEL_MM, rng)
    opacity = float(rng.uniform(0.2, 0.6)) + float(rng.uniform(0.1, 0.4)) * (thin - 0.5)
    angle = float(rng.uniform(0, 2 * math.pi))
    along = x * math.cos(angle) + y * math.sin(angle)
    across = y * math.cos(angle) - x * math.sin(angle)
    edge = PLATE_M / 2 - float(rng.uniform(-0.02, 0.09))
    wave = 0.02 * np.sin(across / float(rng.uniform(0.03, 0.1)) + float(rng.uniform(0, 6)))
    dune = 1 / (1 + np.exp(np.clip(-(along - edge + wave) / float(rng.uniform(0.006, 0.03)), -40, 40)))
    opacity = np.clip(np.maximum(opacity, dune), 0, 0.98)
    level = float(rng.uniform(0.28, 0.46))
    colour = (level * float(rng.uniform(0.5, 0.7)), level * float(rng.uniform(0.78, 0.88)), level)
    return Layer(opacity.astype(np.float32), _surface(size, colour, 0.05, 0.1, rng))


def _surface(
    size: int, colour: tuple[float, float, float], grain: float, relief: float, rng: np.random.Generator
) -> Floats32:
    """Reflectance of snow or sand with its grain and its relief."""
    fine = cv2.GaussianBlur(rng.standard_normal((size, size), dtype=np.float32), (0, 0), 1.2) * 4
    shade = 1 + grain * fine + 2 * relief * (smooth_noise((size, size), 30 / TEXEL_MM, rng) - 0.5)
    return np.asarray(np.clip(shade[..., None] * np.array(colour, np.float32), 0, 0.95), np.float32)


def _under_layer(light: Floats32, scene: PlateScene, layer: Layer) -> Floats32:
    """A road's radiance with a layer on it around the plate; the layer is as bright as the light on the road."""
    placed, half = scene.faces[0], LAYER_M / 2
    square = np.array([(-half, half, 0), (half, half, 0), (half, -half, 0), (-half, -half, 0)])
    corners_px = scene.project(square @ placed.ground_from_face.T + (placed.ahead_m, placed.left_m, 0))
    if not np.isfinite(corners_px).all():
        return light
    x, y = (int(v) for v in np.clip(corners_px.mean(axis=0), 0, (light.shape[1] - 1, light.shape[0] - 1)))
    reach = max(int(np.ptp(corners_px[:, 1]) / 4), 8)
    around = light[max(y - reach, 0) : y + reach, max(x - 2 * reach, 0) : x + 2 * reach]
    road = np.median(around.reshape(-1, 3), axis=0)
    white = (0.5 * road + 0.5 * road.mean()) / scene.road_reflectance
    wide, tall = (int(min(max(1.5 * np.ptp(corners_px[:, axis]), 16), len(layer.opacity))) for axis in (0, 1))
    opacity, cover = (cv2.resize(part, (wide, tall), interpolation=cv2.INTER_AREA)
                      for part in (layer.opacity, layer.reflectance))  # fmt: skip
    edge = np.minimum(np.arange(tall)[:, None], np.arange(tall)[::-1, None]) / tall
    edge = np.minimum(edge, np.minimum(np.arange(wide), np.arange(wide)[::-1])[None] / wide)
    opacity = opacity * np.clip(edge * 8, 0, 1).astype(np.float32)  # it thins out towards the square's edge
    source = np.array([(0, 0), (wide, 0), (wide, tall), (0, tall)], np.float32)
    matrix = cv2.getPerspectiveTransform(source, corners_px.astype(np.float32))
    size = (light.shape[1], light.shape[0])
    alpha = cv2.warpPerspective(opacity, matrix, size)[..., None]
    painted = cv2.warpPerspective(cover, matrix, size) * white.astype(np.float32)
    return np.asarray(light + (painted - light) * alpha, np.float32)
