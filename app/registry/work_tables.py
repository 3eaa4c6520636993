"""Tables of plans, uploads, reprocessings, marker health, public pages and webhooks; `app.registry.tables` has all."""

from __future__ import annotations

import sqlalchemy as sa

from app.registry import column_types
from app.registry.column_types import ID, UtcTime, agency_column, metadata, one_of

# === Tables of alignments, of plans with their history and markers, and of finished units of proofs.


alignments = sa.Table(
    "alignments",
    metadata,
    sa.Column("id", ID, primary_key=True),
    agency_column(),
    sa.Column("name", sa.String(80), nullable=False),
    sa.Column("source_key", sa.String(200), nullable=False),  # of the blob with the file as it came
    sa.Column("source_sha256", sa.String(64), nullable=False),
    sa.Column("declaration", sa.JSON, nullable=False),
    sa.Column("summary", sa.JSON, nullable=False),
    sa.Column("version", sa.Integer, nullable=False),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("updated_at", UtcTime, nullable=False),
    sa.UniqueConstraint("agency_id", "name"),
    sa.Index("ix_alignments_agency_id_id", "agency_id", "id"),
)

plans = sa.Table(
    "plans",
    metadata,
    sa.Column("id", ID, primary_key=True),
    agency_column(),
    sa.Column("alignment_id", ID, sa.ForeignKey("alignments.id"), nullable=False),
    sa.Column("name", sa.String(80), nullable=False),
    sa.Column("status", sa.String(16), nullable=False),
    sa.Column("rules", sa.JSON, nullable=False),
    sa.Column("document_key", sa.String(200), nullable=False),  # of the blob with the placed markers
    sa.Column("summary", sa.JSON, nullable=False),
    sa.Column("proof", sa.JSON(none_as_null=True)),
    sa.Column("author", sa.String(200), nullable=False),
    sa.Column("author_id", sa.String(200), nullable=False),  # holder of the key that made what is to be approved
    sa.Column("approver", sa.String(200)),
    sa.Column("version", sa.Integer, nullable=False),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("updated_at", UtcTime, nullable=False),
    one_of("status", column_types.PLAN_STATUSES),
    sa.UniqueConstraint("agency_id", "name"),
    sa.Index("ix_plans_agency_id_id", "agency_id", "id"),
    sa.Index("ix_plans_alignment_id", "alignment_id"),
)

plan_versions = sa.Table(
    "plan_versions",
    metadata,
    sa.Column("plan_id", ID, sa.ForeignKey("plans.id"), primary_key=True),
    sa.Column("version", sa.Integer, primary_key=True, autoincrement=False),
    agency_column(),
    sa.Column("at", UtcTime, nullable=False),
    sa.Column("who", sa.String(200), nullable=False),
    sa.Column("why", sa.String(500)),
    sa.Column("plan", sa.JSON, nullable=False),
)

plan_markers = sa.Table(
    "plan_markers",
    metadata,
    sa.Column("plan_id", ID, sa.ForeignKey("plans.id"), primary_key=True),
    sa.Column("number", sa.Integer, primary_key=True, autoincrement=False),  # of the first of its planned markers
    agency_column(),
    sa.Column("marker_id", ID, sa.ForeignKey("markers.id"), nullable=False),
    sa.Index("ix_plan_markers_marker_id", "marker_id"),
)

proof_units = sa.Table(
    "proof_units",
    metadata,
    sa.Column("job_id", ID, sa.ForeignKey("jobs.id"), primary_key=True),
    sa.Column("number", sa.Integer, primary_key=True, autoincrement=False),  # of the unit among those of the proof
    agency_column(),
    sa.Column("result", sa.JSON, nullable=False),
)


# === Tables of what GIS clients read of alignments and plans: lanes, and markers that are planned in plans.
#
# Both are copies of what the blobs of alignments and plans contain, written in the same transaction.


FEATURE_ID = sa.String(48)
"""Id of an alignment or a plan, a point, and a number of five or seven digits, so that texts are in its order."""

