"""Sets of simulated frames: the paper's trials, stress, night, heated plates, hidden plates, no plate at all.

Every set is made from a seed alone. A set comes in jobs that can be rendered apart.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from app.markers.plate import PlateCode, PlateGeometry
from app.sensors.camera import Camera
from app.simulation.camera import RenderedFrame, render_plate_scene
from app.simulation.conditions import (
    Conditions,
    Drive,
    draw_daylight,
    draw_shadow,
    draw_stress,
    draw_wear,
    drive_over_plate,
)
from app.simulation.plate_face import Face, plate_face
from app.simulation.plate_scene import Air, PlateScene, face_truth
from benchmarks.plates.views import draw_background, draw_camera
from benchmarks.plates.without_plate import DRAW_WITHOUT_PLATE
from benchmarks.scenes.distractors import draw_distractor_faces, paint_distractors
from benchmarks.scenes.places import draw_occluder, draw_place, scene_under
from benchmarks.scenes.thermal import draw_thermal, render_thermal_scene, warm_face

Image = npt.NDArray[np.uint8]
HERE = Path(__file__).parent.parent
GEOMETRY = PlateGeometry()
MIN_ROWS = 4.0  # below this half a row a unit is left: such frames don't count as having the plate in view
RENDERED_ROWS = 8.0  # below this frames are counted as not decoded without a look
LIGHT = ("shadow-edge", "glare", "stains", "stained-shade", "worn", "dapple")
"""Plates of a fair day but for one thing: the edge of a shadow, glare, spots of paint, both spots and a shadow, wear,
leaves' shadows."""
THERMAL_KMH = {"thermal": 10.0, "thermal-20": 20.0, "thermal-30": 30.0}
SETS = ("trial", "stress", "night", "thermal", "hidden", "free", *LIGHT, "thermal-20", "thermal-30", "look-alikes")
WITHOUT_PLATE = tuple(DRAW_WITHOUT_PLATE)
WITH_PLATE = tuple(name for name in SETS if name not in WITHOUT_PLATE)
LIGHT_ROWS, STRESS_ROWS = (12.0, 90.0), (24.0, 140.0)
DRIVE_FRAMES = 5


@dataclass(frozen=True, slots=True)
class Trial:
    """A row of the paper's figures 10, 12 and 13."""

    figure: int
    trial: int
    code: str
    speed_kmh: float
    fps: float
    depression_deg: float
    azimuth_deg: float
    height_m: float
    illumination: str
    frames_detected: int
    frames_decoded: int

    @property
    def camera(self) -> Camera:
        """1080p; a 70 degree lens, and 85 degrees for figure 13's other camera."""
        return Camera.from_field_of_view(
            1920, 1080, 85.0 if self.figure == 13 else 70.0, height_m=self.height_m,
            depression_deg=self.depression_deg, azimuth_deg=self.azimuth_deg,
        )  # fmt: skip

    @property
    def goal(self) -> int:
        """Frames to decode: four times the paper's in figures 10 and 12, the paper's in figure 13."""
        return self.frames_decoded * (1 if self.figure == 13 else 4)


@dataclass(frozen=True, slots=True)
class Job:
    """A part of a set: one trial, or a batch of frames."""

    set_name: str
    index: int
    seed: int
    frames: int
    share: float = 1.0
    peers: bool = False

    @property
    def rng(self) -> np.random.Generator:
        """Random numbers of this job alone."""
        return np.random.default_rng([self.seed, SETS.index(self.set_name), self.index])


@dataclass(slots=True, eq=False)
class Shot:
    """A frame to evaluate."""

    label: str  # where it comes from
    frame: RenderedFrame
    code: PlateCode | None  # on the first face; None where there is no plate
    codebook: tuple[PlateCode, ...]  # of plates registered nearby
    camera: Camera
    # to render it again with other faces, with the ``background`` and the seed of its noise
    scene: PlateScene | None = None
    conditions: Conditions | None = None
    background: Image | None = None
    noise_seed: int = 0
    thermal: bool = False


@dataclass(frozen=True, slots=True)
class Unseen:
    """A frame with the plate in view but so small that it is not rendered."""

    label: str
    height_px: float


