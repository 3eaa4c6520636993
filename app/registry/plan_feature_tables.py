"""Tables of what GIS clients read of alignments and plans: lanes, and markers that are planned in plans.

Both are copies of what the blobs of alignments and plans contain, written in the same transaction.
"""

from __future__ import annotations

import sqlalchemy as sa

from app.registry.column_types import ID, agency_column
from app.registry.metadata import metadata

FEATURE_ID = sa.String(48)
"""Id of an alignment or a plan, a point, and a number of five or seven digits, so that texts are in its order."""

alignment_lanes = sa.Table(
    "alignment_lanes",
    metadata,
    sa.Column("id", FEATURE_ID, primary_key=True),
    agency_column(),
    sa.Column("alignment_id", ID, sa.ForeignKey("alignments.id"), nullable=False),
    sa.Column("west_deg", sa.Double, nullable=False),
    sa.Column("south_deg", sa.Double, nullable=False),
    sa.Column("east_deg", sa.Double, nullable=False),
    sa.Column("north_deg", sa.Double, nullable=False),
    sa.Column("properties", sa.JSON, nullable=False),
    sa.Column("points_deg", sa.JSON, nullable=False),
    sa.Index("ix_alignment_lanes_agency_id_id", "agency_id", "id"),
)

planned_markers = sa.Table(
    "planned_markers",
    metadata,
    # the integer key is what the spatial index refers to
    sa.Column("row", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), primary_key=True, autoincrement=True),
    sa.Column("id", FEATURE_ID, nullable=False, unique=True),
    agency_column(),
    sa.Column("plan_id", ID, sa.ForeignKey("plans.id"), nullable=False),
    sa.Column("number", sa.Integer, nullable=False),
    sa.Column("family", sa.String(16), nullable=False),
    sa.Column("code", sa.String(64), nullable=False),
    sa.Column("purpose", sa.String(32), nullable=False),
    sa.Column("lane", sa.Text, nullable=False),
    sa.Column("side", sa.String(16)),
    sa.Column("chainage_m", sa.Double, nullable=False),
    sa.Column("station_m", sa.Double, nullable=False),
    sa.Column("offset_m", sa.Double, nullable=False),
    sa.Column("heading_deg", sa.Double, nullable=False),
    sa.Column("vertical_datum", sa.String(64)),
    sa.Column("lon_deg", sa.Double, nullable=False),
    sa.Column("lat_deg", sa.Double, nullable=False),
    sa.Column("height_m", sa.Double),
    # the feature between its id and what follows from the plan: registry/features_of_plans.py
    sa.Column("feature", sa.Text, nullable=False),
    sa.Index("ix_planned_markers_agency_id_id", "agency_id", "id"),
    sa.Index("ix_planned_markers_plan_id", "plan_id"),
    sqlite_autoincrement=True,
)
