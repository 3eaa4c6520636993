"""Keys with scopes, rotation and rate limits; row level security on PostgreSQL."""

from __future__ import annotations

from collections.abc import Iterable

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None

SCOPES = ("admin", "planner", "surveyor", "viewer", "vehicle")
# what a key could do it still can, but that vehicles no longer read the registry
NEW_SCOPES = {"read": "viewer", "decode": "vehicle", "write": "planner", "admin": "admin"}
# back to the older code: a surveyor may less there than here, a vehicle more (nothing less than that could upload)
OLD_SCOPES = {"viewer": "read", "vehicle": "decode", "surveyor": "decode", "planner": "write", "admin": "admin"}


def upgrade() -> None:
    _change_scopes(NEW_SCOPES)
    with op.batch_alter_table("api_keys") as table:
        table.add_column(sa.Column("holder_id", sa.String(length=36), nullable=True))
    op.execute("UPDATE api_keys SET holder_id = id")
    with op.batch_alter_table("api_keys") as table:
        table.alter_column("holder_id", existing_type=sa.String(length=36), nullable=False)
        table.create_check_constraint(op.f("ck_api_keys_scope"), _in(SCOPES))
    op.add_column("decodes", sa.Column("holder_id", sa.String(length=200), nullable=True))


def downgrade() -> None:
    op.drop_column("decodes", "holder_id")
    _change_scopes(OLD_SCOPES)
    with op.batch_alter_table("api_keys") as table:
        table.drop_column("holder_id")
        table.create_check_constraint(op.f("ck_api_keys_scope"), _in(NEW_SCOPES))


def _change_scopes(new_names: dict[str, str]) -> None:
    """Rename the scopes of all keys, and drop the check constraint on them."""
    with op.batch_alter_table("api_keys") as table:
        table.drop_constraint(op.f("ck_api_keys_scope"), type_="check")
    cases = " ".join(f"WHEN '{old}' THEN '{new}'" for old, new in new_names.items())
    op.execute(f"UPDATE api_keys SET scope = CASE scope {cases} END")


def _in(scopes: Iterable[str]) -> str:
    return f"scope IN ({', '.join(map(repr, scopes))})"
