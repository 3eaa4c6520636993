"""Uploads that arrive in parts, bytes that each key has stored, and size and hash of stored uploads."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0021"
down_revision = "0020"
branch_labels = None
depends_on = None

WHOSE = "(SELECT coalesce(current_setting('waymark.agency_id', true), ''))"
TABLES = ("uploads", "upload_parts", "stored_bytes")
_ID = sa.String(length=36)
_TIME = sa.DateTime(timezone=True)


def upgrade() -> None:
    op.create_table(
        "uploads",
        sa.Column("id", _ID, nullable=False),
        sa.Column("agency_id", _ID, nullable=False),
        sa.Column("holder_id", sa.String(length=200), nullable=False),
        sa.Column("label", sa.String(length=200), nullable=False),
        sa.Column("scope", sa.String(length=16), nullable=False),
        sa.Column("method", sa.String(length=16), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("length", sa.BigInteger(), nullable=False),
        sa.Column("received", sa.BigInteger(), nullable=False),
        sa.Column("declared", sa.JSON(), nullable=False),
        sa.Column("lock_id", _ID, nullable=True),
        sa.Column("locked_until", _TIME, nullable=True),
        sa.Column("store_key", sa.String(length=200), nullable=True),
        sa.Column("store_upload_id", sa.String(length=1024), nullable=True),
        sa.Column("decode_id", _ID, nullable=True),
        sa.Column("error", sa.JSON(), nullable=True),
        sa.Column("created_at", _TIME, nullable=False),
        sa.Column("expires_at", _TIME, nullable=False),
        sa.CheckConstraint("state IN ('open', 'done', 'refused', 'expired')", name=op.f("ck_uploads_state")),
        sa.CheckConstraint("method IN ('tus', 's3-parts')", name=op.f("ck_uploads_method")),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_uploads_agency_id")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_uploads")),
    )
    op.create_index("ix_uploads_agency_id_state", "uploads", ["agency_id", "state"], unique=False)
    op.create_index("ix_uploads_state_expires_at", "uploads", ["state", "expires_at"], unique=False)
    op.create_table(
        "upload_parts",
        sa.Column("upload_id", _ID, nullable=False),
        sa.Column("start", sa.BigInteger(), nullable=False),
        sa.Column("agency_id", _ID, nullable=False),
        sa.Column("size", sa.BigInteger(), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("blob_key", sa.String(length=200), nullable=False),
        sa.ForeignKeyConstraint(["upload_id"], ["uploads.id"], name=op.f("fk_upload_parts_upload_id")),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_upload_parts_agency_id")),
        sa.PrimaryKeyConstraint("upload_id", "start", name=op.f("pk_upload_parts")),
    )
    op.create_table(
        "stored_bytes",
        sa.Column("agency_id", _ID, nullable=False),
        sa.Column("holder_id", sa.String(length=200), nullable=False),
        sa.Column("bytes", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_stored_bytes_agency_id")),
        sa.PrimaryKeyConstraint("agency_id", "holder_id", name=op.f("pk_stored_bytes")),
    )
    op.add_column("decodes", sa.Column("upload_bytes", sa.BigInteger(), nullable=True))
    op.add_column("decodes", sa.Column("upload_sha256", sa.String(length=64), nullable=True))
    if op.get_bind().dialect.name == "postgresql":
        for table in TABLES:
            op.execute(f"ALTER TABLE {table} ENABLE ROW LEVEL SECURITY")
            op.execute(f"ALTER TABLE {table} FORCE ROW LEVEL SECURITY")
            op.execute(f"CREATE POLICY agency ON {table} USING (agency_id = {WHOSE} OR {WHOSE} = '*')")


def downgrade() -> None:
    op.drop_column("decodes", "upload_sha256")
    op.drop_column("decodes", "upload_bytes")
    for table in reversed(TABLES):
        op.drop_table(table)
