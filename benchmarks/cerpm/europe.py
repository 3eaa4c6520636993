"""The rows of ``python -m benchmarks.cerpm europe``: radio designs for Europe, and the share of markers read in time.

A vehicle drives at the design speed along the first lane of a straight road with markers on every line. All markers in
reach send; shadows, fading, capture and the receiver are those of `app.simulation.radio.link`. No marker hears another:
see `hearing_m`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np

from app.planning.radio_checks import SPACING_M, RadioPlan, recommend_settings
from app.radio.link import PAPER_POWER_DBM, LinkModel
from app.radio.reception import LANE_WIDTH_M, RoadMarkers
from app.radio.regulation import is_permitted, polite_threshold_dbm
from app.radio.settings import Battery, RadioSettings, Region, life_days, mean_current_ma, time_on_air_s
from app.simulation.radio.link import (
    ANTENNA_M,
    Radio,
    draw_shadows_db,
    mean_rssi_dbm,
    receive_transmissions,
    send_beacons,
)
from app.values import Floats
from benchmarks.cerpm.paths import Result

_PAPER_EIRP_DBM = PAPER_POWER_DBM + 2.15  # [dBm] with the antenna that settings have by default
_MAX_REACH_M = 1500.0  # [m] beyond which no marker is simulated
_BOARD = Battery(sleep_ma=0.008, awake_ma=4.0, transmit_ma=25.5)
"""A board made for the purpose: a hundredth of the paper's in sleep; SX1261 at 14 dBm (data sheet, table 3-5)."""
SOLAR_MW = 400.0  # [mW] rated: 20 cm2 of a marker's top at 20 %
_SUNNY = replace(_BOARD, solar_mw=SOLAR_MW)
NIGHT_CLOCK_S = 0.5e-6 * 14 * 3600  # [s] 0.5 ppm through 14 hours without satellites
_LR_FHSS_S = 2 * 0.233472 + math.ceil(((24 + 2) * 8 + 6) * 1.5 / 48) * 0.1024
"""Of 24 bytes at data rate 9: two headers, and blocks of 48 bits at rate 2/3. LoRaWAN RP002-1.0.4, section 4. [s]"""
_GFSK_S = 8 * (5 + 4 + 1 + 24 + 2) / 4800  # [s] preamble, sync word, length, message, CRC at 4.8 kbit/s
_2G4_SYMBOL_S = 2**12 / 203_125  # [s] spreading factor 12; source: SX1280 data sheet
_2G4_S = time_on_air_s(24, 12, 125_000) / (2**12 / 125_000) * _2G4_SYMBOL_S
_GFSK_DBM, _LR_FHSS_DBM, _2G4_DBM = -118.0, -134.0, -130.0
"""Sensitivities of an SX1262 at 4.8 kbit/s, of LR-FHSS, and of an SX1280 with SF12 at 203 kHz. [dBm] Source: assumed,
of the size of the data sheets' figures; a dB more or less changes no conclusion."""
_2G4_LOSS_DB = 20 * math.log10(2440 / 915)  # free space, against the paper's link


@dataclass(frozen=True, slots=True)
class Design:
    """A radio design on a road."""

    name: str
    law: str
    settings: RadioSettings  # of an SX1276; of another radio, only interval, channels and power are used
    other: Radio | None = None  # another radio than these settings
    gain_db: float = 0.0  # [dB] of levels, besides power
    payload_bytes: int = 24  # [bytes]
    lines: int = 2  # of markers: the lane's two, then those of the lanes beside it
    clock_sd_s: float = 0.0  # [s] of errors of markers' clocks
    carried: bool = False  # whether each packet also has the position of the next marker of its line
    speed_m_s: float = 13.4  # [m/s]
    lawful: bool | None = None  # of another radio; else by `is_permitted`
    battery: Battery = field(default_factory=lambda: _BOARD)

    @property
    def radio(self) -> Radio:
        """The radio as it is simulated."""
        if self.other is not None:
            return self.other
        return Radio(
            self.settings.spreading_factor,
            self.settings.bandwidth_hz,
            self.settings.interval_s,
            min(self.settings.jitter_share, 0.4),
            self.payload_bytes,
            channels=self.settings.channels,
            slots=self.settings.slots,
            clock_sd_s=self.clock_sd_s,
        )

    @property
    def level_db(self) -> float:
        """Level against the paper's link. [dB]"""
        return self.settings.eirp_dbm - _PAPER_EIRP_DBM + self.gain_db

    @property
    def range_m(self) -> float:
        """Distance at which the mean level is the sensitivity. [m]"""
        return LinkModel().range_m(self.radio.sensitivity_dbm - self.level_db)

    @property
    def preview_m(self) -> float:
        """Distance ahead at which a marker must have been read. [m]"""
        return RadioPlan(design_speed_m_s=self.speed_m_s).preview_m

    def years(self, solar_mw: float) -> float:
        """Battery life. [year]"""
        drawn_ma = mean_current_ma(self.settings, self.battery)
        more_s = self.radio.airtime_s - self.settings.time_on_air_s
        assert self.battery.transmit_ma is not None
        drawn_ma += more_s * (self.battery.transmit_ma + self.battery.awake_ma) / self.settings.interval_s
        return life_days(drawn_ma, replace(self.battery, solar_mw=solar_mw)) / 365


