"""Strength and delivery of each marker's packets to the health of its radio."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from app.decoders.cerpm.merge import distances_m, vehicle_positions
from app.decoders.cerpm.verify import VerifiedPacket
from app.errors import InvalidParameter
from app.inputs import Declaration, Number
from app.radio.link import (
    EXPONENT,
    NEAR_DBM,
    Estimate,
    PathLoss,
    audible_share,
    fit_offset,
    fit_path_loss,
    residual_correlation,
)
from app.sensors.pose_track import PoseTrack
from app.values import Floats

ANTENNA_M = 1.5  # [m] of the receiver above the road if unknown; the roof of a car
MIN_FLEET = 5  # markers with a profile to compare a marker with
MIN_LEVELS = 8  # packets with strength and distance, for a level
MIN_EXPECTED = 10  # transmissions, for a delivery ratio
_MIN_AUDIBLE = 4.0  # expected receptions of a healthy marker for silence to be evidence; source: exp(-4), 2 % by chance
_REACH_M = 2000.0  # [m] source: `merge.MergeRules.reach_m`
_MAX_TRANSMISSIONS = 100_000  # of a marker in a drive, more are not reconstructed; a bound on memory
_PAUSE_S, _PAUSE_INTERVALS = 60.0, 20.0  # [s, intervals] longer silence is out of range
_SIGMAS = 1.96  # source: 95 % of a normal distribution
_CERTAIN_SHARE = 0.97  # chance of enough strength above which only collisions lose packets
_MIN_CERTAIN = 20  # such transmissions, for an estimate of collisions
_RECEIVED_SHARES = (0.05, 0.98)  # limits of the estimate; keep logarithms finite
_DEFAULT_RECEIVED_SHARE = 0.7  # of strong transmissions; source: 0.72 by ALOHA in `cerpm-radio` (docs/benchmarks.md)
_DEFAULT_SPREAD_DB = 4.5  # [dB] source: shadows of 4 dB and fading of 2 dB, `simulation.radio.link.Radio`
_DEFAULT_SENSITIVITY_DBM = (
    -150.0
)  # [dBm] no packet is too weak; source: below every receiver's, SX1276 data sheet: -148 dBm
_DEFAULT_CORRELATION = 0.5  # of consecutive packets; as `radio.link.residual_correlation`


class SignalHealth(StrEnum):
    """Health of a marker's radio."""

    HEALTHY = "healthy"
    WEAK = "weak"
    FAILING = "failing"
    NOT_ENOUGH_DATA = "not-enough-data"


class ReceiverDeclaration(Declaration):
    """The vehicle's radio receiver."""

    sensitivity_dbm: Number | None = Field(None, ge=-160, le=-40, description="Fitted if left out. [dBm]")
    antenna_height_m: Number | None = Field(
        None, gt=0, le=20, description=f"Above the road, {ANTENNA_M:g} if left out. [m]"
    )


class SignalRules(ReceiverDeclaration):
    """Limits of weak and failing radios, and the receiver."""

    # `weak_db`, `failing_db`: [dB] level below the line, negative. The 95 % interval must be below half of it.
    weak_db: float = -6.0  # [dB] source: half the range at the paper's exponent of 2.04
    failing_db: float = -12.0  # [dB] source: a quarter of the range
    # `weak_share`, `failing_share`: delivery ratio over that of the fleet; the whole 95 % interval must be below
    weak_share: float = 0.5
    failing_share: float = 0.25

    @model_validator(mode="after")
    def _failing_is_below_weak(self) -> SignalRules:
        if not self.failing_db < self.weak_db < 0:
            raise InvalidParameter("levels are negative, failing below weak", field="weak_db", limit="below 0 dB")
        if not 0 < self.failing_share < self.weak_share <= 1:
            raise InvalidParameter("shares lie between 0 and 1", field="weak_share", limit="0 to 1")
        return self


@dataclass(frozen=True, slots=True, eq=False)
class SignalProfile:
    """Strength and delivery of one marker's packets."""

    number: int
    # `distance_m`, `rssi_dbm`: shape (P,): of each packet, in the order received; NaN if unknown. [m, dBm]
    distance_m: Floats
    rssi_dbm: Floats
    # `received`, `expected`: packets, and transmissions from the first to the last packet of each pass, by their
    # sequences
    received: int
    expected: int
    delivery: Estimate | None  # ratio of both; None without sequences
    # `nearest_m`, `farthest_m`: [m] of the packets; NaN if no position is known
    nearest_m: float
    farthest_m: float
    level_db: Estimate | None  # [dB] above the fleet's line or, without a fleet, the paper's
    compared_with: str  # ``fleet`` or ``paper``
    health: SignalHealth
    reason: str  # with the figures


