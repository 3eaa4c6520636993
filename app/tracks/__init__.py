"""One drive, one track: what several sensors know of a drive, fused on one time base.

The values are in `types`, `estimate` leads through the steps: the clocks of sensors that know their speed are aligned
(`time_base`), the largest set of fixes that agree starts the filter (`start`), the error-state Kalman filter and its
smoother run to and fro along the drive (`kernel`), and after each round fixes are gated by their distance to the track
that the others give. Positions of the vehicle's own receiver come last (`measure`).
"""

from app.tracks.types import (
    Clock,
    ClockOffset,
    ClockState,
    DriveMarker,
    FixResult,
    LanePath,
    LeftOutReason,
    PositionFix,
    ReceiverResult,
    Samples,
    Track,
    TrackGap,
    TrackInput,
    TrackRules,
)

__all__ = [
    "Clock",
    "ClockOffset",
    "ClockState",
    "DriveMarker",
    "FixResult",
    "LanePath",
    "LeftOutReason",
    "PositionFix",
    "ReceiverResult",
    "Samples",
    "Track",
    "TrackGap",
    "TrackInput",
    "TrackRules",
]
