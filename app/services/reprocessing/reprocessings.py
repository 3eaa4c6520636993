"""Reprocessings: chosen, carried out in shards on the queue for archive work, reported, and accepted by a person."""

from __future__ import annotations

import io
import re
import time
from collections.abc import Iterator, Mapping
from datetime import datetime
from typing import Any, NamedTuple

import sqlalchemy as sa

from app.errors import Conflict, InvalidParameter, NotFound, Unavailable, WaymarkError
from app.formats.spreadsheet import TableWriter
from app.registry import decodes as decode_store
from app.registry import jobs as job_store
from app.registry import reprocessings as store
from app.registry.database import Database
from app.registry.ids import new_id, new_ids
from app.registry.jobs import JobKind, new_job
from app.registry.reprocessings import REPROCESSINGS, ReprocessedRow, ReprocessingRow
from app.registry.tenancy import across_agencies
from app.services.access.access import Caller
from app.services.access.audit import log_change
from app.services.decodes.decodes import Decodes
from app.services.decodes.upload_path import PICTURES
from app.services.error_documents import error_document
from app.services.job_queues import QueueName, kinds_in
from app.services.jobs import RunningJob
from app.services.ports import Blobs, Clock, JobQueue
from app.services.reprocessing.compare import compare_results
from app.services.reprocessing.documents import (
    DecodeVersions,
    ReprocessingDocument,
    ReprocessingPage,
    ReprocessingReport,
    reprocessed_document,
    reprocessing_document,
    state_of,
)
from app.services.staged_blobs import staged

SHARD = 100
"""Uploads of one job. Source: chosen by hand; a job of frames takes a minute, and many workers share the work."""
MAX_DECODES = 1_000_000
_MAX_WAIT_S, _STEP_S = 30.0, 0.2
"""How long an upload gives way to jobs that somebody waits for, and how often it looks. [s]"""
_RELEASE = re.compile(r"[0-9]+(\.[0-9]+){1,2}")
_CSV = (
    "decode_id", "change", "family", "frame", "at_s", "code_before", "code", "confidence_before", "confidence",
    "moved_m", "decoder_before", "decoder", "error",
)  # fmt: skip


class Criteria(NamedTuple):
    """Which uploads are decoded again.

    Attributes
    ----------
    kinds : tuple of str or None
    since, until : datetime or None
        When they were uploaded.
    vehicle_id : str or None
    bbox : tuple or None
        West, south, east, north of their coarse positions. [deg]
    decoder : str or None
        Only results of this decoder.
    older_than : str or None
        Only results of earlier releases, e.g. ``0.3.0``.
    """

    kinds: tuple[str, ...] | None = None
    since: datetime | None = None
    until: datetime | None = None
    vehicle_id: str | None = None
    bbox: tuple[float, float, float, float] | None = None
    decoder: str | None = None
    older_than: str | None = None


