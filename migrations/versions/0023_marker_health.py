"""Marker health: the tests of each marker, readings of codes that are not registered, and the work list."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0023"
down_revision = "0022"
branch_labels = None
depends_on = None

WHOSE = "(SELECT coalesce(current_setting('waymark.agency_id', true), ''))"
TABLES = ("marker_health", "unregistered_readings", "maintenance_items")
_ID, _TIME = sa.String(length=36), sa.DateTime(timezone=True)

SQLITE_INDEX = (
    "CREATE VIRTUAL TABLE maintenance_items_rtree USING rtree(row, min_lon, max_lon, min_lat, max_lat)",
    """CREATE TRIGGER maintenance_items_rtree_insert AFTER INSERT ON maintenance_items BEGIN
       INSERT INTO maintenance_items_rtree
       VALUES (new.row, new.lon_deg, new.lon_deg, new.lat_deg, new.lat_deg); END""",
    """CREATE TRIGGER maintenance_items_rtree_update AFTER UPDATE OF lon_deg, lat_deg ON maintenance_items BEGIN
       UPDATE maintenance_items_rtree SET min_lon = new.lon_deg, max_lon = new.lon_deg, min_lat = new.lat_deg,
       max_lat = new.lat_deg WHERE row = new.row; END""",
    """CREATE TRIGGER maintenance_items_rtree_delete AFTER DELETE ON maintenance_items BEGIN
       DELETE FROM maintenance_items_rtree WHERE row = old.row; END""",
)


def upgrade() -> None:
    _create_health()
    _create_items()
    if op.get_bind().dialect.name == "postgresql":
        op.execute(
            "ALTER TABLE maintenance_items ADD COLUMN geom geometry(Point, 4326)"
            " GENERATED ALWAYS AS (ST_SetSRID(ST_MakePoint(lon_deg, lat_deg), 4326)) STORED"
        )
        op.execute("CREATE INDEX ix_maintenance_items_geom ON maintenance_items USING gist (geom)")
        for table in TABLES:
            op.execute(f"ALTER TABLE {table} ENABLE ROW LEVEL SECURITY")
            op.execute(f"ALTER TABLE {table} FORCE ROW LEVEL SECURITY")
            op.execute(f"CREATE POLICY agency ON {table} USING (agency_id = {WHOSE} OR {WHOSE} = '*')")
        return
    for statement in SQLITE_INDEX:
        op.execute(statement)


def downgrade() -> None:
    if op.get_bind().dialect.name == "sqlite":
        op.execute("DROP TABLE maintenance_items_rtree")
    for table in reversed(TABLES):
        op.drop_table(table)


def _create_health() -> None:
    op.create_table(
        "marker_health",
        sa.Column("agency_id", _ID, nullable=False),
        sa.Column("subject", sa.String(length=200), nullable=False),
        sa.Column("marker_id", _ID, nullable=True),
        sa.Column("lon_deg", sa.Double(), nullable=True),
        sa.Column("lat_deg", sa.Double(), nullable=True),
        sa.Column("passes", sa.BigInteger(), nullable=False),
        sa.Column("reads", sa.BigInteger(), nullable=False),
        sa.Column("read_at", _TIME, nullable=True),
        sa.Column("last_at", _TIME, nullable=False),
        sa.Column("ratios", sa.JSON(), nullable=False),
        sa.Column("quality", sa.Double(), nullable=True),
        sa.Column("state", sa.JSON(), nullable=False),
        sa.Column("updated_at", _TIME, nullable=False),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_marker_health_agency_id")),
        sa.ForeignKeyConstraint(["marker_id"], ["markers.id"], name=op.f("fk_marker_health_marker_id")),
        sa.PrimaryKeyConstraint("agency_id", "subject", name=op.f("pk_marker_health")),
    )
    op.create_table(
        "unregistered_readings",
        sa.Column("decode_id", _ID, nullable=False),
        sa.Column("number", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("agency_id", _ID, nullable=False),
        sa.Column("family", sa.String(length=16), nullable=False),
        sa.Column("code", sa.String(length=64), nullable=False),
        sa.Column("lon_deg", sa.Double(), nullable=False),
        sa.Column("lat_deg", sa.Double(), nullable=False),
        sa.Column("confidence", sa.Double(), nullable=False),
        sa.Column("at", _TIME, nullable=False),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_unregistered_readings_agency_id")),
        sa.ForeignKeyConstraint(["decode_id"], ["decodes.id"], name=op.f("fk_unregistered_readings_decode_id")),
        sa.PrimaryKeyConstraint("decode_id", "number", name=op.f("pk_unregistered_readings")),
    )


def _create_items() -> None:
    op.create_table(
        "maintenance_items",
        sa.Column("row", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), autoincrement=True, nullable=False),
        sa.Column("id", _ID, nullable=False),
        sa.Column("agency_id", _ID, nullable=False),
        sa.Column("subject", sa.String(length=200), nullable=False),
        sa.Column("marker_id", _ID, nullable=True),
        sa.Column("decode_id", _ID, nullable=True),
        sa.Column("family", sa.String(length=16), nullable=False),
        sa.Column("code", sa.String(length=64), nullable=True),
        sa.Column("what", sa.String(length=32), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("outcome", sa.String(length=16), nullable=True),
        sa.Column("road", sa.String(length=200), nullable=True),
        sa.Column("measure_m", sa.Double(), nullable=True),
        sa.Column("lon_deg", sa.Double(), nullable=False),
        sa.Column("lat_deg", sa.Double(), nullable=False),
        sa.Column("height_m", sa.Double(), nullable=True),
        sa.Column("priority", sa.Double(), nullable=False),
        sa.Column("ratio", sa.Double(), nullable=False),
        sa.Column("vehicles", sa.Integer(), nullable=False),
        sa.Column("passes", sa.Integer(), nullable=False),
        sa.Column("first_at", _TIME, nullable=False),
        sa.Column("last_at", _TIME, nullable=False),
        sa.Column("evidence", sa.JSON(), nullable=False),
        sa.Column("note", sa.String(length=500), nullable=True),
        sa.Column("decided_by", sa.String(length=200), nullable=True),
        sa.Column("decided_at", _TIME, nullable=True),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("created_at", _TIME, nullable=False),
        sa.Column("updated_at", _TIME, nullable=False),
        sa.Column("feature", sa.Text(), nullable=False),
        sa.CheckConstraint("state IN ('open', 'approved', 'dismissed')", name=op.f("ck_maintenance_items_state")),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_maintenance_items_agency_id")),
        sa.ForeignKeyConstraint(["marker_id"], ["markers.id"], name=op.f("fk_maintenance_items_marker_id")),
        sa.ForeignKeyConstraint(["decode_id"], ["decodes.id"], name=op.f("fk_maintenance_items_decode_id")),
        sa.PrimaryKeyConstraint("row", name=op.f("pk_maintenance_items")),
        sa.UniqueConstraint("id", name=op.f("uq_maintenance_items_id")),
        sqlite_autoincrement=True,
    )
    for columns in (("agency_id", "id"), ("agency_id", "subject"), ("agency_id", "state", "priority", "id")):
        op.create_index(f"ix_maintenance_items_{'_'.join(columns)}", "maintenance_items", list(columns), unique=False)
