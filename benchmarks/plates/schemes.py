"""Schemes of plates in the same scenes, under the same light and the same stains, and tags beside them.

A drive is one plate, with its stains and its light, in frames from far to near; under stress, in frames of different
cameras. Every scheme, and every tag, lies in the same place in the same size, and gets the same stains.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from app.decoders.plate.accumulate import confirm_drive
from app.decoders.plate.confirm import DriveFrame, list_expected, with_expected
from app.decoders.plate.follow_plate import expect_plate, find_expected
from app.decoders.plate.pose import with_pose
from app.decoders.plate.reader import decode_plates
from app.markers.plate import PlateCode, PlateGeometry, PlateScheme, recommended_geometry
from app.markers.reading import PlateReading
from app.sensors.camera import Camera
from app.simulation.camera import render_plate_scene
from app.simulation.conditions import draw_stress
from app.simulation.plate_face import Face, plate_face
from app.simulation.plate_scene import FaceTruth, PlateScene, face_truth
from benchmarks.plates.evaluate import find_right
from benchmarks.plates.peers import FAMILIES, reads_tag, tag_face
from benchmarks.plates.sets import draw_light, draw_scenes, draw_stress_views
from benchmarks.plates.tables import table
from benchmarks.plates.views import draw_background
from benchmarks.scenes.weather import WEATHER, Weather, draw_weather

SCHEME_SETS = ("fair", "shadow-edge", "dapple", "glare", "stains", "stained-shade", "worn", "stress", *WEATHER)
NEIGHBOURS = 20
"""[plates] of the registry within about 500 m of the plate, the plate among them."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A scheme on a size, of the same outer edge of 325 mm."""

    scheme: PlateScheme
    geometry: PlateGeometry
    check_digits: int = 0

    @property
    def name(self) -> str:
        """Scheme and size, for the table."""
        digits = f", {self.check_digits} check digits" if self.check_digits > 1 else ""
        return f"{self.scheme} {self.geometry.n} x {self.geometry.n}{digits}"

    def code(self, lon_deg: float, lat_deg: float, number: int) -> PlateCode:
        """The code of a plate at a place, or with a number."""
        if self.scheme is PlateScheme.ID:
            return PlateCode.from_registry_number(number, n=self.geometry.n)
        return PlateCode.from_position(
            lon_deg, lat_deg, n=self.geometry.n, scheme=self.scheme, check_digits=self.check_digits
        )


_FINE = recommended_geometry(PlateScheme.POSITION_ROBUST)
CANDIDATES = (
    Candidate(PlateScheme.POSITION, PlateGeometry()),
    Candidate(PlateScheme.POSITION_CHECK, PlateGeometry(), 2),
    Candidate(PlateScheme.ID, PlateGeometry()),
    Candidate(PlateScheme.POSITION_ROBUST, _FINE),
    Candidate(PlateScheme.ID, _FINE),
)


@dataclass(frozen=True, slots=True)
class SchemeDrive:
    """A drive to evaluate: one plate under one light."""

    set_name: str
    index: int
    seed: int


@dataclass(frozen=True, slots=True)
class Counts:
    """Frames of a drive that were read in one way, and the wrong readings in them."""

    read: int = 0
    wrong: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class SchemeRecord:
    """What one scheme, or one tag, gave on one drive."""

    drive: SchemeDrive
    name: str
    frames: int
    # `alone`, `together`, `known`: from each frame alone, from the drive's frames together, and with the registry; tags
    # have only the first
    alone: Counts
    tentative: Counts = Counts()  # frames whose digits were returned as likely, from the frame alone
    together: Counts = Counts()
    known: Counts = Counts()
    known_together: Counts = Counts()  # with the registry and the drive's frames
    is_tag: bool = False


def list_drives(seeds: Sequence[int], drives: int, only: Sequence[str]) -> list[SchemeDrive]:
    """Drives of a fair day, of all sets of light and dirt, and of stress, of the sets in ``only``."""
    names = [name for name in SCHEME_SETS if name in only]
    return [SchemeDrive(name, k, seed) for seed in seeds for name in names for k in range(drives)]


