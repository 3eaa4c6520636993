"""Schemes of plates in the same scenes, under the same light and the same stains, and tags beside them.

A drive is one plate, with its stains and its light, in frames from far to near. Every scheme, and every tag, lies in
the same place in the same size, and gets the same stains.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from app.decoders.plate.reader import decode_plates
from app.markers.plate import PlateCode, PlateGeometry, PlateScheme
from app.markers.recommended_plate import recommended_geometry
from app.simulation.camera import render_plate_scene
from app.simulation.plate_face import Face, plate_face
from app.simulation.plate_scene import PlateScene, face_truth
from benchmarks.plates.evaluate import find_right
from benchmarks.plates.peers import FAMILIES, reads_tag, tag_face
from benchmarks.plates.sets import LIGHT, SETS, draw_background, draw_light, draw_scenes
from benchmarks.plates.tables import table

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
class SchemeRecord:
    """What one scheme, or one tag, gave on one drive: frames read and wrong readings, alone and with the registry."""

    set_name: str
    index: int
    seed: int
    name: str
    frames: int
    read: int
    wrong: tuple[str, ...] = ()
    read_known: int = 0
    wrong_known: tuple[str, ...] = ()
    is_tag: bool = False


def list_drives(seeds: Sequence[int], drives: int) -> list[SchemeDrive]:
    """Drives of all sets of light and dirt."""
    return [SchemeDrive(name, k, seed) for seed in seeds for name in LIGHT for k in range(drives)]


def evaluate_drive(drive: SchemeDrive) -> list[SchemeRecord]:
    """Render and read the frames of a drive with every scheme and every tag."""
    cv2.setNumThreads(1)
    rng = np.random.default_rng([drive.seed, 7, SETS.index(drive.set_name), drive.index])
    conditions = draw_light(drive.set_name, rng)
    stains = int(rng.integers(1 << 31))
    lon, lat, number = float(rng.uniform(-180, 180)), float(rng.uniform(-85, 85)), int(rng.integers(1 << 32))
    places = [(lon, lat, number)] + [
        (lon + float(x), lat + float(y), int(v))
        for x, y, v in zip(
            *rng.uniform(-0.005, 0.005, (2, NEIGHBOURS - 1)), rng.integers(1 << 32, size=NEIGHBOURS - 1), strict=True
        )
    ]
    places = [((x + 180) % 360 - 180, y, v) for x, y, v in places]
    blank = Face(PlateGeometry().side_mm / 1000, np.zeros((2, 2, 3), np.float32))
    views = draw_scenes(blank, conditions, rng)
    background = draw_background(views[0].camera, rng)
    noise = [int(s) for s in rng.integers(1 << 31, size=len(views))]

    def frames(face: Face) -> Iterator[tuple[PlateScene, np.ndarray]]:
        for scene, seed in zip(views, noise, strict=True):
            placed = replace(scene, faces=(replace(scene.faces[0], face=face),))
            yield placed, render_plate_scene(placed, background, np.random.default_rng(seed)).image

    records = []
    for candidate in CANDIDATES:
        codes = [candidate.code(*place) for place in places]
        face = plate_face(codes[0], candidate.geometry, conditions.look, conditions.wear, np.random.default_rng(stains))
        records.append(_read(drive, candidate.name, frames(face), codes))
    for family in FAMILIES:
        tag = int(np.random.default_rng([stains, family.modules]).integers(50))
        face = tag_face(family, tag, conditions, np.random.default_rng(stains))
        hits = [reads_tag(family, tag, image, face_truth(scene, scene.faces[0])) for scene, image in frames(face)]
        records.append(
            SchemeRecord(drive.set_name, drive.index, drive.seed, family.name, len(hits), sum(hits), is_tag=True)
        )
    return records


def _read(
    drive: SchemeDrive, name: str, frames: Iterator[tuple[PlateScene, np.ndarray]], codes: Sequence[PlateCode]
) -> SchemeRecord:
    count, hits, wrong = 0, [0, 0], [list[str](), list[str]()]
    for scene, image in frames:
        count += 1
        truth = face_truth(scene, scene.faces[0])
        for k, codebook in enumerate(((), tuple(codes))):
            found = decode_plates(image, camera=scene.camera, codebook=codebook)
            hit, others = find_right(found, codes[0], truth)
            hits[k] += hit is not None
            wrong[k] += others
    return SchemeRecord(
        drive.set_name, drive.index, drive.seed, name, count, hits[0], tuple(wrong[0]), hits[1], tuple(wrong[1])
    )


def schemes_table(records: Sequence[SchemeRecord]) -> str:
    """Frames read and wrong readings of each scheme under each kind of light and dirt, and the worst drives."""
    rows = []
    for name in (*LIGHT, "all"):
        mine = [r for r in records if name in (r.set_name, "all")]
        for scheme in dict.fromkeys(r.name for r in mine):
            own = [r for r in mine if r.name == scheme]
            lost = sum(r.read == 0 for r in own)
            worst = min(own, key=lambda r: r.read)
            known: tuple[object, ...] = ("", "", "")
            if not own[0].is_tag:
                known = (
                    sum(r.read_known for r in own), sum(len(r.wrong_known) for r in own),
                    sum(r.read_known == 0 for r in own),
                )  # fmt: skip
            wrong = "" if own[0].is_tag else sum(len(r.wrong) for r in own)
            rows.append((
                name, scheme, sum(r.frames for r in own), sum(r.read for r in own), wrong,
                f"{worst.read} of {worst.frames}", f"{lost} of {len(own)}", *known,
            ))  # fmt: skip
    head = (
        "set", "scheme", "frames", "read alone", "wrong", "worst drive", "drives lost", "with registry", "wrong",
        "drives lost",
    )  # fmt: skip
    return table(head, rows)
