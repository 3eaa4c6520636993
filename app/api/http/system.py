"""/healthz, /readyz and /metrics for operators, without a key."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import Literal

import anyio
import structlog
from anyio import to_thread
from fastapi import APIRouter, Request, Response
from prometheus_client import CONTENT_TYPE_LATEST
from typing_extensions import TypedDict

from app.api.http.responses import json_response, text_response
from app.api.http.strict_json import StrictRoute
from app.errors import WaymarkError
from app.services.decodes.measures import written_metrics

router = APIRouter(tags=["system"], route_class=StrictRoute)
_LOG = structlog.get_logger("waymark")
_VALID_S = 2.0
"""How long a result of the checks is valid: clients without a key may ask as often as they like. [s]"""
_WITHIN_S = 5.0
"""When a check that does not end counts as failed. [s] Source: chosen by hand."""


class ProcessHealth(TypedDict):
    """Whether the process responds."""

    status: Literal["ok"]


class ReadinessDocument(TypedDict):
    """Whether the server can handle requests, and which of its parts are ready."""

    status: Literal["ready", "not ready"]
    parts: dict[str, bool]


class Readiness:
    """Whether the parts of the server are ready. For the event loop only.

    However many clients ask, the checks run once, and at most every `valid_s`. The log gets a line when a part changes.

    Parameters
    ----------
    checks : dict of callable
        By part: why it is not ready, or None. They run in threads of their own.
    """

    def __init__(self, checks: dict[str, Callable[[], str | None]]) -> None:
        self.checks, self.valid_s, self.within_s = checks, _VALID_S, _WITHIN_S
        self._faults: dict[str, str | None] = {}
        self._until_s = float("-inf")
        self._running: dict[str, asyncio.Task[str | None]] = {}
        self._asking: asyncio.Task[None] | None = None

    async def parts(self) -> dict[str, bool]:
        """Whether each part is ready."""
        if time.monotonic() >= self._until_s:
            if self._asking is None or self._asking.done():
                self._asking = asyncio.create_task(self._ask())
            await asyncio.shield(self._asking)
        return {name: fault is None for name, fault in self._faults.items()}

    async def _ask(self) -> None:
        for name, check in self.checks.items():
            if name not in self._running:  # one that hangs is not started again
                self._running[name] = asyncio.create_task(_fault_of(check))
        await asyncio.wait(self._running.values(), timeout=self.within_s)
        for name in self.checks:
            fault: str | None = f"no answer within {self.within_s:g} s"
            if self._running[name].done():
                fault = self._running.pop(name).result()
            if fault != self._faults.get(name):
                change = _LOG.info if fault is None else _LOG.warning
                change("ready again" if fault is None else "not ready", part=name, cause=fault)
            self._faults[name] = fault
        self._until_s = time.monotonic() + self.valid_s


async def _fault_of(check: Callable[[], str | None]) -> str | None:
    try:
        return await to_thread.run_sync(check, abandon_on_cancel=True, limiter=anyio.CapacityLimiter(1))
    except WaymarkError as error:
        return f"{error.message}: {error.__cause__}" if error.__cause__ is not None else error.message


@router.get("/healthz", responses={200: {"model": ProcessHealth}})
async def get_health() -> Response:
    """Whether the process responds."""
    return json_response(ProcessHealth(status="ok"))


@router.get(
    "/readyz",
    responses={
        200: {"model": ReadinessDocument},
        503: {"model": ReadinessDocument, "description": "A part is not ready"},
    },
)
async def get_readiness(request: Request) -> Response:
    """Every part that requests need is ready: the database answers and is migrated, the decoders run, and what is
    stored can be read again. The result is at most two seconds old."""
    parts = await request.app.state.readiness.parts()
    ready = all(parts.values())
    document = ReadinessDocument(status="ready" if ready else "not ready", parts=parts)
    return json_response(document, 200 if ready else 503)


@router.get("/metrics", responses=text_response("text/plain", "Prometheus text format"))
def get_metrics(request: Request) -> Response:
    """Prometheus metrics."""
    return Response(written_metrics(request.app.state.metrics), media_type=CONTENT_TYPE_LATEST)
