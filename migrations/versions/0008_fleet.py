"""Vehicles, their sensor profiles, keys and uploads, and camera calibrations."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None

_ID = sa.String(length=36)
_TIME = sa.DateTime(timezone=True)


def upgrade() -> None:
    op.create_table(
        "vehicles",
        sa.Column("id", _ID, nullable=False),
        sa.Column("agency_id", _ID, nullable=False),
        sa.Column("name", sa.String(length=80), nullable=False),
        sa.Column("status", sa.String(length=16), nullable=False),
        sa.Column("note", sa.String(length=500), nullable=True),
        sa.Column("profile", sa.JSON(), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("uploads", sa.BigInteger(), server_default="0", nullable=False),
        sa.Column("driven_m", sa.Double(), server_default="0", nullable=False),
        sa.Column("last_seen_at", _TIME, nullable=True),
        sa.Column("created_at", _TIME, nullable=False),
        sa.Column("updated_at", _TIME, nullable=False),
        sa.CheckConstraint("status IN ('active', 'retired')", name=op.f("ck_vehicles_status")),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_vehicles_agency_id")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_vehicles")),
        sa.UniqueConstraint("agency_id", "name", name=op.f("uq_vehicles_agency_id_name")),
    )
    op.create_index("ix_vehicles_agency_id_id", "vehicles", ["agency_id", "id"], unique=False)
    op.create_table(
        "vehicle_versions",
        sa.Column("vehicle_id", _ID, nullable=False),
        sa.Column("version", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("agency_id", _ID, nullable=False),
        sa.Column("at", _TIME, nullable=False),
        sa.Column("who", sa.String(length=200), nullable=False),
        sa.Column("why", sa.String(length=500), nullable=True),
        sa.Column("vehicle", sa.JSON(), nullable=False),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_vehicle_versions_agency_id")),
        sa.ForeignKeyConstraint(["vehicle_id"], ["vehicles.id"], name=op.f("fk_vehicle_versions_vehicle_id")),
        sa.PrimaryKeyConstraint("vehicle_id", "version", name=op.f("pk_vehicle_versions")),
    )
    op.create_table(
        "vehicle_keys",
        sa.Column("agency_id", _ID, nullable=False),
        sa.Column("key_id", sa.String(length=200), nullable=False),
        sa.Column("vehicle_id", _ID, nullable=False),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_vehicle_keys_agency_id")),
        sa.ForeignKeyConstraint(["vehicle_id"], ["vehicles.id"], name=op.f("fk_vehicle_keys_vehicle_id")),
        sa.PrimaryKeyConstraint("agency_id", "key_id", name=op.f("pk_vehicle_keys")),
    )
    op.create_index("ix_vehicle_keys_vehicle_id", "vehicle_keys", ["vehicle_id"], unique=False)
    op.create_table(
        "vehicle_uploads",
        sa.Column("decode_id", _ID, nullable=False),
        sa.Column("vehicle_id", _ID, nullable=False),
        sa.Column("agency_id", _ID, nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("driven_m", sa.Double(), nullable=True),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_vehicle_uploads_agency_id")),
        sa.ForeignKeyConstraint(["decode_id"], ["decodes.id"], name=op.f("fk_vehicle_uploads_decode_id")),
        sa.ForeignKeyConstraint(["vehicle_id"], ["vehicles.id"], name=op.f("fk_vehicle_uploads_vehicle_id")),
        sa.PrimaryKeyConstraint("decode_id", name=op.f("pk_vehicle_uploads")),
    )
    op.create_index("ix_vehicle_uploads_vehicle_id_decode_id", "vehicle_uploads", ["vehicle_id", "decode_id"])
    op.create_table(
        "calibrations",
        sa.Column("id", _ID, nullable=False),
        sa.Column("agency_id", _ID, nullable=False),
        sa.Column("who", sa.String(length=200), nullable=False),
        sa.Column("result", sa.JSON(), nullable=False),
        sa.Column("created_at", _TIME, nullable=False),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_calibrations_agency_id")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_calibrations")),
    )
    op.create_index("ix_calibrations_agency_id_id", "calibrations", ["agency_id", "id"], unique=False)


def downgrade() -> None:
    for table in ("calibrations", "vehicle_uploads", "vehicle_keys", "vehicle_versions", "vehicles"):
        op.drop_table(table)
