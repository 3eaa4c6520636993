"""Queries on alignments, plans, and the markers that plans became. All see one agency only."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import NamedTuple

import sqlalchemy as sa

from app.markers.reading import MarkerRow
from app.registry.bulk_load import Columns, load_columns
from app.registry.column_types import ID, UtcTime, agency_column, columns_of, fetch_all, metadata
from app.registry.jobs import UNFINISHED, jobs
from app.registry.marker_rows import MARKERS, markers
from app.registry.markers import MarkerFilter, conditions_of
from app.registry.plan_states import plan_markers, plans
from app.registry.resources import Resource
from app.registry.spatial import Box, within_box
from app.values import JsonObject

alignments = sa.Table(
    "alignments",
    metadata,
    sa.Column("id", ID, primary_key=True),
    agency_column(),
    sa.Column("name", sa.String(80), nullable=False),
    sa.Column("source_key", sa.String(200), nullable=False),  # of the blob with the file as it came
    sa.Column("source_sha256", sa.String(64), nullable=False),
    sa.Column("declaration", sa.JSON, nullable=False),
    sa.Column("summary", sa.JSON, nullable=False),
    sa.Column("version", sa.Integer, nullable=False),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("updated_at", UtcTime, nullable=False),
    sa.UniqueConstraint("agency_id", "name"),
    sa.Index("ix_alignments_agency_id_id", "agency_id", "id"),
)

plan_versions = sa.Table(
    "plan_versions",
    metadata,
    sa.Column("plan_id", ID, sa.ForeignKey("plans.id"), primary_key=True),
    sa.Column("version", sa.Integer, primary_key=True, autoincrement=False),
    agency_column(),
    sa.Column("at", UtcTime, nullable=False),
    sa.Column("who", sa.String(200), nullable=False),
    sa.Column("why", sa.String(500)),
    sa.Column("plan", sa.JSON, nullable=False),
)

proof_units = sa.Table(
    "proof_units",
    metadata,
    sa.Column("job_id", ID, sa.ForeignKey("jobs.id"), primary_key=True),
    sa.Column("number", sa.Integer, primary_key=True, autoincrement=False),  # of the unit among those of the proof
    agency_column(),
    sa.Column("result", sa.JSON, nullable=False),
)

# === Queries on finished units of proofs, from which an interrupted proof goes on.


def add_unit(connection: sa.Connection, agency_id: str, job_id: str, number: int, result: Mapping[str, object]) -> None:
    """Store the result of a unit that is not stored yet."""
    values = {"job_id": job_id, "number": number, "agency_id": agency_id, "result": dict(result)}
    connection.execute(sa.insert(proof_units).values(values))


def list_units(connection: sa.Connection, agency_id: str, job_id: str) -> dict[int, dict[str, object]]:
    """Results of the finished units of a job, by the units' numbers."""
    c = proof_units.c
    query = sa.select(c.number, c.result).where(c.job_id == job_id, c.agency_id == agency_id)
    return {row.number: row.result for row in connection.execute(query)}


def delete_units(connection: sa.Connection, agency_id: str) -> None:
    """Remove the units of all jobs of an agency that have ended."""
    ended = sa.select(jobs.c.id).where(jobs.c.agency_id == agency_id, jobs.c.state.not_in(UNFINISHED))
    c = proof_units.c
    connection.execute(sa.delete(proof_units).where(c.agency_id == agency_id, c.job_id.in_(ended)))


# === Queries on alignments, plans, and the markers that plans became. All see one agency only.


class AlignmentRow(NamedTuple):
    """A road that plans are made for; declaration and summary are JSON."""

    id: str
    name: str
    source_key: str
    source_sha256: str
    declaration: JsonObject
    summary: JsonObject
    version: int
    created_at: datetime
    updated_at: datetime


class PlanRow(NamedTuple):
    """A plan; rules, summary and proof are JSON."""

    id: str
    alignment_id: str
    name: str
    status: str
    rules: dict[str, object]
    document_key: str
    summary: JsonObject
    proof: JsonObject | None
    author: str
    author_id: str
    approver: str | None
    version: int
    created_at: datetime
    updated_at: datetime


class ExistingRow(NamedTuple):
    """A marker of the registry near a plan."""

    id: str
    family: str
    digits: str | None
    lon_deg: float
    lat_deg: float
    status: str


class BuiltRow(NamedTuple):
    """Where a marker of a plan is today."""

    number: int
    marker_id: str
    status: str
    lon_deg: float
    lat_deg: float
    heading_deg: float | None


ALIGNMENTS = Resource("alignment", AlignmentRow, alignments, cure="GET /v1/alignments lists yours")
PLANS = Resource(
    "plan", PlanRow, plans, cure="GET /v1/plans lists yours", versions=plan_versions, unversioned=("summary", "proof")
)


def list_existing(connection: sa.Connection, agency_id: str, box: Box, *, limit: int) -> list[ExistingRow]:
    """Markers of the agency in a box that may be on the road."""
    query = sa.select(*columns_of(ExistingRow, markers)).where(
        markers.c.agency_id == agency_id, markers.c.status != "retired", within_box(box)
    )
    return fetch_all(connection, query.limit(limit), ExistingRow)


def list_for_map(
    connection: sa.Connection, agency_id: str, filtered: MarkerFilter, box: Box, *, limit: int
) -> list[MarkerRow]:
    """Markers of a filter in a box that are planned or on the road, in the order of their ids."""
    query = MARKERS.where(
        markers.c.agency_id == agency_id, markers.c.status != "retired", within_box(box), *conditions_of(filtered)
    )
    return fetch_all(connection, query.order_by(markers.c.id).limit(limit), MarkerRow)


def link_markers(connection: sa.Connection, agency_id: str, plan_id: str, ids: Sequence[tuple[int, str]]) -> None:
    """Store which marker each number of a plan became."""
    numbers, marker_ids = [number for number, _ in ids], [marker_id for _, marker_id in ids]
    same = {"plan_id": plan_id, "agency_id": agency_id}
    load_columns(connection, plan_markers, Columns.of(len(ids), same, {"number": numbers, "marker_id": marker_ids}))


def list_built(connection: sa.Connection, agency_id: str, plan_id: str) -> list[BuiltRow]:
    """The markers of a plan as they are today, by number."""
    own = ("status", "lon_deg", "lat_deg", "heading_deg")
    query = (
        sa.select(plan_markers.c.number, plan_markers.c.marker_id, *(markers.c[name] for name in own))
        .join(markers, markers.c.id == plan_markers.c.marker_id)
        .where(plan_markers.c.plan_id == plan_id, plan_markers.c.agency_id == agency_id)
        .order_by(plan_markers.c.number)
    )
    return fetch_all(connection, query, BuiltRow)
