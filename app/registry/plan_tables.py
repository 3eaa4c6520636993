"""Tables of alignments, of plans with their history and markers, and of finished units of proofs."""

from __future__ import annotations

import sqlalchemy as sa

from app.registry import column_types
from app.registry.column_types import ID, UtcTime, agency_column, one_of
from app.registry.metadata import metadata

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

plan_markers = sa.Table(
    "plan_markers",
    metadata,
    sa.Column("plan_id", ID, sa.ForeignKey("plans.id"), primary_key=True),
    sa.Column("number", sa.Integer, primary_key=True, autoincrement=False),  # of the first of its planned markers
    agency_column(),
    sa.Column("marker_id", ID, sa.ForeignKey("markers.id"), nullable=False),
    sa.Index("ix_plan_markers_marker_id", "marker_id"),
)

proof_units = sa.Table(
    "proof_units",
    metadata,
    sa.Column("job_id", ID, sa.ForeignKey("jobs.id"), primary_key=True),
    sa.Column("number", sa.Integer, primary_key=True, autoincrement=False),  # of the unit among those of the proof
    agency_column(),
    sa.Column("result", sa.JSON, nullable=False),
)