@dataclass(frozen=True, slots=True)
class DrawnDrive:
    """The scenes of a drive, to be rendered with any plate."""

    weather: Weather
    stains: int  # seed of the wear of each face
    places: list[tuple[float, float, int]]  # as `draw_places`
    views: list[tuple[PlateScene, np.ndarray]]
    noise: list[int]  # seed of each frame

    def frames(self, face: Face) -> Iterator[tuple[PlateScene, np.ndarray]]:
        """Scene and image of each frame."""
        for (scene, background), seed in zip(self.views, self.noise, strict=True):
            covered = replace(scene.faces[0], face=self.weather.on_face(face))
            placed = self.weather.in_scene(replace(scene, faces=(covered, *scene.faces[1:])))
            road = self.weather.on_road(placed, background)
            yield placed, render_plate_scene(placed, road, np.random.default_rng(seed)).image

    def plate(self, candidate: Candidate) -> tuple[Face, list[PlateCode]]:
        """Face of a plate, and the codes of it and of its neighbours."""
        codes = [candidate.code(*place) for place in self.places]
        conditions, rng = self.weather.conditions, np.random.default_rng(self.stains)
        return plate_face(codes[0], candidate.geometry, conditions.look, conditions.wear, rng), codes


def draw_drive(drive: SchemeDrive) -> DrawnDrive:
    """The scenes of a drive."""
    rng = np.random.default_rng([drive.seed, 7, SCHEME_SETS.index(drive.set_name), drive.index])
    weather = _draw_weather(drive.set_name, rng)
    conditions = weather.conditions
    stains = int(rng.integers(1 << 31))
    places = draw_places(rng)
    blank = Face(PlateGeometry().side_mm / 1000, np.zeros((2, 2, 3), np.float32))
    if drive.set_name == "stress":
        views = draw_stress_views(blank, conditions, rng)
    else:
        scenes = [replace(s, night_light=conditions.night_light) for s in draw_scenes(blank, conditions, rng)]
        background = draw_background(scenes[0].camera, rng)
        views = [(scene, background) for scene in scenes]
    return DrawnDrive(weather, stains, places, views, [int(s) for s in rng.integers(1 << 31, size=len(views))])


def evaluate_drive(drive: SchemeDrive) -> list[SchemeRecord]:
    """Render and read the frames of a drive with every scheme and every tag."""
    cv2.setNumThreads(1)
    drawn = draw_drive(drive)
    records = []
    for candidate in CANDIDATES:
        face, codes = drawn.plate(candidate)
        records.append(_read(drive, candidate.name, drawn.frames(face), codes))
    for family in FAMILIES:
        tag = int(np.random.default_rng([drawn.stains, family.modules]).integers(50))
        face = tag_face(family, tag, drawn.weather.conditions, np.random.default_rng(drawn.stains))
        hits = [reads_tag(family, tag, image, face_truth(scene, scene.faces[0])) for scene, image in drawn.frames(face)]
        records.append(SchemeRecord(drive, family.name, len(hits), Counts(sum(hits)), is_tag=True))
    return records


def _draw_weather(name: str, rng: np.random.Generator) -> Weather:
    """Weather, or the light of a set in fair weather."""
    if name in WEATHER:
        return draw_weather(name, rng)
    return Weather(draw_stress(rng) if name == "stress" else draw_light(name, rng))


def draw_places(rng: np.random.Generator) -> list[tuple[float, float, int]]:
    """Longitude, latitude [deg] and number of a plate and of its neighbours."""
    lon, lat, number = float(rng.uniform(-180, 180)), float(rng.uniform(-85, 85)), int(rng.integers(1 << 32))
    moves = rng.uniform(-0.005, 0.005, (2, NEIGHBOURS - 1))
    numbers = rng.integers(1 << 32, size=NEIGHBOURS - 1)
    near = [(lon + float(x), lat + float(y), int(v)) for x, y, v in zip(*moves, numbers, strict=True)]
    return [((x + 180) % 360 - 180, y, v) for x, y, v in [(lon, lat, number), *near]]


