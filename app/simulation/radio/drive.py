"""A drive past markers: packets received by the vehicle, and its track."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime

import numpy as np
import numpy.typing as npt
import scipy

from app.errors import InvalidParameter
from app.markers.cerpm import CerpmMessage, LaneSide
from app.sensors.pose_track import PlainClaim, PoseTrack, ReceivedPacket
from app.simulation.radio.lanes import InstalledMarkers, TrueLane
from app.simulation.radio.link import (
    ANTENNA_M,
    Radio,
    Transmissions,
    draw_shadows_db,
    mean_rssi_dbm,
    receive_transmissions,
    send_beacons,
)
from app.values import Floats, Ints

# === A driver's course in a lane, and the positions of the vehicle's satellite receiver.


MPH = 0.44704  # [m/s] source: definition
_TICK_S = 0.05  # [s] the 20 Hz of RTK receivers
_LATERAL_M_S2 = 2.5  # [m/s2] source: assumed, comfortable bends
_CURVATURE_SD_M = 15.0  # [m] Gaussian over which drivers look at bends; source: assumed, a second of driving
_SLOW_BEFORE_M = 60.0  # [m] over which speed is reduced about a bend; assumed
_SPEED_SD, _SPEED_LENGTH_M = 0.05, 60.0  # share and length [m] of uneven speed; assumed


@dataclass(frozen=True, slots=True)
class Driver:
    """Habits of a driver."""

    # [m/s] on straights; in bends limited by 2.5 m/s2 of lateral acceleration
    speed_m_s: float = 25 * MPH  # [m/s] source: the posted limit of the benchmark's lanes
    # `wander_sd_m`, `wander_time_s`: slow wander about the driver's usual offset in the lane. [m, s]
    wander_sd_m: float = 0.15  # [m] source: assumed, no measurement kept
    wander_time_s: float = 2.5  # [s] source: assumed, no measurement kept
    # [m] of that offset, from drive to drive: with the wander, 0.18 m RMS
    habit_sd_m: float = 0.09  # [m] source: assumed, no measurement kept
    # [m2] offset towards the inside of bends per curvature, mean of drives; its standard deviation is as large
    cut_m2: float = 1.0  # [m2] source: assumed, no measurement kept
    # [m] driven straight on before the lane begins and after it ends
    lead_m: float = 40.0  # [m] source: assumed, no measurement kept


@dataclass(frozen=True, slots=True)
class Multipath:
    """Errors by reflected signals: coloured noise, and steps when a reflection appears and when it goes.

    Raises
    ------
    InvalidParameter
        A value is negative, or a time is below 0.1 s.
    """

    # `sd_m`, `time_s`: coloured noise of each axis: standard deviation and time constant. [m, s]
    sd_m: float = 0.05  # [m] source: Groves, Principles of GNSS, 2nd ed. 2013, 9.3: a quarter of a wavelength at most
    time_s: float = 3.0  # [s] source: assumed; multipath of a moving receiver changes within seconds
    # [m] of a step, each axis
    step_sd_m: float = 0.3  # [m] source: assumed, a few decimetres
    # `steps_per_min`, `step_time_s`: reflections that appear in a minute, and how long one lasts on average. [1/min, s]
    steps_per_min: float = 3.0  # [1/min] source: assumed
    step_time_s: float = 6.0  # [s] source: assumed, 70 m of driving beside a reflecting wall or vehicle

    def __post_init__(self) -> None:
        lowest = min(self.sd_m, self.step_sd_m, self.steps_per_min, self.time_s - 0.1, self.step_time_s - 0.1)
        if not lowest >= 0:
            raise InvalidParameter(
                "multipath with a negative value", field="receiver.multipath", limit="0 or more; times from 0.1 s"
            )


@dataclass(frozen=True, slots=True)
class SatelliteReceiver:
    """A satellite receiver: errors of each axis."""

    white_sd_m: float  # [m] from fix to fix
    # `slow_sd_m`, `slow_time_s`: slow errors, as of multipath and troposphere: size and time constant. [m, s]
    slow_sd_m: float
    slow_time_s: float
    heading_sd_deg: float  # [deg] of a heading; half of it is as slow
    reported_accuracy_m: float  # [m] as reported by the receiver; NaN if it reports none
    rate_hz: float = 10.0  # [Hz] rate of fixes
    lost: float = 0.01  # share of fixes that are missing
    multipath: Multipath | None = None  # further errors, which the reported accuracy does not know

    @classmethod
    def rtk(cls, rate_hz: float = 20.0) -> SatelliteReceiver:
        """Two centimetres, mostly slow; heading from two antennas."""
        return cls(0.008, 0.018, 20.0, 0.3, 0.02, rate_hz)

    @classmethod
    def plain(cls, rate_hz: float = 10.0) -> SatelliteReceiver:
        """Two metres, nearly all of it slow; heading by course over ground."""
        return cls(0.1, 2.0, 40.0, 1.5, 2.0, rate_hz)


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """A vehicle on a lane, every 50 ms."""

    time_s: Floats  # shape (T,): [s] since 1970-01-01 UTC
    # `chainage_m`, `left_m`: shape (T,): [m] of the vehicle along the lane, below 0 before it begins, and left of its
    # centre
    chainage_m: Floats
    left_m: Floats
    point_m: Floats  # shape (T, 2): [m] east and north
    yaw_rad: Floats  # shape (T,): [rad] anticlockwise from east
    speed_m_s: Floats  # shape (T,) [m/s]


def drive_lane(lane: TrueLane, driver: Driver, rng: np.random.Generator, *, start_s: float = 1.78e9) -> Drive:
    """Drive a lane from before its beginning to past its end.

    Parameters
    ----------
    rng : numpy.random.Generator
        Draws speed, wander, habit and how bends are cut.
    start_s : float
        Seconds since 1970-01-01 UTC. [s]

    Raises
    ------
    InvalidParameter
        The speed is not from 1 to 60 m/s, or another value is negative.

    Notes
    -----
    The wander is Matern 3/2 noise in time, which has a finite lateral speed; its standard deviation and that of the
    habit add up to the 0.18 m of the driver's own track.
    """
    lowest = min(driver.wander_sd_m, driver.wander_time_s - 0.1, driver.habit_sd_m, driver.lead_m)
    if not 1 <= driver.speed_m_s <= 60 or lowest < 0:
        raise InvalidParameter(
            f"a drive of {driver.speed_m_s:g} m/s", field="driver", limit="1 to 60 m/s; spreads of zero or more"
        )
    time, chainage, speed = _advance(lane, driver, rng)
    inside = np.clip(chainage, 0.0, lane.length_m)
    bend = np.interp(
        inside,
        lane.chainage_m,
        scipy.ndimage.gaussian_filter1d(lane.curvature_per_m, _CURVATURE_SD_M / lane.chainage_m[1]),
    )
    left = matern_noise(len(time), _TICK_S, driver.wander_time_s, rng) * driver.wander_sd_m
    left = left + float(rng.normal(0, driver.habit_sd_m)) + float(rng.normal(1, 1)) * driver.cut_m2 * bend
    point = lane.points_m(chainage, left)
    step = np.gradient(point, axis=0)
    return Drive(start_s + time, chainage, left, point, np.unwrap(np.arctan2(step[:, 1], step[:, 0])), speed)


def observe_track(lane: TrueLane, drive: Drive, receiver: SatelliteReceiver, rng: np.random.Generator) -> PoseTrack:
    """Track of a drive, as positioned by a receiver.

    Parameters
    ----------
    rng : numpy.random.Generator
        Draws its errors, its jitter and which fixes are missing.
    """
    period = 1.0 / receiver.rate_hz
    span = drive.time_s[-1] - drive.time_s[0]
    ticks = np.arange(0.0, span, period)
    when = ticks + rng.uniform(0, 0.05, len(ticks)) * period
    slow = ornstein_noise(len(ticks), period, receiver.slow_time_s, rng, 3)
    kept = rng.random(len(ticks)) >= receiver.lost
    if kept.sum() < 2:
        raise InvalidParameter("a track of fewer than two fixes", field="receiver.lost", limit="two fixes or more")
    since = drive.time_s - drive.time_s[0]
    at = np.stack([np.interp(when, since, drive.point_m[:, k]) for k in range(2)], 1)
    at = at + slow[:, :2] * receiver.slow_sd_m + rng.normal(0, 1, (len(ticks), 2)) * receiver.white_sd_m
    if receiver.multipath is not None:  # from a generator of its own, so that all else stays the same
        at = at + draw_multipath_m(receiver.multipath, when, rng.spawn(1)[0])
    yaw_error = (slow[:, 2] + rng.normal(0, math.sqrt(3), len(ticks))) / 2 * receiver.heading_sd_deg
    heading = (90.0 - np.degrees(np.interp(when, since, drive.yaw_rad)) + yaw_error) % 360.0
    lon, lat = lane.wgs84_from_enu(at[kept])
    accuracy = np.full(int(kept.sum()), receiver.reported_accuracy_m)
    return PoseTrack(drive.time_s[0] + when[kept], lon, lat, heading[kept], accuracy)


def draw_multipath_m(multipath: Multipath, time_s: Floats, rng: np.random.Generator) -> Floats:
    """Errors of positions by reflected signals, east and north, shape (T, 2). [m]

    Parameters
    ----------
    time_s : ndarray, shape (T,)
        Rising, nearly evenly; T is 2 or more. [s]

    Notes
    -----
    The coloured noise is a critically damped Gauss-Markov process of second order (Gelb, Applied Optimal Estimation,
    1974, table 2.2-1), whose rate of change is finite. Steps begin as a Poisson process, last for exponential times and
    add up; some have begun before the first fix.
    """
    step_s = float(np.mean(np.diff(time_s)))
    noise = np.stack([matern_noise(len(time_s), step_s, multipath.time_s, rng) for _ in range(2)], 1)
    error = multipath.sd_m * noise
    begin, end = float(time_s[0]) - 5 * multipath.step_time_s, float(time_s[-1])
    count = rng.poisson(multipath.steps_per_min * (end - begin) / 60)
    starts = rng.uniform(begin, end, count)
    ends = starts + rng.exponential(multipath.step_time_s, count)
    for start, stop, step_m in zip(starts, ends, rng.normal(0, multipath.step_sd_m, (count, 2)), strict=True):
        error[(time_s >= start) & (time_s < stop)] += step_m
    return np.asarray(error)


def ornstein_noise(count: int, step_s: float, time_s: float, rng: np.random.Generator, rows: int = 1) -> Floats:
    """Noise with exponential correlation, standard deviation 1, shape (count, rows)."""
    keep = math.exp(-step_s / time_s)
    drawn = rng.normal(0, 1, (count, rows))
    drawn[1:] *= math.sqrt(1 - keep**2)
    return _recursed(drawn, keep)


def matern_noise(count: int, step_s: float, time_s: float, rng: np.random.Generator) -> Floats:
    """Noise with a finite rate of change (Matern 3/2), standard deviation 1, shape (count,).

    Notes
    -----
    Two equal first-order filters on white noise; correlation (1 + t/T) exp(-t/T). The first 20 T are discarded.
    """
    lead = int(20 * time_s / step_s)
    keep = math.exp(-step_s / time_s)
    once = _recursed(rng.normal(0, 1, (count + lead, 1)), keep)
    twice = _recursed(once, keep)[lead:, 0]
    power = (1 + keep**2) / (1 - keep**2) ** 3  # sum of (k + 1)^2 keep^2k
    return np.asarray(twice / math.sqrt(power))


def _recursed(values: Floats, keep: float) -> Floats:
    return np.asarray(scipy.signal.lfilter([1.0], [1.0, -keep], values, axis=0))


def _advance(lane: TrueLane, driver: Driver, rng: np.random.Generator) -> tuple[Floats, Floats, Floats]:
    """Times, chainages and speeds of the drive: slower in bends, and uneven."""
    step = float(lane.chainage_m[1])
    cap = np.sqrt(_LATERAL_M_S2 / np.maximum(np.abs(lane.curvature_per_m), 1e-6))
    cap = scipy.ndimage.minimum_filter1d(np.minimum(cap, driver.speed_m_s), int(_SLOW_BEFORE_M / step), mode="nearest")
    cap = scipy.ndimage.gaussian_filter1d(cap, _CURVATURE_SD_M / step, mode="nearest")
    pad = int(driver.lead_m / step) + 1
    at = np.concatenate(
        [
            -step * np.arange(pad, 0, -1),
            lane.chainage_m,
            lane.length_m + step * np.arange(1, pad + 1),
        ]
    )
    uneven = matern_noise(len(at), step, _SPEED_LENGTH_M, rng)
    speed = np.pad(cap, pad, mode="edge") * np.clip(1 + _SPEED_SD * uneven, 0.8, 1.2)
    clock = np.concatenate([[0.0], np.cumsum(step / ((speed[1:] + speed[:-1]) / 2))])
    time = np.arange(0.0, clock[-1], _TICK_S)
    return time, np.interp(time, clock, at), np.interp(time, clock, speed)


# === A drive past markers.


Sign = Callable[[CerpmMessage], bytes]

_SNR_LIMITS_DB = (-20.0, 12.0)  # [dB] source: range that LoRa receivers report
_SNR_SD_DB = 0.5  # [dB] of a reported SNR; assumed


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedDrive:
    """A packet log and the vehicle's track, with the truth about both."""

    packets: tuple[ReceivedPacket, ...]  # in the order received
    track: PoseTrack  # on the same clock
    drive: Drive  # True positions of the vehicle
    sent: Transmissions  # all of them
    # `distance_m`, `strength_dbm`: shape (K,): distance of each transmission from the vehicle, and strength at its
    # receiver. [m, dBm]
    distance_m: Floats
    strength_dbm: Floats
    # shape (len(packets),): index of the installed marker that sent each packet
    sender: Ints = field(default_factory=lambda: np.zeros(0, int))
    # shape (len(packets),): index of each packet in `sent`
    transmission: Ints = field(default_factory=lambda: np.zeros(0, int))