@lru_cache(maxsize=1)
def read_trials() -> tuple[Trial, ...]:
    """The paper's trials."""
    with (HERE / "data" / "plate_trials.csv").open(newline="") as lines:
        return tuple(
            Trial(
                int(row["figure"]), int(row["trial"]), row["code"], float(row["speed_kmh"]), float(row["fps"]),
                float(row["depression_deg"]), float(row["azimuth_deg"]), float(row["height_m"]), row["illumination"],
                int(row["frames_detected"]), int(row["frames_decoded"]),
            )
            for row in csv.DictReader(lines)
        )  # fmt: skip


def draw_code(rng: np.random.Generator) -> PlateCode:
    """Any twelve digits: a plain position plate."""
    return PlateCode("".join(str(d) for d in rng.integers(0, 10, 12)))


def draw_codebook(code: PlateCode, rng: np.random.Generator, count: int = 20) -> tuple[PlateCode, ...]:
    """A code among those of plates within about 500 m, which share its leading decimals."""
    lon, lat = int(code.digits[:6]), int(code.digits[6:])
    codes = {code.digits}
    while len(codes) < count:
        d_lon, d_lat = (int(v) for v in rng.integers(-5000, 5001, 2))
        codes.add(f"{(lon + d_lon) % 1_000_000:06d}{(lat + d_lat) % 1_000_000:06d}")
    return tuple(PlateCode(digits) for digits in sorted(codes))


def find_shot(job: Job, number: int) -> Shot | Unseen:
    """One frame of a job by its place."""
    return next(shot for k, shot in enumerate(shoot(job)) if k == number)


def shoot(job: Job) -> Iterator[Shot | Unseen]:
    """Frames of a job."""
    makers = {
        "trial": _trial, "stress": _stress, "night": _stress, "hidden": _hidden,
        **dict.fromkeys(WITHOUT_PLATE, _without_plate), **dict.fromkeys(THERMAL_KMH, _thermal),
        **dict.fromkeys(LIGHT, _light),
    }  # fmt: skip
    return makers[job.set_name](job)


def _shot(
    label: str, scene: PlateScene, background: Image, code: PlateCode | None, codebook: tuple[PlateCode, ...],
    conditions: Conditions, rng: np.random.Generator,
) -> Shot:  # fmt: skip
    noise_seed = int(rng.integers(1 << 31))
    frame = render_plate_scene(scene, background, np.random.default_rng(noise_seed))
    return Shot(label, frame, code, codebook, scene.camera, scene, conditions, background, noise_seed)


# --- the paper's trials -----------------------------------------------------------------------------------------------


def trial_drive(trial: Trial, rng: np.random.Generator) -> tuple[Drive, PlateCode, Conditions]:
    """A drive under a trial's terms; what the paper leaves open is drawn: light, lens, plate's materials and place."""
    code = PlateCode(trial.code) if trial.code else draw_code(rng)
    conditions = draw_daylight(rng)
    if trial.illumination == "bright":
        conditions = replace(
            conditions, sensor=replace(conditions.sensor, gain=1.4), air=Air(glare=0.1, glare_at_m=(0.1, 0.1))
        )
    drive = Drive(
        camera=trial.camera,
        face=plate_face(code, GEOMETRY, conditions.look, conditions.wear, rng),
        speed_m_s=trial.speed_kmh / 3.6,
        fps=trial.fps,
        exposure_s=conditions.exposure_s,
        left_m=float(rng.normal(0, 0.15)),
        rotation_deg=float(rng.normal(0, 3)),
        far_m=18.0,
        road_reflectance=conditions.road_reflectance,
        shadow=conditions.shadow,
        air=conditions.air,
        sensor=conditions.sensor,
    )
    return drive, code, conditions


def _trial(job: Job) -> Iterator[Shot | Unseen]:
    rng, trial = job.rng, read_trials()[job.index]
    drive, code, conditions = trial_drive(trial, rng)
    codebook, background = draw_codebook(code, rng), draw_background(drive.camera, rng)
    label = f"{trial.figure}/{trial.trial}"
    for scene in drive_over_plate(drive, rng):
        height = face_truth(scene, scene.faces[0]).height_px
        if height < MIN_ROWS or rng.random() >= job.share:
            continue
        if height < RENDERED_ROWS:
            yield Unseen(label, height)
        else:
            yield _shot(label, scene, background, code, codebook, conditions, rng)


