"""What vehicles without a connection get of a family's markers (docs/snapshots.md)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import sqlalchemy as sa

from app.registry.marker_rows import MarkerRow


class SnapshotRecord(ABC):
    """A family's part of a snapshot.

    Attributes
    ----------
    with_retired : bool
        Whether retired markers are in snapshots too.
    """

    with_retired: bool = False

    def columns(self) -> tuple[sa.ColumnElement[Any], ...]:
        """What is read of the spec of each marker, with labels; the whole spec without any."""
        return ()

    @abstractmethod
    def kind(self, row: MarkerRow) -> dict[str, Any]:
        """What a marker has in common with others of its kind; plain values."""

    def members(self, connection: sa.Connection, agency_id: str, codes: Sequence[str]) -> Mapping[str, Sequence[Any]]:
        """Further columns of markers with these codes, by the names of `write_snapshot`; None for a missing value."""
        return {}
