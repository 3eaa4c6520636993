"""Checks of a plan, each with its figure, limit, source and worst place."""

from app.planning.plan_checks.check import ExistingMarker, check_plan

__all__ = ["ExistingMarker", "check_plan"]
