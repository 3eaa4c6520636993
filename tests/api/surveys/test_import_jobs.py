"""Imports that are jobs, listed and called off, on both databases."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from app.errors import Unavailable
from app.main import create_app
from app.registry.jobs import JobKind
from app.services.surveys import import_jobs, imports
from app.settings import Settings
from tests.api.surveys.test_imports import DEGREES, _csv, _finished, _markers, _send
from tests.conftest import ADMIN_KEY, UNLIMITED, LiveServer
from tests.http import refused
from tests.jobs import standin

pytestmark = pytest.mark.both_databases

LATER = {"Prefer": "respond-async"}


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory, new_database_url: Callable[[Path], str]) -> Iterator[LiveServer]:
    """A server that the tests of this module share."""
    folder = tmp_path_factory.mktemp("jobs") / "var"
    url = new_database_url(folder)
    settings = Settings(data_dir=folder, database_url=url, admin_key=ADMIN_KEY, decode_workers=1, **UNLIMITED)
    with LiveServer(create_app(settings, decode=standin.decode)) as running:
        yield running


@pytest.fixture
def waiting(server: LiveServer, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Ids of the jobs that were queued and wait until a test runs them."""
    queued: list[str] = []

    class Held:
        def submit(self, job_id: str, agency_id: str, kind: JobKind) -> None:
            queued.append(job_id)

    monkeypatch.setattr(server.app.state.use_cases.import_jobs, "_queue", Held())
    return queued


def _cancel(client: httpx.Client, import_id: str) -> httpx.Response:
    return client.post(f"/v1/jobs/{import_id}/cancel")


@pytest.mark.slow
@pytest.mark.parametrize(("limit", "value"), [("IMMEDIATE_LINES", 4), ("IMMEDIATE_BYTES", 200)])
def test_long_surveys_become_jobs(
    client: httpx.Client, waiting: list[str], monkeypatch: pytest.MonkeyPatch, limit: str, value: int
) -> None:
    monkeypatch.setattr(import_jobs, limit, value)
    assert _send(client, _csv(4), {**DEGREES, "dry_run": True}).status_code == 200
    answer = _send(client, _csv(8), DEGREES)
    assert (answer.status_code, waiting) == (202, [answer.json()["id"]])


def test_jobs_are_listed_newest_first(server: LiveServer, client: httpx.Client, waiting: list[str]) -> None:
    first = _finished_here(server, client, _send(client, _csv(), DEGREES, **LATER))
    ids = [first, *(_send(client, _csv(), DEGREES, **LATER).json()["id"] for _ in range(3))]
    _send(client, _csv(3), {**DEGREES, "dry_run": True})  # answered at once: no job
    found, url, pages = [], "/v1/jobs?kind=import&limit=3", 0
    while url:
        answer = client.get(url)
        assert answer.status_code == 200, answer.text
        found += answer.json()["items"]
        url, pages = answer.links.get("next", {}).get("url", ""), pages + 1
    assert ([job["id"] for job in found], pages) == (ids[::-1], 2)
    assert all("result" not in job for job in found)
    assert client.get(found[-1]["links"]["self"]).json()["result"]["stored"] == 8
    by_state = {
        state: [job["id"] for job in client.get("/v1/jobs", params={"kind": "import", "state": state}).json()["items"]]
        for state in ("queued", "running", "done", "failed", "cancelled")
    }
    assert by_state == {"queued": ids[:0:-1], "running": [], "done": [first], "failed": [], "cancelled": []}
    for wrong in ({"state": "lost"}, {"limit": 0}, {"limit": 1001}, {"after": "x\u0000"}, {"before": ids[0]}):
        assert client.get("/v1/jobs", params=wrong).status_code in (400, 422)
    with server.agency("imports of others") as other:
        assert other.get("/v1/jobs").json()["items"] == []


def _finished_here(server: LiveServer, client: httpx.Client, answer: httpx.Response) -> str:
    import_id: str = answer.json()["id"]
    server.app.state.use_cases.jobs.run_job(import_id)
    assert client.get(f"/v1/jobs/{import_id}").json()["state"] == "done"
    return import_id


