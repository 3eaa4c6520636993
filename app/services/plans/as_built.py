"""A committed plan beside what was built: residuals, what is out of tolerance, and what that does to the checks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from app.markers.reading import Verdict
from app.planning.plan import Plan, PlanFinding, SurveyedPlace, plan_as_built, residual_of
from app.planning.plan_checks import ExistingMarker, check_plan
from app.registry.plans import BuiltRow
from app.services.plans.documents import AsBuiltDocument, BuiltMarker, CheckComparison

MAX_LISTED = 1000
"""Markers that the comparison lists; all are counted."""
SURVEYED = ("surveyed", "active", "suspect")
"""Statuses of markers that were surveyed."""


def compare_as_built(plan: Plan, built: Sequence[BuiltRow], existing: Sequence[ExistingMarker] = ()) -> AsBuiltDocument:
    """Residuals of the surveyed markers, which of them are out of tolerance, and the checks with them in place.

    Parameters
    ----------
    built : sequence of BuiltRow
        The markers that the plan became.
    existing : sequence of ExistingMarker
        Other markers of the registry near the road.
    """
    planned = {marker.number: marker for marker in plan.markers}
    tolerances = plan.rules.tolerances
    surveyed = {
        row.number: SurveyedPlace(row.lon_deg, row.lat_deg, row.heading_deg) for row in built if row.status in SURVEYED
    }
    markers: list[BuiltMarker] = []
    for row in built:
        if row.number not in surveyed:
            continue
        along, across, turned = residual_of(planned[row.number], surveyed[row.number])
        within = (
            abs(along) <= tolerances.along_m
            and abs(across) <= tolerances.across_m
            and (turned is None or abs(turned) <= tolerances.heading_deg)
        )
        markers.append(
            BuiltMarker(
                number=row.number, marker_id=row.marker_id, status=row.status, along_m=along, across_m=across,
                heading_deg=turned, in_tolerance=within,
            )
        )  # fmt: skip
    markers.sort(key=lambda found: (found["in_tolerance"], -max(abs(found["along_m"]), abs(found["across_m"]))))
    return {
        "surveyed": len(surveyed),
        "not_surveyed": len(built) - len(surveyed),
        "out_of_tolerance": sum(not found["in_tolerance"] for found in markers),
        "tolerances": tolerances.model_dump(),
        "rms_along_m": _rms([found["along_m"] for found in markers]),
        "rms_across_m": _rms([found["across_m"] for found in markers]),
        "markers": markers[:MAX_LISTED],
        "checks": _compare_checks(plan, check_plan(plan_as_built(plan, surveyed), existing)) if surveyed else [],
    }


def _compare_checks(plan: Plan, built: Plan) -> list[CheckComparison]:
    """Each check of either plan, by its name, in the order of the plan as it was built."""
    before = {finding.name: finding for finding in plan.findings}
    after = {finding.name: finding for finding in built.findings}
    names = list(dict.fromkeys([*after, *before]))
    return [
        CheckComparison(
            name=name,
            planned=before.get(name),
            built=after.get(name),
            verdict_changed=_verdict(before.get(name)) != _verdict(after.get(name)),
        )
        for name in names
    ]


def _verdict(finding: PlanFinding | None) -> Verdict:
    """A check that does not apply found nothing."""
    return Verdict.OK if finding is None else finding.verdict


def _rms(values: Sequence[float]) -> float | None:
    return float(np.sqrt(np.mean(np.square(values)))) if values else None