def drive_past(
    lane: TrueLane,
    markers: InstalledMarkers,
    rng: np.random.Generator,
    *,
    sign: Sign | None,
    radio: Radio | None = None,
    driver: Driver | None = None,
    receiver: SatelliteReceiver | None = None,
    drive: Drive | None = None,
    start_s: float = 1.78e9,
    first_sequence: npt.ArrayLike | None = None,
) -> SimulatedDrive:
    """Drive a lane and receive packets.

    Parameters
    ----------
    markers : InstalledMarkers
        Those that send.
    rng : numpy.random.Generator
        Draws the drive, the receiver's errors and the radio.
    sign : callable or None
        Message to the bytes that its marker sends; None for the paper's packets in clear.
    receiver : SatelliteReceiver, optional
        RTK by default.
    drive : Drive, optional
        What is driven, in place of a drive of `driver`.
    start_s : float
        Seconds since 1970-01-01 UTC. [s]
    first_sequence : array_like of int, shape (N,), optional
        Of each marker's first transmission.
    """
    radio = radio or Radio()
    drive = drive or drive_lane(lane, driver or Driver(), rng, start_s=start_s)
    track = observe_track(lane, drive, receiver or SatelliteReceiver.rtk(), rng)
    sent = send_beacons(
        len(markers), radio, float(drive.time_s[0]), float(drive.time_s[-1]), rng, first_sequence=first_sequence
    )
    at = np.stack([np.interp(sent.start_s, drive.time_s, drive.point_m[:, k]) for k in range(2)], 1)
    across_m = markers.point_m[sent.sender] - at
    ground = np.linalg.norm(across_m, axis=1)
    distance = np.hypot(ground, ANTENNA_M)
    travelled = np.interp(sent.start_s, drive.time_s, drive.chainage_m)
    mean = mean_rssi_dbm(distance) if radio.two_ray is None else radio.two_ray.mean_rssi_dbm(ground)
    if radio.antenna_pattern is not None:
        yaw = np.interp(sent.start_s, drive.time_s, drive.yaw_rad)
        mean = mean + radio.antenna_pattern.gain_db(np.degrees(np.arctan2(across_m[:, 1], across_m[:, 0]) - yaw))
    strength = mean + draw_shadows_db(sent.sender, travelled, radio, rng)
    strength = strength + rng.normal(0, radio.fading_sd_db, len(strength))
    channel = sent.channel if radio.channels > 1 else None
    received = np.flatnonzero(receive_transmissions(sent.start_s, strength, radio, rng, channel))
    snr = np.clip(strength[received] - radio.noise_dbm + rng.normal(0, _SNR_SD_DB, len(received)), *_SNR_LIMITS_DB)
    packets = tuple(
        _packet(entry, markers, sent, int(k), radio, sign, float(strength[k]), float(snr[entry]))
        for entry, k in enumerate(received)
    )
    return SimulatedDrive(packets, track, drive, sent, distance, strength, sent.sender[received], received)


