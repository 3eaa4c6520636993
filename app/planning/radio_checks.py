"""Checks of a radio plan: whether markers along a road can be read in time, and lawfully."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from pydantic import Field

from app.errors import InvalidParameter, naming
from app.inputs import Number, Whole
from app.markers.cerpm import MESSAGE_BYTES
from app.markers.reading import RadioFinding, Verdict, at_least, worst_verdict
from app.planning.magnet_checks import DECELERATION_M_S2, REACTION_S, reaction_distance_m
from app.radio.link import LinkModel
from app.radio.reception import (
    LANE_WIDTH_M,
    Air,
    Approach,
    Receiver,
    RoadMarkers,
    RoadReception,
    approach,
    packet_success,
    read_probability,
    road_reception,
)
from app.radio.regulation import check_legal, check_transmitter, is_permitted
from app.radio.settings import (
    BANDWIDTHS_HZ,
    DATA_RATES,
    MAX_BATTERY_DAYS,
    SPREADING_FACTORS,
    Battery,
    RadioSettings,
    Region,
    battery_life_days,
    check_between,
)

CAMERA_PREVIEW_M = 31.0  # [m] of lane that a camera sees, beacons must give more; source: CERPM paper, section 5
SPACING_M = 12.192  # [m] 40 ft; source: CERPM paper, section 3.2
_SAMPLES = 60  # markers that are checked; bounds the time of a check
_STATIONS = 200  # points of the road that are checked; bounds the time of a check
_STATION_MARKERS = 2_000_000  # stations times markers; bounds the time of a check to seconds
_STATION_STEP_M = 5.0  # [m]


@dataclass(frozen=True, slots=True)
class PreviewRule:
    """How far ahead a marker must have been read: by default where the vehicle stops, and at least 31 m."""

    distance_m: Annotated[Number | None, Field(description="Fixed, 1 to 2,000. [m]")] = None
    # `reaction_s`, `deceleration_m_s2`: of the driver or the system; by default AASHTO Green Book (2018), 3.2.2
    reaction_s: Annotated[Number, Field(description="0 to 10. [s]")] = REACTION_S
    deceleration_m_s2: Annotated[Number, Field(description="0.5 to 10. [m/s2]")] = DECELERATION_M_S2

    def __post_init__(self) -> None:
        if self.distance_m is not None:
            check_between("preview.distance_m", self.distance_m, 1.0, 2000.0, "m")
        check_between("preview.reaction_s", self.reaction_s, 0.0, 10.0, "s")
        check_between("preview.deceleration_m_s2", self.deceleration_m_s2, 0.5, 10.0, "m/s2")

    def needed_m(self, speed_m_s: float) -> float:
        """Preview distance at a speed. [m]"""
        if self.distance_m is not None:
            return self.distance_m
        return max(CAMERA_PREVIEW_M, reaction_distance_m(speed_m_s, self.reaction_s, self.deceleration_m_s2))


@dataclass(frozen=True, slots=True)
class EvenRoad:
    """A long road with markers at even distances."""

    spacing_m: Annotated[Number, Field(description="1 to 1,000. [m]")] = SPACING_M
    sides: Annotated[Whole, Field(description="Sides of the lane with markers: 1 or 2.")] = 2
    lane_width_m: Annotated[Number, Field(description="1 to 20. [m]")] = LANE_WIDTH_M

    def __post_init__(self) -> None:
        self.markers(0.0)

    def markers(self, reach_m: float) -> RoadMarkers:
        """The markers in reach of a receiver."""
        with naming("road"):
            return RoadMarkers.evenly(self.spacing_m, reach_m, sides=self.sides, lane_width_m=self.lane_width_m)


@dataclass(frozen=True, slots=True)
class RadioPlan:
    """Markers along a road, their radios, and the requirements."""

    radio: RadioSettings = field(default_factory=RadioSettings)
    region: Region = Region.US915
    road: EvenRoad = field(default_factory=EvenRoad)
    markers: Annotated[RoadMarkers | None, Field(description="In place of `road`: where each is.")] = None
    design_speed_m_s: Annotated[Number, Field(description="0.5 to 70. [m/s]")] = 13.4
    preview: PreviewRule = field(default_factory=PreviewRule)
    link: LinkModel = field(default_factory=LinkModel)
    receiver: Receiver = field(default_factory=Receiver)
    battery: Battery = field(default_factory=Battery)
    min_probability: Annotated[Number, Field(description="That a marker is read in time, 0.5 to 0.9999.")] = 0.99
    min_battery_days: Annotated[Number, Field(description="0 to 36,500. [day]")] = 365.0

    def __post_init__(self) -> None:
        check_between("design_speed_m_s", self.design_speed_m_s, 0.5, 70.0, "m/s")
        check_between("min_probability", self.min_probability, 0.5, 0.9999, "")
        check_between("min_battery_days", self.min_battery_days, 0.0, 36_500.0, "days")

    @property
    def preview_m(self) -> float:
        """Distance ahead at which a marker must have been read. [m]"""
        return self.preview.needed_m(self.design_speed_m_s)

    @property
    def air(self) -> Air:
        """Everything that determines whether a packet is read."""
        return Air(self.radio, self.link, self.receiver)


@dataclass(frozen=True, slots=True, eq=False)
class RadioCheck:
    """The result of checking a radio plan."""

    verdict: Verdict  # the worst of all checks
    # `time_on_air_s`, `range_m`, `preview_m`: of a packet; distance at which its mean level falls to the receiver's
    # sensitivity; distance ahead at which a marker must have been read
    time_on_air_s: float
    range_m: float
    preview_m: float
    road: RoadReception  # one spacing of it where it is even
    packet_success: float  # share of a marker's packets read at the preview distance, minimum over the road's markers
    read_probability: float  # that a marker is read in time, minimum over the road's markers
    battery_days: float  # [day]
    checks: tuple[RadioFinding, ...]
    recommendation: Recommendation | None = None  # if it was asked for


def check_radio(plan: RadioPlan, *, recommend: bool = False) -> RadioCheck:
    """Check a radio plan: law, link, collisions, reading in time, battery; and recommend settings if asked to.

    Raises
    ------
    InvalidParameter
        More than 20,000 markers are within range of one receiver.

    Notes
    -----
    On a road with its own markers, each of them, or 60 evenly chosen ones, is approached; the road before and after
    is assumed to have no markers.
    """
    air, preview_m = plan.air, plan.preview_m
    markers, wanted = markers_of(plan)
    approaches = [approach(markers, index, preview_m, air) for index in wanted]
    probability = min(read_probability(one, plan.design_speed_m_s, air) for one in approaches)
    success = min(_success_at_preview(one, air) for one in approaches)
    road = road_reception(markers, _stations(plan, markers), air)
    days = battery_life_days(plan.radio, plan.battery)
    checks = (
        *check_legal(plan.radio, plan.region),
        *check_transmitter(plan.radio),
        *_lorawan_room(plan),
        _level(plan),
        _channels(plan),
        _turns(plan.radio, max(road.markers_in_range)),
        _probability(plan, probability, success, max(road.markers_in_range)),
        _battery(plan, days),
    )
    return RadioCheck(
        worst_verdict(checks),
        plan.radio.time_on_air_s,
        air.range_m,
        preview_m,
        road,
        success,
        probability,
        days,
        checks,
        recommend_settings(plan) if recommend else None,
    )


def markers_of(plan: RadioPlan) -> tuple[RoadMarkers, list[int]]:
    """Markers of a plan, and the indices of those to check."""
    if plan.markers is None:
        reach_m = plan.air.reach_m + plan.air.harm_m
        return plan.road.markers(reach_m), [0]
    count = len(plan.markers.chainage_m)
    chosen = np.unique(np.linspace(0, count - 1, min(count, _SAMPLES)).round().astype(int))
    return plan.markers, np.argsort(plan.markers.chainage_m, kind="stable")[chosen].tolist()


def _stations(plan: RadioPlan, markers: RoadMarkers) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Stations to check: within one spacing of an even road, otherwise every 5 m, and 200 in all at most."""
    if plan.markers is None:
        return np.linspace(0.0, plan.road.spacing_m, 5)
    low, high = float(markers.chainage_m.min()), float(markers.chainage_m.max())
    most = min(_STATIONS, _STATION_MARKERS // len(markers.chainage_m))
    return np.linspace(low, high, min(most, 1 + math.ceil((high - low) / _STATION_STEP_M)))


def _success_at_preview(reception: Approach, air: Air) -> float:
    if len(reception.ahead_m) == 0:
        return 0.0
    return float(packet_success(reception.level_dbm[0], reception.harmful[0], air.settings, air.link, air.receiver))


def _lorawan_room(plan: RadioPlan) -> tuple[RadioFinding, ...]:
    """Whether LoRaWAN has a data rate of these settings, with room for the message."""
    if not plan.radio.lorawan:
        return ()
    modulation = (plan.radio.spreading_factor, plan.radio.bandwidth_hz)
    room = next(
        (r.payload_bytes for r in DATA_RATES[plan.region] if (r.spreading_factor, r.bandwidth_hz) == modulation), 0
    )
    sentence = f"application payload of this data rate in {plan.region}" if room else "no data rate of uplinks"
    return (at_least("lorawan-room", room, MESSAGE_BYTES, "bytes", "LoRaWAN Regional Parameters", sentence),)


def _level(plan: RadioPlan) -> RadioFinding:
    air = plan.air
    level_dbm = float(air.level_dbm(math.hypot(plan.preview_m, plan.road.lane_width_m / 2)))
    margin_db = level_dbm - air.threshold_dbm
    return at_least(
        "link-margin",
        margin_db,
        2 * plan.link.fading_db,
        "dB",
        "CERPM paper, section 4.1; SX1276 data sheet, table 10",
        f"{level_dbm:.1f} dBm at {plan.preview_m:.0f} m over {air.threshold_dbm:g} dBm; twice the fading is required",
        worst=Verdict.WARN if margin_db >= 0 else Verdict.FAIL,
    )


def _channels(plan: RadioPlan) -> RadioFinding:
    sent, received = plan.radio.channels, plan.receiver.channels
    return at_least(
        "receiver-channels",
        min(received, sent),
        sent,
        "channels",
        "packets are spread evenly over the channels",
        f"the receiver receives {min(1.0, received / sent):.0%} of the channels at the same time",
        worst=Verdict.WARN,
    )


def _turns(settings: RadioSettings, in_range: int) -> RadioFinding:
    """Whether markers collide at random, and not every time: by jitter, or by slots of their own."""
    if settings.slots is not None:
        return at_least(
            "slots",
            settings.slots.capacity,
            in_range,
            "slots",
            "one marker in each slot of a channel",
            f"{settings.slots.per_channel} of {1000 * settings.slots.slot_s:.1f} ms on each of {settings.channels} "
            f"channels in {settings.interval_s:g} s, for {in_range} markers in range of a vehicle",
            worst=Verdict.WARN,
        )
    return at_least(
        "jitter",
        2 * settings.jitter_share * settings.interval_s,
        2 * settings.time_on_air_s,
        "s",
        "pure ALOHA: packets begin independently",
        "span of the interval; with less, two markers that collide once collide every time",
        worst=Verdict.WARN,
    )


def _probability(plan: RadioPlan, probability: float, success: float, in_range: int) -> RadioFinding:
    return at_least(
        "read-in-time",
        probability,
        plan.min_probability,
        "probability",
        ("shadows by Gudmundson 1991, slots" if plan.radio.slotted else "pure ALOHA with capture")
        + "; preview by AASHTO section 3.2.2 and the CERPM paper, section 5",
        f"that a marker is read before the vehicle is {plan.preview_m:.0f} m from it, at {plan.design_speed_m_s:g} m/s "
        f"with {in_range} markers in range; {success:.0%} of its packets are read there",
    )


def _battery(plan: RadioPlan, days: float) -> RadioFinding:
    return at_least(
        "battery-life",
        days,
        plan.min_battery_days,
        "days",
        "CERPM paper, section 2.2; SX1276 data sheet, table 6",
        f"{plan.battery.capacity_mah:g} mAh "
        + (f"and a solar cell of {plan.battery.solar_mw:g} mW" if plan.battery.solar_mw else "without being charged"),
        worst=Verdict.WARN,
    )


# === Recommended radio settings: a search for lawful settings under which markers are read in time.


INTERVALS_S = tuple(float(f"{v:.2g}") for v in np.geomspace(0.1, 20.0, 16))  # [s] ratio of 1.42
POWERS_DBM = (20.0, 17.0, 14.0, 11.0, 8.0)  # [dBm] halves of the SX1276's maximum
MORE_CHANNELS = (2, 4, 8, 16, 32)  # up to four gateway chips
_EU_CHANNELS = 10  # of 200 kHz in 863 to 865 MHz; source: EN 300 220-2 V3.2.1, table B.1, band K
_WANTED = 8  # markers that are approached; bounds the time of the search


@dataclass(frozen=True, slots=True)
class Recommendation:
    """The best lawful settings that were found."""

    # those with the longest battery life that reach the required probability, of equal ones the most probable; if none
    # does, those with the highest probability
    radio: Annotated[RadioSettings | None, Field(description="Null where nothing is lawful.")]
    receiver_channels: int  # channels that the receiver must receive at the same time
    read_probability: float
    battery_days: float  # [day]
    reaches: Annotated[bool, Field(description="Whether the probability asked for is reached.")]
    sentence: str  # for people
    law: tuple[RadioFinding, ...] = ()  # every limit of the region, with the settings' figure


def recommend_settings(plan: RadioPlan, *, more_channels: bool = True) -> Recommendation:
    """Find interval, spreading factor, bandwidth and power under which the preview distance is readable.

    Parameters
    ----------
    plan : RadioPlan
        Its spreading factor, bandwidth, interval and power are varied; all other settings are kept.
    more_channels : bool
        If one channel is not enough, spread fixed markers over 2, 4, 8, 16 or 32 channels, all received. In Europe, if
        none of these are lawful and enough, let them send in slots on ten channels of band K, with polite access.

    Returns
    -------
    Recommendation

    Notes
    -----
    Tried are spreading factors 6 (without a header) or 7 to 12, the three bandwidths, 16 intervals and 5 powers. On a
    road with its own markers, 8 of them are approached: 4 along the road, and 4 that have most others in reach.
    """
    approaches = _ApproachesByLink(plan)
    best = _best(plan, approaches)
    if best.reaches or not more_channels or plan.radio.hopping:
        return best
    for channels in MORE_CHANNELS:
        if channels <= plan.radio.channels:
            continue
        wider = replace(
            plan,
            radio=replace(plan.radio, channels=channels),
            receiver=replace(plan.receiver, channels=max(channels, plan.receiver.channels)),
        )
        found = _best(wider, approaches)
        if found.reaches:
            return found
        best = max(best, found, key=lambda one: one.read_probability)
    if plan.region is Region.EU868 and not plan.radio.lorawan:
        best = max(best, _best(in_slots(plan), approaches), key=lambda one: one.read_probability)
    return best


def in_slots(plan: RadioPlan) -> RadioPlan:
    """A European plan with slots on the ten channels of 863 to 865 MHz, all received, and polite spectrum access."""
    radio = replace(
        plan.radio,
        frequency_hz=863_100_000,
        bandwidth_hz=BANDWIDTHS_HZ[0],
        interval_s=INTERVALS_S[-1],
        jitter_share=0.0,
        channels=_EU_CHANNELS,
        hopping=True,
        polite=True,
        slotted=True,
    )
    receiver = replace(plan.receiver, channels=max(_EU_CHANNELS, plan.receiver.channels))
    return replace(plan, radio=radio, receiver=receiver)


def _best(plan: RadioPlan, approaches_by_link: _ApproachesByLink) -> Recommendation:
    reaching: tuple[float, float, RadioSettings] | None = None
    likeliest: tuple[float, RadioSettings] | None = None
    for first in _modulations(plan):
        approaches = approaches_by_link.find(first)
        intervals = list(_intervals(first, plan)) if approaches else []
        for settings in reversed(intervals) if first.slotted else intervals:
            if settings.slotted:
                approaches = approaches_by_link.find(settings)
            air = Air(settings, plan.link, plan.receiver)
            probability = min(read_probability(one, plan.design_speed_m_s, air) for one in approaches)
            if likeliest is None or probability > likeliest[0]:
                likeliest = probability, settings
            if probability >= plan.min_probability:
                days = battery_life_days(settings, plan.battery)
                if reaching is None or (days, probability) > reaching[:2]:
                    reaching = days, probability, settings
                if settings.slotted and days < MAX_BATTERY_DAYS:
                    break  # with shorter intervals the battery lasts less
    if reaching is not None:
        return _recommendation(plan, reaching[2], reaching[1])
    return _recommendation(plan, likeliest[1], likeliest[0]) if likeliest else _recommendation(plan, None, 0.0)


def _modulations(plan: RadioPlan) -> Iterator[RadioSettings]:
    """Settings with the longest interval: one for each spreading factor, bandwidth and power that may be lawful."""
    room = {(r.spreading_factor, r.bandwidth_hz) for r in DATA_RATES[plan.region] if r.payload_bytes >= MESSAGE_BYTES}
    for bandwidth_hz in BANDWIDTHS_HZ:
        for spreading_factor in SPREADING_FACTORS[1 if plan.radio.explicit_header else 0 :]:
            if plan.radio.lorawan and (spreading_factor, bandwidth_hz) not in room:
                continue
            for power_dbm in POWERS_DBM:
                settings = replace(
                    plan.radio,
                    spreading_factor=spreading_factor,
                    bandwidth_hz=bandwidth_hz,
                    power_dbm=power_dbm,
                    interval_s=INTERVALS_S[-1],
                )
                reaches = Air(settings, plan.link, plan.receiver).reach_m > plan.preview_m
                if reaches and is_permitted(replace(settings, interval_s=3600.0), plan.region):
                    yield settings


def _intervals(first: RadioSettings, plan: RadioPlan) -> Iterator[RadioSettings]:
    """These settings with each interval that is lawful and long enough."""
    for interval_s in INTERVALS_S:
        try:
            settings = replace(first, interval_s=interval_s)
        except InvalidParameter:
            continue
        if is_permitted(settings, plan.region):
            yield settings


class _ApproachesByLink:
    """Approaches of a plan's markers, each computed once: they depend on sensitivity and power, not on channels; in
    slots also on who shares one."""

    def __init__(self, plan: RadioPlan) -> None:
        self._plan = plan
        self._found: dict[tuple[float, float, int], list[Approach]] = {}

    def find(self, settings: RadioSettings) -> list[Approach]:
        """Approaches with these settings; none where more markers are in range than a check allows."""
        plan = replace(self._plan, radio=settings)
        key = plan.air.threshold_dbm, settings.power_dbm, settings.slots.capacity if settings.slots else 0
        if key not in self._found:
            try:
                self._found[key] = _approaches(plan)
            except InvalidParameter:
                self._found[key] = []
        return self._found[key]


def _approaches(plan: RadioPlan) -> list[Approach]:
    markers, wanted = markers_of(plan)
    air, at_m = plan.air, markers.chainage_m
    if len(wanted) > _WANTED:
        ordered = np.sort(at_m)
        first, last = at_m[wanted] - 2 * air.range_m, at_m[wanted] + air.range_m - plan.preview_m
        others = np.searchsorted(ordered, last, "right") - np.searchsorted(ordered, first)
        crowded = np.argsort(-others, kind="stable")[: _WANTED // 2]  # they lose most packets
        spread = np.linspace(0, len(wanted) - 1, _WANTED - len(crowded)).astype(int)
        wanted = [wanted[k] for k in np.unique(np.concatenate([crowded, spread]))]
    return [approach(markers, index, plan.preview_m, air) for index in wanted]


def _recommendation(plan: RadioPlan, settings: RadioSettings | None, probability: float) -> Recommendation:
    receives = plan.receiver.channels
    if settings is None:
        sentence = f"no settings are lawful in {plan.region} and reach {plan.preview_m:.0f} m"
        return Recommendation(None, receives, 0.0, 0.0, False, sentence)
    days = battery_life_days(settings, plan.battery)
    reaches = probability >= plan.min_probability
    channels = f"{settings.channels} channel{'s' if settings.channels > 1 else ''}"
    sentence = (
        f"SF{settings.spreading_factor} at {settings.bandwidth_hz / 1000:g} kHz and {settings.power_dbm:g} dBm, every "
        f"{settings.interval_s:g} s on {channels}: {probability:.1%} of markers are read {plan.preview_m:.0f} m ahead"
    )
    if settings.slotted:
        sentence += "; in slots by satellite time" + (", with polite spectrum access" if settings.polite else "")
    if not reaches:
        sentence += f"; no lawful settings tried reach {plan.min_probability:.1%}"
    law = check_legal(settings, plan.region)
    return Recommendation(settings, receives, probability, days, reaches, sentence, law)
