"""Scenes without a plate: roads and photos as they are, things that share a plate's colours, and look-alikes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from app.simulation.conditions import Conditions, draw_daylight, draw_stress
from app.simulation.plate_scene import PlacedFace, PlateScene
from benchmarks.plates.lookalikes import draw_flat, paint_upright
from benchmarks.plates.views import draw_background, draw_camera, draw_crop
from benchmarks.scenes.distractors import draw_distractor_faces, paint_distractors
from benchmarks.scenes.places import scene_under

Image = npt.NDArray[np.uint8]
Drawn = tuple[PlateScene, Image, Conditions]
"""A scene, the photo behind it and its conditions."""


def draw_free(number: int, rng: np.random.Generator) -> Drawn:
    """Crops of photos as they are, mirrored, in other colours, and with distractors, by the number of the frame."""
    camera = draw_camera(rng)
    background = draw_background(camera, rng) if number % 3 == 0 else draw_crop(camera, rng)
    if number % 2:
        background = paint_distractors(background, rng, int(rng.integers(3, 25)))
    faces: tuple[PlacedFace, ...] = ()
    if number % 4 >= 2:
        faces = draw_distractor_faces(camera, rng, int(rng.integers(1, 7)))
    conditions = draw_stress(rng) if rng.random() < 0.5 else draw_daylight(rng)
    return scene_under(conditions, camera, faces, float(rng.uniform(0, 80)) / 3.6, rng), background, conditions


def draw_look_alikes(_number: int, rng: np.random.Generator) -> Drawn:
    """Roads full of what resembles a plate: QR codes, tiles, chessboards, panels, signs, markings, decoys."""
    camera = draw_camera(rng)
    background = draw_background(camera, rng) if rng.random() < 0.5 else draw_crop(camera, rng)
    background = paint_upright(background, rng, int(rng.integers(0, 9)))
    faces = draw_flat(camera, rng, int(rng.integers(1, 8)))
    conditions = draw_stress(rng) if rng.random() < 0.5 else draw_daylight(rng)
    return scene_under(conditions, camera, faces, float(rng.uniform(0, 80)) / 3.6, rng), background, conditions


DRAW_WITHOUT_PLATE: dict[str, Callable[[int, np.random.Generator], Drawn]] = {
    "free": draw_free, "look-alikes": draw_look_alikes,
}  # fmt: skip
