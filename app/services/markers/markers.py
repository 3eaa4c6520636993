"""Registering, finding and changing markers."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

import sqlalchemy as sa

from app.errors import InvalidParameter
from app.families import get_family
from app.families.documents import MarkerDocument, WarningDocument
from app.families.family import Family, Registration
from app.families.inputs import PositionIn
from app.families.new_marker import NewMarker
from app.families.positions import place_input, position_columns
from app.families.rules import MarkerRules
from app.registry import markers as store
from app.registry.audit import recording
from app.registry.database import Database
from app.registry.history import get_version, list_versions
from app.registry.ids import new_id
from app.registry.marker_rows import MarkerRow, VersionRow
from app.registry.resources import check_version
from app.services.access.access import Caller
from app.services.access.audit import author_of
from app.services.documents import document_of
from app.services.idempotency import IdempotencyKey, write_once
from app.services.markers.accuracy import AccuracyDocument, accuracy_document
from app.services.markers.documents import VersionDocument
from app.services.markers.plausibility import WarningMode, check_position
from app.services.ports import Clock
from app.services.roads.routes import linear_references
from app.services.version_kinds import kind_of_change, kind_of_new

Step = Callable[[sa.Connection], MarkerDocument]
"""What is left to do in the transaction: it returns the marker as it is then."""


@dataclass(frozen=True, slots=True)
class MarkerChange:
    """What to change: `values` by column, the position if it is to be replaced, `spec` by family and member."""

    values: dict[str, Any] = field(default_factory=dict)
    position: PositionIn | None = None
    kind: str | None = None
    reason: str | None = None
    spec: dict[str, dict[str, Any]] = field(default_factory=dict)


class Markers:
    """Use cases on markers, one transaction each.

    Parameters
    ----------
    database : Database
    clock : Clock
    rules : MarkerRules
    random_bits : callable, optional
        Source of the numbers that plates get.
    """

    def __init__(
        self,
        database: Database,
        clock: Clock,
        rules: MarkerRules | None = None,
        random_bits: Callable[[int], int] = secrets.randbits,
    ) -> None:
        self._database = database
        self._clock = clock
        self._rules = rules or MarkerRules()
        self._random_bits = random_bits

    def register(
        self, caller: Caller, new: NewMarker, key: IdempotencyKey | None = None, warnings: WarningMode = "store"
    ) -> tuple[MarkerDocument, bool]:
        """Store a new marker.

        Returns
        -------
        marker : MarkerDocument
            With the warnings about its position.
        replayed : bool
            The request had been made before under the same Idempotency-Key; nothing was stored now.

        Raises
        ------
        InvalidParameter, CodeMismatch, ReferenceSystemError
            The request contradicts itself or a limit, or has warnings that are to be refused.
        CodeTaken
            Another marker carries the code or the number.
        NotFound
            The codebook is not there.
        Conflict
            Magnets of another marker lie too near.
        """
        now = self._clock()
        store_new = self.prepare_new(caller, new, now, warnings)
        ttl = self._rules.idempotency_ttl
        with write_once(self._database, caller.agency_id, key, now, ttl) as (connection, answer):
            if not answer.replayed:
                answer.store(store_new(connection))
        return answer.response, answer.replayed

    def prepare_new(self, caller: Caller, new: NewMarker, now: datetime, warnings: WarningMode = "store") -> Step:
        """What takes time before a new marker is stored, and the step that then stores it.

        Raises
        ------
        InvalidParameter, CodeMismatch, ReferenceSystemError, NotFound
            By the rules of the family; the step raises what is known in the transaction only.
        """
        family, registration = get_family(new.family), self._registration(caller, now)
        prepared = family.prepare(registration, new)

        def store_new(connection: sa.Connection) -> MarkerDocument:
            values = {
                "id": new_id(now),
                "status": new.status,
                "heading_rmse_deg": new.heading_rmse_deg,
                "road": new.road,
                "measure_m": new.measure_m,
                "offset_m": new.offset_m,
                "version": 1,
                "created_at": now,
                "updated_at": now,
                **family.columns(connection, registration, new, prepared),
            }
            found = check_position(connection, caller.agency_id, values["id"], values, warnings)
            if new.measure_m is None:
                values |= linear_references(connection, caller.agency_id, [values], [None])[0]
            kind = kind_of_new(new.status, new.kind)
            who = author_of(caller)
            with recording(
                connection, caller.agency_id, who, "marker.registered", now=now, subject=values["id"]
            ) as entry:
                row = store.add_marker(connection, entry, values, kind=kind, why=new.reason)
            family.index(connection, caller.agency_id, row)
            return _with_warnings(family.detail(row), found)

        return store_new

    def get(self, caller: Caller, marker_id: str) -> MarkerDocument:
        """One marker."""
        with self._database.read() as connection:
            row = store.get_marker(connection, caller.agency_id, marker_id)
        return _family(row).detail(row)

    def accuracy(self, caller: Caller, marker_id: str) -> AccuracyDocument:
        """Accuracy of a marker's survey, by the standards that agencies use."""
        with self._database.read() as connection:
            row = store.get_marker(connection, caller.agency_id, marker_id)
        return accuracy_document(row.horizontal_rmse_m, row.vertical_rmse_m, row.check_points)

    def change(
        self,
        caller: Caller,
        marker_id: str,
        change: MarkerChange,
        version: int | None,
        warnings: WarningMode = "store",
    ) -> MarkerDocument:
        """Change a marker that is still at `version`; None changes whatever version is stored.

        Raises
        ------
        StaleVersion
            The marker was changed since the caller read it.
        InvalidParameter
            Its family does not allow the change, or its position has warnings that are to be refused.
        Conflict
            At its new place, or back in use, it collides with another marker.
        """
        change_stored = self.prepare_change(caller, marker_id, change, version, self._clock(), warnings)
        with self._database.write() as connection:
            return change_stored(connection)

    def prepare_change(
        self,
        caller: Caller,
        marker_id: str,
        change: MarkerChange,
        version: int | None,
        now: datetime,
        warnings: WarningMode = "store",
    ) -> Step:
        """The step that changes a marker; its place is worked out before.

        Raises
        ------
        InvalidParameter, ReferenceSystemError
            The new position is none; the step raises as `change` does.
        """
        placed = place_input(change.position, self._rules.crs_accuracy_m) if change.position is not None else None

        def change_stored(connection: sa.Connection) -> MarkerDocument:
            row = store.get_marker(connection, caller.agency_id, marker_id)
            check_version("marker", marker_id, row.version, version)
            values = dict(change.values)
            if placed is not None and change.position is not None:
                values |= position_columns(change.position, placed)
            family = _family(row)
            values |= _spec_changes(family, change)
            registration = self._registration(caller, now)
            values |= family.revise(connection, registration, row, values)
            found: list[WarningDocument] = []
            if placed is not None:
                found = check_position(connection, caller.agency_id, marker_id, {**row._asdict(), **values}, warnings)
            if (placed is not None or "road" in values) and values.get("measure_m") is None:
                merged = {**row._asdict(), **values}
                values |= linear_references(connection, caller.agency_id, [merged], [row.measure_m])[0]
            kind = kind_of_change(
                row.status, values.get("status", row.status), moved=placed is not None, said=change.kind
            )
            who = author_of(caller)
            with recording(connection, caller.agency_id, who, "marker.changed", now=now, subject=marker_id) as entry:
                changed = store.update_marker(
                    connection, entry, marker_id, values, version=row.version, kind=kind, why=change.reason
                )
            if placed is not None:
                family.index(connection, caller.agency_id, changed)
            return _with_warnings(family.detail(changed), found)

        return change_stored

    def history(
        self, caller: Caller, marker_id: str, *, after: int = 0, limit: int = 100
    ) -> tuple[list[VersionDocument], int | None]:
        """A page of a marker's versions, oldest first, and the version to continue after."""
        with self._database.read() as connection:
            store.get_marker(connection, caller.agency_id, marker_id)
            rows = list_versions(connection, caller.agency_id, marker_id, after=after, limit=limit + 1)
        page = [_version_document(row) for row in rows[:limit]]
        return page, page[-1]["version"] if len(rows) > limit else None

    def version(self, caller: Caller, marker_id: str, version: int) -> VersionDocument:
        """One version of a marker: the marker as it was then, who made it so, when and why.

        Raises
        ------
        NotFound
            There is none, or it belongs to another agency.
        """
        with self._database.read() as connection:
            return _version_document(get_version(connection, caller.agency_id, marker_id, version))

    def _registration(self, caller: Caller, now: datetime) -> Registration:
        return Registration(caller.agency_id, now, self._rules, self._database, self._random_bits)


def _family(row: MarkerRow) -> Family[Any, Any]:
    return get_family(row.family)


def _with_warnings(document: MarkerDocument, found: list[WarningDocument]) -> MarkerDocument:
    return {**document, "position_warnings": found} if found else document


def _spec_changes(family: Family[Any, Any], change: MarkerChange) -> dict[str, Any]:
    """Members of the spec that change; InvalidParameter where they are another family's."""
    for name, members in change.spec.items():
        if name != family.name:
            raise InvalidParameter(
                f"a {family.label} has no {' or '.join(members)}",
                field="/".join(members),
                limit=f"{get_family(name).title} only",
                cure="leave it out",
            )
    return {"spec": change.spec[family.name]} if family.name in change.spec else {}


def _version_document(row: VersionRow) -> VersionDocument:
    """An entry of a marker's history."""
    return document_of(VersionDocument, row, marker=_family(row.marker).document(row.marker))
