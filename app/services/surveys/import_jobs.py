"""Imports of large surveys as jobs: the file is stored, the caller gets the job, and the report comes later."""

from __future__ import annotations

from datetime import timedelta

from app.formats.format import SpooledFile
from app.registry import jobs as store
from app.registry.column_types import new_id
from app.registry.database import Database
from app.registry.jobs import JobKind, new_job
from app.services.access.access import Caller, Scope
from app.services.blobs import staged
from app.services.idempotency import IdempotencyKey, write_once
from app.services.jobs import RunningJob
from app.services.ports import Blobs, Clock, JobQueue
from app.services.progress import JobDocument, job_document
from app.services.surveys.import_report import DeclarationIn, ImportInput, import_input
from app.services.surveys.imports import SETTLED, Imports

IMMEDIATE_BYTES = 4 * 1024**2
IMMEDIATE_LINES = 20_000
"""Surveys up to this size [byte] and number of lines are imported while the caller waits, others become jobs.

Source: 15,000 rows a second (`python -m benchmarks.imports`), rows of a GeoPackage of 120 bytes: two seconds."""
_BLOCK_BYTES = 1 << 18
_STARTED = 0.1


def takes_long(file: SpooledFile) -> bool:
    """Whether a survey is to be imported as a job."""
    if file.size > IMMEDIATE_BYTES:
        return True
    with file.open() as stream:
        return sum(block.count(b"\n") for block in iter(lambda: stream.read(_BLOCK_BYTES), b"")) > IMMEDIATE_LINES


class ImportJobs:
    """Use cases on imports that are jobs.

    Parameters
    ----------
    imports : Imports
        Does the work.
    """

    def __init__(
        self, database: Database, clock: Clock, blobs: Blobs, queue: JobQueue,
        *, imports: Imports, idempotency_ttl: timedelta,
    ) -> None:  # fmt: skip
        self._database, self._clock, self._blobs, self._queue = database, clock, blobs, queue
        self._imports, self._ttl = imports, idempotency_ttl

    def submit(self, caller: Caller, given: ImportInput, key: IdempotencyKey | None) -> tuple[JobDocument, bool]:
        """Store the file and queue its import.

        Returns
        -------
        job : JobDocument
        replayed : bool
            The request had been made before under the same Idempotency-Key.
        """
        now, agency_id = self._clock(), caller.agency_id
        with staged(self._blobs) as stage:
            job = new_job(
                JobKind.IMPORT, new_id(now), agency_id, caller.key_id, now,
                job_input={"declaration": given.declaration.model_dump(mode="json"), "label": caller.label},
                upload_key=stage.add("uploads", given.file),
            )  # fmt: skip
            with write_once(self._database, agency_id, key, now, self._ttl) as (connection, answer):
                if answer.replayed:
                    return answer.response, True
                store.add_job(connection, job)
                document = answer.store(job_document(job, now))
            stage.keep()
        self._queue.submit(job.id, job.agency_id, JobKind.IMPORT)
        return document, False

    def run(self, job: RunningJob) -> None:
        """Import a survey that was queued; the handler of jobs of the kind `JobKind.IMPORT`."""
        row = job.row
        assert row.upload_key is not None
        # nobody acts with this caller but the import itself: the key's permissions were checked when it was queued
        caller = Caller(row.agency_id, row.holder_id or "", row.input["label"], Scope.SURVEYOR)

        def step(progress: float) -> None:
            if row.progress < SETTLED:  # else it was storing when an earlier process stopped, and goes on to the end
                job.report_progress(progress)

        step(_STARTED)
        with self._blobs.opened(row.upload_key) as file:
            given = import_input(DeclarationIn.model_validate(row.input["declaration"]), file)
            report, _ = self._imports.run(caller, given, IdempotencyKey(f"import {row.id}", row.id, ""), step)
        with self._database.write() as connection:
            job.finish(connection, report)
