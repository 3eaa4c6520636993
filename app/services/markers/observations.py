"""What vehicles saw of a marker."""

from __future__ import annotations

from datetime import datetime

from pydantic import JsonValue
from typing_extensions import TypedDict

from app.errors import InvalidParameter
from app.registry import observations as store
from app.registry.database import Database
from app.registry.markers import get_marker
from app.registry.observations import ObservationRow, Place
from app.services.access.access import Caller

_THERE = frozenset({"seen", "ambiguous", "off-line", "wrong-way"})
"""Kinds that say that a marker stands where it should, as far as they go."""


class ObservationDocument(TypedDict):
    """What one decode saw of the marker, in one frame if it was a video."""

    decode_id: str
    frame: int
    at: datetime
    what: str
    detail: dict[str, JsonValue] | None


class ObservationPage(TypedDict):
    """A page of observations, newest first."""

    items: list[ObservationDocument]


class ObservationSummary(TypedDict):
    """How often a marker was seen, and how."""

    marker_id: str
    observations: int
    first_at: datetime | None
    last_at: datetime | None
    last_what: str | None
    last_seen_at: datetime | None
    counts: dict[str, int]


class Observations:
    """Reading observations, one transaction each."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def page(
        self,
        caller: Caller,
        marker_id: str,
        *,
        what: str | None = None,
        since: datetime | None = None,
        until: datetime | None = None,
        before: Place | None = None,
        limit: int = 100,
    ) -> tuple[ObservationPage, str | None]:
        """A page, newest first, and where it ended if there is more.

        Raises
        ------
        NotFound
            There is no such marker, or it belongs to another agency.
        """
        with self._database.read() as connection:
            get_marker(connection, caller.agency_id, marker_id)
            rows = store.list_of_marker(
                connection,
                caller.agency_id,
                marker_id,
                what=what,
                since=since,
                until=until,
                before=before,
                limit=limit + 1,
            )
        page = ObservationPage(
            items=[
                {"decode_id": row.decode_id, "frame": row.frame, "at": row.at, "what": row.what, "detail": row.detail}
                for row in rows[:limit]
            ]
        )
        return page, cursor_of(rows[limit - 1]) if len(rows) > limit else None

    def summary(self, caller: Caller, marker_id: str) -> ObservationSummary:
        """How often a marker was seen and how, first and last.

        Raises
        ------
        NotFound
            There is no such marker, or it belongs to another agency.
        """
        with self._database.read() as connection:
            get_marker(connection, caller.agency_id, marker_id)
            rows = store.summarize(connection, caller.agency_id, marker_id)
            newest = store.list_of_marker(connection, caller.agency_id, marker_id, limit=1)
        there = [row.last for row in rows if row.what in _THERE]
        return {
            "marker_id": marker_id,
            "observations": sum(row.number for row in rows),
            "first_at": min((row.first for row in rows), default=None),
            "last_at": max((row.last for row in rows), default=None),
            "last_what": newest[0].what if newest else None,
            "last_seen_at": max(there, default=None),
            "counts": {row.what: row.number for row in rows},
        }


def cursor_of(row: ObservationRow) -> str:
    """Where an observation stands, as text."""
    return f"{row.at.isoformat()},{row.decode_id},{row.frame}"


def place_of(cursor: str) -> Place:
    """Where a page ended, from its text.

    Raises
    ------
    InvalidParameter
        It is not such a text.
    """
    parts = cursor.split(",")
    try:
        at, decode_id, frame = datetime.fromisoformat(parts[0]), parts[1], int(parts[2])
    except (ValueError, IndexError) as error:
        raise _bad_cursor() from error
    if len(parts) != 3 or at.tzinfo is None or not 0 <= frame < 2**31 or not 1970 < at.year < 9999:
        raise _bad_cursor()
    return Place(at, decode_id[:36], frame)


def _bad_cursor() -> InvalidParameter:
    return InvalidParameter(
        "this is not where a page of observations ended",
        field="before",
        limit="as the link to the next page has it",
        cure="start without before, and follow the links",
    )