class Reprocessings:
    """Use cases on reprocessings.

    Parameters
    ----------
    database, clock, blobs, queue
    decodes : Decodes
        Decodes stored uploads again.
    """

    def __init__(self, database: Database, clock: Clock, blobs: Blobs, queue: JobQueue, decodes: Decodes) -> None:
        self._database, self._clock = database, clock
        self._blobs, self._queue, self._decodes = blobs, queue, decodes

    def create(self, caller: Caller, criteria: Criteria) -> ReprocessingDocument:
        """Queue the uploads that meet some criteria.

        Raises
        ------
        InvalidParameter
            None or too many do.
        """
        if criteria.older_than is not None and _RELEASE.fullmatch(criteria.older_than) is None:
            raise InvalidParameter(f"{criteria.older_than[:40]!r} is no release", field="older_than", limit="0.3.0")
        now, agency_id = self._clock(), caller.agency_id
        with self._database.read(long=True) as connection:
            found = store.stream_decodes(
                connection, agency_id, kinds=criteria.kinds, since=criteria.since, until=criteria.until,
                vehicle_id=criteria.vehicle_id,
            )  # fmt: skip
            ids = [row.id for row in found if _is_meant(row.context, row.decoder, criteria)]
        if not 1 <= len(ids) <= MAX_DECODES:
            raise InvalidParameter(
                f"{len(ids)} uploads meet the criteria", limit=f"1 to {MAX_DECODES}", cure="change the criteria"
            )
        stored = {name: _plain(value) for name, value in criteria._asdict().items() if value is not None}
        row = ReprocessingRow(new_id(now), agency_id, caller.label, stored, len(ids), now)
        shards = [ids[start : start + SHARD] for start in range(0, len(ids), SHARD)]
        jobs = [
            new_job(
                JobKind.REPROCESS, job_id, agency_id, caller.key_id, now,
                job_input={"decode_ids": shard, "label": caller.label}, subject_id=row.id,
            )
            for job_id, shard in zip(new_ids(now, len(shards)), shards, strict=True)
        ]  # fmt: skip
        with self._database.write() as connection:
            store.add_reprocessing(connection, row)
            for job in jobs:
                job_store.add_job(connection, job)
            log_change(connection, caller, "reprocessing.started", now=now, subject=row.id, decodes=len(ids))
            document = self._document(connection, row)
        for job in jobs:
            self._queue.submit(job.id, agency_id, JobKind.REPROCESS)
        return document

    def get(self, caller: Caller, reprocessing_id: str) -> ReprocessingDocument:
        """A reprocessing with its numbers."""
        with self._database.read() as connection:
            return self._document(connection, REPROCESSINGS.get(connection, caller.agency_id, reprocessing_id))

    def page(self, caller: Caller, *, after: str | None, limit: int) -> tuple[ReprocessingPage, str | None]:
        """A page of reprocessings, oldest first, and the id to continue after."""
        with self._database.read() as connection:
            rows, last = REPROCESSINGS.page(connection, caller.agency_id, beyond=after, limit=limit)
            return ReprocessingPage(items=[self._document(connection, row) for row in rows]), last

    def report(
        self, caller: Caller, reprocessing_id: str, *, after: str | None = None, limit: int = 100
    ) -> tuple[ReprocessingReport, str | None]:
        """A page of uploads whose readings differ, and the id to continue after."""
        with self._database.read() as connection:
            REPROCESSINGS.get(connection, caller.agency_id, reprocessing_id)
            rows = store.list_reprocessed(connection, reprocessing_id, after=after, limit=limit + 1)
        items = [reprocessed_document(row) for row in rows[:limit]]
        return ReprocessingReport(items=items), rows[limit - 1].decode_id if len(rows) > limit else None

    def report_csv(self, caller: Caller, reprocessing_id: str) -> Iterator[bytes]:
        """The report as CSV, a line for each reading that differs and each upload that failed."""
        self.get(caller, reprocessing_id)
        return self._csv_lines(caller, reprocessing_id)

    def _csv_lines(self, caller: Caller, reprocessing_id: str) -> Iterator[bytes]:
        yield _line(dict(zip(_CSV, _CSV, strict=True)))
        after: str | None = None
        while True:
            page, after = self.report(caller, reprocessing_id, after=after, limit=1000)
            for item in page["items"]:
                same = {"decode_id": item["decode_id"], "decoder_before": item["decoder_before"]}
                same["decoder"] = item["decoder"]
                if item["error"] is not None:
                    yield _line({**same, "change": "failed", "error": item["error"]["detail"]})
                for change in item["changes"]:
                    yield _line({**same, **change})
            if after is None:
                return

    def cancel(self, caller: Caller, reprocessing_id: str) -> ReprocessingDocument:
        """Stop a reprocessing; what was decoded again stays in its report and is never made current."""
        with self._database.write() as connection:
            row = REPROCESSINGS.get(connection, caller.agency_id, reprocessing_id)
            store.cancel_jobs(connection, caller.agency_id, reprocessing_id, self._clock())
            return self._document(connection, row)

    def accept(self, caller: Caller, reprocessing_id: str) -> ReprocessingDocument:
        """Make the new results current; those of before are kept as versions of their decodes.

        Raises
        ------
        Conflict
            It is not ready, it was accepted before, or a decode was reprocessed by another one since.
        """
        now = self._clock()
        with self._database.write(long=True) as connection:
            row = REPROCESSINGS.get(connection, caller.agency_id, reprocessing_id)
            state = state_of(row, store.count_jobs(connection, reprocessing_id))
            if state != "ready":
                raise Conflict(
                    f"the reprocessing is {state}", field="reprocessing_id", limit="reprocessings that are ready",
                    cure="wait until it is ready, or start another one",
                )  # fmt: skip
            if store.is_outdated(connection, reprocessing_id):
                raise Conflict(
                    "some of these decodes were changed by another reprocessing since", field="reprocessing_id",
                    cure="start another one",
                )  # fmt: skip
            count = store.accept(connection, reprocessing_id, caller.label, now)
            log_change(connection, caller, "reprocessing.accepted", now=now, subject=reprocessing_id, decodes=count)
            return self._document(connection, REPROCESSINGS.get(connection, caller.agency_id, reprocessing_id))

    def versions(self, caller: Caller, decode_id: str) -> DecodeVersions:
        """Results of a decode that were current before."""
        with self._database.read() as connection:
            decode_store.get_decode(connection, caller.agency_id, decode_id, holder_id=caller.own_key_id)
            rows = store.list_versions(connection, decode_id)
        return {
            "items": [
                {
                    "reprocessing_id": row.reprocessing_id, "decoder": row.decoder, "finished_at": row.finished_at,
                    "replaced_at": row.replaced_at, "result": row.result,
                }
                for row in rows
            ]
        }  # fmt: skip

    # --- the work -----------------------------------------------------------------------------------------------------

    def run(self, job: RunningJob) -> None:
        """Decode the uploads of a shard again; the handler of jobs of the kind `JobKind.REPROCESS`."""
        reprocessing_id, ids = job.row.subject_id, job.row.input["decode_ids"]
        assert reprocessing_id is not None
        with self._database.read() as connection:
            done = store.done_ids(connection, reprocessing_id, ids)
        for count, decode_id in enumerate(ids, 1):
            if decode_id in done:
                continue
            self._give_way()
            self._decode_again(job, reprocessing_id, decode_id, (count, len(ids)))
        with self._database.write() as connection:
            job.finish(connection, {"decodes": len(ids)})

    def _give_way(self) -> None:
        """Wait while jobs wait for whose results somebody waits; not for ever, or a busy server would never finish."""
        online, waited_s = kinds_in(QueueName.ONLINE), 0.0
        while waited_s < _MAX_WAIT_S:
            with across_agencies(), self._database.read() as connection:
                if not store.online_jobs_wait(connection, online):
                    return
            time.sleep(_STEP_S)
            waited_s += _STEP_S

    def _decode_again(self, job: RunningJob, reprocessing_id: str, decode_id: str, steps: tuple[int, int]) -> None:
        agency_id = job.row.agency_id
        with self._database.read() as connection:
            before = decode_store.get_decode(connection, agency_id, decode_id)
        old = before.result or {}
        made = ReprocessedRow(
            reprocessing_id, decode_id, agency_id, old.get("decoder"), None, None, None, None, [], 0, 0, 0, 0
        )
        with staged(self._blobs) as stage:
            try:
                document, plot = self._decodes.decode_again(agency_id, decode_id)
            except Unavailable:
                raise
            except (WaymarkError, NotFound) as error:
                made = made._replace(error=dict(error_document(error)))
            else:
                changes, same = compare_results(old, document)
                kinds = [change["change"] for change in changes]
                made = made._replace(
                    decoder=document.get("decoder"), result=document, same=same,
                    changes=[dict(change) for change in changes], gained=kinds.count("gained"),
                    lost=kinds.count("lost"), changed=kinds.count("changed"),
                    picture_key=stage.put(PICTURES, plot) if plot is not None else None,
                )  # fmt: skip
            job.report_progress(
                steps[0] / (steps[1] + 1), steps=steps, keep=lambda connection: store.add_reprocessed(connection, made)
            )
            stage.keep()

    def _document(self, connection: sa.Connection, row: ReprocessingRow) -> ReprocessingDocument:
        return reprocessing_document(row, store.count_jobs(connection, row.id), store.sums(connection, row.id))


