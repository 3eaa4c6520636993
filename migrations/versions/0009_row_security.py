"""Row level security on PostgreSQL: a transaction sees the rows of its agency (registry/engines.py).

The policies are forced and therefore apply to the owner of the tables too, but never to superusers. A later migration
that adds a table also adds its policy; a test checks this.
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None

# asked once for a statement, not for each row
WHOSE = "(SELECT coalesce(current_setting('waymark.agency_id', true), ''))"

# Conditions that are not known to be leakproof wait until the policy let a row through, and then no index serves them.
# Boxes of places compare four numbers. A superuser runs this once; see docs/access.md.
LEAKPROOF = "ALTER FUNCTION geometry_overlaps(geometry, geometry) LEAKPROOF"


def upgrade() -> None:
    if op.get_bind().dialect.name != "postgresql":
        return
    for table, column in _owned_tables():
        op.execute(f"ALTER TABLE {table} ENABLE ROW LEVEL SECURITY")
        op.execute(f"ALTER TABLE {table} FORCE ROW LEVEL SECURITY")
        op.execute(f"CREATE POLICY agency ON {table} USING ({column} = {WHOSE} OR {WHOSE} = '*')")
    if op.get_bind().execute(sa.text("SELECT rolsuper FROM pg_roles WHERE rolname = current_user")).scalar_one():
        op.execute(LEAKPROOF)


def downgrade() -> None:
    if op.get_bind().dialect.name != "postgresql":
        return
    for table, _column in _owned_tables():
        op.execute(f"DROP POLICY agency ON {table}")
        op.execute(f"ALTER TABLE {table} NO FORCE ROW LEVEL SECURITY")
        op.execute(f"ALTER TABLE {table} DISABLE ROW LEVEL SECURITY")


def _owned_tables() -> list[tuple[str, str]]:
    """Tables of rows that belong to agencies, with the column that contains the agency."""
    query = sa.text(
        "SELECT c.table_name FROM information_schema.columns c JOIN information_schema.tables t"
        " USING (table_schema, table_name)"
        " WHERE c.table_schema = current_schema() AND c.column_name = 'agency_id' AND t.table_type = 'BASE TABLE'"
        " ORDER BY 1"
    )
    return [("agencies", "id"), *((name, "agency_id") for name in op.get_bind().execute(query).scalars())]
