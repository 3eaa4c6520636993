"""Tables. Every owned table has an ``agency_id``; migrations/ creates what is declared here, and a test compares."""

from __future__ import annotations

import sqlalchemy as sa

from app.markers.reading import STATUSES
from app.registry import column_types
from app.registry.column_types import ID, UtcTime, agency_column, one_of
from app.registry.column_types import metadata as metadata
from app.registry.work_tables import alignment_lanes as alignment_lanes
from app.registry.work_tables import alignments as alignments
from app.registry.work_tables import damage_report_contacts as damage_report_contacts
from app.registry.work_tables import damage_reports as damage_reports
from app.registry.work_tables import decode_versions as decode_versions
from app.registry.work_tables import events as events
from app.registry.work_tables import maintenance_items as maintenance_items
from app.registry.work_tables import marker_health as marker_health
from app.registry.work_tables import plan_markers as plan_markers
from app.registry.work_tables import plan_versions as plan_versions
from app.registry.work_tables import planned_markers as planned_markers
from app.registry.work_tables import plans as plans
from app.registry.work_tables import proof_units as proof_units
from app.registry.work_tables import public_pages as public_pages
from app.registry.work_tables import reprocessed_decodes as reprocessed_decodes
from app.registry.work_tables import reprocessings as reprocessings
from app.registry.work_tables import stored_bytes as stored_bytes
from app.registry.work_tables import unregistered_readings as unregistered_readings
from app.registry.work_tables import upload_parts as upload_parts
from app.registry.work_tables import uploads as uploads
from app.registry.work_tables import webhook_deliveries as webhook_deliveries
from app.registry.work_tables import webhooks as webhooks

agencies = sa.Table(
    "agencies",
    metadata,
    sa.Column("id", ID, primary_key=True),
    sa.Column("name", sa.String(200), nullable=False, unique=True),
    sa.Column("created_at", UtcTime, nullable=False),
)


api_keys = sa.Table(
    "api_keys",
    metadata,
    sa.Column("id", ID, primary_key=True),
    agency_column(),
    sa.Column("holder_id", ID, nullable=False),  # keys that replace one another have the id of the first
    sa.Column("label", sa.String(200), nullable=False),
    sa.Column("prefix", sa.String(16), nullable=False),
    sa.Column("sha256", sa.String(64), nullable=False, unique=True),
    sa.Column("scope", sa.String(16), nullable=False),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("expires_at", UtcTime),
    sa.Column("revoked_at", UtcTime),
    sa.Column("last_used_at", UtcTime),
    one_of("scope", column_types.SCOPES),
)

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

# what changed an agency's part of the registry: a chain, each entry with the hash of the one before (audit.py)
audit_log = sa.Table(
    "audit_log",
    metadata,
    sa.Column("agency_id", ID, sa.ForeignKey("agencies.id"), primary_key=True),
    sa.Column("number", sa.BigInteger, primary_key=True, autoincrement=False),
    sa.Column("at", UtcTime, nullable=False),
    sa.Column("who", sa.String(200), nullable=False),
    sa.Column("key_id", sa.String(200)),
    sa.Column("action", sa.String(40), nullable=False),
    sa.Column("subject", sa.String(200)),
    sa.Column("detail", sa.JSON(none_as_null=True)),
    sa.Column("versions", sa.BigInteger, nullable=False),
    sa.Column("digest", sa.String(64), nullable=False),
    sa.Column("previous_hash", sa.String(64), nullable=False),
    sa.Column("hash", sa.String(64), nullable=False),
)

# where the magnets of magnet markers lie: what follows from their layouts, kept for searches
magnets = sa.Table(
    "magnets",
    metadata,
    sa.Column("row", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), primary_key=True, autoincrement=True),
    sa.Column("marker_id", ID, sa.ForeignKey("markers.id"), nullable=False),
    sa.Column("number", sa.Integer, nullable=False),
    agency_column(),
    sa.Column("lon_deg", sa.Double, nullable=False),
    sa.Column("lat_deg", sa.Double, nullable=False),
    sa.Column("polarity", sa.String(1), nullable=False),
    sa.Column("phi_deg", sa.Integer, nullable=False),
    sa.UniqueConstraint("marker_id", "number"),
    sqlite_autoincrement=True,
)

codebooks = sa.Table(
    "codebooks",
    metadata,
    sa.Column("id", ID, primary_key=True),
    agency_column(),
    sa.Column("name", sa.String(80), nullable=False),
    sa.Column("design", sa.JSON, nullable=False),
    sa.Column("rules", sa.JSON, nullable=False),
    sa.Column("figures", sa.JSON, nullable=False),
    sa.Column("entries", sa.JSON, nullable=False),
    sa.Column("version", sa.Integer, nullable=False),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("updated_at", UtcTime, nullable=False),
    sa.UniqueConstraint("agency_id", "name"),
    sa.Index("ix_codebooks_agency_id_id", "agency_id", "id"),
)

