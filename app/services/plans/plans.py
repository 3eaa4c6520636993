"""Plans: markers placed on an alignment by rules, checked, approved, and committed to the registry."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from datetime import datetime
from typing import Any

import sqlalchemy as sa

from app.errors import CodeTaken, Conflict, InvalidParameter
from app.families import FAMILIES
from app.families.family import Family
from app.families.surveys import PLANNED, Commitment, MarkerRules, PlannedRow
from app.markers.magnet_design import Codebook
from app.markers.reading import MarkerRow
from app.planning.alignment import Alignment
from app.planning.outputs.package import OutputOptions
from app.planning.outputs.plan_document import read_plan
from app.planning.placement.place import tag_conditions
from app.planning.plan import Plan, PlannedMarker, PlannedTag
from app.planning.plan_checks import ExistingMarker
from app.radio.settings import RadioSettings
from app.registry import markers
from app.registry.audit import recording
from app.registry.bulk_load import Columns
from app.registry.column_types import new_ids, row_of
from app.registry.database import Database
from app.registry.markers import CODEBOOKS, book_of
from app.registry.plan_features import replace_planned
from app.registry.plan_states import find_plan_states, has_status
from app.registry.plans import ALIGNMENTS, PLANS, PlanRow, link_markers, list_built, list_existing
from app.registry.resources import first_version
from app.registry.roads import ROADS
from app.registry.spatial import Box
from app.services.access.access import Caller
from app.services.access.audit import author_of, log_change
from app.services.blobs import delete_unused, staged
from app.services.documents import document_of, kind_of_new
from app.services.idempotency import IdempotencyKey, find_earlier, idempotent
from app.services.jobs import RunningJob
from app.services.markers.codebooks import book_columns, design_figures
from app.services.plans.alignments import BUSY_WAIT_S, road_of
from app.services.plans.as_built import SURVEYED
from app.services.plans.documents import (
    AsBuiltDocument,
    CheckFigure,
    CommittedPlan,
    PlanDocument,
    PlanOverview,
    PlanPage,
    PlanVersionDocument,
    PlanVersionPage,
    ProofSummary,
)
from app.services.plans.proofs import APPROVED, CHECKED, COMMITTED, DRAFT, PROVED, files_of
from app.services.plans.tasks import MadePlan, compare_plan, make_plan, write_file_of_plan
from app.services.ports import Blobs, Clock, DecoderProcesses
from app.services.roads.documents import linear_references
from app.values import JsonObject

MAX_EXISTING = 200_000
"""Markers of the registry near a road that a plan is checked against; bounds the memory."""
_MARGIN_M = 100.0  # [m] around the road: five times the distance of confusable codes
PLACED = 0.9
"""Progress of a job whose plan is placed and checked, and is stored next."""
_TRIES = 4  # of drawing registry numbers that nobody has
_CHANGEABLE = (DRAFT, CHECKED, PROVED, APPROVED)


class Plans:
    """Use cases on plans, one transaction each.

    Parameters
    ----------
    rules : MarkerRules
        Of the markers that plans become.
    """

    def __init__(
        self, database: Database, clock: Clock, blobs: Blobs, processes: DecoderProcesses, rules: MarkerRules
    ) -> None:
        self._database, self._clock, self._blobs, self._processes = database, clock, blobs, processes
        self._rules = rules

    def make(
        self,
        caller: Caller,
        name: str,
        alignment_id: str,
        rules: dict[str, object],
        key: IdempotencyKey | None = None,
        *,
        job: RunningJob | None = None,
    ) -> tuple[PlanDocument, bool]:
        """Place and check the markers of a new plan, and store it.

        Parameters
        ----------
        job : RunningJob, optional
            That makes it; it is finished in the same transaction.

        Returns
        -------
        plan : PlanDocument
            With the status ``checked``, or ``draft`` if a check fails.
        replayed : bool
            The request had been made before under the same Idempotency-Key.

        Raises
        ------
        NotFound
            There is no such alignment.
        InvalidParameter
            The rules cannot be, or do not fit the road.
        Conflict
            The agency has a plan of this name.
        """
        now, agency_id = self._clock(), caller.agency_id
        if earlier := find_earlier(self._database, agency_id, key, now):
            return earlier, True
        with self._database.read() as connection:
            PLANS.check_name(connection, agency_id, name)
        made = self.place(caller, name, alignment_id, rules)
        if job is not None:
            job.report_progress(PLACED)
        with staged(self._blobs) as stage:
            document_key = stage.put("plans", made.document)
            with (
                self._database.write(long=True) as connection,
                idempotent(connection, agency_id, key, now, self._rules.idempotency_ttl) as answer,
            ):
                if answer.replayed:
                    return answer.response, True
                PLANS.check_name(connection, agency_id, name)
                values = {
                    **first_version(now),
                    "name": name,
                    "alignment_id": alignment_id,
                    **_made_columns(caller, made, rules, document_key),
                }
                row = PLANS.add(connection, agency_id, values, who=caller.label)
                if job is not None and not job.finish(connection, {"plan_version": 1}, subject_id=row.id):
                    raise Conflict("another worker has made this plan")
                replace_planned(connection, agency_id, row.id, made.features)
                document = answer.store(plan_document(row))
                log_change(connection, caller, "plan.made", now=now, subject=row.id, document=rules)
            stage.keep()
        return document, False

    def get(self, caller: Caller, plan_id: str) -> PlanDocument:
        """One plan; one that is committed is built or surveyed when its markers are."""
        with self._database.read() as connection:
            row = PLANS.get(connection, caller.agency_id, plan_id)
            states = find_plan_states(connection, caller.agency_id)
        return plan_document(row._replace(status=states.status_of(row.id, row.status)))

    def page(
        self,
        caller: Caller,
        *,
        alignment_id: str | None = None,
        status: str | None = None,
        after: str | None = None,
        limit: int = 100,
    ) -> tuple[PlanPage, str | None]:
        """A page of plans without their findings, and the id to continue after if there are more."""
        agency_id = caller.agency_id
        with self._database.read() as connection:
            states = find_plan_states(connection, agency_id)
            where = () if status is None else (has_status(status, states),)
            rows, last = PLANS.page(
                connection, agency_id, beyond=after, limit=limit, where=where, alignment_id=alignment_id
            )
        rows = [row._replace(status=states.status_of(row.id, row.status)) for row in rows]
        return {"items": [plan_overview(row) for row in rows]}, last

    def history(
        self, caller: Caller, plan_id: str, *, after: int = 0, limit: int = 100
    ) -> tuple[PlanVersionPage, int | None]:
        """A page of a plan's history, oldest first, and the version to continue after if there are more."""
        with self._database.read() as connection:
            rows, last = PLANS.history(connection, caller.agency_id, plan_id, after=after, limit=limit)
        return {"items": [document_of(PlanVersionDocument, row, plan=row.stored) for row in rows]}, last

    def change(
        self,
        caller: Caller,
        plan_id: str,
        version: int | None,
        *,
        name: str | None = None,
        rules: dict[str, object] | None = None,
        reason: str | None = None,
    ) -> PlanDocument:
        """Rename a plan, or place and check it again by other rules; the proof and the approval are then gone.

        Raises
        ------
        NotFound, StaleVersion, InvalidParameter
        Conflict
            Another plan has the name, or the plan is committed.
        """
        row = self._get(caller, plan_id)
        cure = "make another plan on the same alignment"
        _check_status(row, _CHANGEABLE, "changed", cure)
        made = None if rules is None else self.place(caller, name or row.name, row.alignment_id, rules)
        now, agency_id = self._clock(), caller.agency_id
        with staged(self._blobs) as stage:
            changes: JsonObject = {"name": name or row.name}
            if made is not None and rules is not None:
                changes |= _made_columns(caller, made, rules, stage.put("plans", made.document))
            with self._database.write(long=made is not None) as connection:
                row = PLANS.get_at(connection, agency_id, plan_id, version)
                _check_status(row, _CHANGEABLE, "changed", cure)
                if changes["name"] != row.name:
                    PLANS.check_name(connection, agency_id, changes["name"])
                changed = PLANS.update(
                    connection,
                    agency_id,
                    plan_id,
                    changes,
                    version=row.version,
                    now=now,
                    who=caller.label,
                    why=reason,
                )
                _log_plan(connection, caller, "plan.changed", changed, now)
                if made is not None:
                    replace_planned(connection, agency_id, plan_id, made.features)
            stage.keep()
        if made is not None:
            delete_unused(self._blobs, files_of(row.proof))
        return plan_document(changed)

    def approve(self, caller: Caller, plan_id: str, version: int | None) -> PlanDocument:
        """Approve a plan that somebody else made and that passed its checks.

        Raises
        ------
        NotFound, StaleVersion
        Conflict
            The author approves, a check fails, or the plan is approved already.
        """
        now, agency_id = self._clock(), caller.agency_id
        with self._database.write() as connection:
            row = PLANS.get_at(connection, agency_id, plan_id, version)
            _check_status(row, (CHECKED, PROVED), "approved", "change its rules until every check passes")
            if row.author_id == caller.key_id:
                raise Conflict(
                    "the author of a plan cannot approve it",
                    field="approver",
                    limit="author and approver differ",
                    cure="let the holder of another key approve it",
                )
            changes = {"status": APPROVED, "approver": caller.label}
            approved = PLANS.update(
                connection, agency_id, plan_id, changes, version=row.version, now=now, who=caller.label
            )
            _log_plan(connection, caller, "plan.approved", approved, now)
        return plan_document(approved)

    def commit(
        self, caller: Caller, plan_id: str, version: int | None, key: IdempotencyKey | None = None
    ) -> tuple[CommittedPlan, bool]:
        """Make the markers of an approved plan planned markers of the registry: all or none.

        Raises
        ------
        NotFound, StaleVersion
        Conflict
            The plan is not approved, or its codebook was changed.
        CodeTaken
            Another marker has got one of its codes since it was placed.
        """
        now, agency_id = self._clock(), caller.agency_id
        if earlier := find_earlier(self._database, agency_id, key, now):
            return earlier, True
        row = self._get(caller, plan_id)
        plan = read_plan(zlib.decompress(self._blobs.get(row.document_key)))
        with (
            self._database.write(long=True) as connection,
            idempotent(connection, agency_id, key, now, self._rules.idempotency_ttl) as answer,
        ):
            if answer.replayed:
                return answer.response, True
            row = PLANS.get_at(connection, agency_id, plan_id, row.version if version is None else version)
            _check_status(row, (APPROVED,), "committed", "let somebody approve it first")
            if taken := self._taken(connection, agency_id, [(m.family, m.code) for m in plan.markers]):
                raise CodeTaken(
                    f"{len(taken)} codes of the plan belong to other markers by now, e.g. {min(taken)}",
                    field="plan",
                    limit="codes that no other marker has",
                    cure="PATCH the plan with its own rules: its markers get new codes",
                )
            markers, uncommitted = _commit_markers(connection, caller, row, plan, self._rules, now)
            committed = PLANS.update(
                connection, agency_id, plan_id, {"status": COMMITTED}, version=row.version, now=now, who=caller.label
            )
            document = answer.store(CommittedPlan(**plan_document(committed), markers=markers, uncommitted=uncommitted))
        return document, False

    def file(self, caller: Caller, plan_id: str, name: str, options: OutputOptions | None = None) -> tuple[bytes, int]:
        """A file of a plan, and the plan's version; the options are those of the crew that stakes it out.

        Raises
        ------
        NotFound
            There is no such plan, or it has no such file.
        InvalidParameter, ReferenceSystemError
            The options cannot be used.
        """
        row = self._get(caller, plan_id)
        document = self._blobs.get(row.document_key)
        content = self._processes.run(write_file_of_plan, document, name, options, wait_s=BUSY_WAIT_S)
        return content, row.version

    def as_built(self, caller: Caller, plan_id: str) -> AsBuiltDocument:
        """A plan beside what was built and surveyed; nothing is, before it is committed.

        Raises
        ------
        NotFound
        """
        agency_id = caller.agency_id
        existing: tuple[ExistingMarker, ...] = ()
        with self._database.read() as connection:
            row = PLANS.get(connection, agency_id, plan_id)
            built = list_built(connection, agency_id, plan_id)
            if any(marker.status in SURVEYED for marker in built):
                own = {marker.marker_id for marker in built}
                road = ALIGNMENTS.get(connection, agency_id, row.alignment_id)
                found = self._existing(connection, caller, road.summary["extent_deg"])
                existing = tuple(marker for marker in found if marker.marker_id not in own)
        document = self._blobs.get(row.document_key)
        return self._processes.run(compare_plan, document, tuple(built), existing, wait_s=BUSY_WAIT_S)

    def place(self, caller: Caller, name: str, alignment_id: str, rules: dict[str, object]) -> MadePlan:
        """A plan with codes that no stored marker has, placed and checked; nothing is stored.

        Raises
        ------
        NotFound, InvalidParameter, Conflict
            As `make`.
        """
        with self._database.read() as connection:
            row = ALIGNMENTS.get(connection, caller.agency_id, alignment_id)
            existing = self._existing(connection, caller, row.summary["extent_deg"])
            codebook = _codebook(connection, caller, rules)
        taken: set[int] = set()
        with self._blobs.opened(row.source_key) as file:
            road = road_of(row, file, self._rules.crs_accuracy_m)
            for _ in range(_TRIES):
                made = self._processes.run(
                    make_plan, road, rules, name, frozenset(taken), existing, codebook, wait_s=BUSY_WAIT_S
                )
                with self._database.read() as connection:
                    found = self._taken(connection, caller.agency_id, made.numbers)
                if not found:
                    return made
                taken |= found
        raise Conflict(
            "no unused registry numbers were found", field="rules", cure="try again, or give the plan another name"
        )

    # --- steps ------------------------------------------------------------------------------------------------------

    def _get(self, caller: Caller, plan_id: str) -> PlanRow:
        with self._database.read() as connection:
            return PLANS.get(connection, caller.agency_id, plan_id)

    def _existing(
        self, connection: sa.Connection, caller: Caller, extent_deg: list[float]
    ) -> tuple[ExistingMarker, ...]:
        box = Box(*extent_deg).widened(_MARGIN_M)
        found = list_existing(connection, caller.agency_id, box, limit=MAX_EXISTING)
        return tuple(ExistingMarker(m.id, m.family, m.digits or "", m.lon_deg, m.lat_deg, m.status) for m in found)

    def _taken(self, connection: sa.Connection, agency_id: str, codes: Sequence[tuple[str, str]]) -> set[int]:
        """Registry numbers of these codes that other markers have."""
        taken: set[int] = set()
        for family in FAMILIES:
            own = [code for name, code in codes if name == family.name]
            found = markers.list_by_digits(connection, family.name, own)
            taken |= family.taken_numbers(agency_id, found)
        return taken


