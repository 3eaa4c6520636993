"""Jobs of every kind as one resource: their progress, their end, and where the result is."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Annotated, Literal, NotRequired, cast

import sqlalchemy as sa
import structlog
from pydantic import Field
from typing_extensions import ReadOnly, TypedDict

from app.errors import Conflict, NotAllowed, NotFound, Unavailable
from app.registry import jobs as registry_jobs
from app.registry import webhooks as store
from app.registry.database import Database
from app.registry.engines import across_agencies
from app.registry.jobs import UNFINISHED, JobKind, JobRow, JobState, event_of_holder
from app.services.access.access import AGENCY_SCOPES, Caller, Scope
from app.services.access.audit import VerificationResult
from app.services.blobs import delete_unused, staged
from app.services.documents import ErrorDocument
from app.services.jobs import RunningJob
from app.services.plans.documents import MadePlanResult, PackageResult, ProofResult
from app.services.ports import Blobs, Clock
from app.services.surveys.import_report import ImportReport
from app.services.surveys.imports import SETTLED

# === Who sees and cancels jobs of each kind, and where their results are: the rules of the resources that they make.


_EVERYBODY = frozenset(AGENCY_SCOPES)
_READERS = _EVERYBODY - {Scope.VEHICLE}
_SURVEYORS = _READERS - {Scope.VIEWER}
_PLANNERS = frozenset({Scope.PLANNER, Scope.ADMIN})


@dataclass(frozen=True, slots=True)
class JobRules:
    """What holds for the jobs of one kind."""

    # `readers`, `cancellers`: scopes of keys that may read them, and that may cancel those of others of the agency
    readers: frozenset[Scope]
    cancellers: frozenset[Scope]
    result_path: Callable[[JobRow], str | None]  # path of the result of a job that is done; None if it has none
    too_late_progress: float = 2.0  # a job beyond this progress cannot be cancelled any more; over 1: it always can


def _itself(job: JobRow) -> str:
    return f"/v1/jobs/{job.id}"


def _about_plan(end: str) -> Callable[[JobRow], str | None]:
    return lambda job: f"/v1/plans/{job.subject_id}{end}" if job.subject_id is not None else None


RULES: dict[str, JobRules] = {
    JobKind.DECODE: JobRules(_EVERYBODY, _EVERYBODY - {Scope.VIEWER}, lambda job: f"/v1/decodes/{job.id}"),
    JobKind.IMPORT: JobRules(_SURVEYORS, _SURVEYORS, _itself, SETTLED),
    JobKind.PLAN: JobRules(_READERS, _PLANNERS, _about_plan("")),
    JobKind.PROOF: JobRules(_READERS, _PLANNERS, _about_plan("/proof")),
    JobKind.PACKAGE: JobRules(_READERS, _PLANNERS, _about_plan("/package")),
    JobKind.ARTWORK: JobRules(_READERS, _PLANNERS, lambda job: f"/v1/jobs/{job.id}/result"),
    JobKind.EXPORT: JobRules(_READERS, _PLANNERS, lambda job: f"/v1/jobs/{job.id}/result"),
    JobKind.REPROCESS: JobRules(
        frozenset({Scope.ADMIN}), frozenset({Scope.ADMIN}), lambda job: f"/v1/reprocessings/{job.subject_id}"
    ),
    JobKind.DRIVE: JobRules(_EVERYBODY, _EVERYBODY - {Scope.VIEWER}, lambda job: f"/v1/drives/{job.id}"),
    JobKind.AUDIT: JobRules(frozenset({Scope.ADMIN}), frozenset({Scope.ADMIN}), _itself),
}
_OTHERS = JobRules(frozenset({Scope.ADMIN}), frozenset({Scope.ADMIN}), lambda _job: None)


def rules_of(kind: str) -> JobRules:
    """The rules of a kind; one that is not listed is for administrators."""
    return RULES.get(kind, _OTHERS)


def visible_kinds(caller: Caller) -> list[JobKind]:
    """Kinds of jobs that a caller may read."""
    return [kind for kind in JobKind if caller.scope in rules_of(kind).readers]


def may_cancel(caller: Caller, job: JobRow) -> bool:
    """Whether a caller may cancel a job that it sees: its own, or any of its agency by its scope."""
    return job.holder_id == caller.key_id or caller.scope in rules_of(job.kind).cancellers


# === Jobs of every kind as clients see them.


class JobLinks(TypedDict):
    """Paths of the job, of its progress as server-sent events, and of what it made."""

    self: str
    events: str
    result: NotRequired[str]


class JobHead(TypedDict):
    """What jobs of every kind have."""

    id: str
    kind: ReadOnly[JobKind]
    state: JobState
    subject_id: Annotated[
        str | None, Field(description="Id of the plan that it is about, or has made, or of the reprocessing.")
    ]
    attempts: Annotated[int, Field(description="Since the last part of the result was stored.")]
    progress: Annotated[float, Field(description="0 to 1.")]
    done: Annotated[int | None, Field(description="Steps that are done: frames, plates, units; null if not counted.")]
    total: Annotated[int | None, Field(description="Steps in all; null if not counted or not known yet.")]
    rate_per_s: Annotated[
        float | None, Field(description="Steps per second: mean since the start; in events, of the last ten seconds.")
    ]
    cancel_requested: Annotated[bool, Field(description="A running job stops at its next step.")]
    created_at: datetime
    started_at: Annotated[datetime | None, Field(description="When it was started first.")]
    finished_at: datetime | None
    error: Annotated[ErrorDocument | None, Field(description="Why there is no result.")]
    dead_letter: Annotated[
        bool,
        Field(description="It failed because it stopped the processes that worked on it, or exceeded their limits."),
    ]
    links: JobLinks


class JobSummary(JobHead):
    """A job of any kind, without its result."""

    kind: JobKind


class PlanJob(JobHead):
    """A job that makes a plan."""

    kind: Literal[JobKind.PLAN]
    result: MadePlanResult | None


class ProofJob(JobHead):
    """A job that proves a plan."""

    kind: Literal[JobKind.PROOF]
    result: ProofResult | None


class PackageJob(JobHead):
    """A job that packs the files of a plan."""

    kind: Literal[JobKind.PACKAGE]
    result: PackageResult | None


class ImportJob(JobHead):
    """A job that imports a survey. A refused import is done, too."""

    kind: Literal[JobKind.IMPORT]
    result: ImportReport | None


class VerificationJob(JobHead):
    """A job that verifies the agency's audit log."""

    kind: Literal[JobKind.AUDIT]
    result: VerificationResult | None