# the key that an agency's CERPMs derive theirs from, encrypted under the server's own
agency_secrets = sa.Table(
    "agency_secrets",
    metadata,
    sa.Column("agency_id", ID, sa.ForeignKey("agencies.id"), primary_key=True),
    sa.Column("wrapped", sa.LargeBinary, nullable=False),
    sa.Column("created_at", UtcTime, nullable=False),
)

# which transmissions of a CERPM were received and when: what is sent again is known by it
cerpm_spans = sa.Table(
    "cerpm_spans",
    metadata,
    sa.Column("row", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), primary_key=True, autoincrement=True),
    agency_column(),
    sa.Column("number", sa.BigInteger, nullable=False),
    sa.Column("first_sequence", sa.BigInteger, nullable=False),
    sa.Column("last_sequence", sa.BigInteger, nullable=False),
    sa.Column("first_heard_s", sa.Double),  # seconds since 1970-01-01 UTC; null where the log had no times
    sa.Column("last_heard_s", sa.Double),
    sa.Column("decode_id", ID, sa.ForeignKey("decodes.id"), nullable=False),
    sa.Index("ix_cerpm_spans_agency_id_number", "agency_id", "number"),
    sqlite_autoincrement=True,
)

# an upload that is decoded; one that is not decoded while its sender waits has a job of the same id
decodes = sa.Table(
    "decodes",
    metadata,
    sa.Column("id", ID, primary_key=True),
    agency_column(),
    sa.Column("kind", sa.String(32), nullable=False),  # of the upload
    sa.Column("holder_id", sa.String(200)),  # of the key that uploaded it
    sa.Column("context", sa.JSON, nullable=False),
    sa.Column("upload_key", sa.String(200)),
    sa.Column("upload_bytes", sa.BigInteger),
    sa.Column("upload_sha256", sa.String(64)),
    sa.Column("picture_key", sa.String(200)),
    sa.Column("result", sa.JSON(none_as_null=True)),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("finished_at", UtcTime),  # when the result was stored
    sa.Column("decoder", sa.String(200)),  # of the result, with its release
    sa.Index("ix_decodes_agency_id_id", "agency_id", "id"),
)

# work that outlives the request that asked for it; what is true of a job is true in its row, and nowhere else
UNFINISHED_JOBS = sa.text("state IN ('queued', 'running')")
jobs = sa.Table(
    "jobs",
    metadata,
    sa.Column("id", ID, primary_key=True),
    agency_column(),
    sa.Column("holder_id", sa.String(200)),  # of the key that asked for it
    sa.Column("kind", sa.String(32), nullable=False),
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("attempts", sa.Integer, nullable=False, server_default="0"),
    sa.Column("progress", sa.Double, nullable=False, server_default="0"),
    sa.Column("cancel_requested", sa.Boolean, nullable=False, server_default=sa.false()),
    sa.Column("input", sa.JSON, nullable=False),
    sa.Column("upload_key", sa.String(200)),
    sa.Column("result", sa.JSON(none_as_null=True)),
    sa.Column("error", sa.JSON(none_as_null=True)),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("finished_at", UtcTime),
    sa.Column("subject_id", ID),  # of the row that it is about, e.g. a plan
    sa.Column("steps_done", sa.Integer),
    sa.Column("steps_total", sa.Integer),
    sa.Column("started_at", UtcTime),  # first
    sa.Column("runner", sa.String(100)),  # the run of a job that has the lease
    sa.Column("lease_until", UtcTime),
    sa.Column("turn_at", UtcTime),  # when it was started last
    sa.Column("dead_letter", sa.Boolean, nullable=False, server_default=sa.false()),
    sa.Column("traceparent", sa.String(55)),  # of the span that made it
    one_of("state", column_types.JOB_STATES),
    sa.Index("ix_jobs_agency_id_kind_id", "agency_id", "kind", "id"),
    sa.Index("ix_jobs_agency_id_id", "agency_id", "id"),
    sa.Index("ix_jobs_state", "state"),
    sa.Index("ix_jobs_subject_id", "subject_id"),
    sa.Index("ix_jobs_agency_id_kind_turn_at", "agency_id", "kind", "turn_at"),
    sa.Index(
        "ix_jobs_unfinished",
        "kind",
        "agency_id",
        "id",
        postgresql_where=UNFINISHED_JOBS,
        sqlite_where=UNFINISHED_JOBS,
    ),
)

observations = sa.Table(
    "observations",
    metadata,
    sa.Column("decode_id", ID, sa.ForeignKey("decodes.id"), primary_key=True),
    sa.Column("marker_id", ID, sa.ForeignKey("markers.id"), primary_key=True),
    sa.Column("frame", sa.Integer, primary_key=True, autoincrement=False, server_default="0"),
    agency_column(),
    sa.Column("at", UtcTime, nullable=False),
    sa.Column("what", sa.String(32), nullable=False),
    sa.Column("detail", sa.JSON(none_as_null=True)),
    sa.Index("ix_observations_marker_id_at", "marker_id", "at"),
)

