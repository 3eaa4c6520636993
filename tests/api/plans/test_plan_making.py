"""Plans that are made by jobs, on both databases, and roads that are too long for any."""

from __future__ import annotations

import itertools
import json
from typing import Any

import httpx
import pytest

from app.errors import Unavailable
from app.registry.jobs import JobKind
from app.services.plans import making
from tests.api.plans.test_plans import road, send_road
from tests.conftest import LiveServer
from tests.http import finished, refused

pytestmark = pytest.mark.both_databases

PLACES = itertools.count(1)
LATER = {"Prefer": "respond-async"}


@pytest.fixture
def body(client: httpx.Client) -> dict[str, Any]:
    """A plan to make."""
    number = next(PLACES)
    alignment = send_road(client, road(30.0, 40.0 + number * 0.02, 300.0), name=f"r{number}").json()
    return {"name": f"p{number}", "alignment_id": alignment["id"], "rules": {"version": 1, "plates": {}}}


@pytest.mark.slow
def test_a_plan_is_made_by_a_job_and_is_the_same_as_an_immediate_one(
    client: httpx.Client, body: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    queued = client.post("/v1/plans", json=body, headers=LATER | {"Idempotency-Key": "made"})
    assert (queued.status_code, queued.json()["subject_id"], queued.json()["kind"]) == (202, None, "plan")
    job = finished(client, queued.headers["Location"])
    assert (job["state"], job["result"]) == ("done", {"plan_version": 1})
    plan = client.get(job["links"]["result"]).json()
    assert (plan["id"], plan["name"], plan["status"]) == (job["subject_id"], body["name"], "checked")
    for headers in (LATER, {}):  # the first response, whatever is preferred
        again = client.post("/v1/plans", json=body, headers=headers | {"Idempotency-Key": "made"})
        assert (again.status_code, again.json()) == (202, queued.json())
        assert again.headers["Idempotency-Replayed"] == "true"
    refused(client.post("/v1/plans", json=body, headers=LATER), 409, field="name")
    immediate = client.post("/v1/plans", json=body | {"name": "at once"})
    assert immediate.status_code == 201
    assert immediate.json().keys() == plan.keys()
    assert immediate.json()["counts"] == plan["counts"]
    monkeypatch.setattr(making, "IMMEDIATE_LANES_M", 250.0)
    long = client.post("/v1/plans", json=body | {"name": "long"})
    assert long.status_code == 202
    assert finished(client, long.headers["Location"])["state"] == "done"


def test_a_job_that_is_run_twice_makes_one_plan(
    server: LiveServer, client: httpx.Client, body: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    queued: list[str] = []

    class Held:
        def submit(self, job_id: str, agency_id: str, kind: JobKind) -> None:
            queued.append(job_id)

    monkeypatch.setattr(server.app.state.use_cases.plan_making, "_queue", Held())
    job = client.post("/v1/plans", json=body, headers=LATER).json()
    plans, jobs = server.app.state.use_cases.plans, server.app.state.use_cases.jobs
    processes = plans._processes

    class Stopping:
        def run(self, task: Any, *arguments: Any, wait_s: float = 0.0) -> Any:
            raise Unavailable("the server stops")

    monkeypatch.setattr(plans, "_processes", Stopping())
    with pytest.raises(Unavailable):
        jobs.run_job(job["id"])
    assert client.get("/v1/plans").json()["items"] == []
    monkeypatch.setattr(plans, "_processes", processes)
    jobs.run_job(queued[0])
    jobs.run_job(queued[0])
    assert [plan["name"] for plan in client.get("/v1/plans").json()["items"]] == [body["name"]]
    waiting = client.post("/v1/plans", json=body | {"name": "never"}, headers=LATER).json()
    assert client.post(f"/v1/jobs/{waiting['id']}/cancel").json()["state"] == "cancelled"
    jobs.run_job(waiting["id"])
    assert len(client.get("/v1/plans").json()["items"]) == 1


def test_bad_input_is_refused_at_once_or_fails_the_job_and_no_plan_is_stored(
    client: httpx.Client, body: dict[str, Any]
) -> None:
    unknown = body | {"rules": {"version": 1, "plates": {"spacing": 10}}}
    refused(client.post("/v1/plans", json=unknown, headers=LATER), 422, field="plates.spacing")
    nowhere = body | {"alignment_id": "019cb624-0000-7000-8000-00000000ffff"}
    refused(client.post("/v1/plans", json=nowhere, headers=LATER), 404, field="alignment_id")
    elsewhere = body | {"rules": {"version": 1, "plates": {}, "road": {"lanes": ["7"]}}}
    failed = finished(client, client.post("/v1/plans", json=elsewhere, headers=LATER).headers["Location"])
    assert (failed["state"], failed["subject_id"], failed["error"]["field"]) == ("failed", None, "road.lanes")
    assert client.get("/v1/plans").json()["items"] == []


def test_a_road_of_1000_km_is_refused_with_the_limit(client: httpx.Client) -> None:
    lane = [[-60.0 + 0.01 * k, -30.0] for k in range(1040)]  # 96.5 km a degree
    properties = {"lane": "1", "width_m": 3.5, "speed_limit_kmh": 70}
    feature = {"type": "Feature", "properties": properties, "geometry": {"type": "LineString", "coordinates": lane}}
    data = json.dumps({"type": "FeatureCollection", "features": [feature]}).encode()
    problem = refused(send_road(client, data, name="across the pampa"), 422)
    assert "500 km" in problem["limit"]
    assert "sections" in problem["cure"]
    assert client.get("/v1/alignments").json()["items"] == []
