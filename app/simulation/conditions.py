"""Conditions drawn at random, from a sunny afternoon to every degradation together; drives through them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from app.sensors.camera import Camera
from app.simulation.plate_face import Face, PlateLook, PlateWear, draw_look
from app.simulation.plate_scene import Air, PlacedFace, PlateScene, Sensor, Shadow, face_truth


@dataclass(frozen=True, slots=True)
class Conditions:
    """All of a scene but the plate's code and place."""

    look: PlateLook
    wear: PlateWear
    shadow: Shadow
    air: Air
    sensor: Sensor
    exposure_s: float
    road_reflectance: float
    night_light: float | None = None  # as in PlateScene


def draw_daylight(rng: np.random.Generator) -> Conditions:
    """Fair weather: a new plate, a good dash camera with a global or a rolling shutter, 1/500 to 1/2000 s."""
    return Conditions(
        look=draw_look(rng),
        wear=PlateWear(contrast_loss=_uniform(rng, 0, 0.1), patchy_loss=_uniform(rng, 0, 0.3)),
        shadow=Shadow(),
        air=Air(haze=_uniform(rng, 0, 0.05)),
        sensor=Sensor(
            blur_px=_uniform(rng, 0.4, 0.9),
            full_well_e=_uniform(rng, 3000, 10000),
            read_noise_e=_uniform(rng, 2, 6),
            gain=_uniform(rng, 0.8, 1.2),
            white_balance=(_uniform(rng, 0.93, 1.07), 1.0, _uniform(rng, 0.93, 1.07)),
            gamma=_uniform(rng, 2.0, 2.4),
            shoulder=_uniform(rng, 0.6, 0.95),
            bayer=bool(rng.random() < 0.7),
            sharpen=_uniform(rng, 0, 0.6),
            colour_shift_px=_uniform(rng, -0.3, 0.3),
            readout_s=_uniform(rng, 0.002, 0.012) if rng.random() < 0.5 else 0.0,
            jpeg_quality=int(rng.integers(85, 96)),
        ),
        exposure_s=1 / _uniform(rng, 500, 2000),
        road_reflectance=_uniform(rng, 0.16, 0.32),
    )


def draw_stress(rng: np.random.Generator, *, night: bool = False) -> Conditions:
    """Every degradation drawn at random, several together.

    Parameters
    ----------
    night : bool
        Headlights and lit plates in place of daylight.
    """
    fair = draw_daylight(rng)
    sensor = replace(
        fair.sensor,
        blur_px=_uniform(rng, 0.4, 1.2),
        full_well_e=float(np.exp(rng.uniform(np.log(500), np.log(8000)))),
        read_noise_e=_uniform(rng, 2, 8),
        gain=_uniform(rng, 0.5, 1.5),
        white_balance=(_uniform(rng, 0.75, 1.3), 1.0, _uniform(rng, 0.75, 1.3)),
        sharpen=_uniform(rng, 0, 1.0),
        colour_shift_px=_uniform(rng, -0.6, 0.6),
        readout_s=_uniform(rng, 0, 0.025),
    )
    stressed = replace(
        fair,
        wear=draw_wear(rng),
        shadow=draw_shadow(rng),
        air=_draw_air(rng),
        sensor=sensor,
        exposure_s=1 / float(np.exp(rng.uniform(np.log(250), np.log(2500)))),
    )
    return at_night(stressed, rng) if night else stressed


def draw_wear(rng: np.random.Generator) -> PlateWear:
    """Wear and stains of a plate after years on the road."""
    return PlateWear(
        contrast_loss=_uniform(rng, 0, 0.45),
        patchy_loss=_uniform(rng, 0, 0.75) if rng.random() < 0.7 else 0.0,
        patch_mm=_uniform(rng, 25, 120),
        dirt_blobs=int(rng.integers(0, 5)),
        dirt_mm=_uniform(rng, 6, 22),
    )


def draw_shadow(rng: np.random.Generator) -> Shadow:
    """Shadow edges and leaves, each on some of the plates."""
    return Shadow(
        edge_light=_uniform(rng, 0.2, 0.7) if rng.random() < 0.4 else 1.0,
        edge_angle_deg=_uniform(rng, 0, 360),
        edge_offset_m=_uniform(rng, -0.2, 0.2),
        penumbra_m=_uniform(rng, 0.01, 0.08),
        dapple_light=_uniform(rng, 0.25, 0.8) if rng.random() < 0.35 else 1.0,
        dapple_m=_uniform(rng, 0.06, 0.4),
        dapple_softness=_uniform(rng, 0.05, 0.4),
        seed=int(rng.integers(1 << 31)),
    )


def _draw_air(rng: np.random.Generator) -> Air:
    return Air(
        haze=_uniform(rng, 0, 0.55) if rng.random() < 0.4 else 0.0,
        airlight=_uniform(rng, 0.4, 0.9),
        glare=_uniform(rng, 0.05, 0.35) if rng.random() < 0.3 else 0.0,
        glare_at_m=(_uniform(rng, -0.2, 0.2), _uniform(rng, -0.2, 0.2)),
        glare_size_m=(_uniform(rng, 0.05, 0.2), _uniform(rng, 0.1, 0.5)),
    )


def at_night(conditions: Conditions, rng: np.random.Generator) -> Conditions:
    """The same with headlights and lit plates in place of daylight."""
    look = replace(conditions.look, led=_uniform(rng, 0.15, 0.7))
    sensor = replace(conditions.sensor, full_well_e=_uniform(rng, 150, 800), read_noise_e=_uniform(rng, 2, 6), gain=1.0)
    night = replace(conditions, look=look, sensor=sensor, shadow=Shadow(), air=Air())
    return replace(night, night_light=_uniform(rng, 0.01, 0.15), exposure_s=_uniform(rng, 1 / 500, 1 / 125))


def _uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(rng.uniform(low, high))


# === Drives over a plate: the scenes of the frames in which it is in view.


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """A pass over a square on the road at even speed."""

    camera: Camera
    face: Face
    # `speed_m_s`, `fps`, `exposure_s`: speed, frames a second, exposure time
    speed_m_s: float
    fps: float
    exposure_s: float
    left_m: float = 0.0  # [m] plate's centre left of the camera's path
    rotation_deg: float = 0.0  # [deg] of the plate, clockwise from the vehicle's heading
    far_m: float = 12.0  # [m] distance ahead at which the first frames are taken
    sway_deg: float = 0.15  # [deg] standard deviation of roll and pitch between frames, as springs give it
    road_reflectance: float = 0.22
    shadow: Shadow = field(default_factory=Shadow)
    air: Air = field(default_factory=Air)
    sensor: Sensor = field(default_factory=Sensor)


def drive_over_plate(drive: Drive, rng: np.random.Generator, *, partly: bool = False) -> Iterator[PlateScene]:
    """Scenes of the frames that have the plate in view, far to near; the phase of the first frame is drawn.

    Parameters
    ----------
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
