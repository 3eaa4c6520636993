"""Spans of requests, jobs and tasks of decoder processes; nothing happens until `install` is called.

A span's context is text in the form of W3C Trace Context (https://www.w3.org/TR/trace-context/): it is stored with a
job, so that the span of a worker continues that of the request. This module imports no OpenTelemetry; what is installed
does (`app.control.exporting`).
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import ClassVar, Protocol

_TRACEPARENT = re.compile(r"00-[0-9a-f]{32}-[0-9a-f]{16}-[0-9a-f]{2}")


class Tracer(Protocol):
    """Records spans."""

    def begin(self, name: str, parent: str | None, attributes: dict[str, str]) -> object:
        """Begin a span, a child of `parent` or of the thread's own."""

    def end(self, span: object, attributes: dict[str, str]) -> None:
        """End a span."""

    def current(self) -> str | None:
        """The context of the thread's span."""

    def record(self, name: str, parent: str | None, times_ns: tuple[int, int], attributes: dict[str, str]) -> None:
        """Record a span that has ended; nanoseconds since 1970."""


class _Installed:
    tracer: ClassVar[Tracer | None] = None


def install(tracer: Tracer | None) -> None:
    """Have spans recorded, or not any more."""
    _Installed.tracer = tracer


def is_on() -> bool:
    """Whether spans are recorded."""
    return _Installed.tracer is not None


def current() -> str | None:
    """The context of the thread's span; None if there is none."""
    return _Installed.tracer.current() if _Installed.tracer is not None else None


def accepted(traceparent: str) -> str | None:
    """The context that a client sent, if it has the form of one."""
    return traceparent if _TRACEPARENT.fullmatch(traceparent) else None


@contextmanager
def span(name: str, *, parent: str | None = None, **attributes: str) -> Iterator[dict[str, str]]:
    """Record the block; yields a mapping for attributes that are known at its end."""
    tracer, later = _Installed.tracer, dict[str, str]()
    if tracer is None:
        yield later
        return
    begun = tracer.begin(name, parent, attributes)
    try:
        yield later
    except BaseException as error:
        later["error.type"] = type(error).__name__  # never the message, which may quote the input
        raise
    finally:
        tracer.end(begun, later)


def record(name: str, parent: str | None, times_ns: tuple[int, int], **attributes: str) -> None:
    """Record a span that has ended."""
    if _Installed.tracer is not None:
        _Installed.tracer.record(name, parent, times_ns, attributes)
