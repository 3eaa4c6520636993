"""A drive past markers: packets received by the vehicle, and its track."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from app.markers.cerpm import CerpmMessage, LaneSide
from app.sensors.pose_track import PoseTrack
from app.sensors.receiver import PlainClaim, ReceivedPacket
from app.simulation.radio.driving import Drive, Driver, SatelliteReceiver, drive_lane, observe_track
from app.simulation.radio.lanes import TrueLane
from app.simulation.radio.link import (
    Radio,
    Transmissions,
    draw_shadows_db,
    mean_rssi_dbm,
    receive_transmissions,
    send_beacons,
)
from app.simulation.radio.markers import InstalledMarkers
from app.simulation.radio.propagation import ANTENNA_M

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Sign = Callable[[CerpmMessage], bytes]

_SNR_LIMITS_DB = (-20.0, 12.0)  # [dB] source: range that LoRa receivers report
_SNR_SD_DB = 0.5  # [dB] of a reported SNR; source: assumed, no measurement kept


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedDrive:
    """A packet log and the vehicle's track, with the truth about both.

    Attributes
    ----------
    packets : tuple of ReceivedPacket
        In the order received.
    track : PoseTrack
        On the same clock.
    drive : Drive
        True positions of the vehicle.
    sent : Transmissions
        All of them.
    distance_m, strength_dbm : ndarray, shape (K,)
        Distance of each transmission from the vehicle, and strength at its receiver. [m, dBm]
    sender : ndarray of int, shape (len(packets),)
        Index of the installed marker that sent each packet.
    transmission : ndarray of int, shape (len(packets),)
        Index of each packet in `sent`.
    """

    packets: tuple[ReceivedPacket, ...]
    track: PoseTrack
    drive: Drive
    sent: Transmissions
    distance_m: Floats
    strength_dbm: Floats
    sender: Ints = field(default_factory=lambda: np.zeros(0, int))
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
    lane : TrueLane
    markers : InstalledMarkers
        Those that send.
    rng : numpy.random.Generator
        Draws the drive, the receiver's errors and the radio.
    sign : callable or None
        Message to the bytes that its marker sends; None for the paper's packets in clear.
    radio : Radio, optional
    driver : Driver, optional
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
    received = np.flatnonzero(receive_transmissions(sent.start_s, strength, radio, rng))
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
