"""Settings of a marker's radio."""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated

import numpy as np
import numpy.typing as npt
import scipy
from pydantic import Field, with_config

from app.errors import InvalidParameter
from app.inputs import INPUT, Flag, Number, Whole
from app.markers.cerpm import MESSAGE_BYTES
from app.values import Ints

# === Time on air of LoRa packets.


SPREADING_FACTORS = (6, 7, 8, 9, 10, 11, 12)  # 6 only without a header; source: SX1276 data sheet, 4.1.1.2
BANDWIDTHS_HZ = (125_000, 250_000, 500_000)  # [Hz] source: SX1276 data sheet, table 10, sensitivities near 900 MHz
CODING_RATES = (5, 6, 7, 8)  # bits sent for four of data; source: SX1276 data sheet, 4.1.1.3
MAX_PAYLOAD_BYTES = 255  # [bytes] source: one byte of length in the header
PREAMBLE_SYMBOLS = (6, 65535)  # shortest and longest; source: SX1276 data sheet, 4.1.1.6
LONG_SYMBOL_S = 0.016  # [s] longer symbols need the low data rate optimisation; source: SX1276 data sheet, 4.1.1.6
_SYNC_SYMBOLS = 4.25  # that the radio adds to the preamble; source: SX1276 data sheet, 4.1.1.7


def time_on_air_s(
    payload_bytes: int,
    spreading_factor: int,
    bandwidth_hz: int,
    *,
    coding_rate: int = 5,
    preamble_symbols: int = 8,
    crc: bool = True,
    explicit_header: bool = True,
    low_data_rate: bool | None = None,
) -> float:
    """Time on air of one packet.

    Parameters
    ----------
    payload_bytes : int
        All bytes that the radio sends, 0 to 255; with LoRaWAN its 13 bytes too. [bytes]
    spreading_factor : int
        6 to 12; 6 needs `explicit_header` false.
    bandwidth_hz : int
        125,000, 250,000 or 500,000. [Hz]
    coding_rate : int
        Bits sent for four of data, 5 to 8: 5 is 4/5.
    preamble_symbols : int
        As programmed, 6 to 65,535; the radio adds 4.25.
    low_data_rate : bool, optional
        Low data rate optimisation; by default where a symbol lasts over 16 ms.

    Returns
    -------
    float
        [s]

    Raises
    ------
    InvalidParameter
        A value is outside its limits.

    Notes
    -----
    Semtech SX1276/77/78/79 data sheet, revision 7, section 4.1.1.7.
    """
    check_modulation(spreading_factor, bandwidth_hz, explicit_header=explicit_header)
    check_whole("payload_bytes", payload_bytes, 0, MAX_PAYLOAD_BYTES, "bytes")
    check_whole("coding_rate", coding_rate, CODING_RATES[0], CODING_RATES[-1], "bits for four of data")
    check_whole("preamble_symbols", preamble_symbols, *PREAMBLE_SYMBOLS, "symbols")
    symbol_s = symbol_time_s(spreading_factor, bandwidth_hz)
    optimised = symbol_s > LONG_SYMBOL_S if low_data_rate is None else low_data_rate
    bits = 8 * payload_bytes - 4 * spreading_factor + 28 + 16 * crc - 20 * (not explicit_header)
    blocks = math.ceil(bits / (4 * (spreading_factor - 2 * optimised)))
    payload_symbols = 8 + max(blocks * coding_rate, 0)
    return (preamble_symbols + _SYNC_SYMBOLS + payload_symbols) * symbol_s


def symbol_time_s(spreading_factor: int, bandwidth_hz: int) -> float:
    """Duration of one symbol. [s]"""
    return float(2**spreading_factor / bandwidth_hz)


def check_modulation(spreading_factor: int, bandwidth_hz: int, *, explicit_header: bool = True) -> None:
    """Raises InvalidParameter if the radio does not have the spreading factor or the bandwidth."""
    check_whole("spreading_factor", spreading_factor, SPREADING_FACTORS[0], SPREADING_FACTORS[-1], "")
    if bandwidth_hz not in BANDWIDTHS_HZ:
        raise InvalidParameter(
            f"bandwidth_hz is {bandwidth_hz}",
            field="bandwidth_hz",
            limit=", ".join(f"{hz:d}" for hz in BANDWIDTHS_HZ) + " Hz",
            cure="give the bandwidth in hertz",
        )
    if spreading_factor == SPREADING_FACTORS[0] and explicit_header:
        raise InvalidParameter(
            "spreading factor 6 has no room for a header",
            field="spreading_factor",
            limit="7 to 12 with a header",
            cure="leave the header out, which fixes the length of packets, or use 7",
        )


