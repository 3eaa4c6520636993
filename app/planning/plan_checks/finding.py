"""Findings at the place where they are worst."""

from __future__ import annotations

from typing import Literal

from app.markers.checks import Verdict
from app.planning.plan import PlanFinding, PlannedMarker


def compare(
    name: str,
    figure: float,
    relation: Literal["<=", ">="],
    limit: float,
    unit: str,
    source: str,
    sentence: str,
    at: PlannedMarker | None = None,
    *,
    missed: Verdict = Verdict.FAIL,
) -> PlanFinding:
    """A finding that is OK where the figure keeps the limit, else `missed`; `at` is the marker where it is worst."""
    slack = 1e-9 * max(abs(limit), 1.0)
    met = figure <= limit + slack if relation == "<=" else figure >= limit - slack
    verdict = Verdict.OK if met else missed
    if at is None:
        return PlanFinding(name, figure, relation, limit, unit, source, verdict, sentence)
    return PlanFinding(
        name, figure, relation, limit, unit, source, verdict, sentence, at.lane, at.station_m, at.lon_deg, at.lat_deg
    )
