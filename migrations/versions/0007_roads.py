"""Roads as routes with measures, and an index of markers by road and measure."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None

_ID = sa.String(length=36)
_TIME = sa.DateTime(timezone=True)
_INDEX = "ix_markers_agency_id_road_measure_m_id"
_FIGURES = "1000000 100000 1000 2 1"  # as in 0001: figures of a large registry


def upgrade() -> None:
    op.create_table(
        "roads",
        sa.Column("id", _ID, nullable=False),
        sa.Column("agency_id", _ID, nullable=False),
        sa.Column("name", sa.String(length=200), nullable=False),
        sa.Column("parts", sa.JSON(), nullable=False),
        sa.Column("given", sa.JSON(), nullable=False),
        sa.Column("calibration", sa.JSON(), nullable=False),
        sa.Column("length_m", sa.Double(), nullable=False),
        sa.Column("from_m", sa.Double(), nullable=False),
        sa.Column("to_m", sa.Double(), nullable=False),
        sa.Column("localization_grade", sa.String(length=64), nullable=False),
        sa.Column("transform_note", sa.String(length=500), nullable=True),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("created_at", _TIME, nullable=False),
        sa.Column("updated_at", _TIME, nullable=False),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_roads_agency_id")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_roads")),
        sa.UniqueConstraint("agency_id", "name", name=op.f("uq_roads_agency_id_name")),
    )
    op.create_index("ix_roads_agency_id_id", "roads", ["agency_id", "id"], unique=False)
    op.create_table(
        "road_versions",
        sa.Column("road_id", _ID, nullable=False),
        sa.Column("version", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("agency_id", _ID, nullable=False),
        sa.Column("at", _TIME, nullable=False),
        sa.Column("who", sa.String(length=200), nullable=False),
        sa.Column("why", sa.String(length=500), nullable=True),
        sa.Column("road", sa.JSON(), nullable=False),
        sa.ForeignKeyConstraint(["agency_id"], ["agencies.id"], name=op.f("fk_road_versions_agency_id")),
        sa.ForeignKeyConstraint(["road_id"], ["roads.id"], name=op.f("fk_road_versions_road_id")),
        sa.PrimaryKeyConstraint("road_id", "version", name=op.f("pk_road_versions")),
    )
    op.create_index(
        _INDEX,
        "markers",
        ["agency_id", "road", "measure_m", "id"],
        unique=False,
        sqlite_where=sa.text("road IS NOT NULL"),
        postgresql_where=sa.text("road IS NOT NULL"),
    )
    if op.get_bind().dialect.name == "sqlite":
        statement = sa.text("INSERT INTO sqlite_stat1 VALUES ('markers', :index, :figures)")
        op.execute(statement.bindparams(index=_INDEX, figures=_FIGURES))
        op.execute("ANALYZE sqlite_schema")


def downgrade() -> None:
    op.drop_index(_INDEX, table_name="markers")
    op.drop_table("road_versions")
    op.drop_index("ix_roads_agency_id_id", table_name="roads")
    op.drop_table("roads")
