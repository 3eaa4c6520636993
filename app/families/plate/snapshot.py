"""Plates in the snapshot of an area."""

from __future__ import annotations

from typing import Any

from app.families.snapshot import SnapshotRecord
from app.registry.marker_rows import MarkerRow

_KIND = ("scheme", "check_digits", "n", "unit_mm", "gap_mm", "thickness_mm")


class PlateSnapshot(SnapshotRecord):
    """Code scheme and dimensions of plates."""

    def kind(self, row: MarkerRow) -> dict[str, Any]:
        """Scheme and dimensions."""
        return {name: getattr(row, name) for name in _KIND}
