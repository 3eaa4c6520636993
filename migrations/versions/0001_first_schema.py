"""First schema: agencies, keys, markers with their history, decodes, observations, idempotency keys."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None

SQLITE_INDEX = (
    "CREATE VIRTUAL TABLE markers_rtree USING rtree(row, min_lon, max_lon, min_lat, max_lat)",
    """CREATE TRIGGER markers_rtree_insert AFTER INSERT ON markers BEGIN
       INSERT INTO markers_rtree VALUES (new.row, new.lon_deg, new.lon_deg, new.lat_deg, new.lat_deg); END""",
    """CREATE TRIGGER markers_rtree_update AFTER UPDATE OF lon_deg, lat_deg ON markers BEGIN
       UPDATE markers_rtree SET min_lon = new.lon_deg, max_lon = new.lon_deg,
       min_lat = new.lat_deg, max_lat = new.lat_deg WHERE row = new.row; END""",
    """CREATE TRIGGER markers_rtree_delete AFTER DELETE ON markers BEGIN
       DELETE FROM markers_rtree WHERE row = old.row; END""",
)

# Without figures SQLite takes an agency for ten markers, and reads them all instead of asking the R*Tree: on 200,000
# markers a box of 100 takes 70 ms then, and 2 ms with these. They stand for a large registry.
SQLITE_STATISTICS = (
    ("markers", "ix_markers_agency_id_id", "1000000 100000 1"),
    ("markers", "ix_markers_agency_id_status_id", "1000000 100000 20000 1"),
    ("markers", "ix_markers_digits", "1000000 2"),
    ("markers", "sqlite_autoindex_markers_1", "1000000 1"),
    ("markers_rtree_rowid", None, "1000000"),
    ("markers_rtree_node", None, "30000"),
)


def upgrade() -> None:
    op.create_table(
        "agencies",
        sa.Column("id", sa.String(length=36), nullable=False),
        sa.Column("name", sa.String(length=200), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_agencies")),
        sa.UniqueConstraint("name", name=op.f("uq_agencies_name")),
    )
    op.create_table(
        "api_keys",
        sa.Column("id", sa.String(length=36), nullable=False),
        sa.Column("agency_id", sa.String(length=36), nullable=False),
        sa.Column("label", sa.String(length=200), nullable=False),
        sa.Column("prefix", sa.String(length=16), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("scope", sa.String(length=16), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("expires_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("revoked_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("last_used_at", sa.DateTime(timezone=True), nullable=True),
        sa.CheckConstraint("scope IN ('read', 'decode', 'write', 'admin')", name=op.f("ck_api_keys_scope")),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_api_keys_agency_id")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_api_keys")),
        sa.UniqueConstraint("sha256", name=op.f("uq_api_keys_sha256")),
    )
    op.create_table(
        "decodes",
        sa.Column("id", sa.String(length=36), nullable=False),
        sa.Column("agency_id", sa.String(length=36), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("kind", sa.String(length=32), nullable=False),
        sa.Column("context", sa.JSON(), nullable=False),
        sa.Column("upload_key", sa.String(length=200), nullable=True),
        sa.Column("picture_key", sa.String(length=200), nullable=True),
        sa.Column("result", sa.JSON(none_as_null=True), nullable=True),
        sa.Column("error", sa.JSON(none_as_null=True), nullable=True),
        sa.Column("attempts", sa.Integer(), server_default="0", nullable=False),
        sa.Column("progress", sa.Double(), server_default="0", nullable=False),
        sa.Column("cancel_requested", sa.Boolean(), server_default=sa.false(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("finished_at", sa.DateTime(timezone=True), nullable=True),
        sa.CheckConstraint(
            "state IN ('queued', 'running', 'done', 'failed', 'cancelled')", name=op.f("ck_decodes_state")
        ),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_decodes_agency_id")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_decodes")),
    )
    op.create_index("ix_decodes_agency_id_id", "decodes", ["agency_id", "id"], unique=False)
    op.create_index("ix_decodes_state", "decodes", ["state"], unique=False)
    op.create_table(
        "idempotency_keys",
        sa.Column("agency_id", sa.String(length=36), nullable=False),
        sa.Column("key", sa.String(length=200), nullable=False),
        sa.Column("request_sha256", sa.String(length=64), nullable=False),
        sa.Column("response", sa.JSON(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("expires_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_idempotency_keys_agency_id")),
        sa.PrimaryKeyConstraint("agency_id", "key", name=op.f("pk_idempotency_keys")),
    )
    op.create_index("ix_idempotency_keys_expires_at", "idempotency_keys", ["expires_at"], unique=False)
    op.create_table(
        "markers",
        sa.Column("row", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), autoincrement=True, nullable=False),
        sa.Column("id", sa.String(length=36), nullable=False),
        sa.Column("agency_id", sa.String(length=36), nullable=False),
        sa.Column("family", sa.String(length=16), nullable=False),
        sa.Column("status", sa.String(length=16), nullable=False),
        sa.Column("scheme", sa.String(length=16), nullable=True),
        sa.Column("digits", sa.String(length=64), nullable=True),
        sa.Column("check_digits", sa.Integer(), nullable=True),
        sa.Column("digits_match_position", sa.Boolean(), nullable=True),
        sa.Column("n", sa.Integer(), nullable=True),
        sa.Column("unit_mm", sa.Double(), nullable=True),
        sa.Column("gap_mm", sa.Double(), nullable=True),
        sa.Column("thickness_mm", sa.Double(), nullable=True),
        sa.Column("lon_deg", sa.Double(), nullable=False),
        sa.Column("lat_deg", sa.Double(), nullable=False),
        sa.Column("height_m", sa.Double(), nullable=True),
        sa.Column("heading_deg", sa.Double(), nullable=True),
        sa.Column("heading_rmse_deg", sa.Double(), nullable=True),
        sa.Column("crs", sa.String(length=64), nullable=False),
        sa.Column("realization", sa.String(length=64), nullable=True),
        sa.Column("epoch", sa.Double(), nullable=True),
        sa.Column("vertical_datum", sa.String(length=64), nullable=True),
        sa.Column("horizontal_rmse_m", sa.Double(), nullable=True),
        sa.Column("vertical_rmse_m", sa.Double(), nullable=True),
        sa.Column("survey_method", sa.String(length=200), nullable=True),
        sa.Column("original", sa.JSON(), nullable=False),
        sa.Column("localization_grade", sa.String(length=64), nullable=False),
        sa.Column("transform_note", sa.String(length=500), nullable=True),
        sa.Column("road", sa.String(length=200), nullable=True),
        sa.Column("measure_m", sa.Double(), nullable=True),
        sa.Column("offset_m", sa.Double(), nullable=True),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("updated_at", sa.DateTime(timezone=True), nullable=False),
        sa.CheckConstraint(
            "status IN ('planned', 'built', 'surveyed', 'active', 'suspect', 'retired')", name=op.f("ck_markers_status")
        ),
        sa.CheckConstraint(
            "lon_deg BETWEEN -180 AND 180 AND lat_deg BETWEEN -90 AND 90", name=op.f("ck_markers_position")
        ),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_markers_agency_id")),
        sa.PrimaryKeyConstraint("row", name=op.f("pk_markers")),
        sa.UniqueConstraint("id", name=op.f("uq_markers_id")),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_markers_agency_id_id", "markers", ["agency_id", "id"], unique=False)
    op.create_index("ix_markers_agency_id_status_id", "markers", ["agency_id", "status", "id"], unique=False)
    op.create_index("ix_markers_digits", "markers", ["digits"], unique=False)
    op.create_index(
        "uq_markers_id_digits",
        "markers",
        ["digits", "n"],
        unique=True,
        sqlite_where=sa.text("scheme = 'id'"),
        postgresql_where=sa.text("scheme = 'id'"),
    )
    op.create_table(
        "marker_versions",
        sa.Column("marker_id", sa.String(length=36), nullable=False),
        sa.Column("version", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("agency_id", sa.String(length=36), nullable=False),
        sa.Column("at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("who", sa.String(length=200), nullable=False),
        sa.Column("why", sa.String(length=500), nullable=True),
        sa.Column("marker", sa.JSON(), nullable=False),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_marker_versions_agency_id")),
        sa.ForeignKeyConstraint(["marker_id"], ["markers.id"], name=op.f("fk_marker_versions_marker_id")),
        sa.PrimaryKeyConstraint("marker_id", "version", name=op.f("pk_marker_versions")),
    )
    op.create_table(
        "observations",
        sa.Column("decode_id", sa.String(length=36), nullable=False),
        sa.Column("marker_id", sa.String(length=36), nullable=False),
        sa.Column("frame", sa.Integer(), server_default="0", autoincrement=False, nullable=False),
        sa.Column("agency_id", sa.String(length=36), nullable=False),
        sa.Column("at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("what", sa.String(length=32), nullable=False),
        sa.Column("detail", sa.JSON(none_as_null=True), nullable=True),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_observations_agency_id")),
        sa.ForeignKeyConstraint(["decode_id"], ["decodes.id"], name=op.f("fk_observations_decode_id")),
        sa.ForeignKeyConstraint(["marker_id"], ["markers.id"], name=op.f("fk_observations_marker_id")),
        sa.PrimaryKeyConstraint("decode_id", "marker_id", "frame", name=op.f("pk_observations")),
    )
    op.create_index("ix_observations_marker_id_at", "observations", ["marker_id", "at"], unique=False)
    if op.get_bind().dialect.name == "sqlite":
        for statement in SQLITE_INDEX:
            op.execute(statement)
        op.execute("ANALYZE")
        for table, index, figures in SQLITE_STATISTICS:
            values = {"table": table, "index": index, "figures": figures}
            op.execute(sa.text("INSERT INTO sqlite_stat1 VALUES (:table, :index, :figures)").bindparams(**values))
        op.execute("ANALYZE sqlite_schema")


def downgrade() -> None:
    if op.get_bind().dialect.name == "sqlite":
        op.execute("DROP TABLE markers_rtree")
    op.drop_index("ix_observations_marker_id_at", table_name="observations")
    op.drop_table("observations")
    op.drop_table("marker_versions")
    op.drop_index(
        "uq_markers_id_digits",
        table_name="markers",
        sqlite_where=sa.text("scheme = 'id'"),
        postgresql_where=sa.text("scheme = 'id'"),
    )
    op.drop_index("ix_markers_digits", table_name="markers")
    op.drop_index("ix_markers_agency_id_status_id", table_name="markers")
    op.drop_index("ix_markers_agency_id_id", table_name="markers")
    op.drop_table("markers")
    op.drop_index("ix_idempotency_keys_expires_at", table_name="idempotency_keys")
    op.drop_table("idempotency_keys")
    op.drop_index("ix_decodes_state", table_name="decodes")
    op.drop_index("ix_decodes_agency_id_id", table_name="decodes")
    op.drop_table("decodes")
    op.drop_table("api_keys")
    op.drop_table("agencies")
