"""Places of plates on the road, drawn at random, and scenes of them under drawn conditions."""

from __future__ import annotations

import numpy as np

from app.errors import InvalidParameter
from app.sensors.camera import Camera
from app.simulation.conditions import Conditions
from app.simulation.plate_face import Face
from app.simulation.plate_scene import Occluder, PlacedFace, PlateScene, face_truth


def draw_place(
    camera: Camera,
    face: Face,
    rng: np.random.Generator,
    rows_px: tuple[float, float],
    rotation_deg: float | None = None,
) -> PlacedFace:
    """A place on the road where the whole face is in view and its image is within a range of heights.

    Parameters
    ----------
    camera : Camera
    face : Face
    rng : numpy.random.Generator
    rows_px : tuple of float
        Least and greatest height of its image; heights in between are drawn evenly in the logarithm. [px]
    rotation_deg : float, optional
        Drawn from the full circle if not given.

    Raises
    ------
    InvalidParameter
        This camera sees no face at such a height.
    """
    wanted = float(np.exp(rng.uniform(*np.log(rows_px))))
    for _ in range(200):
        turn = _uniform(rng, 0, 360) if rotation_deg is None else rotation_deg
        side = _uniform(rng, -0.5, 0.5)
        low, high = 0.3, 40.0
        for _ in range(40):  # image height falls with distance
            ahead = (low + high) / 2
            placed = PlacedFace(face, ahead, side * ahead, turn)
            truth = face_truth(PlateScene(camera, (placed,)), placed)
            low, high = (ahead, high) if not truth.height_px <= wanted else (low, ahead)
        if truth.in_view and rows_px[0] <= truth.height_px <= rows_px[1] + 0.01:
            return placed
        wanted = float(np.exp(rng.uniform(*np.log(rows_px))))
    raise InvalidParameter(f"this camera never sees a face {rows_px[0]:g} to {rows_px[1]:g} rows high", field="rows_px")


def scene_under(
    conditions: Conditions, camera: Camera, faces: tuple[PlacedFace, ...], speed_m_s: float, rng: np.random.Generator
) -> PlateScene:
    """Scene of placed faces under drawn conditions, the vehicle shaking as vehicles do."""
    shake = rng.standard_normal(3) * (0.5, 1.5, 0.5)
    return PlateScene(
        camera=camera,
        faces=faces,
        speed_m_s=speed_m_s,
        exposure_s=conditions.exposure_s,
        spin_deg_s=(float(shake[0]), float(shake[1]), float(shake[2])),
        road_reflectance=conditions.road_reflectance,
        night_light=conditions.night_light,
        shadow=conditions.shadow,
        air=conditions.air,
        sensor=conditions.sensor,
    )


def draw_occluder(rng: np.random.Generator) -> Occluder:
    """Something dark or bright that hides 5 to 60 % of the plate."""
    return Occluder(_uniform(rng, 0, 360), _uniform(rng, 0.05, 0.6), _uniform(rng, 0.01, 0.6), _uniform(rng, 0.5, 4))


def _uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(rng.uniform(low, high))
