"""Magnets: codebooks, properties of a marker that only its family has, and positions of single magnets."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

SQLITE_INDEX = (
    "CREATE VIRTUAL TABLE magnets_rtree USING rtree(row, min_lon, max_lon, min_lat, max_lat)",
    """CREATE TRIGGER magnets_rtree_insert AFTER INSERT ON magnets BEGIN
       INSERT INTO magnets_rtree VALUES (new.row, new.lon_deg, new.lon_deg, new.lat_deg, new.lat_deg); END""",
    """CREATE TRIGGER magnets_rtree_update AFTER UPDATE OF lon_deg, lat_deg ON magnets BEGIN
       UPDATE magnets_rtree SET min_lon = new.lon_deg, max_lon = new.lon_deg,
       min_lat = new.lat_deg, max_lat = new.lat_deg WHERE row = new.row; END""",
    """CREATE TRIGGER magnets_rtree_delete AFTER DELETE ON magnets BEGIN
       DELETE FROM magnets_rtree WHERE row = old.row; END""",
)

# as in 0001: figures of a large registry, so that the planner asks the R*Tree
SQLITE_STATISTICS = (
    ("markers", "ix_markers_agency_id_family_id", "1000000 100000 50000 1"),
    ("magnets", "sqlite_autoindex_magnets_1", "1000000 10 1"),
    ("magnets_rtree_rowid", None, "1000000"),
    ("magnets_rtree_node", None, "30000"),
)


def upgrade() -> None:
    op.add_column("markers", sa.Column("spec", sa.JSON(none_as_null=True), nullable=True))
    op.create_index("ix_markers_agency_id_family_id", "markers", ["agency_id", "family", "id"], unique=False)
    op.create_table(
        "magnets",
        sa.Column("row", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), autoincrement=True, nullable=False),
        sa.Column("marker_id", sa.String(length=36), nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("agency_id", sa.String(length=36), nullable=False),
        sa.Column("lon_deg", sa.Double(), nullable=False),
        sa.Column("lat_deg", sa.Double(), nullable=False),
        sa.Column("polarity", sa.String(length=1), nullable=False),
        sa.Column("phi_deg", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_magnets_agency_id")),
        sa.ForeignKeyConstraint(["marker_id"], ["markers.id"], name=op.f("fk_magnets_marker_id")),
        sa.PrimaryKeyConstraint("row", name=op.f("pk_magnets")),
        sa.UniqueConstraint("marker_id", "number", name=op.f("uq_magnets_marker_id_number")),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "codebooks",
        sa.Column("id", sa.String(length=36), nullable=False),
        sa.Column("agency_id", sa.String(length=36), nullable=False),
        sa.Column("name", sa.String(length=80), nullable=False),
        sa.Column("design", sa.JSON(), nullable=False),
        sa.Column("rules", sa.JSON(), nullable=False),
        sa.Column("figures", sa.JSON(), nullable=False),
        sa.Column("entries", sa.JSON(), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("updated_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_codebooks_agency_id")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_codebooks")),
        sa.UniqueConstraint("agency_id", "name", name=op.f("uq_codebooks_agency_id_name")),
    )
    op.create_index("ix_codebooks_agency_id_id", "codebooks", ["agency_id", "id"], unique=False)
    if op.get_bind().dialect.name == "sqlite":
        for statement in SQLITE_INDEX:
            op.execute(statement)
        for table, index, figures in SQLITE_STATISTICS:
            values = {"table": table, "index": index, "figures": figures}
            op.execute(sa.text("INSERT INTO sqlite_stat1 VALUES (:table, :index, :figures)").bindparams(**values))
        op.execute("ANALYZE sqlite_schema")


def downgrade() -> None:
    if op.get_bind().dialect.name == "sqlite":
        op.execute("DROP TABLE magnets_rtree")
    op.drop_index("ix_codebooks_agency_id_id", table_name="codebooks")
    op.drop_table("codebooks")
    op.drop_table("magnets")
    # the code of 0001 knows plates only
    for table in ("observations", "marker_versions"):
        op.execute(f"DELETE FROM {table} WHERE marker_id IN (SELECT id FROM markers WHERE family <> 'plate')")
    op.execute("DELETE FROM markers WHERE family <> 'plate'")
    op.drop_index("ix_markers_agency_id_family_id", table_name="markers")
    op.drop_column("markers", "spec")
