"""Routes about jobs of every kind and their files, about events, and about webhooks."""

from __future__ import annotations

import asyncio
import time
from collections import defaultdict, deque
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Annotated, Generic, Protocol, TypeVar

import anyio
import structlog
from anyio import to_thread
from fastapi import Depends, Path, Query, Request, Response
from fastapi.responses import StreamingResponse
from pydantic import ConfigDict, Field

from app.api.http import event_stream
from app.api.http.dependencies import Caller, LastId, PageSize, use_case
from app.api.http.event_stream import EventStream, LastEventId, ServerEvent, StreamPlaces
from app.api.http.permissions import EVERYBODY, PLANNERS, READERS
from app.api.http.problems import problem_responses
from app.api.http.responses import (
    NOT_MODIFIED,
    IfNoneMatch,
    created_response,
    document_response,
    file_response,
    json_response,
    page_response,
    text_response,
)
from app.api.http.routes import Router
from app.errors import InvalidParameter, Unavailable
from app.inputs import Identifier, StrictModel, Text
from app.registry.jobs import UNFINISHED, JobKind, JobRow, JobState
from app.services.access.access import Caller as CallerValue
from app.services.ports import Clock
from app.services.progress import AgencyEvents, AllJobs, AnyJob, EventPage, JobDocument, JobFiles, JobPage, job_summary
from app.services.surveys.exports import STREAMED, WHOLE
from app.services.webhooks import (
    DeliveryDocument,
    DeliveryPage,
    DeliveryState,
    NewWebhookDocument,
    WebhookDocument,
    WebhookList,
    Webhooks,
)

# === What streams follow: one query for all jobs, and one for all agencies, at each tick, whoever runs the jobs.


TICK_S = 0.5
"""Time between two looks. [s] Jobs report their progress about once a second."""
WINDOW_S = 10.0
"""Time over which the rate of a job's steps is taken. [s]"""
StateT = TypeVar("StateT")
StateT_contra = TypeVar("StateT_contra", contravariant=True)
_LOG = structlog.get_logger(__name__)


class _Follower(Protocol[StateT_contra]):
    def notify(self, state: StateT_contra, /) -> None:
        """Note a state."""


class Watch(Generic[StateT]):
    """Looks at all that is followed in this process, together, in one thread, only while there are followers.

    Parameters
    ----------
    read : callable
        States by ids; runs in a thread.
    """

    def __init__(self, read: Callable[[Sequence[str]], Mapping[str, StateT]], tick_s: float = TICK_S) -> None:
        self._read, self._tick_s = read, tick_s
        self._followers: dict[str, set[_Follower[StateT]]] = defaultdict(set)
        self._task: asyncio.Task[None] | None = None

    @property
    def is_looking(self) -> bool:
        """Whether somebody follows something."""
        return self._task is not None and not self._task.done()

    @contextmanager
    def following(self, followed_id: str, follower: _Follower[StateT]) -> Iterator[None]:
        """Notify a follower of states while a block runs."""
        self._followers[followed_id].add(follower)
        if not self.is_looking:
            self._task = asyncio.create_task(self._look())
        try:
            yield
        finally:
            self._followers[followed_id].discard(follower)
            if not self._followers[followed_id]:
                del self._followers[followed_id]

    async def _look(self) -> None:
        limiter = anyio.CapacityLimiter(1)
        while self._followers:
            try:
                states = await to_thread.run_sync(self._read, list(self._followers), limiter=limiter)
            except Unavailable:
                states = {}  # the database answers again at one of the next ticks
            except Exception:  # noqa: BLE001 - it is logged, and those who follow wait on
                _LOG.exception("what streams follow could not be read")
                states = {}
            for followed_id, state in states.items():
                for follower in self._followers.get(followed_id, ()):
                    follower.notify(state)
            await asyncio.sleep(self._tick_s)


class _Flag:
    """Set by one task, awaited by another for so long."""

    def __init__(self) -> None:
        self._event = asyncio.Event()

    def set(self) -> None:
        self._event.set()

    async def wait(self, timeout_s: float) -> bool:
        with anyio.move_on_after(timeout_s):
            await self._event.wait()
        was_set = self._event.is_set()
        self._event.clear()
        return was_set


