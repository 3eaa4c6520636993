"""Strength and delivery of each marker's packets over distance -> its health."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from app.decoders.cerpm.path_loss import (
    NEAR_DBM,
    PAPER_EXPONENT,
    Estimate,
    PathLoss,
    audible_share,
    fit_offset,
    fit_path_loss,
    residual_correlation,
)
from app.decoders.cerpm.track_places import distances_m, vehicle_places
from app.decoders.cerpm.verify import VerifiedPacket
from app.errors import InvalidParameter
from app.sensors.pose_track import PoseTrack

Floats = npt.NDArray[np.float64]

ANTENNA_M = 1.5
"""Of the receiver above the road, where it is not known. [m]"""
LEAST_FLEET = 5
"""Markers with a profile that make a fleet to compare with."""
LEAST_LEVELS, LEAST_EXPECTED = 8, 10
_LEAST_TELLING = 4.0
"""Transmissions that a healthy marker would have been heard with; with fewer, silence tells nothing."""
_REACH_M, _MOST_SLOTS = 2000.0, 100_000
_PAUSE_S, _PAUSE_INTERVALS = 60.0, 20.0
_SIGMAS = 1.96


class SignalHealth(StrEnum):
    """What the radio tells of a marker."""

    HEALTHY = "healthy"
    WEAK = "weak"
    FAILING = "failing"
    NOT_ENOUGH_DATA = "not-enough-data"


@dataclass(frozen=True, slots=True)
class SignalRules:
    """Where weakness begins.

    Attributes
    ----------
    weak_db, failing_db : float
        Level below the line, negative. The interval of 95 % must lie below half of it. [dB]
    weak_share, failing_share : float
        Delivery ratio over that of the fleet; the whole interval of 95 % must lie below.
    sensitivity_dbm : float or None
        Of the receiver; fitted without. [dBm]
    antenna_height_m : float
        Of the receiver above the road. [m]
    """

    weak_db: float = -6.0
    failing_db: float = -12.0
    weak_share: float = 0.5
    failing_share: float = 0.25
    sensitivity_dbm: float | None = None
    antenna_height_m: float = ANTENNA_M

    def __post_init__(self) -> None:
        if not self.failing_db < self.weak_db < 0:
            raise InvalidParameter(
                "levels are negative, failing below weak", field="signal.weak_db", limit="below 0 dB"
            )
        if not 0 < self.failing_share < self.weak_share <= 1:
            raise InvalidParameter("shares lie between 0 and 1", field="signal.weak_share", limit="0 to 1")
        if not 0 < self.antenna_height_m <= 20:
            raise InvalidParameter(
                f"the antenna is {self.antenna_height_m:g} m above the road",
                field="receiver.antenna_height_m",
                limit="above 0, at most 20 m",
            )


@dataclass(frozen=True, slots=True, eq=False)
class SignalProfile:
    """One marker's radio.

    Attributes
    ----------
    number : int
    distance_m, rssi_dbm : ndarray, shape (P,)
        Of each packet, in the order heard; NaN where it is not known. [m, dBm]
    heard, expected : int
        Packets, and transmissions from the first one heard to the last of each pass, by their sequences.
    delivery : Estimate or None
        Ratio of both; None without sequences.
    nearest_m, farthest_m : float
        Of the packets heard; NaN where no place is known. [m]
    level_db : Estimate or None
        Above the fleet's line or, without a fleet, the paper's. [dB]
    against : str
        ``fleet`` or ``paper``.
    health : SignalHealth
    reason : str
        With the figures.
    """

    number: int
    distance_m: Floats
    rssi_dbm: Floats
    heard: int
    expected: int
    delivery: Estimate | None
    nearest_m: float
    farthest_m: float
    level_db: Estimate | None
    against: str
    health: SignalHealth
    reason: str


@dataclass(frozen=True, slots=True)
class SignalReport:
    """Profiles by number, and the path loss that they share; None where too few packets have a place."""

    profiles: dict[int, SignalProfile]
    path_loss: PathLoss | None


@dataclass(slots=True)
class _Heard:
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
    """RSSI over distance of each marker, and its health.

    Parameters
    ----------
    verified : iterable of VerifiedPacket
        Of `verify_packets`; only accepted ones count.
    places : mapping of int to (float, float)
        Longitude and latitude of markers by number. [deg]
    track : PoseTrack or None
        The vehicle's own positions; without it only delivery is known.
    rules : SignalRules, optional

    Returns
    -------
    SignalReport

    Notes
    -----
    One drive tells of a marker's radio through one car, one weather and one traffic: a verdict of a single drive is a
    reason to look again, not to dig it out.
    """
    rules = rules or SignalRules()
    antenna_m = rules.antenna_height_m
    heard = _gather(verified, places, track, antenna_m)
    line = _fleet_line(heard, rules)
    fleet = line is not None and sum(one.measured.sum() >= LEAST_LEVELS for one in heard) >= LEAST_FLEET
    compared = line if fleet and line is not None else _paper_line(line, rules)
    missed = _missed(heard, places, track, antenna_m)
    scene = _Scene("fleet" if fleet else "paper", compared, _correlation(heard, line), *missed)
    scene.set_heard_share(heard)
    deliveries = {one.number: _delivery(one) for one in heard}
    ratios = [e.value for _h, n, e in deliveries.values() if e is not None and n >= LEAST_EXPECTED]
    scene.usual = float(np.median(ratios)) if len(ratios) >= LEAST_FLEET else None
    return SignalReport({one.number: _profile(one, deliveries[one.number], scene, rules) for one in heard}, line)


@dataclass(slots=True)
class _Scene:
    """What all markers of a drive share.

    Attributes
    ----------
    against : str
    line : PathLoss
    correlation : float
    interval_s : float
        Between transmissions; NaN where it is not known. [s]
    missed_m : dict of int to ndarray
        Where the vehicle was at transmissions that were not heard. [m]
    heard_share : float
        Of strong transmissions.
    usual : float or None
        Delivery ratio in the middle of the fleet.
    """

    against: str
    line: PathLoss
    correlation: float
    interval_s: float
    missed_m: dict[int, Floats]
    heard_share: float = 0.7
    usual: float | None = None

    def set_heard_share(self, heard: Sequence[_Heard]) -> None:
        """From transmissions so near that only collisions can take them."""
        near = [audible_share(self.line, one.distance_m[one.measured]) > 0.97 for one in heard]
        lost = [
            audible_share(self.line, self.missed_m[one.number]) > 0.97 for one in heard if one.number in self.missed_m
        ]
        good, bad = sum(int(n.sum()) for n in near), sum(int(n.sum()) for n in lost)
        if good + bad >= 20:
            self.heard_share = min(max(good / (good + bad), 0.05), 0.98)


def _profile(
    one: _Heard, delivered: tuple[int, int, Estimate | None], scene: _Scene, rules: SignalRules
) -> SignalProfile:
    measured = one.measured
    missed_m = scene.missed_m.get(one.number, np.empty(0))
    distance_m, rssi_dbm = one.distance_m[measured], one.rssi_dbm[measured]
    telling = scene.heard_share * float(audible_share(scene.line, np.concatenate((distance_m, missed_m))).sum())
    level = None
    if measured.sum() >= LEAST_LEVELS or (len(missed_m) and telling >= _LEAST_TELLING):
        level = fit_offset(scene.line, distance_m, rssi_dbm, missed_m, scene.heard_share, scene.correlation)
    count, expected, delivery = delivered
    health, reason = _judge(level, scene.against, delivery, expected, scene.usual, rules)
    known = one.distance_m[np.isfinite(one.distance_m)]
    nearest_m, farthest_m = (float(known.min()), float(known.max())) if len(known) else (math.nan, math.nan)
    return SignalProfile(
        one.number, one.distance_m, one.rssi_dbm, count, expected, delivery, nearest_m, farthest_m, level,
        scene.against, health, reason,
    )  # fmt: skip


def _missed(
    heard: Sequence[_Heard], places: Mapping[int, tuple[float, float]], track: PoseTrack | None, antenna_m: float
) -> tuple[float, dict[int, Floats]]:
    """The interval of the markers, and how far the vehicle was at each transmission that it did not hear.

    Between two packets their sequences tell how many; before the first and after the last the interval does, for as
    long as the log and the track last.
    """
    steps = [np.diff(one.time_s) / np.diff(one.sequence) for one in heard if len(one.sequence) > 1]
    pooled = np.concatenate(steps) if steps else np.empty(0)
    pooled = pooled[np.isfinite(pooled) & (pooled > 0)]
    times = np.concatenate([one.time_s for one in heard]) if heard else np.empty(0)
    if track is None or len(pooled) < LEAST_EXPECTED or not np.isfinite(times).all():
        return math.nan, {}
    interval_s = float(np.median(pooled))
    start_s, end_s = max(times.min(), track.time_s[0]), min(times.max(), track.time_s[-1])
    if (end_s - start_s) / interval_s > _MOST_SLOTS:
        return interval_s, {}
    missed = {}
    for one in heard:
        if one.number not in places:
            continue
        gaps = np.maximum(np.diff(one.sequence).astype(int), 1)
        share = np.concatenate([np.arange(1, gap) / gap for gap in gaps]) if len(gaps) else np.empty(0)
        between = np.repeat(one.time_s[:-1], gaps - 1) + share * np.repeat(np.diff(one.time_s), gaps - 1)
        before = np.arange(one.time_s[0] - interval_s, start_s, -interval_s)
        after = np.arange(one.time_s[-1] + interval_s, end_s, interval_s)
        vehicle = vehicle_places(track, np.concatenate((before, between, after)))
        away = np.hypot(distances_m(vehicle, np.broadcast_to(places[one.number], vehicle.shape)), antenna_m)
        missed[one.number] = away[np.isfinite(away) & (away <= _REACH_M)]
    return interval_s, missed


def _gather(
    verified: Iterable[VerifiedPacket],
    places: Mapping[int, tuple[float, float]],
    track: PoseTrack | None,
    antenna_m: float,
) -> list[_Heard]:
    groups: dict[int, list[tuple[float, float, float]]] = defaultdict(list)
    for packet in verified:
        if packet.accepted and packet.number is not None and packet.message is not None:
            heard = packet.packet
            groups[packet.number].append((heard.heard_at_s, float(packet.message.sequence), heard.rssi_dbm))
    found = []
    for number in sorted(groups):
        rows = np.array(sorted(groups[number], key=lambda row: row[1]), float)
        distance = np.full(len(rows), np.nan)
        if track is not None and number in places:
            vehicle = vehicle_places(track, rows[:, 0])
            distance = np.hypot(distances_m(vehicle, np.broadcast_to(places[number], vehicle.shape)), antenna_m)
        found.append(_Heard(number, rows[:, 0], rows[:, 1], rows[:, 2], distance))
    return found


def _fleet_line(heard: Sequence[_Heard], rules: SignalRules) -> PathLoss | None:
    distance = [one.distance_m[one.measured] for one in heard]
    if not distance:
        return None
    rssi = np.concatenate([one.rssi_dbm[one.measured] for one in heard])
    group = np.concatenate([np.full(len(d), one.number) for one, d in zip(heard, distance, strict=True)])
    return fit_path_loss(np.concatenate(distance), rssi, group, rules.sensitivity_dbm)


def _paper_line(fitted: PathLoss | None, rules: SignalRules) -> PathLoss:
    """The line through the paper's two points, with the spread and sensitivity that were fitted if they were."""
    level, exponent = Estimate(NEAR_DBM, NEAR_DBM, NEAR_DBM), Estimate(PAPER_EXPONENT, PAPER_EXPONENT, PAPER_EXPONENT)
    spread = 4.5 if fitted is None else fitted.spread_db
    sensitivity = rules.sensitivity_dbm if rules.sensitivity_dbm is not None else -150.0
    if fitted is not None:
        sensitivity = fitted.sensitivity_dbm
    return PathLoss(level, exponent, spread, sensitivity, 2, False)


