"""Results of all units -> the report of a proof."""

from __future__ import annotations

import io
import math
import zlib
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from enum import StrEnum

import numpy as np
import orjson
from pydantic import BaseModel, ConfigDict, Field, field_validator
from typing_extensions import TypedDict

from app.errors import InvalidParameter
from app.formats.text import TableWriter
from app.inputs import Number, Whole
from app.planning.plan import Plan, PlannedLineMagnet, PlannedMarker, PlannedPlate, PlannedTag
from app.planning.rules import CameraRules

# === Terms of a proof: how many drives, of which vehicles, in which conditions; and the units that it is divided into.


class Condition(StrEnum):
    """A condition of a drive; several are joined with ``+``, as in ``night+rain``."""

    DAY = "day"
    NIGHT = "night"
    RAIN = "rain"
    SHADE = "shade"
    WEAR = "wear"
    DIRT = "dirt"


class UnitKind(StrEnum):
    """What the vehicle reads in a unit of the proof."""

    PLATES = "plates"
    TAGS = "tags"
    LINE = "line"
    LANE = "lane"


class ProofTerms(BaseModel):
    """What is driven, and how. The same plan, terms and seed give the same result.

    `lost_share` of the markers are missing, drawn again for each drive. Drives take the conditions in turn, and the
    cameras in turn after each round of conditions. The uncertainty of a survey is radial, as in the registry.
    """

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)

    drives: Whole = Field(default=6, ge=1, le=10_000)
    seed: Whole = Field(default=1, ge=0, le=2**31 - 1)
    conditions: tuple[str, ...] = Field(
        default=("day",), min_length=1, max_length=20, description="Of the drives in turn; `night+rain` is both."
    )
    cameras: tuple[str, ...] | None = Field(
        default=None, min_length=1, max_length=10, description="Names in the rules; without, all of them."
    )
    speed_share: Number = Field(default=1.0, ge=0.1, le=1.5, description="Of the design speed.")
    lost_share: Number = Field(default=0.0, ge=0.0, le=0.9, description="Of the markers, missing in a drive.")
    clearance_m: Number = Field(
        default=0.16, ge=0.05, le=0.6, description="Of the magnetometers above the road; the magnets may lie deeper."
    )
    survey_rmse_m: Number = Field(default=0.03, ge=0.0, le=2.0, description="Of the registered positions, horizontal.")
    max_markers_per_drive: Whole = Field(
        default=40, ge=1, le=1_000_000, description="Plates and tags each; more are sampled by strata."
    )
    max_sections_per_drive: Whole = Field(
        default=6, ge=1, le=100_000, description="Stretches of line magnets and of lanes with CERPMs each."
    )
    weak_below: Number = Field(default=0.9, gt=0.0, le=1.0, description="Read rate below which a marker is weak.")

    @field_validator("conditions")
    @classmethod
    def _known(cls, conditions: tuple[str, ...]) -> tuple[str, ...]:
        for text in conditions:
            parse_conditions(text)
        return conditions


def parse_conditions(text: str) -> frozenset[Condition]:
    """The conditions of a drive, e.g. of ``night+rain``; ``day`` is what the others are added to.

    Raises
    ------
    InvalidParameter
        A name is unknown.
    """
    names = [part.strip() for part in text.split("+")]
    unknown = [name for name in names if name not in list(Condition)]
    if unknown:
        raise InvalidParameter(
            f"{unknown[0][:40]!r} is no condition",
            field="conditions",
            limit=", ".join(Condition),
            cure="name one of these, or join several with +",
        )
    return frozenset(Condition(name) for name in names)


@dataclass(frozen=True, slots=True)
class ProofUnit:
    """A part of the proof that is computed apart from the others, in any order and in any process."""

    kind: UnitKind
    drive: int  # from 0
    lane: str
    markers: tuple[int, ...] = ()  # numbers of the plates or tags that are driven over; empty for the others
    # `from_m`, `to_m`: [m] stretch of the lane that is driven for line magnets and CERPMs
    from_m: float = 0.0
    to_m: float = 0.0
    weight: tuple[float, ...] = (1.0,)  # of each marker: how many of its stratum it stands for; one value for a stretch

    @property
    def key(self) -> str:
        """Identifies the unit among those of the same plan and terms."""
        start = str(self.markers[0]) if self.markers else f"{self.from_m:.2f}"
        return f"{self.drive}/{self.kind}/{self.lane}/{start}"


@dataclass(frozen=True, slots=True)
class DriveTerms:
    """What is the same along one drive."""

    drive: int
    condition: str  # as in the terms
    camera: CameraRules


