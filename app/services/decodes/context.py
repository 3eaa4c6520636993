"""Kinds of decodes, what they may cost, and the times of their results."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from typing import Literal

from app.formats.format import ArchiveLimits
from app.formats.images import ImageLimits
from app.formats.packets.rows import PacketLimits
from app.formats.traces.declaration import TraceLimits
from app.formats.video_file import VideoLimits
from app.registry.decodes import DecodeRow
from app.values import JsonObject

# === Kinds of decodes.


class DecodeKind(StrEnum):
    """What was decoded."""

    FRAME = "frame"
    ARCHIVE = "archive"
    VIDEO = "video"
    TRACE = "trace"
    PACKETS = "packets"


# === Limits of decodes that a deployment can set.


@dataclass(frozen=True, slots=True)
class DecodeRules:
    """What uploads may cost."""

    images: ImageLimits = field(default_factory=ImageLimits)
    archives: ArchiveLimits = field(default_factory=ArchiveLimits)
    videos: VideoLimits = field(default_factory=VideoLimits)
    traces: TraceLimits = field(default_factory=TraceLimits)
    packets: PacketLimits = field(default_factory=PacketLimits)
    # [byte] recordings and packet logs up to this size are decoded while the caller waits, larger ones become jobs
    immediate_trace_bytes: int = 8 * 1024**2
    frames_in_flight: int = 2  # frames of one archive that are decoded at the same time
    progress_every: timedelta = timedelta(seconds=1)  # shortest time between two reports of a job's progress
    idempotency_ttl: timedelta = timedelta(hours=24)


# === The times of a decode: UTC where the upload states when it was taken, else those of its recording.


_EPOCH_S = 1e9
"""[s] times beyond are seconds since 1970: no recording lasts 30 years."""


@dataclass(frozen=True, slots=True)
class DecodeTimes:
    """What the times of a decode count from."""

    clock: Literal["utc", "recording"]  # ``utc``: seconds since 1970-01-01 UTC; ``recording``: of the recording
    zero_s: float = 0.0  # [s] added to times of a trace or of a video's frames
    captured_s: float | None = None  # [s] when the upload was taken, by its context
    alone: bool = False  # the upload is a single frame, which was taken then

    def trace_s(self, t_s: float) -> float:
        """Time of a sample. [s]"""
        return round(t_s + self.zero_s, 4)

    def frame_s(self, frame: JsonObject) -> float | None:
        """Time of a frame, None if it is not known. [s]"""
        if self.clock == "utc":
            return _seconds(frame.get("captured_at")) or (self.captured_s if self.alone else None)
        return frame.get("time_s")


def clock_of(row: DecodeRow) -> DecodeTimes:
    """The clock of a decode that has a result."""
    result, captured_s = row.result or {}, _seconds(row.context.get("captured_at"))
    if row.kind == DecodeKind.TRACE:
        start_s = float((result.get("motion") or {}).get("start_s", 0.0))
        if start_s > _EPOCH_S:
            return DecodeTimes("utc")
        return DecodeTimes("recording") if captured_s is None else DecodeTimes("utc", captured_s - start_s)
    if row.kind == DecodeKind.PACKETS:
        return DecodeTimes("utc")
    frames = result.get("frames", ())
    alone = len(frames) == 1 and row.kind == DecodeKind.FRAME
    stated = any(frame.get("captured_at") for frame in frames) or (alone and captured_s is not None)
    return DecodeTimes("utc" if stated else "recording", captured_s=captured_s, alone=alone)


def stamp(time_s: float | None, clock: DecodeTimes) -> str | None:
    """A time as RFC 3339; None unless it is UTC."""
    if time_s is None or clock.clock != "utc":
        return None
    return datetime.fromtimestamp(time_s, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _seconds(value: str | datetime | None) -> float | None:
    if value is None:
        return None
    return (datetime.fromisoformat(value) if isinstance(value, str) else value).timestamp()
