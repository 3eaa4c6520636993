"""Settings of a marker's radio."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated

from pydantic import Field, with_config

from app.errors import InvalidParameter
from app.inputs import INPUT, Flag, Number, Whole
from app.markers.cerpm import MESSAGE_BYTES

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
        if self.lorawan and not self.explicit_header:
            raise InvalidParameter(
                "LoRaWAN uplinks have a header",
                field="explicit_header",
                limit="true with lorawan",
                cure="keep the header, or send without LoRaWAN",
            )
        shortest_s = self.interval_s * (1 - self.jitter_share)
        if self.time_on_air_s > shortest_s:
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
    def eirp_dbm(self) -> float:
        """Radiated power, relative to an isotropic antenna. [dBm]"""
        return self.power_dbm + self.antenna_gain_dbi


# === Battery life of a marker.


CAPACITY_MAH = 1000.0  # [mAh] at 3.7 V; source: CERPM paper, section 2.2
_TRANSMIT_MA = ((7.0, 20.0), (13.0, 29.0), (17.0, 87.0), (20.0, 120.0))  # [dBm, mA] source: SX1276 data sheet, table 6


@dataclass(frozen=True, slots=True)
class Battery:
    """The marker's battery and its loads."""

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

    def __post_init__(self) -> None:
        check_between("battery.capacity_mah", self.capacity_mah, 10.0, 1e6, "mAh")
        check_between("battery.usable_share", self.usable_share, 0.1, 1.0, "")
        check_between("battery.sleep_ma", self.sleep_ma, 0.0, 1000.0, "mA")
        check_between("battery.awake_ma", self.awake_ma, 0.0, 1000.0, "mA")
        check_between("battery.awake_s", self.awake_s, 0.0, 10.0, "s")
        if self.transmit_ma is not None:
            check_between("battery.transmit_ma", self.transmit_ma, 1.0, 1000.0, "mA")


def mean_current_ma(settings: RadioSettings, battery: Battery) -> float:
    """Average supply current of a marker: asleep, and for each packet awake and sending. [mA]"""
    sending_ma = transmit_current_ma(settings.power_dbm) if battery.transmit_ma is None else battery.transmit_ma
    airtime_s = settings.time_on_air_s
    packet_mas = airtime_s * sending_ma + (airtime_s + battery.awake_s) * battery.awake_ma
    return battery.sleep_ma + packet_mas / settings.interval_s


def battery_life_days(settings: RadioSettings, battery: Battery) -> float:
    """Battery life without charging. [day]"""
    return battery.capacity_mah * battery.usable_share / max(mean_current_ma(settings, battery), 1e-9) / 24


def transmit_current_ma(power_dbm: float) -> float:
    """Supply current of a sending SX1276: that of the next higher power in its data sheet. [mA]"""
    return next((current for power, current in _TRANSMIT_MA if power_dbm <= power), _TRANSMIT_MA[-1][1])