alignment_lanes = sa.Table(
    "alignment_lanes",
    metadata,
    sa.Column("id", FEATURE_ID, primary_key=True),
    agency_column(),
    sa.Column("alignment_id", ID, sa.ForeignKey("alignments.id"), nullable=False),
    sa.Column("west_deg", sa.Double, nullable=False),
    sa.Column("south_deg", sa.Double, nullable=False),
    sa.Column("east_deg", sa.Double, nullable=False),
    sa.Column("north_deg", sa.Double, nullable=False),
    sa.Column("properties", sa.JSON, nullable=False),
    sa.Column("points_deg", sa.JSON, nullable=False),
    sa.Index("ix_alignment_lanes_agency_id_id", "agency_id", "id"),
)

planned_markers = sa.Table(
    "planned_markers",
    metadata,
    # the integer key is what the spatial index refers to
    sa.Column("row", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), primary_key=True, autoincrement=True),
    sa.Column("id", FEATURE_ID, nullable=False, unique=True),
    agency_column(),
    sa.Column("plan_id", ID, sa.ForeignKey("plans.id"), nullable=False),
    sa.Column("number", sa.Integer, nullable=False),
    sa.Column("family", sa.String(16), nullable=False),
    sa.Column("code", sa.String(64), nullable=False),
    sa.Column("purpose", sa.String(32), nullable=False),
    sa.Column("lane", sa.Text, nullable=False),
    sa.Column("side", sa.String(16)),
    sa.Column("chainage_m", sa.Double, nullable=False),
    sa.Column("station_m", sa.Double, nullable=False),
    sa.Column("offset_m", sa.Double, nullable=False),
    sa.Column("heading_deg", sa.Double, nullable=False),
    sa.Column("vertical_datum", sa.String(64)),
    sa.Column("lon_deg", sa.Double, nullable=False),
    sa.Column("lat_deg", sa.Double, nullable=False),
    sa.Column("height_m", sa.Double),
    # the feature between its id and what follows from the plan: registry/features_of_plans.py
    sa.Column("feature", sa.Text, nullable=False),
    sa.Index("ix_planned_markers_agency_id_id", "agency_id", "id"),
    sa.Index("ix_planned_markers_plan_id", "plan_id"),
    sqlite_autoincrement=True,
)


# === Tables of uploads: those that arrive in parts, their parts, and how much each key has stored.


UPLOAD_STATES = ("open", "done", "refused", "expired")
UPLOAD_METHODS = ("tus", "s3-parts")

# an upload that arrives in parts; what was received is what its parts hold, and both are written in one transaction
uploads = sa.Table(
    "uploads",
    metadata,
    sa.Column("id", ID, primary_key=True),
    agency_column(),
    sa.Column("holder_id", sa.String(200), nullable=False),  # of the key that uploads
    sa.Column("label", sa.String(200), nullable=False),
    sa.Column("scope", sa.String(16), nullable=False),
    sa.Column("method", sa.String(16), nullable=False),
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("length", sa.BigInteger, nullable=False),  # of the whole file [byte]
    sa.Column("received", sa.BigInteger, nullable=False),  # [byte]
    sa.Column("declared", sa.JSON, nullable=False),  # name of the file, context and vehicle
    sa.Column("lock_id", ID),  # of the request that writes
    sa.Column("locked_until", UtcTime),
    sa.Column("store_key", sa.String(200)),  # of the object that an upload to S3 becomes
    sa.Column("store_upload_id", sa.String(1024)),
    sa.Column("decode_id", ID),
    sa.Column("error", sa.JSON(none_as_null=True)),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("expires_at", UtcTime, nullable=False),
    one_of("state", UPLOAD_STATES),
    one_of("method", UPLOAD_METHODS),
    sa.Index("ix_uploads_agency_id_state", "agency_id", "state"),
    sa.Index("ix_uploads_state_expires_at", "state", "expires_at"),
)

upload_parts = sa.Table(
    "upload_parts",
    metadata,
    sa.Column("upload_id", ID, sa.ForeignKey("uploads.id"), primary_key=True),
    sa.Column("start", sa.BigInteger, primary_key=True),  # its first byte in the file
    agency_column(),
    sa.Column("size", sa.BigInteger, nullable=False),  # [byte]
    sa.Column("sha256", sa.String(64), nullable=False),
    sa.Column("blob_key", sa.String(200), nullable=False),
)

