"""``python -m app.tracks``: compile the filter and keep it beside the code, so that no vehicle waits for it."""

from __future__ import annotations

import numpy as np

from app.tracks import Clock, LanePath, PositionFix, Samples, TrackInput
from app.tracks.estimate import estimate_track

_STEP_DEG = 1e-4


def main() -> None:
    """Estimate a short track in which every kernel takes part."""
    time_s = np.arange(0.0, 10.0, 0.1)
    fixes = tuple(
        PositionFix(name, second, 0.0, _STEP_DEG * second, (0.01, 0.0, 0.01), 0.0, 1.0, marker_id=f"{name} {second}")
        for second, name in enumerate(["bar", "camera"] * 5)
    )
    lane = LanePath("lane", np.zeros(12), _STEP_DEG * np.arange(-1.0, 11.0), 0.1)
    speeds = Samples("bar", time_s, np.full(time_s.size, 11.1), 0.1)
    headings = Samples("bar", time_s, np.zeros(time_s.size), 0.5)
    estimate_track(TrackInput((Clock("bar"), Clock("camera")), fixes, (speeds,), (headings,), (lane,)))


if __name__ == "__main__":
    main()
