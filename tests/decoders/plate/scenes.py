"""Small frames of plates on the road, with the truth about them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from app.markers.plate import PlateCode, PlateGeometry
from app.sensors.camera import Camera
from app.simulation.backgrounds import road_background
from app.simulation.camera import RenderedFrame, render_plate_scene
from app.simulation.plate_face import Face, PlateLook, PlateWear, plate_face
from app.simulation.plate_scene import PlacedFace, PlateScene, Sensor
from benchmarks.scenes.thermal import PlateWarmth, ThermalSensor, render_thermal_scene, warm_face

Image = npt.NDArray[np.uint8]
BACKGROUNDS = Path(__file__).parents[3] / "benchmarks" / "backgrounds"
CAMERA = Camera.from_field_of_view(960, 540, 60.0, height_m=1.5, depression_deg=25.0)
THERMAL_CAMERA = Camera.from_field_of_view(640, 512, 50.0)
PAPER = PlateCode("023792168411")
AHEAD_M = 3.0  # about 40 rows


@lru_cache
def photo(name: str) -> Image:
    """A real road photo."""
    return np.asarray(cv2.imread(str(BACKGROUNDS / name)), np.uint8)


@lru_cache
def road(name: str = "adv_test1.jpg", camera: Camera = CAMERA) -> Image:
    """A real road as the camera sees it."""
    return road_background(photo(name), camera, np.random.default_rng(5))


def face_of(
    code: PlateCode = PAPER, geometry: PlateGeometry | None = None, *, wear: PlateWear | None = None, seed: int = 0
) -> Face:
    """A plate's face, new unless worn."""
    return plate_face(
        code, geometry or PlateGeometry(code.n), PlateLook(), wear or PlateWear(), np.random.default_rng(seed)
    )


def painted(face: Face, cells: dict[tuple[int, int], tuple[float, float, float]], n: int = 8) -> Face:
    """The face with units (row, column) painted over, gaps included; colours in blue, green, red."""
    reflectance = face.reflectance.copy()
    edges = np.round(np.linspace(0, reflectance.shape[0], n + 1)).astype(int)
    for (row, column), colour in cells.items():
        reflectance[edges[row] : edges[row + 1], edges[column] : edges[column + 1]] = colour
    return replace(face, reflectance=reflectance)


def marker_units(corner: str, n: int = 8) -> list[tuple[int, int]]:
    """Units of a corner cell, e.g. ``top-left``."""
    rows = (0, 1) if corner.startswith("top") else (n - 2, n - 1)
    columns = (0, 1) if corner.endswith("left") else (n - 2, n - 1)
    return [(r, c) for r in rows for c in columns]


def shoot(
    *faces: PlacedFace,
    camera: Camera = CAMERA,
    seed: int = 1,
    sensor: Sensor | None = None,
    background: Image | None = None,
    change: Callable[[PlateScene], PlateScene] = lambda scene: scene,
) -> RenderedFrame:
    """A frame of faces on a real road."""
    scene = change(PlateScene(camera, faces, speed_m_s=5.0, sensor=sensor or Sensor()))
    photo_behind = road(camera=camera) if background is None else background
    return render_plate_scene(scene, photo_behind, np.random.default_rng(seed))


def shoot_plate(
    code: PlateCode = PAPER, *, ahead_m: float = AHEAD_M, left_m: float = 0.0, turn_deg: float = 0.0, seed: int = 1
) -> RenderedFrame:
    """A frame of one new plate."""
    return shoot(PlacedFace(face_of(code), ahead_m, left_m, turn_deg), seed=seed)


def shoot_warm(code: PlateCode, turn_deg: float, *, ahead_m: float = 2.6, seed: int = 3) -> RenderedFrame:
    """A thermal frame of one heated plate."""
    face = warm_face(code, PlateGeometry(code.n), PlateWarmth(), np.random.default_rng(seed))
    scene = PlateScene(THERMAL_CAMERA, (PlacedFace(face, ahead_m, 0.1, turn_deg),))
    return render_thermal_scene(scene, ThermalSensor(), None, np.random.default_rng(seed))
