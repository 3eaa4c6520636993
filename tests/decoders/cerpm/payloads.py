"""Payloads made byte by byte from the table in app/markers/cerpm.py, without Waymark's encoder."""

from __future__ import annotations

import struct

from cryptography.hazmat.primitives.ciphers.algorithms import AES
from cryptography.hazmat.primitives.cmac import CMAC

from app.sensors.pose_track import ReceivedPacket

LON_DEG, LAT_DEG = -85.6123456, 42.2834567
START_S = 1_790_000_000.0


def key_of(number: int) -> bytes:
    """Some key of a marker."""
    return struct.pack(">QQ", 0x5EED, number)


def body(
    number: int = 7,
    lon_deg: float = LON_DEG,
    lat_deg: float = LAT_DEG,
    *,
    head: int = 0x14,
    height: int = 12_503,
    speed: int = 50,
    sequence: int = 0,
) -> bytes:
    """The first 20 bytes."""
    steps = round(lon_deg * 1e7), round(lat_deg * 1e7)
    return struct.pack(">BIiiHBI", head, number, *steps, height, speed, sequence)


def signed(content: bytes, key: bytes | None = None) -> bytes:
    """With the tag of a key; without one, of the marker's own."""
    cmac = CMAC(AES(key or key_of(int.from_bytes(content[1:5]))))
    cmac.update(content)
    return content + cmac.finalize()[:4]


def heard(
    sequence: int, at_s: float, number: int = 7, *, entry: int = 0, payload: bytes | None = None
) -> ReceivedPacket:
    """An honest packet, unless it is given another payload."""
    content = payload or signed(body(number, LON_DEG + number * 1e-4, sequence=sequence))
    return ReceivedPacket(entry, START_S + at_s, content, rssi_dbm=-110.0)
