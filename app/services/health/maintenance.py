"""The work list: reading it, and deciding on its items. A person approves every change of a marker's status."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from datetime import datetime

import orjson
import sqlalchemy as sa

from app.errors import Conflict
from app.families.documents import MarkerDocument
from app.formats.spreadsheet import TableWriter
from app.health import MarkerState
from app.health.rules import RULES, TESTED
from app.registry import audit, maintenance
from app.registry import health as store
from app.registry.database import Database
from app.registry.maintenance import ITEM_FIELDS, ItemFilter, ItemRow
from app.registry.markers import get_marker
from app.services.access.access import Caller
from app.services.access.audit import author_of
from app.services.health.documents import (
    HealthDocument,
    MaintenanceItem,
    MaintenancePage,
    Outcome,
    health_document,
    item_document,
)
from app.services.health.items import decided_event, fault_of
from app.services.markers.markers import MarkerChange, Markers
from app.services.ports import Clock

_STATUS_OF: dict[str, str] = {"suspect": "suspect", "retired": "retired", "resurvey": "suspect"}
CSV_COLUMNS = ("id", *(field.name for field in ITEM_FIELDS), "lon_deg", "lat_deg", "note")


class Maintenance:
    """Use cases on the work list, one transaction each.

    Parameters
    ----------
    database : Database
    clock : Clock
    markers : Markers
        Changes the status of a marker, with its history and the audit log.
    """

    def __init__(self, database: Database, clock: Clock, markers: Markers) -> None:
        self._database, self._clock, self._markers = database, clock, markers

    def page(
        self, caller: Caller, filtered: ItemFilter, *, after: tuple[float, str] | None, limit: int
    ) -> tuple[MaintenancePage, str | None]:
        """A page, the most urgent item first, and where it ended if there is more."""
        with self._database.read() as connection:
            rows = maintenance.list_items(connection, caller.agency_id, filtered, after=after, limit=limit + 1)
        last = rows[limit - 1] if len(rows) > limit else None
        items = [item_document(row) for row in rows[:limit]]
        return {"items": items}, None if last is None else f"{last.priority},{last.id}"

    def get(self, caller: Caller, item_id: str) -> MaintenanceItem:
        """One item."""
        with self._database.read() as connection:
            return item_document(maintenance.get_item(connection, caller.agency_id, item_id))

    def stream(self, caller: Caller, form: str, filtered: ItemFilter) -> Iterator[bytes]:
        """All items of a filter as GeoJSON or CSV, the most urgent first."""
        with self._database.read() as connection:
            rows = maintenance.iterate_items(connection, caller.agency_id, filtered)
            yield from _csv_lines(rows) if form == "csv" else _geojson_parts(rows)

    def health(self, caller: Caller, marker_id: str) -> HealthDocument:
        """The tests of a marker.

        Raises
        ------
        NotFound
            There is no such marker, or it belongs to another agency.
        """
        with self._database.read() as connection:
            get_marker(connection, caller.agency_id, marker_id)
            row = store.find_marker_health(connection, caller.agency_id, marker_id)
        month_passes = 0.0 if row is None else MarkerState.from_document(row.state).month_passes
        limits = {fault: RULES.upper(fault, month_passes) for fault in TESTED}
        return health_document(marker_id, row, limits)

    def approve(
        self, caller: Caller, item_id: str, outcome: Outcome, note: str | None, version: int | None
    ) -> MaintenanceItem:
        """Accept a suspicion, and change the marker as chosen.

        Parameters
        ----------
        outcome : str
            ``suspect`` or ``retired`` is the marker's new status; ``resurvey`` makes it suspect until it is surveyed
            again; ``none`` leaves it.
        version : int or None
            The marker's version that the decision is based on; None for any.

        Raises
        ------
        Conflict
            The item was decided before, or it has no marker that could be changed.
        StaleVersion
            The marker was changed since the caller read it.
        """
        now, status = self._clock(), _STATUS_OF.get(outcome)
        with self._database.read() as connection:
            found = maintenance.get_item(connection, caller.agency_id, item_id)
        change: Callable[[sa.Connection], MarkerDocument] | None = None
        if status is not None:
            if found.marker_id is None:
                raise Conflict(
                    f"a finding of kind {found.what} has no registered marker",
                    field="outcome",
                    limit="none",
                    cure="approve it with the outcome none, and register the marker if it is yours",
                )
            reason = f"{'resurvey wanted' if outcome == 'resurvey' else 'maintenance'}: {found.what}"
            values = MarkerChange({"status": status}, reason=f"{reason}; {note}"[:500] if note else reason)
            change = self._markers.prepare_change(caller, found.marker_id, values, version, now)
        with self._database.write() as connection:
            row = _open_item(connection, caller, item_id)
            if change is not None:
                change(connection)
            return self._decide(connection, caller, row, "approved", outcome, note, now)

    def dismiss(self, caller: Caller, item_id: str, note: str) -> MaintenanceItem:
        """Reject a suspicion with a reason: its test starts anew, and the item stays in the list of those decided.

        Raises
        ------
        Conflict
            The item was decided before.
        """
        now = self._clock()
        with self._database.write() as connection:
            row = _open_item(connection, caller, item_id)
            return self._decide(connection, caller, row, "dismissed", None, note, now)

    def _decide(
        self, connection: sa.Connection, caller: Caller, row: ItemRow, state: str, outcome: Outcome | None,
        note: str | None, now: datetime,
    ) -> MaintenanceItem:  # fmt: skip
        author = author_of(caller)
        decided = maintenance.change_item(
            connection, caller.agency_id, row,
            {
                "state": state, "outcome": outcome, "note": note, "decided_by": author.who, "decided_at": now,
                "version": row.version + 1, "updated_at": now,
            },
        )  # fmt: skip
        _reset_test(connection, caller.agency_id, row, now)
        detail = {"what": row.what, "marker_id": row.marker_id, "outcome": outcome, "note": note}
        audit.record(
            connection, caller.agency_id, author, f"maintenance.{state}", now=now, subject=row.id, detail=detail
        )
        decided_event(connection, caller.agency_id, decided, now)
        return item_document(decided)


def _open_item(connection: sa.Connection, caller: Caller, item_id: str) -> ItemRow:
    row = maintenance.get_item(connection, caller.agency_id, item_id)
    if row.state != "open":
        raise Conflict(
            f"the item was {row.state} before", field="item_id", limit="open items", cure="read it: GET it by its id"
        )
    return row


def _reset_test(connection: sa.Connection, agency_id: str, row: ItemRow, now: datetime) -> None:
    """Forget the evidence of the fault that was decided: new evidence of several vehicles may raise it again."""
    fault = fault_of(row)
    stored = store.find_health(connection, agency_id, [row.subject]).get(row.subject)
    if fault is None or stored is None:
        return
    state = MarkerState.from_document(stored.state)
    state.reset(fault)
    document = state.document()
    changed = stored._replace(state=document, ratios=document["ratios"], updated_at=now)
    store.store_health(connection, agency_id, [changed])


def _geojson_parts(rows: Iterator[ItemRow]) -> Iterator[bytes]:
    yield b'{"type":"FeatureCollection","features":['
    for number, row in enumerate(rows):
        document = dict(item_document(row))
        place = [document.pop("lon_deg"), document.pop("lat_deg")]
        feature = {
            "type": "Feature", "id": document.pop("id"), "geometry": {"type": "Point", "coordinates": place},
            "properties": document,
        }  # fmt: skip
        yield (b"," if number else b"") + orjson.dumps(feature)
    yield b"]}"


def _csv_lines(rows: Iterator[ItemRow]) -> Iterator[bytes]:
    yield _csv_line(CSV_COLUMNS)
    for row in rows:
        document = dict(item_document(row))
        yield _csv_line(tuple(document[name] for name in CSV_COLUMNS))


def _csv_line(values: tuple[object, ...]) -> bytes:
    text = io.StringIO()
    TableWriter(text).write_row(value.isoformat() if isinstance(value, datetime) else value for value in values)
    return text.getvalue().encode()
