"""Jobs of every kind as clients see them."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, NotRequired, cast

from pydantic import Field
from typing_extensions import TypedDict

from app.registry.jobs import UNFINISHED, JobKind, JobRow, JobState
from app.services.error_documents import ErrorDocument
from app.services.progress.kinds import rules_of


class JobLinks(TypedDict):
    """Paths of the job, of its progress as server-sent events, and of what it made."""

    self: str
    events: str
    result: NotRequired[str]


class JobDocument(TypedDict):
    """A job of any kind. Its result is a resource of its own: `links.result`, once the job is done."""

    id: str
    kind: JobKind
    state: JobState
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


class JobPage(TypedDict):
    """A page of jobs, newest first; the Link header leads to the next one."""

    items: list[JobDocument]


def job_document(job: JobRow, now: datetime) -> JobDocument:
    """A job as clients see it."""
    return {
        "id": job.id,
        "kind": JobKind(job.kind),
        "state": job.state,
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