@dataclass(frozen=True, slots=True)
class SignalReport:
    """Profiles by number, and their common path loss; None if too few packets have a position."""

    profiles: dict[int, SignalProfile]
    path_loss: PathLoss | None


@dataclass(slots=True)
class _MarkerPackets:
    """Packets of one marker, by time."""

    number: int
    time_s: Floats
    sequence: Floats
    rssi_dbm: Floats
    distance_m: Floats

    @property
    def measured(self) -> npt.NDArray[np.bool_]:
        """Those with a distance and a strength."""
        return np.isfinite(self.distance_m) & np.isfinite(self.rssi_dbm)


def profile_signals(
    verified: Iterable[VerifiedPacket],
    places: Mapping[int, tuple[float, float]],
    track: PoseTrack | None,
    rules: SignalRules | None = None,
) -> SignalReport:
    """RSSI over distance of each marker, and the health of its radio.

    Parameters
    ----------
    verified : iterable of VerifiedPacket
        Of `verify_packets`; only accepted ones count.
    places : mapping of int to (float, float)
        Longitude and latitude of markers by number. [deg]
    track : PoseTrack or None
        The vehicle's own positions; without them only delivery is known.

    Returns
    -------
    SignalReport

    Notes
    -----
    One drive shows a marker's radio with one car, one weather and one traffic: the health from a single drive is a
    reason to check the marker, not to replace it.
    """
    rules = rules or SignalRules()
    antenna_m = rules.antenna_height_m or ANTENNA_M
    markers = _group_packets(verified, places, track, antenna_m)
    line = _fleet_line(markers, rules)
    fleet = line is not None and sum(one.measured.sum() >= MIN_LEVELS for one in markers) >= MIN_FLEET
    compared = line if fleet and line is not None else _paper_line(line, rules)
    missed = _missed_transmissions(markers, places, track, antenna_m)
    scene = _Scene("fleet" if fleet else "paper", compared, _correlation(markers, line), *missed)
    scene.set_received_share(markers)
    deliveries = {one.number: _delivery(one) for one in markers}
    ratios = [d.ratio.value for d in deliveries.values() if d.ratio is not None and d.expected >= MIN_EXPECTED]
    scene.usual = float(np.median(ratios)) if len(ratios) >= MIN_FLEET else None
    return SignalReport({one.number: _profile(one, deliveries[one.number], scene, rules) for one in markers}, line)


@dataclass(slots=True)
class _Scene:
    """Values common to all markers of a drive."""

    compared_with: str
    line: PathLoss
    correlation: float
    interval_s: float  # [s] between transmissions; NaN if unknown
    missed_m: dict[int, Floats]  # [m] distance of the vehicle at transmissions that were not received
    received_share: float = _DEFAULT_RECEIVED_SHARE  # share of strong transmissions that are received
    usual: float | None = None  # median delivery ratio of the fleet

    def set_received_share(self, markers: Sequence[_MarkerPackets]) -> None:
        """Estimate it from transmissions so near that only collisions can lose them."""
        near = [audible_share(self.line, one.distance_m[one.measured]) > _CERTAIN_SHARE for one in markers]
        lost = [
            audible_share(self.line, self.missed_m[one.number]) > _CERTAIN_SHARE
            for one in markers
            if one.number in self.missed_m
        ]
        good, bad = sum(int(n.sum()) for n in near), sum(int(n.sum()) for n in lost)
        if good + bad >= _MIN_CERTAIN:
            self.received_share = min(max(good / (good + bad), _RECEIVED_SHARES[0]), _RECEIVED_SHARES[1])


def _profile(one: _MarkerPackets, delivery: _Delivery, scene: _Scene, rules: SignalRules) -> SignalProfile:
    measured = one.measured
    missed_m = scene.missed_m.get(one.number, np.empty(0))
    distance_m, rssi_dbm = one.distance_m[measured], one.rssi_dbm[measured]
    audible = scene.received_share * float(audible_share(scene.line, np.concatenate((distance_m, missed_m))).sum())
    level = None
    if measured.sum() >= MIN_LEVELS or (len(missed_m) and audible >= _MIN_AUDIBLE):
        level = fit_offset(scene.line, distance_m, rssi_dbm, missed_m, scene.received_share, scene.correlation)
    health, reason = _rate_health(level, scene.compared_with, delivery, scene.usual, rules)
    known = one.distance_m[np.isfinite(one.distance_m)]
    nearest_m, farthest_m = (float(known.min()), float(known.max())) if len(known) else (math.nan, math.nan)
    return SignalProfile(
        number=one.number,
        distance_m=one.distance_m,
        rssi_dbm=one.rssi_dbm,
        received=delivery.received,
        expected=delivery.expected,
        delivery=delivery.ratio,
        nearest_m=nearest_m,
        farthest_m=farthest_m,
        level_db=level,
        compared_with=scene.compared_with,
        health=health,
        reason=reason,
    )