idempotency_keys = sa.Table(
    "idempotency_keys",
    metadata,
    sa.Column("agency_id", ID, sa.ForeignKey("agencies.id"), primary_key=True),
    sa.Column("holder_id", sa.String(200), primary_key=True, server_default=""),  # whose request; empty: a job's own
    sa.Column("key", sa.String(200), primary_key=True),
    sa.Column("request_sha256", sa.String(64), nullable=False),
    sa.Column("response", sa.JSON, nullable=False),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("expires_at", UtcTime, nullable=False),
    sa.Index("ix_idempotency_keys_expires_at", "expires_at"),
)

roads = sa.Table(
    "roads",
    metadata,
    sa.Column("id", ID, primary_key=True),
    agency_column(),
    sa.Column("name", sa.String(200), nullable=False),
    sa.Column("parts", sa.JSON, nullable=False),  # of the axis: lines of longitude and latitude
    sa.Column("given", sa.JSON, nullable=False),  # frame of the geometry as it came
    sa.Column("calibration", sa.JSON, nullable=False),
    sa.Column("length_m", sa.Double, nullable=False),
    sa.Column("from_m", sa.Double, nullable=False),
    sa.Column("to_m", sa.Double, nullable=False),
    sa.Column("localization_grade", sa.String(64), nullable=False),
    sa.Column("transform_note", sa.String(500)),
    sa.Column("version", sa.Integer, nullable=False),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("updated_at", UtcTime, nullable=False),
    sa.UniqueConstraint("agency_id", "name"),
    sa.Index("ix_roads_agency_id_id", "agency_id", "id"),
)

road_versions = sa.Table(
    "road_versions",
    metadata,
    sa.Column("road_id", ID, sa.ForeignKey("roads.id"), primary_key=True),
    sa.Column("version", sa.Integer, primary_key=True, autoincrement=False),
    agency_column(),
    sa.Column("at", UtcTime, nullable=False),
    sa.Column("who", sa.String(200), nullable=False),
    sa.Column("why", sa.String(500)),
    sa.Column("road", sa.JSON, nullable=False),
)

VEHICLE_STATUSES = ("active", "retired")

vehicles = sa.Table(
    "vehicles",
    metadata,
    sa.Column("id", ID, primary_key=True),
    agency_column(),
    sa.Column("name", sa.String(80), nullable=False),
    sa.Column("status", sa.String(16), nullable=False),
    sa.Column("note", sa.String(500)),
    sa.Column("profile", sa.JSON, nullable=False),  # the part of a decode's context that stays the same
    sa.Column("version", sa.Integer, nullable=False),
    # counted in the transaction that stores an upload or its result; they make no version
    sa.Column("uploads", sa.BigInteger, nullable=False, server_default="0"),
    sa.Column("driven_m", sa.Double, nullable=False, server_default="0"),
    sa.Column("last_seen_at", UtcTime),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("updated_at", UtcTime, nullable=False),
    sa.UniqueConstraint("agency_id", "name"),
    one_of("status", VEHICLE_STATUSES),
    sa.Index("ix_vehicles_agency_id_id", "agency_id", "id"),
)

vehicle_versions = sa.Table(
    "vehicle_versions",
    metadata,
    sa.Column("vehicle_id", ID, sa.ForeignKey("vehicles.id"), primary_key=True),
    sa.Column("version", sa.Integer, primary_key=True, autoincrement=False),
    agency_column(),
    sa.Column("at", UtcTime, nullable=False),
    sa.Column("who", sa.String(200), nullable=False),
    sa.Column("why", sa.String(500)),
    sa.Column("vehicle", sa.JSON, nullable=False),
)

# holders of keys that speak for a vehicle: api_keys.holder_id, which stays when a key is replaced
vehicle_keys = sa.Table(
    "vehicle_keys",
    metadata,
    sa.Column("agency_id", ID, sa.ForeignKey("agencies.id"), primary_key=True),
    sa.Column("key_id", sa.String(200), primary_key=True),
    sa.Column("vehicle_id", ID, sa.ForeignKey("vehicles.id"), nullable=False),
    sa.Index("ix_vehicle_keys_vehicle_id", "vehicle_id"),
)

vehicle_uploads = sa.Table(
    "vehicle_uploads",
    metadata,
    sa.Column("decode_id", ID, sa.ForeignKey("decodes.id"), primary_key=True),
    sa.Column("vehicle_id", ID, sa.ForeignKey("vehicles.id"), nullable=False),
    agency_column(),
    sa.Column("version", sa.Integer, nullable=False),  # of the vehicle's profile
    sa.Column("driven_m", sa.Double),  # null until the decode is done
    sa.Index("ix_vehicle_uploads_vehicle_id_decode_id", "vehicle_id", "decode_id"),
)

calibrations = sa.Table(
    "calibrations",
    metadata,
    sa.Column("id", ID, primary_key=True),
    agency_column(),
    sa.Column("who", sa.String(200), nullable=False),
    sa.Column("result", sa.JSON, nullable=False),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Index("ix_calibrations_agency_id_id", "agency_id", "id"),
)
