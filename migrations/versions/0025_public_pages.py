"""Public pages: what agencies release, and damage reports with the contacts of those who sent them."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0025"
down_revision = "0024"
branch_labels = None
depends_on = None

WHOSE = "(SELECT coalesce(current_setting('waymark.agency_id', true), ''))"
TABLES = ("public_pages", "damage_reports", "damage_report_contacts")
_ID, _TIME = sa.String(length=36), sa.DateTime(timezone=True)


def upgrade() -> None:
    op.create_table(
        "public_pages",
        sa.Column("agency_id", _ID, nullable=False),
        sa.Column("fields", sa.JSON(), nullable=False),
        sa.Column("damage_reports", sa.Boolean(), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("updated_at", _TIME, nullable=False),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_public_pages_agency_id")),
        sa.PrimaryKeyConstraint("agency_id", name=op.f("pk_public_pages")),
    )
    op.create_table(
        "damage_reports",
        sa.Column("id", _ID, nullable=False),
        sa.Column("agency_id", _ID, nullable=False),
        sa.Column("marker_id", _ID, nullable=False),
        sa.Column("form_nonce", sa.String(length=32), nullable=False),
        sa.Column("kind", sa.String(length=16), nullable=False),
        sa.Column("text", sa.String(length=2000), nullable=True),
        sa.Column("language", sa.String(length=8), nullable=False),
        sa.Column("photo_key", sa.String(length=200), nullable=True),
        sa.Column("photo_bytes", sa.BigInteger(), nullable=True),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("note", sa.String(length=500), nullable=True),
        sa.Column("item_id", _ID, nullable=True),
        sa.Column("decided_by", sa.String(length=200), nullable=True),
        sa.Column("decided_at", _TIME, nullable=True),
        sa.Column("created_at", _TIME, nullable=False),
        sa.CheckConstraint(
            "kind IN ('damaged', 'dirty', 'missing', 'loose', 'other')", name=op.f("ck_damage_reports_kind")
        ),
        sa.CheckConstraint("state IN ('new', 'accepted', 'rejected')", name=op.f("ck_damage_reports_state")),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_damage_reports_agency_id")),
        sa.ForeignKeyConstraint(["marker_id"], ["markers.id"], name=op.f("fk_damage_reports_marker_id")),
        sa.ForeignKeyConstraint(["item_id"], ["maintenance_items.id"], name=op.f("fk_damage_reports_item_id")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_damage_reports")),
        sa.UniqueConstraint("marker_id", "form_nonce", name=op.f("uq_damage_reports_marker_id_form_nonce")),
    )
    for columns in (("agency_id", "id"), ("agency_id", "state", "id"), ("marker_id", "state")):
        op.create_index(f"ix_damage_reports_{'_'.join(columns)}", "damage_reports", list(columns), unique=False)
    op.create_table(
        "damage_report_contacts",
        sa.Column("report_id", _ID, nullable=False),
        sa.Column("agency_id", _ID, nullable=False),
        sa.Column("email", sa.String(length=254), nullable=False),
        sa.Column("created_at", _TIME, nullable=False),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_damage_report_contacts_agency_id")),
        sa.ForeignKeyConstraint(["report_id"], ["damage_reports.id"], name=op.f("fk_damage_report_contacts_report_id")),
        sa.PrimaryKeyConstraint("report_id", name=op.f("pk_damage_report_contacts")),
    )
    op.create_index("ix_damage_report_contacts_created_at", "damage_report_contacts", ["created_at"], unique=False)
    if op.get_bind().dialect.name == "postgresql":
        for table in TABLES:
            op.execute(f"ALTER TABLE {table} ENABLE ROW LEVEL SECURITY")
            op.execute(f"ALTER TABLE {table} FORCE ROW LEVEL SECURITY")
            op.execute(f"CREATE POLICY agency ON {table} USING (agency_id = {WHOSE} OR {WHOSE} = '*')")


def downgrade() -> None:
    for table in reversed(TABLES):
        op.drop_table(table)
