"""Which blobs the rows refer to."""

from __future__ import annotations

import re
from collections.abc import Iterator

import sqlalchemy as sa

from app.registry.column_types import AnySelect
from app.registry.decodes import decodes
from app.registry.jobs import JobKind, jobs
from app.registry.plan_states import plans
from app.registry.plans import alignments
from app.registry.public_pages import damage_reports
from app.registry.reprocessings import decode_versions, reprocessed_decodes
from app.registry.uploads import upload_parts, uploads

COLUMNS = (
    decodes.c.upload_key,
    decodes.c.picture_key,
    jobs.c.upload_key,
    upload_parts.c.blob_key,
    uploads.c.store_key,
    alignments.c.source_key,
    plans.c.document_key,
    damage_reports.c.photo_key,
    decode_versions.c.picture_key,
    reprocessed_decodes.c.picture_key,
)
"""Columns that are the key of a blob."""
_DOCUMENTS = (plans.c.proof, jobs.c.input, jobs.c.result)
"""JSON in which keys of blobs stand."""
_KEY = re.compile(r"[a-z]+/[0-9a-f]{2}/[0-9a-f]{32}")
_ROWS = 10_000


def blob_references(connection: sa.Connection) -> Iterator[str]:
    """Keys of all blobs that rows of any agency refer to; some of them more than once."""
    for column in COLUMNS:
        yield from _stream(connection, sa.select(column).where(column.is_not(None)))
    for column in _DOCUMENTS:
        query = sa.select(sa.cast(column, sa.Text)).where(column.is_not(None))
        if column.table is jobs:
            query = query.where(jobs.c.kind.not_in((JobKind.IMPORT, JobKind.REPROCESS)))  # large, and have no keys
        for text in _stream(connection, query):
            yield from _KEY.findall(text)


def _stream(connection: sa.Connection, query: AnySelect) -> Iterator[str]:
    with connection.execute(query.execution_options(yield_per=_ROWS)) as rows:
        yield from rows.scalars()
