"""/v1/events: what happens in an agency, as it happens."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Annotated

from anyio import to_thread
from fastapi import APIRouter, Query, Request, Response

from app.api.http import event_stream
from app.api.http.dependencies import Caller, PageSize, use_cases
from app.api.http.event_stream import EventStream, LastEventId, ServerEvent
from app.api.http.problems import problem_responses
from app.api.http.responses import page_response
from app.api.http.strict_json import StrictRoute
from app.api.jobs.streams import Streams
from app.api.jobs.watch import AgencyFollower, Watch
from app.errors import InvalidParameter
from app.services.access.access import Caller as CallerValue
from app.services.progress.events import AgencyEvents, EventPage

router = APIRouter(prefix="/v1/events", tags=["events"], route_class=StrictRoute)

_MAX_DIGITS = 18
Service = Annotated[AgencyEvents, use_cases("agency_events")]


@router.get(
    "",
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
    events: Service,
    streams: Annotated[Streams, use_cases("streams")],
    after: Annotated[int | None, Query(ge=0, lt=10**18, description="Id of the last event that was seen.")] = None,
    limit: PageSize = 100,
    last_event_id: LastEventId = None,
) -> Response:
    """What happens in the agency, oldest first: jobs that end, markers that become suspect.

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
            f"{last_event_id[:40]!r} is no id of an event", field="Last-Event-ID", limit="the id of an event, a number",
            cure="send the id of the last event as it came",
        )  # fmt: skip
    return int(last_event_id)
