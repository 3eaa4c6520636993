"""CERPM messages as LoRaWAN application payload: overhead, and data rates with enough room."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

F_PORT = 24  # of CERPM messages, by hand; 1 to 223 are the application's; source: LoRaWAN 1.0.4, section 4.3.2
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
