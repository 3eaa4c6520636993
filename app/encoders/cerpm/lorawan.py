"""CERPM messages as LoRaWAN application payload: what LoRaWAN adds, and which data rates have room."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from app.encoders.cerpm.airtime import check_whole, time_on_air_s
from app.errors import InvalidParameter
from app.markers.cerpm import MESSAGE_BYTES

F_PORT = 24
"""Port of CERPM messages; 1 to 223 are the application's (LoRaWAN 1.0.4, section 4.3.2)."""
LORAWAN_BYTES = 13
"""What LoRaWAN adds: MHDR 1, DevAddr 4, FCtrl 1, FCnt 2, FPort 1, MIC 4. [bytes]"""
_MAX_MAC_COMMAND_BYTES = 15


class Region(StrEnum):
    """Where a marker stands, for the rules and the channels of its radio."""

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


@dataclass(frozen=True, slots=True)
class LorawanUplink:
    """A CERPM message inside LoRaWAN.

    Attributes
    ----------
    f_port : int
    payload : bytes
        Application payload: the message as it is, its own tag too, which vehicles check without LoRaWAN's keys.
    frame_bytes : int
        All that the radio sends. [bytes]
    data_rate : int
    time_on_air_s : float
        [s]
    """

    f_port: int
    payload: bytes
    frame_bytes: int
    data_rate: int
    time_on_air_s: float


def wrap_uplink(payload: bytes, region: Region, data_rate: int, *, mac_command_bytes: int = 0) -> LorawanUplink:
    """What an encoded message becomes at a data rate of LoRaWAN.

    Parameters
    ----------
    payload : bytes
        24 of them, from `encode_message`.
    region : Region
    data_rate : int
        0 to 4 in US915, 0 to 6 in EU868.
    mac_command_bytes : int
        FOpts that travel with it, 0 to 15; they take the payload's room. [bytes]

    Raises
    ------
    InvalidParameter
        No such LoRa data rate, or it has no room: 24 bytes do not fit US915's DR0, which carries 11.
    """
    check_whole("payload", len(payload), MESSAGE_BYTES, MESSAGE_BYTES, "bytes")
    check_whole("mac_command_bytes", mac_command_bytes, 0, _MAX_MAC_COMMAND_BYTES, "bytes")
    rates = DATA_RATES[region]
    check_whole("data_rate", data_rate, 0, len(rates) - 1, f"in {region}")
    rate = rates[data_rate]
    room = rate.payload_bytes - mac_command_bytes
    if room < len(payload):
        fitting = ", ".join(
            f"DR{n}" for n, other in enumerate(rates) if other.payload_bytes - mac_command_bytes >= MESSAGE_BYTES
        )
        raise InvalidParameter(
            f"a message of {len(payload)} bytes does not fit DR{data_rate} of {region}, which has room for {room}",
            field="data_rate",
            limit=f"at least {MESSAGE_BYTES} bytes of application payload: {fitting}",
            cure="set a least data rate in the device profile, or send without LoRaWAN",
        )
    frame_bytes = LORAWAN_BYTES + mac_command_bytes + len(payload)
    airtime_s = time_on_air_s(frame_bytes, rate.spreading_factor, rate.bandwidth_hz)
    return LorawanUplink(F_PORT, payload, frame_bytes, data_rate, airtime_s)
