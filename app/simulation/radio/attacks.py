"""Faults of markers and logs, and attacks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from app.errors import InvalidParameter
from app.markers.cerpm import BODY_BYTES, MESSAGE_BYTES, TAG_BYTES
from app.sensors.pose_track import ReceivedPacket
from app.simulation.radio.lanes import InstalledMarkers, TrueLane

_ON_THE_LINE_M = 1.0  # [m] from a boundary, where a wrong position is not detectable
_TRIES = 1000  # bounds the search


def move_claim(
    lane: TrueLane, markers: InstalledMarkers, row: int, rng: np.random.Generator, *, distance_m: float = 30.0
) -> InstalledMarkers:
    """A marker that sends a wrong position, moved or programmed wrongly; its tags stay valid.

    Parameters
    ----------
    row : int
        Index of the marker.
    rng : numpy.random.Generator
        Draws the direction; one that leaves it on a boundary of the lane, or straight beyond an end of one, is drawn
        again: there it is on the line of its neighbours.
    distance_m : float
        [m]

    Raises
    ------
    InvalidParameter
        Every direction leaves it within a metre of a boundary.
    """
    lon, lat = markers.lon_deg.copy(), markers.lat_deg.copy()
    beyond = distance_m * np.linspace(0, 1, max(int(distance_m / 0.25), 2))[:, None]
    lines = []
    for line in (lane.left_m, lane.right_m):
        for end, ahead in ((line[0], line[0] - line[4]), (line[-1], line[-1] - line[-5])):
            lines.append(end + beyond * ahead / np.linalg.norm(ahead))
        lines.append(line)
    known = np.concatenate(lines)
    for _ in range(_TRIES):
        angle = float(rng.uniform(0, 2 * math.pi))
        place = markers.point_m[row] + distance_m * np.array([math.cos(angle), math.sin(angle)])
        if np.linalg.norm(known - place, axis=1).min() > _ON_THE_LINE_M:
            claim = lane.wgs84_from_enu(place[None])
            lon[row], lat[row] = float(claim[0][0]), float(claim[1][0])
            return replace(markers, lon_deg=lon, lat_deg=lat)
    raise InvalidParameter(
        f"no place {distance_m:g} m from a marker is off the lane's lines", field="distance_m", limit="above a metre"
    )


def corrupt_packets(packets: Sequence[ReceivedPacket], share: float, rng: np.random.Generator) -> list[ReceivedPacket]:
    """A log in which a share of the payloads has flipped bits, a lost end, or bytes too many."""
    out = list(packets)
    for k in np.flatnonzero(rng.random(len(out)) < share):
        payload = out[k].payload
        if payload is None:
            continue
        kind = int(rng.integers(3))
        if kind == 0:
            flipped = bytearray(payload)
            for bit in rng.choice(8 * len(flipped), int(rng.integers(1, 9)), replace=False):
                flipped[bit // 8] ^= 1 << (bit % 8)
            payload = bytes(flipped)
        elif kind == 1:
            payload = payload[: int(rng.integers(0, len(payload)))]
        else:
            payload = payload + rng.bytes(int(rng.integers(1, 12)))
        out[k] = replace(out[k], payload=payload)
    return out


def repeat_packets(
    packets: Sequence[ReceivedPacket], share: float, rng: np.random.Generator, *, within_s: float = 0.5
) -> list[ReceivedPacket]:
    """A log with a share of the packets twice, as from two gateways or repeated delivery."""
    out: list[ReceivedPacket] = []
    for packet, again, late in zip(
        packets, rng.random(len(packets)) < share, rng.uniform(0, within_s, len(packets)), strict=True
    ):
        out.append(packet)
        if again:
            out.append(replace(packet, received_at_s=packet.received_at_s + float(late), rssi_dbm=packet.rssi_dbm - 3))
    return out


def shuffle_packets(
    packets: Sequence[ReceivedPacket], rng: np.random.Generator, *, reach: int = 8
) -> list[ReceivedPacket]:
    """A log whose rows are out of order by up to `reach` rows; times stay with their packets."""
    order = np.argsort(np.arange(len(packets)) + rng.uniform(0, reach, len(packets)), kind="stable")
    return [packets[int(k)] for k in order]


def shift_clock(packets: Sequence[ReceivedPacket], offset_s: float) -> list[ReceivedPacket]:
    """A log whose receiver's clock is off against the vehicle's track."""
    return [replace(packet, received_at_s=packet.received_at_s + offset_s) for packet in packets]


def number_entries(packets: Sequence[ReceivedPacket]) -> list[ReceivedPacket]:
    """A log whose entries are numbered in order."""
    return [replace(packet, entry=entry) for entry, packet in enumerate(packets)]


def forge_packets(
    packets: Sequence[ReceivedPacket], count: int, rng: np.random.Generator, *, later_s: float = 0.0
) -> list[ReceivedPacket]:
    """Packets forged from received ones, without a key.

    Parameters
    ----------
    packets : sequence of ReceivedPacket
        With payloads; each forgery starts from one of them.
    rng : numpy.random.Generator
        Draws which, and how: another tag by chance; the tag of the packet kept and its place, its sequence or another
        bit of its body changed; the tag of another packet; a tag of zeros; the number of another marker.
    later_s : float
        Minimum delay after the packet that each starts from. [s]

    Raises
    ------
    InvalidParameter
        There are not two packets of the right length.
    """
    real = [(p, p.payload) for p in packets if p.payload is not None and len(p.payload) == MESSAGE_BYTES]
    if len(real) < 2:
        raise InvalidParameter("fewer than two packets to forge from", field="packets", limit="two or more")
    out: list[ReceivedPacket] = []
    while len(out) < count:
        (base, genuine), (_other, foreign) = (real[int(k)] for k in rng.choice(len(real), 2, replace=False))
        body, tag = bytearray(genuine[:BODY_BYTES]), genuine[BODY_BYTES:]
        kind = int(rng.integers(6))
        if kind == 0:
            body[5:13] = rng.bytes(8) if rng.random() < 0.5 else _nudged(bytes(body[5:13]), rng)
        elif kind == 1:
            more = int.from_bytes(body[16:20]) + int(rng.integers(1, 10_000))
            body[16:20] = (more % 2**32).to_bytes(4)
        elif kind == 2:
            bit = int(rng.integers(8 * BODY_BYTES))
            body[bit // 8] ^= 1 << (bit % 8)
        elif kind == 3:
            tag = foreign[BODY_BYTES:]
        elif kind == 4:
            body[1:5] = foreign[1:5]
        if kind == 5 or rng.random() < 0.3:
            tag = bytes(TAG_BYTES) if rng.random() < 0.2 else rng.bytes(TAG_BYTES)
        payload = bytes(body) + tag
        if payload in (genuine, foreign):
            continue  # nothing was changed
        late = later_s + float(rng.uniform(0, 5))
        out.append(replace(base, received_at_s=base.received_at_s + late, payload=payload))
    return out


def replay_packets(
    packets: Sequence[ReceivedPacket], count: int, rng: np.random.Generator, *, at_s: tuple[float, float]
) -> list[ReceivedPacket]:
    """Packets recorded on the road and sent again, bit by bit, between two times. [s]"""
    if not packets:
        raise InvalidParameter("no packets to replay", field="packets", limit="one or more")
    return [
        replace(packets[int(k)], received_at_s=float(t), rssi_dbm=float(round(rng.uniform(-115, -70))))
        for k, t in zip(rng.integers(0, len(packets), count), rng.uniform(*at_s, count), strict=True)
    ]


def _nudged(place: bytes, rng: np.random.Generator) -> bytes:
    """A longitude and latitude some ten metres off."""
    lon, lat = (int.from_bytes(place[k : k + 4], signed=True) for k in (0, 4))
    off = rng.integers(500, 5000, 2) * rng.choice((-1, 1), 2)
    return b"".join((v + int(d)).to_bytes(4, signed=True) for v, d in ((lon, off[0]), (lat, off[1])))
