"""The audit log: who appends to it, and how an agency reads it."""

from __future__ import annotations

from typing import Any

from app.registry import audit as store
from app.registry.audit import Author, Row
from app.registry.database import Database
from app.services.access import Caller


def author_of(caller: Caller) -> Author:
    """Whom the history names for what a caller does."""
    return Author(caller.label, caller.key_id)


class AuditLog:
    """Reading an agency's chain of changes."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def page(
        self, caller: Caller, *, after: int = 0, limit: int = 100
    ) -> tuple[list[dict[str, Any]], int | None, dict[str, Any] | None]:
        """A page of entries, oldest first; the number to continue after if there are more; and the chain's head."""
        with self._database.read() as connection:
            rows = store.list_entries(connection, caller.agency_id, after=after, limit=limit + 1)
            head = store.find_head(connection, caller.agency_id)
        page = [_entry_document(row) for row in rows[:limit]]
        newest = {"number": head["number"], "hash": head["hash"]} if head is not None else None
        return page, page[-1]["number"] if len(rows) > limit else None, newest


def _entry_document(row: Row) -> dict[str, Any]:
    return {str(name): value for name, value in row.items() if name != "agency_id"}
