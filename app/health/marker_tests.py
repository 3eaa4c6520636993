"""Wald's sequential tests of one marker over drives, with the evidence of each vehicle bounded, and their priority."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.health.states import (
    READING_LEVELS,
    RULES,
    Evidence,
    FarEntry,
    Fault,
    HealthRules,
    LonLat,
    MarkerState,
    OffsetEntry,
    Pass,
    VehicleState,
    Verdict,
)
from app.values import Floats

# === Likelihood ratios of the tests, for many markers at once.


DISPLACEMENT_M, DISPLACEMENT_SHARE = (1.5, 15.0), (0.9, 0.1)
"""Standard deviations of a moved marker's displacement before it is seen, each axis [m], and how common they are:
pushed aside, or installed or programmed at another place."""
WIDE_SHARE, WIDE_SIGMAS = 0.05, 3.0
"""Share of offsets with so many times the stated error. Position errors have heavy tails."""
OUTLIER_SHARE, OUTLIER_M = 0.02, 10.0
"""Share of offsets that are wrong altogether, evenly within this distance [m]."""
DISC_POINTS = 8
"""Points on the edge of the disc in which a marker counts as not moved."""
_OUTLIER_DENSITY = OUTLIER_SHARE / (np.pi * OUTLIER_M**2)


def _normal(square: Floats, variance: Floats) -> Floats:
    """Density of a normal distribution on the plane, by the squared distance. [1/m2]"""
    return np.asarray(np.exp(-0.5 * square / variance) / (2.0 * np.pi * variance))


def _offset_density(square: Floats, variance: Floats, spread: Floats | float) -> Floats:
    """Density of an offset by its squared distance from where it is expected, with what that is uncertain by [m2]."""
    near = _normal(square, variance + spread)
    wide = _normal(square, WIDE_SIGMAS**2 * variance + spread)
    return (1.0 - WIDE_SHARE - OUTLIER_SHARE) * near + WIDE_SHARE * wide + _OUTLIER_DENSITY


def moved_ratios(
    offset_m: Floats, sigma_m: Floats, used: npt.NDArray[np.bool_], disc_m: Floats, bound: float
) -> tuple[Floats, Floats]:
    """Log-likelihood ratio of a marker that has moved against one that has not, and where it is.

    Parameters
    ----------
    offset_m : ndarray, shape (M, K, 2)
        Of M markers as K vehicles saw them, in the order of their passes. [m]
    sigma_m : ndarray, shape (M, K)
        Standard deviation on each axis. [m]
    used : ndarray of bool, shape (M, K)
    disc_m : ndarray, shape (M,)
        A marker within it has not moved. [m]
    bound : float
        What one vehicle adds at most. [nat]

    Returns
    -------
    ratio : ndarray, shape (M,)
        [nat]
    displacement_m : ndarray, shape (M, 2)
        Estimated. [m]

    Notes
    -----
    The displacement is not known, so each pass is predicted from the passes before it: the product of such predictions
    is a likelihood, and the bound of Wald's test holds for it (Robbins and Siegmund, Annals of Statistics 2, 1974). The
    marker that has not moved is taken where it fits the passes best within the disc.
    """
    angle = 2.0 * np.pi * np.arange(DISC_POINTS) / DISC_POINTS
    ring = np.vstack([np.zeros((1, 2)), np.column_stack([np.cos(angle), np.sin(angle)])])
    points = disc_m[:, None, None] * ring
    parts = [_moved_by(offset_m, sigma_m, used, points, sigma, bound) for sigma in DISPLACEMENT_M]
    totals = np.stack([total + np.log(share) for (total, _), share in zip(parts, DISPLACEMENT_SHARE, strict=True)])
    likelier = totals.min(axis=2).argmax(axis=0)
    mean = np.stack([mean for _, mean in parts])[likelier, np.arange(len(offset_m))]
    return np.logaddexp(totals[0], totals[1]).min(axis=1), mean


def _moved_by(
    offset_m: Floats, sigma_m: Floats, used: npt.NDArray[np.bool_], points: Floats, displacement_m: float, bound: float
) -> tuple[Floats, Floats]:
    """Ratios against each point of the disc, and the estimated displacement, for one size of displacements."""
    total = np.zeros((len(offset_m), points.shape[1]))
    weight = np.full(len(offset_m), 1.0 / displacement_m**2)
    mean = np.zeros((len(offset_m), 2))
    variance = sigma_m**2
    for k in range(offset_m.shape[1]):
        seen, var = offset_m[:, k], variance[:, k]
        moved = _offset_density(((seen - mean) ** 2).sum(axis=1), var, 1.0 / weight)
        stayed = _offset_density(((seen[:, None, :] - points) ** 2).sum(axis=2), var[:, None], 0.0)
        gain = np.clip(np.log(moved)[:, None] - np.log(stayed), -bound - 2.0, bound)
        total += np.where(used[:, k, None], gain, 0.0)
        # an outlier moves the estimate little: its weight is the probability that it is none
        trust = np.where(used[:, k], 1.0 - _OUTLIER_DENSITY / moved, 0.0)
        added = trust / var
        mean += (added / (weight + added))[:, None] * (seen - mean)
        weight += added
    return total, mean


def missing_gain(
    probability: float, levels: list[float], factors: tuple[float, ...], false_read: float
) -> tuple[float, list[float]]:
    """Log-likelihood ratio of a miss for a marker that is gone, and the probabilities of its factors after the miss.

    Parameters
    ----------
    probability : float
        That this vehicle reads a healthy, clean marker.
    levels, factors : sequence of float
        Probabilities of the factors on it, by the marker's record.
    false_read : float
        That a marker is read that is gone.
    """
    misses = [level * (1.0 - factor * probability) for level, factor in zip(levels, factors, strict=True)]
    total = sum(misses)
    return float(np.log1p(-false_read) - np.log(total)), [miss / total for miss in misses]


def after_reading(levels: list[float], factors: tuple[float, ...]) -> list[float]:
    """Probabilities of the factors after a reading."""
    reads = [level * factor for level, factor in zip(levels, factors, strict=True)]
    total = sum(reads)
    return [read / total for read in reads]


def shift_gain(value: float, shift: float, variance: float) -> float:
    """Log-likelihood ratio of a normal value that is shifted. [nat]"""
    return shift * (value - 0.5 * shift) / variance


# === Priority of an item of the work list.


URGENCY: Mapping[str, float] = {
    "wrong-way-driver": 1.0,
    "wrong-way": 0.9,
    "cloned": 0.9,
    "moved": 0.8,
    "shifted": 0.8,
    "turned": 0.8,
    "missing": 0.6,
    "unregistered": 0.5,
    "fading": 0.4,
    "loose": 0.7,
    "damaged": 0.6,
    "dirty": 0.4,
    "other": 0.4,
}
"""How much a fault can mislead a vehicle: a marker that shows a wrong place is worse than one that shows none. The last
four, and `missing`, are kinds of damage that people report; a loose marker can also hurt somebody."""
SAFETY_ROLE, USUAL_ROLE = 1.0, 0.8
"""Of markers whose meaning vehicles act on (stop line, speed limit, bend), and of all others."""
BUSY_PASSES = 3000.0
"""Passes in a month from which traffic weighs most, a hundred a day."""


def item_priority(what: str, *, acted_on: bool, ratio: float, limit: float, month_passes: float) -> float:
    """Priority from 0 to 1: urgency x safety role x certainty x traffic.

    Parameters
    ----------
    what : str
        A fault, a reported kind of damage, or ``wrong-way-driver``, which is always first.
    acted_on : bool
        Vehicles act on the marker's meaning.
    ratio, limit : float
        Of the test. [nat]
    month_passes : float
        Passes in a month.

    Notes
    -----
    Certainty rises from 0.8 at the limit to 1 at twice the limit; traffic from 0.7 without passes to 1 at `BUSY_PASSES`
    by the logarithm.
    """
    if what == "wrong-way-driver":
        return 1.0
    role = SAFETY_ROLE if acted_on else USUAL_ROLE
    certainty = 0.8 + 0.2 * min(max(ratio / limit - 1.0, 0.0), 1.0) if limit > 0 else 0.8
    traffic = 0.7 + 0.3 * min(math.log1p(month_passes) / math.log1p(BUSY_PASSES), 1.0)
    return round(URGENCY[what] * role * certainty * traffic, 4)


# === Wald's sequential tests of one marker, with the evidence of each vehicle bounded.


MAX_OFFSETS = 12
"""Vehicles in the test for a moved marker; older ones are forgotten. Four to six decide."""
MAX_FAR = 32
MAX_SHARES = 128
"""Vehicles that a test remembers. A plate in doubt between dirty and gone needs about fifty."""
FALSE_READ = 0.002
"""Probability that a marker is read that is gone: a misread that fits."""
FORGETTING = 0.02
"""Share by which the record of a marker's reading returns to the usual at each pass. Fifty passes."""
READ_REVERSED, READ_LEGAL = 0.98, 0.005
"""Probability that a pass finds a marker reversed which is, and which is not."""
ALONE_BOUND = 2.5
"""[nat] at most of a reversed marker that is met without another one: the driver may be on the wrong way."""
FADED, QUALITY_VARIANCE = -3.0, 1.8
"""Standard deviations of quality by which a faded marker is below its record, and the variance of a pass's quality, of
the marker's own and of the drive's with it."""
MAX_QUALITY_RECORD, MIN_QUALITY_RECORD = 50.0, 10.0
"""Passes that a marker's usual quality rests on, at most and at least."""
FAR_MISREAD = 0.005
"""Probability of a reading far away that is none. Wrong coarse positions and misread codes."""
SAME_PLACE_M, FAR_MEMORY_S = 50.0, 60 * 86_400.0
"""[m, s] two far readings that are as near to each other and as young count together."""
UNREGISTERED_MISREAD = 0.01
"""Probability that a code is read, at the same place, that is not there. Decoders refuse below 1 %."""