def plan_document(row: PlanRow) -> PlanDocument:
    """A plan as clients see it."""
    proof = None
    if row.proof is not None:
        proof = {name: value for name, value in row.proof.items() if name in ProofSummary.__annotations__}
    return document_of(PlanDocument, row, proof=proof, **_members(row, PlanDocument))


def plan_overview(row: PlanRow) -> PlanOverview:
    """A plan in a list."""
    checks = [{name: finding[name] for name in CheckFigure.__annotations__} for finding in row.summary["findings"]]
    return document_of(PlanOverview, row, **_members(row, PlanOverview), checks=checks)


def _members(row: PlanRow, document: object) -> dict[str, object]:
    return {name: value for name, value in row.summary.items() if name in document.__annotations__}


def _made_columns(caller: Caller, made: MadePlan, rules: Mapping[str, object], document_key: str) -> dict[str, object]:
    passed = made.summary["verdict"] != "fail"
    return {
        "status": CHECKED if passed else DRAFT,
        "rules": dict(rules),
        "document_key": document_key,
        "summary": made.summary,
        "proof": None,
        "author": caller.label,
        "author_id": caller.key_id,
        "approver": None,
    }


def _codebook(connection: sa.Connection, caller: Caller, rules: Mapping[str, object]) -> dict[str, object] | None:
    tags = rules.get("tags")
    name = tags.get("codebook") if isinstance(tags, dict) else None
    if not isinstance(name, str):
        return None
    row = CODEBOOKS.find(connection, caller.agency_id, name=name)
    if row is None:
        raise InvalidParameter(
            f"the agency has no codebook {name[:80]!r}",
            field="rules.tags.codebook",
            limit="a codebook of the agency",
            cure="GET /v1/codebooks lists yours; leave the member out for a new one",
        )
    return book_of(row).to_document()