class JobFollower:
    """One who follows a job: only the newest state waits for it, so a slow one costs no memory.

    Attributes
    ----------
    row : JobRow
        The newest state.
    """

    def __init__(self, row: JobRow) -> None:
        self.row = row
        self._steps: deque[tuple[float, int]] = deque()
        self._changed = _Flag()
        self._note(row)

    def notify(self, row: JobRow) -> None:
        """Replace the state."""
        if _progress_of(row) != _progress_of(self.row):
            self.row = row
            self._note(row)
            self._changed.set()

    async def wait(self, timeout_s: float) -> bool:
        """Wait for a new state; returns whether one came in time."""
        return await self._changed.wait(timeout_s)

    def rate_per_s(self) -> float | None:
        """Steps per second in the last seconds; None before two states differ. [1/s]"""
        (first_s, first), (last_s, last) = self._steps[0], self._steps[-1]
        if last <= first or last_s <= first_s:
            return None
        return round((last - first) / (last_s - first_s), 3)

    def _note(self, row: JobRow) -> None:
        now_s = time.monotonic()
        self._steps.append((now_s, row.steps_done or 0))
        while len(self._steps) > 2 and now_s - self._steps[1][0] > WINDOW_S:
            self._steps.popleft()


def _progress_of(row: JobRow) -> tuple[object, ...]:
    """The state that a follower gets; a row that was read for a stream has neither input nor result."""
    return row.state, row.attempts, row.progress, row.steps_done, row.steps_total, row.cancel_requested


class AgencyFollower:
    """One who follows the events of an agency.

    Attributes
    ----------
    after : int
        Id of the last event that it has read.
    """

    def __init__(self, after: int) -> None:
        self.after = after
        self._newer = _Flag()

    def notify(self, newest: int) -> None:
        """There are events up to this one."""
        if newest > self.after:
            self._newer.set()

    async def wait(self, timeout_s: float) -> bool:
        """Wait for newer events; returns whether there are some."""
        return await self._newer.wait(timeout_s)


# === What all event streams of this process share.


class Streams:
    """The places for streams, and the looks at the jobs and agencies that they follow.

    Parameters
    ----------
    read_jobs : callable
        Rows of jobs by their ids.
    read_newest : callable
        Ids of the newest events by agencies.
    """

    def __init__(
        self,
        read_jobs: Callable[[Sequence[str]], Mapping[str, JobRow]],
        read_newest: Callable[[Sequence[str]], Mapping[str, int]],
    ) -> None:
        self.places = StreamPlaces()
        self.jobs = Watch(read_jobs)
        self.agencies = Watch(read_newest)


async def get_streams(request: Request) -> Streams:
    """The streams of the server."""
    streams: Streams = request.app.state.streams
    return streams


SharedStreams = Annotated[Streams, Depends(get_streams)]


# === /v1/jobs: work that goes on after its request was answered, of every kind.


router = Router("/v1/jobs", "jobs")

JobId = Annotated[Identifier, Path(description="Id of the job.")]
Service = Annotated[AllJobs, use_case(lambda cases: cases.all_jobs)]


@router.get("", EVERYBODY, responses=document_response(JobPage))
def list_jobs(
    request: Request,
    caller: Caller,
    jobs: Service,
    kind: JobKind | None = None,
    state: JobState | None = None,
    dead_letter: Annotated[
        bool | None, Query(description="`true`: only jobs that stopped the processes that worked on them.")
    ] = None,
    subject_id: Annotated[Identifier | None, Query(description="Jobs about this plan or reprocessing.")] = None,
    limit: PageSize = 100,
    after: LastId = None,
) -> Response:
    """List the jobs of an agency.

    Of all kinds that the key may see, without their results, newest first.
    """
    page, last = jobs.page(
        caller, kind=kind, state=state, dead_letter=dead_letter, subject_id=subject_id, before=after, limit=limit
    )
    return page_response(request, page, after=last)


@router.get("/{job_id}", EVERYBODY, responses=document_response(AnyJob, 404))
def get_job(job_id: JobId, caller: Caller, jobs: Service) -> Response:
    """Get a job with its progress.

    Once it is done it has its result, or `links.result` leads there. A refused import is done, too.
    """
    document = jobs.get(caller, job_id)
    waiting = document["state"] in UNFINISHED
    return json_response(document, headers={"Retry-After": "1"} if waiting else None)


# viewers cancel the artwork and exports that they asked for; app/services/progress.py lists the kinds of each scope
@router.post("/{job_id}/cancel", EVERYBODY, responses=document_response(AnyJob, 404, 409))
def cancel_job(job_id: JobId, caller: Caller, jobs: Service) -> Response:
    """Cancel a job.

    Asks a queued or running job to stop; a finished one stays as it is.

    409 where it is too late: an import that is storing already.
    """
    return json_response(jobs.cancel(caller, job_id))


