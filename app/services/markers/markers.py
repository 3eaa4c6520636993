"""Registering, finding and changing markers."""

from __future__ import annotations

import secrets
import types
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from typing import TYPE_CHECKING, Any, NotRequired

import sqlalchemy as sa
from pydantic import JsonValue
from typing_extensions import TypedDict

from app.errors import InvalidParameter
from app.families import FAMILIES, get_family, union_of_documents
from app.families.documents import MarkerDocument, MarkerIn, PositionIn, WarningDocument, place_input, position_columns
from app.families.family import AnyFamily, Registration
from app.families.surveys import ColumnValues, MarkerRules
from app.markers.reading import MarkerRow
from app.registry import decodes as registry_observations
from app.registry import markers as store
from app.registry.audit import recording
from app.registry.column_types import new_id
from app.registry.database import Database
from app.registry.decodes import ObservationRow, Place
from app.registry.history import get_version, list_versions
from app.registry.marker_rows import VersionRow
from app.registry.markers import get_marker
from app.registry.resources import check_version
from app.services.access.access import Caller
from app.services.access.audit import author_of
from app.services.documents import VersionKind, document_of, kind_of_change, kind_of_new
from app.services.idempotency import IdempotencyKey, write_once
from app.services.markers.plausibility import AccuracyDocument, WarningMode, accuracy_document, check_position
from app.services.ports import Clock
from app.services.roads.documents import linear_references

# === Shapes of markers of all families, and of the answers that hold them.


class AlongDocument(TypedDict):
    """Where a marker is along the line of a search."""

    distance_m: float
    offset_m: float
    ambiguous: bool


class Found(TypedDict):
    """What a search adds to a marker."""

    distance_m: NotRequired[float]
    along: NotRequired[AlongDocument]


class FoundMarker(MarkerDocument, Found):
    """A marker of any family that a search found; `distance_m` is from the place of the search. [m]"""


def _found(document: Any) -> object:
    """The shape of a family's markers in the answer to a search."""
    return types.new_class(f"Found{document.__name__}", (document, Found))


if TYPE_CHECKING:
    AnyMarker = MarkerDocument
    AnyMarkerDetail = MarkerDocument
    AnyFoundMarker = FoundMarker
else:
    AnyMarker = union_of_documents(family.document_type for family in FAMILIES)
    AnyMarkerDetail = union_of_documents(family.detail_type for family in FAMILIES)
    AnyFoundMarker = union_of_documents(_found(family.document_type) for family in FAMILIES)


class MarkerPage(TypedDict):
    """A page of markers; the Link header leads to the next one."""

    items: list[AnyFoundMarker]


class VersionDocument(TypedDict):
    """One entry of a marker's history."""

    version: int
    at: datetime
    who: str
    why: str | None
    kind: VersionKind
    sha256: str
    audit_number: int
    marker: AnyMarker


class VersionPage(TypedDict):
    """A page of a marker's history, oldest first."""

    items: list[VersionDocument]


# === Registering, finding and changing markers.


Step = Callable[[sa.Connection], MarkerDocument]
"""What is left to do in the transaction: it returns the marker as it is then."""


@dataclass(frozen=True, slots=True)
class MarkerChange:
    """What to change: `values` by column, the position if it is to be replaced, `spec` by family and member."""

    values: ColumnValues = field(default_factory=dict)
    position: PositionIn | None = None
    kind: str | None = None
    reason: str | None = None
    spec: dict[str, dict[str, object]] = field(default_factory=dict)


class Markers:
    """Use cases on markers, one transaction each.

    Parameters
    ----------
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
        self, caller: Caller, new: MarkerIn, key: IdempotencyKey | None = None, warnings: WarningMode = "store"
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

    def prepare_new(self, caller: Caller, new: MarkerIn, now: datetime, warnings: WarningMode = "store") -> Step:
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


def _family(row: MarkerRow) -> AnyFamily:
    return get_family(row.family)


def _with_warnings(document: MarkerDocument, found: list[WarningDocument]) -> MarkerDocument:
    return {**document, "position_warnings": found} if found else document


def _spec_changes(family: AnyFamily, change: MarkerChange) -> dict[str, object]:
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


# === What vehicles saw of a marker.


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
            rows = registry_observations.list_of_marker(
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
            rows = registry_observations.summarize(connection, caller.agency_id, marker_id)
            newest = registry_observations.list_of_marker(connection, caller.agency_id, marker_id, limit=1)
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
        field="after",
        limit="as the link to the next page has it",
        cure="start without after, and follow the links",
    )