def update_marker(
    state: MarkerState, evidence: Evidence, vehicle: str, at_s: float, rules: HealthRules = RULES
) -> list[Verdict]:
    """Add the evidence of a pass to the tests of its marker.

    Parameters
    ----------
    state : MarkerState
        Changed in place.
    evidence : Evidence
        Of `judge_drive`.
    vehicle : str
        Who passed: what one vehicle adds to a test is bounded.
    at_s : float
        When it passed. [s since 1970]

    Returns
    -------
    list of Verdict
        Faults that are suspected now, with those that were suspected before and still are.
    """
    at_place = evidence.read and evidence.elsewhere is None
    if evidence.elsewhere is None or evidence.read_probability > 0.0:
        state.count(at_s, read=at_place)
    state.survey_m = evidence.survey_m
    found = [
        _test_missing(state, evidence, vehicle, at_s, rules, at_place=at_place),
        _test_moved(state, evidence, vehicle, at_s, rules),
        _test_far(state, evidence, vehicle, at_s, rules),
        _test_direction(state, evidence, vehicle, at_s, rules),
        _test_quality(state, evidence, vehicle, at_s, rules),
    ]
    limited = [_limited(one, rules.upper(one.fault, state.month_passes)) for one in found if one is not None]
    return [one for one in limited if one.ratio >= one.limit]


