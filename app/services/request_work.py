"""What a request uses and when it must stop: processor time of its threads and decoder processes, and a deadline."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import ParamSpec, TypeVar

from app.errors import Unavailable

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")


class RequestWork:
    """The work for one request, shared by all its threads.

    Parameters
    ----------
    deadline_s : float
        When `check_deadline` stops it, on the monotonic clock. [s]

    Attributes
    ----------
    used_s : float
        Processor time so far. [s]
    abandoned : bool
        Whether the client has left, so that nobody waits for the answer.
    """

    __slots__ = ("_deadline_s", "abandoned", "used_s")

    def __init__(self, deadline_s: float) -> None:
        self._deadline_s = deadline_s
        self.used_s = 0.0
        self.abandoned = False

    def check(self) -> None:
        """As `check_deadline`."""
        if self.abandoned:
            raise Unavailable("the client has left", cure="send the request again and wait for its answer")
        if time.monotonic() > self._deadline_s:
            raise Unavailable("the request took too long and was stopped", cure="split the request")


_WORK: ContextVar[RequestWork | None] = ContextVar("waymark_request_work", default=None)


@contextmanager
def working(timeout_s: float) -> Iterator[RequestWork]:
    """Account for a request. Threads that are started in this block inherit its account."""
    work = RequestWork(time.monotonic() + timeout_s)
    token = _WORK.set(work)
    try:
        yield work
    finally:
        _WORK.reset(token)


def current_work() -> RequestWork | None:
    """The request for which this is called; None in jobs and on the command line."""
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
