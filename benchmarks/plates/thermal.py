"""Schemes of plates in thermal frames by day and by night, beside colour frames from the same places; warm clutter.

A drive passes one plate with a 640 x 512 camera. The plate is warmer than the road, as heaters and the sun make it, or
colder, as it may be on a clear night.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from app.decoders.plate.reader import decode_plates
from app.markers.plate import PlateCode
from app.sensors.camera import Camera
from app.simulation.camera import render_plate_scene
from app.simulation.conditions import Conditions, Drive, draw_daylight, drive_over_plate
from app.simulation.plate_face import Face, plate_face
from app.simulation.plate_scene import PlateScene, face_truth
from benchmarks.plates.evaluate import find_right
from benchmarks.plates.schemes import CANDIDATES, Candidate, Counts, draw_places
from benchmarks.plates.tables import table
from benchmarks.plates.views import draw_background
from benchmarks.scenes.places import draw_place
from benchmarks.scenes.thermal import draw_thermal, render_thermal_scene, warm_face

ROWS = (12.0, 16.0, 24.0, 32.0, 48.0)
"""[px] heights of the plate's image by which frames are counted; one frame is taken in each interval, and one above."""
SPEEDS_KMH = (10.0, 20.0, 30.0)
CAMERA = Camera.from_field_of_view(640, 512, 50.0)
CLUTTER = 60  # [frames] without a plate for each number of a drive


@dataclass(frozen=True, slots=True)
class ThermalDrive:
    """A drive to evaluate."""

    seed: int
    index: int

    @property
    def speed_kmh(self) -> float:
        """Of three speeds in turn."""
        return SPEEDS_KMH[self.index % 3]

    @property
    def is_cold(self) -> bool:
        """Whether the plate is colder than the road: in every other three drives."""
        return self.index // 3 % 2 == 1


@dataclass(frozen=True, slots=True)
class ThermalRecord:
    """A frame of one scheme, or one without a plate."""

    drive: ThermalDrive
    name: str
    height_px: float
    thermal: Counts
    known: Counts | None = None  # with the registry
    colour: Counts | None = None  # in a colour frame from the same place
    thermal_ms: float = 0.0  # processor time of the thermal frame


def evaluate_thermal(drive: ThermalDrive) -> list[ThermalRecord]:
    """Render and read a drive with every scheme, and frames of warm clutter."""
    cv2.setNumThreads(1)
    return [record for candidate in CANDIDATES for record in _pass(drive, candidate)] + list(_clutter(drive))


def _pass(drive: ThermalDrive, candidate: Candidate) -> Iterator[ThermalRecord]:
    """One frame of the plate in each interval of heights, in both kinds of light."""
    rng = np.random.default_rng([drive.seed, 31, drive.index])
    codes = [candidate.code(*place) for place in draw_places(rng)]
    warmth, sensor = draw_thermal(rng)
    face = warm_face(codes[0], candidate.geometry, warmth, rng)
    if drive.is_cold:
        assert face.emission is not None
        face, sensor = replace(face, emission=-face.emission), replace(sensor, road_level=255 - sensor.road_level)
    conditions = draw_daylight(rng)
    coloured = plate_face(codes[0], candidate.geometry, conditions.look, conditions.wear, rng)
    turn_deg = float(rng.uniform(0, 360)) if drive.index % 2 else float(rng.normal(0, 3))
    background = draw_background(CAMERA, rng)
    for scene in _scenes(face, drive.speed_kmh / 3.6, turn_deg, rng):
        height_px = face_truth(scene, scene.faces[0]).height_px
        frame = render_thermal_scene(scene, sensor, background, rng)
        seen, thermal_ms = _read(frame.image, codes[0], frame.truths[0], thermal=True)
        known, _ms = _read(frame.image, codes[0], frame.truths[0], thermal=True, codebook=tuple(codes))
        colour = _in_colour(scene, coloured, conditions, codes[0], background, rng)
        yield ThermalRecord(drive, candidate.name, height_px, seen, known, colour, thermal_ms)


def _scenes(face: Face, speed_m_s: float, turn_deg: float, rng: np.random.Generator) -> Iterator[PlateScene]:
    drive = Drive(CAMERA, face, speed_m_s, 120.0, 0.01, float(rng.normal(0, 0.2)), turn_deg, far_m=10.0)
    scenes = list(drive_over_plate(drive, rng))
    heights = np.array([face_truth(scene, scene.faces[0]).height_px for scene in scenes])
    for low, high in zip(ROWS, (*ROWS[1:], np.inf), strict=True):
        places = np.flatnonzero((heights >= low) & (heights < high))
        if len(places):
            yield scenes[int(rng.choice(places))]


def _in_colour(
    scene: PlateScene, face: Face, conditions: Conditions, code: PlateCode, background: Any, rng: np.random.Generator
) -> Counts:
    lit = replace(
        scene, faces=(replace(scene.faces[0], face=face),), exposure_s=conditions.exposure_s,
        road_reflectance=conditions.road_reflectance, shadow=conditions.shadow, air=conditions.air,
        sensor=conditions.sensor,
    )  # fmt: skip
    frame = render_plate_scene(lit, background, rng)
    return _read(frame.image, code, frame.truths[0])[0]