def update_unregistered(
    state: MarkerState, confidence: float, vehicle: str, at_s: float, rules: HealthRules = RULES
) -> list[Verdict]:
    """Add a reading of a code at a place where none is registered; see `update_marker`."""
    state.count(at_s, read=True)
    gain = min(-math.log(UNREGISTERED_MISREAD + (1.0 - confidence)), rules.vehicle_bound)
    verdict = _add_share(state, Fault.UNREGISTERED, vehicle, max(gain, 0.0), at_s, rules)
    upper = rules.upper(Fault.UNREGISTERED, state.month_passes)
    return [_limited(verdict, upper)] if verdict is not None and verdict.ratio >= upper else []


def _limited(verdict: Verdict, upper: float) -> Verdict:
    return Verdict(
        verdict.fault, verdict.ratio, upper, verdict.vehicles, verdict.passes, verdict.since_s, verdict.offset_m,
        verdict.elsewhere,
    )  # fmt: skip


def _add_share(
    state: MarkerState, fault: Fault, vehicle: str, gain: float, at_s: float, rules: HealthRules,
    *, bound: float | None = None,
) -> Verdict | None:  # fmt: skip
    """Add to a vehicle's share of a test, bounded; the verdict if enough vehicles have one and the test goes on."""
    shares = state.shares.setdefault(fault, {})
    if vehicle in shares or len(shares) < MAX_SHARES:
        limit = rules.vehicle_bound if bound is None else bound
        shares[vehicle] = max(-rules.vehicle_bound - 2.0, min(shares.get(vehicle, 0.0) + gain, limit))
    ratio = math.fsum(shares.values())
    state.since.setdefault(fault, at_s)
    if ratio <= rules.lower:
        state.reset(fault)
        return None
    state.ratios[fault] = ratio
    vehicles = _supporters(shares)
    if vehicles < rules.vehicles:
        return None
    return Verdict(fault, ratio, math.inf, vehicles, len(shares), state.since[fault])


