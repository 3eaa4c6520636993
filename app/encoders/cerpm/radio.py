"""Whether markers along a road can be read in time, and lawfully: every check of a radio plan in one place."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from app.encoders.cerpm.airtime import check_between
from app.encoders.cerpm.battery import Battery, battery_life_days
from app.encoders.cerpm.checks import RadioFinding, Verdict, at_least
from app.encoders.cerpm.collisions import Receiver, packet_success
from app.encoders.cerpm.hearing import (
    LANE_WIDTH_M,
    Air,
    Approach,
    RoadHearing,
    RoadMarkers,
    approach,
    hear_road,
    read_probability,
)
from app.encoders.cerpm.legal import check_legal
from app.encoders.cerpm.link import LinkModel
from app.encoders.cerpm.lorawan import DATA_RATES, Region
from app.encoders.cerpm.settings import RadioSettings
from app.encoders.magnet.checks import DECELERATION_MPS2, REACTION_S, reaction_distance_m
from app.markers.cerpm import MESSAGE_BYTES

CAMERA_PREVIEW_M = 31.0
"""What a camera sees of the lane ahead (CERPM paper, section 5): beacons that give less are no help. The controller's
look-ahead, 15 m (section 2.3.2), lies within. [m]"""
SPACING_M = 12.192
"""40 feet, the paper's. [m]"""
_SAMPLES = 60
_STATIONS = 200
_STATION_STEP_M = 5.0


@dataclass(frozen=True, slots=True)
class PreviewRule:
    """How far ahead a marker must have been read.

    Parameters
    ----------
    distance_m : float, optional
        Fixed, 1 to 2,000. By default it is the distance in which the vehicle stops, and at least the camera's 31 m. [m]
    reaction_s, deceleration_mps2 : float
        Of the driver or the system; AASHTO Green Book (2018), section 3.2.2, by default. [s], [m/s2]

    Raises
    ------
    InvalidParameter
        A value is outside its limits.
    """

    distance_m: float | None = None
    reaction_s: float = REACTION_S
    deceleration_mps2: float = DECELERATION_MPS2

    def __post_init__(self) -> None:
        if self.distance_m is not None:
            check_between("preview.distance_m", self.distance_m, 1.0, 2000.0, "m")
        check_between("preview.reaction_s", self.reaction_s, 0.0, 10.0, "s")
        check_between("preview.deceleration_mps2", self.deceleration_mps2, 0.5, 10.0, "m/s2")

    def needed_m(self, speed_mps: float) -> float:
        """At a speed. [m]"""
        if self.distance_m is not None:
            return self.distance_m
        return max(CAMERA_PREVIEW_M, reaction_distance_m(speed_mps, self.reaction_s, self.deceleration_mps2))


@dataclass(frozen=True, slots=True)
class RadioPlan:
    """Markers along a road, their radios, and what must come of it.

    Parameters
    ----------
    settings : RadioSettings
    region : Region
    spacing_m, sides, lane_width_m
        Of a long road with a marker every so far on so many sides; used where `markers` are not given.
        1 to 1,000 m; 1 or 2; 1 to 20 m.
    markers : RoadMarkers, optional
        Where they stand.
    design_speed_mps : float
        0.5 to 70. [m/s]
    preview : PreviewRule
    link : LinkModel
    receiver : Receiver
    battery : Battery
    least_probability : float
        That a marker is read before the preview distance, 0.5 to 0.9999.
    least_battery_days : float
        0 to 36,500. [day]

    Raises
    ------
    InvalidParameter
        A value is outside its limits.
    """

    settings: RadioSettings
    region: Region = Region.US915
    spacing_m: float = SPACING_M
    sides: int = 2
    lane_width_m: float = LANE_WIDTH_M
    markers: RoadMarkers | None = None
    design_speed_mps: float = 13.4
    preview: PreviewRule = field(default_factory=PreviewRule)
    link: LinkModel = field(default_factory=LinkModel)
    receiver: Receiver = field(default_factory=Receiver)
    battery: Battery = field(default_factory=Battery)
    least_probability: float = 0.99
    least_battery_days: float = 365.0

    def __post_init__(self) -> None:
        check_between("design_speed_mps", self.design_speed_mps, 0.5, 70.0, "m/s")
        check_between("least_probability", self.least_probability, 0.5, 0.9999, "")
        check_between("least_battery_days", self.least_battery_days, 0.0, 36_500.0, "days")
        RoadMarkers.evenly(self.spacing_m, 0.0, sides=self.sides, lane_width_m=self.lane_width_m)

    @property
    def preview_m(self) -> float:
        """How far ahead a marker must have been read. [m]"""
        return self.preview.needed_m(self.design_speed_mps)

    @property
    def air(self) -> Air:
        """What decides whether a packet is read."""
        return Air(self.settings, self.link, self.receiver)


@dataclass(frozen=True, slots=True, eq=False)
class RadioCheck:
    """What comes of a radio plan.

    Attributes
    ----------
    time_on_air_s, range_m, preview_m : float
        Of a packet; where its mean level falls to the receiver's sensitivity; how far ahead a marker must have been
        read. [s], [m], [m]
    road : RoadHearing
        Markers in range and share of packets read at points of the road; one spacing of it where it is even.
    packet_success : float
        Share of a marker's packets read at the preview distance, the least over the road's markers.
    read_probability : float
        That a marker is read in time, the least over the road's markers.
    battery_days : float
        [day]
    checks : tuple of RadioFinding
    """

    time_on_air_s: float
    range_m: float
    preview_m: float
    road: RoadHearing
    packet_success: float
    read_probability: float
    battery_days: float
    checks: tuple[RadioFinding, ...]

    @property
    def verdict(self) -> Verdict:
        """The worst of all checks."""
        found = {check.verdict for check in self.checks}
        return next((v for v in (Verdict.FAIL, Verdict.WARN) if v in found), Verdict.OK)


