"""Jobs of every kind as one resource, and their progress as server-sent events, on both databases."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from queue import SimpleQueue
from typing import Any

import httpx
import pytest

from app.api.http import event_stream
from app.errors import UnreadableUpload
from app.registry import jobs as job_leases
from app.registry import jobs as store
from app.registry.column_types import new_id
from app.registry.engines import across_agencies
from app.registry.jobs import JobKind, JobRow, new_job
from app.registry.webhooks import add_event
from app.services.access.access import Scope
from app.services.documents import error_document
from app.services.progress import RULES
from tests.conftest import LiveServer
from tests.http import WITHIN_S, refused, wait_until

pytestmark = pytest.mark.both_databases


def whoami(server: LiveServer, client: httpx.Client) -> Any:
    return server.app.state.use_cases.access.authenticate(client.headers["authorization"].split()[1])


def add(server: LiveServer, client: httpx.Client, kind: JobKind = JobKind.PLAN, **values: Any) -> JobRow:
    """A job in the table that no engine knows, so that the test decides how it goes on."""
    caller, now = whoami(server, client), datetime.now(UTC)
    job = new_job(kind, new_id(now), caller.agency_id, caller.key_id, now)._replace(**values)
    with across_agencies(), server.app.state.database.write() as connection:
        store.add_job(connection, job)
    return job


@contextmanager
def writing(server: LiveServer) -> Iterator[Any]:
    with across_agencies(), server.app.state.database.write() as connection:
        yield connection


def step(server: LiveServer, job: JobRow, done: int, total: int) -> None:
    with writing(server) as connection:
        job_leases.start_job(connection, job.id, datetime.now(UTC))
        assert store.record_progress(connection, job.id, done / total, steps=(done, total))


def finish(server: LiveServer, job: JobRow, state: Any = "done", **values: Any) -> None:
    with writing(server) as connection:
        assert store.finish_job(connection, job.id, state, datetime.now(UTC), **values)


class Reader:
    """Reads a stream in a thread, event by event."""

    def __init__(self, client: httpx.Client, path: str, **headers: str) -> None:
        self.events: SimpleQueue[dict[str, Any] | None] = SimpleQueue()
        self.comments: SimpleQueue[str] = SimpleQueue()
        self.response: httpx.Response | None = None
        self._stop = threading.Event()
        self._args = (client, path, headers)
        self.thread = threading.Thread(target=self._read, daemon=True)
        self.thread.start()

    def _read(self) -> None:
        try:
            self._read_events()
        except (httpx.HTTPError, httpx.StreamError, OSError):
            assert self._stop.is_set()  # the test has closed its client

    def _read_events(self) -> None:
        client, path, headers = self._args
        event: dict[str, Any] = {}
        with client.stream("GET", path, headers=headers) as response:
            self.response = response
            for line in response.iter_lines():
                if self._stop.is_set():
                    return
                name, _, value = line.partition(": ")
                if line.startswith(":"):
                    self.comments.put(line)
                elif line:
                    event[name] = json.loads(value) if name == "data" else value
                else:
                    if "event" in event:
                        self.events.put(event)
                    event = {}
        self.events.put(None)

    def next(self) -> Any:
        return self.events.get(timeout=WITHIN_S)

    def rest(self) -> list[Any]:
        found = []
        while (event := self.next()) is not None:
            found.append(event)
        return found

    def leave(self) -> None:
        self._stop.set()


def test_jobs_of_all_kinds_are_listed_and_filtered(server: LiveServer, client: httpx.Client) -> None:
    plan, imported = add(server, client), add(server, client, JobKind.IMPORT)
    step(server, imported, 2, 8)
    found = client.get("/v1/jobs").json()["items"]
    assert [job["id"] for job in found] == [imported.id, plan.id]
    assert [job["id"] for job in client.get("/v1/jobs?kind=plan").json()["items"]] == [plan.id]
    assert [job["id"] for job in client.get("/v1/jobs?state=running").json()["items"]] == [imported.id]
    first = client.get("/v1/jobs?limit=1")
    assert [job["id"] for job in client.get(first.links["next"]["url"]).json()["items"]] == [plan.id]
    running = client.get(f"/v1/jobs/{imported.id}").json()
    assert (running["done"], running["total"], running["progress"], running["attempts"]) == (2, 8, 0.25, 1)
    assert running["started_at"] is not None
    assert running["rate_per_s"] > 0
    assert "result" not in running["links"]
    finish(server, imported)
    assert client.get(f"/v1/jobs/{imported.id}").json()["links"]["result"] == f"/v1/jobs/{imported.id}"
    finish(server, plan, "failed", error=error_document(UnreadableUpload("no road", field="file")))
    assert client.get(f"/v1/jobs/{plan.id}").json()["error"] == {
        "kind": "UnreadableUpload", "detail": "no road", "field": "file"
    }  # fmt: skip
    for wrong in ({"kind": "lunch"}, {"state": "lost"}, {"limit": 0}, {"before": plan.id}):
        assert client.get("/v1/jobs", params=wrong).status_code in (400, 422)


def test_every_kind_has_rules() -> None:
    assert set(RULES) == set(JobKind)


def test_a_key_sees_the_kinds_that_its_scope_may_read(server: LiveServer) -> None:
    name = f"scopes {server.url}"
    with (
        server.agency(name) as planner, server.agency(name, Scope.VIEWER) as viewer,
        server.agency(name, Scope.VEHICLE) as vehicle, server.agency("strangers") as stranger,
    ):  # fmt: skip
        decode, imported, plan = (add(server, planner, kind) for kind in (JobKind.DECODE, JobKind.IMPORT, JobKind.PLAN))
        own = add(server, vehicle, JobKind.DECODE)
        assert [job["id"] for job in vehicle.get("/v1/jobs").json()["items"]] == [own.id]
        assert {job["id"] for job in viewer.get("/v1/jobs").json()["items"]} == {own.id, decode.id, plan.id}
        assert stranger.get("/v1/jobs").json()["items"] == []
        for path in ("", "/events"):
            refused(vehicle.get(f"/v1/jobs/{decode.id}{path}"), 404, "not-found", field="job_id")
            refused(viewer.get(f"/v1/jobs/{imported.id}{path}"), 404, "not-found")
            refused(stranger.get(f"/v1/jobs/{plan.id}{path}"), 404, "not-found")
        refused(viewer.post(f"/v1/jobs/{plan.id}/cancel"), 403, "not-allowed")
        refused(stranger.post(f"/v1/jobs/{plan.id}/cancel"), 404, "not-found")
        assert planner.get(f"/v1/jobs/{plan.id}").json()["cancel_requested"] is False
        assert vehicle.post(f"/v1/jobs/{own.id}/cancel").json()["state"] == "cancelled"


def test_jobs_are_cancelled_until_they_store(server: LiveServer, client: httpx.Client) -> None:
    queued, running, storing = add(server, client), add(server, client), add(server, client, JobKind.IMPORT)
    step(server, running, 1, 2)
    step(server, storing, 99, 100)
    assert client.post(f"/v1/jobs/{queued.id}/cancel").json()["state"] == "cancelled"
    assert client.post(f"/v1/jobs/{running.id}/cancel").json()["cancel_requested"] is True
    refused(client.post(f"/v1/jobs/{storing.id}/cancel"), 409, "conflict", field="job_id")


def test_a_stream_tells_the_progress_and_the_end(server: LiveServer, client: httpx.Client) -> None:
    job = add(server, client)
    reader = Reader(client, f"/v1/jobs/{job.id}/events")
    first = reader.next()
    assert (first["event"], first["data"]["state"], first["data"]["done"]) == ("progress", "queued", None)
    for done in (1, 3):
        step(server, job, done, 4)
        told = reader.next()
        assert (told["event"], told["data"]["done"], told["data"]["total"]) == ("progress", done, 4)
    assert told["data"]["rate_per_s"] > 0
    finish(server, job, subject_id="019cb624-0000-7000-8000-00000000aaaa")
    (last,) = reader.rest()
    assert last["event"] == "done"
    assert last["data"] | {"result": None} == client.get(f"/v1/jobs/{job.id}").json()
    assert last["data"]["links"]["result"].startswith("/v1/plans/")
    assert reader.response is not None
    assert reader.response.headers["content-type"].startswith("text/event-stream")
    # who has seen the end need not come again, and who has not gets it at once
    assert client.get(f"/v1/jobs/{job.id}/events", headers={"Last-Event-ID": last["id"]}).status_code == 204
    assert [
        e["event"] for e in Reader(client, f"/v1/jobs/{job.id}/events", **{"Last-Event-ID": told["id"]}).rest()
    ] == ["done"]


def test_what_was_seen_is_not_sent_again(server: LiveServer, client: httpx.Client) -> None:
    job = add(server, client)
    step(server, job, 1, 4)
    before = Reader(client, f"/v1/jobs/{job.id}/events")
    seen = before.next()["id"]
    again = Reader(client, f"/v1/jobs/{job.id}/events", **{"Last-Event-ID": seen})
    wait_until(lambda: again.response, "the second stream")
    finish(server, job, "cancelled")
    assert [event["event"] for event in again.rest()] == ["cancelled"]
    assert [event["event"] for event in before.rest()] == ["cancelled"]


@pytest.mark.slow
def test_many_streams_share_one_query_and_no_threads(
    server: LiveServer, client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    jobs = [add(server, client) for _ in range(15)]
    streams, asked = server.app.state.streams, SimpleQueue[list[str]]()
    read = streams.jobs._read
    readers = [Reader(client, f"/v1/jobs/{job.id}/events") for job in jobs]
    for reader in readers:
        reader.next()
    monkeypatch.setattr(streams.jobs, "_read", lambda ids: (asked.put(ids), read(ids))[1])
    before = {thread.name for thread in threading.enumerate()}
    for _ in range(3):
        assert set(asked.get(timeout=WITHIN_S)) == {job.id for job in jobs}
    assert sum("AnyIO" in name for name in before) < len(jobs)  # a stream that waits has no thread
    for job in jobs:
        finish(server, job, "cancelled")
    assert all([event["event"] for event in reader.rest()] == ["cancelled"] for reader in readers)
    wait_until(lambda: not streams.places.open and not streams.jobs.is_looking, "the last look")


def test_a_quiet_stream_has_heartbeats_and_a_client_that_leaves_frees_its_place(
    server: LiveServer, client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(event_stream, "HEARTBEAT_S", 0.02)
    reader = Reader(client, f"/v1/jobs/{add(server, client).id}/events")
    for _ in range(3):
        assert reader.comments.get(timeout=WITHIN_S) == ": still here"
    reader.leave()
    wait_until(lambda: not server.app.state.streams.places.open, "the place to be free")


def test_a_key_has_so_many_streams_at_once(
    server: LiveServer, client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server.app.state.streams.places, "_per_key", 2)
    job = add(server, client)
    readers = [Reader(client, f"/v1/jobs/{job.id}/events") for _ in range(2)]
    for reader in readers:
        reader.next()
    answer = client.get(f"/v1/jobs/{job.id}/events")
    assert refused(answer, 429, "too-many-requests")["limit"].startswith("2 of one key")
    assert int(answer.headers["retry-after"]) > 0
    finish(server, job, "cancelled")
    assert [event["event"] for reader in readers for event in reader.rest()] == ["cancelled"] * 2


def test_events_of_an_agency_are_a_stream_that_misses_nothing(server: LiveServer, client: httpx.Client) -> None:
    sse = {"Accept": "text/event-stream"}
    reader = Reader(client, "/v1/events", **sse)
    wait_until(lambda: reader.response, "the stream")
    job, other = add(server, client), add(server, client, JobKind.DECODE)
    finish(server, job)
    first = reader.next()
    assert (first["event"], first["data"]["subject_id"]) == ("job.done", job.id)
    assert first["data"]["detail"] == {"job_kind": "plan"}
    reader.leave()
    client.post(f"/v1/jobs/{other.id}/cancel")
    with server.agency("strangers") as stranger:
        finish(server, add(server, stranger), "failed")
    again = Reader(client, "/v1/events", **sse, **{"Last-Event-ID": first["id"]})
    second = again.next()
    assert (second["event"], second["data"]["subject_id"]) == ("job.cancelled", other.id)
    finish(server, add(server, client), "failed")
    assert again.next()["event"] == "job.failed"
    again.leave()
    wrong = client.get("/v1/events", headers={**sse, "Last-Event-ID": "x1"})
    refused(wrong, 422, "invalid-parameter", field="Last-Event-ID")
    page = client.get("/v1/events?limit=2")
    assert [event["kind"] for event in page.json()["items"]] == ["job.done", "job.cancelled"]
    assert [event["kind"] for event in client.get(page.links["next"]["url"]).json()["items"]] == ["job.failed"]


def test_events_of_jobs_are_for_the_scopes_that_may_read_them(server: LiveServer) -> None:
    name = f"events {server.url}"
    sse = {"Accept": "text/event-stream", "Last-Event-ID": "0"}
    with (
        server.agency(name, Scope.ADMIN) as admin, server.agency(name) as planner,
        server.agency(name, Scope.VIEWER) as viewer, server.agency(name, Scope.VEHICLE) as vehicle,
        server.agency("strangers") as stranger,
    ):  # fmt: skip
        wanted = [JobKind.AUDIT, JobKind.REPROCESS, JobKind.IMPORT, JobKind.DECODE]
        for kind in wanted:
            finish(server, add(server, admin, kind))
        finish(server, add(server, stranger, JobKind.DECODE))
        for reader, seen in ((admin, wanted), (planner, wanted[2:]), (viewer, wanted[3:])):
            items = reader.get("/v1/events").json()["items"]
            assert [event["detail"]["job_kind"] for event in items] == seen
            stream = Reader(reader, "/v1/events", **sse)
            assert [stream.next()["data"]["detail"]["job_kind"] for _ in seen] == seen
            stream.leave()
        own = add(server, vehicle, JobKind.DECODE)
        finish(server, own)
        assert [event["subject_id"] for event in vehicle.get("/v1/events").json()["items"]] == [own.id]
        stream = Reader(vehicle, "/v1/events", **sse)
        assert stream.next()["data"]["subject_id"] == own.id
        stream.leave()
        with server.app.state.database.write() as connection:
            add_event(connection, own.agency_id, "maintenance.suspect", subject_id=own.id, at=own.created_at)
        assert len(viewer.get("/v1/events").json()["items"]) == 3
        assert len(vehicle.get("/v1/events").json()["items"]) == 1
        progress = Reader(vehicle, f"/v1/jobs/{own.id}/events")
        assert progress.next()["event"] == "done"
        progress.leave()


def test_dead_letters_are_listed_with_their_reasons(server: LiveServer, client: httpx.Client) -> None:
    dead, failed = add(server, client, JobKind.DECODE), add(server, client, JobKind.DECODE)
    reason = error_document(UnreadableUpload("the file stopped the decoder process, twice", field="file"))
    finish(server, dead, "failed", error=reason, dead_letter=True)
    finish(server, failed, "failed", error=error_document(UnreadableUpload("no frame", field="file")))
    (found,) = client.get("/v1/jobs?dead_letter=true").json()["items"]
    assert (found["id"], found["dead_letter"], found["state"]) == (dead.id, True, "failed")
    assert found["error"]["detail"] == "the file stopped the decoder process, twice"
    assert [job["id"] for job in client.get("/v1/jobs?state=failed&dead_letter=false").json()["items"]] == [failed.id]
    with server.agency("strangers") as stranger:
        assert stranger.get("/v1/jobs?dead_letter=true").json()["items"] == []


def test_a_server_that_stops_ends_its_streams(serve: Callable[..., LiveServer], settings: Any) -> None:
    server = serve(settings)
    with server.client() as client:
        reader = Reader(client, f"/v1/jobs/{add(server, client).id}/events")
        reader.next()
        server.__exit__()  # waits for the server's thread, which waits for its requests
        assert reader.rest() == []
