"""Places on lanes before codes are assigned, and the distances ahead of events at which they are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from app.formats.alignments.geometry import BoundaryStyle
from app.markers.cerpm import LaneSide
from app.markers.magnet_codebook import Meaning
from app.planning.alignment import Floats, Lane, RoadEvent
from app.planning.plan import Purpose
from app.planning.rules import Ahead

GRAVITY_MPS2 = 9.81  # [m/s2] source: the stopping distance on a grade, AASHTO Green Book (2018), equation 3-3
_APPROACH_M = (
    300.0  # [m] before an event, whose highest design speed counts; source: chosen by hand, above the stopping
)
# distance at 130 km/h


@dataclass(frozen=True, slots=True)
class Site:
    """A place for one marker on a lane.

    Attributes
    ----------
    chainage_m, offset_m : float
        Along the centre line, and from it, left positive; of a tag its first magnet. [m]
    purpose : Purpose
    event : RoadEvent or None
        What it stands ahead of.
    meaning : Meaning or None
        Of a tag.
    side : LaneSide
        Of the boundary or the painted line on which it stands.
    style : BoundaryStyle
        Of the painted line.
    """

    chainage_m: float
    offset_m: float
    purpose: Purpose
    event: RoadEvent | None = None
    meaning: Meaning | None = None
    side: LaneSide = LaneSide.UNKNOWN
    style: BoundaryStyle = BoundaryStyle.UNKNOWN


def distance_ahead_m(lane: Lane, event_m: float, rule: Ahead) -> float:
    """How far ahead of an event a vehicle must know of it. [m]

    Notes
    -----
    Stopping distance: v t + v^2 / (2 g (a / g + G)) with the grade G of the approach, AASHTO Green Book (2018),
    equations 3-2 and 3-3. Reaction distance: v t. The highest design speed of the 300 m before the event counts.
    """
    approach = (lane.chainage_m >= event_m - _APPROACH_M) & (lane.chainage_m <= event_m)
    speed = float(lane.design_speed_mps[approach].max()) if approach.any() else float(lane.design_speed_mps[0])
    if not isinstance(rule.before, str):
        return max(rule.before, rule.min_before_m)
    distance = speed * rule.reaction_s
    if rule.before == "stopping_distance":
        grade = float(lane.grade[approach].mean()) if approach.any() else 0.0
        friction = max(rule.deceleration_mps2 / GRAVITY_MPS2 + grade, 0.05)
        distance += speed**2 / (2 * GRAVITY_MPS2 * friction)
    return max(distance, rule.min_before_m)


def spread_evenly(start_m: float, end_m: float, spacing_m: float) -> Floats:
    """Middles of the fewest equal parts of a stretch that are no longer than the spacing, shape (K,). [m]"""
    count = max(int(np.ceil((end_m - start_m) / spacing_m - 1e-9)), 1)
    return np.asarray(start_m + (np.arange(count) + 0.5) * (end_m - start_m) / count)
