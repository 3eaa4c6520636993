"""Verifications of an agency's log as jobs: every hash of its history is computed again."""

from __future__ import annotations

from datetime import timedelta
from typing import Annotated, NotRequired

from pydantic import ConfigDict, Field
from typing_extensions import TypedDict

from app.errors import Conflict, InvalidParameter
from app.registry import audit as log
from app.registry import jobs as store
from app.registry.audit import AuditFault, ChainReport, check_history
from app.registry.column_types import new_id
from app.registry.database import Database
from app.registry.jobs import UNFINISHED, JobKind, new_job
from app.services.access.access import Caller
from app.services.access.audit import MAX_FAULTS, VerificationResult, parse_head
from app.services.idempotency import IdempotencyKey, write_once
from app.services.jobs import RunningJob
from app.services.ports import Clock, JobQueue
from app.services.progress import JobDocument, job_document

_NEARLY = 0.99
"""Progress of a verification that has gone through everything, and is not stored yet."""


class VerificationInput(TypedDict):
    """What to verify."""

    __pydantic_config__ = ConfigDict(json_schema_extra={"examples": [{}]})  # type: ignore[misc]

    expected_head: NotRequired[
        Annotated[str | None, Field(max_length=90, description="NUMBER:HASH of an entry that the log must contain.")]
    ]


class AuditVerifications:
    """Use cases on verifications of the log.

    Parameters
    ----------
    idempotency_ttl : timedelta
        How long the response to an Idempotency-Key is stored.
    """

    def __init__(self, database: Database, clock: Clock, queue: JobQueue, *, idempotency_ttl: timedelta) -> None:
        self._database, self._clock, self._queue, self._ttl = database, clock, queue, idempotency_ttl

    def request(
        self, caller: Caller, wanted: VerificationInput, key: IdempotencyKey | None
    ) -> tuple[JobDocument, bool]:
        """Queue a verification; returns its job, and whether the request was made before with this key.

        Raises
        ------
        InvalidParameter
            The expected head is none.
        Conflict
            One is queued or running already.
        """
        expected = wanted.get("expected_head")
        if expected is not None:
            _check_head(expected)
        now, agency_id = self._clock(), caller.agency_id
        job = new_job(
            JobKind.AUDIT, new_id(now), agency_id, caller.key_id, now,
            job_input={"label": caller.label, "expected_head": expected}, subject_id=agency_id,
        )  # fmt: skip
        with write_once(self._database, agency_id, key, now, self._ttl) as (connection, answer):
            if answer.replayed:
                return answer.response, True
            other = store.find_job_about(connection, agency_id, JobKind.AUDIT, agency_id, UNFINISHED)
            if other is not None:
                raise Conflict(
                    f"verification {other.id} is {other.state}",
                    limit="one verification of a log at a time",
                    cure=f"wait for it, or cancel it: POST /v1/jobs/{other.id}/cancel",
                )
            store.add_job(connection, job)
            document = answer.store(job_document(job, now))
        self._queue.submit(job.id, agency_id, JobKind.AUDIT)
        return document, False

    def run(self, job: RunningJob) -> None:
        """Verify the log of the job's agency; the handler of jobs of the kind `JobKind.AUDIT`."""
        expected = job.row.input["expected_head"]
        report, faults, count = ChainReport(), list[AuditFault](), 0
        with self._database.read(long=True) as connection:
            total = log.count_history(connection, job.row.agency_id)

            def report_progress() -> None:
                done = min(report.entries + report.versions, total)
                job.report_progress(min(_NEARLY, done / total), steps=(done, total))

            report.watch = report_progress
            head = parse_head(expected) if expected is not None else None
            for fault in check_history(connection, job.row.agency_id, report, head):
                count += 1
                if count <= MAX_FAULTS:
                    faults.append(fault)
        result: VerificationResult = {
            "entries": report.entries,
            "versions": report.versions,
            "head": f"{report.head[0]}:{report.head[1]}" if report.head is not None else None,
            "fault_count": count,
            "faults": faults,
        }
        with self._database.write() as connection:
            job.finish(connection, result)


def _check_head(text: str) -> None:
    try:
        parse_head(text)
    except InvalidParameter as error:
        error.field = "expected_head"
        raise
