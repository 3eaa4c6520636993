"""Rows of markers outside the registry."""

from __future__ import annotations

from datetime import datetime
from typing import NamedTuple

import sqlalchemy as sa

from app.markers.reading import STATUSES, MarkerRow, Status
from app.registry import column_types
from app.registry.column_types import ID, UtcTime, agency_column, columns_of, metadata, one_of, select_rows

markers = sa.Table(
    "markers",
    metadata,
    # the integer key is what the spatial index refers to; clients only see the id
    sa.Column("row", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), primary_key=True, autoincrement=True),
    sa.Column("id", ID, nullable=False, unique=True),
    agency_column(),
    sa.Column("family", sa.String(16), nullable=False),
    sa.Column("status", sa.String(16), nullable=False),
    sa.Column("scheme", sa.String(16)),
    sa.Column("digits", sa.String(64)),
    sa.Column("check_digits", sa.Integer),
    sa.Column("digits_match_position", sa.Boolean),
    sa.Column("n", sa.Integer),
    sa.Column("unit_mm", sa.Double),
    sa.Column("gap_mm", sa.Double),
    sa.Column("thickness_mm", sa.Double),
    sa.Column("lon_deg", sa.Double, nullable=False),
    sa.Column("lat_deg", sa.Double, nullable=False),
    sa.Column("height_m", sa.Double),
    sa.Column("heading_deg", sa.Double),
    sa.Column("heading_rmse_deg", sa.Double),
    sa.Column("crs", sa.String(64), nullable=False),
    sa.Column("realization", sa.String(64)),
    sa.Column("epoch", sa.Double),
    sa.Column("vertical_datum", sa.String(64)),
    sa.Column("horizontal_rmse_m", sa.Double),
    sa.Column("vertical_rmse_m", sa.Double),
    sa.Column("survey_method", sa.String(200)),
    sa.Column("check_points", sa.Integer),
    sa.Column("surveyor", sa.String(200)),
    sa.Column("instrument", sa.String(200)),
    sa.Column("survey_file_sha256", sa.String(64)),
    sa.Column("transform_accuracy_m", sa.Double),
    sa.Column("original", sa.JSON, nullable=False),
    sa.Column("localization_grade", sa.String(64), nullable=False),
    sa.Column("transform_note", sa.String(500)),
    sa.Column("road", sa.String(200)),
    sa.Column("measure_m", sa.Double),
    sa.Column("offset_m", sa.Double),
    sa.Column("spec", sa.JSON(none_as_null=True)),  # what a family keeps besides: the lane and the layout of magnets
    sa.Column("version", sa.Integer, nullable=False),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("updated_at", UtcTime, nullable=False),
    # the GeoJSON feature that GIS clients read, written with every change of the row: registry/features.py
    sa.Column("feature", sa.Text, nullable=False, server_default=""),
    one_of("status", STATUSES),
    sa.CheckConstraint("lon_deg BETWEEN -180 AND 180 AND lat_deg BETWEEN -90 AND 90", name="position"),
    sa.Index("ix_markers_agency_id_id", "agency_id", "id"),
    sa.Index("ix_markers_agency_id_status_id", "agency_id", "status", "id"),
    sa.Index("ix_markers_agency_id_family_id", "agency_id", "family", "id"),
    sa.Index("ix_markers_digits", "digits"),
    sqlite_autoincrement=True,
)
# a registry number names one plate on the whole server, for ever
sa.Index(
    "uq_markers_id_digits",
    markers.c.digits,
    markers.c.n,
    unique=True,
    sqlite_where=markers.c.scheme == "id",
    postgresql_where=markers.c.scheme == "id",
)
# a CERPM's number names one marker of its agency, for ever
sa.Index(
    "uq_markers_cerpm_number",
    markers.c.agency_id,
    markers.c.digits,
    unique=True,
    sqlite_where=markers.c.family == "cerpm",
    postgresql_where=markers.c.family == "cerpm",
)
# a marker's place on its road; most markers of a survey name none
sa.Index(
    "ix_markers_agency_id_road_measure_m_id",
    markers.c.agency_id,
    markers.c.road,
    markers.c.measure_m,
    markers.c.id,
    sqlite_where=markers.c.road.is_not(None),
    postgresql_where=markers.c.road.is_not(None),
)

marker_versions = sa.Table(
    "marker_versions",
    metadata,
    sa.Column("marker_id", ID, sa.ForeignKey("markers.id"), primary_key=True),
    sa.Column("version", sa.Integer, primary_key=True, autoincrement=False),
    agency_column(),
    sa.Column("at", UtcTime, nullable=False),
    sa.Column("who", sa.String(200), nullable=False),
    sa.Column("why", sa.String(500)),
    sa.Column("marker", sa.JSON, nullable=False),
    sa.Column("kind", sa.String(16), nullable=False),
    sa.Column("audit_number", sa.BigInteger, nullable=False),
    sa.Column("sha256", sa.String(64), nullable=False),
    one_of("kind", column_types.VERSION_KINDS),
)


class CodeRow(NamedTuple):
    """What is known of a marker of any agency that carries a code."""

    id: str
    agency_id: str
    digits: str
    n: int
    scheme: str
    status: Status
    lon_deg: float
    lat_deg: float
    digits_match_position: bool | None


class VersionRow(NamedTuple):
    """One entry of a marker's history."""

    version: int
    at: datetime
    who: str
    why: str | None
    kind: str
    sha256: str
    audit_number: int
    marker: MarkerRow


PUBLIC = columns_of(MarkerRow, markers)
MARKERS = select_rows(MarkerRow, markers)
