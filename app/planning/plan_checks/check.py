"""All checks of a plan."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from app.geodesy import LocalizationGrade
from app.markers.checks import Verdict
from app.planning.plan import Plan, PlanFinding
from app.planning.plan_checks.cerpms import check_cerpms, radio_settings
from app.planning.plan_checks.conflicts import ExistingMarker, check_conflicts
from app.planning.plan_checks.finding import compare
from app.planning.plan_checks.magnets import check_magnets
from app.planning.plan_checks.plates import check_plates
from app.planning.plan_checks.predictions import check_predictions
from app.planning.plan_checks.quality import check_quality


def check_plan(plan: Plan, existing: Sequence[ExistingMarker] = ()) -> Plan:
    """The plan with the findings of all checks that apply to it, and the radio settings of its CERPMs.

    Parameters
    ----------
    plan : Plan
    existing : sequence of ExistingMarker
        Markers of the registry near the road.
    """
    plan = replace(plan, radio=radio_settings(plan))
    return replace(plan, findings=tuple(_findings(plan, existing)))


def _findings(plan: Plan, existing: Sequence[ExistingMarker]) -> Iterator[PlanFinding]:
    yield from _places(plan)
    yield from check_plates(plan)
    yield from check_magnets(plan)
    yield from check_cerpms(plan)
    yield from check_predictions(plan)
    yield from check_quality(plan)
    yield from check_conflicts(plan, existing)


def _places(plan: Plan) -> Iterator[PlanFinding]:
    missing = [left for left in plan.left_out if left.moved_m is None]
    yield compare(
        "placed", len(missing), "<=", 0, "places", "the rules of the plan",
        "places that the rules ask for and that have no marker" + (f"; first: {missing[0].reason}" if missing else ""),
        missed=Verdict.WARN,
    )  # fmt: skip
    unfit = plan.alignment.grade is LocalizationGrade.UNFIT
    yield compare(
        "positions", float(unfit), "<=", 0, "roads", "docs/decisions/0003-positions.md",
        "the road is placed by an origin or without a stated accuracy: survey the markers before they localize"
        if unfit
        else "the road's reference system has a stated accuracy",
        missed=Verdict.WARN,
    )  # fmt: skip
