"""Registering, finding and changing markers."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, TypeVar

import sqlalchemy as sa

from app.errors import InvalidParameter, StaleVersion
from app.registry import markers as store
from app.registry.audit import recording
from app.registry.database import Database
from app.registry.history import get_version, marker_of
from app.registry.ids import new_id
from app.registry.markers import Row
from app.services.access import Caller
from app.services.accuracy import accuracy_document
from app.services.audit import author_of
from app.services.cerpm_markers import Cerpms, NewCerpm
from app.services.idempotency import IdempotencyKey, find_answer, keep_answer
from app.services.magnet_markers import Magnets, NewMagnets
from app.services.marker_documents import version_document
from app.services.marker_rules import MarkerFamily, MarkerRules, NewMarker
from app.services.plate_markers import NewPlate, Plates
from app.services.ports import Clock
from app.services.positions import GivenPosition, place_given, position_columns
from app.services.road_routes import linear_reference
from app.services.version_kinds import kind_of_change, kind_of_new

New = TypeVar("New", bound=NewMarker)
Prepared = TypeVar("Prepared")
Step = Callable[[sa.Connection], dict[str, Any]]
"""What is left to do in the transaction: it returns the marker as it is then."""


@dataclass(frozen=True, slots=True)
class MarkerChange:
    """What to change: `values` by column, and the position if it is to be replaced."""

    values: dict[str, Any] = field(default_factory=dict)
    position: GivenPosition | None = None
    kind: str | None = None
    reason: str | None = None


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
        self._plates = Plates(self._rules, random_bits)
        self._magnets = Magnets(database, self._rules)
        self._cerpms = Cerpms(self._rules)
        self._families: dict[str, MarkerFamily[Any, Any]] = {
            "plate": self._plates,
            "magnet": self._magnets,
            "cerpm": self._cerpms,
        }

    def register(
        self, caller: Caller, new: NewPlate | NewMagnets | NewCerpm, key: IdempotencyKey | None = None
    ) -> tuple[dict[str, Any], bool]:
        """Store a new marker.

        Returns
        -------
        marker : dict
        replayed : bool
            The request had been made before under the same Idempotency-Key; nothing was stored now.

        Raises
        ------
        InvalidParameter, CodeMismatch, ReferenceSystemError
            The request contradicts itself or a limit.
        CodeTaken
            Another marker carries the code or the number.
        NotFound
            The codebook is not there.
        Conflict
            Magnets of another marker lie too near.
        """
        now = self._clock()
        store_new = self.prepare_new(caller, new, now)
        with self._database.write() as connection:
            answer = find_answer(connection, caller.agency_id, key, now)
            if answer is not None:
                return answer, True
            marker = store_new(connection)
            keep_answer(connection, caller.agency_id, key, marker, now, self._rules.idempotency_ttl)
        return marker, False

    def prepare_new(self, caller: Caller, new: NewPlate | NewMagnets | NewCerpm, now: datetime) -> Step:
        """What takes time before a new marker is stored, and the step that then stores it.

        Raises
        ------
        InvalidParameter, CodeMismatch, ReferenceSystemError, NotFound
            As the family says; its step raises what is known in the transaction only.
        """
        if isinstance(new, NewPlate):
            return self._prepared(self._plates, caller, new, now)
        if isinstance(new, NewMagnets):
            return self._prepared(self._magnets, caller, new, now)
        return self._prepared(self._cerpms, caller, new, now)

    def _prepared(self, family: MarkerFamily[New, Prepared], caller: Caller, new: New, now: datetime) -> Step:
        prepared = family.prepare(caller, new, now)

        def store_new(connection: sa.Connection) -> dict[str, Any]:
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
                **family.columns(connection, caller, new, prepared),
            }
            if new.measure_m is None:
                values |= linear_reference(connection, caller.agency_id, values)
            kind = kind_of_new(new.status, new.kind)
            who = author_of(caller)
            with recording(
                connection, caller.agency_id, who, "marker.registered", now=now, subject=values["id"]
            ) as entry:
                row = store.add_marker(connection, entry, values, kind=kind, why=new.reason)
            family.index(connection, caller, row)
            return family.detail(row)

        return store_new

    def get(self, caller: Caller, marker_id: str) -> dict[str, Any]:
        """One marker."""
        with self._database.read() as connection:
            row = store.get_marker(connection, caller.agency_id, marker_id)
        return self._family(row).detail(row)

    def accuracy(self, caller: Caller, marker_id: str) -> dict[str, Any]:
        """How good a marker's survey is, by the standards that agencies know."""
        with self._database.read() as connection:
            row = store.get_marker(connection, caller.agency_id, marker_id)
        return accuracy_document(row["horizontal_rmse_m"], row["vertical_rmse_m"], row["check_points"])

    def change(self, caller: Caller, marker_id: str, change: MarkerChange, version: int | None) -> dict[str, Any]:
        """Change a marker that is still at `version`; None changes whatever version is stored.

        Raises
        ------
        StaleVersion
            The marker was changed since the caller read it.
        InvalidParameter
            Its family does not allow the change.
        Conflict
            At its new place, or back in use, it collides with another marker.
        """
        change_stored = self.prepare_change(caller, marker_id, change, version, self._clock())
        with self._database.write() as connection:
            return change_stored(connection)

    def prepare_change(
        self, caller: Caller, marker_id: str, change: MarkerChange, version: int | None, now: datetime
    ) -> Step:
        """The step that changes a marker; its place is worked out before.

        Raises
        ------
        InvalidParameter, ReferenceSystemError
            The new position is none; the step raises as `change` does.
        """
        placed = place_given(change.position, self._rules.crs_accuracy_m) if change.position is not None else None

        def change_stored(connection: sa.Connection) -> dict[str, Any]:
            row = store.get_marker(connection, caller.agency_id, marker_id)
            if version is not None and row["version"] != version:
                raise StaleVersion(
                    f"marker {marker_id} is at version {row['version']}, the change is based on version {version}",
                    field="If-Match",
                    limit=f'"{row["version"]}"',
                    cure="read the marker again and repeat the change on what it is now",
                )
            values = dict(change.values)
            if placed is not None and change.position is not None:
                values |= position_columns(change.position, placed)
            family = self._family(row)
            if "spec" in values and row["family"] != "cerpm":
                raise InvalidParameter(
                    f"a {row['family']} has no side, speed limit or radio",
                    field="/".join(values["spec"]),
                    limit="CERPMs only",
                    cure="leave it out",
                )
            values |= family.revised(connection, caller, row, values, moved=placed is not None)
            if (placed is not None or "road" in values) and values.get("measure_m") is None:
                merged = {**row, **values}
                values |= linear_reference(connection, caller.agency_id, merged, row["measure_m"])
            kind = kind_of_change(
                row["status"], values.get("status", row["status"]), moved=placed is not None, said=change.kind
            )
            who = author_of(caller)
            with recording(connection, caller.agency_id, who, "marker.changed", now=now, subject=marker_id) as entry:
                changed = store.update_marker(
                    connection, entry, marker_id, values, version=row["version"], kind=kind, why=change.reason
                )
            if placed is not None:
                family.index(connection, caller, changed)
            return family.detail(changed)

        return change_stored

    def history(
        self, caller: Caller, marker_id: str, *, after: int = 0, limit: int = 100
    ) -> tuple[list[dict[str, Any]], int | None]:
        """A page of a marker's versions, oldest first, and the version to continue after."""
        with self._database.read() as connection:
            store.get_marker(connection, caller.agency_id, marker_id)
            rows = store.list_versions(connection, caller.agency_id, marker_id, after=after, limit=limit + 1)
        page = [self._version(row) for row in rows[:limit]]
        return page, page[-1]["version"] if len(rows) > limit else None

    def version(self, caller: Caller, marker_id: str, version: int) -> dict[str, Any]:
        """One version of a marker: the marker as it was then, who made it so, when and why.

        Raises
        ------
        NotFound
            There is none, or it belongs to another agency.
        """
        with self._database.read() as connection:
            return self._version(get_version(connection, caller.agency_id, marker_id, version))

    def _version(self, row: Row) -> dict[str, Any]:
        marker = marker_of(row)
        return version_document(row, self._family(marker).document(marker))

    def _family(self, row: Row | dict[str, Any]) -> MarkerFamily[Any, Any]:
        return self._families[row["family"]]
