"""Wald's sequential tests of one marker, with the evidence of each vehicle bounded."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from app.health.likelihoods import after_reading, missing_gain, moved_ratios, shift_gain
from app.health.passes import Evidence, LonLat
from app.health.rules import READING_LEVELS, RULES, Fault, HealthRules
from app.health.states import FarEntry, MarkerState, OffsetEntry
from app.health.verdicts import Verdict

MAX_OFFSETS = 12
"""Vehicles in the test for a moved marker; older ones are forgotten. Source: by hand; four to six decide."""
MAX_FAR = 32
MAX_SHARES = 128
"""Vehicles that a test remembers. Source: by hand; a plate in doubt between dirty and gone needs about fifty."""
FALSE_READ = 0.002
"""Probability that a marker is read that is gone: a misread that fits. Source: by hand."""
FORGETTING = 0.02
"""Share by which the record of a marker's reading returns to the usual at each pass. Source: by hand, fifty passes."""
READ_REVERSED, READ_LEGAL = 0.98, 0.005
"""Probability that a pass finds a marker reversed which is, and which is not. Source: by hand."""
ALONE_BOUND = 2.5
"""[nat] at most of a reversed marker that is met without another one: the driver may be on the wrong way."""
FADED, QUALITY_VARIANCE = -3.0, 1.8
"""Standard deviations of quality by which a faded marker is below its record, and the variance of a pass's quality, of
the marker's own and of the drive's with it. Source: by hand."""
MAX_QUALITY_RECORD, MIN_QUALITY_RECORD = 50.0, 10.0
"""Passes that a marker's usual quality rests on, at most and at least. Source: by hand."""
FAR_MISREAD = 0.005
"""Probability of a reading far away that is none. Source: by hand; wrong coarse positions and misread codes."""
SAME_PLACE_M, FAR_MEMORY_S = 50.0, 60 * 86_400.0
"""[m, s] two far readings that are as near to each other and as young count together. Source: by hand."""
UNREGISTERED_MISREAD = 0.01
"""Probability that a code is read, at the same place, that is not there. Source: by hand; decoders refuse below 1 %."""


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
    rules : HealthRules, optional

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
