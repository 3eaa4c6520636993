"""Leases on running jobs, whose turn it is, and jobs that stopped their processes: app/registry/jobs.py."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0020"
down_revision = "0019"
branch_labels = None
depends_on = None

UNFINISHED = sa.text("state IN ('queued', 'running')")


def upgrade() -> None:
    op.add_column("jobs", sa.Column("runner", sa.String(length=100), nullable=True))
    op.add_column("jobs", sa.Column("lease_until", sa.DateTime(timezone=True), nullable=True))
    op.add_column("jobs", sa.Column("turn_at", sa.DateTime(timezone=True), nullable=True))
    op.add_column("jobs", sa.Column("dead_letter", sa.Boolean(), server_default=sa.false(), nullable=False))
    op.create_index("ix_jobs_agency_id_kind_turn_at", "jobs", ["agency_id", "kind", "turn_at"], unique=False)
    where = {"postgresql_where": UNFINISHED, "sqlite_where": UNFINISHED}
    op.create_index("ix_jobs_unfinished", "jobs", ["kind", "agency_id", "id"], unique=False, **where)


def downgrade() -> None:
    op.drop_index("ix_jobs_unfinished", table_name="jobs")
    op.drop_index("ix_jobs_agency_id_kind_turn_at", table_name="jobs")
    for name in ("dead_letter", "turn_at", "lease_until", "runner"):
        op.drop_column("jobs", name)