def _supporters(shares: Mapping[str, float]) -> int:
    return sum(share > 0.0 for share in shares.values())


def _test_missing(
    state: MarkerState, evidence: Evidence, vehicle: str, at_s: float, rules: HealthRules, *, at_place: bool
) -> Verdict | None:
    factors, usual = READING_LEVELS.get(state.family, READING_LEVELS["magnet"])
    if at_place:
        state.reset(Fault.MISSING)
        if evidence.read_probability > 0.0:
            state.levels = _forgotten(after_reading(state.levels, factors), usual)
        return None
    if evidence.read or evidence.read_probability <= 0.0:
        return None
    gain, levels = missing_gain(evidence.read_probability, state.levels, factors, FALSE_READ)
    state.levels = _forgotten(levels, usual)
    return _add_share(state, Fault.MISSING, vehicle, gain, at_s, rules)


def _forgotten(levels: list[float], usual: tuple[float, ...]) -> list[float]:
    return [(1.0 - FORGETTING) * level + FORGETTING * common for level, common in zip(levels, usual, strict=True)]


def _test_moved(
    state: MarkerState, evidence: Evidence, vehicle: str, at_s: float, rules: HealthRules
) -> Verdict | None:
    if evidence.offset_m is None:
        return None
    _add_offset(state, evidence, vehicle, at_s)
    entries = state.offsets
    count = len(entries)
    # a test may begin with each of the passes: what was seen before the marker moved must not hold it back
    ratio, displacement_m = moved_ratios(
        np.tile(np.array([(one.east_m, one.north_m) for one in entries]), (count, 1, 1)),
        np.tile(np.array([one.sigma_m for one in entries]), (count, 1)),
        np.triu(np.ones((count, count), dtype=bool)),
        np.full(count, max(rules.disc_m, 2.0 * state.survey_m)),
        rules.vehicle_bound,
    )
    best = int(np.argmax(ratio))
    if ratio[best] <= rules.lower:
        state.ratios.pop(Fault.MOVED, None)
        state.offsets = []
        return None
    state.offsets = entries = entries[best:]
    state.ratios[Fault.MOVED] = float(ratio[best])
    east_m, north_m = (float(value) for value in displacement_m[best])
    if len(entries) < rules.vehicles or math.hypot(east_m, north_m) < rules.moved_m:
        return None
    return Verdict(
        Fault.MOVED, float(ratio[best]), math.inf, len(entries), sum(one.passes for one in entries),
        min(one.at_s for one in entries), (east_m, north_m),
    )  # fmt: skip


