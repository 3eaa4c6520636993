"""CERPMs in the snapshot of an area."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import sqlalchemy as sa

from app.families.snapshot import SnapshotRecord
from app.registry import cerpms
from app.registry.marker_rows import MarkerRow
from app.registry.tables import markers

_HEARD = ("first_sequence", "last_sequence", "first_heard_s", "last_heard_s")


class CerpmSnapshot(SnapshotRecord):
    """Side, speed limit and interval of CERPMs, and which transmissions were heard.

    Retired ones are included: whoever has their keys can still send.
    """

    with_retired = True

    def columns(self) -> tuple[sa.ColumnElement[Any], ...]:
        """Side, speed limit and interval."""
        spec = markers.c.spec
        radio = spec["radio"]
        return (
            spec["side"].as_string().label("side"),
            spec["speed_limit"].label("speed_limit"),
            radio["interval_s"].as_float().label("interval_s"),
            radio["jitter_share"].as_float().label("jitter_share"),
        )

    def kind(self, row: MarkerRow) -> dict[str, Any]:
        """Side, speed limit and the shortest interval between two transmissions."""
        spec = row.spec
        min_interval_s = spec["interval_s"] * (1 - spec["jitter_share"])
        return {"side": spec["side"], "speed_limit": spec["speed_limit"], "min_interval_s": min_interval_s}

    def members(self, connection: sa.Connection, agency_id: str, codes: Sequence[str]) -> Mapping[str, Sequence[Any]]:
        """First and last transmission that was heard of each."""
        heard = cerpms.list_span_ends(connection, agency_id, map(int, codes))
        ends = [heard.get(int(code)) for code in codes]
        return {name: [None if end is None else getattr(end, name) for end in ends] for name in _HEARD}
