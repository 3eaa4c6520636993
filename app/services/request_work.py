"""What a request or a job uses: processor time of its threads and decoder processes; and when a request must stop."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from typing import ParamSpec, TypeVar

from app.errors import Unavailable
from app.registry.engines import STOPS, Stops

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")


class RequestWork:
    """The work for one request or job, shared by all its threads.

    Parameters
    ----------
    deadline_s : float
        When `check_deadline` stops it, on the monotonic clock. [s]
    is_job : bool
        Whether it is a job, for which no client waits.

    Attributes
    ----------
    used_s : float
        Processor time so far. [s]
    stops : Stops
        What to stop when the client leaves, so that nobody waits for the answer: statements of the database, processes.
    """

    __slots__ = ("_deadline_s", "is_job", "stops", "used_s")

    def __init__(self, deadline_s: float, *, is_job: bool = False) -> None:
        self._deadline_s = deadline_s
        self.is_job = is_job
        self.used_s = 0.0
        self.stops = Stops()

    def check(self) -> None:
        """As `check_deadline`."""
        self.stops.check()
        if time.monotonic() > self._deadline_s:
            raise Unavailable("the request took too long and was stopped", cure="split the request")


_WORK: ContextVar[RequestWork | None] = ContextVar("waymark_request_work", default=None)


@contextmanager
def working(timeout_s: float, *, is_job: bool = False) -> Iterator[RequestWork]:
    """Account for a request or a job. Threads that are started in this block inherit its account."""
    work = RequestWork(time.monotonic() + timeout_s, is_job=is_job)
    token, stops = _WORK.set(work), STOPS.set(work.stops)
    try:
        yield work
    finally:
        STOPS.reset(stops)
        _WORK.reset(token)


def current_work() -> RequestWork | None:
    """The request or job for which this is called; None on the command line."""
    return _WORK.get()


def check_deadline() -> None:
    """Stop here if the client has left or the request's deadline has passed. Long loops call this once a step.

    Raises
    ------
    Unavailable
        One of the two.
    """
    work = _WORK.get()
    if work is not None:
        work.check()


def stopping(stop: Callable[[], object]) -> AbstractContextManager[None]:
    """`stop` is called from another thread, perhaps repeatedly, if the client leaves while the block runs."""
    work = _WORK.get()
    return nullcontext() if work is None else work.stops.calling(stop)


def add_processor_time(used_s: float) -> None:
    """Add processor time to the request for which this is called. [s]"""
    work = _WORK.get()
    if work is not None:
        work.used_s += used_s


def counted(call: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
    """Call a function, and add the processor time of this thread."""
    started_s = time.thread_time()
    try:
        return call(*args, **kwargs)
    finally:
        add_processor_time(time.thread_time() - started_s)


def counted_steps(steps: Iterator[T]) -> Iterator[T]:
    """The items of an iterator, with the processor time of each step added; stops at the deadline."""
    while True:
        check_deadline()
        try:
            item = counted(next, steps)
        except StopIteration:
            return
        yield item
