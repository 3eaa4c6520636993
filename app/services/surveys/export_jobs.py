"""Exports as jobs: the file is written to disk, stored, and sent when it is asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from app.registry import jobs as store
from app.registry.bulk import count_records
from app.registry.database import Database
from app.registry.ids import new_id
from app.registry.jobs import JobKind, new_job
from app.registry.markers import MarkerFilter
from app.registry.spatial import Box
from app.services.access.access import Caller, Scope
from app.services.idempotency import IdempotencyKey, write_once
from app.services.jobs import RunningJob
from app.services.markers.search_areas import area_of_text
from app.services.ports import Clock, JobQueue
from app.services.progress.documents import JobDocument, job_document
from app.services.progress.results import JobFiles
from app.services.surveys.exports import STREAMED, WHOLE, Exports

SUFFIXES = {"shapefile": "shp.zip", "landxml": "xml"}
MAX_LEFT_OUT_IDS = 20
"""Ids in the header Waymark-Left-Out. Source: chosen by hand, 1 kB."""
_WRITING = 0.95
"""Progress when all markers are read; GDAL then closes the file."""


class ExportJobs:
    """Use cases on exports that are jobs.

    Parameters
    ----------
    database, clock, queue
    exports : Exports
        Writes the files.
    files : JobFiles
    idempotency_ttl : timedelta
    """

    def __init__(
        self, database: Database, clock: Clock, queue: JobQueue, exports: Exports, files: JobFiles,
        idempotency_ttl: timedelta,
    ) -> None:  # fmt: skip
        self._database, self._clock, self._queue = database, clock, queue
        self._exports, self._files, self._ttl = exports, files, idempotency_ttl

    def submit(
        self, caller: Caller, wanted: Mapping[str, Any], key: IdempotencyKey | None = None
    ) -> tuple[JobDocument, bool]:
        """Queue an export; returns whether it was queued before.

        Parameters
        ----------
        caller : Caller
        wanted : mapping
            ``format`` and what `filter_of` reads.
        key : IdempotencyKey or None
        """
        filter_of(wanted)
        now, agency_id = self._clock(), caller.agency_id
        job_input = {"wanted": dict(wanted), "label": caller.label}
        job = new_job(JobKind.EXPORT, new_id(now), agency_id, caller.key_id, now, job_input=job_input)
        with write_once(self._database, agency_id, key, now, self._ttl) as (connection, answer):
            if answer.replayed:
                return answer.response, True
            store.add_job(connection, job)
            document = answer.store(job_document(job, now))
        self._queue.submit(job.id, agency_id, JobKind.EXPORT)
        return document, False

    def run(self, job: RunningJob) -> None:
        """Write the file; the handler of jobs of the kind `JobKind.EXPORT`."""
        wanted = job.row.input["wanted"]
        kind, filtered = wanted["format"], filter_of(wanted)
        caller = Caller(job.row.agency_id, job.row.holder_id or "", job.row.input["label"], Scope.VIEWER)
        with self._database.read() as connection:
            total = count_records(connection, caller.agency_id, filtered)
        job.report_progress(0.0, steps=(0, total))

        def report(done: int) -> None:
            job.report_progress(min(1.0, done / max(1, total)) * _WRITING, steps=(min(done, total), total))

        with TemporaryDirectory(prefix="waymark-export-") as folder:
            path, left_out = self._exports.write_file(caller, kind, filtered, Path(folder), report)
            headers = {}
            if left_out:
                headers["Waymark-Left-Out"] = f"{len(left_out)}; {' '.join(left_out[:MAX_LEFT_OUT_IDS])}"
            name, media_type = f"markers.{SUFFIXES.get(kind, kind)}", (STREAMED | WHOLE)[kind]
            self._files.finish(job, path, name=name, media_type=media_type, headers=headers)


def filter_of(wanted: Mapping[str, Any]) -> MarkerFilter:
    """The filter of an export.

    Parameters
    ----------
    wanted : mapping
        ``bbox`` (west, south, east, north), ``polygon`` (WKT), ``road``, ``from_m``, ``to_m``, ``status``, ``family``;
        all optional.

    Raises
    ------
    InvalidParameter
        The polygon cannot be read.
    """
    box, polygon = wanted.get("bbox"), wanted.get("polygon")
    names = ("road", "from_m", "to_m", "status", "family")
    plain = MarkerFilter(**{name: wanted.get(name) for name in names})
    return replace(
        plain,
        box=Box(*box) if box is not None else None,
        area=area_of_text(polygon) if polygon is not None else None,
    )
