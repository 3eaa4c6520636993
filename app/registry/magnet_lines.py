"""Painted lines of magnets."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any

import sqlalchemy as sa

from app.registry.lines import Line, LinePlace, make_line, widened
from app.registry.spatial import Box, within_box
from app.registry.tables import magnets, markers

_C = markers.c
_PAINTED = (_C.family == "magnet", _C.scheme == "line-tag", _C.status != "retired")
_MAGNET_LINES = 100
"""Number of lines whose magnets are read in one query. Chosen by hand."""


class MagnetLines:
    """The source of painted lines of magnets, in the order of their ids."""

    def begins_line(self, place: LinePlace) -> bool:
        """Any magnet marker may be a line."""
        return True

    def read_lines(
        self,
        connection: sa.Connection,
        agency_id: str,
        *,
        box: Box | None,
        pinned: Mapping[str, Any],
        after: LinePlace | None,
    ) -> Iterator[Line]:
        """Lines in the order of their ids."""
        yield from _lines(connection, agency_id, box, None if after is None else after.id)

    def find_line(self, connection: sa.Connection, agency_id: str, place: LinePlace) -> Line | None:
        """The line of a marker."""
        rows = connection.execute(_magnets_of(agency_id).where(_C.id == place.id)).all()
        return _line_of(rows) if len(rows) >= 2 else None


def _lines(connection: sa.Connection, agency_id: str, box: Box | None, after: str | None) -> Iterator[Line]:
    ids = sa.select(_C.id).where(_C.agency_id == agency_id, *_PAINTED).order_by(_C.id).limit(_MAGNET_LINES)
    if box is not None:
        near = sa.or_(*(within_box(part, magnets) for part in widened(box)))
        ids = ids.where(_C.id.in_(sa.select(magnets.c.marker_id).where(magnets.c.agency_id == agency_id, near)))
    while True:
        chunk = connection.execute(ids if after is None else ids.where(_C.id > after)).scalars().all()
        if not chunk:
            return
        rows = connection.execute(_magnets_of(agency_id).where(_C.id.in_(chunk))).all()
        for _, group in groupby(rows, key=lambda row: row.id):
            if len(line := list(group)) >= 2:
                yield _line_of(line)
        after = chunk[-1]


def _magnets_of(agency_id: str) -> sa.Select[Any]:
    return (
        sa.select(_C.id, _C.digits, _C.road, _C.status, magnets.c.lon_deg, magnets.c.lat_deg)
        .join(magnets, magnets.c.marker_id == _C.id)
        .where(_C.agency_id == agency_id, *_PAINTED)
        .order_by(_C.id, magnets.c.number)
    )


def _line_of(rows: Sequence[Any]) -> Line:
    first = rows[0]
    return make_line(first.id, rows, family="magnet", code=first.digits, side=None, measures=(None, None))
