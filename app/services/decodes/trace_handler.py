"""Recordings of magnetometers: through a decoder process, then matched against the registered information tags."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Any

import sqlalchemy as sa

from app.decoders.magnet.identify import TagFormat
from app.decoders.magnet.match import ReadTrace, match_tags
from app.errors import UnreadableUpload
from app.formats.spooled_file import SpooledFile
from app.geodesy import decimal_year
from app.registry.codebooks import CODEBOOKS, book_of
from app.registry.database import Database
from app.registry.decodes import NewObservation
from app.services.decoder_processes import DecoderProcesses, Pending
from app.services.decodes.context import DecodeContext
from app.services.decodes.kinds import DecodeKind
from app.services.decodes.rules import DecodeRules
from app.services.decodes.trace_documents import trace_document
from app.services.decodes.trace_matching import NearbyTags, find_nearby_tags
from app.services.decodes.trace_task import TraceResult, TraceTask, trace_terms
from app.services.decodes.upload_path import Decoded, Upload, UploadHandler
from app.services.health.evidence import EVIDENCE
from app.services.health.traces import missed_tags, tag_evidence
from app.services.markers.codebook_documents import MAX_BOOKS_SEARCHED


@dataclass(frozen=True, slots=True)
class TraceSignal:
    """What a decoder process found in a recording, and the tags that it was looking for."""

    result: TraceResult
    nearby: NearbyTags


@dataclass(frozen=True, slots=True)
class StartedTrace:
    """A recording in a decoder process."""

    nearby: NearbyTags
    pending: Pending[TraceResult]

    def result(self) -> TraceSignal:
        """Wait for the findings."""
        return TraceSignal(self.pending.result(), self.nearby)

    def cancel(self) -> None:
        """Stop the process."""
        self.pending.cancel()


class TraceHandler(UploadHandler[TraceSignal]):
    """Magnetometer traces. Short ones are decoded while the caller waits."""

    kind = DecodeKind.TRACE

    def __init__(self, database: Database, processes: DecoderProcesses, rules: DecodeRules) -> None:
        self._database, self._processes, self._rules = database, processes, rules

    def accepts(self, context: DecodeContext, file: SpooledFile) -> bool:
        """Uploads whose context declares a trace."""
        return context.trace is not None

    def is_job(self, file: SpooledFile) -> bool:
        """Whether the recording is longer than `DecodeRules.immediate_trace_bytes`."""
        check_not_empty(file)
        return file.size > self._rules.immediate_trace_bytes

    def start(self, upload: Upload) -> StartedTrace:
        """Hand the recording over with the tags that the drive can have passed."""
        declared = upload.context.trace or {}
        position, reach_m = upload.context.coarse_position, trace_terms(declared).reach_m
        with self._database.read() as connection:
            epoch = decimal_year(upload.observed_at)
            nearby = find_nearby_tags(connection, upload.agency_id, position, reach_m, epoch)
            formats = () if nearby.texts else _book_formats(connection, upload.agency_id)
        name = str(declared.get("file_name") or "recording")
        task = TraceTask(name, upload.file, declared, nearby.texts, formats, self._rules.traces)
        return StartedTrace(nearby, self._processes.submit(task, wait_s=upload.wait_s))

    def plot(self, signal: TraceSignal) -> bytes:
        """The trace with what was found in it."""
        return signal.result.plot

    def match(self, connection: sa.Connection, upload: Upload, signal: TraceSignal) -> Decoded:
        """Match the findings against the registered tags."""
        terms = trace_terms(upload.context.trace or {})
        trace = match_tags(signal.result.findings, signal.nearby.tags, terms.bar)
        document = trace_document(signal.result, trace, codebook_tags=len(signal.nearby.texts))
        nearby, at = signal.nearby, upload.observed_at
        missed = missed_tags(trace, nearby.tags, nearby.complete, terms.bar, at)
        return Decoded(document, [*_observations(trace, at), *missed])


def check_not_empty(file: SpooledFile) -> None:
    """Raise `UnreadableUpload` for a file without content."""
    if not file.size:
        raise UnreadableUpload("the file is empty", field="file", cure="send the recording again, whole")


def _book_formats(connection: sa.Connection, agency_id: str) -> tuple[TagFormat, ...]:
    """Formats of the agency's codebooks: what tags look like where none is registered near by."""
    rows, _ = CODEBOOKS.page(connection, agency_id, limit=MAX_BOOKS_SEARCHED)
    designs = [book_of(row).design for row in rows]
    return tuple(dict.fromkeys(TagFormat(d.magnets, d.length_m, d.segment_m) for d in designs))


def _observations(trace: ReadTrace, observed_at: datetime) -> list[NewObservation]:
    """One row for each registered tag; of one that was passed twice the more confident reading counts."""
    rows: dict[str, NewObservation] = {}
    evidence = tag_evidence(trace)
    for tag in sorted(trace.tags, key=lambda tag: -tag.reading.confidence):
        if tag.match is None or tag.match.tag is None:
            continue
        reading, marker_id = tag.reading, tag.match.tag.marker_id
        detail = {
            "confidence": float(reading.confidence),
            "missing_magnets": reading.missing,
            "extra_magnets": reading.extra,
            "lateral_cm": round(float(reading.lateral_cm), 2),
            EVIDENCE: evidence[marker_id],
        }
        what = _what(reading.wrong_way, evidence[marker_id])
        rows.setdefault(marker_id, NewObservation(marker_id, 0, observed_at, what, detail))
    return list(rows.values())


def _what(wrong_way: bool, evidence: dict[str, Any]) -> str:
    if evidence.get("two_places"):
        return "cloned"
    if "elsewhere_deg" in evidence:
        return "out-of-place"
    return "wrong-way" if wrong_way else "seen"