# bytes of stored uploads, a row for each key: quotas need no sum over all decodes
stored_bytes = sa.Table(
    "stored_bytes",
    metadata,
    sa.Column("agency_id", ID, sa.ForeignKey("agencies.id"), primary_key=True),
    sa.Column("holder_id", sa.String(200), primary_key=True),
    sa.Column("bytes", sa.BigInteger, nullable=False),
)


# === Tables of reprocessings: what a newer decoder reads in stored uploads, and the results that it replaced.


reprocessings = sa.Table(
    "reprocessings",
    metadata,
    sa.Column("id", ID, primary_key=True),
    agency_column(),
    sa.Column("who", sa.String(200), nullable=False),
    sa.Column("criteria", sa.JSON, nullable=False),
    sa.Column("decodes", sa.Integer, nullable=False),  # to be decoded again
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("accepted_at", UtcTime),
    sa.Column("accepted_by", sa.String(200)),
    sa.Index("ix_reprocessings_agency_id_id", "agency_id", "id"),
)

reprocessed_decodes = sa.Table(
    "reprocessed_decodes",
    metadata,
    sa.Column("reprocessing_id", ID, sa.ForeignKey("reprocessings.id"), primary_key=True),
    sa.Column("decode_id", ID, sa.ForeignKey("decodes.id"), primary_key=True),
    agency_column(),
    sa.Column("decoder_before", sa.String(200)),
    sa.Column("decoder", sa.String(200)),
    sa.Column("result", sa.JSON(none_as_null=True)),  # null where it failed
    sa.Column("picture_key", sa.String(200)),
    sa.Column("error", sa.JSON(none_as_null=True)),
    sa.Column("changes", sa.JSON, nullable=False),
    sa.Column("gained", sa.Integer, nullable=False),
    sa.Column("lost", sa.Integer, nullable=False),
    sa.Column("changed", sa.Integer, nullable=False),
    sa.Column("same", sa.Integer, nullable=False),
)

# results that were current before; the newest is in `decodes`
decode_versions = sa.Table(
    "decode_versions",
    metadata,
    sa.Column("decode_id", ID, sa.ForeignKey("decodes.id"), primary_key=True),
    sa.Column("reprocessing_id", ID, sa.ForeignKey("reprocessings.id"), primary_key=True),  # that replaced it
    agency_column(),
    sa.Column("decoder", sa.String(200)),
    sa.Column("result", sa.JSON, nullable=False),
    sa.Column("picture_key", sa.String(200)),
    sa.Column("finished_at", UtcTime),
    sa.Column("replaced_at", UtcTime, nullable=False),
)


# === Tables of marker health: events, the state of each marker's tests, the work list, and readings of unknown codes.


_COUNTED = sa.BigInteger().with_variant(sa.Integer(), "sqlite")

# what happened that others want to know: written in the transaction in which it happens. Writes come one after
# another, so ids rise in the order of commits, and whoever reads on after an id misses nothing
events = sa.Table(
    "events",
    metadata,
    sa.Column("id", _COUNTED, primary_key=True, autoincrement=True),
    agency_column(),
    sa.Column("kind", sa.String(40), nullable=False),
    sa.Column("subject_id", sa.String(200)),
    sa.Column("at", UtcTime, nullable=False),
    sa.Column("detail", sa.JSON(none_as_null=True)),
    sa.Index("ix_events_agency_id_id", "agency_id", "id"),
    sqlite_autoincrement=True,
)

# the tests of a marker, of a code that is not registered, or a vehicle's own errors: app/health/states.py
marker_health = sa.Table(
    "marker_health",
    metadata,
    sa.Column("agency_id", ID, sa.ForeignKey("agencies.id"), primary_key=True),
    sa.Column("subject", sa.String(200), primary_key=True),  # a marker's id, code:..., or vehicle:...
    sa.Column("marker_id", ID, sa.ForeignKey("markers.id")),
    sa.Column("lon_deg", sa.Double),  # of a code that is not registered
    sa.Column("lat_deg", sa.Double),
    sa.Column("passes", sa.BigInteger, nullable=False),
    sa.Column("reads", sa.BigInteger, nullable=False),
    sa.Column("read_at", UtcTime),  # last read at its place
    sa.Column("last_at", UtcTime, nullable=False),
    sa.Column("ratios", sa.JSON, nullable=False),  # logarithms of the likelihood ratios, by fault
    sa.Column("quality", sa.Double),  # mean of the record, in standard deviations of a pass
    sa.Column("state", sa.JSON, nullable=False),
    sa.Column("updated_at", UtcTime, nullable=False),
)

