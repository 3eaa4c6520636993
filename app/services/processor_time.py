"""Processor time that a request uses: of its threads, and of the decoder processes that work for it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


@dataclass(slots=True)
class ProcessorTime:
    """Processor time that was used so far.

    Attributes
    ----------
    used_s : float
        [s]
    """

    used_s: float = 0.0


_REQUEST: ContextVar[ProcessorTime | None] = ContextVar("waymark_processor_time", default=None)


@contextmanager
def counting() -> Iterator[ProcessorTime]:
    """Count the processor time of a request. Threads that are started in this block inherit the counter."""
    counter = ProcessorTime()
    token = _REQUEST.set(counter)
    try:
        yield counter
    finally:
        _REQUEST.reset(token)


def add_processor_time(used_s: float) -> None:
    """Add time to the request in which this is called; outside of a request it is not counted. [s]"""
    counter = _REQUEST.get()
    if counter is not None:
        counter.used_s += used_s


def counted(call: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
    """Call a function, and add the processor time of this thread."""
    started_s = time.thread_time()
    try:
        return call(*args, **kwargs)
    finally:
        add_processor_time(time.thread_time() - started_s)
