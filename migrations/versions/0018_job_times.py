"""When a job was started; jobs of all kinds are listed together."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0018"
down_revision = "0017"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("jobs", sa.Column("started_at", sa.DateTime(timezone=True), nullable=True))
    op.create_index("ix_jobs_agency_id_id", "jobs", ["agency_id", "id"], unique=False)


def downgrade() -> None:
    op.drop_index("ix_jobs_agency_id_id", table_name="jobs")
    op.drop_column("jobs", "started_at")