def test_one_that_waits_never_starts(server: LiveServer, client: httpx.Client, waiting: list[str]) -> None:
    job = _send(client, _csv(), DEGREES, **LATER).json()
    assert (job["state"], job["cancel_requested"], waiting) == ("queued", False, [job["id"]])
    with server.agency("imports of others") as other:
        assert _cancel(other, job["id"]).status_code == 404
    cancelled = _cancel(client, job["id"])
    assert (cancelled.status_code, cancelled.json()["state"]) == (200, "cancelled")
    ended = client.get(f"/v1/jobs/{job['id']}").json()
    assert (ended["state"], ended["finished_at"] is None) == ("cancelled", False)
    server.app.state.use_cases.jobs.run_job(job["id"])
    assert _markers(client) == []
    assert _cancel(client, job["id"]).json()["state"] == "cancelled"
    assert client.get(f"/v1/jobs/{job['id']}").json() == ended
    assert client.get("/v1/jobs?state=cancelled").json()["items"][0]["id"] == job["id"]


def test_one_that_runs_stops_before_it_stores(
    server: LiveServer, client: httpx.Client, waiting: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    job = _send(client, _csv(), DEGREES, **LATER).json()
    processes, asked = server.app.state.use_cases.imports._processes, []

    class Slow:
        def run(self, task: Any, *arguments: Any, wait_s: float = 0.0) -> Any:
            pending = processes.submit(task, *arguments, wait_s=wait_s)
            asked.append(_cancel(client, job["id"]))
            return pending.result()

    monkeypatch.setattr(server.app.state.use_cases.imports, "_processes", Slow())
    server.app.state.use_cases.jobs.run_job(job["id"])
    assert (asked[0].status_code, asked[0].json()["state"]) == (200, "running")
    assert asked[0].json()["cancel_requested"]
    ended = client.get(f"/v1/jobs/{job['id']}").json()
    assert (ended["state"], ended["result"], ended["error"]) == ("cancelled", None, None)
    assert _markers(client) == []
    monkeypatch.undo()
    again = _finished(client, _send(client, _csv(), DEGREES, **LATER))
    assert again["result"]["stored"] == 8


def test_one_that_stores_says_that_it_is_too_late(
    server: LiveServer, client: httpx.Client, waiting: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    job = _send(client, _csv(), DEGREES, **LATER).json()
    store, asked = imports._Import.store, []

    def slow(*arguments: Any) -> int:
        asked.append(_cancel(client, job["id"]))  # while the writer has the database
        return store(*arguments)

    monkeypatch.setattr(imports._Import, "store", slow)
    server.app.state.use_cases.jobs.run_job(job["id"])
    asked.append(_cancel(client, job["id"]))
    refused(asked[0], 409, "conflict", field="job_id")
    assert asked[0].json()["detail"] == "the import is storing already"
    assert (asked[1].status_code, asked[1].json()["state"]) == (200, "done")
    ended = client.get(f"/v1/jobs/{job['id']}").json()
    assert (ended["state"], ended["cancel_requested"], ended["result"]["stored"]) == ("done", False, 8)


def test_one_that_was_storing_when_the_server_stopped_goes_on(
    server: LiveServer, client: httpx.Client, waiting: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    job = _send(client, _csv(), DEGREES, **LATER).json()
    store = imports._Import.store

    def broken(*arguments: Any) -> int:
        store(*arguments)
        raise Unavailable("the server stops")

    monkeypatch.setattr(imports._Import, "store", broken)
    with pytest.raises(Unavailable):
        server.app.state.use_cases.jobs.run_job(job["id"])
    assert _markers(client) == []
    assert client.get(f"/v1/jobs/{job['id']}").json()["state"] == "queued"
    assert _cancel(client, job["id"]).status_code == 409
    assert client.post(f"/v1/jobs/{job['id']}/cancel").status_code == 409
    monkeypatch.setattr(imports._Import, "store", store)
    server.app.state.use_cases.jobs.run_job(job["id"])
    assert client.get(f"/v1/jobs/{job['id']}").json()["result"]["stored"] == 8