def _add_offset(state: MarkerState, evidence: Evidence, vehicle: str, at_s: float) -> None:
    """Add an offset to that of its vehicle: further passes of one vehicle share its errors, so sigma stays."""
    assert evidence.offset_m is not None
    east_m, north_m = evidence.offset_m
    for entry in state.offsets:
        if entry.vehicle == vehicle:
            entry.passes += 1
            entry.east_m += (east_m - entry.east_m) / entry.passes
            entry.north_m += (north_m - entry.north_m) / entry.passes
            entry.sigma_m = min(entry.sigma_m, evidence.sigma_m)
            return
    state.offsets = [*state.offsets, OffsetEntry(vehicle, at_s, east_m, north_m, evidence.sigma_m)][-MAX_OFFSETS:]


def _test_far(state: MarkerState, evidence: Evidence, vehicle: str, at_s: float, rules: HealthRules) -> Verdict | None:
    """A marker that is read far from its place: cloned if it is also read at its place meanwhile, else moved."""
    if evidence.elsewhere is None and not evidence.two_places:
        return None
    kept = [one for one in state.far if at_s - one.at_s <= FAR_MEMORY_S and one.vehicle != vehicle]
    state.far = [*kept, FarEntry(vehicle, at_s, evidence.elsewhere)][-MAX_FAR:]
    together = [one for one in state.far if _same_place(one.place, evidence.elsewhere)]
    ratio = len(together) * min(-math.log(FAR_MISREAD), rules.vehicle_bound)
    first_s = min(one.at_s for one in together)
    is_cloned = evidence.two_places or state.read_s >= first_s
    fault = Fault.CLONED if is_cloned else Fault.MOVED
    state.ratios[fault] = max(ratio, state.ratios.get(fault, ratio))
    if len(together) < rules.vehicles:
        return None
    place = evidence.elsewhere
    return Verdict(fault, ratio, math.inf, len(together), len(together), first_s, None, place)


def _same_place(one: LonLat | None, other: LonLat | None) -> bool:
    if one is None or other is None:
        return True
    north_m = 111_320.0 * (one[1] - other[1])
    east_m = 111_320.0 * math.cos(math.radians(one[1])) * ((one[0] - other[0] + 180.0) % 360.0 - 180.0)
    return math.hypot(east_m, north_m) <= SAME_PLACE_M


def _test_direction(
    state: MarkerState, evidence: Evidence, vehicle: str, at_s: float, rules: HealthRules
) -> Verdict | None:
    if evidence.reversed is None:
        return None
    if evidence.reversed:
        gain, bound = math.log(READ_REVERSED / READ_LEGAL), ALONE_BOUND if evidence.alone else rules.vehicle_bound
    else:
        gain, bound = math.log((1 - READ_REVERSED) / (1 - READ_LEGAL)), rules.vehicle_bound
    return _add_share(state, Fault.WRONG_WAY, vehicle, gain, at_s, rules, bound=bound)


def _test_quality(
    state: MarkerState, evidence: Evidence, vehicle: str, at_s: float, rules: HealthRules
) -> Verdict | None:
    if evidence.quality is None:
        return None
    usual = state.quality if state.quality_passes >= MIN_QUALITY_RECORD else 0.0
    value = evidence.quality - usual
    if state.ratios.get(Fault.FADING, 0.0) <= 0.0 or state.quality_passes < MIN_QUALITY_RECORD:
        state.quality_passes = min(state.quality_passes + 1.0, MAX_QUALITY_RECORD)
        state.quality += max(-1.0, min(1.0, evidence.quality - state.quality)) / state.quality_passes
    return _add_share(state, Fault.FADING, vehicle, shift_gain(value, FADED, QUALITY_VARIANCE), at_s, rules)


