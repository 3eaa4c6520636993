"""Limits of decodes that a deployment can set."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import timedelta

from app.decoders.archives import ArchiveLimits
from app.decoders.cerpm.packet_log import PacketLimits
from app.decoders.images import ImageLimits
from app.decoders.traces.declaration import TraceLimits


@dataclass(frozen=True, slots=True)
class DecodeRules:
    """What uploads may cost, and how patient jobs are.

    Attributes
    ----------
    images : ImageLimits
    archives : ArchiveLimits
    traces : TraceLimits
    packets : PacketLimits
    trace_at_once_bytes : int
        Recordings and packet logs up to this size are decoded while the caller waits, larger ones become jobs. [byte]
    frames_in_flight : int
        Frames of one archive that are decoded at the same time.
    max_attempts : int
        How often a job is started before it is given up.
    progress_every : timedelta
        Least time between two notes of a job's progress.
    idempotency_ttl : timedelta
    """

    images: ImageLimits = field(default_factory=ImageLimits)
    archives: ArchiveLimits = field(default_factory=ArchiveLimits)
    traces: TraceLimits = field(default_factory=TraceLimits)
    packets: PacketLimits = field(default_factory=PacketLimits)
    trace_at_once_bytes: int = 8 * 1024**2
    frames_in_flight: int = 2
    max_attempts: int = 3
    progress_every: timedelta = timedelta(seconds=1)
    idempotency_ttl: timedelta = timedelta(hours=24)
