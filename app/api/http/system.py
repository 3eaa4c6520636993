"""/healthz, /readyz and /metrics for operators, without a key."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal

from fastapi import APIRouter, Request, Response
from prometheus_client import CONTENT_TYPE_LATEST
from typing_extensions import TypedDict

from app.api.http.responses import json_response, text_response
from app.services.decodes.measures import written_metrics

router = APIRouter(tags=["system"])


class ProcessHealth(TypedDict):
    """Whether the process responds."""

    status: Literal["ok"]


class ReadinessDocument(TypedDict):
    """Whether the server can handle requests, and which of its parts are ready."""

    status: Literal["ready", "not ready"]
    parts: dict[str, bool]


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
def get_readiness(request: Request) -> Response:
    """Every part that requests need is ready: the database is migrated and writable, the workers are alive."""
    checks: Mapping[str, Callable[[], bool]] = request.app.state.readiness
    parts = {name: check() for name, check in checks.items()}
    ready = all(parts.values())
    document = ReadinessDocument(status="ready" if ready else "not ready", parts=parts)
    return json_response(document, 200 if ready else 503)


@router.get("/metrics", responses=text_response("text/plain", "Prometheus text format"))
def get_metrics(request: Request) -> Response:
    """Prometheus metrics."""
    return Response(written_metrics(request.app.state.metrics), media_type=CONTENT_TYPE_LATEST)