# === The vehicle's own errors, estimated from all markers of its drive before any marker is judged.
#
# A camera that is turned shifts every marker; fog, dirt on the lens and a dead sensor miss every marker; a driver on
# the wrong way meets every marker reversed. So each pass is compared with the passes of other markers beside it.


BESIDE = 6
"""Passes on each side that a pass is compared with. A kilometre of plates 80 m apart."""
MIN_OTHERS = 3
"""Other markers for a common shift: of three, one may have moved. Source: the median's breakdown point."""
MIN_EXPECTED = 0.3
"""Reading probability below which a pass is no evidence of a missing marker."""
RECENT_PASSES = 6.0
"""Passes of its last minutes that a vehicle's reading rate rests on besides those of the drive."""
DOUBT_PASSES = 0.7
"""Misses that are added to those of a drive, because its rate is estimated from few passes. Source: as the predictive
probability of a binomial with Jeffreys' prior."""
RATE_LIMITS = (0.05, 1.0)
_MAX_PROBABILITY = 0.95  # a truck in front hides a marker in some percent of passes
MIN_ALIVE = 0.5
"""Readings of other markers, the decaying ones of the last minutes with them, without which a miss is no evidence."""
SILENT_DRIVE_FACTOR = {"cerpm": 0.5}
"""By family: factor on the reading probability of its only marker on a drive that reads none. Nothing shows that the
receiver of CERPMs works, but fog and dirt do not stop it as they stop a camera; of other families such a drive is no
evidence. 65 drives find a CERPM gone."""
WRONG_WAY_SHARE = 0.6
"""Share of reversed markers from which the vehicle is on the wrong way."""
STATED_PASSES = 4.0
"""Passes that a decoder's own standard deviation weighs as much as. Source: `python -m benchmarks.health`."""
SIGMA_FLOOR_M = 0.08
"""[m] of what no model has: the road's cross fall, springs, the map. Each axis."""
_MAD_SIGMA, _MEDIAN_LOSS = 1.4826, 1.2533  # of a normal distribution: MAD to sigma, median's error to the mean's


@dataclass(frozen=True, slots=True)
class JudgedDrive:
    """Evidence of a drive on markers and on the vehicle."""

    evidence: list[Evidence]  # in the order of the passes
    wrong_way: bool  # the driver is on the wrong way
    only_one: bool  # a single marker shows it, which may itself be installed in reverse
    shift_m: tuple[float, float] | None  # [m] median offset, forward and left


def judge_drive(passes: Sequence[Pass], vehicle: VehicleState, at_s: float) -> JudgedDrive:
    """Evidence on each marker of a drive; the vehicle's record is updated.

    Parameters
    ----------
    passes : sequence of Pass
        One for each marker of one upload.
    vehicle : VehicleState
        Changed in place.
    at_s : float
        When the drive was recorded. [s since 1970]
    """
    vehicle.age(at_s)
    order = sorted(range(len(passes)), key=lambda k: passes[k].along)
    ordered = [passes[k] for k in order]
    probability = _read_probabilities(ordered, vehicle)
    offset_m, sigma_m, shift_m = _offsets(ordered, vehicle)
    is_reversed, wrong_way, only_one = _directions(ordered)
    quality = _qualities(ordered)
    evidence: list[Evidence | None] = [None] * len(passes)
    for rank, (k, one) in enumerate(zip(order, ordered, strict=True)):
        known = bool(np.isfinite(sigma_m[rank]))
        evidence[k] = Evidence(
            one.marker_id, one.family, one.read, float(probability[rank]),
            (float(offset_m[rank, 0]), float(offset_m[rank, 1])) if known else None,
            float(sigma_m[rank]) if known else 0.0, one.survey_m, is_reversed[rank], only_one,
            float(quality[rank]) if np.isfinite(quality[rank]) else None, one.elsewhere, one.two_places,
        )  # fmt: skip
    vehicle.reads += sum(one.read for one in passes if one.expected >= MIN_EXPECTED)
    vehicle.expected += sum(one.expected for one in passes if one.expected >= MIN_EXPECTED)
    return JudgedDrive([one for one in evidence if one is not None], wrong_way, only_one, shift_m)


