"""Checks of a plan, each with its figure, limit, source and worst place."""

from app.planning.plan_checks.check import check_plan
from app.planning.plan_checks.conflicts import ExistingMarker

__all__ = ["ExistingMarker", "check_plan"]
