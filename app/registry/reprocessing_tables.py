"""Tables of reprocessings: what a newer decoder reads in stored uploads, and the results that it replaced."""

from __future__ import annotations

import sqlalchemy as sa

from app.registry.column_types import ID, UtcTime, agency_column
from app.registry.metadata import metadata

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
