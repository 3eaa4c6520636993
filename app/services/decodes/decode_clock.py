"""The times of a decode: UTC where the upload states when it was taken, else those of its recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Literal

from app.registry.decodes import DecodeRow
from app.services.decodes.kinds import DecodeKind

_EPOCH_S = 1e9
"""[s] times beyond are seconds since 1970: no recording lasts 30 years."""


@dataclass(frozen=True, slots=True)
class DecodeTimes:
    """What the times of a decode count from.

    Attributes
    ----------
    clock : str
        ``utc``: seconds since 1970-01-01 UTC; ``recording``: of the recording.
    zero_s : float
        Added to times of a trace or of a video's frames. [s]
    captured_s : float or None
        When the upload was taken, by its context. [s]
    alone : bool
        The upload is a single frame, which was taken then.
    """

    clock: Literal["utc", "recording"]
    zero_s: float = 0.0
    captured_s: float | None = None
    alone: bool = False

    def trace_s(self, t_s: float) -> float:
        """Time of a sample. [s]"""
        return round(t_s + self.zero_s, 4)

    def frame_s(self, frame: Mapping[str, Any]) -> float | None:
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
