"""Faults of a print at four strengths each: the value and grade of the parameter, and how such plates are read."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from app.decoders.plate.print_grade import grade_print
from app.errors import PrintNotGraded
from app.markers.plate import PlateCode, PlateGeometry
from app.markers.print_grade import PrintGrade, PrintParameterName
from app.planning.predict.printed_plate import DesignSpeed, PassesRead, read_passes
from app.planning.rules import CameraRules
from app.simulation.plate_face import Colour, PlateLook, draw_look
from benchmarks.scenes.printed_plate import PrintFaults, Stain, photograph_print, printed_face

SPEED_M_S = 60 / 3.6
PHOTO_PX = (2016, 1512)
SIDE_PX = 950.0
GEOMETRY = PlateGeometry()
UNITS = ((2, 3), (4, 5), (3, 6), (6, 3), (5, 1))
"""Units that are faulty, in cells of their own."""

Fault = Callable[[PlateCode, PlateLook, float], tuple[PlateLook, PrintFaults]]


@dataclass(frozen=True, slots=True)
class FaultKind:
    """A fault of a print."""

    name: str  # with the unit of its strength
    parameter: PrintParameterName  # that it lowers
    strengths: tuple[float, ...]
    make: Fault  # look and faults of a strength
    scheme: str = "position"  # of the plate: ``position`` or ``id``


@dataclass(slots=True)
class PrintRecord:
    """One plate with one fault."""

    kind: FaultKind
    strength: float
    grade: PrintGrade | None
    refusal: str
    passes: PassesRead = field(default_factory=PassesRead)


def _grey(colour: Colour, share: float) -> Colour:
    blue, green, red = colour
    mean = (blue + green + red) / 3
    return (blue + (mean - blue) * share, green + (mean - green) * share, red + (mean - red) * share)


def _contrast(_code: PlateCode, look: PlateLook, level: float) -> tuple[PlateLook, PrintFaults]:
    return replace(look, dark=tuple(level * part for part in look.light)), PrintFaults()  # type: ignore[arg-type]


def _faded(_code: PlateCode, look: PlateLook, share: float) -> tuple[PlateLook, PrintFaults]:
    return look, PrintFaults(faded={UNITS[0]: share})


def _flipped(_code: PlateCode, look: PlateLook, count: float) -> tuple[PlateLook, PrintFaults]:
    return look, PrintFaults(faded=dict.fromkeys(UNITS[: int(count)], 1.0))


def _stretched(_code: PlateCode, look: PlateLook, share: float) -> tuple[PlateLook, PrintFaults]:
    return look, PrintFaults(stretch=share)


def _displaced(code: PlateCode, look: PlateLook, shift_mm: float) -> tuple[PlateLook, PrintFaults]:
    """A unit that stands out of the gaps, moved over a neighbour of the other paint: others do not show."""
    is_dark = abs(look.dark[1] - look.gap[1]) > abs(look.light[1] - look.gap[1])
    units = code.units.astype(bool)
    fitting = ((row, column) for row in range(2, 6) for column in range(7)
               if units[row, column] == is_dark != units[row, column + 1])  # fmt: skip
    return look, PrintFaults(shifts_mm={next(fitting): (shift_mm, 0.0)})


def _grown(_code: PlateCode, look: PlateLook, share: float) -> tuple[PlateLook, PrintFaults]:
    return look, PrintFaults(growth_mm=share * GEOMETRY.gap_mm / 2)


def _pale(_code: PlateCode, look: PlateLook, share: float) -> tuple[PlateLook, PrintFaults]:
    return replace(look, green=_grey(look.green, share), red=_grey(look.red, share)), PrintFaults()


def _stained(_code: PlateCode, look: PlateLook, radius_mm: float) -> tuple[PlateLook, PrintFaults]:
    """Two stains on crossings of gaps."""
    pitch_mm, paint = GEOMETRY.pitch_mm, (0.3, 0.3, 0.3)
    stains = (Stain(0.0, pitch_mm, radius_mm, paint), Stain(-pitch_mm, -pitch_mm, radius_mm, paint))
    return look, PrintFaults(stains=stains)


_P = PrintParameterName
KINDS = (
    FaultKind("dark paint, share of the white", _P.SYMBOL_CONTRAST, (0.15, 0.4, 0.55, 0.75), _contrast),
    FaultKind("a faded unit, share", _P.MODULATION, (0.2, 0.28, 0.33, 0.38), _faded),
    FaultKind("stretched along travel, share", _P.AXIAL_NONUNIFORMITY, (0.04, 0.07, 0.09, 0.14), _stretched),
    FaultKind("a displaced unit, mm", _P.GRID_NONUNIFORMITY, (4.0, 10.0, 16.5, 22.0), _displaced),
    FaultKind("larger units, share of the gap", _P.PRINT_GROWTH, (0.3, 0.6, 0.75, 1.1), _grown),
    FaultKind("pale markers, share of grey", _P.COLOUR, (0.3, 0.5, 0.65, 0.8), _pale),
    FaultKind("two stains, radius in mm", _P.DAMAGE, (8.0, 14.0, 20.0, 28.0), _stained),
    FaultKind("wrong units of an id plate", _P.UNUSED_ERROR_CORRECTION, (0.0, 1.0, 2.0, 3.0), _flipped, "id"),
)


def print_records(seed: int, *, passes: int = 2, step_of_strengths: int = 1) -> Iterator[PrintRecord]:
    """Grade a photo of each fault at each strength, and read the same plate in passes at 60 km/h."""
    for number, kind in enumerate(KINDS):
        for step, strength in enumerate(kind.strengths[::step_of_strengths]):
            rng = np.random.default_rng((seed, number, step))
            yield _record(kind, strength, rng, seed, passes)


def _record(kind: FaultKind, strength: float, rng: np.random.Generator, seed: int, passes: int) -> PrintRecord:
    if kind.scheme == "id":
        code = PlateCode.from_registry_number(int(rng.integers(1 << 32)))
    else:
        code = PlateCode.from_position(float(rng.uniform(5, 15)), float(rng.uniform(46, 54)))
    look, faults = kind.make(code, draw_look(rng), strength)
    face = printed_face(code, GEOMETRY, look, faults)
    photo = photograph_print(
        face, rng, side_px=SIDE_PX, size_px=PHOTO_PX, tilt_deg=float(rng.uniform(0, 10)),
        turn_deg=float(rng.uniform(0, 360)),
    )  # fmt: skip
    pixels = np.asarray(cv2.imdecode(np.frombuffer(photo, np.uint8), cv2.IMREAD_COLOR), np.uint8)
    grade, refusal = None, ""
    try:
        grade = grade_print(pixels, code=code, geometry=GEOMETRY)
    except PrintNotGraded as error:
        refusal = error.message
    design = DesignSpeed(CameraRules(), SPEED_M_S)
    found = read_passes(face, code, GEOMETRY, design, seed=seed + int(rng.integers(1 << 20)), passes=passes)
    return PrintRecord(kind, strength, grade, refusal, found)


def prints_table(records: list[PrintRecord]) -> str:
    """One row a fault and strength; with several seeds the worst grade and the frames of all."""
    rows = [
        "| fault | strength | parameter | value | grade | other parameters below A | frames read % | alone % | wrong |",
        "|---|--:|---|--:|---|---|--:|--:|--:|",
    ]
    groups: dict[tuple[str, float], list[PrintRecord]] = {}
    for record in records:
        groups.setdefault((record.kind.name, record.strength), []).append(record)
    for (name, strength), group in groups.items():
        graded = [record.grade for record in group if record.grade is not None]
        refused = f"; {len(group) - len(graded)} refused" if len(graded) < len(group) else ""
        wanted = group[0].kind.parameter
        own = [p for grade in graded for p in grade.parameters if p.name is wanted]
        others = sorted({str(p.name) for g in graded for p in g.parameters if p.name is not wanted and p.grade < 4})
        value = f"{np.median([p.value for p in own]):.3g}" if own else "-"
        letters = "".join(sorted({p.letter for p in own})) if own else "-"
        frames = [hit for record in group for _px, hit in record.passes.frames]
        alone = sum(record.passes.alone for record in group)
        wrong = sum(record.passes.wrong for record in group)
        rows.append(
            f"| {name} | {strength:g} | {wanted} | {value} | {letters}{refused} | {', '.join(others) or '-'} | "
            f"{100 * np.mean(frames):.0f} | {100 * alone / len(frames):.0f} | {wrong} |"
        )
    return "\n".join(rows)