def _is_meant(context: Mapping[str, Any], decoder: str | None, criteria: Criteria) -> bool:
    if criteria.decoder is not None and decoder != criteria.decoder:
        return False
    if criteria.older_than is not None and not _is_older(decoder, criteria.older_than):
        return False
    return criteria.bbox is None or _is_inside(context, criteria.bbox)


def _is_older(decoder: str | None, release: str) -> bool:
    """Whether a decoder, such as ``waymark 0.2.0 plate/3``, is of an earlier release; one that is unknown is."""
    found = re.match(r"waymark ([0-9.]+)", decoder or "")
    if found is None:
        return True
    return _numbers(found[1]) < _numbers(release)


def _numbers(release: str) -> tuple[int, ...]:
    numbers = [int(part) for part in release.split(".") if part]
    return tuple(numbers + [0] * (3 - len(numbers)))


def _is_inside(context: Mapping[str, Any], bbox: tuple[float, float, float, float]) -> bool:
    position = context.get("coarse_position")
    if not position:
        return False
    west, south, east, north = bbox
    lon, lat = position["lon_deg"], position["lat_deg"]
    across = west <= lon <= east if west <= east else lon >= west or lon <= east
    return bool(across and south <= lat <= north)


def _plain(value: Any) -> Any:
    return value.isoformat() if isinstance(value, datetime) else list(value) if isinstance(value, tuple) else value


def _line(values: Mapping[str, object]) -> bytes:
    text = io.StringIO()
    TableWriter(text).write_row(values.get(name) for name in _CSV)
    return text.getvalue().encode()
