"""The cost of requests: a budget of processor time by key and agency, and slots for routes that may take seconds."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from contextvars import ContextVar
from functools import partial, wraps
from inspect import iscoroutinefunction
from typing import Any, NamedTuple

import anyio
from anyio import to_thread
from fastapi import Response
from starlette.exceptions import HTTPException
from starlette.types import Receive

from app.api.http.rate_limits import RateLimit
from app.errors import Unavailable
from app.services.access.access import Caller
from app.services.request_work import RequestWork, counted, working

EXPENSIVE = frozenset(
    {
        "POST /v1/markers/bulk",
        "POST /v1/artwork",
        "POST /v1/programs",
        "POST /v1/radio-checks",
        "POST /v1/imports",
        "GET /v1/exports/{kind}",
        "GET /v1/snapshots",
        "POST /v1/alignments",
        "GET /v1/alignments/{alignment_id}/map.{form}",
        "GET /v1/alignments/{alignment_id}/profile",
        "POST /v1/plan-rules",
        "POST /v1/plan-previews",
        "POST /v1/plans",
        "PATCH /v1/plans/{plan_id}",
        "GET /v1/plans/{plan_id}/files/{name}",
        "POST /v1/plans/{plan_id}/commit",
        "GET /v1/plans/{plan_id}/as-built",
        "POST /v1/roads",
        "PATCH /v1/roads/{road_id}",
        "POST /v1/roads/{road_id}/locate",
        "POST /v1/roads/{road_id}/position",
        "POST /v1/codebooks",
        "POST /v1/codebook-drafts",
        "POST /v1/codebooks/{codebook_id}/entries",
        "POST /v1/calibrations",
        "POST /v1/plate-drafts/artwork.{form}",
        "POST /v1/plate-drafts/view",
        "POST /v1/print-grades",
        "GET /v1/decodes/{decode_id}/samples",
        "GET /v1/decodes/{decode_id}/packets",
    }
)
"""Routes whose largest request takes over a second. Source: `python -m benchmarks.abuse`."""
MAX_WAITING = 16
"""Expensive requests of one agency that wait for a slot; each holds its body."""
SLOT_WAIT_S = 20.0
"""Longest wait for a slot. [s]"""
_MINUTES_AT_ONCE = 10
Endpoint = Callable[..., Any]


class Slots:
    """Places for expensive requests: so many at once in all, and fewer for one agency. For the event loop only.

    Parameters
    ----------
    in_all, per_agency : int
    wait_s : float
        Longest wait for a place. [s]
    """

    def __init__(self, in_all: int, per_agency: int, wait_s: float = SLOT_WAIT_S) -> None:
        self._in_all, self._per_agency, self._wait_s = in_all, per_agency, wait_s
        self._running: Counter[str] = Counter()
        self._waiting: Counter[str] = Counter()
        self._freed = asyncio.Event()

    @asynccontextmanager
    async def slot(self, agency_id: str) -> AsyncIterator[None]:
        """A place for a request of an agency.

        Raises
        ------
        Unavailable
            None was free in time, or too many requests of the agency wait already.
        """
        await self._wait(agency_id)
        self._running[agency_id] += 1
        try:
            yield
        finally:
            self._running -= Counter([agency_id])
            self._freed.set()
            self._freed = asyncio.Event()

    def _is_free(self, agency_id: str) -> bool:
        return self._running[agency_id] < self._per_agency and self._running.total() < self._in_all

    async def _wait(self, agency_id: str) -> None:
        if self._is_free(agency_id):
            return
        if self._waiting[agency_id] >= MAX_WAITING:
            raise self._busy()
        self._waiting[agency_id] += 1
        try:
            with anyio.fail_after(self._wait_s):
                while not self._is_free(agency_id):
                    await self._freed.wait()
        except TimeoutError:
            raise self._busy() from None
        finally:
            self._waiting -= Counter([agency_id])

    def _busy(self) -> Unavailable:
        return Unavailable(
            "too many expensive requests are being handled",
            limit=f"{self._per_agency} at once for one agency, {self._in_all} in all",
            cure="wait for the time in Retry-After, and send expensive requests one after the other",
        )


class Budget:
    """Processor time that keys and agencies may use, charged after each request.

    Parameters
    ----------
    key_s_per_min, agency_s_per_min : float
        Processor time per minute in the long run; ten minutes' worth at once. 0: unlimited. [s/min]
    """

    def __init__(self, key_s_per_min: float, agency_s_per_min: float) -> None:
        self._limits = [
            (_limit(per_min, owner), of)
            for per_min, owner, of in (
                (key_s_per_min, "key", _key_of),
                (agency_s_per_min, "agency", _agency_of),
            )
            if per_min
        ]

    def check(self, caller: Caller) -> None:
        """Refuse a caller that has used up its time.

        Raises
        ------
        TooManyRequests
            With the time until there is some again.
        """
        for limit, of in self._limits:
            limit.check(of(caller))

    def charge(self, caller: Caller, used_s: float) -> None:
        """Charge a request. [s]"""
        for limit, of in self._limits:
            limit.charge(of(caller), used_s)


def _key_of(caller: Caller) -> str:
    return caller.key_id


def _agency_of(caller: Caller) -> str:
    return caller.agency_id


def _limit(per_min: float, owner: str) -> RateLimit:
    return RateLimit(
        per_min / 60,
        max(1, round(per_min * _MINUTES_AT_ONCE)),
        name=f"{owner}-processor-seconds",
        message=f"the requests of this {owner} used too much processor time",
        cure="wait for the time in Retry-After, and send smaller requests, or fewer",
    )


# --- around the endpoints -----------------------------------------------------------------------------------------


class _Admitted(NamedTuple):
    slots: Slots
    agency_id: str
    work: RequestWork
    receive: Receive


_ADMITTED: ContextVar[_Admitted | None] = ContextVar("waymark_admitted", default=None)


@contextmanager
def admitted(slots: Slots, agency_id: str, timeout_s: float, receive: Receive) -> Iterator[RequestWork]:
    """Account for a request, and give its endpoint the server's slots."""
    with working(timeout_s) as work:
        token = _ADMITTED.set(_Admitted(slots, agency_id, work, receive))
        try:
            yield work
        finally:
            _ADMITTED.reset(token)


def bounded(endpoint: Endpoint, *, expensive: bool) -> Endpoint:
    """An endpoint that runs in a thread whose time is counted; an expensive one in a slot, while its client waits."""
    if iscoroutinefunction(endpoint):
        return endpoint

    @wraps(endpoint)
    async def run(**values: Any) -> Response:
        call = partial(counted, endpoint, **values)
        request = _ADMITTED.get()
        if request is None or not expensive:
            return await to_thread.run_sync(call)
        async with request.slots.slot(request.agency_id), _watched(request):
            return await to_thread.run_sync(call)

    return run


@asynccontextmanager
async def _watched(request: _Admitted) -> AsyncIterator[None]:
    """Note it when the client leaves. The body was read before, so the next message is its end."""

    async def watch() -> None:
        with suppress(HTTPException):
            while (await request.receive())["type"] != "http.disconnect":
                pass
        request.work.abandoned = True

    task = asyncio.create_task(watch())
    try:
        yield
    finally:
        task.cancel()
