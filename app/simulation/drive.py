"""Drives over a plate: the scenes of the frames in which it is in view."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from app.sensors.camera import Camera
from app.simulation.plate_face import Face
from app.simulation.plate_scene import Air, PlacedFace, PlateScene, Sensor, Shadow, face_truth


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """A pass over a square on the road at even speed.

    Parameters
    ----------
    camera : Camera
    face : Face
    speed_m_s, fps, exposure_s : float
        Speed, frames a second, exposure time.
    left_m : float
        Plate's centre left of the camera's path. [m]
    rotation_deg : float
        Of the plate, clockwise from the vehicle's heading. [deg]
    far_m : float
        Distance ahead at which the first frames are taken. [m]
    sway_deg : float
        Standard deviation of roll and pitch between frames, as springs give it. [deg]
    """

    camera: Camera
    face: Face
    speed_m_s: float
    fps: float
    exposure_s: float
    left_m: float = 0.0
    rotation_deg: float = 0.0
    far_m: float = 12.0
    sway_deg: float = 0.15
    road_reflectance: float = 0.22
    shadow: Shadow = field(default_factory=Shadow)
    air: Air = field(default_factory=Air)
    sensor: Sensor = field(default_factory=Sensor)


def drive_over_plate(drive: Drive, rng: np.random.Generator, *, partly: bool = False) -> Iterator[PlateScene]:
    """Scenes of the frames that have the plate in view, far to near; the phase of the first frame is drawn.

    Parameters
    ----------
    drive : Drive
    rng : numpy.random.Generator
        Draws phase, sway and shake.
    partly : bool
        Also those that see only part of it.
    """
    step_m = drive.speed_m_s / drive.fps
    ahead_m = drive.far_m - rng.random() * step_m
    sway = np.zeros(2)
    keep = math.exp(-2 * math.pi * 1.5 / drive.fps)  # bodies sway at about 1.5 Hz
    while ahead_m > -drive.face.side_m:
        sway = keep * sway + math.sqrt(1 - keep**2) * drive.sway_deg * rng.standard_normal(2)
        shake = rng.standard_normal(3) * (0.3, 0.8, 0.2)
        scene = PlateScene(
            camera=drive.camera,
            faces=(PlacedFace(drive.face, ahead_m, drive.left_m, drive.rotation_deg),),
            speed_m_s=drive.speed_m_s,
            exposure_s=drive.exposure_s,
            spin_deg_s=(float(shake[0]), float(shake[1]), float(shake[2])),
            body_deg=(float(sway[0]), float(sway[1]), 0.0),
            road_reflectance=drive.road_reflectance,
            shadow=drive.shadow,
            air=drive.air,
            sensor=drive.sensor,
        )
        truth = face_truth(scene, scene.faces[0])
        if truth.in_view or (partly and truth.partly_in_view):
            yield scene
        ahead_m -= step_m
