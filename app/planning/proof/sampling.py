"""Which markers and stretches a drive passes over, where a road has more than the terms allow.

Strata are a lane's markers of one purpose at a similar speed, in bends and outside of them, and on changes of grade.
Each stratum gets a share of the sample in proportion to its size and at least one; within a stratum every k-th marker
along the road is taken from a random start. Over several drives the sample moves, so that weak markers are found.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from app.planning.alignment import Lane
from app.planning.plan import PlannedMarker

_SPEED_STEP_MPS = 5.0  # [m/s] of the strata; source: chosen by hand, 18 km/h
_BEND_1PM = 1 / 400.0  # [1/m] source: the default of `road.curve_radius_m`
_CREST_1PM = 1 / 1000.0  # [1/m] change of grade; source: chosen by hand, sharper than any crest at 60 km/h


def stratum_of(marker: PlannedMarker, lane: Lane) -> tuple[int, bool, bool, str]:
    """What makes markers alike: speed, bend, crest or sag, purpose."""
    at = marker.chainage_m
    speed = float(lane.value_at(lane.design_speed_mps, at))
    bend = abs(float(lane.value_at(lane.curvature_per_m, at))) > _BEND_1PM
    before = max(at - 10.0, 0.0)
    change = float(lane.value_at(lane.grade, at) - lane.value_at(lane.grade, before)) / 10.0
    return int(speed / _SPEED_STEP_MPS), bend, abs(change) > _CREST_1PM, str(marker.purpose)


def sample_markers(
    markers: Sequence[PlannedMarker], lanes: dict[str, Lane], most: int, rng: np.random.Generator
) -> list[tuple[PlannedMarker, float]]:
    """Markers with their weights, at most about `most` of them; all of them if there are no more than that."""
    if len(markers) <= most:
        return [(marker, 1.0) for marker in markers]
    strata: dict[tuple[int, bool, bool, str], list[PlannedMarker]] = defaultdict(list)
    for marker in markers:
        strata[stratum_of(marker, lanes[marker.lane])].append(marker)
    chosen = []
    for key in sorted(strata):
        members = strata[key]
        count = min(max(round(most * len(members) / len(markers)), 1), len(members))
        chosen += [(members[k], len(members) / count) for k in spread(len(members), count, rng)]
    return sorted(chosen, key=lambda one: one[0].number)


def spread(size: int, count: int, rng: np.random.Generator) -> list[int]:
    """Indices of a systematic sample: every (size / count)-th from a random start."""
    start = float(rng.random())
    return [int((k + start) * size / count) for k in range(count)]


def cut_stretches(length_m: float, longest_m: float) -> list[tuple[float, float]]:
    """A lane as equal stretches of at most a length. [m]"""
    count = max(int(np.ceil(length_m / longest_m - 1e-9)), 1)
    borders = np.linspace(0.0, length_m, count + 1)
    return [(float(a), float(b)) for a, b in pairwise(borders)]