def _beside(values: Floats, families: Sequence[str] | None = None) -> Floats:
    """Values of the passes beside each pass but its own, shape (N, 2 BESIDE); NaN outside and of other families."""
    count = len(values)
    index = np.arange(count)[:, None] + np.array([k for k in range(-BESIDE, BESIDE + 1) if k])
    inside = (index >= 0) & (index < count)
    index = np.clip(index, 0, max(count - 1, 0))
    found = np.where(inside, values[index] if count else np.nan, np.nan)
    if families is not None and count:
        names = np.array(families)
        found = np.where(names[index] == names[:, None], found, np.nan)
    return np.asarray(found, dtype=np.float64)


def _median(values: Floats) -> Floats:
    """Medians of values of shape (N, K, D) over K without NaN, shape (N, D); NaN where there is no value."""
    ordered = np.sort(values, axis=1)  # NaN comes last
    count = np.isfinite(values).sum(axis=1, keepdims=True)
    low, high = np.maximum((count - 1) // 2, 0), np.minimum(count // 2, values.shape[1] - 1)
    both = np.take_along_axis(ordered, low, axis=1) + np.take_along_axis(ordered, high, axis=1)
    return np.asarray(np.where(count > 0, both / 2.0, np.nan)[:, 0, :])


def _read_probabilities(passes: Sequence[Pass], vehicle: VehicleState) -> Floats:
    """That this vehicle reads each marker, from the markers beside it and from its last minutes; 0 is no evidence."""
    expected = np.array([one.expected for one in passes])
    enough = expected >= MIN_EXPECTED
    families = [one.family for one in passes]
    reads = np.nansum(_beside(np.where(enough, [one.read for one in passes], np.nan).astype(float), families), axis=1)
    others = np.nansum(_beside(np.where(enough, expected, np.nan), families), axis=1)
    alive = reads + vehicle.reads
    recent = 1.0 + min(vehicle.expected, RECENT_PASSES)
    record = recent * min((vehicle.reads + 1.0) / (vehicle.expected + 1.0), 1.0)
    read = np.array([one.read for one in passes], dtype=np.float64)
    alike = (np.array(families)[:, None] == np.array(families)).astype(np.float64)
    all_reads, all_others = alike @ (enough * read) - enough * read, alike @ (enough * expected) - enough * expected
    rate = np.minimum(
        (reads + record) / (others + recent + DOUBT_PASSES), (all_reads + record) / (all_others + recent + DOUBT_PASSES)
    )
    probability = np.minimum(expected * np.clip(rate, *RATE_LIMITS), _MAX_PROBABILITY)
    is_lone = (all_others <= 0.0) & (vehicle.expected < MIN_EXPECTED)
    silent = np.array([SILENT_DRIVE_FACTOR.get(family, 0.0) for family in families]) * is_lone
    return np.where(enough, np.where(alive >= MIN_ALIVE, 1.0, silent) * probability, 0.0)


def _offsets(passes: Sequence[Pass], vehicle: VehicleState) -> tuple[Floats, Floats, tuple[float, float] | None]:
    """Offsets less the drive's common shift [m], their standard deviations (NaN: none) and the shift."""
    raw = np.array([one.offset_m or (np.nan, np.nan) for one in passes], dtype=np.float64).reshape(-1, 2)
    stated = np.array([one.sigma_m for one in passes])
    absolute = np.array([one.offset_is_absolute for one in passes], dtype=bool)
    found = np.isfinite(raw[:, 0])
    sigma = np.where(found, np.hypot(stated, SIGMA_FLOOR_M), np.nan)
    by_position = found & ~absolute
    if not by_position.any():
        return raw, sigma, None
    heading = np.radians([one.heading_deg or 0.0 for one in passes])
    axes = np.stack([np.sin(heading), np.cos(heading), -np.cos(heading), np.sin(heading)], axis=1).reshape(-1, 2, 2)
    in_vehicle = np.einsum("nij,nj->ni", axes, raw)
    shift, scatter = _common_shift(np.where(by_position[:, None], in_vehicle, np.nan), stated, passes, vehicle)
    common = np.median(in_vehicle[by_position], axis=0)
    vehicle.learn(float(common[0]), float(common[1]), int(by_position.sum()))
    rest = np.einsum("nji,nj->ni", axes, in_vehicle - shift)
    offset = np.where(by_position[:, None], rest, raw)
    return offset, np.where(by_position, scatter, sigma), (float(common[0]), float(common[1]))


def _common_shift(
    in_vehicle: Floats, stated: Floats, passes: Sequence[Pass], vehicle: VehicleState
) -> tuple[Floats, Floats]:
    """Shift of each pass by the passes beside it, or by the vehicle's record, and the error of what is left. [m]"""
    beside = np.stack([_beside(in_vehicle[:, 0]), _beside(in_vehicle[:, 1])], axis=2)
    others = np.isfinite(beside[:, :, 0]).sum(axis=1)
    median = _median(beside)
    spread = _MAD_SIGMA * _median(np.abs(beside - median[:, None, :])).mean(axis=1)
    by_others = others >= MIN_OTHERS
    own = np.array([np.nan if one.position_sigma_m is None else one.position_sigma_m for one in passes])
    shift = np.where(by_others[:, None], median, [vehicle.forward_m, vehicle.left_m])
    by_median = _MEDIAN_LOSS * spread / np.sqrt(np.maximum(others, 1))
    shift_sigma = np.where(by_others, by_median, np.hypot(own, vehicle.shift_sigma_m))
    # what the markers beside it scatter by, this one scatters by too; few of them are weak evidence of it
    pooled = (others * np.nan_to_num(spread) ** 2 + STATED_PASSES * stated**2) / (others + STATED_PASSES)
    variance = np.where(by_others, np.maximum(pooled, stated**2), stated**2)
    return shift, np.sqrt(variance + shift_sigma**2 + SIGMA_FLOOR_M**2)


def _directions(passes: Sequence[Pass]) -> tuple[list[bool | None], bool, bool]:
    """Whether each marker is reversed against the drive's others, whether the vehicle is on the wrong way, and whether
    one marker alone shows a direction.
    """
    shown = [one.reversed for one in passes if one.reversed is not None]
    reversed_ones = sum(shown)
    if len(shown) <= 2 and reversed_ones == 1:  # of two that differ, either may be right
        return [one.reversed for one in passes], len(shown) == 1, True
    wrong_way = reversed_ones > WRONG_WAY_SHARE * len(shown) and reversed_ones >= 2
    against = [None if one.reversed is None else one.reversed != wrong_way for one in passes]
    return against, wrong_way, False


def _qualities(passes: Sequence[Pass]) -> Floats:
    """Quality of each marker less the median of those beside it; NaN where there are fewer than two."""
    raw = np.array([np.nan if one.quality is None else one.quality for one in passes], dtype=np.float64)
    if not np.isfinite(raw).any():
        return raw
    beside = _beside(raw, [one.family for one in passes])
    others = np.isfinite(beside).sum(axis=1)
    median = _median(beside[:, :, None])[:, 0]
    relative = np.array([one.quality_is_relative for one in passes])
    return np.where(relative, raw, np.where(others >= 2, raw - median, np.nan))