class OtherJob(JobHead):
    """A job whose result is a resource of its own: `links.result`, once it is done."""

    kind: Literal[JobKind.DECODE, JobKind.DRIVE, JobKind.ARTWORK, JobKind.EXPORT, JobKind.REPROCESS]
    result: None


JobDocument = PlanJob | ProofJob | PackageJob | ImportJob | VerificationJob | OtherJob
AnyJob = Annotated[JobDocument, Field(discriminator="kind")]
RESULTS: dict[JobKind, type] = {
    JobKind.PLAN: MadePlanResult,
    JobKind.PROOF: ProofResult,
    JobKind.PACKAGE: PackageResult,
    JobKind.IMPORT: ImportReport,
    JobKind.AUDIT: VerificationResult,
}
"""Results that are part of their jobs; a job may keep more beside them, such as keys of blobs."""


class JobPage(TypedDict):
    """A page of jobs without their results, newest first; the Link header leads to the next one."""

    items: list[JobSummary]


def job_document(job: JobRow, now: datetime) -> JobDocument:
    """A job as clients see it."""
    result, shape = job.result, RESULTS.get(JobKind(job.kind))
    if result is not None:
        result = None if shape is None else {name: result[name] for name in shape.__annotations__ if name in result}
    return cast("JobDocument", {**job_summary(job, now), "result": result})


def job_summary(job: JobRow, now: datetime) -> JobSummary:
    """A job without its result."""
    return {
        "id": job.id,
        "kind": JobKind(job.kind),
        "state": job.state,
        "subject_id": job.subject_id,
        "attempts": job.attempts,
        "progress": job.progress,
        "done": job.steps_done,
        "total": job.steps_total,
        "rate_per_s": _mean_rate_per_s(job, now),
        "cancel_requested": job.cancel_requested,
        "created_at": job.created_at,
        "started_at": job.started_at,
        "finished_at": job.finished_at,
        "error": cast("ErrorDocument | None", job.error),
        "dead_letter": job.dead_letter,
        "links": _links(job),
    }


def _mean_rate_per_s(job: JobRow, now: datetime) -> float | None:
    if job.started_at is None or not job.steps_done or job.state == "queued":
        return None
    elapsed_s = ((job.finished_at or now) - job.started_at).total_seconds()
    return round(job.steps_done / elapsed_s, 3) if elapsed_s > 0 else None