def hearing_m(settings: RadioSettings) -> float:
    """Distance at which a polite marker hears another, if the road between them cost no more than to a vehicle. [m]"""
    level_db = settings.eirp_dbm - _PAPER_EIRP_DBM
    return LinkModel().range_m(polite_threshold_dbm(settings.bandwidth_hz) - level_db)


@cache
def recommended(speed_m_s: float = 13.4, lines: int = 2) -> RadioSettings:
    """Settings that the planner recommends in Europe, with markers on every line, for the board with a solar cell."""
    even = RadioPlan(_fixed(868_300_000), Region.EU868, design_speed_m_s=speed_m_s, battery=_SUNNY)
    wider = replace(even, markers=RoadMarkers(*_markers(lines, -_MAX_REACH_M, _MAX_REACH_M)))
    found = recommend_settings(even if lines == 2 else wider)
    assert found.radio is not None
    return found.radio


def _markers(lines: int, low_m: float, high_m: float) -> tuple[Floats, Floats]:
    """Chainage and offset from the vehicle's path of markers on every line, along the road."""
    along_m = np.arange(low_m, high_m, SPACING_M)
    offset_m = np.tile((0.5 - np.arange(lines)) * LANE_WIDTH_M, len(along_m))
    return np.repeat(along_m, lines), offset_m


@cache
def best_of_today(frequency_hz: int) -> RadioSettings:
    """The lawful settings on one channel that read most."""
    found = recommend_settings(RadioPlan(_fixed(frequency_hz), Region.EU868), more_channels=False)
    assert found.radio is not None
    return found.radio


def _fixed(frequency_hz: int) -> RadioSettings:
    return RadioSettings(frequency_hz, bandwidth_hz=125_000, power_dbm=14.0, interval_s=10.0)


def list_designs(short: bool) -> list[Design]:
    """One for each row; in short mode without wider roads and other speeds, whose recommendations take long."""
    duty, polite = "EN 300 220-2 B.1, {} duty cycle".format, "EN 300 220-1 5.21, polite, band {}".format
    one, tenth, slots = best_of_today(868_300_000), best_of_today(869_525_000), recommended()
    in_tenth = replace(tenth, interval_s=1.7, slotted=True, jitter_share=0.0, power_dbm=17.0)
    hopping = RadioSettings(863_100_000, 7, 125_000, 0.83, 0.2, 14.0, channels=10, hopping=True, polite=True)
    fast = replace(hopping, interval_s=0.58, channels=25)
    gfsk = Radio(7, 125_000, hopping.interval_s, channels=80, other_airtime_s=_GFSK_S, other_sensitivity_dbm=_GFSK_DBM)
    lr_fhss_s = 100 * _LR_FHSS_S  # a duty cycle of 1 %
    lr_fhss = Radio(7, 125_000, lr_fhss_s, channels=35, other_airtime_s=_LR_FHSS_S, other_sensitivity_dbm=_LR_FHSS_DBM)
    high = Radio(12, 125_000, 1.7, channels=16, other_airtime_s=_2G4_S, other_sensitivity_dbm=_2G4_DBM)
    designs = [
        Design("one channel at 868.3 MHz, best", duty("1 %"), one),
        Design("one channel at 869.525 MHz, best", duty("10 %"), tenth),
        Design("869.525 MHz in slots", duty("10 %"), in_tenth),
        Design("LR-FHSS, data rate 9", duty("1 %"), replace(one, interval_s=lr_fhss_s), lr_fhss, lawful=True),
        Design(
            "LoRa at 2.4 GHz, SF12, 203 kHz, 10 dBm EIRP", "EN 300 328 V2.2.2, at most 10 dBm",
            replace(hopping, interval_s=1.7, power_dbm=7.85), high, -_2G4_LOSS_DB, lawful=True,
        ),
        Design("GFSK of 4.8 kbit/s, 80 channels at random", polite("K"), hopping, gfsk, lawful=True),
        Design("10 channels at random", polite("K"), hopping),
        Design("the same, messages of 19 bytes", polite("K"), hopping, payload_bytes=19),
        Design("25 channels at random", polite("K and L"), fast),
        Design("10 channels at random, each repeats the next", polite("K"), replace(hopping, interval_s=2.4),
               payload_bytes=32, carried=True),
        Design("**10 channels in slots, recommended**", polite("K"), slots),
        Design("the same, a night without satellites", polite("K"), slots, clock_sd_s=NIGHT_CLOCK_S),
    ]  # fmt: skip
    if short:
        return designs
    slow, fast_lane = recommended(30 / 3.6), recommended(20.0)
    return [
        *designs,
        Design("10 channels in slots, 2 lanes", polite("K"), recommended(lines=3), lines=3),
        Design("10 channels in slots, 2 x 2 lanes", polite("K"), recommended(lines=6), lines=6),
        Design("10 channels in slots, 30 km/h", polite("K"), slow, speed_m_s=30 / 3.6),
        Design("10 channels in slots, 72 km/h", polite("K"), fast_lane, speed_m_s=20.0),
    ]


