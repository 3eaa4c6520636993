"""Tables of marker health: events, the state of each marker's tests, the work list, and readings of unknown codes."""

from __future__ import annotations

import sqlalchemy as sa

from app.registry.column_types import ID, UtcTime, agency_column, one_of
from app.registry.metadata import metadata

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