def drive_terms(plan: Plan, terms: ProofTerms, drive: int) -> DriveTerms:
    """Condition and camera of a drive: they take turns.

    Raises
    ------
    InvalidParameter
        The rules have no camera of this name.
    """
    condition = terms.conditions[drive % len(terms.conditions)]
    known = {camera.name: camera for camera in plan.rules.cameras}
    names = terms.cameras if terms.cameras is not None else tuple(known)
    name = names[drive // len(terms.conditions) % len(names)]
    if name not in known:
        raise InvalidParameter(
            f"the rules have no camera {name[:60]!r}",
            field="cameras",
            limit=", ".join(known)[:300],
            cure="name a camera of the rules",
        )
    return DriveTerms(drive, condition, known[name])


# === Results of units of a proof, as they are stored: one JSON object a unit.


class MarkerPass(TypedDict):
    """One pass of one drive over one marker."""

    marker: int  # number in the plan
    weight: float  # how many markers of its stratum it stands for
    lost: bool  # it is missing in this drive
    # `readable`, `seen`, `read`: of plates: frames in which it is in view and a unit is a pixel high or more; of them,
    # those that were rendered (no more than it takes to read it in `plates.min_frames`), and those in which it was
    # read. Of magnets: 1, 1, and whether it was read.
    readable: int
    seen: int
    read: int
    fix_m: list[float] | None  # [m] error of the vehicle's position along and across the lane
    cause: str | None  # why it was not read


class WrongReading(TypedDict):
    """Something that was read and is not there: what, and the number of the marker that was being passed."""

    marker: int
    text: str


class LanePath(TypedDict):
    """Path of one drive along a stretch of lane with CERPMs, against the true centre line."""

    places: int  # places of the true centre line between the first and the last marker
    covered: int  # of them, those within 1 m of the path
    # `square_sum_m2`, `worst_m`: of the distances of the covered places from the path. [m2, m]
    square_sum_m2: float
    worst_m: float
    worst_at_m: float  # [m] chainage of the greatest distance
    # `received`, `markers`: markers that were received and verified, of those along the stretch
    received: int
    markers: int
    left_out: list[int]  # numbers of markers that the path leaves out
    refusal: str | None  # why there is no path


class UnitResult(TypedDict):
    """Result of one unit."""

    key: str  # of the unit
    # `kind`, `drive`, `lane`: as in the unit
    kind: str
    drive: int
    lane: str
    # `condition`, `camera`: of the drive
    condition: str
    camera: str
    weight: float  # of a stretch: how many of its kind it stands for
    passes: list[MarkerPass]
    wrong: list[WrongReading]
    path: LanePath | None  # of a lane with CERPMs


# === Results of all units -> the report of a proof.


_Z95 = 1.959964  # standard normal quantile of 97.5 %, for intervals of 95 %
ALL = "all"
"""Condition of figures over all drives."""


@dataclass(frozen=True, slots=True)
class ReadRate:
    """Share of passes in which markers of one kind were read, weighted by strata."""

    kind: str  # ``plates``, ``tags`` or ``line``
    condition: str
    # `passes`, `read`, `lost`: passes, those in which the marker was read, those in which it was missing
    passes: int
    read: int
    lost: int
    # `rate`, `low`, `high`: share read of all passes, and its 95 % interval (Wilson, with the effective number of
    # passes after Kish)
    rate: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class MarkerProof:
    """What the drives show about one marker."""

    # `number`, `code`, `kind`, `lane`, `chainage_m`, `station_m`, `lon_deg`, `lat_deg`: of the plan
    number: int
    code: str
    kind: str
    lane: str
    chainage_m: float
    station_m: float
    lon_deg: float
    lat_deg: float
    # `passes`, `read`, `lost`, `wrong`: passes; those in which it was read; was missing; in which something was read
    # that is not there
    passes: int
    read: int
    lost: int
    wrong: int
    # `rate`, `low`, `high`: share read of the passes in which it was there, and its 95 % interval; None without such a
    # pass
    rate: float | None
    low: float | None
    high: float | None
    fix_rms_m: float | None  # [m] of the vehicle's position, horizontal
    weak: bool  # read less often than `weak_below`
    cause: str | None  # the most frequent cause of a miss


@dataclass(frozen=True, slots=True)
class DriveResult:
    """One drive on one lane."""

    drive: int
    lane: str
    condition: str
    camera: str
    # `passes`, `read`, `fixes`, `wrong`: markers passed, read, with a position of the vehicle; wrong readings
    passes: int
    read: int
    fixes: int
    wrong: int
    # `fix_rms_m`, `fix_worst_m`: [m] errors of the positions, horizontal
    fix_rms_m: float | None
    fix_worst_m: float | None
    # `longest_gap_m`, `gap_from_m`: [m] longest way without a position, the lane's ends included, and where it begins;
    # None without plates and tags
    longest_gap_m: float | None
    gap_from_m: float | None
    gap_estimated: bool  # plates and tags that were not driven over count as read at the drive's rate
    # `path_rms_m`, `path_worst_m`, `path_worst_at_m`, `path_coverage`: of the path from CERPMs: distances of the centre
    # line from it, and the share of it that has a path. [m, m, m, 1]
    path_rms_m: float | None
    path_worst_m: float | None
    path_worst_at_m: float | None
    path_coverage: float | None
    refusals: tuple[str, ...] = ()  # why stretches have no path


class WrongInDrive(WrongReading):
    """A wrong reading, and the drive that it was made in; the marker is 0 beside line magnets."""

    drive: int


PROOF_FORMAT = "waymark-proof/1"
NOTE = (
    "Simulated drives: rates are of passes, weighted by strata where markers are sampled; intervals are Wilson's of "
    "95 %, which take passes as independent. Light, wear and dirt are drawn from the ranges of "
    "app/simulation/conditions.py."
)
"""What the figures are, in every report."""


@dataclass(frozen=True, slots=True)
class ProofReport:
    """What simulated vehicles read of a plan."""

    plan: str  # its name
    terms: ProofTerms
    complete: bool  # all units were computed
    rates: tuple[ReadRate, ...]  # by kind, over all drives first and then by condition
    drives: tuple[DriveResult, ...]  # by drive and lane
    weak: tuple[int, ...]  # numbers of the markers that are read too rarely
    wrong: tuple[WrongInDrive, ...]
    markers: tuple[MarkerProof, ...]  # those that were driven over, by number
    format: str = PROOF_FORMAT
    note: str = NOTE

    def list_weak(self) -> list[MarkerProof]:
        """Markers that are read too rarely."""
        return [marker for marker in self.markers if marker.weak]

    def write(self, option: int = 0) -> bytes:
        """The report as JSON, with options of orjson."""
        return orjson.dumps(self, lambda terms: terms.model_dump(mode="json"), option)


def wilson(rate: float, count: float) -> tuple[float, float]:
    """95 % interval of a share from a number of trials (Wilson 1927)."""
    if count <= 0:
        return 0.0, 1.0
    z2 = _Z95**2 / count
    middle = (rate + z2 / 2) / (1 + z2)
    half = _Z95 * math.sqrt(rate * (1 - rate) / count + z2 / (4 * count)) / (1 + z2)
    return max(middle - half, 0.0), min(middle + half, 1.0)


def summarize(plan: Plan, terms: ProofTerms, results: Iterable[UnitResult], *, complete: bool = True) -> ProofReport:
    """The report of a proof from the results of its units, in any order."""
    units = sorted(results, key=lambda unit: unit["key"])
    drives = sorted({(unit["drive"], unit["lane"]) for unit in units})
    wrong = [WrongInDrive(drive=unit["drive"], **one) for unit in units for one in unit["wrong"]]
    markers = _markers(plan, terms, units)
    return ProofReport(
        plan.name,
        terms,
        complete,
        _rates(units),
        tuple(_drive(plan, terms, drive, lane, units) for drive, lane in drives),
        tuple(marker.number for marker in markers if marker.weak),
        tuple(sorted(wrong, key=lambda one: (one["drive"], one["marker"], one["text"]))),
        markers,
    )


# --- read rates -----------------------------------------------------------------------------------------------------


def _rates(units: Sequence[UnitResult]) -> tuple[ReadRate, ...]:
    groups: dict[tuple[str, str], list[MarkerPass]] = defaultdict(list)
    for unit in units:
        for condition in (ALL, unit["condition"]):
            groups[unit["kind"], condition] += unit["passes"]
    order = sorted(groups, key=lambda key: (key[0], key[1] != ALL, key[1]))
    return tuple(
        _rate(kind, condition, groups[kind, condition]) for kind, condition in order if groups[kind, condition]
    )


def _rate(kind: str, condition: str, passes: Sequence[MarkerPass]) -> ReadRate:
    weights = np.array([one["weight"] for one in passes])
    read = np.array([one["read"] > 0 for one in passes])
    rate = float(weights[read].sum() / weights.sum())
    low, high = wilson(rate, float(weights.sum() ** 2 / (weights**2).sum()))
    return ReadRate(kind, condition, len(passes), int(read.sum()), sum(one["lost"] for one in passes), rate, low, high)


# --- markers --------------------------------------------------------------------------------------------------------


def _markers(plan: Plan, terms: ProofTerms, units: Sequence[UnitResult]) -> tuple[MarkerProof, ...]:
    by_number = {marker.number: marker for marker in plan.markers}
    passes: dict[int, list[MarkerPass]] = defaultdict(list)
    wrong: Counter[int] = Counter()
    for unit in units:
        for one in unit["passes"]:
            passes[one["marker"]].append(one)
        wrong.update(one["marker"] for one in unit["wrong"])
    return tuple(_marker(by_number[number], terms, passes[number], wrong[number]) for number in sorted(passes))


def _marker(marker: PlannedMarker, terms: ProofTerms, passes: Sequence[MarkerPass], wrong: int) -> MarkerProof:
    there = [one for one in passes if not one["lost"]]
    read = sum(one["read"] > 0 for one in there)
    rate = read / len(there) if there else None
    low, high = wilson(rate, len(there)) if rate is not None else (None, None)
    causes = Counter(one["cause"] for one in (there or passes) if one["cause"] is not None)
    fixes = [math.hypot(*one["fix_m"]) for one in passes if one["fix_m"] is not None]
    return MarkerProof(
        marker.number, marker.code, _kind(marker), marker.lane, marker.chainage_m, marker.station_m, marker.lon_deg,
        marker.lat_deg, len(passes), read, len(passes) - len(there), wrong, rate, low, high, _rms(fixes),
        rate is None or rate < terms.weak_below, min(causes, key=lambda c: (-causes[c], c)) if causes else None,
    )  # fmt: skip


def _kind(marker: PlannedMarker) -> str:
    kinds = ((PlannedPlate, UnitKind.PLATES), (PlannedTag, UnitKind.TAGS), (PlannedLineMagnet, UnitKind.LINE))
    return next((str(kind) for of, kind in kinds if isinstance(marker.detail, of)), marker.family)


# --- drives ---------------------------------------------------------------------------------------------------------


def _drive(plan: Plan, terms: ProofTerms, drive: int, lane: str, units: Sequence[UnitResult]) -> DriveResult:
    own = [unit for unit in units if (unit["drive"], unit["lane"]) == (drive, lane)]
    passes = [one for unit in own for one in unit["passes"]]
    fixes = [math.hypot(*one["fix_m"]) for one in passes if one["fix_m"] is not None]
    gap, gap_from, estimated = _longest_gap(plan, terms, drive, lane, own)
    paths = [unit["path"] for unit in own if unit["path"] is not None]
    places, covered = sum(path["places"] for path in paths), sum(path["covered"] for path in paths)
    worst = max(paths, key=lambda path: path["worst_m"]) if covered else None
    return DriveResult(
        drive=drive,
        lane=lane,
        condition=own[0]["condition"],
        camera=own[0]["camera"],
        passes=len(passes),
        read=sum(one["read"] > 0 for one in passes),
        fixes=len(fixes),
        wrong=sum(len(unit["wrong"]) for unit in own),
        fix_rms_m=_rms(fixes),
        fix_worst_m=max(fixes) if fixes else None,
        longest_gap_m=gap,
        gap_from_m=gap_from,
        gap_estimated=estimated,
        path_rms_m=math.sqrt(sum(path["square_sum_m2"] for path in paths) / covered) if covered else None,
        path_worst_m=worst["worst_m"] if worst else None,
        path_worst_at_m=worst["worst_at_m"] if worst else None,
        path_coverage=covered / places if places else None,
        refusals=tuple(path["refusal"] for path in paths if path["refusal"] is not None),
    )


def _longest_gap(
    plan: Plan, terms: ProofTerms, drive: int, lane: str, units: Sequence[UnitResult]
) -> tuple[float | None, float | None, bool]:
    """Longest way without a fix and where it begins; whether markers were not driven over."""
    markers = [m for m in plan.markers if m.lane == lane and isinstance(m.detail, PlannedPlate | PlannedTag)]
    if not markers:
        return None, None, False
    driven = {one["marker"]: one["fix_m"] is not None for unit in units for one in unit["passes"]}
    known = [driven[marker.number] for marker in markers if marker.number in driven]
    rate = sum(known) / len(known) if known else 0.0
    rng = np.random.default_rng((terms.seed, drive, zlib.crc32(lane.encode())))
    drawn = rng.random(len(markers)) < rate
    fixed = [m.chainage_m for m, luck in zip(markers, drawn, strict=True) if driven.get(m.number, bool(luck))]
    places = np.array([0.0, *sorted(fixed), plan.alignment.lane(lane).length_m])
    widest = int(np.argmax(np.diff(places)))
    return float(np.diff(places)[widest]), float(places[widest]), len(known) < len(markers)


def _rms(values: Sequence[float]) -> float | None:
    return math.sqrt(sum(value**2 for value in values) / len(values)) if values else None


def markers_csv(report: ProofReport) -> str:
    """One row a marker that was driven over; empty where a figure is unknown."""
    stream = io.StringIO()
    writer = TableWriter(stream, "\n")
    names = [field.name for field in fields(MarkerProof)]
    writer.write_row(names)
    for marker in report.markers:
        writer.write_row(getattr(marker, name) for name in names)
    return stream.getvalue()
