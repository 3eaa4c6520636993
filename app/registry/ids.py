"""Identifiers that sort by the time they were made."""

from __future__ import annotations

import secrets
import struct
import uuid
from datetime import datetime


def new_ids(now: datetime, count: int, part: int = 0) -> list[str]:
    """Many UUIDs version 7, rising; those of a later `part` (0 to 4095) of the same time come after.

    Notes
    -----
    The part counts in the 12 bits after the time (RFC 9562, section 6.2, method 1).
    """
    milliseconds = int(now.timestamp() * 1000) & ((1 << 48) - 1)
    head = f"{milliseconds:012x}"
    head = f"{head[:8]}-{head[8:]}-7{part:03x}-"
    tails = sorted(f"{value | 1 << 63:016x}" for value in _random_62_bits(count))
    return [f"{head}{tail[:4]}-{tail[4:]}" for tail in tails]


def _random_62_bits(count: int) -> list[int]:
    values = struct.unpack(f">{count}Q", secrets.token_bytes(8 * count))
    return [value & (1 << 62) - 1 for value in values]


def new_id(now: datetime) -> str:
    """A UUID version 7 (RFC 9562, section 5.7) as text."""
    milliseconds = int(now.timestamp() * 1000) & ((1 << 48) - 1)
    value = milliseconds << 80 | 0x7 << 76 | secrets.randbits(12) << 64 | 0b10 << 62 | secrets.randbits(62)
    return str(uuid.UUID(int=value))
