"""Even distances along a lane."""

from __future__ import annotations

import math

import numpy as np

from app.planning.alignment import Floats, Lane
from app.planning.rules import Quality


def replace_every(quality: Quality, fix_every_m: float) -> Quality:
    """The quality with another distance between fixes. [m]"""
    return quality.model_copy(update={"fix_every_m": fix_every_m})


def middles(lane: Lane, step_m: float) -> Floats:
    """Middles of equal parts of a lane of at most a step. [m]"""
    return even_places(lane, max(math.ceil(lane.length_m / step_m - 1e-9), 1))


def even_places(lane: Lane, count: int) -> Floats:
    """Middles of so many equal parts of a lane, shape (count,). [m]"""
    return np.asarray((np.arange(count) + 0.5) * lane.length_m / max(count, 1))