@router.get(
    "/{job_id}/events",
    EVERYBODY,
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
    streams: SharedStreams,
    last_event_id: LastEventId = None,
) -> Response:
    """Follow the progress of a job.

    As server-sent events, until it ends: `done`, `total`, `rate_per_s` and `progress`.

    The first event is the present state, and the last one has the name of the state in which the job ended. The data of
    each is the job without its result. With `Last-Event-ID`, what was seen is not sent again. Comments keep the
    connection open. A stream ends after 15 minutes at the latest; clients connect again.
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
    document = job_summary(row, clock())
    if row.state in UNFINISHED:
        rate_per_s = follower.rate_per_s()
        if rate_per_s is not None:
            document["rate_per_s"] = rate_per_s
        return ServerEvent("progress", _event_id(row), document)
    return ServerEvent(row.state, _event_id(row), document)


# === /v1/jobs/{job_id}/result: files that jobs have made.


file_router = Router("/v1/jobs", "jobs")

_TYPES = dict.fromkeys(media.partition(";")[0] for media in ("application/zip", *(STREAMED | WHOLE).values()))


def queued_job(job: JobDocument, replayed: bool) -> Response:
    """202 Accepted for a job that was queued."""
    response = created_response(job, replayed, path="/v1/jobs", status=202)
    response.headers["Retry-After"] = "1"
    return response


@file_router.get(
    "/{job_id}/result",
    READERS,
    response_class=StreamingResponse,
    responses={**file_response(_TYPES), **NOT_MODIFIED, **problem_responses(404, 409)},
)
def get_job_result(
    job_id: Annotated[Identifier, Path(description="Id of the job.")],
    caller: Caller,
    files: Annotated[JobFiles, use_case(lambda cases: cases.job_files)],
    if_none_match: IfNoneMatch = None,
) -> Response:
    """Download the file of a job.

    Artwork or an export. It is kept for seven days; then 404.
    """
    file = files.open(caller, job_id)
    headers = {"ETag": f'"{file.sha256}"'}
    if if_none_match == headers["ETag"]:
        return Response(status_code=304, headers=headers)
    headers |= {
        **file.headers,
        "Content-Length": str(file.size_bytes),
        "Content-Disposition": f'attachment; filename="{file.name}"',
    }
    return StreamingResponse(file.chunks, headers=headers, media_type=file.media_type)


# === /v1/events: what happens in an agency, as it happens.


event_router = Router("/v1/events", "events")

_MAX_DIGITS = 18
EventService = Annotated[AgencyEvents, use_case(lambda cases: cases.agency_events)]


@event_router.get(
    "",
    EVERYBODY,
    responses={
        200: {
            "model": EventPage,
            "description": "Events; as a stream their type is the kind, e.g. `job.done`",
            "content": {event_stream.MEDIA_TYPE: {"schema": {"type": "string"}}},
        },
        **problem_responses(),
    },
)
async def get_events(
    request: Request,
    caller: Caller,
    events: EventService,
    streams: SharedStreams,
    after: Annotated[int | None, Query(ge=0, lt=10**18, description="Id of the last event that was seen.")] = None,
    limit: PageSize = 100,
    last_event_id: LastEventId = None,
) -> Response:
    """List or follow the events of an agency.

    Oldest first: jobs that end, markers that become suspect.

    A vehicle gets the events of the jobs that its key asked for.

    With `Accept: text/event-stream` it is a stream of events as they happen: all since `Last-Event-ID`, or without it
    new ones only. It ends after 15 minutes at the latest; clients connect again. Events are kept for 30 days.
    """
    if event_stream.MEDIA_TYPE not in request.headers.get("accept", ""):
        page = await to_thread.run_sync(events.list, caller, after or 0, limit)
        return page_response(request, EventPage(items=page), after=page[-1]["id"] if len(page) == limit else None)
    if last_event_id is not None:
        after = _number(last_event_id)
    elif after is None:
        after = await to_thread.run_sync(events.newest, caller)
    return EventStream(_stream(caller, events, streams.agencies, after), streams.places, caller.key_id)


async def _stream(
    caller: CallerValue, events: AgencyEvents, watch: Watch[int], after: int
) -> AsyncIterator[ServerEvent]:
    follower = AgencyFollower(after)
    with watch.following(caller.agency_id, follower):
        while True:
            if not await follower.wait(event_stream.HEARTBEAT_S):
                yield ServerEvent()
                continue
            while found := await to_thread.run_sync(events.list, caller, follower.after):
                for event in found:
                    follower.after = event["id"]
                    yield ServerEvent(event["kind"], str(event["id"]), event)


def _number(last_event_id: str) -> int:
    if not (last_event_id.isascii() and last_event_id.isdigit()) or len(last_event_id) > _MAX_DIGITS:
        raise InvalidParameter(
            f"{last_event_id[:40]!r} is no id of an event",
            field="Last-Event-ID",
            limit="the id of an event, a number",
            cure="send the id of the last event as it came",
        )
    return int(last_event_id)


# === /v1/webhooks: addresses that are sent the agency's events.


webhook_router = Router("/v1/webhooks", "webhooks")

WebhookId = Annotated[Identifier, Path(description="Id of the webhook.")]
DeliveryId = Annotated[Identifier, Path(description="Id of the delivery, the header `webhook-id`.")]
WebhookService = Annotated[Webhooks, use_case(lambda cases: cases.webhooks)]


class WebhookIn(StrictModel):
    """A webhook to register."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"url": "https://example.org/hooks/waymark", "events": ["job.*"]}]}
    )

    url: Text = Field(min_length=1, max_length=500, description="https, at a public address.")
    events: list[Annotated[Text, Field(min_length=1, max_length=40)]] = Field(
        min_length=1, max_length=20, description="Kinds of events: `job.done`; `job.*` for all that begin so; `*`."
    )