def share_in_time(design: Design, seed: Sequence[int], length_m: float = 1000.0) -> tuple[int, int]:
    """Markers of the driven lane that are read in time in one drive, and all of those."""
    rng = np.random.default_rng(seed)
    radio = design.radio
    reach_m = min(LinkModel().range_m(radio.sensitivity_dbm - design.level_db - 15.0), _MAX_REACH_M)
    at_m, left_m = _markers(design.lines, -reach_m, length_m + 2 * reach_m)
    last_s = (length_m + reach_m) / design.speed_m_s
    sent = send_beacons(len(at_m), radio, 0.0, last_s, rng)
    vehicle_m = sent.start_s * design.speed_m_s
    ground_m = np.hypot(at_m[sent.sender] - vehicle_m, left_m[sent.sender])
    near = ground_m <= reach_m
    sender, channel = sent.sender[near], sent.channel[near]
    start_s, vehicle_m = sent.start_s[near], vehicle_m[near]
    level = mean_rssi_dbm(np.hypot(ground_m[near], ANTENNA_M)) + design.level_db
    level = level + draw_shadows_db(sender, vehicle_m, radio, rng) + rng.normal(0, radio.fading_sd_db, len(level))
    received = receive_transmissions(start_s, level, radio, rng, channel)
    read_at_m = np.full(len(at_m), np.inf)  # of the vehicle, when it first knew a marker
    over_m = (start_s + radio.airtime_s) * design.speed_m_s
    for step in (0, design.lines) if design.carried else (0,):
        about = np.clip(sender[received] + step, 0, len(at_m) - 1)
        np.minimum.at(read_at_m, about, over_m[received])
    wanted = (np.arange(len(at_m)) % design.lines < 2) & (at_m >= reach_m) & (at_m < reach_m + length_m)
    return int((at_m - read_at_m >= design.preview_m)[wanted].sum()), int(wanted.sum())


def shares_in_time(design: Design, seed: int, drives: int, length_m: float) -> Floats:
    """Share read in time of each drive, shape (drives,)."""
    counts = np.array([share_in_time(design, (seed, 868, k), length_m) for k in range(drives)])
    return np.asarray(counts[:, 0] / counts[:, 1])


def run_europe(seed: int, short: bool) -> Result:
    """One row for each design."""
    drives, length_m = (1, 120.0) if short else (10, 1000.0)
    rows: list[Sequence[object]] = []
    for design in list_designs(short):
        radio, interval_s = design.radio, design.radio.interval_s
        shares = shares_in_time(design, seed, drives, length_m)
        lawful = is_permitted(design.settings, Region.EU868) if design.lawful is None else design.lawful
        rows.append(
            (
                design.name, design.law, "yes" if lawful else "**no**", f"{1000 * radio.airtime_s:.0f}",
                f"{interval_s:.2f}", f"{100 * radio.airtime_s / interval_s:.2f}", f"{design.range_m:.0f}",
                f"{100 * shares.mean():.1f}", f"{100 * shares.min():.1f}", f"{design.years(0.0):.2f}",
                f"{design.years(SOLAR_MW):.2f}",
            )
        )  # fmt: skip
    head = (
        "design", "law", "lawful", "on air [ms]", "every [s]", "on air [%]", "range [m]", "read in time [%]",
        "worst drive", "battery [years]", "with solar cell",
    )  # fmt: skip
    hears = hearing_m(recommended())
    note = (
        f"Markers 40 ft apart on both lines of a lane, 48 km/h, 60 m ahead, {drives} drives of {length_m:g} m; all "
        f"channels received. A polite marker hears another one within {hears:.1f} m: all of them are hidden nodes. "
        f"Battery of 1,000 mAh on a purpose-built board (8 uA asleep, 25.5 mA sending); solar cell of {SOLAR_MW:g} mW "
        "rated, 50 degrees north, at most ten years."
    )
    return note, head, rows
