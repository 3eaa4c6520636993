"""A simulated drive past plates as an H.264 video, rendered cheaply.

The road is a photo whose ground moves towards the camera, rendered once for a loop of frames. A whole scene with its
light, wear, motion blur, rolling shutter and noise is rendered only where a plate is in view. Exposure drifts along the
drive, and the encoder adds its artefacts.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from app.markers.plate import PlateCode, PlateGeometry, PlateScheme
from app.sensors.camera import Camera
from app.simulation.backgrounds import moving_backgrounds, road_photos
from app.simulation.camera import render_plate_scene
from app.simulation.conditions import Conditions, draw_daylight, draw_stress
from app.simulation.plate_face import plate_face
from app.simulation.plate_scene import PlacedFace, PlateScene, face_truth

LOOP_FRAMES = 16
"""[frames] of moving road before it begins again. Source: chosen by hand, for memory."""
HARD_SHARE = 0.7
"""[1] of the plates under drawn degradations, the others in fair weather. Source: chosen by hand."""
FAR_M = 14.0
"""[m] ahead of the camera from which plates are rendered. Source: by hand; farther ones have fewer than 10 rows."""


@dataclass(frozen=True, slots=True)
class PassedPlate:
    """A plate of a drive."""

    code: PlateCode
    at_m: float  # [m] along the drive
    frames: tuple[int, ...]  # in which all of it is in view
    is_hard: bool  # under drawn degradations


@dataclass(frozen=True, slots=True)
class DriveShape:
    """A drive to simulate: duration [s], frames a second [Hz], speed [m/s], distance of plates [m], seed."""

    duration_s: float = 600.0
    rate_hz: float = 30.0
    speed_m_s: float = 25.0
    spacing_m: float = 60.0
    seed: int = 1
    readout_s: float = 0.0

    @property
    def frames(self) -> int:
        """Number of frames."""
        return round(self.duration_s * self.rate_hz)


CAMERA = Camera.from_field_of_view(1920, 1080, 70.0)


@dataclass(frozen=True, slots=True, eq=False)
class _Plate:
    code: PlateCode
    at_m: float
    left_m: float
    conditions: Conditions
    face: Any
    is_hard: bool


def write_drive(path: Path, shape: DriveShape, *, preset: str = "veryfast", crf: int = 23) -> list[PassedPlate]:
    """Render and encode a drive; returns the truth."""
    import av

    with av.open(str(path), "w", format="mp4") as container:
        stream: Any = container.add_stream("libx264", rate=round(shape.rate_hz))
        stream.width, stream.height, stream.pix_fmt = CAMERA.width_px, CAMERA.height_px, "yuv420p"
        stream.options = {"preset": preset, "crf": str(crf), "g": str(round(2 * shape.rate_hz))}
        stream.codec_context.thread_count = 1
        seen: dict[float, list[int]] = {}
        plates = list(_place_plates(shape))
        for number, image in enumerate(_render(shape, plates, seen)):
            frame = av.VideoFrame.from_ndarray(image, format="bgr24")
            frame.pts = number
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return [PassedPlate(p.code, p.at_m, tuple(seen.get(p.at_m, ())), p.is_hard) for p in plates]


def kept_drive(path: Path, shape: DriveShape, *, preset: str, crf: int) -> list[PassedPlate]:
    """The truth of a drive that an earlier run left in the folder, else of one that is rendered there."""
    truth_path = path.with_suffix(".json")
    if not truth_path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        truth = write_drive(path, shape, preset=preset, crf=crf)
        rows = [(p.code.digits, p.code.scheme, p.at_m, p.frames, p.is_hard) for p in truth]
        truth_path.write_text(json.dumps(rows))
    return [
        PassedPlate(PlateCode(digits, PlateScheme(scheme)), at_m, tuple(frames), is_hard)
        for digits, scheme, at_m, frames, is_hard in json.loads(truth_path.read_text())
    ]


def _place_plates(shape: DriveShape) -> Iterator[_Plate]:
    rng = np.random.default_rng([shape.seed, 1])
    geometry = PlateGeometry(8)
    at_m = shape.spacing_m / 2
    while at_m < shape.duration_s * shape.speed_m_s:
        is_hard = bool(rng.random() < HARD_SHARE)
        conditions = draw_stress(rng) if is_hard else draw_daylight(rng)
        code = (
            PlateCode.from_registry_number(int(rng.integers(1 << 32)))
            if rng.random() < 0.5
            else PlateCode.from_position(114.0 + float(rng.random()), 22.0 + float(rng.random()))
        )
        face = plate_face(code, geometry, conditions.look, conditions.wear, rng)
        # the encoder takes the place of JPEG; the shutter is the camera's
        sensor = replace(conditions.sensor, jpeg_quality=None, readout_s=shape.readout_s)
        yield _Plate(
            code, at_m, float(rng.uniform(-0.8, 0.8)), replace(conditions, sensor=sensor), face, is_hard
        )  # fmt: skip
        at_m += shape.spacing_m * float(rng.uniform(0.7, 1.3))


def _render(shape: DriveShape, plates: list[_Plate], seen: dict[float, list[int]]) -> Iterator[Any]:
    rng = np.random.default_rng([shape.seed, 2])
    step_m = shape.speed_m_s / shape.rate_hz
    loops = [moving_backgrounds(photo, CAMERA, rng, step_m, LOOP_FRAMES) for photo in road_photos()]
    sway = np.zeros(2)
    keep = math.exp(-2 * math.pi * 1.5 / shape.rate_hz)  # bodies sway at about 1.5 Hz
    for number in range(shape.frames):
        at_m = number * step_m
        loop = loops[int(at_m // 400) % len(loops)]
        background = loop[number % LOOP_FRAMES]
        sway = keep * sway + math.sqrt(1 - keep**2) * 0.15 * rng.standard_normal(2)
        shake = rng.standard_normal(3) * (0.3, 0.8, 0.2)
        plate = next((p for p in plates if -1.0 < p.at_m - at_m < FAR_M), None)
        if plate is None:
            yield background
            continue
        conditions = plate.conditions
        drift = 1 + 0.25 * math.sin(0.9 * number / shape.rate_hz)  # exposure control that hunts
        scene = PlateScene(
            camera=CAMERA,
            faces=(PlacedFace(plate.face, plate.at_m - at_m, plate.left_m),),
            speed_m_s=shape.speed_m_s,
            exposure_s=conditions.exposure_s,
            spin_deg_s=(float(shake[0]), float(shake[1]), float(shake[2])),
            body_deg=(float(sway[0]), float(sway[1]), 0.0),
            road_reflectance=conditions.road_reflectance,
            shadow=conditions.shadow,
            air=conditions.air,
            sensor=replace(conditions.sensor, gain=conditions.sensor.gain * drift),
        )
        truth = face_truth(scene, scene.faces[0])
        if truth.in_view:
            seen.setdefault(plate.at_m, []).append(number)
        yield render_plate_scene(scene, background, rng).image if truth.partly_in_view else background
