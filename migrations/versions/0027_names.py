"""One word for a concept and one suffix for a unit, in columns, in values and in the names of stored JSON.

What people decide about is approved or rejected, and has a status; what the server carries out has a state. Speeds end
in m_s or kmh, accelerations in m_s2, curvatures in per_m. The name of a recording's file is a member of its context, as
that of a picture is, and what a drive's job needs to know of its decodes has the names of the request. Entries of the
audit log and versions of markers keep the names of their time: hashes cover them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0027"
down_revision = "0026"
branch_labels = None
depends_on = None

COLUMNS = (
    ("maintenance_items", "state", "status"),
    ("damage_reports", "state", "status"),
    ("reprocessings", "accepted_at", "approved_at"),
    ("reprocessings", "accepted_by", "approved_by"),
)
VALUES = {"maintenance_items": ("dismissed", "rejected"), "damage_reports": ("accepted", "approved")}
CHOICES = {
    "maintenance_items": ("open", "approved", "dismissed"),
    "damage_reports": ("new", "accepted", "rejected"),
}
INDEXES = (
    ("maintenance_items", ("agency_id", "state", "priority", "id")),
    ("damage_reports", ("agency_id", "state", "id")),
    ("damage_reports", ("marker_id", "state")),
)
NAMES = {
    "speed_mps": "speed_m_s",
    "quantum_mps": "quantum_m_s",
    "design_speed_mps": "design_speed_m_s",
    "deceleration_mps2": "deceleration_m_s2",
    "speed_limit_km_h": "speed_limit_kmh",
    "speed_limits_km_h": "speed_limits_kmh",
    "speed_km_h": "speed_kmh",
    "curvature_1pm": "curvature_per_m",
    "believed_m": "assumed_m",
}
DOCUMENTS = {
    "codebooks": ("design", "rules", "figures"),
    "decode_versions": ("result",),
    "decodes": ("context", "result"),
    "jobs": ("input", "result"),
    "plan_versions": ("plan",),
    "plans": ("rules", "summary"),
    "reprocessed_decodes": ("result",),
    "uploads": ("declared",),
    "vehicle_versions": ("vehicle",),
    "vehicles": ("profile",),
}

RECORDINGS = ("trace", "packets")
OF_DRIVES = {"decode_id": "id", "sigma_s": "clock_sigma_s"}
CHUNK = 1000


def upgrade() -> None:
    for table, columns in INDEXES:
        op.drop_index(f"ix_{table}_{'_'.join(columns)}", table)
    for table, old, new in COLUMNS:
        op.execute(f"ALTER TABLE {table} RENAME COLUMN {old} TO {new}")
    for table, (old, new) in VALUES.items():
        choices = CHOICES[table]
        _choose(table, ("state", choices), ("status", tuple(new if one == old else one for one in choices)))
    for table, columns in INDEXES:
        columns = tuple("status" if name == "state" else name for name in columns)
        op.create_index(f"ix_{table}_{'_'.join(columns)}", table, list(columns), unique=False)
    _rename(NAMES)
    _rewrite("decodes", "context", RECORDINGS, _lift_file_name)
    _rewrite("jobs", "input", ("drive",), lambda _kind, document: _rename_decodes(document, OF_DRIVES))


def downgrade() -> None:
    former = {new: old for old, new in OF_DRIVES.items()}
    _rewrite("jobs", "input", ("drive",), lambda _kind, document: _rename_decodes(document, former))
    _rewrite("decodes", "context", RECORDINGS, _lower_file_name)
    _rename({new: old for old, new in NAMES.items()})
    for table, columns in INDEXES:
        op.drop_index(f"ix_{table}_{'_'.join(columns).replace('state', 'status')}", table)
    for table, (old, new) in VALUES.items():
        choices = CHOICES[table]
        _choose(table, ("status", tuple(new if one == old else one for one in choices)), ("state", choices))
    for table, old, new in COLUMNS:
        op.execute(f"ALTER TABLE {table} RENAME COLUMN {new} TO {old}")
    for table, columns in INDEXES:
        op.create_index(f"ix_{table}_{'_'.join(columns)}", table, list(columns), unique=False)


def _choose(table: str, before: tuple[str, tuple[str, ...]], after: tuple[str, tuple[str, ...]]) -> None:
    """Other values of a column that one_of() declares; the column has its name of `status` already.

    SQLite cannot change a constraint. Copying the table, as Alembic does, would break the references to it; the text of
    the schema is changed instead, which is what SQLite's documentation of ALTER TABLE recommends for CHECK constraints.
    """
    values = {one: other for one, other in zip(before[1], after[1], strict=True) if one != other}
    was, becomes = (f"ck_{table}_{name}" for name, _ in (before, after))
    check = f"status IN ({', '.join(map(repr, after[1]))})"
    connection = op.get_bind()
    if connection.dialect.name == "postgresql":
        op.drop_constraint(op.f(was), table, type_="check")
    else:
        former = f"CONSTRAINT {was} CHECK (%s IN ({', '.join(map(repr, before[1]))}))"
        query = sa.text("SELECT sql FROM sqlite_schema WHERE type = 'table' AND name = :table")
        sql = str(connection.execute(query, {"table": table}).scalar_one())
        for name in ("status", '"status"'):  # SQLite quotes the name of a column that it renamed
            sql = sql.replace(former % name, f"CONSTRAINT {becomes} CHECK ({check})")
        if becomes not in sql:
            raise RuntimeError(f"the schema of {table} is not as migration 0026 left it")
        version = connection.exec_driver_sql("PRAGMA schema_version").scalar_one()
        connection.exec_driver_sql("PRAGMA writable_schema = ON")
        change = sa.text("UPDATE sqlite_schema SET sql = :sql WHERE type = 'table' AND name = :table")
        connection.execute(change, {"sql": sql, "table": table})
        connection.exec_driver_sql(f"PRAGMA schema_version = {version + 1}")
        connection.exec_driver_sql("PRAGMA writable_schema = RESET")
    for old, new in values.items():
        op.execute(f"UPDATE {table} SET status = '{new}' WHERE status = '{old}'")
        if table == "maintenance_items":
            op.execute(
                f"""UPDATE {table} SET feature = replace(feature, '"status":"{old}"', '"status":"{new}"')"""
                f" WHERE status = '{new}'"
            )
    if connection.dialect.name == "postgresql":
        op.create_check_constraint(op.f(becomes), table, check)


def _rename(names: Mapping[str, str]) -> None:
    """Other names of members, in every stored document that may have them."""
    postgresql = op.get_bind().dialect.name == "postgresql"
    for table, columns in DOCUMENTS.items():
        for column in columns:
            text = f"{column}::text" if postgresql else column
            changed = text
            for old, new in names.items():
                changed = f"""replace({changed}, '"{old}"', '"{new}"')"""
            if postgresql:
                changed = f"({changed})::json"
            found = " OR ".join(f"""{text} LIKE '%"{old}"%' """ for old in names)
            op.execute(sa.text(f"UPDATE {table} SET {column} = {changed} WHERE {found}"))


def _rewrite(
    table: str, column: str, kinds: tuple[str, ...], change: Callable[[str, dict[str, Any]], dict[str, Any]]
) -> None:
    """Change the documents of rows of some kinds, a part of the table after the other."""
    connection, last = op.get_bind(), ""
    rows = sa.table(table, sa.column("id"), sa.column("kind"), sa.column(column, sa.JSON))
    of_kinds = sa.select(rows).where(rows.c.kind.in_(kinds)).order_by(rows.c.id).limit(CHUNK)
    while found := connection.execute(of_kinds.where(rows.c.id > last)).mappings().all():
        for row in found:
            if (changed := change(row["kind"], row[column])) != row[column]:
                connection.execute(sa.update(rows).where(rows.c.id == row["id"]).values({column: changed}))
        last = found[-1]["id"]


def _lift_file_name(kind: str, context: dict[str, Any]) -> dict[str, Any]:
    part = dict(context.get(kind) or {})
    name = part.pop("file_name", None)
    return context if name is None else {**context, kind: part, "file_name": name}


def _lower_file_name(kind: str, context: dict[str, Any]) -> dict[str, Any]:
    above = {name: value for name, value in context.items() if name != "file_name"}
    return (
        {**above, kind: {**(context.get(kind) or {}), "file_name": context["file_name"]}} if above != context else above
    )


def _rename_decodes(job_input: dict[str, Any], names: Mapping[str, str]) -> dict[str, Any]:
    decodes = [{names.get(name, name): value for name, value in one.items()} for one in job_input.get("decodes", ())]
    return {**job_input, "decodes": decodes} if decodes else job_input