def _links(job: JobRow) -> JobLinks:
    links = JobLinks(self=f"/v1/jobs/{job.id}", events=f"/v1/jobs/{job.id}/events")
    if job.state == "done" and (path := rules_of(job.kind).result_path(job)) is not None:
        links["result"] = path
    return links


def is_finished(job: JobRow) -> bool:
    """Whether a job has ended, in whatever way."""
    return job.state not in UNFINISHED


# === Events of an agency as its clients read them.


class EventDocument(TypedDict):
    """Something that happened."""

    id: int
    kind: Annotated[str, Field(description="For example job.done.")]
    subject_id: str | None
    at: datetime
    detail: dict[str, object] | None


class EventPage(TypedDict):
    """A page of events, oldest first; the Link header leads to the next one."""

    items: list[EventDocument]


class AgencyEvents:
    """Use cases on events."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def newest(self, caller: Caller) -> int:
        """Id of the newest event; 0 if there is none."""
        with self._database.read() as connection:
            return store.newest_event(connection, caller.agency_id)

    def list(self, caller: Caller, after: int, limit: int = 100) -> list[EventDocument]:
        """Events after one, oldest first; of jobs those that the caller may read. A vehicle sees nothing else."""
        kinds, holder_id = visible_kinds(caller), caller.own_key_id
        about = None if holder_id is None else event_of_holder(caller.agency_id, holder_id)
        with self._database.read() as connection:
            rows = store.list_events(
                connection, caller.agency_id, after=after, job_kinds=kinds, about=about, limit=limit
            )
        return [cast("EventDocument", row._asdict()) for row in rows]

    def newest_of(self, agency_ids: Sequence[str]) -> dict[str, int]:
        """Ids of the newest events of several agencies, for streams whose callers were checked before."""
        with across_agencies(), self._database.read() as connection:
            return store.newest_events(connection, agency_ids)


# === Jobs of every kind are listed, read and cancelled alike.


class AllJobs:
    """Use cases on jobs, whatever they do. A caller sees the kinds whose resources its scope may read.

    Attributes
    ----------
    clock : Clock
    """

    def __init__(self, database: Database, clock: Clock) -> None:
        self._database, self.clock = database, clock

    def get(self, caller: Caller, job_id: str) -> JobDocument:
        """A job with its progress, and its result once there is one.

        Raises
        ------
        NotFound
            There is none with this id that the caller may see.
        """
        return job_document(self.row(caller, job_id), self.clock())

    def row(self, caller: Caller, job_id: str) -> JobRow:
        """As `get`, as a row."""
        with self._database.read() as connection:
            return _visible(connection, caller, job_id)

    def page(
        self, caller: Caller, *, kind: JobKind | None = None, state: str | None = None, dead_letter: bool | None = None,
        subject_id: str | None = None, before: str | None = None, limit: int = 100,
    ) -> tuple[JobPage, str | None]:  # fmt: skip
        """A page of jobs, newest first, and the id to continue before."""
        kinds = [one for one in visible_kinds(caller) if kind is None or one == kind]
        with self._database.read() as connection:
            rows = registry_jobs.list_jobs(
                connection, caller.agency_id, kinds,
                state=state, before=before, limit=limit + 1, subject_id=subject_id, holder_id=caller.own_key_id,
                dead_letter=dead_letter,
            )  # fmt: skip
        now = self.clock()
        page = JobPage(items=[job_summary(row, now) for row in rows[:limit]])
        return page, rows[limit - 1].id if len(rows) > limit else None

    def cancel(self, caller: Caller, job_id: str) -> JobDocument:
        """Cancel a job: a queued one never starts, a running one stops at its next step, a finished one stays.

        Raises
        ------
        NotFound
            There is none with this id that the caller may see.
        NotAllowed
            It is another's, and the scope does not cover that.
        Conflict
            It is too late: what it makes is being stored.
        """
        with self._database.read() as connection:  # the one who stores may have the writer for long
            _check_cancel(caller, _visible(connection, caller, job_id))
        with self._database.write() as connection:
            job = _visible(connection, caller, job_id)
            _check_cancel(caller, job)
            limit = rules_of(job.kind).too_late_progress
            registry_jobs.request_cancel(connection, caller.agency_id, job_id, self.clock(), below_progress=limit)
            return job_document(_visible(connection, caller, job_id), self.clock())

    def watched(self, job_ids: Sequence[str]) -> dict[str, JobRow]:
        """Jobs by their ids, without inputs and results; whoever follows one was checked before."""
        with across_agencies(), self._database.read() as connection:
            return {row.id: row for row in registry_jobs.list_progress(connection, job_ids)}


def _check_cancel(caller: Caller, job: JobRow) -> None:
    """Refuse to cancel a job of another, or one whose result is being stored."""
    if not may_cancel(caller, job):
        raise NotAllowed(
            f"a key with the scope {caller.scope} may not cancel this job",
            limit="the key that asked for it, or " + " or ".join(sorted(rules_of(job.kind).cancellers)),
        )
    if job.state in UNFINISHED and job.progress >= rules_of(job.kind).too_late_progress:
        raise Conflict(
            f"the {job.kind} is storing already",
            field="job_id",
            limit="jobs that store nothing yet",
            cure="read its result",
        )


def _visible(connection: sa.Connection, caller: Caller, job_id: str) -> JobRow:
    job = registry_jobs.find_job(connection, caller.agency_id, job_id)
    if job is None or caller.scope not in rules_of(job.kind).readers or caller.own_key_id not in (None, job.holder_id):
        raise NotFound(f"there is no job {job_id}", field="job_id", cure="GET /v1/jobs lists yours")
    return job


# === Files that jobs make: written as blobs, sent part by part, and deleted when they have expired.


KEPT = timedelta(days=7)
"""How long the file of a job is kept. It can be made again."""
FOLDER = "results"
FILE_KINDS = (JobKind.ARTWORK, JobKind.EXPORT)
_LOG = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class StoredFile:
    """A file to send: its name, type, size and hash, its headers, and its content part by part."""

    name: str
    media_type: str
    size_bytes: int
    sha256: str
    headers: dict[str, str]
    chunks: Iterator[bytes]


class JobFiles:
    """Files of jobs.

    Parameters
    ----------
    jobs : AllJobs
        Decides which jobs a caller may see.
    """

    def __init__(self, database: Database, clock: Clock, blobs: Blobs, jobs: AllJobs) -> None:
        self._database, self._clock, self._blobs, self._jobs = database, clock, blobs, jobs
        self._stopping = threading.Event()

    def finish(self, job: RunningJob, path: Path, *, name: str, media_type: str, headers: dict[str, str]) -> None:
        """Store a file, and finish its job."""
        with path.open("rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        with staged(self._blobs) as stage:
            result = {
                "name": name,
                "media_type": media_type,
                "size_bytes": path.stat().st_size,
                "sha256": sha256,
                "headers": headers,
                "blob_key": stage.put_file(FOLDER, path),
            }
            with self._database.write() as connection:
                if not job.finish(connection, result):
                    return
            stage.keep()

    def open(self, caller: Caller, job_id: str) -> StoredFile:
        """The file of a job that is done.

        Raises
        ------
        NotFound
            There is no such job, it makes no file, or the file has expired.
        Conflict
            The job is not done.
        """
        job = self._jobs.row(caller, job_id)
        if job.kind not in FILE_KINDS:
            raise NotFound(f"a {job.kind} makes no file", field="job_id", cure="follow links.result of the job")
        if job.state != "done" or job.result is None:
            raise Conflict(
                f"the job is {job.state}",
                field="job_id",
                limit="jobs that are done",
                cure=f"GET /v1/jobs/{job_id}/events reports when it is",
            )
        if job.result.get("blob_key") is None:
            raise NotFound(
                "the file of this job has expired", field="job_id", limit=f"{KEPT.days} days", cure="ask for it again"
            )
        found = job.result
        return StoredFile(
            found["name"], found["media_type"], found["size_bytes"], found["sha256"], found["headers"],
            self._blobs.stream(found["blob_key"]),
        )  # fmt: skip

    def stop(self) -> None:
        """End a `try_to_delete_expired` that runs."""
        self._stopping.set()

    def delete_expired(self) -> int:
        """Delete files that are kept no longer; returns their number."""
        with across_agencies(), self._database.read() as connection:
            expired = registry_jobs.list_ended(connection, FILE_KINDS, self._clock() - KEPT)
        deleted = 0
        for job in expired:
            if self._stopping.is_set():
                break
            key = (job.result or {}).get("blob_key")
            if key is None:
                continue
            with across_agencies(), self._database.write() as connection:
                registry_jobs.replace_result(connection, job.id, {**(job.result or {}), "blob_key": None})
            delete_unused(self._blobs, [key])
            deleted += 1
        return deleted

    def try_to_delete_expired(self) -> None:
        """As `delete_expired`; a store that does not answer is tried the next time."""
        try:
            self.delete_expired()
        except (Unavailable, sa.exc.SQLAlchemyError) as error:
            _LOG.warning("expired files of jobs could not be deleted", why=str(error))
