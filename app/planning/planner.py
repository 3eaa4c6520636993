"""A road and rules to a plan: placed, optimised where the rules require a quality, and checked."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from app.markers.magnet_design import Codebook
from app.planning.alignment import Alignment
from app.planning.optimise.plan import optimise_by_prediction
from app.planning.placement import place_plan
from app.planning.placement.place import NumberSource
from app.planning.plan import Optimum, Plan
from app.planning.plan_checks import ExistingMarker, check_plan
from app.planning.rules import PlanRules


def make_plan(
    alignment: Alignment,
    rules: PlanRules,
    *,
    name: str,
    codebook: Codebook | None = None,
    numbers: NumberSource | None = None,
    existing: Sequence[ExistingMarker] = (),
    report: Callable[[str], None] = lambda step: None,
) -> Plan:
    """Place and check the markers of a plan; the cheapest ones where the rules have a `quality`.

    Parameters
    ----------
    alignment, rules, name, codebook, numbers
        As `place_plan`.
    existing : sequence of ExistingMarker
        As `check_plan`.
    report : callable
        Called with the name of each step, for people.

    Raises
    ------
    InvalidParameter
        As `place_plan` and `optimise_by_prediction`.
    """
    optimum, chosen = None, None
    if rules.quality is not None:
        report("Finding the cheapest places")
        found = optimise_by_prediction(alignment, rules)
        chosen = found.places
        optimum = Optimum(found.quality, found.cost, found.bound, found.table)
    report("Placing the markers")
    placed = place_plan(alignment, rules, name=name, codebook=codebook, numbers=numbers, chosen=chosen)
    report(f"Checking {len(placed.markers)} markers")
    return check_plan(replace(placed, optimum=optimum), existing)
