"""Positions of the vehicle's own receiver, as a decode keeps them for the track of its drive."""

from __future__ import annotations

import numpy as np
from typing_extensions import TypedDict

from app.sensors.pose_track import PoseTrack

EVERY_S = 5.0
"""[s] between two positions that are kept. Source: by hand; positions of one minute share their error."""
MAX_POSITIONS = 20_000
"""Positions of a decode at most; of more, fewer are kept. Source: by hand, 27 hours."""


class ReceiverPositions(TypedDict):
    """Positions of the vehicle's own receiver, at most one in five seconds.

    `time_s` are seconds since 1970-01-01 UTC; `accuracy_m` is the horizontal standard deviation that the receiver
    states, null where it states none.
    """

    time_s: list[float]
    lon_deg: list[float]
    lat_deg: list[float]
    accuracy_m: list[float | None]


def receiver_positions(track: PoseTrack | None) -> ReceiverPositions | None:
    """The first position of each interval of a track; None without a track."""
    if track is None or not len(track.time_s):
        return None
    every_s = max(EVERY_S, float(track.time_s[-1] - track.time_s[0]) / MAX_POSITIONS)
    kept = np.unique(np.floor((track.time_s - track.time_s[0]) / every_s), return_index=True)[1]
    accuracy_m = np.round(track.accuracy_m[kept], 3).tolist()
    return {
        "time_s": np.round(track.time_s[kept], 3).tolist(),
        "lon_deg": np.round(track.lon_deg[kept], 9).tolist(),
        "lat_deg": np.round(track.lat_deg[kept], 9).tolist(),
        "accuracy_m": [value if value == value else None for value in accuracy_m],  # NaN is not itself
    }
