"""Magnet markers in the snapshot of an area."""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa

from app.families.snapshot import SnapshotRecord
from app.registry.marker_rows import MarkerRow
from app.registry.tables import markers


class MagnetSnapshot(SnapshotRecord):
    """Tag, meaning and the beginning of the lane of magnet markers."""

    def columns(self) -> tuple[sa.ColumnElement[Any], ...]:
        """Where the lane begins, and the meaning."""
        spec = markers.c.spec
        lane_start = spec["lane"]["points_deg"][0]
        return (
            lane_start[0].as_float().label("lane_lon_deg"),
            lane_start[1].as_float().label("lane_lat_deg"),
            spec["meaning"].label("meaning"),
        )

    def kind(self, row: MarkerRow) -> dict[str, Any]:
        """Scheme and meaning."""
        return {"scheme": row.scheme, "meaning": row.spec["meaning"]}
