"""Kinds of versions, the audit log and the survey's provenance.

Existing versions get a kind that follows from what changed, their hash, and one entry in the log of their agency.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any

import orjson
import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None

KINDS = ("as-planned", "as-built", "resurvey", "correction", "change")
PROVENANCE = (
    ("check_points", sa.Integer()),
    ("surveyor", sa.String(length=200)),
    ("instrument", sa.String(length=200)),
    ("survey_file_sha256", sa.String(length=64)),
    ("transform_accuracy_m", sa.Double()),
)
NEW = (("kind", sa.String(length=16)), ("audit_number", sa.BigInteger()), ("sha256", sa.String(length=64)))
CHUNK = 2000
PLACE = ("lon_deg", "lat_deg", "height_m", "original")

versions = sa.table(
    "marker_versions",
    sa.column("marker_id", sa.String),
    sa.column("version", sa.Integer),
    sa.column("agency_id", sa.String),
    sa.column("at", sa.DateTime(timezone=True)),
    sa.column("who", sa.String),
    sa.column("why", sa.String),
    sa.column("marker", sa.JSON),
    *(sa.column(name, kind) for name, kind in NEW),
)
log = sa.table(
    "audit_log",
    sa.column("agency_id", sa.String),
    sa.column("number", sa.BigInteger),
    sa.column("at", sa.DateTime(timezone=True)),
    *(sa.column(name, sa.String) for name in ("who", "action", "digest", "previous_hash", "hash")),
    sa.column("versions", sa.BigInteger),
)
UPDATE_ONE = sa.text(
    "UPDATE marker_versions SET kind = :kind, audit_number = 1, sha256 = :sha256"
    " WHERE marker_id = :marker AND version = :version"
)
UPDATE_MANY = sa.text(
    """UPDATE marker_versions v SET kind = n.kind, audit_number = 1, sha256 = n.sha256
       FROM unnest(CAST(:markers AS varchar[]), CAST(:versions AS integer[]), CAST(:kinds AS varchar[]),
                   CAST(:sha256s AS varchar[])) AS n(marker_id, version, kind, sha256)
       WHERE v.marker_id = n.marker_id AND v.version = n.version"""
)


def upgrade() -> None:
    for name, kind in PROVENANCE:
        op.add_column("markers", sa.Column(name, kind, nullable=True))
    for name, kind in NEW:
        op.add_column("marker_versions", sa.Column(name, kind, nullable=True))
    op.create_table(
        "audit_log",
        sa.Column("agency_id", sa.String(length=36), nullable=False),
        sa.Column("number", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("who", sa.String(length=200), nullable=False),
        sa.Column("key_id", sa.String(length=200), nullable=True),
        sa.Column("action", sa.String(length=40), nullable=False),
        sa.Column("subject", sa.String(length=200), nullable=True),
        sa.Column("detail", sa.JSON(none_as_null=True), nullable=True),
        sa.Column("versions", sa.BigInteger(), nullable=False),
        sa.Column("digest", sa.String(length=64), nullable=False),
        sa.Column("previous_hash", sa.String(length=64), nullable=False),
        sa.Column("hash", sa.String(length=64), nullable=False),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_audit_log_agency_id")),
        sa.PrimaryKeyConstraint("agency_id", "number", name=op.f("pk_audit_log")),
    )
    _hash_history(op.get_bind())
    with op.batch_alter_table("marker_versions") as table:
        for name, kind in NEW:
            table.alter_column(name, existing_type=kind, nullable=False)
        table.create_check_constraint(op.f("ck_marker_versions_kind"), f"kind IN ({', '.join(map(repr, KINDS))})")


def downgrade() -> None:
    op.drop_table("audit_log")
    with op.batch_alter_table("marker_versions") as table:
        table.drop_constraint(op.f("ck_marker_versions_kind"), type_="check")
        for name, _ in NEW:
            table.drop_column(name)
    for name, _ in PROVENANCE:
        op.drop_column("markers", name)


def _hash_history(connection: sa.Connection) -> None:
    """Hash every version, agency by agency, in the order of the markers' ids and the versions' numbers."""
    digests: dict[str, Any] = {}
    counts: dict[str, int] = {}
    for page in _pages(connection):
        rows = []
        for row, kind in page:
            sha256 = _sha256(row, kind)
            digests.setdefault(row.agency_id, hashlib.sha256()).update(sha256.encode())
            counts[row.agency_id] = counts.get(row.agency_id, 0) + 1
            rows.append({"marker": row.marker_id, "version": row.version, "kind": kind, "sha256": sha256})
        _keep(connection, rows)
    for agency_id, digest in digests.items():
        connection.execute(sa.insert(log).values(_first_entry(agency_id, counts[agency_id], digest.hexdigest())))


def _keep(connection: sa.Connection, rows: list[dict[str, Any]]) -> None:
    if connection.dialect.name == "postgresql":
        connection.execute(UPDATE_MANY, {f"{name}s": [row[name] for row in rows] for name in rows[0]})
    else:
        connection.execute(UPDATE_ONE, rows)


def _pages(connection: sa.Connection) -> Iterator[list[tuple[Any, str]]]:
    """All versions with the kinds that follow from what changed."""
    after, before = ("", 0), None
    while True:
        query = sa.select(versions).order_by(versions.c.marker_id, versions.c.version).limit(CHUNK)
        query = query.where(
            sa.or_(
                versions.c.marker_id > after[0],
                sa.and_(versions.c.marker_id == after[0], versions.c.version > after[1]),
            )
        )
        page = []
        for row in connection.execute(query):
            same = before is not None and before.marker_id == row.marker_id
            page.append((row, _kind(before.marker if same and before is not None else None, row.marker)))
            before = row
        if not page:
            return
        yield page
        after = (page[-1][0].marker_id, page[-1][0].version)


def _kind(old: dict[str, Any] | None, new: dict[str, Any]) -> str:
    if new.get("status") == "planned":
        return "as-planned"
    if old is None:
        return "as-built"
    if all(old.get(name) == new.get(name) for name in PLACE):
        return "change"
    return "as-built" if old.get("status") in ("planned", "built") else "resurvey"


def _utc(at: datetime) -> datetime:
    return at.replace(tzinfo=UTC) if at.tzinfo is None else at.astimezone(UTC)


def _sha256(row: Any, kind: str) -> str:
    """The hash that app/registry/audit.py computes."""
    values = (row.agency_id, row.marker_id, row.version, _utc(row.at), row.who, row.why, kind, row.marker)
    return hashlib.sha256(orjson.dumps(values, option=orjson.OPT_SORT_KEYS)).hexdigest()


def _first_entry(agency_id: str, count: int, digest: str) -> dict[str, Any]:
    now, who, action, previous = datetime.now(UTC), "migration 0006", "history.hashed", "0" * 64
    values = [agency_id, 1, now, who, None, action, None, None, count, digest, previous]
    hashed = hashlib.sha256(orjson.dumps(values, option=orjson.OPT_SORT_KEYS)).hexdigest()
    return {
        "agency_id": agency_id, "number": 1, "at": now, "who": who, "action": action, "versions": count,
        "digest": digest, "previous_hash": previous, "hash": hashed,
    }  # fmt: skip
