"""The radio between markers and a vehicle: path loss, sensitivity, collisions, a receiver for one packet at a time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter
from app.markers.cerpm import MESSAGE_BYTES
from app.radio.link import MIN_DISTANCE_M, NEAR_DBM, NEAR_M, LinkModel, sensitivity_dbm
from app.radio.settings import (
    MAX_CHANNELS,
    Slots,
    check_between,
    check_modulation,
    check_whole,
    symbol_time_s,
    time_on_air_s,
)
from app.values import Bools, Floats, Ints

# === Mean strength of a marker by two rays, the direct one and one reflected by the road, and a vehicle's antenna
# pattern.
#
# Both are options of `Radio`; without them strength falls with the logarithm of distance, alike in all directions.


Complexes = npt.NDArray[np.complex128]

ANTENNA_M = 1.5  # [m] height of the antenna above the road; source: assumed, the roof of a car
_MARKER_M = 0.05  # [m] height of a marker's antenna; source: assumed, of a raised pavement marker
_FREQUENCY_HZ = 915e6  # [Hz] source: middle of the US band of 902 to 928 MHz
_PERMITTIVITY = 5.0  # relative, of asphalt; source: assumed, between dry and wet in tables of ground-penetrating radar
_CONDUCTIVITY_S_M = 0.005  # [S/m] of asphalt; source: assumed, as above
_LIGHT_M_S = 299_792_458.0  # [m/s] source: definition
_VACUUM_F_M = 8.8541878128e-12  # [F/m] permittivity of vacuum; source: CODATA 2018


@dataclass(frozen=True, slots=True)
class TwoRay:
    """Direct and reflected ray between a marker and an antenna, both vertically polarised.

    Raises
    ------
    InvalidParameter
        A value is outside its limits.

    Notes
    -----
    Rappaport, Wireless Communications, 2nd edition 2002, sections 4.5 and 4.6, with the exact lengths of both rays.
    Beyond 4 antenna_m marker_m / wavelength, a metre for a marker in the road, strength falls with the fourth power
    of distance. The surface wave, which fills up the field below a tenth of a metre, is left out.
    """

    # `antenna_m`, `marker_m`: [m] heights above the road, 0.01 to 30
    antenna_m: float = ANTENNA_M
    marker_m: float = _MARKER_M
    frequency_hz: float = _FREQUENCY_HZ  # [Hz] 100 MHz to 10 GHz
    permittivity: float = _PERMITTIVITY  # relative permittivity of the road, 1 to 100
    conductivity_s_m: float = _CONDUCTIVITY_S_M  # [S/m] of the road, 0 to 10
    near_dbm: float = NEAR_DBM  # [dBm] level at 50 m along the road: the CERPM paper's by default

    def __post_init__(self) -> None:
        check_between("two_ray.antenna_m", self.antenna_m, 0.01, 30.0, "m")
        check_between("two_ray.marker_m", self.marker_m, 0.01, 30.0, "m")
        check_between("two_ray.frequency_hz", self.frequency_hz, 1e8, 1e10, "Hz")
        check_between("two_ray.permittivity", self.permittivity, 1.0, 100.0, "")
        check_between("two_ray.conductivity_s_m", self.conductivity_s_m, 0.0, 10.0, "S/m")
        check_between("two_ray.near_dbm", self.near_dbm, -150.0, 0.0, "dBm")

    def mean_rssi_dbm(self, ground_m: npt.ArrayLike) -> Floats:
        """Mean level at distances along the road, of any shape; below 1 m as at 1 m. [dBm]"""
        level = self.near_dbm + self._gain_db(np.asarray(ground_m, float)) - self._gain_db(np.array(NEAR_M))
        return np.asarray(level)

    def reflection(self, elevation_rad: npt.ArrayLike) -> Complexes:
        """Fresnel coefficient of the road by the angle of a ray above it, of any shape; vertical polarisation."""
        sine = np.sin(np.asarray(elevation_rad, float))
        loss = self.conductivity_s_m / (2 * math.pi * self.frequency_hz * _VACUUM_F_M)
        permittivity = complex(self.permittivity, -loss)
        root = np.sqrt(permittivity - 1 + sine**2)
        return np.asarray((permittivity * sine - root) / (permittivity * sine + root))

    def _gain_db(self, ground_m: Floats) -> Floats:
        """Power of both rays against that of the direct one at 1 m. [dB]"""
        ground = np.maximum(ground_m, MIN_DISTANCE_M)
        direct = np.hypot(ground, self.antenna_m - self.marker_m)
        reflected = np.hypot(ground, self.antenna_m + self.marker_m)
        coefficient = self.reflection(np.arctan2(self.antenna_m + self.marker_m, ground))
        longer_rad = 2 * math.pi * self.frequency_hz / _LIGHT_M_S * (reflected - direct)
        field = 1 / direct + coefficient * np.exp(-1j * longer_rad) / reflected
        return np.asarray(20 * np.log10(np.abs(field)))


class Notch(NamedTuple):
    """Where an antenna is weak: azimuth from the vehicle's front, left positive [deg], depth [dB], and width [deg]."""

    azimuth_deg: float
    depth_db: float
    width_deg: float


