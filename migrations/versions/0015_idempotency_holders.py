"""An Idempotency-Key belongs to the holder of a key, not to the agency.

Responses that were stored before have no known holder: nobody gets them again, and they expire within a day.
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0015"
down_revision = "0014"
branch_labels = None
depends_on = None

TABLE = "idempotency_keys"
KEY = "pk_idempotency_keys"


def upgrade() -> None:
    op.add_column(TABLE, sa.Column("holder_id", sa.String(length=200), nullable=False, server_default=""))
    with op.batch_alter_table(TABLE) as table:
        table.drop_constraint(op.f(KEY), type_="primary")
        table.create_primary_key(op.f(KEY), ["agency_id", "holder_id", "key"])


def downgrade() -> None:
    op.execute(f"DELETE FROM {TABLE} WHERE holder_id <> ''")  # the older release would give them to every holder
    with op.batch_alter_table(TABLE) as table:
        table.drop_constraint(op.f(KEY), type_="primary")
        table.create_primary_key(op.f(KEY), ["agency_id", "key"])
    with op.batch_alter_table(TABLE) as table:
        table.drop_column("holder_id")
