"""The GeoJSON feature of each marker as text beside its columns, from which pages are assembled.

The function that writes the texts here does not change; later migrations write the texts again.
"""

from __future__ import annotations

import orjson
import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None

CHUNK = 5000
PROPERTIES = {
    "family": "family",
    "status": "status",
    "scheme": "scheme",
    "code": "digits",
    "heading_deg": "heading_deg",
    "heading_rmse_deg": "heading_rmse_deg",
    "side": "side",
    "road": "road",
    "measure_m": "measure_m",
    "offset_m": "offset_m",
    "realization": "realization",
    "epoch": "epoch",
    "vertical_datum": "vertical_datum",
    "horizontal_rmse_m": "horizontal_rmse_m",
    "vertical_rmse_m": "vertical_rmse_m",
    "survey_method": "survey_method",
    "check_points": "check_points",
    "surveyor": "surveyor",
    "instrument": "instrument",
    "transform_accuracy_m": "transform_accuracy_m",
    "localization_grade": "localization_grade",
    "version": "version",
    "updated_at": "updated_at",
}
_PLACE = ("row", "id", "lon_deg", "lat_deg", "height_m")
_own = [name for name in (*_PLACE, *PROPERTIES.values()) if name not in ("side", "updated_at")]
markers = sa.table(
    "markers",
    *(sa.column(name) for name in _own),
    sa.column("updated_at", sa.DateTime(timezone=True)),
    sa.column("spec", sa.JSON),
)
UPDATE_ONE = sa.text("UPDATE markers SET feature = :feature WHERE row = :row")
UPDATE_MANY = sa.text(
    """UPDATE markers m SET feature = n.feature
       FROM unnest(CAST(:rows AS bigint[]), CAST(:features AS text[])) AS n(row, feature) WHERE m.row = n.row"""
)


def upgrade() -> None:
    op.add_column("markers", sa.Column("feature", sa.Text(), server_default="", nullable=False))
    connection = op.get_bind()
    c = markers.c
    side = sa.case((c.family == "cerpm", c.spec["side"].as_string())).label("side")
    query = sa.select(*(c[name] for name in _own), c.updated_at, side).order_by(c.row).limit(CHUNK)
    last = -1
    while rows := connection.execute(query.where(c.row > last)).mappings().all():
        texts = [(row["row"], _text(row)) for row in rows]
        if connection.dialect.name == "postgresql":
            numbers, features = zip(*texts, strict=True)
            connection.execute(UPDATE_MANY, {"rows": list(numbers), "features": list(features)})
        else:
            connection.execute(UPDATE_ONE, [{"row": number, "feature": text} for number, text in texts])
        last = rows[-1]["row"]


def downgrade() -> None:
    op.drop_column("markers", "feature")


def _text(row: sa.RowMapping) -> str:
    place = (row["lon_deg"], row["lat_deg"], row["height_m"])
    feature = {
        "type": "Feature",
        "id": row["id"],
        "geometry": {"type": "Point", "coordinates": place if place[2] is not None else place[:2]},
        "properties": {name: row[column] for name, column in PROPERTIES.items()},
    }
    return orjson.dumps(feature, option=orjson.OPT_UTC_Z | orjson.OPT_NAIVE_UTC).decode()
