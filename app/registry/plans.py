"""Queries on alignments, plans, and the markers that plans became. All see one agency only."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from typing import Any, NamedTuple

import sqlalchemy as sa

from app.registry.bulk_load import load_columns
from app.registry.columns import Columns
from app.registry.marker_rows import MARKERS, MarkerRow
from app.registry.markers import MarkerFilter, conditions_of
from app.registry.resources import Resource
from app.registry.rows import columns_of, fetch_all
from app.registry.spatial import Box, within_box
from app.registry.tables import alignments, markers, plan_markers, plan_versions, plans


class AlignmentRow(NamedTuple):
    """A road that plans are made for; declaration and summary are JSON."""

    id: str
    name: str
    source_key: str
    source_sha256: str
    declaration: dict[str, Any]
    summary: dict[str, Any]
    version: int
    created_at: datetime
    updated_at: datetime


class PlanRow(NamedTuple):
    """A plan; rules, summary and proof are JSON."""

    id: str
    alignment_id: str
    name: str
    status: str
    rules: dict[str, Any]
    document_key: str
    summary: dict[str, Any]
    proof: dict[str, Any] | None
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