def _missed_transmissions(
    markers: Sequence[_MarkerPackets],
    places: Mapping[int, tuple[float, float]],
    track: PoseTrack | None,
    antenna_m: float,
) -> tuple[float, dict[int, Floats]]:
    """The interval of the markers, and the distance of the vehicle at each transmission that it did not receive.

    Only those within the log and the track count.
    """
    steps = [np.diff(one.time_s) / np.diff(one.sequence) for one in markers if len(one.sequence) > 1]
    pooled = np.concatenate(steps) if steps else np.empty(0)
    pooled = pooled[np.isfinite(pooled) & (pooled > 0)]
    times = np.concatenate([one.time_s for one in markers]) if markers else np.empty(0)
    if track is None or len(pooled) < MIN_EXPECTED or not np.isfinite(times).all():
        return math.nan, {}
    interval_s = float(np.median(pooled))
    start_s, end_s = max(times.min(), track.time_s[0]), min(times.max(), track.time_s[-1])
    if (end_s - start_s) / interval_s > _MAX_TRANSMISSIONS:
        return interval_s, {}
    missed = {}
    for one in markers:
        if one.number not in places:
            continue
        at_s = _missed_times_s(one, interval_s, start_s, end_s)
        vehicle = vehicle_positions(track, at_s)
        away = np.hypot(distances_m(vehicle, np.broadcast_to(places[one.number], vehicle.shape)), antenna_m)
        missed[one.number] = away[np.isfinite(away) & (away <= _REACH_M)]
    return interval_s, missed


def _missed_times_s(one: _MarkerPackets, interval_s: float, start_s: float, end_s: float) -> Floats:
    """Times from start to end at which a marker's transmissions were not received. [s]

    Between two packets, transmissions are counted by sequences; before the first and after the last packet by the
    interval. A packet whose clock is years off does not add more of them: times are computed only from start to end.
    """
    before_s = (
        one.time_s.min() - interval_s - _steps_s(one.time_s.min() - interval_s - end_s, interval_s, start_s, end_s)
    )
    after_s = (
        one.time_s.max() + interval_s + _steps_s(start_s - one.time_s.max() - interval_s, interval_s, start_s, end_s)
    )
    at_s = np.concatenate((before_s, _times_between_s(one, start_s, end_s), after_s))
    return at_s[(at_s >= start_s) & (at_s <= end_s)]


def _steps_s(away_s: float, interval_s: float, start_s: float, end_s: float) -> Floats:
    """Multiples of an interval from a distance on, as many as there may be from start to end. [s]"""
    first = max(math.ceil(away_s / interval_s), 0)
    return interval_s * (first + np.arange(math.ceil(max(end_s - start_s, 0.0) / interval_s) + 1, dtype=np.float64))


def _times_between_s(one: _MarkerPackets, start_s: float, end_s: float) -> Floats:
    """Times from start to end of the sequences between packets; none where they are implausibly many. [s]"""
    pause_s, steps = np.diff(one.time_s), np.diff(one.sequence)
    known = (pause_s > 0) & (steps > 1)
    earlier_s, steps = one.time_s[:-1][known], steps[known]
    step_s = pause_s[known] / steps
    lowest = np.maximum(np.ceil((start_s - earlier_s) / step_s), 1)
    highest = np.minimum(np.floor((end_s - earlier_s) / step_s), steps - 1)
    counts = np.maximum(highest - lowest + 1, 0)
    if not counts.sum() <= _MAX_TRANSMISSIONS:
        return np.empty(0)
    counts = counts.astype(np.int64)
    row = np.repeat(np.arange(len(counts)), counts)
    place = np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.asarray(earlier_s[row] + (lowest[row] + place) * step_s[row])


def _group_packets(
    verified: Iterable[VerifiedPacket],
    places: Mapping[int, tuple[float, float]],
    track: PoseTrack | None,
    antenna_m: float,
) -> list[_MarkerPackets]:
    """Accepted packets of each marker, with distances where the track gives them."""
    groups: dict[int, list[tuple[float, float, float]]] = defaultdict(list)
    for packet in verified:
        if packet.accepted and packet.number is not None and packet.message is not None:
            row = (packet.packet.received_at_s, float(packet.message.sequence), packet.packet.rssi_dbm)
            groups[packet.number].append(row)
    found = []
    for number in sorted(groups):
        rows = np.array(sorted(groups[number], key=lambda row: row[1]), float)
        distance = np.full(len(rows), np.nan)
        if track is not None and number in places:
            vehicle = vehicle_positions(track, rows[:, 0])
            distance = np.hypot(distances_m(vehicle, np.broadcast_to(places[number], vehicle.shape)), antenna_m)
        found.append(_MarkerPackets(number, rows[:, 0], rows[:, 1], rows[:, 2], distance))
    return found


