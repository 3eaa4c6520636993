"""Limits that a deployment can set for markers, and the states that their rules ask about."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import timedelta
from typing import Any

from app.registry.marker_rows import MarkerRow

PLANNED = "planned"
RETIRED = "retired"


@dataclass(frozen=True, slots=True)
class MarkerRules:
    """Limits that a deployment can set."""

    explicit_code_radius_m: float = 20_000.0
    position_code_radius_m: float = 1_000.0
    crs_accuracy_m: float = 0.1
    idempotency_ttl: timedelta = timedelta(hours=24)


def is_placed_anew(row: MarkerRow, values: dict[str, Any]) -> bool:
    """Whether a change gives a position, or puts a retired marker back into use."""
    return "lon_deg" in values or (row.status == RETIRED and values.get("status", RETIRED) != RETIRED)
