"""Recordings of magnetometers -> findings, matches, fixes and observations: at once, or as a job."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Any

import sqlalchemy as sa

from app.decoders.magnet.book import TagFormat
from app.decoders.magnet.registered import ReadTrace, match_tags
from app.registry import codebooks
from app.registry import decodes as store
from app.services.codebook_documents import MAX_BOOKS_SEARCHED, book_of
from app.services.decode_context import DecodeContext
from app.services.decode_rules import DecodeRules
from app.services.frames import Blobs
from app.services.trace_documents import trace_document
from app.services.trace_reading import NearbyTags, find_nearby_tags, trace_observations
from app.services.traces import PendingTrace, TraceDecoder, TraceResult, TraceTask, trace_terms
from app.storage.blobs import new_blob_key

TRACE = "trace"
PICTURES = "pictures"


@dataclass(frozen=True, slots=True)
class StartedTrace:
    """A recording in a decoder process, and what the registry has near by."""

    nearby: NearbyTags
    pending: PendingTrace


def start_trace(
    connection: sa.Connection, agency_id: str, decoder: TraceDecoder, data: bytes, context: DecodeContext,
    rules: DecodeRules, *, wait_s: float = 0.0,
) -> StartedTrace:  # fmt: skip
    """Hand a recording to a decoder process, with the tags that may be met.

    Raises
    ------
    Unavailable
        The decoder processes are busy.
    """
    declared = context.trace or {}
    nearby = find_nearby_tags(connection, agency_id, context.coarse_position, trace_terms(declared).reach_m)
    formats = () if nearby.texts else _book_formats(connection, agency_id)
    name = str(declared.get("file_name") or "recording")
    task = TraceTask(name, data, declared, nearby.texts, formats, rules.traces)
    return StartedTrace(nearby, decoder.start_trace(task, wait_s=wait_s))


def _book_formats(connection: sa.Connection, agency_id: str) -> tuple[TagFormat, ...]:
    """Formats of the agency's codebooks: what tags look like where none is registered near by."""
    rows = codebooks.list_codebooks(connection, agency_id, after=None, limit=MAX_BOOKS_SEARCHED)
    designs = [book_of(row).design for row in rows]
    return tuple(dict.fromkeys(TagFormat(d.magnets, d.length_m, d.segment_m) for d in designs))


def finished_columns(
    result: TraceResult, started: StartedTrace, context: DecodeContext, blobs: Blobs
) -> tuple[dict[str, Any], ReadTrace]:
    """Columns of a decode that is done, its plot stored, and what was read."""
    trace = match_tags(result.findings, started.nearby.tags, trace_terms(context.trace or {}).bar)
    document = trace_document(result, trace, codebook_tags=len(started.nearby.texts))
    picture_key = new_blob_key(PICTURES)
    blobs.put(picture_key, result.plot)
    return {"state": "done", "progress": 1.0, "result": document, "picture_key": picture_key}, trace


def store_observations(
    connection: sa.Connection, agency_id: str, decode_id: str, trace: ReadTrace, seen_at: datetime
) -> None:
    """Note which registered tags were passed."""
    store.add_observations(connection, agency_id, trace_observations(decode_id, trace, seen_at))
