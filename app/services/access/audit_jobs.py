"""Verifications of an agency's log as jobs: every hash of its history is computed again."""

from __future__ import annotations

from datetime import datetime, timedelta
from typing import Annotated, NotRequired, cast

from pydantic import ConfigDict, Field
from typing_extensions import TypedDict

from app.errors import Conflict, InvalidParameter
from app.registry import audit as log
from app.registry import jobs as store
from app.registry.audit import ChainReport, check_history
from app.registry.column_types import new_id
from app.registry.database import Database
from app.registry.jobs import UNFINISHED, JobKind, JobRow, JobState, new_job
from app.services.access.access import Caller
from app.services.access.audit import parse_head
from app.services.documents import ErrorDocument, document_of
from app.services.idempotency import IdempotencyKey, write_once
from app.services.jobs import RunningJob
from app.services.ports import Clock, JobQueue

_MAX_FAULTS = 1000
_NEARLY = 0.99
"""Progress of a verification that has gone through everything, and is not stored yet."""


class AuditFaultDocument(TypedDict):
    """Something that is not as it was written."""

    where: str
    what: str


class VerificationResult(TypedDict):
    """What was gone through, and what is not as it was written."""

    entries: Annotated[int, Field(description="Entries of the log.")]
    versions: Annotated[int, Field(description="Versions of markers.")]
    head: Annotated[str | None, Field(description="NUMBER:HASH of the last entry; keep it elsewhere.")]
    fault_count: int
    faults: Annotated[list[AuditFaultDocument], Field(description=f"The first {_MAX_FAULTS}.")]


class VerificationDocument(TypedDict):
    """A verification of the agency's log: a job."""

    id: str
    state: JobState
    progress: Annotated[float, Field(description="0 to 1.")]
    created_at: datetime
    finished_at: datetime | None
    error: Annotated[ErrorDocument | None, Field(description="Why there is no result.")]
    result: VerificationResult | None


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
    ) -> tuple[VerificationDocument, bool]:
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
            document = answer.store(verification_document(job))
        self._queue.submit(job.id, agency_id, JobKind.AUDIT)
        return document, False

    def get(self, caller: Caller, job_id: str) -> VerificationDocument:
        """A verification, with its result once it is done.

        Raises
        ------
        NotFound
        """
        with self._database.read() as connection:
            return verification_document(store.get_job(connection, caller.agency_id, JobKind.AUDIT, job_id))

    def run(self, job: RunningJob) -> None:
        """Verify the log of the job's agency; the handler of jobs of the kind `JobKind.AUDIT`."""
        expected = job.row.input["expected_head"]
        report, faults, count = ChainReport(), list[AuditFaultDocument](), 0
        with self._database.read(long=True) as connection:
            total = log.count_history(connection, job.row.agency_id)

            def report_progress() -> None:
                done = min(report.entries + report.versions, total)
                job.report_progress(min(_NEARLY, done / total), steps=(done, total))

            report.watch = report_progress
            head = parse_head(expected) if expected is not None else None
            for fault in check_history(connection, job.row.agency_id, report, head):
                count += 1
                if count <= _MAX_FAULTS:
                    faults.append({"where": fault.where, "what": fault.what})
        result: VerificationResult = {
            "entries": report.entries,
            "versions": report.versions,
            "head": f"{report.head[0]}:{report.head[1]}" if report.head is not None else None,
            "fault_count": count,
            "faults": faults,
        }
        with self._database.write() as connection:
            job.finish(connection, cast("dict[str, object]", result))


def _check_head(text: str) -> None:
    try:
        parse_head(text)
    except InvalidParameter as error:
        error.field = "expected_head"
        raise


def verification_document(job: JobRow) -> VerificationDocument:
    """A verification as clients see it."""
    return document_of(VerificationDocument, job)
