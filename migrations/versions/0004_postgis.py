"""PostGIS: points of markers and magnets with a GiST index, and a distance function that is the same on both databases.

SQLite has its R*Trees from 0001 and 0002. The points are generated columns, computed from longitude
and latitude.
"""

from __future__ import annotations

from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None

TABLES = ("markers", "magnets")

# `ST_DistanceSpheroid` and pyproj call the same geodesic of PROJ (Karney 2013, https://doi.org/10.1007/s00190-012-0578-z)
DISTANCE = """
CREATE FUNCTION waymark_distance_m(
    lon_a_deg double precision, lat_a_deg double precision, lon_b_deg double precision, lat_b_deg double precision
) RETURNS double precision LANGUAGE sql IMMUTABLE STRICT PARALLEL SAFE COST 1000 AS $$
    SELECT ST_DistanceSpheroid(
        ST_MakePoint(lon_a_deg, lat_a_deg), ST_MakePoint(lon_b_deg, lat_b_deg),
        'SPHEROID["WGS 84",6378137,298.257223563]'::spheroid
    )
$$
"""


def upgrade() -> None:
    if op.get_bind().dialect.name != "postgresql":
        return
    op.execute(DISTANCE)
    for table in TABLES:
        op.execute(
            f"ALTER TABLE {table} ADD COLUMN geom geometry(Point, 4326)"
            " GENERATED ALWAYS AS (ST_SetSRID(ST_MakePoint(lon_deg, lat_deg), 4326)) STORED"
        )
        op.execute(f"CREATE INDEX ix_{table}_geom ON {table} USING gist (geom)")


def downgrade() -> None:
    if op.get_bind().dialect.name != "postgresql":
        return
    for table in TABLES:
        op.execute(f"ALTER TABLE {table} DROP COLUMN geom")
    op.execute(
        "DROP FUNCTION waymark_distance_m(double precision, double precision, double precision, double precision)"
    )
