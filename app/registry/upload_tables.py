"""Tables of uploads: those that arrive in parts, their parts, and how much each key has stored."""

from __future__ import annotations

import sqlalchemy as sa

from app.registry.column_types import ID, UtcTime, agency_column, one_of
from app.registry.metadata import metadata

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
