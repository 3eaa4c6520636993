"""Packages of plans over HTTP, on both databases."""

from __future__ import annotations

import hashlib
import io
import itertools
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest

from app.errors import Unavailable
from app.registry.jobs import JobKind
from app.services.plans.tasks import write_package_part
from tests.api.plans.test_plans import road, send_road
from tests.conftest import LiveServer
from tests.http import created, finished, refused

pytestmark = [pytest.mark.slow, pytest.mark.both_databases]

PLACES = itertools.count(1)
RULES: dict[str, Any] = {"version": 1, "plates": {"spacing_m": 100}, "lines": {}, "tags": {}}


@pytest.fixture
def plan(client: httpx.Client) -> dict[str, Any]:
    """A plan of plates and magnets."""
    number = next(PLACES)
    alignment = send_road(client, road(40.0, 40.0 + number * 0.02, 300.0), name=f"r{number}").json()
    return created(client, "/v1/plans", name=f"p{number}", alignment_id=alignment["id"], rules=RULES)


@pytest.fixture
def waiting(server: LiveServer, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Ids of the packages that were queued and wait until a test runs them."""
    queued: list[str] = []

    class Held:
        def submit(self, job_id: str, agency_id: str, kind: JobKind) -> None:
            queued.append(job_id)

    monkeypatch.setattr(server.app.state.use_cases.packages, "_queue", Held())
    return queued


class Watched:
    """Decoder processes that do something before a part is handed over."""

    def __init__(self, processes: Any, before: Callable[[int], None]) -> None:
        self._processes, self._before = processes, before
        self._parts = 0

    def submit(self, task: Any, *arguments: Any, wait_s: float = 0.0) -> Any:
        if task is write_package_part:
            self._before(self._parts)
            self._parts += 1
        return self._processes.submit(task, *arguments, wait_s=wait_s)

    def run(self, task: Any, *arguments: Any, wait_s: float = 0.0) -> Any:
        return self.submit(task, *arguments, wait_s=wait_s).result()


def blobs_of(server: LiveServer) -> set[Path]:
    folder = server.app.state.use_cases.packages._blobs._folder
    return set((folder / "packages").rglob("*/*"))


def test_a_plan_is_packed_with_its_drawings_sheets_and_artwork(client: httpx.Client, plan: dict[str, Any]) -> None:
    url = f"/v1/plans/{plan['id']}"
    refused(client.get(f"{url}/package"), 404, field="plan_id")
    wanted = {"crs": "EPSG:32637", "unit": "m", "scale": 500, "title_block": {"owner": "An Agency"}, "formats": ["svg"]}
    queued = client.post(f"{url}/package", json=wanted, headers={"Idempotency-Key": "packed"})
    assert queued.status_code == 202, queued.text
    job = finished(client, queued.headers["Location"])
    assert (job["kind"], job["state"], job["error"]) == ("package", "done", None)
    assert job["done"] == job["total"] > 10
    answer = client.get(f"{url}/package")
    assert (answer.status_code, answer.headers["content-type"]) == (200, "application/zip")
    assert len(answer.content) == job["result"]["size_bytes"]
    assert hashlib.sha256(answer.content).hexdigest() == job["result"]["sha256"]
    archive = zipfile.ZipFile(io.BytesIO(answer.content))
    assert archive.testzip() is None
    manifest = json.loads(archive.read("manifest.json"))
    assert archive.namelist() == [*(entry["name"] for entry in manifest["files"]), "manifest.json"]
    assert len(archive.namelist()) == job["result"]["files"]
    for entry in manifest["files"]:
        content = archive.read(entry["name"])
        assert (len(content), hashlib.sha256(content).hexdigest()) == (entry["size"], entry["sha256"])
    assert manifest["options"]["title_block"]["owner"] == "An Agency"
    names = archive.namelist()
    assert sum(name.startswith("artwork/plate-") for name in names) == plan["counts"]["plate"]
    assert {"drawings.pdf", "bill.csv", "stakeout.dxf", "artwork/quality.pdf"} <= set(names)
    assert any(name.startswith("drilling/tag-") for name in names)
    headers = {"If-None-Match": answer.headers["ETag"]}
    assert client.get(f"{url}/package", headers=headers).status_code == 304
    again = client.post(f"{url}/package", json=wanted, headers={"Idempotency-Key": "packed"})
    assert again.json() == queued.json()
    second = finished(client, client.post(f"{url}/package", json=wanted).headers["Location"])
    assert second["result"]["sha256"] == job["result"]["sha256"], "the same plan gives the same bytes"
    assert client.get(url).json()["version"] == 1
    changed = client.patch(url, json={"rules": {"version": 1, "plates": {}}}, headers={"If-Match": '"1"'})
    assert changed.status_code == 200
    refused(client.get(f"{url}/package"), 404, field="plan_id")


def test_an_interrupted_or_cancelled_package_leaves_nothing(
    server: LiveServer,
    client: httpx.Client,
    plan: dict[str, Any],
    waiting: list[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    url = f"/v1/plans/{plan['id']}/package"
    packages, jobs = server.app.state.use_cases.packages, server.app.state.use_cases.jobs
    processes, before = packages._processes, blobs_of(server)
    job = client.post(url, json={}).json()
    refused(client.post(url, json={}), 409, field="plan_id")

    def stop(count: int) -> None:
        if count == 3:
            raise Unavailable("the server stops")

    monkeypatch.setattr(packages, "_processes", Watched(processes, stop))
    with pytest.raises(Unavailable):
        jobs.run_job(job["id"])
    assert client.get(f"/v1/jobs/{job['id']}").json()["state"] == "queued"

    def cancel(count: int) -> None:
        if count == 3:
            client.post(f"/v1/jobs/{job['id']}/cancel")

    monkeypatch.setattr(packages, "_processes", Watched(processes, cancel))
    jobs.run_job(job["id"])
    assert client.get(f"/v1/jobs/{job['id']}").json()["state"] == "cancelled"
    refused(client.get(url), 404)
    assert blobs_of(server) == before
    monkeypatch.setattr(packages, "_processes", processes)
    for _ in range(2):
        done = client.post(url, json={}).json()
        jobs.run_job(done["id"])
        assert client.get(url).status_code == 200
    assert len(blobs_of(server) - before) == 1, "the earlier package is gone"


@pytest.mark.parametrize(
    ("wanted", "field"),
    [
        ({"scale": 300}, "scale"),
        ({"crs": "EPSG:1"}, "crs"),
        ({"crs": "EPSG:4326"}, "crs"),
        ({"unit": "yard"}, "unit"),
        ({"formats": []}, "formats"),
        ({"formats": ["exe"]}, "formats.0"),
        ({"title_block": {"logo": "x"}}, "title_block.logo"),
        ({"title_block": {"owner": "x" * 81}}, "title_block.owner"),
    ],
)
def test_bad_options_are_refused_and_no_job_is_queued(
    client: httpx.Client, plan: dict[str, Any], wanted: dict[str, Any], field: str
) -> None:
    refused(client.post(f"/v1/plans/{plan['id']}/package", json=wanted), 422, field=field)
    assert client.get("/v1/jobs").json()["items"] == []
