"""What tests over HTTP share: requests that must succeed, refusals, and waiting for an event."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, TypeVar

import httpx

from app.api.http.permissions import PUBLIC
from app.api.http.routes import permissions_of
from app.main import ROUTERS

T = TypeVar("T")
PERMISSIONS = {
    **permissions_of(route for router in ROUTERS for route in router.routes),
    **{f"GET {folder}": PUBLIC for folder in ("/static", "/guide")},
}
"""Who may use which route of an app."""
WITHIN_S = 900.0
"""How long `wait_until` waits: far more than a loaded machine needs, less than the time limit of a test. [s]"""


def created(client: httpx.Client, path: str, **body: Any) -> dict[str, Any]:
    """The resource that a POST with these members created."""
    response = client.post(path, json=body)
    assert response.status_code == 201, response.text
    return dict(response.json())


def refused(
    response: httpx.Response, status: int, slug: str | None = None, *, field: str | None = None
) -> dict[str, Any]:
    """The problem document of a refused request, checked for what every problem document has."""
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    problem = dict(response.json())
    assert {"type", "title", "detail", "instance", "request_id"} <= problem.keys(), problem
    assert problem["status"] == status
    if slug is not None:
        assert problem["type"] == f"urn:waymark:problem:{slug}", problem
    if field is not None:
        assert problem["field"] == field, problem
        assert status == 404 or problem.get("limit") or problem.get("cure"), problem
    return problem


def wait_until(condition: Callable[[], T | None], what: str, within_s: float = WITHIN_S) -> T:
    """The first true value of a condition that is asked again and again; fails only if it stays false for minutes."""
    deadline = time.monotonic() + within_s
    while not (value := condition()):
        assert time.monotonic() < deadline, f"waited {within_s:g} s in vain for {what}"
        time.sleep(0.02)
    return value


def finished(client: httpx.Client, path: str) -> dict[str, Any]:
    """A job's document once it is done, failed or cancelled."""

    def ended() -> dict[str, Any] | None:
        job = client.get(path).json()
        return job if job["state"] not in ("queued", "running") else None

    return wait_until(ended, f"{path} to end")
