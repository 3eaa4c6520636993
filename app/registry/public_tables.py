"""Tables of public pages: what agencies release, and the damage reports that come from the pages."""

from __future__ import annotations

import sqlalchemy as sa

from app.registry.column_types import ID, UtcTime, agency_column, one_of
from app.registry.metadata import metadata

REPORT_KINDS = ("damaged", "dirty", "missing", "loose", "other")
REPORT_STATES = ("new", "accepted", "rejected")

# what an agency releases; without a row, `app.registry.public_pages.DEFAULT`
public_pages = sa.Table(
    "public_pages",
    metadata,
    sa.Column("agency_id", ID, sa.ForeignKey("agencies.id"), primary_key=True),
    sa.Column("fields", sa.JSON, nullable=False),
    sa.Column("damage_reports", sa.Boolean, nullable=False),
    sa.Column("version", sa.Integer, nullable=False),
    sa.Column("updated_at", UtcTime, nullable=False),
)

damage_reports = sa.Table(
    "damage_reports",
    metadata,
    sa.Column("id", ID, primary_key=True),
    agency_column(),
    sa.Column("marker_id", ID, sa.ForeignKey("markers.id"), nullable=False),
    sa.Column("form_nonce", sa.String(32), nullable=False),  # of the form: one that is sent twice is one report
    sa.Column("kind", sa.String(16), nullable=False),
    sa.Column("text", sa.String(2000)),
    sa.Column("language", sa.String(8), nullable=False),
    sa.Column("photo_key", sa.String(200)),
    sa.Column("photo_bytes", sa.BigInteger),
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("note", sa.String(500)),
    sa.Column("item_id", ID, sa.ForeignKey("maintenance_items.id")),  # that the report was accepted into
    sa.Column("decided_by", sa.String(200)),
    sa.Column("decided_at", UtcTime),
    sa.Column("created_at", UtcTime, nullable=False),
    one_of("kind", REPORT_KINDS),
    one_of("state", REPORT_STATES),
    sa.UniqueConstraint("marker_id", "form_nonce"),
    sa.Index("ix_damage_reports_agency_id_id", "agency_id", "id"),
    sa.Index("ix_damage_reports_agency_id_state_id", "agency_id", "state", "id"),
    sa.Index("ix_damage_reports_marker_id_state", "marker_id", "state"),
)

# apart from the reports, so that it can be deleted without them
damage_report_contacts = sa.Table(
    "damage_report_contacts",
    metadata,
    sa.Column("report_id", ID, sa.ForeignKey("damage_reports.id"), primary_key=True),
    agency_column(),
    sa.Column("email", sa.String(254), nullable=False),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Index("ix_damage_report_contacts_created_at", "created_at"),
)