@webhook_router.post("", PLANNERS, status_code=201, responses=document_response(NewWebhookDocument, 409, status=201))
def post_webhook(webhook: WebhookIn, caller: Caller, webhooks: WebhookService) -> Response:
    """Register a webhook.

    Each event is posted to its URL, signed as Standard Webhooks are, until it answers with 2xx.

    The secret is in this answer only; an Idempotency-Key is not heeded, because no answer is kept.
    """
    document = webhooks.create(caller, webhook.url, webhook.events)
    headers = {"Location": f"/v1/webhooks/{document['id']}", "Cache-Control": "private, no-store"}
    return json_response(document, 201, headers)


@webhook_router.get("", PLANNERS, responses=document_response(WebhookList))
def list_webhooks(caller: Caller, webhooks: WebhookService) -> Response:
    """List the webhooks of an agency."""
    return json_response(webhooks.all(caller))


@webhook_router.get("/{webhook_id}", PLANNERS, responses=document_response(WebhookDocument, 404))
def get_webhook(webhook_id: WebhookId, caller: Caller, webhooks: WebhookService) -> Response:
    """Get a webhook."""
    return json_response(webhooks.get(caller, webhook_id))


@webhook_router.delete("/{webhook_id}", PLANNERS, status_code=204, responses=problem_responses(404))
def delete_webhook(webhook_id: WebhookId, caller: Caller, webhooks: WebhookService) -> Response:
    """Delete a webhook with its deliveries."""
    webhooks.delete(caller, webhook_id)
    return Response(status_code=204)


@webhook_router.post("/{webhook_id}/enable", PLANNERS, responses=document_response(WebhookDocument, 404))
def enable_webhook(webhook_id: WebhookId, caller: Caller, webhooks: WebhookService) -> Response:
    """Enable a webhook again.

    One that was disabled because its receiver failed for a day; it gets the events since then.
    """
    return json_response(webhooks.enable(caller, webhook_id))


@webhook_router.get("/{webhook_id}/deliveries", PLANNERS, responses=document_response(DeliveryPage, 404))
def list_deliveries(
    request: Request,
    webhook_id: WebhookId,
    caller: Caller,
    webhooks: WebhookService,
    state: DeliveryState | None = None,
    limit: PageSize = 100,
    after: LastId = None,
) -> Response:
    """List the deliveries of a webhook.

    What was sent and how that ended, newest first; kept for 30 days.
    """
    page, last = webhooks.deliveries(caller, webhook_id, state=state, before=after, limit=limit)
    return page_response(request, page, after=last)


@webhook_router.post(
    "/{webhook_id}/deliveries/{delivery_id}/redeliver",
    PLANNERS,
    responses=document_response(DeliveryDocument, 404, 409),
)
def redeliver(webhook_id: WebhookId, delivery_id: DeliveryId, caller: Caller, webhooks: WebhookService) -> Response:
    """Send a delivery of a webhook again.

    With the same id and body.
    """
    return json_response(webhooks.redeliver(caller, webhook_id, delivery_id))