# --- stress -----------------------------------------------------------------------------------------------------------


def _draw_stress_scene(job: Job, rng: np.random.Generator) -> tuple[PlateScene, Image, PlateCode, Conditions]:
    camera, code = draw_camera(rng), draw_code(rng)
    conditions = draw_stress(rng, night=job.set_name == "night")
    face = plate_face(code, GEOMETRY, conditions.look, conditions.wear, rng)
    return *_draw_stress_view(camera, face, conditions, rng), code, conditions


def _draw_stress_view(
    camera: Camera, face: Face, conditions: Conditions, rng: np.random.Generator
) -> tuple[PlateScene, Image]:
    placed = draw_place(camera, face, rng, STRESS_ROWS)
    extra = draw_distractor_faces(camera, rng, int(rng.integers(0, 4)), (placed,))
    background = paint_distractors(draw_background(camera, rng), rng, int(rng.integers(0, 6)))
    return scene_under(conditions, camera, (placed, *extra), float(rng.uniform(0, 80)) / 3.6, rng), background


def draw_stress_views(face: Face, conditions: Conditions, rng: np.random.Generator) -> list[tuple[PlateScene, Image]]:
    """Views of a plate through different cameras, at different places beside different things."""
    return [_draw_stress_view(draw_camera(rng), face, conditions, rng) for _ in range(DRIVE_FRAMES)]


def _stress(job: Job) -> Iterator[Shot | Unseen]:
    rng = job.rng
    for _ in range(job.frames):
        scene, background, code, conditions = _draw_stress_scene(job, rng)
        yield _shot(job.set_name, scene, background, code, draw_codebook(code, rng), conditions, rng)


def _hidden(job: Job) -> Iterator[Shot | Unseen]:
    """Plates that are partly hidden, or half out of the image: read right or not at all."""
    rng = job.rng
    for k in range(job.frames):
        scene, background, code, conditions = _draw_stress_scene(job, rng)
        if k % 2:
            scene = replace(scene, occluder=draw_occluder(rng))
        else:
            scene = _pushed_out(scene, rng)
        yield _shot("hidden", scene, background, code, draw_codebook(code, rng), conditions, rng)


def _pushed_out(scene: PlateScene, rng: np.random.Generator) -> PlateScene:
    """The scene through a camera whose sensor ends within the plate."""
    corners = face_truth(scene, scene.faces[0]).corners_px
    low, high = corners.min(axis=0), corners.max(axis=0)
    cut = low + (high - low) * rng.uniform(0.1, 0.9, 2)
    camera, axis = scene.camera, int(rng.integers(2))
    shift = np.zeros(2)
    edge = (0.0, float((camera.width_px, camera.height_px)[axis]))[int(rng.integers(2))]
    shift[axis] = edge - cut[axis]
    moved = replace(camera, cx_px=camera.cx_px + float(shift[0]), cy_px=camera.cy_px + float(shift[1]))
    return replace(scene, camera=moved, faces=scene.faces[:1])


# --- light and stains ---------------------------------------------------------------------------------------------