def _check_status(row: PlanRow, allowed: tuple[str, ...], what: str, cure: str) -> None:
    if row.status not in allowed:
        raise Conflict(
            f"the plan is {row.status} and cannot be {what}", field="status", limit=", ".join(allowed), cure=cure
        )


def _log_plan(connection: sa.Connection, caller: Caller, action: str, row: PlanRow, now: datetime) -> None:
    log_change(connection, caller, action, now=now, subject=row.id, document=row.rules, status=row.status)


# === An approved plan becomes planned markers, in the caller's transaction and under one entry of the audit log.


_PART = 2000  # rows that are stored at a time, as by imports
_MAX_ROAD = 200  # [character] of the name of a marker's road


def _commit_markers(
    connection: sa.Connection, caller: Caller, row: PlanRow, plan: Plan, rules: MarkerRules, now: datetime
) -> tuple[int, int]:
    """Store the markers of a plan; returns how many, and how many planned markers became none.

    Raises
    ------
    Conflict
        The codebook of the plan was changed since.
    """
    codebook_id = _store_codebook(connection, caller, plan, now)
    roads = _registry_roads(connection, caller.agency_id, plan.alignment)
    commitment = Commitment(
        row.id, plan.alignment, rules, now, codebook_id, plan.radio or RadioSettings(), plan.rules.installation, roads
    )
    stored: list[tuple[int, str]] = []
    covered = 0
    author, detail = author_of(caller), {"markers": plan.counts}
    with (
        recording(
            connection, caller.agency_id, author, "plan.committed", now=now, subject=row.id, detail=detail
        ) as entry,
        markers.many_markers(connection, len(plan.markers)),
    ):
        for number, (family, part) in enumerate(_parts(commitment, plan.markers)):
            ids = new_ids(now, len(part), number)
            _measure(connection, caller.agency_id, part)
            columns = _columns(part, ids, family.name, now)
            markers.add_markers(connection, entry, columns, kind=kind_of_new, why=f"plan {plan.name}")
            if family.has_index:
                for stored_row in columns.rows():
                    family.index(connection, caller.agency_id, row_of(MarkerRow, stored_row))
            stored += zip((planned.number for planned in part), ids, strict=True)
            covered += sum(planned.covered for planned in part)
    link_markers(connection, caller.agency_id, row.id, stored)
    return len(stored), len(plan.markers) - covered


