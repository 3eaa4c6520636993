"""How far a committed plan is built: it follows from the statuses of its markers and is stored nowhere.

Each change of a marker adds an entry to the audit log of its agency. So what was found at an entry holds until the next
one, and lists and map views do not count the same markers again.
"""

from __future__ import annotations

import threading
from typing import NamedTuple

import sqlalchemy as sa

from app.registry import column_types
from app.registry.audit import audit_log
from app.registry.column_types import ID, UtcTime, agency_column, metadata, one_of
from app.registry.marker_rows import markers

plans = sa.Table(
    "plans",
    metadata,
    sa.Column("id", ID, primary_key=True),
    agency_column(),
    sa.Column("alignment_id", ID, sa.ForeignKey("alignments.id"), nullable=False),
    sa.Column("name", sa.String(80), nullable=False),
    sa.Column("status", sa.String(16), nullable=False),
    sa.Column("rules", sa.JSON, nullable=False),
    sa.Column("document_key", sa.String(200), nullable=False),  # of the blob with the placed markers
    sa.Column("summary", sa.JSON, nullable=False),
    sa.Column("proof", sa.JSON(none_as_null=True)),
    sa.Column("author", sa.String(200), nullable=False),
    sa.Column("author_id", sa.String(200), nullable=False),  # holder of the key that made what is to be approved
    sa.Column("approver", sa.String(200)),
    sa.Column("version", sa.Integer, nullable=False),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("updated_at", UtcTime, nullable=False),
    one_of("status", column_types.PLAN_STATUSES),
    sa.UniqueConstraint("agency_id", "name"),
    sa.Index("ix_plans_agency_id_id", "agency_id", "id"),
    sa.Index("ix_plans_alignment_id", "alignment_id"),
)

plan_markers = sa.Table(
    "plan_markers",
    metadata,
    sa.Column("plan_id", ID, sa.ForeignKey("plans.id"), primary_key=True),
    sa.Column("number", sa.Integer, primary_key=True, autoincrement=False),  # of the first of its planned markers
    agency_column(),
    sa.Column("marker_id", ID, sa.ForeignKey("markers.id"), nullable=False),
    sa.Index("ix_plan_markers_marker_id", "marker_id"),
)

COMMITTED, BUILT, SURVEYED = "committed", "built", "surveyed"
_MAX_KNOWN = 4096  # agencies whose states are kept; source: as extents of collections (services/markers/features.py)
_KNOWN: dict[str, tuple[str, PlanStates]] = {}
_LOCK = threading.Lock()


class PlanStates(NamedTuple):
    """An agency's committed plans whose markers are all built, but not all surveyed; and those with all surveyed."""

    built: frozenset[str] = frozenset()
    surveyed: frozenset[str] = frozenset()

    def status_of(self, plan_id: str, stored: str) -> str:
        """Status of a plan."""
        if stored != COMMITTED:
            return stored
        return BUILT if plan_id in self.built else SURVEYED if plan_id in self.surveyed else COMMITTED


def find_plan_states(connection: sa.Connection, agency_id: str) -> PlanStates:
    """States of the agency's committed plans.

    A plan is built when none of its markers is planned any more, and surveyed when all of them are surveyed, active or
    suspect. Retired markers do not count; a plan with no others stays committed.
    """
    c = audit_log.c
    head = sa.select(c.hash).where(c.agency_id == agency_id).order_by(c.number.desc()).limit(1)
    hash_ = connection.execute(head).scalar_one_or_none() or ""
    with _LOCK:
        known = _KNOWN.get(agency_id)
    if known is not None and known[0] == hash_:
        return known[1]
    left = sa.func.max(sa.case((markers.c.status == "planned", 2), (markers.c.status == "built", 1), else_=0))
    query = (
        sa.select(plan_markers.c.plan_id, left)
        .join(markers, markers.c.id == plan_markers.c.marker_id)
        .where(plan_markers.c.agency_id == agency_id, markers.c.status != "retired")
        .group_by(plan_markers.c.plan_id)
    )
    found = [(str(plan_id), int(rank)) for plan_id, rank in connection.execute(query)]
    states = PlanStates(*(frozenset(plan for plan, rank in found if rank == wanted) for wanted in (1, 0)))
    with _LOCK:
        if len(_KNOWN) >= _MAX_KNOWN:
            _KNOWN.clear()
        _KNOWN[agency_id] = (hash_, states)
    return states


def has_status(status: str, states: PlanStates) -> sa.ColumnElement[bool]:
    """Plans with a status."""
    match status:
        case "built":
            return plans.c.id.in_(sorted(states.built))
        case "surveyed":
            return plans.c.id.in_(sorted(states.surveyed))
        case "committed":
            return sa.and_(plans.c.status == status, plans.c.id.not_in(sorted(states.built | states.surveyed)))
        case _:
            return plans.c.status == status