def _read(image: npt.NDArray[np.uint8], code: PlateCode | None, truth: Any, **options: Any) -> tuple[Counts, float]:
    began = time.process_time()
    readings = decode_plates(image, camera=CAMERA, **options)
    elapsed_ms = 1e3 * (time.process_time() - began)
    hit, wrong = find_right(readings, code, truth)
    return Counts(int(hit is not None), wrong), elapsed_ms


# --- warm clutter -----------------------------------------------------------------------------------------------------


def _clutter(drive: ThermalDrive) -> Iterator[ThermalRecord]:
    """Warm and cold things that are no plates: discs, patches, gratings, grids with and without warm corners."""
    rng = np.random.default_rng([drive.seed, 32, drive.index])
    for _ in range(CLUTTER):
        _warmth, sensor = draw_thermal(rng)
        faces = tuple(draw_place(CAMERA, _thing(rng), rng, (12.0, 90.0)) for _ in range(int(rng.integers(0, 4))))
        scene = PlateScene(
            CAMERA, faces or (draw_place(CAMERA, _empty(), rng, (12.0, 90.0)),), float(rng.uniform(3, 9))
        )
        frame = render_thermal_scene(scene, sensor, draw_background(CAMERA, rng), rng)
        seen, thermal_ms = _read(frame.image, None, None, thermal=True)
        yield ThermalRecord(drive, "no plate", np.nan, seen, thermal_ms=thermal_ms)


def _empty() -> Face:
    return Face(0.3, np.zeros((2, 2, 3), np.float32))


def _thing(rng: np.random.Generator) -> Face:
    """A square face with something warm on it, 0.2 to 0.6 m wide."""
    size, kind = 96, int(rng.integers(5))
    heat = float(rng.uniform(4, 20)) * (1 if rng.random() < 0.7 else -1)
    y, x = np.mgrid[0:size, 0:size] / size
    if kind == 0:
        shape = (np.hypot(x - 0.5, y - 0.5) < 0.5).astype(np.float32)
    elif kind == 1:
        shape = np.ones((size, size), np.float32)
    elif kind == 2:
        bars = int(rng.integers(3, 12))
        shape = (np.floor(x * (2 * bars + 1)) % 2 == 0).astype(np.float32)
    else:
        cells = int(rng.integers(4, 14))
        grid = (rng.random((cells, cells)) < rng.uniform(0.3, 0.7)).astype(np.float32)
        if kind == 4:
            for row, column in ((0, 0), (0, -2), (-2, 0), (-2, -2)):
                grid[row : row + 2 or None, column : column + 2 or None] = 1.0
        shape = cv2.resize(grid, (size, size), interpolation=cv2.INTER_NEAREST)
    warm = np.repeat((heat * cv2.GaussianBlur(shape, (0, 0), 1.0))[..., None], 3, axis=2)
    return Face(float(rng.uniform(0.2, 0.6)), np.zeros((size, size, 3), np.float32), warm.astype(np.float32))


# --- the tables -------------------------------------------------------------------------------------------------------


def thermal_table(records: Sequence[ThermalRecord]) -> str:
    """Frames read by scheme, polarity and height of the plate's image, beside the colour frames; then the times."""
    rows: list[tuple[object, ...]] = []
    plates = [r for r in records if r.name != "no plate"]
    for name in dict.fromkeys(r.name for r in plates):
        for low, high in zip(ROWS, (*ROWS[1:], np.inf), strict=True):
            mine = [r for r in plates if r.name == name and low <= r.height_px < high]
            if not mine:
                continue
            warm, cold = ([r for r in mine if r.drive.is_cold is cold] for cold in (False, True))
            read = [f"{sum(r.thermal.read for r in some)} of {len(some)}" for some in (warm, cold)]
            ways = [[one for one in way if one is not None] for way in (
                [r.thermal for r in mine], [r.colour for r in mine], [r.known for r in mine],
            )]  # fmt: skip
            shares = (f"{100 * np.mean([one.read for one in way]):.0f}" for way in ways)
            wrong = [sum(len(one.wrong) for one in way) for way in ways]
            interval = f"{low:g} rows and more" if np.isinf(high) else f"{low:g}-{high:g} rows"
            rows.append((f"{name}, {interval}", *read, *shares, wrong[0] + wrong[2], wrong[1]))
    head = (
        "scheme, rows",
        "warm",
        "cold",
        "thermal %",
        "colour %",
        "thermal with registry %",
        "wrong",
        "wrong in colour",
    )
    return f"{table(head, rows)}\n\n{_times_table(records)}"


def _times_table(records: Sequence[ThermalRecord]) -> str:
    rows = []
    for name, mine in (
        ("with a plate", [r for r in records if r.name != "no plate"]),
        ("no plate", [r for r in records if r.name == "no plate"]),
    ):
        if mine:
            times = np.array([r.thermal_ms for r in mine])
            wrong = sum(len(r.thermal.wrong) for r in mine)
            cells = (f"{np.median(times):.0f}", f"{times.mean():.0f}", f"{np.percentile(times, 95):.0f}")
            rows.append((name, len(mine), wrong, *cells, f"{times.max():.0f}"))
    return table(("thermal frames", "frames", "wrong", "median ms", "mean ms", "95 % ms", "worst ms"), rows)
