"""Lanes of alignments and markers of plans for GIS clients.

Alignments and plans that were stored before have no features: a plan gets them when its rules are sent again, and an
alignment when it is stored under another name.
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0014"
down_revision = "0013"
branch_labels = None
depends_on = None

WHOSE = "(SELECT coalesce(current_setting('waymark.agency_id', true), ''))"
TABLES = ("alignment_lanes", "planned_markers")
_ID, _FEATURE_ID = sa.String(length=36), sa.String(length=48)

SQLITE_INDEX = (
    "CREATE VIRTUAL TABLE planned_markers_rtree USING rtree(row, min_lon, max_lon, min_lat, max_lat)",
    """CREATE TRIGGER planned_markers_rtree_insert AFTER INSERT ON planned_markers BEGIN
       INSERT INTO planned_markers_rtree VALUES (new.row, new.lon_deg, new.lon_deg, new.lat_deg, new.lat_deg); END""",
    """CREATE TRIGGER planned_markers_rtree_delete AFTER DELETE ON planned_markers BEGIN
       DELETE FROM planned_markers_rtree WHERE row = old.row; END""",
)

# as in 0001: figures of a large registry, so that the planner asks the R*Tree
SQLITE_STATISTICS = (
    ("planned_markers", "ix_planned_markers_agency_id_id", "1000000 100000 1"),
    ("planned_markers", "ix_planned_markers_plan_id", "1000000 10000"),
    ("planned_markers", "sqlite_autoindex_planned_markers_1", "1000000 1"),
    ("planned_markers_rtree_rowid", None, "1000000"),
    ("planned_markers_rtree_node", None, "30000"),
    ("plans", "ix_plans_agency_id_id", "10000 100 1"),
)


def upgrade() -> None:
    op.create_table(
        "alignment_lanes",
        sa.Column("id", _FEATURE_ID, nullable=False),
        sa.Column("agency_id", _ID, nullable=False),
        sa.Column("alignment_id", _ID, nullable=False),
        *(sa.Column(f"{side}_deg", sa.Double(), nullable=False) for side in ("west", "south", "east", "north")),
        sa.Column("properties", sa.JSON(), nullable=False),
        sa.Column("points_deg", sa.JSON(), nullable=False),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_alignment_lanes_agency_id")),
        sa.ForeignKeyConstraint(["alignment_id"], ["alignments.id"], name=op.f("fk_alignment_lanes_alignment_id")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_alignment_lanes")),
    )
    op.create_index("ix_alignment_lanes_agency_id_id", "alignment_lanes", ["agency_id", "id"], unique=False)
    _create_planned_markers()
    if op.get_bind().dialect.name == "postgresql":
        op.execute(
            "ALTER TABLE planned_markers ADD COLUMN geom geometry(Point, 4326)"
            " GENERATED ALWAYS AS (ST_SetSRID(ST_MakePoint(lon_deg, lat_deg), 4326)) STORED"
        )
        op.execute("CREATE INDEX ix_planned_markers_geom ON planned_markers USING gist (geom)")
        for table in TABLES:
            op.execute(f"ALTER TABLE {table} ENABLE ROW LEVEL SECURITY")
            op.execute(f"ALTER TABLE {table} FORCE ROW LEVEL SECURITY")
            op.execute(f"CREATE POLICY agency ON {table} USING (agency_id = {WHOSE} OR {WHOSE} = '*')")
        return
    for statement in SQLITE_INDEX:
        op.execute(statement)
    for table, index, figures in SQLITE_STATISTICS:
        values = {"table": table, "index": index, "figures": figures}
        op.execute(sa.text("INSERT INTO sqlite_stat1 VALUES (:table, :index, :figures)").bindparams(**values))
    op.execute("ANALYZE sqlite_schema")


def downgrade() -> None:
    if op.get_bind().dialect.name == "sqlite":
        op.execute("DROP TABLE planned_markers_rtree")
        op.execute("DELETE FROM sqlite_stat1 WHERE tbl = 'plans'")
    for table in reversed(TABLES):
        op.drop_table(table)


def _create_planned_markers() -> None:
    op.create_table(
        "planned_markers",
        sa.Column("row", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), autoincrement=True, nullable=False),
        sa.Column("id", _FEATURE_ID, nullable=False),
        sa.Column("agency_id", _ID, nullable=False),
        sa.Column("plan_id", _ID, nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("family", sa.String(length=16), nullable=False),
        sa.Column("code", sa.String(length=64), nullable=False),
        sa.Column("purpose", sa.String(length=32), nullable=False),
        sa.Column("lane", sa.Text(), nullable=False),
        sa.Column("side", sa.String(length=16), nullable=True),
        sa.Column("chainage_m", sa.Double(), nullable=False),
        sa.Column("station_m", sa.Double(), nullable=False),
        sa.Column("offset_m", sa.Double(), nullable=False),
        sa.Column("heading_deg", sa.Double(), nullable=False),
        sa.Column("vertical_datum", sa.String(length=64), nullable=True),
        sa.Column("lon_deg", sa.Double(), nullable=False),
        sa.Column("lat_deg", sa.Double(), nullable=False),
        sa.Column("height_m", sa.Double(), nullable=True),
        sa.Column("feature", sa.Text(), nullable=False),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_planned_markers_agency_id")),
        sa.ForeignKeyConstraint(["plan_id"], ["plans.id"], name=op.f("fk_planned_markers_plan_id")),
        sa.PrimaryKeyConstraint("row", name=op.f("pk_planned_markers")),
        sa.UniqueConstraint("id", name=op.f("uq_planned_markers_id")),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_planned_markers_agency_id_id", "planned_markers", ["agency_id", "id"], unique=False)
    op.create_index("ix_planned_markers_plan_id", "planned_markers", ["plan_id"], unique=False)
