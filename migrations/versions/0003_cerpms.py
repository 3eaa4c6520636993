"""CERPMs: numbers that are unique in an agency, secret keys of agencies, and received transmissions."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_index(
        "uq_markers_cerpm_number",
        "markers",
        ["agency_id", "digits"],
        unique=True,
        sqlite_where=sa.text("family = 'cerpm'"),
        postgresql_where=sa.text("family = 'cerpm'"),
    )
    op.create_table(
        "agency_secrets",
        sa.Column("agency_id", sa.String(length=36), nullable=False),
        sa.Column("wrapped", sa.LargeBinary(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_agency_secrets_agency_id")),
        sa.PrimaryKeyConstraint("agency_id", name=op.f("pk_agency_secrets")),
    )
    op.create_table(
        "cerpm_spans",
        sa.Column("row", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), autoincrement=True, nullable=False),
        sa.Column("agency_id", sa.String(length=36), nullable=False),
        sa.Column("number", sa.BigInteger(), nullable=False),
        sa.Column("first_sequence", sa.BigInteger(), nullable=False),
        sa.Column("last_sequence", sa.BigInteger(), nullable=False),
        sa.Column("first_heard_s", sa.Double(), nullable=True),
        sa.Column("last_heard_s", sa.Double(), nullable=True),
        sa.Column("decode_id", sa.String(length=36), nullable=False),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_cerpm_spans_agency_id")),
        sa.ForeignKeyConstraint(["decode_id"], ["decodes.id"], name=op.f("fk_cerpm_spans_decode_id")),
        sa.PrimaryKeyConstraint("row", name=op.f("pk_cerpm_spans")),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_cerpm_spans_agency_id_number", "cerpm_spans", ["agency_id", "number"], unique=False)


def downgrade() -> None:
    op.drop_table("cerpm_spans")
    op.drop_table("agency_secrets")
    # the code of 0002 knows no CERPMs
    for table in ("observations", "marker_versions"):
        op.execute(f"DELETE FROM {table} WHERE marker_id IN (SELECT id FROM markers WHERE family = 'cerpm')")
    op.execute("DELETE FROM markers WHERE family = 'cerpm'")
    op.drop_index("uq_markers_cerpm_number", table_name="markers")
