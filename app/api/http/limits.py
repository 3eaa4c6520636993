"""Limits on requests: budgets of processor time, slots for expensive routes, and requests per key and address."""

from __future__ import annotations

import asyncio
import ipaddress
import math
import select
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from contextvars import ContextVar
from functools import partial, wraps
from inspect import iscoroutinefunction
from threading import Lock
from typing import Any

import anyio
from anyio import to_thread
from fastapi import Response
from starlette.exceptions import HTTPException
from starlette.types import Receive

from app.errors import TooManyRequests, Unavailable
from app.services.access.access import Caller
from app.services.request_work import RequestWork, counted, working

# === Limits on requests per key and on wrong keys per address: token buckets in this process.


_MAX_BUCKETS = 10_000


class RateLimit:
    """Token buckets by owner. A bucket is stored as the time when it will be full again (GCRA, ITU-T I.371).

    Not thread-safe: only the event loop uses it.

    Parameters
    ----------
    per_s : float
        Tokens added per second, > 0. [1/s]
    at_once : int
        Tokens in a full bucket, >= 1.
    name : str
        Name of the policy in headers.
    message : str
        Message of a refusal.
    cure : str
        What the client can do.
    now_s : callable
        A monotonic clock. [s]
    """

    def __init__(
        self,
        per_s: float,
        at_once: int,
        *,
        name: str,
        message: str,
        cure: str,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._token_s = 1.0 / per_s
        self._bucket_s = at_once * self._token_s
        self._limit = f"{at_once} at once, then {per_s:.3g}/s"
        self._name, self._message, self._cure = name, message, cure
        self._now_s = now_s
        self._full_at_s: dict[str, float] = {}
        self.policy = f'"{name}";q={at_once};w={math.ceil(self._bucket_s)}'.encode()
        """Value of the header RateLimit-Policy (draft-ietf-httpapi-ratelimit-headers-10)."""

    def take(self, owner: str) -> bytes:
        """Take a token from an owner's bucket.

        Returns
        -------
        bytes
            Value of the header RateLimit: tokens left, and seconds until the bucket is full again.

        Raises
        ------
        TooManyRequests
            The bucket is empty.
        """
        now_s = self._now_s()
        full_at_s = max(self._full_at_s.get(owner, 0.0), now_s) + self._token_s
        left_s = self._bucket_s - (full_at_s - now_s)
        if left_s < -1e-9:
            raise self._refusal(-left_s)
        self._keep(owner, full_at_s, now_s)
        left = int(left_s / self._token_s + 1e-6)
        return f'"{self._name}";r={left};t={math.ceil(full_at_s - now_s)}'.encode()

    def check(self, owner: str) -> None:
        """Refuse an owner whose bucket is empty, without taking a token.

        Raises
        ------
        TooManyRequests
            It is.
        """
        if self.is_spent(owner):
            raise self._refusal(self._wait_s(owner))

    def is_spent(self, owner: str) -> bool:
        """Whether an owner's bucket is empty."""
        return self._wait_s(owner) > 1e-9

    def reserve_s(self, owner: str) -> float:
        """Take a token, or the one that comes after those that others wait for; returns the time until it comes. [s]"""
        wait_s = max(0.0, self._wait_s(owner))
        self.charge(owner, 1.0)
        return wait_s

    def _wait_s(self, owner: str) -> float:
        return self._full_at_s.get(owner, 0.0) - self._now_s() + self._token_s - self._bucket_s

    def charge(self, owner: str, tokens: float) -> None:
        """Take tokens that were used already; the bucket may be overdrawn, and `check` then refuses."""
        now_s = self._now_s()
        self._keep(owner, max(self._full_at_s.get(owner, 0.0), now_s) + tokens * self._token_s, now_s)

    def _keep(self, owner: str, full_at_s: float, now_s: float) -> None:
        if owner not in self._full_at_s and len(self._full_at_s) >= _MAX_BUCKETS:
            self._forget(now_s)
        self._full_at_s[owner] = full_at_s

    def _refusal(self, wait_s: float) -> TooManyRequests:
        return TooManyRequests(
            self._message, limit=self._limit, cure=self._cure, retry_after_s=max(1, math.ceil(wait_s))
        )

    def _forget(self, now_s: float) -> None:
        """Delete full buckets, which equal new ones; if there are none, delete the oldest tenth."""
        full = [owner for owner, at_s in self._full_at_s.items() if at_s <= now_s]
        for owner in full or list(self._full_at_s)[: _MAX_BUCKETS // 10]:
            del self._full_at_s[owner]


def address_of(host: str) -> str:
    """Addresses whose wrong keys are counted together: an IPv4 address, or an IPv6 network of 64 bits."""
    if ":" not in host:
        return host
    try:
        return str(ipaddress.ip_network((host.partition("%")[0], 64), strict=False))
    except ValueError:
        return host


# === The cost of requests: a budget of processor time by key and agency, and slots for routes that may take seconds.


MAX_WAITING = 16
"""Expensive requests of one agency that wait for a slot; each holds its body."""
SLOT_WAIT_S = 20.0
"""Longest wait for a slot. [s]"""
_MINUTES_AT_ONCE = 10
_WATCHED_AFTER_S = 0.1
"""Requests that take longer are watched for the end of their connection. [s] Few take as long."""
_LOOK_EVERY_S = 0.25
_CLOSED = getattr(select, "POLLRDHUP", 0)
"""The client has closed its side, even where it sent more that nobody has read. Source: man 2 poll; Linux only, others
report POLLHUP, which needs no flag."""
Endpoint = Callable[..., Any]
Transport = asyncio.BaseTransport | None  # of the connection of a request, where the server has one


class Slots:
    """Places for expensive requests: so many at once in all, and fewer for one agency. For the event loop only.

    Parameters
    ----------
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
    """Processor time that keys and agencies may use, charged after each request, and after each job to its agency.

    Parameters
    ----------
    key_s_per_min, agency_s_per_min : float
        Processor time per minute in the long run; ten minutes' worth at once. 0: unlimited. [s/min]
    """

    def __init__(self, key_s_per_min: float, agency_s_per_min: float) -> None:
        self._lock = Lock()
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
        with self._lock:
            for limit, of in self._limits:
                limit.check(of(caller))

    def charge(self, caller: Caller, used_s: float) -> None:
        """Charge a request. [s]"""
        with self._lock:
            for limit, of in self._limits:
                limit.charge(of(caller), used_s)

    def charge_job(self, agency_id: str, used_s: float) -> None:
        """Charge a job of an agency, from any thread. [s]"""
        with self._lock:
            for limit, of in self._limits:
                if of is _agency_of:
                    limit.charge(agency_id, used_s)


def _key_of(caller: Caller) -> str:
    return caller.key_id


def _agency_of(caller: Caller) -> str:
    return caller.agency_id


def _limit(per_min: float, owner: str) -> RateLimit:
    return RateLimit(
        per_min / 60,
        max(1, round(per_min * _MINUTES_AT_ONCE)),
        name=f"{owner}-processor-seconds",
        message=f"the requests of this {owner} used too much processor time"
        + (", those of its jobs included" if owner == "agency" else ""),
        cure="wait for the time in Retry-After, and send smaller requests, or fewer",
    )


# --- around the endpoints -----------------------------------------------------------------------------------------


class _Admitted:
    """A request whose body is not yet read."""

    def __init__(self, slots: Slots, agency_id: str, work: RequestWork, receive: Receive, transport: Transport) -> None:
        self.slots, self.agency_id, self.work = slots, agency_id, work
        self._receive, self._transport = receive, transport
        self._watching: asyncio.TimerHandle | asyncio.Task[None] | None = None

    def watch(self) -> None:
        """Stop the work when the client leaves. The body has been read, so the next message is its end."""
        if self._watching is None:
            self._watching = asyncio.get_running_loop().call_later(_WATCHED_AFTER_S, self._begin)

    def end(self) -> None:
        """The request has ended."""
        if self._watching is not None:
            self._watching.cancel()

    def _begin(self) -> None:
        self._watching = asyncio.create_task(self._stop_when_left())

    async def _stop_when_left(self) -> None:
        left = asyncio.create_task(self._wait_for_disconnect())
        try:
            while not left.done() and not _is_disconnected(self._transport):
                await asyncio.wait((left,), timeout=_LOOK_EVERY_S)
            while True:
                await asyncio.to_thread(self.work.stops.stop)
                await asyncio.sleep(_LOOK_EVERY_S)
        finally:
            left.cancel()

    async def _wait_for_disconnect(self) -> None:
        with suppress(HTTPException):
            while (await self._receive())["type"] != "http.disconnect":
                pass


_ADMITTED: ContextVar[_Admitted | None] = ContextVar("waymark_admitted", default=None)


@contextmanager
def admitted(
    slots: Slots, agency_id: str, timeout_s: float, receive: Receive, transport: Transport = None
) -> Iterator[RequestWork]:
    """Account for a request, give its endpoint the server's slots, and stop its work when its client leaves.

    `transport` is that of its connection, where the server has one.
    """
    with working(timeout_s) as work:
        request = _Admitted(slots, agency_id, work, receive, transport)
        token = _ADMITTED.set(request)
        try:
            yield work
        finally:
            request.end()
            _ADMITTED.reset(token)


def _is_disconnected(transport: Transport) -> bool:
    """Whether the client has closed a connection.

    While a further request of the client waits, uvicorn neither reads from the connection nor reports its end.
    """
    if transport is None or transport.is_closing():
        return transport is not None
    poll = select.poll()
    poll.register(transport.get_extra_info("socket").fileno(), _CLOSED)
    return bool(poll.poll(0))


def watch_client() -> None:
    """Stop the work for the current request when its client leaves; for endpoints that have read the body."""
    if (request := _ADMITTED.get()) is not None:
        request.watch()


def bounded(endpoint: Endpoint, *, expensive: bool, watched: bool = True) -> Endpoint:
    """An endpoint that runs in a thread whose time is counted; an expensive one in a slot.

    A watched one runs while its client waits. Others go on: a vehicle may send a frame and lose the connection.
    """
    if iscoroutinefunction(endpoint):
        return endpoint

    @wraps(endpoint)
    async def run(**values: object) -> Response:
        call = partial(counted, endpoint, **values)
        if watched:
            watch_client()
        request = _ADMITTED.get()
        if request is None or not expensive:
            return await to_thread.run_sync(call)
        async with request.slots.slot(request.agency_id):
            request.work.check()
            return await to_thread.run_sync(call)

    return run
