"""The decoder of each result, reprocessings, and the results that they replaced."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0022"
down_revision = "0021"
branch_labels = None
depends_on = None

WHOSE = "(SELECT coalesce(current_setting('waymark.agency_id', true), ''))"
TABLES = ("reprocessings", "reprocessed_decodes", "decode_versions")
_ID = sa.String(length=36)
_TIME = sa.DateTime(timezone=True)


def upgrade() -> None:
    postgresql = op.get_bind().dialect.name == "postgresql"
    op.add_column("decodes", sa.Column("decoder", sa.String(length=200), nullable=True))
    decoder = "result->>'decoder'" if postgresql else "json_extract(result, '$.decoder')"
    op.execute(f"UPDATE decodes SET decoder = {decoder} WHERE result IS NOT NULL")
    op.create_table(
        "reprocessings",
        sa.Column("id", _ID, nullable=False),
        sa.Column("agency_id", _ID, nullable=False),
        sa.Column("who", sa.String(length=200), nullable=False),
        sa.Column("criteria", sa.JSON(), nullable=False),
        sa.Column("decodes", sa.Integer(), nullable=False),
        sa.Column("created_at", _TIME, nullable=False),
        sa.Column("accepted_at", _TIME, nullable=True),
        sa.Column("accepted_by", sa.String(length=200), nullable=True),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_reprocessings_agency_id")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_reprocessings")),
    )
    op.create_index("ix_reprocessings_agency_id_id", "reprocessings", ["agency_id", "id"], unique=False)
    op.create_table(
        "reprocessed_decodes",
        sa.Column("reprocessing_id", _ID, nullable=False),
        sa.Column("decode_id", _ID, nullable=False),
        sa.Column("agency_id", _ID, nullable=False),
        sa.Column("decoder_before", sa.String(length=200), nullable=True),
        sa.Column("decoder", sa.String(length=200), nullable=True),
        sa.Column("result", sa.JSON(), nullable=True),
        sa.Column("picture_key", sa.String(length=200), nullable=True),
        sa.Column("error", sa.JSON(), nullable=True),
        sa.Column("changes", sa.JSON(), nullable=False),
        sa.Column("gained", sa.Integer(), nullable=False),
        sa.Column("lost", sa.Integer(), nullable=False),
        sa.Column("changed", sa.Integer(), nullable=False),
        sa.Column("same", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_reprocessed_decodes_agency_id")),
        sa.ForeignKeyConstraint(["decode_id"], ["decodes.id"], name=op.f("fk_reprocessed_decodes_decode_id")),
        sa.ForeignKeyConstraint(
            ["reprocessing_id"], ["reprocessings.id"], name=op.f("fk_reprocessed_decodes_reprocessing_id")
        ),
        sa.PrimaryKeyConstraint("reprocessing_id", "decode_id", name=op.f("pk_reprocessed_decodes")),
    )
    op.create_table(
        "decode_versions",
        sa.Column("decode_id", _ID, nullable=False),
        sa.Column("reprocessing_id", _ID, nullable=False),
        sa.Column("agency_id", _ID, nullable=False),
        sa.Column("decoder", sa.String(length=200), nullable=True),
        sa.Column("result", sa.JSON(), nullable=False),
        sa.Column("picture_key", sa.String(length=200), nullable=True),
        sa.Column("finished_at", _TIME, nullable=True),
        sa.Column("replaced_at", _TIME, nullable=False),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_decode_versions_agency_id")),
        sa.ForeignKeyConstraint(["decode_id"], ["decodes.id"], name=op.f("fk_decode_versions_decode_id")),
        sa.ForeignKeyConstraint(
            ["reprocessing_id"], ["reprocessings.id"], name=op.f("fk_decode_versions_reprocessing_id")
        ),
        sa.PrimaryKeyConstraint("decode_id", "reprocessing_id", name=op.f("pk_decode_versions")),
    )
    if postgresql:
        for table in TABLES:
            op.execute(f"ALTER TABLE {table} ENABLE ROW LEVEL SECURITY")
            op.execute(f"ALTER TABLE {table} FORCE ROW LEVEL SECURITY")
            op.execute(f"CREATE POLICY agency ON {table} USING (agency_id = {WHOSE} OR {WHOSE} = '*')")


def downgrade() -> None:
    for table in reversed(TABLES):
        op.drop_table(table)
    op.execute("DELETE FROM jobs WHERE kind = 'reprocess'")  # nothing of the older release could run them
    op.drop_column("decodes", "decoder")