def check_radio(plan: RadioPlan) -> RadioCheck:
    """Check a radio plan: law, link, collisions, reading in time, battery.

    Raises
    ------
    InvalidParameter
        More than 20,000 markers matter to one receiver.

    Notes
    -----
    On a road with given markers every one, or 60 of them evenly chosen, is driven towards; the road before and after is
    taken to be without markers.
    """
    air, preview_m = plan.air, plan.preview_m
    markers, wanted = markers_of(plan)
    approaches = [approach(markers, index, preview_m, air) for index in wanted]
    probability = min(read_probability(heard, plan.design_speed_mps, air) for heard in approaches)
    success = min(_success_at_preview(heard, air) for heard in approaches)
    road = hear_road(markers, _stations(plan, markers), air)
    days = battery_life_days(plan.settings, plan.battery)
    checks = (
        *check_legal(plan.settings, plan.region),
        *_lorawan_room(plan),
        _level(plan),
        _channels(plan),
        _jitter(plan.settings),
        _probability(plan, probability, success, int(road.heard.max())),
        _battery(plan, days),
    )
    return RadioCheck(plan.settings.time_on_air_s, air.range_m, preview_m, road, success, probability, days, checks)


def markers_of(plan: RadioPlan) -> tuple[RoadMarkers, list[int]]:
    """Markers of a plan, and which of them are asked for."""
    if plan.markers is None:
        reach_m = plan.air.reach_m + plan.air.harm_m
        even = RoadMarkers.evenly(plan.spacing_m, reach_m, sides=plan.sides, lane_width_m=plan.lane_width_m)
        return even, [0]
    count = len(plan.markers.chainage_m)
    chosen = np.unique(np.linspace(0, count - 1, min(count, _SAMPLES)).round().astype(int))
    return plan.markers, np.argsort(plan.markers.chainage_m, kind="stable")[chosen].tolist()


def _stations(plan: RadioPlan, markers: RoadMarkers) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Points of the road: of an even one within one spacing, else every 5 m or 200 in all."""
    if plan.markers is None:
        return np.linspace(0.0, plan.spacing_m, 5)
    low, high = float(markers.chainage_m.min()), float(markers.chainage_m.max())
    return np.linspace(low, high, min(_STATIONS, 1 + math.ceil((high - low) / _STATION_STEP_M)))


def _success_at_preview(heard: Approach, air: Air) -> float:
    if len(heard.ahead_m) == 0:
        return 0.0
    return float(packet_success(heard.level_dbm[0], heard.harmful[0], air.settings, air.link, air.receiver))


def _lorawan_room(plan: RadioPlan) -> tuple[RadioFinding, ...]:
    """Whether LoRaWAN has a data rate of these settings, with room for the message."""
    if not plan.settings.lorawan:
        return ()
    modulation = (plan.settings.spreading_factor, plan.settings.bandwidth_hz)
    room = next(
        (r.payload_bytes for r in DATA_RATES[plan.region] if (r.spreading_factor, r.bandwidth_hz) == modulation), 0
    )
    sentence = f"application payload of this data rate in {plan.region}" if room else "no data rate of uplinks"
    return (at_least("lorawan-room", room, MESSAGE_BYTES, "bytes", "LoRaWAN Regional Parameters", sentence),)


def _level(plan: RadioPlan) -> RadioFinding:
    air = plan.air
    level_dbm = float(air.level_dbm(math.hypot(plan.preview_m, plan.lane_width_m / 2)))
    margin_db = level_dbm - air.threshold_dbm
    return at_least(
        "link-margin",
        margin_db,
        2 * plan.link.fading_db,
        "dB",
        "CERPM paper, section 4.1; SX1276 data sheet, table 10",
        f"{level_dbm:.1f} dBm at {plan.preview_m:.0f} m over {air.threshold_dbm:g} dBm; twice the fading is asked for",
        worst=Verdict.WARN if margin_db >= 0 else Verdict.FAIL,
    )


def _channels(plan: RadioPlan) -> RadioFinding:
    sends, hears = plan.settings.channels, plan.receiver.channels
    return at_least(
        "receiver-channels",
        min(hears, sends),
        sends,
        "channels",
        "packets are spread evenly over the channels",
        f"the receiver hears {min(1.0, hears / sends):.0%} of the channels at once",
        worst=Verdict.WARN,
    )


def _jitter(settings: RadioSettings) -> RadioFinding:
    return at_least(
        "jitter",
        2 * settings.jitter_share * settings.interval_s,
        2 * settings.time_on_air_s,
        "s",
        "pure ALOHA: packets begin independently",
        "span of the interval; with less, two markers that collide once go on colliding",
        worst=Verdict.WARN,
    )


def _probability(plan: RadioPlan, probability: float, success: float, heard: int) -> RadioFinding:
    return at_least(
        "read-in-time",
        probability,
        plan.least_probability,
        "probability",
        "pure ALOHA with capture; preview by AASHTO section 3.2.2 and the CERPM paper, section 5",
        f"that a marker is read before the vehicle is {plan.preview_m:.0f} m from it, at {plan.design_speed_mps:g} m/s "
        f"with {heard} markers in range; {success:.0%} of its packets are read there",
    )


def _battery(plan: RadioPlan, days: float) -> RadioFinding:
    return at_least(
        "battery-life",
        days,
        plan.least_battery_days,
        "days",
        "CERPM paper, section 2.2; SX1276 data sheet, table 6",
        f"{plan.battery.capacity_mah:g} mAh without being charged",
        worst=Verdict.WARN,
    )