# what decodes read where nothing is registered
unregistered_readings = sa.Table(
    "unregistered_readings",
    metadata,
    sa.Column("decode_id", ID, sa.ForeignKey("decodes.id"), primary_key=True),
    sa.Column("number", sa.Integer, primary_key=True, autoincrement=False),
    agency_column(),
    sa.Column("family", sa.String(16), nullable=False),
    sa.Column("code", sa.String(64), nullable=False),
    sa.Column("lon_deg", sa.Double, nullable=False),
    sa.Column("lat_deg", sa.Double, nullable=False),
    sa.Column("confidence", sa.Double, nullable=False),
    sa.Column("at", UtcTime, nullable=False),
)

ITEM_STATES = ("open", "approved", "dismissed")

# the work list: faults that are suspected, and what people decided
maintenance_items = sa.Table(
    "maintenance_items",
    metadata,
    # the integer key is what the spatial index refers to
    sa.Column("row", _COUNTED, primary_key=True, autoincrement=True),
    sa.Column("id", ID, nullable=False, unique=True),
    agency_column(),
    sa.Column("subject", sa.String(200), nullable=False),
    sa.Column("marker_id", ID, sa.ForeignKey("markers.id")),
    sa.Column("decode_id", ID, sa.ForeignKey("decodes.id")),  # that made it an item
    sa.Column("family", sa.String(16), nullable=False),
    sa.Column("code", sa.String(64)),
    sa.Column("what", sa.String(32), nullable=False),
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("outcome", sa.String(16)),
    sa.Column("road", sa.String(200)),
    sa.Column("measure_m", sa.Double),
    sa.Column("lon_deg", sa.Double, nullable=False),
    sa.Column("lat_deg", sa.Double, nullable=False),
    sa.Column("height_m", sa.Double),
    sa.Column("priority", sa.Double, nullable=False),
    sa.Column("ratio", sa.Double, nullable=False),
    sa.Column("vehicles", sa.Integer, nullable=False),
    sa.Column("passes", sa.Integer, nullable=False),
    sa.Column("first_at", UtcTime, nullable=False),
    sa.Column("last_at", UtcTime, nullable=False),
    sa.Column("evidence", sa.JSON, nullable=False),
    sa.Column("note", sa.String(500)),
    sa.Column("decided_by", sa.String(200)),
    sa.Column("decided_at", UtcTime),
    sa.Column("version", sa.Integer, nullable=False),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("updated_at", UtcTime, nullable=False),
    # the feature that GIS clients read, written with every change of the row
    sa.Column("feature", sa.Text, nullable=False),
    one_of("state", ITEM_STATES),
    sa.Index("ix_maintenance_items_agency_id_id", "agency_id", "id"),
    sa.Index("ix_maintenance_items_agency_id_subject", "agency_id", "subject"),
    sa.Index("ix_maintenance_items_agency_id_state_priority_id", "agency_id", "state", "priority", "id"),
    sqlite_autoincrement=True,
)


# === Tables of public pages: what agencies release, and the damage reports that come from the pages.


REPORT_KINDS = ("damaged", "dirty", "missing", "loose", "other")
REPORT_STATES = ("new", "accepted", "rejected")

# what an agency releases; without a row, `app.registry.public_pages.DEFAULT`
public_pages = sa.Table(
    "public_pages",
    metadata,
    sa.Column("agency_id", ID, sa.ForeignKey("agencies.id"), primary_key=True),
    sa.Column("fields", sa.JSON, nullable=False),
    sa.Column("damage_reports", sa.Boolean, nullable=False),
    sa.Column("version", sa.Integer, nullable=False),
    sa.Column("updated_at", UtcTime, nullable=False),
)

