"""/v1/jobs: work that goes on after its request was answered, of every kind."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Annotated

from anyio import to_thread
from fastapi import APIRouter, Path, Query, Request, Response

from app.api.http import event_stream
from app.api.http.dependencies import Caller, Identifier, LastId, PageSize, use_cases
from app.api.http.event_stream import EventStream, LastEventId, ServerEvent
from app.api.http.problems import problem_responses
from app.api.http.responses import document_response, json_response, page_response, text_response
from app.api.http.strict_json import StrictRoute
from app.api.jobs.streams import Streams
from app.api.jobs.watch import JobFollower, Watch
from app.registry.jobs import UNFINISHED, JobKind, JobRow, JobState
from app.services.ports import Clock
from app.services.progress.documents import JobDocument, JobPage, job_document
from app.services.progress.jobs import AllJobs

router = APIRouter(prefix="/v1/jobs", tags=["jobs"], route_class=StrictRoute)

JobId = Annotated[Identifier, Path(description="Id of the job.")]
Service = Annotated[AllJobs, use_cases("all_jobs")]


@router.get("", responses=document_response(JobPage))
def list_jobs(
    request: Request,
    caller: Caller,
    jobs: Service,
    kind: JobKind | None = None,
    state: JobState | None = None,
    dead_letter: Annotated[
        bool | None, Query(description="`true`: only jobs that stopped the processes that worked on them.")
    ] = None,
    limit: PageSize = 100,
    before: LastId = None,
) -> Response:
    """Jobs of all kinds that the key may see, newest first."""
    page, last = jobs.page(caller, kind=kind, state=state, dead_letter=dead_letter, before=before, limit=limit)
    return page_response(request, page, before=last)


@router.get("/{job_id}", responses=document_response(JobDocument, 404))
def get_job(job_id: JobId, caller: Caller, jobs: Service) -> Response:
    """A job with its progress; `links.result` leads to its result once it is done."""
    document = jobs.get(caller, job_id)
    waiting = document["state"] in UNFINISHED
    return json_response(document, headers={"Retry-After": "1"} if waiting else None)


@router.post("/{job_id}/cancel", responses=document_response(JobDocument, 404, 409))
def cancel_job(job_id: JobId, caller: Caller, jobs: Service) -> Response:
    """Ask a queued or running job to stop; a finished one stays as it is.

    409 where it is too late: an import that is storing already.
    """
    return json_response(jobs.cancel(caller, job_id))


@router.get(
    "/{job_id}/events",
    responses={
        **text_response(event_stream.MEDIA_TYPE, "Events `progress`, and a last one `done`, `failed` or `cancelled`"),
        204: {"description": "The last event has been seen: do not connect again"},
        **problem_responses(404),
    },
)
async def get_job_events(
    job_id: JobId,
    caller: Caller,
    jobs: Service,
    streams: Annotated[Streams, use_cases("streams")],
    last_event_id: LastEventId = None,
) -> Response:
    """The progress of a job as server-sent events, until it ends: `done`, `total`, `rate_per_s` and `progress`.

    The first event is the present state, and the last one has the name of the state in which the job ended, and the
    whole job as data. With `Last-Event-ID`, what was seen is not sent again. Comments keep the connection open. A
    stream ends after 15 minutes at the latest; clients connect again.
    """
    row = await to_thread.run_sync(jobs.row, caller, job_id)
    if row.state not in UNFINISHED and last_event_id == _event_id(row):
        return Response(status_code=204)
    return EventStream(_events(row, streams.jobs, jobs.clock, last_event_id), streams.places, caller.key_id)


async def _events(row: JobRow, watch: Watch[JobRow], clock: Clock, seen: str | None) -> AsyncIterator[ServerEvent]:
    follower = JobFollower(row)
    with watch.following(row.id, follower):
        if _event_id(row) != seen:
            yield _event(follower, clock)
        while follower.row.state in UNFINISHED:
            if await follower.wait(event_stream.HEARTBEAT_S):
                yield _event(follower, clock)
            else:
                yield ServerEvent()


def _event_id(row: JobRow) -> str:
    """What distinguishes two states of a job."""
    return f"{row.state}.{row.attempts}.{row.steps_done or 0}.{row.progress:.6f}"


def _event(follower: JobFollower, clock: Clock) -> ServerEvent:
    row = follower.row
    document = job_document(row, clock())
    if row.state in UNFINISHED:
        rate_per_s = follower.rate_per_s()
        if rate_per_s is not None:
            document["rate_per_s"] = rate_per_s
        return ServerEvent("progress", _event_id(row), document)
    return ServerEvent(row.state, _event_id(row), document)
