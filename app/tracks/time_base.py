"""The times of a drive: nodes on one clock over the data of all sensors, and what cannot be one drive."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from app.errors import InvalidParameter
from app.tracks.types import CLOCKS, Clock, Floats, TrackInput

STEP_S = 0.1
"""Time between nodes. [s] Source: by hand; a car turns by less than 3 deg and brakes by less than 1 m/s in it."""
MAX_NUMBERS = 36_500_000
"""Numbers in the covariances of all nodes at most, 0.3 GB. Source: `python -m benchmarks.track --hours 10`, which stays
below the memory and the time of a decoder process: 89 s and 1.2 GB, the simulation with it, for 34,500,000."""
MAX_PAUSE_S = 600.0
"""Longest time without any data that a track leads across. [s] Source: by hand; a constant speed is no forecast for
ten minutes, but a wait at a ferry is one drive."""
_NEAR_S = 1.0  # [s] a node has a speed or a heading if a sample is so near; source: app/formats/traces/series.py


@dataclass(frozen=True, slots=True, eq=False)
class TimeBase:
    """Nodes on the reference clock: time of the first [s], step [s], and their number."""

    start_s: float
    step_s: float
    count: int

    @property
    def time_s(self) -> Floats:
        """Of the nodes. [s]"""
        return np.asarray(self.start_s + self.step_s * np.arange(self.count), dtype=np.float64)

    def nearest(self, time_s: Floats) -> tuple[np.ndarray, Floats]:
        """The nearest nodes, and how long after them the times are. [s]"""
        node = np.clip(np.rint((time_s - self.start_s) / self.step_s), 0, self.count - 1).astype(np.int64)
        return node, time_s - (self.start_s + self.step_s * node)


def check_times(given: TrackInput) -> None:
    """Refuse what has no track, without estimating one.

    Raises
    ------
    InvalidParameter
        The drive is too long for the number of its clocks, sensors do not overlap in time, or a clock is not declared.
    """
    time_base(given, checked_clocks(given))


def checked_clocks(given: TrackInput) -> dict[str, Clock]:
    """The clocks of a drive by name; refuses names that appear twice or are not declared."""
    clocks = {clock.name: clock for clock in given.clocks}
    if len(clocks) != len(given.clocks):
        raise InvalidParameter("two clocks have the same name", field="clocks", limit="each name once")
    samples = (*given.speeds, *given.headings)
    used = [*(fix.clock for fix in given.fixes), *(series.clock for series in samples)]
    missing = next((name for name in used if name not in clocks), None)
    if missing is not None:
        raise InvalidParameter(f"the clock {missing} is not declared", field="clocks", limit="all that are used")
    return clocks


def time_base(given: TrackInput, clocks: dict[str, Clock]) -> tuple[TimeBase, list[tuple[float, float]]]:
    """Nodes over all data, and the pauses in which no sensor recorded.

    Raises
    ------
    InvalidParameter
        There are no times, or sensors do not overlap and are too far apart.
    """
    spans: list[tuple[float, float, str]] = []
    for series in (*given.speeds, *given.headings):
        if series.time_s.size:
            offset = clocks[series.clock].offset_s
            breaks = np.flatnonzero(np.diff(series.time_s) > _NEAR_S)
            edges = np.r_[-1, breaks, series.time_s.size - 1]
            for a, b in pairwise(edges.tolist()):
                spans.append((series.time_s[a + 1] + offset, series.time_s[b] + offset, series.clock))
    spans += [(fix.time_s + clocks[fix.clock].offset_s,) * 2 + (fix.clock,) for fix in given.fixes]
    if not spans:
        raise InvalidParameter(
            "no upload has a position, a speed or a heading with a time",
            field="decodes",
            limit="one or more fixes of registered markers with a time",
            cure="send captured_at with each upload, and decode markers that are registered",
        )
    spans.sort()
    pauses, end, last = [], spans[0][1], spans[0][2]
    for first, to, clock in spans:
        if first - end > MAX_PAUSE_S:
            raise InvalidParameter(
                f"the sensors do not overlap in time: {last} ends {first - end:.0f} s before {clock} begins",
                field="decodes",
                limit=f"at most {MAX_PAUSE_S:g} s without data",
                cure="check captured_at of both; declare offset_s of a clock that was set wrong, or make two drives",
            )
        if first > end + _NEAR_S:
            pauses.append((end, first))
        if to >= end:
            end, last = to, clock
    margin = 1.0 + 3.0 * max((clock.sigma_s for clock in clocks.values()), default=0.0)
    start, duration = spans[0][0] - margin, end - spans[0][0] + 2 * margin
    base = TimeBase(float(start), STEP_S, math.ceil(duration / STEP_S) + 1)
    _check_size(base, len(clocks))
    return base, pauses


def _check_size(base: TimeBase, clocks: int) -> None:
    """Refuse a drive that is too long for the number of its clocks."""
    unknown = max(clocks - 1, 0)
    most = MAX_NUMBERS / (CLOCKS + unknown) ** 2
    if base.count > most:
        raise InvalidParameter(
            f"the drive takes {base.count * STEP_S / 3600:.1f} h, and offsets of {unknown} clocks are to be estimated",
            field="decodes",
            limit=f"{most * STEP_S / 3600:.1f} h with so many clocks",
            cure="make several drives of it, or give decodes of one sensor the same clock",
        )
