"""``python -m app.jobs.compile_kernels``: compile what decodes plates, traces and packets, and estimates tracks.

Numba keeps the result beside the code, or in NUMBA_CACHE_DIR, for processors like this one.
"""

from __future__ import annotations

import multiprocessing
from concurrent.futures import ProcessPoolExecutor

import numpy as np

from app.decoders.plate.reader import decode_plates
from app.jobs.decoder_process import warm_frame
from app.jobs.trace_tasks import compile_traces
from app.lanes.banded_matrix import factor, inverse_band
from app.lanes.boundary_sides import assign_sides
from app.services.decodes.trace_task import CompileTracesTask
from app.tracks import Clock, LanePath, PositionFix, Samples, TrackInput
from app.tracks.estimate import estimate_track

_STEP_DEG = 1e-4
_STATIONS_M = np.arange(0.0, 40.0, 10.0)


def main() -> None:
    """Run everything once, so that every kernel takes part: plates in one process, the rest in another."""
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
        for done in [pool.submit(_read_plate), pool.submit(_read_trace_and_track)]:
            done.result()


def _read_plate() -> None:
    decode_plates(warm_frame())


def _read_trace_and_track() -> None:
    """Decode a trace, find sides of a lane and its standard deviations, and estimate a track."""
    compile_traces(CompileTracesTask(), None)
    inverse_band(factor(np.array([[2.0] * 4, [1.0] * 4])))
    assign_sides(_STATIONS_M, np.resize((1.7, -1.7), 4), np.zeros(4, np.int64), wander=0.1, near_track=False)
    estimate_track(_short_track())


def _short_track() -> TrackInput:
    time_s = np.arange(0.0, 10.0, 0.1)
    fixes = tuple(
        PositionFix(name, second, 0.0, _STEP_DEG * second, (0.01, 0.0, 0.01), 0.0, 1.0, marker_id=f"{name} {second}")
        for second, name in enumerate(["bar", "camera"] * 5)
    )
    lane = LanePath("lane", np.zeros(12), _STEP_DEG * np.arange(-1.0, 11.0), 0.1)
    speeds = Samples("bar", time_s, np.full(time_s.size, 11.1), 0.1)
    headings = Samples("bar", time_s, np.zeros(time_s.size), 0.5)
    return TrackInput((Clock("bar"), Clock("camera")), fixes, (speeds,), (headings,), (lane,))


if __name__ == "__main__":
    main()
