"""/healthz, /readyz, /metrics: for operators, without a key."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from fastapi import APIRouter, Request, Response
from prometheus_client import CONTENT_TYPE_LATEST, generate_latest

from app.api.dependencies import json_response

router = APIRouter(tags=["system"])


@router.get("/healthz", response_class=Response)
async def get_health() -> Response:
    """The process answers."""
    return json_response({"status": "ok"})


@router.get("/readyz", response_class=Response, responses={503: {"description": "A part is not ready"}})
def get_readiness(request: Request) -> Response:
    """Every part that requests need is ready: the database is migrated and writable, the workers are alive."""
    checks: Mapping[str, Callable[[], bool]] = request.app.state.readiness
    parts = {name: check() for name, check in checks.items()}
    ready = all(parts.values())
    return json_response({"status": "ready" if ready else "not ready", "parts": parts}, 200 if ready else 503)


@router.get("/metrics", response_class=Response)
def get_metrics(request: Request) -> Response:
    """Prometheus metrics."""
    return Response(generate_latest(request.app.state.metrics), media_type=CONTENT_TYPE_LATEST)
