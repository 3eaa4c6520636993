"""The required quality of an optimised plan against what is predicted for the markers as they were placed."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from app.planning.optimise.cover import window_rows
from app.planning.optimise.models import marker_fixes
from app.planning.outputs.bill import plan_bill
from app.planning.plan import Plan, PlanFinding, PlannedMarker, PlannedPlate, PlannedTag
from app.planning.plan_checks.finding import compare
from app.planning.plan_checks.predictions import SOURCE

_ALMOST_SURE = 1 - 1e-9  # highest probability that counts; source: as app/planning/optimise/plan.py
_ROUNDING = 1e-6  # of probabilities; source: chainages are rounded when markers are placed


def check_quality(plan: Plan) -> Iterator[PlanFinding]:
    """Fixes in every stretch of `fix_every_m`, and the budget."""
    if plan.rules.quality is None or plan.optimum is None:
        return
    required = plan.optimum.quality
    markers = [marker for marker in plan.markers if isinstance(marker.detail, PlannedPlate | PlannedTag)]
    if plan.rules.plates is not None or plan.rules.tags is not None:
        least, error, place = _least_probability(plan, markers, required.fix_every_m, required.fix_error_m)
        sentence = (
            f"predicted probability that a pass fixes its position within {required.fix_error_m:g} m in every "
            f"{required.fix_every_m:g} m, in the worst stretch, which begins near here"
        )
        yield compare(
            "fix-probability", least, ">=", required.fix_probability - _ROUNDING, "probability", SOURCE, sentence, place
        )
        yield compare(
            "fix-error", error, "<=", required.fix_error_m, "m", SOURCE,
            "predicted standard error of the fixes that count", place,
        )  # fmt: skip
    if required.budget is not None:
        currency = plan.rules.costs.currency
        yield compare(
            "budget", plan_bill(plan).total, "<=", required.budget, currency, "quality.budget of the rules",
            f"cost of the plan; a fix every {required.fix_every_m:.1f} m is what the budget buys",
        )  # fmt: skip


def _least_probability(
    plan: Plan, markers: list[PlannedMarker], every_m: float, error_m: float
) -> tuple[float, float, PlannedMarker | None]:
    """Least probability of a fix in any stretch of any lane, greatest error of what counts, and a marker near it."""
    wanted = plan.rules.road.lanes or [lane.name for lane in plan.alignment.lanes]
    least, worst_error, place = math.inf, 0.0, None
    for name in dict.fromkeys(wanted):
        lane = plan.alignment.lane(name)
        own = sorted((marker for marker in markers if marker.lane == name), key=lambda marker: marker.chainage_m)
        probability, error = marker_fixes(plan.rules, lane, own)
        counts = error <= error_m
        gain = np.where(counts, -np.log1p(-np.clip(probability, 0.0, _ALMOST_SURE)), 0.0)
        worst_error = max(worst_error, float(error[counts].max(initial=0.0)))
        at = np.array([marker.chainage_m for marker in own])
        first, last = window_rows(at, every_m, lane.length_m)
        total = np.concatenate([[0.0], np.cumsum(gain)])
        found = total[last] - total[first]
        k = int(found.argmin())
        chance = -math.expm1(-float(found[k]))
        if chance < least:
            least = chance
            place = own[max(int(first[k]) - 1, 0)] if own else None
    return least, worst_error, place
