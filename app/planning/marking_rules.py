"""Marking cycles per country and edition, as data with citations: app/planning/data/marking_rules.json."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources

from app.errors import InvalidParameter


@dataclass(frozen=True, slots=True)
class MarkingRules:
    """The cycle N of the markings of a country in an edition of its manual.

    Attributes
    ----------
    key, title, country, edition : str
    cycle_m : float
        Distance from the start of a line segment to the next one, or between studs. [m]
    straight_cycles, curve_cycles : float
        Spacing of raised markers that guide, in cycles.
    """

    key: str
    title: str
    country: str
    edition: str
    cycle_m: float
    straight_cycles: float
    curve_cycles: float


@lru_cache(maxsize=1)
def list_marking_rules() -> dict[str, MarkingRules]:
    """All rules by key."""
    document = json.loads((resources.files("app.planning") / "data" / "marking_rules.json").read_text("utf-8"))
    found = {}
    for key, rule in document["rules"].items():
        cycles = rule["positioning_guide_cycles"]
        found[key] = MarkingRules(
            key, rule["title"], rule["country"], rule["edition"], rule["cycle_m"], cycles["straight"], cycles["curve"]
        )
    return found


def marking_rules(key: str) -> MarkingRules:
    """Rules by their key.

    Raises
    ------
    InvalidParameter
        There are none with this key.
    """
    found = list_marking_rules().get(key)
    if found is None:
        known = ", ".join(list_marking_rules())
        raise InvalidParameter(
            f"there are no marking rules {key[:40]!r}",
            field="cerpm.marking_rules",
            limit=known,
            cure="choose one of these, and give n_m if the agency has another cycle",
        )
    return found