def check_whole(name: str, value: float, low: int, high: int, unit: str) -> None:
    """Raises InvalidParameter if a value is not a whole number within limits."""
    if not low <= value <= high or value != int(value):
        raise InvalidParameter(
            f"{name} is {value:g}", field=name, limit=f"a whole number from {low} to {high} {unit}".rstrip()
        )


def check_between(name: str, value: float, low: float, high: float, unit: str) -> None:
    """Raises InvalidParameter if a value is outside its limits or NaN."""
    if not low <= value <= high:
        raise InvalidParameter(
            f"{name} is {value:g} {unit}".rstrip(), field=name, limit=f"{low:g} to {high:g} {unit}".rstrip()
        )


# === CERPM messages as LoRaWAN application payload: overhead, and data rates with enough room.


F_PORT = 24  # of CERPM messages; 1 to 223 are the application's; source: LoRaWAN 1.0.4, section 4.3.2
LORAWAN_BYTES = 13  # [bytes] MHDR 1, DevAddr 4, FCtrl 1, FCnt 2, FPort 1, MIC 4; source: LoRaWAN 1.0.4, section 4


class Region(StrEnum):
    """Region of a marker: determines the regulation and the channels of its radio."""

    US915 = "US915"
    EU868 = "EU868"


@dataclass(frozen=True, slots=True)
class DataRate:
    """A LoRa uplink data rate: its modulation, and the longest application payload without MAC commands."""

    spreading_factor: int
    bandwidth_hz: int
    payload_bytes: int


DATA_RATES: dict[Region, tuple[DataRate, ...]] = {
    Region.US915: (
        DataRate(10, 125_000, 11),
        DataRate(9, 125_000, 53),
        DataRate(8, 125_000, 125),
        DataRate(7, 125_000, 242),
        DataRate(8, 500_000, 242),
    ),
    Region.EU868: (
        DataRate(12, 125_000, 51),
        DataRate(11, 125_000, 51),
        DataRate(10, 125_000, 51),
        DataRate(9, 125_000, 115),
        DataRate(8, 125_000, 242),
        DataRate(7, 125_000, 242),
        DataRate(7, 250_000, 242),
    ),
}
"""LoRa uplink data rates by number, without repeaters. LoRaWAN Regional Parameters 1.0.3 revision A, sections 2.2 and
2.3 (the same in RP002-1.0.4)."""


# === Slots: which marker sends when, and on which channel, where all have the time of satellites.


SLOT_GUARD_S = 0.004  # [s] between packets in slots, for errors of clocks up to half of it
MAX_PLACES = 1_000_000  # of a frame: a slot of 1 ms on each of 128 channels, for 8 s
_CHANNEL_SALT = b"waymark slot"
_MIX = 2654435761  # source: Knuth, TAOCP 3, 6.4; CRC alone is linear, so that two slots would meet always or never
_PLACES_AT_ONCE = 1000  # markers whose neighbours are looked up together; bounds memory


