"""Settings of a marker's radio."""

from __future__ import annotations

from dataclasses import dataclass

from app.errors import InvalidParameter
from app.markers.cerpm import MESSAGE_BYTES
from app.radio.airtime import (
    CODING_RATES,
    PREAMBLE_SYMBOLS,
    check_between,
    check_modulation,
    check_whole,
    time_on_air_s,
)
from app.radio.lorawan import LORAWAN_BYTES

FREQUENCIES_HZ = (779_000_000, 1_020_000_000)  # [Hz] source: SX1276 data sheet, its highest band
POWER_DBM = (-4.0, 20.0)  # [dBm] source: SX1276 data sheet, section 5.4, both outputs
CONTINUOUS_POWER_DBM = 17.0  # [dBm] at any duty cycle; source: SX1276 data sheet, section 5.4.3
FULL_POWER_DUTY_CYCLE = 0.01  # above 17 dBm; source: SX1276 data sheet, section 5.4.3, operation at +20 dBm
INTERVALS_S = (0.05, 86_400.0)  # [s] source: by hand, 20 a second to one a day
MAX_CHANNELS = 128  # source: by hand, twice the 64 channels of US915
CHANNEL_STEP = 1.6  # bandwidths between channels; source: LoRaWAN Regional Parameters, 200 kHz for 125 kHz


@dataclass(frozen=True, slots=True)
class RadioSettings:
    """Settings of the radio of a marker.

    Parameters
    ----------
    frequency_hz : int
        Carrier of the lowest channel, 779 to 1,020 MHz. [Hz]
    spreading_factor : int
        7 to 12, or 6 without a header.
    bandwidth_hz : int
        125,000, 250,000 or 500,000. [Hz]
    interval_s : float
        From one transmission to the next on average, 0.05 to 86,400. [s]
    jitter_share : float
        Each interval is drawn evenly from interval (1 - share) to interval (1 + share), 0 to 0.9: without it two
        markers that collide once collide every time.
    power_dbm : float
        At the antenna's connector, -4 to 20; above 17 the transmitter may send 1 % of the time. [dBm]
    antenna_gain_dbi : float
        -10 to 6. [dBi]
    channels : int
        Number of channels that packets are spread over, 1 to 128, in steps of 1.6 bandwidths as in LoRaWAN.
    hopping : bool
        Every marker uses all channels in a pseudo-random order; otherwise each uses one of them.
    coding_rate, preamble_symbols, explicit_header, crc
        See `time_on_air_s`.
    lorawan : bool
        The message travels in a LoRaWAN frame.

    Raises
    ------
    InvalidParameter
        A value is outside its limits, or a packet is longer than the shortest interval.
    """

    frequency_hz: int = 915_000_000
    spreading_factor: int = 7
    bandwidth_hz: int = 500_000
    interval_s: float = 1.6
    jitter_share: float = 0.2
    power_dbm: float = 20.0
    antenna_gain_dbi: float = 2.15
    channels: int = 1
    hopping: bool = False
    coding_rate: int = 5
    preamble_symbols: int = 8
    explicit_header: bool = True
    crc: bool = True
    lorawan: bool = False

    def __post_init__(self) -> None:
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