_NOTCHES = (Notch(180.0, 12.0, 35.0), Notch(90.0, 6.0, 15.0), Notch(-90.0, 6.0, 15.0))
"""Behind and to both sides. [deg, dB, deg] Source: assumed; published patterns of antennas on cars differ by some 10 dB
around the vehicle."""


@dataclass(frozen=True, slots=True)
class AntennaPattern:
    """Gain of a vehicle's antenna by azimuth: 0 dB but for Gaussian notches.

    Raises
    ------
    InvalidParameter
        A depth or a width is outside its limits.
    """

    # each with a depth of 0 to 60 dB and a width (standard deviation) of 1 to 180 degrees
    notches: tuple[Notch, ...] = _NOTCHES

    def __post_init__(self) -> None:
        for notch in self.notches:
            if not (0 <= notch.depth_db <= 60 and 1 <= notch.width_deg <= 180 and math.isfinite(notch.azimuth_deg)):
                raise InvalidParameter(
                    f"a notch of {notch.depth_db:g} dB, {notch.width_deg:g} degrees wide",
                    field="antenna_pattern.notches",
                    limit="0 to 60 dB, 1 to 180 degrees",
                )

    def gain_db(self, azimuth_deg: npt.ArrayLike) -> Floats:
        """Gain at azimuths of any shape, from the vehicle's front, left positive. [dB]"""
        azimuth = np.asarray(azimuth_deg, float)
        gain = np.zeros_like(azimuth)
        for notch in self.notches:
            away = (azimuth - notch.azimuth_deg + 180.0) % 360.0 - 180.0
            gain = gain - notch.depth_db * np.exp(-((away / notch.width_deg) ** 2) / 2)
        return gain


# === The radio between markers and a vehicle.


_NOISE_FIGURE_DB = 6.0  # [dB] source: assumed for the SX1276, no measurement kept
_SOFT_DB = 0.35  # [dB] scale of the logistic step from no reception to full reception; source: assumed
_PREAMBLE_TAIL_SYMBOLS = 4.25  # source: SX1276 data sheet, 4.1.1.7