def _correlation(heard: Sequence[_Heard], line: PathLoss | None) -> float:
    if line is None:
        return 0.5
    residual = [one.rssi_dbm[one.measured] - line.rssi_dbm(one.distance_m[one.measured]) for one in heard]
    group = np.concatenate([np.full(len(r), one.number) for one, r in zip(heard, residual, strict=True)])
    return residual_correlation(np.concatenate(residual), group)


def _delivery(one: _Heard) -> tuple[int, int, Estimate | None]:
    """Packets heard, transmissions that there were, and their ratio with Wilson's interval."""
    heard = len(one.sequence)
    if heard < 2:
        return heard, heard, None
    gaps = np.diff(one.sequence)
    pauses = np.diff(one.time_s)
    interval = float(np.median(pauses / np.maximum(gaps, 1))) if np.isfinite(pauses).all() else math.nan
    limit_s = max(_PAUSE_S, _PAUSE_INTERVALS * interval) if interval > 0 else math.inf
    with np.errstate(invalid="ignore"):
        away = pauses > limit_s  # the vehicle was out of reach between two passes
    expected = int(gaps[~away].sum() + away.sum() + 1)
    return heard, expected, _wilson(heard, expected)


def _wilson(good: int, count: int) -> Estimate:
    share, square = good / count, _SIGMAS**2
    middle = (share + square / (2 * count)) / (1 + square / count)
    reach = _SIGMAS * math.sqrt(share * (1 - share) / count + square / (4 * count**2)) / (1 + square / count)
    return Estimate(share, max(middle - reach, 0.0), min(middle + reach, 1.0))


