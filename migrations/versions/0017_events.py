"""Events that are sent to those who subscribe to them: app/registry/webhooks.py."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0017"
down_revision = "0016"
branch_labels = None
depends_on = None

WHOSE = "(SELECT coalesce(current_setting('waymark.agency_id', true), ''))"
_ID = sa.String(length=36)


def upgrade() -> None:
    op.create_table(
        "events",
        sa.Column("id", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), autoincrement=True, nullable=False),
        sa.Column("agency_id", _ID, nullable=False),
        sa.Column("kind", sa.String(length=40), nullable=False),
        sa.Column("subject_id", sa.String(length=200), nullable=True),
        sa.Column("at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("detail", sa.JSON(), nullable=True),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_events_agency_id")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_events")),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_events_agency_id_id", "events", ["agency_id", "id"], unique=False)
    if op.get_bind().dialect.name == "postgresql":
        op.execute("ALTER TABLE events ENABLE ROW LEVEL SECURITY")
        op.execute("ALTER TABLE events FORCE ROW LEVEL SECURITY")
        op.execute(f"CREATE POLICY agency ON events USING (agency_id = {WHOSE} OR {WHOSE} = '*')")


def downgrade() -> None:
    op.drop_table("events")
