"""Keys of the server's operators, which create agencies over HTTP."""

from __future__ import annotations

from collections.abc import Iterable

import sqlalchemy as sa
from alembic import op

revision = "0026"
down_revision = "0025"
branch_labels = None
depends_on = None

OLDER = ("admin", "planner", "surveyor", "viewer", "vehicle")
OPERATOR = "operator"
TABLE = "api_keys"


def upgrade() -> None:
    _replace_check((*OLDER, OPERATOR))


def downgrade() -> None:
    """The older schema has no such scope: operators' keys are deleted, and the agencies that they created stay."""
    op.execute(sa.delete(sa.table(TABLE, sa.column("scope"))).where(sa.column("scope") == OPERATOR))
    _replace_check(OLDER)


def _replace_check(scopes: Iterable[str]) -> None:
    with op.batch_alter_table(TABLE) as table:
        table.drop_constraint(op.f("ck_api_keys_scope"), type_="check")
        table.create_check_constraint(op.f("ck_api_keys_scope"), f"scope IN ({', '.join(map(repr, scopes))})")
