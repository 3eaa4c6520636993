"""Jobs about plans: making one of a long road, proving one, packing its files. Listed, read and cancelled alike."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal, NotRequired, cast

import sqlalchemy as sa
from pydantic import Field
from typing_extensions import TypedDict

from app.errors import Conflict
from app.registry import jobs as store
from app.registry.database import Database
from app.registry.jobs import UNFINISHED, JobKind, JobRow, JobState
from app.services.access.access import Caller, Scope
from app.services.documents import document_of
from app.services.error_documents import ErrorDocument
from app.services.jobs import RunningJob
from app.services.ports import Clock

KINDS = (JobKind.PLAN, JobKind.PROOF, JobKind.PACKAGE)
PlanJobKind = Literal["plan", "proof", "package"]


class PlanJobLinks(TypedDict):
    """Where to read the job again, and the plan."""

    self: str
    plan: NotRequired[str]


class PlanJobResult(TypedDict):
    """What a job has done. Members that do not belong to its kind are left out."""

    plan_version: NotRequired[int]
    """Version of the plan that was proved, packed or made."""
    outdated: NotRequired[bool]
    """The plan was changed while it was proved: the result is not its proof."""
    passed: NotRequired[bool]
    weak: NotRequired[int]
    wrong: NotRequired[int]
    size_bytes: NotRequired[int]
    sha256: NotRequired[str]
    files: NotRequired[int]


class PlanJobSummary(TypedDict):
    """A job about a plan, without its result."""

    id: str
    kind: PlanJobKind
    plan_id: Annotated[str | None, Field(description="Null before the plan is made.")]
    state: JobState
    progress: Annotated[float, Field(description="0 to 1.")]
    steps_done: Annotated[int | None, Field(description="Units of a proof, files of a package; null if unknown.")]
    steps_total: int | None
    attempts: Annotated[int, Field(description="Since the last part of the result was stored.")]
    cancel_requested: Annotated[bool, Field(description="A running job stops at its next step.")]
    created_at: datetime
    finished_at: datetime | None
    error: Annotated[ErrorDocument | None, Field(description="Why there is no result.")]
    links: PlanJobLinks


class PlanJobDocument(PlanJobSummary):
    """A job about a plan."""

    result: PlanJobResult | None


class PlanJobPage(TypedDict):
    """A page of jobs, newest first; the Link header leads to the next one."""

    items: list[PlanJobSummary]


class PlanJobs:
    """Use cases on jobs about plans."""

    def __init__(self, database: Database, clock: Clock) -> None:
        self._database, self._clock = database, clock

    def get(self, caller: Caller, job_id: str) -> PlanJobDocument:
        """A job with its progress, and its result once there is one.

        Raises
        ------
        NotFound
            There is none with this id, or it belongs to another agency.
        """
        with self._database.read() as connection:
            return plan_job_document(store.get_job(connection, caller.agency_id, KINDS, job_id))

    def page(
        self, caller: Caller, *, plan_id: str | None = None, state: str | None = None, before: str | None = None,
        limit: int = 100,
    ) -> tuple[PlanJobPage, str | None]:  # fmt: skip
        """A page of jobs without their results, newest first, and the id to continue before."""
        with self._database.read() as connection:
            rows = store.list_jobs(
                connection, caller.agency_id, KINDS, state=state, before=before, limit=limit + 1, subject_id=plan_id
            )
        page = PlanJobPage(items=[plan_job_summary(row) for row in rows[:limit]])
        return page, rows[limit - 1].id if len(rows) > limit else None

    def cancel(self, caller: Caller, job_id: str) -> PlanJobDocument:
        """Cancel a job: a queued one never starts, a running one stops at its next step, a finished one stays.

        Raises
        ------
        NotFound
            There is none with this id, or it belongs to another agency.
        """
        with self._database.write() as connection:
            store.get_job(connection, caller.agency_id, KINDS, job_id)
            store.request_cancel(connection, caller.agency_id, job_id, self._clock())
            return plan_job_document(store.get_job(connection, caller.agency_id, KINDS, job_id))


def plan_job_document(job: JobRow) -> PlanJobDocument:
    """A job as clients see it."""
    result = None
    if job.result is not None:
        members = PlanJobResult.__annotations__
        result = cast("PlanJobResult", {name: value for name, value in job.result.items() if name in members})
    return {**plan_job_summary(job), "result": result}


def plan_job_summary(job: JobRow) -> PlanJobSummary:
    """A job without its result."""
    links = PlanJobLinks(self=f"/v1/plan-jobs/{job.id}")
    if job.subject_id is not None:
        links["plan"] = f"/v1/plans/{job.subject_id}"
    return document_of(PlanJobSummary, job, plan_id=job.subject_id, links=links)


def check_only_one(connection: sa.Connection, agency_id: str, kind: JobKind, plan_id: str) -> None:
    """Refuse a second job of a kind about a plan while one is unfinished.

    Raises
    ------
    Conflict
    """
    other = store.find_job_about(connection, agency_id, kind, plan_id, UNFINISHED)
    if other is not None:
        raise Conflict(
            f"job {other.id} about this plan is {other.state}",
            field="plan_id",
            limit=f"one {kind} of a plan at a time",
            cure=f"wait for it, or cancel it: POST /v1/plan-jobs/{other.id}/cancel",
        )


def caller_of(job: RunningJob) -> Caller:
    """Whom a job acts for: the permissions were checked when it was queued."""
    return Caller(job.row.agency_id, job.row.holder_id or "", job.row.input["label"], Scope.PLANNER)
