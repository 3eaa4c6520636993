"""An approved plan becomes planned markers, in the caller's transaction and under one entry of the audit log."""

from __future__ import annotations

from datetime import datetime
from typing import Any

import sqlalchemy as sa

from app.encoders.magnet.codebook import CodebookRules
from app.errors import Conflict
from app.families import FAMILIES
from app.families.planned import Commitment
from app.families.rules import PLANNED, MarkerRules
from app.markers.magnet_codebook import Codebook
from app.planning.plan import Plan, PlannedTag
from app.radio.settings import RadioSettings
from app.registry import bulk
from app.registry.audit import recording
from app.registry.codebooks import CODEBOOKS, book_of
from app.registry.columns import Columns
from app.registry.ids import new_ids
from app.registry.marker_rows import MarkerRow
from app.registry.plans import PlanRow, link_markers
from app.registry.resources import first_version
from app.registry.rows import row_of
from app.services.access.access import Caller
from app.services.access.audit import author_of
from app.services.markers.codebook_documents import book_columns, design_figures, rules_columns
from app.services.version_kinds import kind_of_new

_PART = 2000  # rows that are stored at a time; source: chosen by hand, as imports


def commit_markers(
    connection: sa.Connection, caller: Caller, row: PlanRow, plan: Plan, rules: MarkerRules, now: datetime
) -> tuple[int, int]:
    """Store the markers of a plan; returns how many, and how many planned markers became none.

    Raises
    ------
    Conflict
        The codebook of the plan was changed since.
    """
    codebook_id = _store_codebook(connection, caller, plan, now)
    commitment = Commitment(row.id, plan.alignment, rules, now, codebook_id, plan.radio or RadioSettings())
    with recording(
        connection, caller.agency_id, author_of(caller), "plan.committed", now=now, subject=row.id,
        detail={"markers": plan.counts},
    ) as entry:  # fmt: skip
        stored: list[tuple[int, str]] = []
        covered, number = 0, 0
        with bulk.many_markers(connection, len(plan.markers)):
            for family in FAMILIES:
                own = [marker for marker in plan.markers if marker.family == family.name]
                if not own:
                    continue
                assert family.planned is not None, f"no plan has markers of the family {family.name}"
                rows = list(family.planned.rows(commitment, own))
                covered += sum(found.covered for found in rows)
                for start in range(0, len(rows), _PART):
                    part = rows[start : start + _PART]
                    ids = new_ids(now, len(part), number)
                    number += 1
                    columns = _columns(part, ids, family.name, plan, now)
                    bulk.add_markers(connection, entry, columns, kind=kind_of_new, why=f"plan {plan.name}")
                    stored += zip((found.number for found in part), ids, strict=True)
                    if family.planned.needs_index:
                        for stored_row in columns.rows():
                            family.index(connection, caller.agency_id, row_of(MarkerRow, stored_row))
    link_markers(connection, caller.agency_id, row.id, stored)
    return len(stored), len(plan.markers) - covered


def _columns(part: list[Any], ids: list[str], family: str, plan: Plan, now: datetime) -> Columns:
    """Rows as columns; what a family leaves out is empty."""
    same = {
        **dict.fromkeys(MarkerRow._fields),
        "family": family,
        "status": PLANNED,
        "version": 1,
        "created_at": now,
        "updated_at": now,
    }
    names = sorted({name for found in part for name in found.columns} - {"id", "family"})
    lists = {"id": ids, **{name: [found.columns.get(name) for found in part] for name in names}}
    return Columns.of(len(part), {name: same[name] for name in same if name not in lists}, lists)


def _store_codebook(connection: sa.Connection, caller: Caller, plan: Plan, now: datetime) -> str | None:
    """The codebook of the plan's tags in the registry, with the entries that the plan added."""
    book = plan.codebook
    if book is None or not any(isinstance(marker.detail, PlannedTag) for marker in plan.markers):
        return None
    agency_id = caller.agency_id
    row = CODEBOOKS.find(connection, agency_id, name=book.name)
    if row is None:
        rules = CodebookRules()
        values = {
            **first_version(now),
            **book_columns(book),
            "rules": rules_columns(rules),
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
