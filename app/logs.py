"""Structured logs on standard error, from structlog and from the standard library alike."""

from __future__ import annotations

import json
import logging
import sys
from contextlib import suppress
from typing import Any, Literal

import orjson
import structlog

_CHATTY = ("alembic.runtime.plugins", "app.registry.engines")
"""Loggers of libraries that report each connection that is closed and each part of theirs that is loaded."""


def configure_logs(log_format: Literal["console", "json"], level: str) -> None:
    """Write one line an event: readable on a console, JSON for a collector."""
    shared: list[structlog.typing.Processor] = [
        structlog.contextvars.merge_contextvars,
        structlog.stdlib.add_logger_name,
        structlog.stdlib.add_log_level,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
    ]
    if log_format == "json":
        shared.append(structlog.processors.format_exc_info)
        render: structlog.typing.Processor = structlog.processors.JSONRenderer(serializer=_json, default=str)
    else:
        plain = structlog.dev.plain_traceback  # the default shows local variables, and keys are among them
        render = structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty(), exception_formatter=plain)
    structlog.configure(  # past the standard library: each request is a line, and there it takes ten times as long
        processors=[*shared, render],
        logger_factory=_Lines,
        wrapper_class=structlog.make_filtering_bound_logger(level),
        cache_logger_on_first_use=True,
    )
    handler = logging.StreamHandler(sys.stderr)
    of_records = [structlog.stdlib.ProcessorFormatter.remove_processors_meta, render]
    handler.setFormatter(structlog.stdlib.ProcessorFormatter(processors=of_records, foreign_pre_chain=shared))
    root = logging.getLogger()
    root.handlers = [handler]
    root.setLevel(level)
    for chatty in _CHATTY:
        logging.getLogger(chatty).setLevel(logging.WARNING)


def _json(event: Any, default: Any) -> str:
    try:
        return orjson.dumps(event, default=default).decode()
    except TypeError:  # what is no text in UTF-8
        return json.dumps(event, default=default)


class _Lines:
    """Writes lines to standard error. That nobody reads them any more fails no request."""

    def __init__(self, name: str | None = None) -> None:
        self.name = name

    def msg(self, line: str) -> None:
        with suppress(OSError, ValueError):
            sys.stderr.buffer.write(line.encode(errors="backslashreplace") + b"\n")
            sys.stderr.buffer.flush()

    debug = info = warning = error = critical = msg
