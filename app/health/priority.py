"""Priority of an item of the work list."""

from __future__ import annotations

import math
from collections.abc import Mapping

URGENCY: Mapping[str, float] = {
    "wrong-way-driver": 1.0,
    "wrong-way": 0.9,
    "cloned": 0.9,
    "moved": 0.8,
    "missing": 0.6,
    "unregistered": 0.5,
    "fading": 0.4,
    "loose": 0.7,
    "damaged": 0.6,
    "dirty": 0.4,
    "other": 0.4,
}
"""How much a fault can mislead a vehicle: a marker that shows a wrong place is worse than one that shows none. The last
four, and `missing`, are kinds of damage that people report; a loose marker can also hurt somebody. Source: by hand."""
SAFETY_ROLE, USUAL_ROLE = 1.0, 0.8
"""Of markers whose meaning vehicles act on (stop line, speed limit, bend), and of all others. Source: by hand."""
BUSY_PASSES = 3000.0
"""Passes in a month from which traffic weighs most, a hundred a day. Source: by hand."""


def item_priority(what: str, *, acted_on: bool, ratio: float, limit: float, month_passes: float) -> float:
    """Priority from 0 to 1: urgency x safety role x certainty x traffic.

    Parameters
    ----------
    what : str
        A fault, a reported kind of damage, or ``wrong-way-driver``, which is always first.
    acted_on : bool
        Vehicles act on the marker's meaning.
    ratio, limit : float
        Of the test. [nat]
    month_passes : float
        Passes in a month.

    Notes
    -----
    Certainty rises from 0.8 at the limit to 1 at twice the limit; traffic from 0.7 without passes to 1 at `BUSY_PASSES`
    by the logarithm.
    """
    if what == "wrong-way-driver":
        return 1.0
    role = SAFETY_ROLE if acted_on else USUAL_ROLE
    certainty = 0.8 + 0.2 * min(max(ratio / limit - 1.0, 0.0), 1.0) if limit > 0 else 0.8
    traffic = 0.7 + 0.3 * min(math.log1p(month_passes) / math.log1p(BUSY_PASSES), 1.0)
    return round(URGENCY[what] * role * certainty * traffic, 4)