def _judge(
    level: Estimate | None,
    against: str,
    delivery: Estimate | None,
    expected: int,
    usual: float | None,
    rules: SignalRules,
) -> tuple[SignalHealth, str]:
    told = []
    level_known = level is not None and level.high - level.low <= -2 * rules.failing_db
    if level is not None:
        told.append(f"level {level.value:+.1f} dB ({level.low:+.1f} to {level.high:+.1f}) against the {against}'s line")
    delivery_known = delivery is not None and expected >= LEAST_EXPECTED
    if delivery is not None:
        told.append(
            f"{100 * delivery.value:.0f} % ({100 * delivery.low:.0f} to {100 * delivery.high:.0f} %) of {expected} "
            "transmissions heard" + ("" if usual is None else f", usual {100 * usual:.0f} %")
        )
    figures = "; ".join(told) or "too few packets to tell"
    for health, least_db, share in (
        (SignalHealth.FAILING, rules.failing_db, rules.failing_share),
        (SignalHealth.WEAK, rules.weak_db, rules.weak_share),
    ):
        if level is not None and level_known and level.value <= least_db and level.high <= least_db / 2:
            return health, figures
        if usual is not None and delivery is not None and delivery_known and delivery.high < share * usual:
            return health, figures
    if level_known or (delivery_known and usual is not None):
        return SignalHealth.HEALTHY, figures
    return SignalHealth.NOT_ENOUGH_DATA, figures