def _fleet_line(markers: Sequence[_MarkerPackets], rules: SignalRules) -> PathLoss | None:
    """Path loss fitted to the packets of all markers."""
    distance = [one.distance_m[one.measured] for one in markers]
    if not distance:
        return None
    rssi = np.concatenate([one.rssi_dbm[one.measured] for one in markers])
    group = np.concatenate([np.full(len(d), one.number) for one, d in zip(markers, distance, strict=True)])
    return fit_path_loss(np.concatenate(distance), rssi, group, rules.sensitivity_dbm)


def _paper_line(fitted: PathLoss | None, rules: SignalRules) -> PathLoss:
    """The line through the paper's two points, with the fitted spread and sensitivity if there are any."""
    level, exponent = Estimate(NEAR_DBM, NEAR_DBM, NEAR_DBM), Estimate(EXPONENT, EXPONENT, EXPONENT)
    spread = _DEFAULT_SPREAD_DB if fitted is None else fitted.spread_db
    sensitivity = rules.sensitivity_dbm if rules.sensitivity_dbm is not None else _DEFAULT_SENSITIVITY_DBM
    if fitted is not None:
        sensitivity = fitted.sensitivity_dbm
    return PathLoss(level, exponent, spread, sensitivity, 2, False)


def _correlation(markers: Sequence[_MarkerPackets], line: PathLoss | None) -> float:
    if line is None:
        return _DEFAULT_CORRELATION
    residual = [one.rssi_dbm[one.measured] - line.rssi_dbm(one.distance_m[one.measured]) for one in markers]
    group = np.concatenate([np.full(len(r), one.number) for one, r in zip(markers, residual, strict=True)])
    return residual_correlation(np.concatenate(residual), group)


class _Delivery(NamedTuple):
    """Packets received, transmissions expected, and their ratio."""

    received: int
    expected: int
    ratio: Estimate | None


def _delivery(one: _MarkerPackets) -> _Delivery:
    """Delivery of a marker, with Wilson's interval; without a ratio for fewer than two packets."""
    received = len(one.sequence)
    if received < 2:
        return _Delivery(received, received, None)
    gaps = np.diff(one.sequence)
    pauses = np.diff(one.time_s)
    interval = float(np.median(pauses / np.maximum(gaps, 1))) if np.isfinite(pauses).all() else math.nan
    limit_s = max(_PAUSE_S, _PAUSE_INTERVALS * interval) if interval > 0 else math.inf
    with np.errstate(invalid="ignore"):
        away = pauses > limit_s  # the vehicle was out of reach between two passes
    expected = int(gaps[~away].sum() + away.sum() + 1)
    return _Delivery(received, expected, _wilson_interval(received, expected))


def _wilson_interval(good: int, count: int) -> Estimate:
    """Share with its 95 % interval. Source: Wilson, J. Am. Stat. Assoc. 22 (1927), 209."""
    share, square = good / count, _SIGMAS**2
    middle = (share + square / (2 * count)) / (1 + square / count)
    reach = _SIGMAS * math.sqrt(share * (1 - share) / count + square / (4 * count**2)) / (1 + square / count)
    return Estimate(share, max(middle - reach, 0.0), min(middle + reach, 1.0))


def _rate_health(
    level: Estimate | None, compared_with: str, delivery: _Delivery, usual: float | None, rules: SignalRules
) -> tuple[SignalHealth, str]:
    """Health by level and delivery, and the figures for people."""
    ratio, expected = delivery.ratio, delivery.expected
    parts = []
    level_known = level is not None and level.high - level.low <= -2 * rules.failing_db
    if level is not None:
        parts.append(
            f"level {level.value:+.1f} dB ({level.low:+.1f} to {level.high:+.1f}) against the {compared_with}'s line"
        )
    ratio_known = ratio is not None and expected >= MIN_EXPECTED
    if ratio is not None:
        parts.append(
            f"{100 * ratio.value:.0f} % ({100 * ratio.low:.0f} to {100 * ratio.high:.0f} %) of {expected} "
            "transmissions received" + ("" if usual is None else f", usual {100 * usual:.0f} %")
        )
    figures = "; ".join(parts) or "too few packets"
    for health, min_db, share in (
        (SignalHealth.FAILING, rules.failing_db, rules.failing_share),
        (SignalHealth.WEAK, rules.weak_db, rules.weak_share),
    ):
        if level is not None and level_known and level.value <= min_db and level.high <= min_db / 2:
            return health, figures
        if usual is not None and ratio is not None and ratio_known and ratio.high < share * usual:
            return health, figures
    if level_known or (ratio_known and usual is not None):
        return SignalHealth.HEALTHY, figures
    return SignalHealth.NOT_ENOUGH_DATA, figures