def _light(job: Job) -> Iterator[Shot | Unseen]:
    """Drives of a few frames each, far to near; the label is the drive's."""
    rng = job.rng
    for number in range(job.frames // DRIVE_FRAMES):
        code, conditions = draw_code(rng), draw_light(job.set_name, rng)
        face = plate_face(code, GEOMETRY, conditions.look, conditions.wear, rng)
        scenes = draw_scenes(face, conditions, rng)
        codebook, background = draw_codebook(code, rng), draw_background(scenes[0].camera, rng)
        for scene in scenes:
            yield _shot(f"{job.set_name} {job.index}.{number}", scene, background, code, codebook, conditions, rng)


def draw_scenes(face: Face, conditions: Conditions, rng: np.random.Generator) -> list[PlateScene]:
    """Views of a plate from a camera that passes it, evenly over those of the wanted heights."""
    while True:
        drive = Drive(
            camera=draw_camera(rng),
            face=face,
            speed_m_s=float(rng.uniform(5, 30)),
            fps=30.0,
            exposure_s=conditions.exposure_s,
            left_m=float(rng.normal(0, 0.4)),
            rotation_deg=float(rng.normal(0, 8)),
            far_m=18.0,
            road_reflectance=conditions.road_reflectance,
            shadow=conditions.shadow,
            air=conditions.air,
            sensor=conditions.sensor,
        )
        low, high = LIGHT_ROWS
        seen = [s for s in drive_over_plate(drive, rng) if low <= face_truth(s, s.faces[0]).height_px <= high]
        if len(seen) >= DRIVE_FRAMES:
            return [seen[k] for k in np.linspace(0, len(seen) - 1, DRIVE_FRAMES).round().astype(int)]


def draw_light(name: str, rng: np.random.Generator) -> Conditions:
    """A fair day but for what the set is named after."""
    conditions = draw_daylight(rng)
    if name in {"shadow-edge", "dapple", "stained-shade"}:
        shadow = draw_shadow(rng)
        while (shadow.edge_light == 1 or name == "dapple") and (shadow.dapple_light == 1 or name == "shadow-edge"):
            shadow = draw_shadow(rng)
        edge_light, dapple_light = shadow.edge_light, shadow.dapple_light
        if rng.random() < 0.5:  # deeper
            edge_light, dapple_light = float(rng.uniform(0.12, 0.5)), float(rng.uniform(0.15, 0.5))
        shadow = replace(
            shadow,
            edge_light=edge_light if shadow.edge_light < 1 and name != "dapple" else 1.0,
            dapple_light=dapple_light if shadow.dapple_light < 1 and name != "shadow-edge" else 1.0,
        )
        conditions = replace(conditions, shadow=shadow)
    if name == "glare":
        at_m = (float(rng.uniform(-0.2, 0.2)), float(rng.uniform(-0.2, 0.2)))
        size_m = (float(rng.uniform(0.05, 0.2)), float(rng.uniform(0.1, 0.5)))
        air = Air(glare=float(rng.uniform(0.05, 0.35)), glare_at_m=at_m, glare_size_m=size_m)
        conditions = replace(conditions, air=air)
    if "stain" in name:
        conditions = replace(conditions, wear=replace(conditions.wear, paint_spots=int(rng.integers(1, 4))))
    if name == "worn":
        conditions = replace(conditions, wear=replace(draw_wear(rng), dirt_blobs=0))
    return conditions


# --- heated plates ----------------------------------------------------------------------------------------------------


def _thermal(job: Job) -> Iterator[Shot | Unseen]:
    """A drive with a 640 x 512 thermal camera, from 16 rows on."""
    rng = job.rng
    camera, code = Camera.from_field_of_view(640, 512, 50.0), draw_code(rng)
    warmth, sensor = draw_thermal(rng)
    turn = float(rng.uniform(0, 360)) if job.index % 2 else float(rng.normal(0, 3))
    drive = Drive(
        camera, warm_face(code, GEOMETRY, warmth, rng), THERMAL_KMH[job.set_name] / 3.6, 30.0, 0.01,
        float(rng.normal(0, 0.2)), turn, far_m=8.0,
    )  # fmt: skip
    codebook, background = draw_codebook(code, rng), draw_background(camera, rng)
    for scene in drive_over_plate(drive, rng):
        if face_truth(scene, scene.faces[0]).height_px >= 16 and rng.random() < job.share:
            frame = render_thermal_scene(scene, sensor, background, rng)
            yield Shot(job.set_name, frame, code, codebook, camera, thermal=True)


# --- no plate ---------------------------------------------------------------------------------------------------------


def _without_plate(job: Job) -> Iterator[Shot | Unseen]:
    """Roads without a plate, with a codebook of plates that are not there."""
    rng = job.rng
    for number in range(job.frames):
        scene, background, conditions = DRAW_WITHOUT_PLATE[job.set_name](number, rng)
        yield _shot(job.set_name, scene, background, None, draw_codebook(draw_code(rng), rng), conditions, rng)


def replace_face(shot: Shot, face: Face) -> RenderedFrame:
    """The same frame with another square where the plate lies: same place, light, motion and noise."""
    assert shot.scene is not None
    assert shot.background is not None
    faces = (replace(shot.scene.faces[0], face=face), *shot.scene.faces[1:])
    return render_plate_scene(replace(shot.scene, faces=faces), shot.background, np.random.default_rng(shot.noise_seed))
