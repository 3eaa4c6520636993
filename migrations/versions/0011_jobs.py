"""Jobs in a table of their own; stored documents with the fields' new names, and readings with their family.

A decode that was queued keeps its row and its id, and gets a job of the same id, which has its state, its progress and
its error from now on. A queued import was a row of `decodes` too; it becomes a job and nothing else.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None

STATES = ("queued", "running", "done", "failed", "cancelled")
WHOSE = "(SELECT coalesce(current_setting('waymark.agency_id', true), ''))"
_ID = sa.String(length=36)
_TIME = sa.DateTime(timezone=True)
_DOCUMENT = sa.JSON(none_as_null=True)
_KEY = sa.String(length=200)
_TEMPORARY_INDEX = "ix_cerpm_spans_decode_id"

# what both schemas know of a decode, and what only the older one does
KEPT = (
    ("id", _ID, False), ("agency_id", _ID, False), ("kind", sa.String(length=32), False), ("holder_id", _KEY, True),
    ("context", sa.JSON(), False), ("upload_key", _KEY, True), ("picture_key", _KEY, True),
    ("result", _DOCUMENT, True), ("created_at", _TIME, False), ("finished_at", _TIME, True),
)  # fmt: skip
OF_JOBS = ("state", "attempts", "progress", "cancel_requested", "error")

jobs = sa.table(
    "jobs",
    *(sa.column(name, kind) for name, kind, _ in KEPT if name not in ("context", "picture_key")),
    sa.column("input", sa.JSON()),
    sa.column("state", sa.String), sa.column("attempts", sa.Integer), sa.column("progress", sa.Double),
    sa.column("cancel_requested", sa.Boolean), sa.column("error", _DOCUMENT),
)  # fmt: skip
decodes = sa.table(
    "decodes",
    *(sa.column(name, kind) for name, kind, _ in KEPT),
    sa.column("state", sa.String), sa.column("attempts", sa.Integer), sa.column("progress", sa.Double),
    sa.column("cancel_requested", sa.Boolean), sa.column("error", _DOCUMENT),
)  # fmt: skip

# table, its key, the column of documents, the place in them, and the older and the newer name of a member there
_LANE = ("most_strays", "max_outlier_ratio")
_FRESHNESS = ("least_interval_s", "min_interval_s")
RENAMED: tuple[tuple[str, tuple[str, ...], str, tuple[str, ...], tuple[str, str]], ...] = (
    ("decodes", ("id",), "result", ("lane",), ("doubts", "localization_warnings")),
    ("decodes", ("id",), "context", ("packets", "lane"), _LANE),
    ("decodes", ("id",), "context", ("packets", "freshness"), _FRESHNESS),
    ("vehicles", ("id",), "profile", ("packets", "lane"), _LANE),
    ("vehicles", ("id",), "profile", ("packets", "freshness"), _FRESHNESS),
    ("vehicle_versions", ("vehicle_id", "version"), "vehicle", ("profile", "packets", "lane"), _LANE),
    ("vehicle_versions", ("vehicle_id", "version"), "vehicle", ("profile", "packets", "freshness"), _FRESHNESS),
    ("codebooks", ("id",), "figures", (), ("told_apart", "distinguishable")),
)


def _names(table: sa.TableClause) -> list[str]:
    return [column.name for column in table.c]


def upgrade() -> None:
    _create_jobs()
    _move_to_jobs()
    if op.get_bind().dialect.name == "sqlite":
        with _rebuilt_decodes() as before:
            _create_decodes(older=False)
            _copy_decodes(before)
    else:
        op.execute("DELETE FROM decodes WHERE kind = 'import'")
        op.execute("UPDATE decodes SET finished_at = NULL WHERE result IS NULL")
        op.drop_index("ix_decodes_state", table_name="decodes")
        op.drop_constraint(op.f("ck_decodes_state"), "decodes", type_="check")
        for name in OF_JOBS:
            op.drop_column("decodes", name)
    for renamed in RENAMED:
        _rename(*renamed)
    _change_readings(lambda reading: {"family": "plate", **reading})


def downgrade() -> None:
    _change_readings(lambda reading: {name: value for name, value in reading.items() if name != "family"})
    for table, key, column, place, (old, new) in RENAMED:
        _rename(table, key, column, place, (new, old))
    if op.get_bind().dialect.name == "sqlite":
        with _rebuilt_decodes() as before:
            _create_decodes(older=True)
            _restore_decodes(before)
    else:
        for column in _columns_of_jobs(nullable=True):
            op.add_column("decodes", column)
        _fill_from_jobs()
        for column in _columns_of_jobs(nullable=True):
            if column.name != "error":
                op.alter_column("decodes", column.name, nullable=False)
        op.create_check_constraint(op.f("ck_decodes_state"), "decodes", _one_of_states())
        op.create_index("ix_decodes_state", "decodes", ["state"])
    _move_imports_back()
    op.drop_table("jobs")


def _create_jobs() -> None:
    op.create_table(
        "jobs",
        sa.Column("id", _ID, nullable=False),
        sa.Column("agency_id", _ID, nullable=False),
        sa.Column("holder_id", _KEY, nullable=True),
        sa.Column("kind", sa.String(length=32), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("attempts", sa.Integer(), server_default="0", nullable=False),
        sa.Column("progress", sa.Double(), server_default="0", nullable=False),
        sa.Column("cancel_requested", sa.Boolean(), server_default=sa.false(), nullable=False),
        sa.Column("input", sa.JSON(), nullable=False),
        sa.Column("upload_key", _KEY, nullable=True),
        sa.Column("result", _DOCUMENT, nullable=True),
        sa.Column("error", _DOCUMENT, nullable=True),
        sa.Column("created_at", _TIME, nullable=False),
        sa.Column("finished_at", _TIME, nullable=True),
        sa.CheckConstraint(_one_of_states(), name=op.f("ck_jobs_state")),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_jobs_agency_id")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_jobs")),
    )
    op.create_index("ix_jobs_agency_id_kind_id", "jobs", ["agency_id", "kind", "id"])
    op.create_index("ix_jobs_state", "jobs", ["state"])
    if op.get_bind().dialect.name == "postgresql":  # as 0009 did for the tables of its time
        op.execute("ALTER TABLE jobs ENABLE ROW LEVEL SECURITY")
        op.execute("ALTER TABLE jobs FORCE ROW LEVEL SECURITY")
        op.execute(f"CREATE POLICY agency ON jobs USING (agency_id = {WHOSE} OR {WHOSE} = '*')")


def _move_to_jobs() -> None:
    """Imports with all their columns, and the state of queued decodes: immediate ones are done at the first attempt."""
    imports, queued = decodes.c.kind == "import", decodes.c.kind != "import"
    queued &= (decodes.c.kind == "archive") | (decodes.c.state != "done") | (decodes.c.attempts > 1)
    empty, none = sa.literal({}, sa.JSON()), sa.null()
    for chosen, values in (
        (imports, {"kind": sa.literal("import"), "input": decodes.c.context}),
        (queued, {"kind": sa.literal("decode"), "input": empty, "upload_key": none, "result": none}),
    ):
        columns = [values[name] if name in values else decodes.c[name] for name in _names(jobs)]
        op.get_bind().execute(sa.insert(jobs).from_select(_names(jobs), sa.select(*columns).where(chosen)))


def _move_imports_back() -> None:
    values = {"context": jobs.c.input, "picture_key": sa.null()}
    columns = [values[name] if name in values else jobs.c[name] for name in _names(decodes)]
    query = sa.select(*columns).where(jobs.c.kind == "import")
    op.get_bind().execute(sa.insert(decodes).from_select(_names(decodes), query))


# --- the table of decodes ---------------------------------------------------------------------------------------------


def _columns_of_jobs(*, nullable: bool) -> list[sa.Column[Any]]:
    return [
        sa.Column("state", sa.String(length=16), nullable=nullable),
        sa.Column("attempts", sa.Integer(), server_default="0", nullable=nullable),
        sa.Column("progress", sa.Double(), server_default="0", nullable=nullable),
        sa.Column("cancel_requested", sa.Boolean(), server_default=sa.false(), nullable=nullable),
        sa.Column("error", _DOCUMENT, nullable=True),
    ]


def _one_of_states() -> str:
    return f"state IN ({', '.join(map(repr, STATES))})"


def _fill_from_jobs() -> None:
    """Give each decode the state of its job; one without is done. PostgreSQL only."""
    op.execute(
        "UPDATE decodes d SET state = coalesce(j.state, 'done'), attempts = coalesce(j.attempts, 1),"
        " progress = coalesce(j.progress, 1), cancel_requested = coalesce(j.cancel_requested, false),"
        " error = j.error, finished_at = coalesce(j.finished_at, d.finished_at)"
        " FROM decodes o LEFT JOIN jobs j ON j.id = o.id WHERE o.id = d.id"
    )


@contextmanager
def _rebuilt_decodes() -> Iterator[str]:
    """Replace the table on SQLite, which drops no column that a constraint names. Yields the copy of its rows.

    Other tables refer to decodes. Their references are checked at the end of the transaction, and are counted while
    rows leave and come back, for which `cerpm_spans` needs an index.
    """
    before = "decodes_before_0011"
    op.execute("PRAGMA defer_foreign_keys = ON")
    op.create_index(_TEMPORARY_INDEX, "cerpm_spans", ["decode_id"])
    op.execute(f"CREATE TABLE {before} AS SELECT * FROM decodes")
    op.drop_table("decodes")
    yield before
    op.drop_table(before)
    op.drop_index(_TEMPORARY_INDEX, table_name="cerpm_spans")


def _create_decodes(*, older: bool) -> None:
    checks = [sa.CheckConstraint(_one_of_states(), name=op.f("ck_decodes_state"))] if older else []
    op.create_table(
        "decodes",
        *(sa.Column(name, kind, nullable=nullable) for name, kind, nullable in KEPT),
        *(_columns_of_jobs(nullable=False) if older else ()),
        *checks,
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_decodes_agency_id")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_decodes")),
    )
    op.create_index("ix_decodes_agency_id_id", "decodes", ["agency_id", "id"])
    if older:
        op.create_index("ix_decodes_state", "decodes", ["state"])


def _copy_decodes(before: str) -> None:
    names = [name for name, _, _ in KEPT]
    values = ["CASE WHEN result IS NULL THEN NULL ELSE finished_at END" if n == "finished_at" else n for n in names]
    op.execute(
        f"INSERT INTO decodes ({', '.join(names)}) SELECT {', '.join(values)} FROM {before} WHERE kind <> 'import'"
    )


def _restore_decodes(before: str) -> None:
    names = [name for name, _, _ in KEPT]
    values = ["coalesce(j.finished_at, d.finished_at)" if name == "finished_at" else f"d.{name}" for name in names]
    values += ["coalesce(j.state, 'done')", "coalesce(j.attempts, 1)", "coalesce(j.progress, 1.0)"]
    values += ["coalesce(j.cancel_requested, 0)", "j.error"]
    op.execute(
        f"INSERT INTO decodes ({', '.join((*names, *OF_JOBS))}) SELECT {', '.join(values)}"
        f" FROM {before} d LEFT JOIN jobs j ON j.id = d.id"
    )


# --- documents --------------------------------------------------------------------------------------------------------


def _rename(table: str, key: tuple[str, ...], column: str, place: tuple[str, ...], names: tuple[str, str]) -> None:
    """Rename one member of the documents of a column, where they have it."""
    old, new = names
    rows = sa.table(table, *(sa.column(name) for name in key), sa.column(column, sa.JSON()))
    named = sa.cast(rows.c[column], sa.Text).like(f'%"{old}"%')
    connection = op.get_bind()
    for found in connection.execute(sa.select(*(rows.c[name] for name in key)).where(named)).all():
        this = sa.and_(*(rows.c[name] == value for name, value in zip(key, found, strict=True)))
        document = connection.execute(sa.select(rows.c[column]).where(this)).scalar_one()
        member: Any = document
        for name in place:
            member = member.get(name) if isinstance(member, dict) else None
        if isinstance(member, dict) and old in member:
            member[new] = member.pop(old)
            connection.execute(sa.update(rows).where(this).values({column: document}))


def _change_readings(changed: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
    """Change each reading of the decodes of frames, which name their family from now on; all so far are of plates."""
    connection = op.get_bind()
    frames = sa.and_(decodes.c.kind.in_(("frame", "archive")), decodes.c.result.is_not(None))
    for decode_id in connection.execute(sa.select(decodes.c.id).where(frames)).scalars().all():
        this = decodes.c.id == decode_id
        result = connection.execute(sa.select(decodes.c.result).where(this)).scalar_one()
        if isinstance(result, dict) and result.get("readings"):
            result["readings"] = [changed(reading) for reading in result["readings"]]
            connection.execute(sa.update(decodes).where(this).values(result=result))
