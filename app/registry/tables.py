"""All tables: each is declared beside its queries; migrations/ creates what is declared, and a test compares."""

from __future__ import annotations

from app.registry import (
    agencies,
    audit,
    decodes,
    health,
    jobs,
    marker_rows,
    markers,
    plan_features,
    plan_states,
    plans,
    public_pages,
    reprocessings,
    roads,
    uploads,
    vehicles,
    webhooks,
)
from app.registry.column_types import metadata

DECLARED_IN = (
    agencies, audit, decodes, health, jobs, marker_rows, markers, plan_features, plan_states, plans, public_pages,
    reprocessings, roads, uploads, vehicles, webhooks,
)  # fmt: skip
"""Modules that declare tables; with all of them imported, `metadata` is complete."""
__all__ = ["DECLARED_IN", "metadata"]
