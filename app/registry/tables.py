"""All tables: each is declared beside its queries; migrations/ creates what is declared, and a test compares.

And which of their columns are keys of blobs.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

import sqlalchemy as sa

from app.registry import (
    agencies,
    audit,
    decodes,
    health,
    jobs,
    marker_rows,
    markers,
    plan_features,
    plan_states,
    plans,
    public_pages,
    reprocessings,
    roads,
    uploads,
    vehicles,
    webhooks,
)
from app.registry.column_types import AnySelect, metadata
from app.registry.jobs import JobKind

DECLARED_IN = (
    agencies, audit, decodes, health, jobs, marker_rows, markers, plan_features, plan_states, plans, public_pages,
    reprocessings, roads, uploads, vehicles, webhooks,
)  # fmt: skip
"""Modules that declare tables; with all of them imported, `metadata` is complete."""
__all__ = ["BLOB_COLUMNS", "DECLARED_IN", "blob_references", "metadata"]

BLOB_COLUMNS = (
    decodes.decodes.c.upload_key,
    decodes.decodes.c.picture_key,
    jobs.jobs.c.upload_key,
    uploads.upload_parts.c.blob_key,
    uploads.uploads.c.store_key,
    plans.alignments.c.source_key,
    plan_states.plans.c.document_key,
    public_pages.damage_reports.c.photo_key,
    reprocessings.decode_versions.c.picture_key,
    reprocessings.reprocessed_decodes.c.picture_key,
)
"""Columns that are the key of a blob."""
_DOCUMENTS = (plan_states.plans.c.proof, jobs.jobs.c.input, jobs.jobs.c.result)
"""JSON in which keys of blobs stand."""
_KEY = re.compile(r"[a-z]+/[0-9a-f]{2}/[0-9a-f]{32}")
_ROWS = 10_000


def blob_references(connection: sa.Connection) -> Iterator[str]:
    """Keys of all blobs that rows of any agency refer to; some of them more than once."""
    for column in BLOB_COLUMNS:
        yield from _stream(connection, sa.select(column).where(column.is_not(None)))
    for column in _DOCUMENTS:
        query = sa.select(sa.cast(column, sa.Text)).where(column.is_not(None))
        if column.table is jobs.jobs:
            query = query.where(jobs.jobs.c.kind.not_in((JobKind.IMPORT, JobKind.REPROCESS)))  # large, and have no keys
        for text in _stream(connection, query):
            yield from _KEY.findall(text)


def _stream(connection: sa.Connection, query: AnySelect) -> Iterator[str]:
    with connection.execute(query.execution_options(yield_per=_ROWS)) as rows:
        yield from rows.scalars()