def _registry_roads(connection: sa.Connection, agency_id: str, alignment: Alignment) -> dict[str, str]:
    """Name in the registry of each road of an alignment: that of the registered road, else of the alignment.

    Files name their roads ``1`` or ``CL``; an agency has one alignment of a name.
    """
    names = list(dict.fromkeys(lane.road for lane in alignment.lanes))
    own = {name: f"{alignment.name}, {name}" if len(names) > 1 else alignment.name for name in names}
    return {
        name: name if name and ROADS.find(connection, agency_id, name=name) is not None else own[name][:_MAX_ROAD]
        for name in names
    }


def _measure(connection: sa.Connection, agency_id: str, part: Sequence[PlannedRow]) -> None:
    """Give rows on registered roads the measures and offsets of these; the others keep the stations of the plan."""
    columns = [planned.columns for planned in part]
    for own, found in zip(
        columns, linear_references(connection, agency_id, columns, [one["measure_m"] for one in columns]), strict=True
    ):
        own |= found


def _parts(
    commitment: Commitment, planned: Sequence[PlannedMarker]
) -> Iterator[tuple[Family[Any, object], list[PlannedRow]]]:
    """Rows of the planned markers, family by family, as many at a time as are stored in one step."""
    for family in FAMILIES:
        own = [marker for marker in planned if marker.family == family.name]
        if own:
            rows = list(family.planned_rows(commitment, own))
            yield from ((family, rows[start : start + _PART]) for start in range(0, len(rows), _PART))


