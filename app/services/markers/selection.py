"""Markers of one family, picked by id or by a filter."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import sqlalchemy as sa

from app.errors import InvalidParameter
from app.registry import markers as store
from app.registry.marker_rows import MarkerRow
from app.registry.markers import MarkerFilter


@dataclass(frozen=True, slots=True)
class Selection:
    """Markers by id, or all that a filter leaves."""

    marker_ids: tuple[str, ...] = ()
    filtered: MarkerFilter = field(default_factory=MarkerFilter)


def select_markers(
    connection: sa.Connection, agency_id: str, selection: Selection, family: str, *, most: int
) -> list[MarkerRow]:
    """The agency's markers of one family in a selection, 1 to `most` of them.

    Raises
    ------
    InvalidParameter
        None or too many, or one is named twice.
    NotFound
        One is missing.
    """
    count = len(selection.marker_ids)
    if count > most:
        raise _too_many(f"{count} {family}s were selected", family, most)
    if len(set(selection.marker_ids)) != count:
        raise InvalidParameter(
            f"a {family} is selected twice", field="marker_ids", limit="each id once", cure="leave repetitions out"
        )
    if selection.marker_ids:
        rows = store.get_markers(connection, agency_id, list(selection.marker_ids))
    else:
        filtered = replace(selection.filtered, family=family)
        rows = store.list_markers(connection, agency_id, filtered, after=None, limit=most + 1)
    found = [row for row in rows if row.family == family]
    if len(found) > most:
        raise _too_many(f"more than {most} {family}s were selected", family, most)
    if not found:
        raise InvalidParameter(
            f"no {family} was selected", field="marker_ids", limit=f"1 to {most} {family}s", cure="widen the filter"
        )
    return found


def _too_many(message: str, family: str, most: int) -> InvalidParameter:
    return InvalidParameter(
        message,
        field="marker_ids",
        limit=f"{most} {family}s at once",
        cure="select by a smaller box, by status, or by fewer ids",
    )