@dataclass(frozen=True, slots=True)
class Radio:
    """Transmission, propagation and reception of markers' packets."""

    spreading_factor: int = 7  # 7 to 12
    bandwidth_hz: int = 500_000  # [Hz] 125, 250 or 500 kHz
    # `interval_s`, `jitter`: [s] between transmissions of a marker, and the maximum share of it by which each is early
    # or late, below half
    interval_s: float = 2.0  # [s]
    jitter: float = 0.1
    payload_bytes: int = MESSAGE_BYTES  # [bytes]
    preamble_symbols: int = 8  # programmed length
    # of the preamble's end that the receiver needs undisturbed to lock (Bor et al. 2016: five).
    lock_symbols: float = 5.0  # source: Bor et al. 2016, section 4
    # [dB] by how much a packet must be above the sum of all others to be read; infinite: never read
    capture_db: float = 6.0  # [dB] source: Bor et al. 2016, section 4
    # `shadow_sd_db`, `shadow_length_m`: of shadowing, and its correlation length along the vehicle's way (Gudmundson
    # 1991). [dB, m]
    shadow_sd_db: float = 4.0  # [dB] source: assumed, no measurement kept
    shadow_length_m: float = 25.0  # [m] source: assumed, no measurement kept
    # [dB] of fading from packet to packet
    fading_sd_db: float = 2.0  # [dB] source: assumed, no measurement kept
    two_ray: TwoRay | None = None  # mean strength by two rays; None for log-distance
    antenna_pattern: AntennaPattern | None = None  # of the vehicle's antenna; None if it is alike in all directions
    channels: int = 1  # hopped over, all of them received
    slots: Slots | None = None  # in which markers send; None: from random phases, with jitter
    clock_sd_s: float = 0.0  # [s] of the errors of markers' clocks, which move their slots; constant in a drive
    # `other_airtime_s`, `other_sensitivity_dbm`: of another modulation than the LoRa of an SX1276. [s, dBm]
    other_airtime_s: float | None = None
    other_sensitivity_dbm: float | None = None

    def __post_init__(self) -> None:
        check_modulation(self.spreading_factor, self.bandwidth_hz)
        check_whole("radio.channels", self.channels, 1, MAX_CHANNELS, "")
        check_between("radio.clock_sd_s", self.clock_sd_s, 0.0, 3600.0, "s")
        if not (0 <= self.jitter < 0.5 and (1 - 2 * self.jitter) * self.interval_s > self.airtime_s):
            raise InvalidParameter(
                f"an interval of {self.interval_s:g} s with a jitter of {self.jitter:g}",
                field="radio.interval_s",
                limit=f"longer than the {self.airtime_s:.3f} s on air, jitter included",
            )

    @property
    def airtime_s(self) -> float:
        """Time on air of one packet. [s]"""
        if self.other_airtime_s is not None:
            return self.other_airtime_s
        return time_on_air_s(
            self.payload_bytes, self.spreading_factor, self.bandwidth_hz, preamble_symbols=self.preamble_symbols
        )

    @property
    def spare_s(self) -> float:
        """From the start of a packet to where the receiver needs it undisturbed. [s]"""
        return max(self.preamble_symbols + _PREAMBLE_TAIL_SYMBOLS - self.lock_symbols, 0.0) * self.symbol_s

    @property
    def symbol_s(self) -> float:
        """[s]"""
        return symbol_time_s(self.spreading_factor, self.bandwidth_hz)

    @property
    def sensitivity_dbm(self) -> float:
        """Strength at which half of the packets are received. [dBm]"""
        if self.other_sensitivity_dbm is not None:
            return self.other_sensitivity_dbm
        return sensitivity_dbm(self.spreading_factor, self.bandwidth_hz)

    @property
    def noise_dbm(self) -> float:
        """Thermal noise in the receiver. [dBm]"""
        return -174.0 + 10 * math.log10(self.bandwidth_hz) + _NOISE_FIGURE_DB


@dataclass(frozen=True, slots=True, eq=False)
class Transmissions:
    """Transmissions of markers, by time."""

    sender: Ints  # shape (K,): index of the marker
    sequence: Ints  # shape (K,): of its message
    start_s: Floats  # shape (K,) [s]
    channel: Ints  # shape (K,)


def mean_rssi_dbm(distance_m: npt.ArrayLike) -> Floats:
    """Strength by distance, without shadows and fading: log-distance through the paper's two points. [dBm]"""
    return LinkModel().level_dbm(distance_m)


def send_beacons(
    count: int,
    radio: Radio,
    start_s: float,
    end_s: float,
    rng: np.random.Generator,
    *,
    first_sequence: npt.ArrayLike | None = None,
    place: npt.ArrayLike | None = None,
) -> Transmissions:
    """Transmissions of independent markers from one time to another.

    Parameters
    ----------
    count : int
        Markers.
    start_s, end_s : float
        [s]
    rng : numpy.random.Generator
        Draws phases, jitter, channels and first sequences; in slots, errors of clocks.
    first_sequence : array_like of int, shape (count,), optional
        Drawn below 1,000,000 by default.
    place : array_like of int, shape (count,), optional
        Of each marker in a frame of slots; in order by default.

    Notes
    -----
    A marker's turns are one interval apart. Without slots they have a random phase; each transmission is uniformly
    early or late in its turn, and hops to a random channel. Clocks of 20 ppm do not matter within a drive. In slots a
    clock that is wrong by more than the guard time collides with the neighbouring slots.
    """
    turns = int((end_s - start_s) / radio.interval_s) + 2
    first = rng.integers(0, 1_000_000, count) if first_sequence is None else np.asarray(first_sequence, int)
    if radio.slots is None:
        phase = rng.uniform(-1, 0, (count, 1)) * radio.interval_s
        jitter = rng.uniform(-radio.jitter, radio.jitter, (count, turns)) * radio.interval_s
        start = start_s + phase + np.arange(turns) * radio.interval_s + jitter
        channel = rng.integers(0, radio.channels, start.shape) if radio.channels > 1 else np.zeros(start.shape, int)
    else:
        places = np.arange(count) if place is None else np.asarray(place, int)
        frame = math.floor(start_s / radio.slots.frame_s) + np.arange(turns)
        slot, channel = radio.slots.at(places[:, None], frame)
        late_s = rng.normal(0, radio.clock_sd_s, (count, 1))
        start = frame * radio.slots.frame_s + slot * radio.slots.slot_s + late_s
    sender, turn = np.nonzero((start >= start_s) & (start < end_s))
    sent = start[sender, turn]
    order = np.argsort(sent, kind="stable")
    sender, turn = sender[order], turn[order]
    return Transmissions(sender, first[sender] + turn, sent[order], channel[sender, turn])


