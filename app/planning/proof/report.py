"""Results of all units -> the report of a proof."""

from __future__ import annotations

import math
import zlib
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from app.planning.plan import Plan, PlannedLineMagnet, PlannedMarker, PlannedPlate, PlannedTag
from app.planning.proof.results import MarkerPass, UnitResult
from app.planning.proof.terms import ProofTerms, UnitKind

_Z95 = 1.959964  # standard normal quantile of 97.5 %, for intervals of 95 %
ALL = "all"
"""Condition of figures over all drives."""


@dataclass(frozen=True, slots=True)
class ReadRate:
    """Share of passes in which markers of one kind were read, weighted by strata.

    Attributes
    ----------
    kind : str
        ``plates``, ``tags`` or ``line``.
    condition : str
    passes, read, lost : int
        Passes, those in which the marker was read, those in which it was missing.
    rate, low, high : float
        Share read of all passes, and its 95 % interval (Wilson, with the effective number of passes after Kish).
    """

    kind: str
    condition: str
    passes: int
    read: int
    lost: int
    rate: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class MarkerProof:
    """What the drives show about one marker.

    Attributes
    ----------
    number, code, kind, lane, chainage_m, station_m, lon_deg, lat_deg
        Of the plan.
    passes, read, lost, wrong : int
        Passes; those in which it was read; was missing; in which something was read that is not there.
    rate, low, high : float or None
        Share read of the passes in which it was there, and its 95 % interval; None without such a pass.
    fix_rms_m : float or None
        Of the vehicle's position, horizontal. [m]
    weak : bool
        Read less often than `weak_below`.
    cause : str or None
        The most frequent cause of a miss.
    """

    number: int
    code: str
    kind: str
    lane: str
    chainage_m: float
    station_m: float
    lon_deg: float
    lat_deg: float
    passes: int
    read: int
    lost: int
    wrong: int
    rate: float | None
    low: float | None
    high: float | None
    fix_rms_m: float | None
    weak: bool
    cause: str | None


@dataclass(frozen=True, slots=True)
class DriveResult:
    """One drive on one lane.

    Attributes
    ----------
    drive : int
    lane, condition, camera : str
    passes, read, fixes, wrong : int
        Markers passed, read, with a position of the vehicle; wrong readings.
    fix_rms_m, fix_worst_m : float or None
        Errors of the positions, horizontal. [m]
    longest_gap_m, gap_from_m : float or None
        Longest way without a position, the lane's ends included, and where it begins; None without plates and tags. [m]
    gap_estimated : bool
        Plates and tags that were not driven over count as read at the drive's rate.
    path_rms_m, path_worst_m, path_worst_at_m, path_coverage : float or None
        Of the path from CERPMs: distances of the centre line from it, and the share of it that has a path. [m, m, m, 1]
    refusals : tuple of str
        Why stretches have no path.
    """

    drive: int
    lane: str
    condition: str
    camera: str
    passes: int
    read: int
    fixes: int
    wrong: int
    fix_rms_m: float | None
    fix_worst_m: float | None
    longest_gap_m: float | None
    gap_from_m: float | None
    gap_estimated: bool
    path_rms_m: float | None
    path_worst_m: float | None
    path_worst_at_m: float | None
    path_coverage: float | None
    refusals: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class ProofReport:
    """What simulated vehicles read of a plan.

    Attributes
    ----------
    plan : str
        Its name.
    terms : ProofTerms
    complete : bool
        All units were computed.
    rates : tuple of ReadRate
        By kind, over all drives first and then by condition.
    markers : tuple of MarkerProof
        Those that were driven over, by number.
    drives : tuple of DriveResult
        By drive and lane.
    wrong : tuple of (drive, marker, text)
    """

    plan: str
    terms: ProofTerms
    complete: bool
    rates: tuple[ReadRate, ...]
    markers: tuple[MarkerProof, ...]
    drives: tuple[DriveResult, ...]
    wrong: tuple[tuple[int, int, str], ...]

    @property
    def weak(self) -> tuple[MarkerProof, ...]:
        """Markers that are read too rarely."""
        return tuple(marker for marker in self.markers if marker.weak)


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
    wrong = sorted((unit["drive"], one["marker"], one["text"]) for unit in units for one in unit["wrong"])
    return ProofReport(
        plan.name,
        terms,
        complete,
        _rates(units),
        _markers(plan, terms, units),
        tuple(_drive(plan, terms, drive, lane, units) for drive, lane in drives),
        tuple(wrong),
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
