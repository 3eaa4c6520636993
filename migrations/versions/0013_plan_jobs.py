"""Jobs about plans: what a job is about, its steps, and the finished units of proofs."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0013"
down_revision = "0012"
branch_labels = None
depends_on = None

WHOSE = "(SELECT coalesce(current_setting('waymark.agency_id', true), ''))"
KINDS = "('plan', 'proof', 'package')"
_ID = sa.String(length=36)


def upgrade() -> None:
    op.add_column("jobs", sa.Column("subject_id", _ID, nullable=True))
    op.add_column("jobs", sa.Column("steps_done", sa.Integer(), nullable=True))
    op.add_column("jobs", sa.Column("steps_total", sa.Integer(), nullable=True))
    op.create_index("ix_jobs_subject_id", "jobs", ["subject_id"], unique=False)
    op.create_table(
        "proof_units",
        sa.Column("job_id", _ID, nullable=False),
        sa.Column("number", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("agency_id", _ID, nullable=False),
        sa.Column("result", sa.JSON(), nullable=False),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_proof_units_agency_id")),
        sa.ForeignKeyConstraint(["job_id"], ["jobs.id"], name=op.f("fk_proof_units_job_id")),
        sa.PrimaryKeyConstraint("job_id", "number", name=op.f("pk_proof_units")),
    )
    if op.get_bind().dialect.name == "postgresql":
        op.execute("ALTER TABLE proof_units ENABLE ROW LEVEL SECURITY")
        op.execute("ALTER TABLE proof_units FORCE ROW LEVEL SECURITY")
        op.execute(f"CREATE POLICY agency ON proof_units USING (agency_id = {WHOSE} OR {WHOSE} = '*')")


def downgrade() -> None:
    op.drop_table("proof_units")
    op.execute(f"DELETE FROM jobs WHERE kind IN {KINDS}")  # nothing of the older release could run them
    op.drop_index("ix_jobs_subject_id", table_name="jobs")
    for name in ("steps_total", "steps_done", "subject_id"):
        op.drop_column("jobs", name)
