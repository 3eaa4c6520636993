"""Events of an agency as its clients read them."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from typing import Annotated, Any, cast

from pydantic import Field
from typing_extensions import TypedDict

from app.registry import events as store
from app.registry.database import Database
from app.registry.tenancy import across_agencies
from app.services.access.access import Caller
from app.services.progress.kinds import visible_kinds


class EventDocument(TypedDict):
    """Something that happened."""

    id: int
    kind: Annotated[str, Field(description="For example job.done.")]
    subject_id: str | None
    at: datetime
    detail: dict[str, Any] | None


class EventPage(TypedDict):
    """A page of events, oldest first; the Link header leads to the next one."""

    items: list[EventDocument]


class AgencyEvents:
    """Use cases on events."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def newest(self, caller: Caller) -> int:
        """Id of the newest event; 0 if there is none."""
        with self._database.read() as connection:
            return store.newest_event(connection, caller.agency_id)

    def list(self, caller: Caller, after: int, limit: int = 100) -> list[EventDocument]:
        """Events after one, oldest first; of jobs those that the caller may read. A vehicle sees nothing else."""
        kinds = visible_kinds(caller)
        with self._database.read() as connection:
            rows = store.list_events(
                connection, caller.agency_id,
                after=after, job_kinds=kinds, holder_id=caller.own_key_id, limit=limit,
            )  # fmt: skip
        return [cast("EventDocument", row._asdict()) for row in rows]

    def newest_of(self, agency_ids: Sequence[str]) -> dict[str, int]:
        """Ids of the newest events of several agencies, for streams whose callers were checked before."""
        with across_agencies(), self._database.read() as connection:
            return store.newest_events(connection, agency_ids)
