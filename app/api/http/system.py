"""/healthz, /readyz and /metrics for operators, without a key; the settings that pages and admins see."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import Annotated, Literal

import anyio
import structlog
from anyio import to_thread
from fastapi import Request, Response
from prometheus_client import CONTENT_TYPE_LATEST
from pydantic import Field
from typing_extensions import TypedDict

from app.api.http.dependencies import Caller
from app.api.http.permissions import ADMINS, PUBLIC
from app.api.http.responses import document_response, json_response, text_response
from app.api.http.routes import Router
from app.errors import WaymarkError
from app.services.decodes.upload_path import written_metrics

router = Router("", "system")
_LOG = structlog.get_logger("waymark")
_VALID_S = 2.0
"""How long a result of the checks is valid: clients without a key may ask as often as they like. [s]"""
_WITHIN_S = 5.0
"""When a check that does not end counts as failed. [s]"""


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


@router.get("/healthz", PUBLIC, responses={200: {"model": ProcessHealth}})
async def get_health() -> Response:
    """Check whether the process responds."""
    return json_response(ProcessHealth(status="ok"))


@router.get(
    "/readyz",
    PUBLIC,
    responses={
        200: {"model": ReadinessDocument},
        503: {"model": ReadinessDocument, "description": "A part is not ready"},
    },
)
async def get_readiness(request: Request) -> Response:
    """Check whether every part that requests need is ready.

    Every part that requests need is ready: the database answers and is migrated, the decoders run, and what is stored
    can be read again. The result is at most two seconds old.
    """
    parts = await request.app.state.readiness.parts()
    ready = all(parts.values())
    document = ReadinessDocument(status="ready" if ready else "not ready", parts=parts)
    return json_response(document, 200 if ready else 503)


@router.get("/metrics", PUBLIC, responses=text_response("text/plain", "Prometheus text format"))
def get_metrics(request: Request) -> Response:
    """Get the server's metrics.

    In the format of Prometheus.
    """
    return Response(written_metrics(request.app.state.metrics), media_type=CONTENT_TYPE_LATEST)


# === GET /v1/page-settings: what the web pages need to know before anybody has signed in.


page_settings_router = Router("/v1/page-settings", "system")


class SignInOptions(TypedDict):
    """How a page signs somebody in at the identity provider: OAuth 2.0, authorization code with PKCE (RFC 7636)."""

    issuer: str
    client_id: str
    authorize_url: Annotated[str, Field(description="The provider's authorization endpoint.")]
    token_url: Annotated[str, Field(description="The provider's token endpoint.")]
    scopes: Annotated[str, Field(description="Scopes to request, separated by spaces.")]


class BaseMap(TypedDict):
    """The map under the markers."""

    kind: Literal["pmtiles", "raster"]
    url: Annotated[str, Field(description="Of a PMTiles file, or of raster tiles with {z}, {x} and {y}.")]
    attribution: str


class PageSettings(TypedDict):
    """Settings of the web pages."""

    version: Annotated[str, Field(description="Of the server.")]
    sign_in: Annotated[SignInOptions | None, Field(description="null: sign in with a key.")]
    base_map: Annotated[BaseMap | None, Field(description="null: the pages draw a grid.")]
    guide: Annotated[bool, Field(description="The documents are at /guide: false where they were not built.")]


@page_settings_router.get("", PUBLIC, responses=document_response(PageSettings))
async def get_page_settings(request: Request) -> Response:
    """Get the settings of the web pages.

    Sign-in, base map and guide. Needs no key.
    """
    return json_response(request.app.state.page_settings)


# === GET /v1/server-settings: what the server runs with, for admins: no secret, no path, no address of a store.


server_settings_router = Router("/v1/server-settings", "system")


class NumberSetting(TypedDict):
    """A setting that is a number or a switch."""

    name: Annotated[str, Field(description="Of the environment variable.")]
    value: float | bool
    default: float | bool
    description: str


class ServerSettings(TypedDict):
    """Settings in use."""

    version: Annotated[str, Field(description="Of the server.")]
    engine: Annotated[Literal["embedded", "celery"], Field(description="Who runs the jobs: the server, or workers.")]
    database: Literal["sqlite", "postgresql"]
    storage: Annotated[Literal["folder", "s3"], Field(description="Where uploads are stored.")]
    broker: Annotated[Literal["amqp"] | None, Field(description="null: the server needs none.")]
    public_url: Annotated[str | None, Field(description="Address of the server in QR codes and links.")]
    issuer: Annotated[str | None, Field(description="OpenID Connect issuer whose tokens are accepted.")]
    base_map: Annotated[Literal["pmtiles", "raster"] | None, Field(description="null: the pages draw a grid.")]
    grids: Annotated[bool, Field(description="PROJ grids for coordinate transformations are installed.")]
    tracing: Annotated[bool, Field(description="Traces are sent to a collector.")]
    log_format: Literal["console", "json"]
    log_level: Literal["DEBUG", "INFO", "WARNING", "ERROR"]
    numbers: Annotated[list[NumberSetting], Field(description="Limits and switches, see docs/settings.md.")]


@server_settings_router.get("", ADMINS, responses=document_response(ServerSettings))
async def get_server_settings(request: Request, caller: Caller) -> Response:
    """Get the settings that the server runs with."""
    return json_response(request.app.state.server_settings)