def _read(
    drive: SchemeDrive, name: str, frames: Iterator[tuple[PlateScene, np.ndarray]], codes: Sequence[PlateCode]
) -> SchemeRecord:
    truths, alone, known, images, cameras = [], [], [], [], []
    for scene, image in frames:
        cameras.append(scene.camera)
        images.append(image)
        truths.append(face_truth(scene, scene.faces[0]))
        alone.append(decode_plates(image, camera=scene.camera))
        known.append(decode_plates(image, camera=scene.camera, codebook=tuple(codes)))
    together = read_together(alone, images, cameras)
    likely = [[one.likely_code.digits for one in readings if one.likely_code is not None] for readings in alone]
    tentative = Counts(
        sum(codes[0].digits in shown for shown in likely),
        tuple(digits for shown in likely for digits in shown if digits != codes[0].digits),
    )
    return SchemeRecord(
        drive, name, len(truths), _count(alone, codes[0], truths), tentative, _count(together, codes[0], truths),
        _count(known, codes[0], truths), _count(read_together(known, images, cameras), codes[0], truths),
    )  # fmt: skip


def read_together(
    alone: Sequence[list[PlateReading]], images: Sequence[np.ndarray], cameras: Sequence[Camera]
) -> list[list[PlateReading]]:
    """What the frames of a drive show together, as an archive of them is read."""
    confirmed = confirm_drive(list(enumerate(alone)))
    together = [[with_pose(one, cameras[k]) for one in confirmed.get(k, readings)] for k, readings in enumerate(alone)]
    expected = list_expected([DriveFrame(k, readings, cameras[k]) for k, readings in enumerate(together)])
    for k, plates in expected.items():
        wanted = [place for one in plates if (place := expect_plate(one, cameras[k])) is not None]
        found = [one for place in wanted if (one := find_expected(images[k], place, cameras[k])) is not None]
        together[k] = with_expected(together[k], found)
    return together


def _count(frames: Sequence[list[PlateReading]], code: PlateCode, truths: Sequence[FaceTruth]) -> Counts:
    found = [find_right(readings, code, truth) for readings, truth in zip(frames, truths, strict=True)]
    return Counts(
        sum(hit is not None for hit, _wrong in found), tuple(digits for _hit, wrong in found for digits in wrong)
    )


def schemes_table(records: Sequence[SchemeRecord]) -> str:
    """Frames read and wrong readings of each scheme under each kind of light and dirt, and the worst drives."""
    rows: list[tuple[object, ...]] = []
    for name in (*SCHEME_SETS, "all"):
        mine = [r for r in records if name in (r.drive.set_name, "all")]
        for scheme in dict.fromkeys(r.name for r in mine):
            own = [r for r in mine if r.name == scheme]
            alone = [r.alone for r in own]
            worst = min(own, key=lambda r: r.alone.read)
            place = f"{worst.alone.read} of {worst.frames}"
            head = (name, scheme, sum(r.frames for r in own))
            if own[0].is_tag:
                rows.append((*head, sum(one.read for one in alone), "", "", "", "", place, _lost(alone)))
                continue
            ways = (
                alone, [r.tentative for r in own], [r.together for r in own], [r.known for r in own],
                [r.known_together for r in own],
            )  # fmt: skip
            shown = (f"{sum(one.read for one in way)} / {sum(len(one.wrong) for one in way)}" for way in ways)
            lost = " / ".join(_lost(ways[k]) for k in (0, 2, 3, 4))
            rows.append((*head, *shown, place, lost))
    titles = (
        "set", "scheme", "frames", "alone / wrong", "tentative / wrong", "with the drive's frames / wrong",
        "with registry / wrong", "with both / wrong", "worst drive alone",
        "drives lost alone / with its frames / with registry / with both",
    )  # fmt: skip
    return table(titles, rows)


def wrong_readings(records: Sequence[SchemeRecord]) -> Iterator[str]:
    """Sure readings that are on no plate, and where they were read."""
    for record in records:
        for digits in (
            *record.alone.wrong, *record.together.wrong, *record.known.wrong, *record.known_together.wrong,
        ):  # fmt: skip
            yield f"{digits} of {record.name}, {record.drive}"


def _lost(drives: Sequence[Counts]) -> str:
    return str(sum(one.read == 0 for one in drives))