damage_reports = sa.Table(
    "damage_reports",
    metadata,
    sa.Column("id", ID, primary_key=True),
    agency_column(),
    sa.Column("marker_id", ID, sa.ForeignKey("markers.id"), nullable=False),
    sa.Column("form_nonce", sa.String(32), nullable=False),  # of the form: one that is sent twice is one report
    sa.Column("kind", sa.String(16), nullable=False),
    sa.Column("text", sa.String(2000)),
    sa.Column("language", sa.String(8), nullable=False),
    sa.Column("photo_key", sa.String(200)),
    sa.Column("photo_bytes", sa.BigInteger),
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("note", sa.String(500)),
    sa.Column("item_id", ID, sa.ForeignKey("maintenance_items.id")),  # that the report was accepted into
    sa.Column("decided_by", sa.String(200)),
    sa.Column("decided_at", UtcTime),
    sa.Column("created_at", UtcTime, nullable=False),
    one_of("kind", REPORT_KINDS),
    one_of("state", REPORT_STATES),
    sa.UniqueConstraint("marker_id", "form_nonce"),
    sa.Index("ix_damage_reports_agency_id_id", "agency_id", "id"),
    sa.Index("ix_damage_reports_agency_id_state_id", "agency_id", "state", "id"),
    sa.Index("ix_damage_reports_marker_id_state", "marker_id", "state"),
)

# apart from the reports, so that it can be deleted without them
damage_report_contacts = sa.Table(
    "damage_report_contacts",
    metadata,
    sa.Column("report_id", ID, sa.ForeignKey("damage_reports.id"), primary_key=True),
    agency_column(),
    sa.Column("email", sa.String(254), nullable=False),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Index("ix_damage_report_contacts_created_at", "created_at"),
)


# === Tables of webhooks and of what is delivered to them.


WEBHOOK_STATES = ("active", "disabled")
DELIVERY_STATES = ("waiting", "delivered", "failed")

webhooks = sa.Table(
    "webhooks",
    metadata,
    sa.Column("id", ID, primary_key=True),
    agency_column(),
    sa.Column("url", sa.String(500), nullable=False),
    sa.Column("events", sa.JSON, nullable=False),  # kinds, or their beginnings with .*
    sa.Column("sealed_secret", sa.LargeBinary, nullable=False),  # under the server's key
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("reason", sa.String(500)),  # why it is disabled
    sa.Column("last_event_id", sa.BigInteger, nullable=False),  # up to which events have become deliveries
    sa.Column("last_success_at", UtcTime),
    sa.Column("who", sa.String(200), nullable=False),
    sa.Column("created_at", UtcTime, nullable=False),
    one_of("state", WEBHOOK_STATES),
    sa.Index("ix_webhooks_agency_id_id", "agency_id", "id"),
)

# one event for one webhook; a row is leased by moving `due_at`, so that two processes do not send it together
webhook_deliveries = sa.Table(
    "webhook_deliveries",
    metadata,
    sa.Column("id", ID, primary_key=True),
    agency_column(),
    sa.Column("webhook_id", ID, sa.ForeignKey("webhooks.id", ondelete="CASCADE"), nullable=False),
    sa.Column("event_id", sa.BigInteger, nullable=False),
    sa.Column("kind", sa.String(40), nullable=False),
    sa.Column("body", sa.Text, nullable=False),  # as it is signed and sent
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("attempts", sa.Integer, nullable=False, server_default="0"),
    sa.Column("due_at", UtcTime, nullable=False),
    sa.Column("give_up_at", UtcTime, nullable=False),
    sa.Column("status", sa.Integer),  # of the last response
    sa.Column("error", sa.String(300)),  # of the last attempt
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("ended_at", UtcTime),
    one_of("state", DELIVERY_STATES),
    sa.UniqueConstraint("webhook_id", "event_id"),
    sa.Index("ix_webhook_deliveries_state_due_at", "state", "due_at"),
    sa.Index("ix_webhook_deliveries_webhook_id_id", "webhook_id", "id"),
)