def _columns(part: list[PlannedRow], ids: list[str], family: str, now: datetime) -> Columns:
    """Rows as columns; what a family leaves out is empty."""
    same = {
        **dict.fromkeys(MarkerRow._fields),
        "family": family,
        "status": PLANNED,
        "version": 1,
        "created_at": now,
        "updated_at": now,
    }
    names = sorted({name for planned in part for name in planned.columns} - {"id", "family"})
    lists: dict[str, Sequence[object]] = {"id": ids}
    lists |= {name: [planned.columns.get(name) for planned in part] for name in names}
    return Columns.of(len(part), {name: same[name] for name in same if name not in lists}, lists)


def _store_codebook(connection: sa.Connection, caller: Caller, plan: Plan, now: datetime) -> str | None:
    """The codebook of the plan's tags in the registry, with the entries that the plan added."""
    book = plan.codebook
    if book is None or not any(isinstance(marker.detail, PlannedTag) for marker in plan.markers):
        return None
    agency_id = caller.agency_id
    row = CODEBOOKS.find(connection, agency_id, name=book.name)
    if row is None:
        rules = tag_conditions(plan.rules, plan.alignment)
        values = {
            **first_version(now),
            **book_columns(book),
            "rules": asdict(rules),
            "figures": design_figures(book.design, rules),
        }
        return CODEBOOKS.add(connection, agency_id, values).id
    stored = book_of(row)
    if stored.entries == book.entries:
        return row.id
    if not _extends(book, stored):
        raise Conflict(
            f"the codebook {book.name} was changed since the plan was made",
            field="plan",
            limit="the codes of the plan's tags are free in the codebook",
            cure="PATCH the plan with its own rules: its tags get codes from the codebook as it is",
        )
    entries = {"entries": book_columns(book)["entries"]}
    return CODEBOOKS.update(connection, agency_id, row.id, entries, version=row.version, now=now).id


def _extends(longer: Codebook, book: Codebook) -> bool:
    return longer.design == book.design and longer.entries[: len(book.entries)] == book.entries
