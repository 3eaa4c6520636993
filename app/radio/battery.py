"""Battery life of a marker."""

from __future__ import annotations

from dataclasses import dataclass

from app.radio.airtime import check_between
from app.radio.settings import RadioSettings

CAPACITY_MAH = 1000.0  # [mAh] at 3.7 V; source: CERPM paper, section 2.2
_TRANSMIT_MA = ((7.0, 20.0), (13.0, 29.0), (17.0, 87.0), (20.0, 120.0))  # [dBm, mA] source: SX1276 data sheet, table 6


@dataclass(frozen=True, slots=True)
class Battery:
    """A marker's battery and its loads.

    Parameters
    ----------
    capacity_mah : float
        10 to 1,000,000. [mAh]
    usable_share : float
        Share left by cold, age and self-discharge, 0.1 to 1.
    sleep_ma : float
        Whole marker between packets, 0 to 1,000. The default is the maker's figure for the paper's board (WiFi LoRa 32,
        deep sleep); a purpose-built board needs a hundredth. [mA]
    awake_ma, awake_s : float
        Its processor while it makes a packet, and the time for that besides the time on air: assumed. [mA], [s]
    transmit_ma : float, optional
        Radio while it sends, 1 to 1,000; by the SX1276's data sheet from the power by default. [mA]

    Raises
    ------
    InvalidParameter
        A value is outside its limits.
    """

    capacity_mah: float = CAPACITY_MAH
    usable_share: float = 0.8  # source: assumed, no measurement kept
    sleep_ma: float = 0.8  # [mA] source: the maker's figure for the WiFi LoRa 32, deep sleep
    awake_ma: float = 40.0  # [mA] source: assumed, no measurement kept
    awake_s: float = 0.01  # [s] source: assumed, no measurement kept
    transmit_ma: float | None = None

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