@dataclass(frozen=True, slots=True)
class Slots:
    """The frame that markers share: slots in time on channels. A slot on a channel is a place."""

    frame_s: float  # [s] in which each marker sends once; frames are counted from the GPS epoch
    slot_s: float  # [s] a packet and its guard time
    channels: int

    @property
    def per_channel(self) -> int:
        """Slots of a frame on one channel."""
        return math.floor(self.frame_s / self.slot_s + 1e-9)

    @property
    def capacity(self) -> int:
        """Places of a frame: markers that never send at the same time on the same channel."""
        return self.per_channel * self.channels

    def at(self, place: npt.ArrayLike, frame: npt.ArrayLike) -> tuple[Ints, Ints]:
        """Slot and channel of places in frames; the arguments are broadcast against each other.

        Parameters
        ----------
        place : array_like of int
            0 or more; modulo `capacity`.
        frame : array_like of int
            Time since the GPS epoch over `frame_s`, rounded down; modulo 2^32.

        Notes
        -----
        Slot ``s = place mod per_channel``, channel ``(place // per_channel + h) mod channels`` with ``h = (2654435761
        CRC-32("waymark slot" || frame || s) mod 2^32) >> 16``, four bytes each, big endian. Places of one slot are on
        different channels in every frame; those of neighbouring slots, which overlap if clocks are wrong, are on one
        channel in one of `channels` frames only; and over an hour each place uses all channels alike.
        """
        places, frames = np.broadcast_arrays(np.asarray(place, np.int64), np.asarray(frame, np.int64) % 2**32)
        places = places % self.capacity
        slot = places % self.per_channel
        pairs, which = np.unique(np.stack((frames.ravel(), slot.ravel()), 1), axis=0, return_inverse=True)
        mixed = [zlib.crc32(_CHANNEL_SALT + f.to_bytes(4) + s.to_bytes(4)) * _MIX % 2**32 for f, s in pairs.tolist()]
        hops = [one >> 16 for one in mixed]
        hop = np.array(hops, np.int64)[which.ravel()].reshape(slot.shape)
        return slot, (places // self.per_channel + hop) % self.channels


def assign_places(points_m: npt.ArrayLike, capacity: int) -> Ints:
    """Places of a frame for markers, so that those with the same place are far apart.

    Parameters
    ----------
    points_m : array_like, shape (N, D)
        Positions in any Cartesian frame. [m]
    capacity : int
        Places of a frame.

    Returns
    -------
    ndarray of int, shape (N,)
        0 to capacity - 1. Each marker in turn gets a place that none of its 2 `capacity` nearest markers has yet or, if
        they have all of them, the place whose nearest user is the farthest.
    """
    points = np.asarray(points_m, float)
    place = np.full(len(points), -1, np.int64)
    if len(points) == 0:
        return place
    count = min(2 * capacity, len(points))  # along a road, half of them have their places already
    tree = scipy.spatial.cKDTree(points)
    for start in range(0, len(points), _PLACES_AT_ONCE):
        _distance, near = tree.query(points[start : start + _PLACES_AT_ONCE], k=[*range(1, count + 1)])
        for k, row in enumerate(np.atleast_2d(near), start):
            rank = np.full(capacity, len(points))  # of the nearest user of each place
            taken = place[row][::-1]  # the nearest ones last, so that they count
            rank[taken[taken >= 0]] = np.arange(len(row))[::-1][taken >= 0]
            place[k] = rank.argmax()
    return place


# === Settings of a marker's radio.


FREQUENCIES_HZ = (779_000_000, 1_020_000_000)  # [Hz] source: SX1276 data sheet, its highest band
POWER_DBM = (-4.0, 20.0)  # [dBm] source: SX1276 data sheet, section 5.4, both outputs
CONTINUOUS_POWER_DBM = 17.0  # [dBm] at any duty cycle; source: SX1276 data sheet, section 5.4.3
FULL_POWER_DUTY_CYCLE = 0.01  # above 17 dBm; source: SX1276 data sheet, section 5.4.3, operation at +20 dBm
INTERVALS_S = (0.05, 86_400.0)  # [s] 20 a second to one a day
MAX_CHANNELS = 128  # twice the 64 channels of US915
CHANNEL_STEP = 1.6  # bandwidths between channels; source: LoRaWAN Regional Parameters, 200 kHz for 125 kHz


@with_config(INPUT)
@dataclass(frozen=True, slots=True)
class RadioSettings:
    """How a marker's radio is set."""

    frequency_hz: Annotated[Whole, Field(description="Carrier of the lowest channel, 779 to 1,020 MHz. [Hz]")] = (
        915_000_000
    )
    spreading_factor: Annotated[Whole, Field(description="7 to 12, or 6 without a header.")] = 7
    bandwidth_hz: Annotated[Whole, Field(description="125000, 250000 or 500000. [Hz]")] = 500_000
    interval_s: Annotated[
        Number, Field(description="From one transmission to the next on average, 0.05 to 86,400. [s]")
    ] = 1.6
    # 0 to 0.9: without it two markers that collide once collide every time
    jitter_share: Annotated[
        Number, Field(description="Each interval is drawn evenly around that, this share to each side.")
    ] = 0.2
    power_dbm: Annotated[
        Number,
        Field(description="At the antenna's connector, -4 to 20; above 17 it may send 1 % of the time. [dBm]"),
    ] = 20.0
    antenna_gain_dbi: Annotated[Number, Field(description="-10 to 6. [dBi]")] = 2.15
    # in steps of 1.6 bandwidths, as in LoRaWAN
    channels: Annotated[Whole, Field(description="Over which packets are spread, 1 to 128.")] = 1
    hopping: Annotated[Flag, Field(description="Every marker uses all channels in turn; else each has one.")] = False
    coding_rate: Annotated[Whole, Field(description="5 to 8: 4/5 to 4/8.")] = 5
    preamble_symbols: Annotated[Whole, Field(description="Length of the preamble.")] = 8
    explicit_header: Annotated[Flag, Field(description="Whether packets have a header.")] = True
    crc: Annotated[Flag, Field(description="Whether packets have a checksum of the radio.")] = True
    lorawan: Annotated[Flag, Field(description="The message travels in a LoRaWAN frame.")] = False
    polite: Annotated[
        Flag,
        Field(
            description="It listens before each packet, and hops on where the channel is in use (EN 300 220-1, clause "
            "5.21: polite spectrum access with adaptive frequency agility); needs hopping."
        ),
    ] = False
    slotted: Annotated[
        Flag,
        Field(
            description="Markers send in slots, each in its `place`, by the time of a satellite receiver in each, "
            "without jitter; on several channels it needs hopping."
        ),
    ] = False
    place: Annotated[
        Whole,
        Field(description="Of this marker in a frame of slots; markers within twice the range need different ones."),
    ] = 0
    slot_guard_s: Annotated[
        Number, Field(description="Between packets in slots, 0.001 to 1: twice the largest error of a clock. [s]")
    ] = SLOT_GUARD_S

    def __post_init__(self) -> None:
        """Raises InvalidParameter if a value is outside its limits, or a packet longer than the shortest interval."""
        check_modulation(self.spreading_factor, self.bandwidth_hz, explicit_header=self.explicit_header)
        check_whole("frequency_hz", self.frequency_hz, *FREQUENCIES_HZ, "Hz")
        check_between("interval_s", self.interval_s, *INTERVALS_S, "s")
        check_between("jitter_share", self.jitter_share, 0.0, 0.9, "")
        check_between("power_dbm", self.power_dbm, *POWER_DBM, "dBm")
        check_between("antenna_gain_dbi", self.antenna_gain_dbi, -10.0, 6.0, "dBi")
        check_whole("channels", self.channels, 1, MAX_CHANNELS, "")
        check_whole("coding_rate", self.coding_rate, CODING_RATES[0], CODING_RATES[-1], "bits for four of data")
        check_whole("preamble_symbols", self.preamble_symbols, *PREAMBLE_SYMBOLS, "symbols")
        if self.hopping and self.channels == 1:
            raise InvalidParameter(
                "a radio cannot hop on one channel", field="channels", limit="2 to 128 with hopping", cure="name more"
            )
        check_whole("place", self.place, 0, MAX_PLACES, "")
        check_between("slot_guard_s", self.slot_guard_s, 0.001, 1.0, "s")
        for name, wanted in (("polite", self.polite), ("slotted", self.slotted and self.channels > 1)):
            if wanted and not self.hopping:
                raise InvalidParameter(
                    f"a {name} radio on fixed channels",
                    field="hopping",
                    limit=f"true with {name}",
                    cure="let it hop over two channels or more",
                )
        if self.lorawan and not self.explicit_header:
            raise InvalidParameter(
                "LoRaWAN uplinks have a header",
                field="explicit_header",
                limit="true with lorawan",
                cure="keep the header, or send without LoRaWAN",
            )
        shortest_s = self.interval_s * (1 - self.jitter_share)
        if self.slotted:
            if self.slots is None or self.slots.per_channel < 1:
                raise InvalidParameter(
                    f"no slot of {self.time_on_air_s + self.slot_guard_s:.3f} s fits in the interval",
                    field="interval_s",
                    limit=f"{self.time_on_air_s + self.slot_guard_s:.3f} s or more with these slots",
                    cure="send less often, or with a lower spreading factor or a wider band",
                )
        elif self.time_on_air_s > shortest_s:
            raise InvalidParameter(
                f"a packet lasts {self.time_on_air_s:.3f} s, longer than the shortest interval",
                field="interval_s",
                limit=f"more than {self.time_on_air_s / (1 - self.jitter_share):.3f} s with this jitter",
                cure="send less often, or with a lower spreading factor or a wider band",
            )

    @property
    def band_hz(self) -> tuple[float, float]:
        """Lower edge of the lowest channel and upper edge of the highest. [Hz]"""
        span_hz = (self.channels - 1) * CHANNEL_STEP * self.bandwidth_hz
        return self.frequency_hz - self.bandwidth_hz / 2, self.frequency_hz + span_hz + self.bandwidth_hz / 2

    @property
    def packet_bytes(self) -> int:
        """Length of a packet on the air. [bytes]"""
        return MESSAGE_BYTES + (LORAWAN_BYTES if self.lorawan else 0)

    @property
    def time_on_air_s(self) -> float:
        """Time on air of one packet. [s]"""
        return time_on_air_s(
            self.packet_bytes,
            self.spreading_factor,
            self.bandwidth_hz,
            coding_rate=self.coding_rate,
            preamble_symbols=self.preamble_symbols,
            crc=self.crc,
            explicit_header=self.explicit_header,
        )

    @property
    def slots(self) -> Slots | None:
        """The frame of slots; None without slots."""
        if not self.slotted:
            return None
        return Slots(self.interval_s, self.time_on_air_s + self.slot_guard_s, self.channels)

    @property
    def eirp_dbm(self) -> float:
        """Radiated power, relative to an isotropic antenna. [dBm]"""
        return self.power_dbm + self.antenna_gain_dbi


# === Battery life of a marker.


CAPACITY_MAH = 1000.0  # [mAh] at 3.7 V; source: CERPM paper, section 2.2
MAX_BATTERY_DAYS = 3650.0  # [day] of a charged battery: ten years; source: assumed, age ends it then
_VOLTS = 3.7  # [V] source: CERPM paper, section 2.2
_TRANSMIT_MA = ((7.0, 20.0), (13.0, 29.0), (17.0, 87.0), (20.0, 120.0))  # [dBm, mA] source: SX1276 data sheet, table 6
_LISTEN_MA, _LISTEN_S = 12.0, 0.005  # [mA, s] before a polite packet; source: SX1276 data sheet, table 6, and assumed
# [mA, s, s] of a satellite receiver: current, duration of a fix, and time between fixes, in which an oscillator of
# 0.5 ppm drifts by 0.9 ms; source: assumed, of the size of data sheets
_FIX_MA, _FIX_S, FIX_EVERY_S = 25.0, 3.0, 1800.0
SUN_H = (0.7, 1.4, 2.6, 4.1, 5.0, 5.4, 5.3, 4.5, 3.1, 1.7, 0.9, 0.5)
"""Sun on a horizontal square metre in a day of each month, at 50 degrees north in Central Europe. [h at 1,000 W/m2]
Source: assumed, of the size of the monthly means that PVGIS shows for Frankfurt; 1,070 hours in a year."""
_CHARGED_SHARE = 0.5  # of a cell's rated energy; source: assumed: dirt and shade of traffic 0.7, charging 0.7
_FIRST_MONTH = 9  # October: a full battery meets the dark half of the year first


@dataclass(frozen=True, slots=True)
class Battery:
    """The marker's battery, its loads, and the solar cell that charges it."""

    capacity_mah: Annotated[Number, Field(description="10 to 1,000,000. [mAh]")] = CAPACITY_MAH
    usable_share: Annotated[  # source: assumed, no measurement kept
        Number, Field(description="Of the capacity, left by cold, age and self-discharge, 0.1 to 1.")
    ] = 0.8
    # source: the maker's figure for the paper's board, the WiFi LoRa 32 in deep sleep
    sleep_ma: Annotated[
        Number,
        Field(
            description="Between transmissions, 0 to 1,000; by default of the paper's board, a purpose-built one needs "
            "a hundredth. [mA]"
        ),
    ] = 0.8
    # `awake_ma`, `awake_s`: source: assumed, no measurement kept
    awake_ma: Annotated[Number, Field(description="Of the processor while it makes a packet, 0 to 1,000. [mA]")] = 40.0
    awake_s: Annotated[Number, Field(description="For each packet, besides its time on air, 0 to 10. [s]")] = 0.01
    transmit_ma: Annotated[
        Number | None, Field(description="While it sends, 1 to 1,000; by the power and the SX1276's data sheet. [mA]")
    ] = None
    solar_mw: Annotated[
        Number,
        Field(
            description="Rated power of a solar cell in the marker's top, at 1,000 W/m2, 0 (none) to 100,000; half of "
            "its energy charges the battery. [mW]"
        ),
    ] = 0.0
    winter_sun_h: Annotated[
        Number,
        Field(
            description="Sun on the horizontal in a day of December, 0 to 8, which moves the other months as much: 0.5 "
            "in Central Europe, 0.2 at 59 and 2 at 40 degrees north. [h at 1,000 W/m2]"
        ),
    ] = SUN_H[11]

    def __post_init__(self) -> None:
        check_between("battery.capacity_mah", self.capacity_mah, 10.0, 1e6, "mAh")
        check_between("battery.usable_share", self.usable_share, 0.1, 1.0, "")
        check_between("battery.sleep_ma", self.sleep_ma, 0.0, 1000.0, "mA")
        check_between("battery.awake_ma", self.awake_ma, 0.0, 1000.0, "mA")
        check_between("battery.awake_s", self.awake_s, 0.0, 10.0, "s")
        if self.transmit_ma is not None:
            check_between("battery.transmit_ma", self.transmit_ma, 1.0, 1000.0, "mA")
        check_between("battery.solar_mw", self.solar_mw, 0.0, 1e5, "mW")
        check_between("battery.winter_sun_h", self.winter_sun_h, 0.0, 8.0, "h")

    def charge_mw(self, month: int) -> float:
        """Power that charges the battery, mean of a day in a month from 0, January. [mW]"""
        sun_h = max(SUN_H[month] + self.winter_sun_h - SUN_H[11], 0.0)
        return self.solar_mw * _CHARGED_SHARE * sun_h / 24


def mean_current_ma(settings: RadioSettings, battery: Battery) -> float:
    """Average supply current of a marker: asleep, and for each packet awake, listening if it is polite, and sending; in
    slots also of its satellite receiver. [mA]"""
    sending_ma = transmit_current_ma(settings.power_dbm) if battery.transmit_ma is None else battery.transmit_ma
    airtime_s = settings.time_on_air_s
    packet_mas = airtime_s * sending_ma + (airtime_s + battery.awake_s) * battery.awake_ma
    packet_mas += _LISTEN_S * (_LISTEN_MA + battery.awake_ma) * settings.polite
    timing_ma = _FIX_S * _FIX_MA / FIX_EVERY_S * settings.slotted
    return battery.sleep_ma + packet_mas / settings.interval_s + timing_ma


def battery_life_days(settings: RadioSettings, battery: Battery) -> float:
    """Battery life; of a charged battery at most ten years. [day]"""
    return life_days(mean_current_ma(settings, battery), battery)


def life_days(current_ma: float, battery: Battery) -> float:
    """Time until a full battery is empty, from October on. [day]

    Notes
    -----
    The charge rises and falls evenly within a month, by the cell's mean power and the load, and stays below the usable
    capacity.
    """
    usable_mwh = battery.capacity_mah * battery.usable_share * _VOLTS
    load_mw = max(current_ma, 1e-9) * _VOLTS
    if battery.solar_mw == 0.0:
        return usable_mwh / load_mw / 24
    month_days = 365.0 / 12
    left_mwh = usable_mwh
    for k in range(round(MAX_BATTERY_DAYS / month_days)):
        gain_mw = battery.charge_mw((_FIRST_MONTH + k) % 12) - load_mw
        if left_mwh + 24 * month_days * gain_mw <= 0.0:
            return k * month_days + left_mwh / (-24 * gain_mw)
        left_mwh = min(left_mwh + 24 * month_days * gain_mw, usable_mwh)
    return MAX_BATTERY_DAYS


def transmit_current_ma(power_dbm: float) -> float:
    """Supply current of a sending SX1276: that of the next higher power in its data sheet. [mA]"""
    return next((current for power, current in _TRANSMIT_MA if power_dbm <= power), _TRANSMIT_MA[-1][1])