def draw_shadows_db(sender: Ints, travelled_m: Floats, radio: Radio, rng: np.random.Generator) -> Floats:
    """Shadowing of each transmission, correlated along the way between the same marker and the vehicle. [dB]

    Parameters
    ----------
    sender : ndarray of int, shape (K,)
        By time.
    travelled_m : ndarray, shape (K,)
        Distance driven by the vehicle. [m]
    """
    drawn = rng.normal(0, 1, len(sender))
    shadows = np.empty(len(sender))
    for one in np.unique(sender):
        mine = np.flatnonzero(sender == one)
        keep = np.exp(-np.diff(travelled_m[mine]) / radio.shadow_length_m)
        value = 0.0
        for k, at in enumerate(mine):
            share = float(keep[k - 1]) if k else 0.0
            value = share * value + math.sqrt(1 - share**2) * drawn[at]
            shadows[at] = value
    return shadows * radio.shadow_sd_db


def receive_transmissions(
    start_s: Floats, strength_dbm: Floats, radio: Radio, rng: np.random.Generator, channel: Ints | None = None
) -> Bools:
    """Which transmissions one receiver reads; on each of several channels it reads one packet at a time.

    Parameters
    ----------
    start_s : ndarray, shape (K,)
        Rising. [s]
    strength_dbm : ndarray, shape (K,)
        At the receiver. [dBm]
    radio : Radio
        All send with the same settings.
    rng : numpy.random.Generator
        Draws receptions near the sensitivity.
    channel : ndarray of int, shape (K,), optional
        Of each transmission; by default all are on one.

    Returns
    -------
    ndarray of bool, shape (K,)

    Notes
    -----
    Bor et al. 2016, "Do LoRa low-power wide-area networks scale?", section 4: packets of one spreading factor collide
    where they overlap, but for the beginning of the preamble, unless one is `capture_db` above the others. The
    receiver locks on to a preamble if it is idle and then receives nothing else until that packet is over: another
    packet that begins meanwhile is lost, and if it is strong enough, the first one too.
    """
    if channel is not None:
        received = np.zeros(len(start_s), bool)
        for one in np.unique(channel):
            here = np.flatnonzero(channel == one)
            received[here] = receive_transmissions(start_s[here], strength_dbm[here], radio, rng)
        return received
    airtime, spare = radio.airtime_s, radio.spare_s
    odds = 1 / (1 + np.exp(-np.clip((strength_dbm - radio.sensitivity_dbm) / _SOFT_DB, -60, 60)))
    audible = rng.random(len(start_s)) < odds
    power = 10 ** (strength_dbm / 10)
    first = np.searchsorted(start_s, start_s - airtime + spare, side="right")
    locked = np.searchsorted(start_s, start_s + spare + radio.lock_symbols * radio.symbol_s, side="left")
    last = np.searchsorted(start_s, start_s + airtime, side="left")
    received = np.zeros(len(start_s), bool)
    free_at = -math.inf
    for k in np.flatnonzero(audible):
        if start_s[k] + spare < free_at:
            continue  # another packet is being read
        others = np.r_[first[k] : k, k + 1 : locked[k]]
        if not _is_captured(power[k], power[others].sum(), radio.capture_db):
            continue  # no lock on a disturbed preamble
        free_at = start_s[k] + airtime
        others = np.r_[first[k] : k, k + 1 : last[k]]
        worst = _strongest_moment(start_s[others], power[others], start_s[k] + spare, airtime)
        received[k] = _is_captured(power[k], worst, radio.capture_db)
    return received


def _is_captured(power_mw: float, others_mw: float, capture_db: float) -> bool:
    return others_mw <= 0 or power_mw >= 10 ** (capture_db / 10) * others_mw


def _strongest_moment(start_s: Floats, power_mw: Floats, from_s: float, airtime_s: float) -> float:
    """Greatest sum of packets' powers at any moment after a time; it is reached when one of them begins. [mW]"""
    moments = np.maximum(start_s, from_s)[:, None]
    on_air = (start_s <= moments) & (start_s + airtime_s > moments)
    return float((on_air * power_mw).sum(axis=1).max(initial=0.0))
