"""The rows of ``python -m benchmarks.magnets physics``: the decoder on drives with a second physics.

Every row has the same drives but for one option of the simulation (the last: all of them): single magnets, then tags,
then iron that is not a marker.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from app.decoders.magnet.decoder import decode_trace
from app.decoders.magnet.identify import TagCandidates, TagFormat
from app.simulation.magnetic.clutter import ferrous_clutter
from app.simulation.magnetic.dipoles import METRO_CYLINDER, Cylinder
from app.simulation.magnetic.drive import MPH, Course, Scene, SimulatedDrive, Vehicle, simulate_drive
from app.simulation.magnetic.recorder import Chip
from app.simulation.magnetic.road import PlacedTag, Road
from benchmarks.magnets.scenes import LEAD_M, random_magnets, random_tag
from benchmarks.magnets.score import TagTally, Tally, score_magnets, score_tags

BAR = Vehicle.compact().bar
FORMAT = TagFormat(3, 4.0, 1.0)
MAGNETS, TAGS, IRON_M = 25, 8, 140.0
"""On a drive: single magnets, tags, and the length of the road with iron [m]."""
CLEARANCES_CM = (16, 30)
SPEEDS_MPH = (30, 60, 20, 45)
FERRITE_ROD = Cylinder(0.014, 0.05, sunk_m=0.03)
"""A rod in a drilled hole, its upper end level with the road, with the moment of METRO's magnet. [m] Source: remanence
of 0.40 T, ceramic 8 (MMPA 0100-00, table III-1); its size and depth are chosen by hand."""
RANGE_UT = 400.0
"""[uT] Source: LIS3MDL data sheet (DocID024204), smallest full scale of 4 gauss; the MLX90393 has 4.9 mT."""
CROSS_AXIS = 0.03
"""Source: assumed, 1.7 degrees between axes."""
GAIN_ERROR = 0.05
"""Source: HMC5883L data sheet, gain tolerance of 5 %, here taken as one standard deviation."""
STAMP_JITTER_S = 0.001
"""[s] Source: USB 2.0 specification, section 8.4.3: a host reads a full-speed device once a millisecond."""


@dataclass(frozen=True, slots=True)
class Physics:
    """What differs from the usual simulation."""

    name: str
    shape: Cylinder | None = None
    spheroid_iron: bool = False
    chip: Chip = field(default_factory=Chip)


ROWS = (
    Physics("base: point dipoles"),
    Physics("METRO's magnets as cylinders", METRO_CYLINDER),
    Physics("ferrite rods of 14 x 50 mm, sunk", FERRITE_ROD),
    Physics("iron of spheroids", spheroid_iron=True),
    Physics("sensors saturate at 400 uT", chip=Chip(range_ut=RANGE_UT)),
    Physics("axes mixed by 3 %, gains off by 5 %", chip=Chip(cross_axis=CROSS_AXIS, gain_error=GAIN_ERROR)),
    Physics("times of samples off by 1 ms", chip=Chip(stamp_jitter_s=STAMP_JITTER_S)),
    Physics(
        "all together, ferrite rods", FERRITE_ROD, True,
        Chip(range_ut=RANGE_UT, cross_axis=CROSS_AXIS, gain_error=GAIN_ERROR, stamp_jitter_s=STAMP_JITTER_S),
    ),
)  # fmt: skip


def run_physics(seed: int, short: bool) -> tuple[str, Sequence[str], list[Sequence[object]]]:
    """One row for each option: magnets and tags at 16 and at 30 cm."""
    rows = [_row(physics, seed, _drives(short)) for physics in ROWS]
    head = ("simulation", "recall", "worst drive", "wrong", "false", "precision", "tags right", "wrong tags")
    note = (
        "Each drive has single magnets, tags (M 3, L 4 m, Seg_d 1 m) and the ferrous set one after the other, at 20 to "
        "60 mph; the decoder is unchanged. Each cell has the value for a clearance of "
        + " / ".join(f"{cm} cm" for cm in CLEARANCES_CM)
        + f". There are {_drives(short) * TAGS} tags at each clearance. Recall counts single magnets and those of tags."
    )
    return note, head, rows


def _drives(short: bool) -> int:
    return 2 if short else 12


def _row(physics: Physics, seed: int, drives: int) -> Sequence[object]:
    columns = zip(*(_at_clearance(physics, seed, cm, drives) for cm in CLEARANCES_CM), strict=True)
    return (physics.name, *(" / ".join(cells) for cells in columns))


def _at_clearance(physics: Physics, seed: int, clearance_cm: int, drives: int) -> tuple[str, ...]:
    """Recall, worst drive, wrong and false readings, precision, tags right and wrong."""
    total, tags, recalls = Tally(), TagTally(), []
    for k in range(drives):
        rng, mph = np.random.default_rng([seed, 71, clearance_cm, k]), SPEEDS_MPH[k % len(SPEEDS_MPH)]
        drive = physics_drive(physics, rng, clearance_m=clearance_cm / 100, speed_mph=mph)
        findings = decode_trace(drive.trace, BAR, candidates=TagCandidates(formats=[FORMAT]))
        one = score_magnets(drive, findings)
        recalls.append(one.recall)
        total.add(one)
        tags.add(score_tags(drive, findings))
    return (
        f"{total.recall:.3f}", f"{min(recalls):.3f}", str(total.wrong), str(total.extra), f"{total.precision:.3f}",
        str(tags.right), str(tags.wrong),
    )  # fmt: skip


def physics_drive(
    physics: Physics,
    rng: np.random.Generator,
    *,
    clearance_m: float,
    speed_mph: float,
) -> SimulatedDrive:
    """Magnets 3 m apart, tags 15 m apart, and each kind of iron once, 20 m apart."""
    lines = random_magnets(rng, MAGNETS, 3.0)
    first_tag_m = LEAD_M + 3.0 * MAGNETS + 10
    placed = [
        PlacedTag(random_tag(rng, FORMAT), first_tag_m + 15.0 * k, float(rng.uniform(-0.3, 0.3))) for k in range(TAGS)
    ]
    first_iron_m = first_tag_m + 15.0 * TAGS + 20
    clutter = ferrous_clutter(first_iron_m, first_iron_m + IRON_M, 20.0, rng)
    scene = Scene(
        Road(first_iron_m + IRON_M + 20), Vehicle.compact(clearance_m=clearance_m),
        Course(speed_m_s=speed_mph * MPH), tags=placed, lines=lines, clutter=clutter,
    )  # fmt: skip
    return simulate_drive(
        replace(scene, magnet_shape=physics.shape, spheroid_iron=physics.spheroid_iron, chip=physics.chip), rng
    )
