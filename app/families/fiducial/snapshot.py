"""Fiducial signs in the snapshot of an area."""

from __future__ import annotations

from typing import Any

from app.families.snapshot import SnapshotRecord
from app.registry.marker_rows import MarkerRow


class FiducialSnapshot(SnapshotRecord):
    """Dictionary, dimensions and mounting of signs; `app.decoders.fiducial.offline` reads them on board."""

    def kind(self, row: MarkerRow) -> dict[str, Any]:
        """Dictionary, dimensions and mounting."""
        return {"scheme": row.scheme, **row.spec}