def _packet(
    entry: int,
    markers: InstalledMarkers,
    sent: Transmissions,
    k: int,
    radio: Radio,
    sign: Sign | None,
    strength_dbm: float,
    snr_db: float,
) -> ReceivedPacket:
    """A packet as the receiver logs it when it is over: RSSI in whole dB, SNR in quarters."""
    message = marker_message(markers, int(sent.sender[k]), int(sent.sequence[k]))
    at_s, rssi, snr = float(sent.start_s[k]) + radio.airtime_s, float(round(strength_dbm)), round(4 * snr_db) / 4
    if sign is not None:
        return ReceivedPacket(entry, at_s, payload=sign(message), rssi_dbm=rssi, snr_db=snr)
    claim = PlainClaim(
        message.number, message.lon_deg, message.lat_deg, message.height_m, message.side, message.speed_limit
    )
    return ReceivedPacket(entry, at_s, claim=claim, rssi_dbm=rssi, snr_db=snr)


def marker_message(markers: InstalledMarkers, row: int, sequence: int) -> CerpmMessage:
    """Message of an installed marker in a transmission."""
    return CerpmMessage(
        number=int(markers.number[row]),
        lon_deg=float(markers.lon_deg[row]),
        lat_deg=float(markers.lat_deg[row]),
        side=LaneSide(int(markers.broadcast_side[row])),
        speed_limit=markers.speed_limit,
        sequence=sequence,
    )


# === What a vehicle uploads of a drive.


def write_packets(packets: Sequence[ReceivedPacket]) -> str:
    """A receiver's log: a JSON object a packet."""
    lines = [
        {
            "time": datetime.fromtimestamp(packet.received_at_s, UTC).isoformat(),
            "payload_hex": packet.payload.hex() if packet.payload else "",
            "rssi_dbm": packet.rssi_dbm,
            "snr_db": packet.snr_db,
        }
        for packet in packets
    ]
    return "".join(json.dumps(line) + "\n" for line in lines)


def write_poses(track: PoseTrack) -> str:
    """A track as CSV."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(("time_s", "lon_deg", "lat_deg", "heading_deg", "accuracy_m"))
    for row in zip(track.time_s, track.lon_deg, track.lat_deg, track.heading_deg, track.accuracy_m, strict=True):
        time_s, lon, lat, heading, accuracy = (float(value) for value in row)
        writer.writerow((f"{time_s:.3f}", f"{lon:.9f}", f"{lat:.9f}", f"{heading:.3f}", f"{accuracy:.3f}"))
    return stream.getvalue()
