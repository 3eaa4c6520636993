"""Limits of decodes that a deployment can set."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import timedelta

from app.formats.archives import ArchiveLimits
from app.formats.images import ImageLimits
from app.formats.packets.declaration import PacketLimits
from app.formats.traces.declaration import TraceLimits
from app.formats.video.index import VideoLimits


@dataclass(frozen=True, slots=True)
class DecodeRules:
    """What uploads may cost.

    Attributes
    ----------
    images : ImageLimits
    archives : ArchiveLimits
    videos : VideoLimits
    traces : TraceLimits
    packets : PacketLimits
    immediate_trace_bytes : int
        Recordings and packet logs up to this size are decoded while the caller waits, larger ones become jobs. [byte]
    frames_in_flight : int
        Frames of one archive that are decoded at the same time.
    progress_every : timedelta
        Shortest time between two reports of a job's progress.
    idempotency_ttl : timedelta
    """

    images: ImageLimits = field(default_factory=ImageLimits)
    archives: ArchiveLimits = field(default_factory=ArchiveLimits)
    videos: VideoLimits = field(default_factory=VideoLimits)
    traces: TraceLimits = field(default_factory=TraceLimits)
    packets: PacketLimits = field(default_factory=PacketLimits)
    immediate_trace_bytes: int = 8 * 1024**2
    frames_in_flight: int = 2
    progress_every: timedelta = timedelta(seconds=1)
    idempotency_ttl: timedelta = timedelta(hours=24)
