"""Proofs of plans over HTTP: jobs that go on after a restart, on both databases."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import sqlalchemy as sa

from app.errors import Unavailable
from app.main import create_app
from app.planning.proof import prove
from app.registry.agencies import agencies
from app.registry.jobs import JobKind
from app.services.plans.tasks import prove_unit, write_proof
from app.settings import Settings
from tests.api.plans.test_plans import road, send_road
from tests.conftest import ADMIN_KEY, UNLIMITED, LiveServer
from tests.formats.pictures import corner_frame, png
from tests.http import created, finished, refused, wait_until

pytestmark = [pytest.mark.slow, pytest.mark.both_databases]

PLACES = itertools.count(1)
PLATES: dict[str, Any] = {"version": 1, "plates": {"spacing_m": 100}}
TERMS: dict[str, Any] = {"drives": 3, "seed": 5, "max_markers_per_drive": 1}
FIRST = {"If-Match": '"1"'}


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory, new_database_url: Callable[[Path], str]) -> Iterator[LiveServer]:
    """A server with one decoder process, that the tests of this module share."""
    folder = tmp_path_factory.mktemp("proofs") / "var"
    url = new_database_url(folder)
    settings = Settings(
        data_dir=folder, database_url=url, admin_key=ADMIN_KEY, decode_workers=1, warm_decoders=False, **UNLIMITED
    )
    with LiveServer(create_app(settings)) as running:
        yield running


@pytest.fixture
def plan(client: httpx.Client) -> dict[str, Any]:
    """A checked plan of three plates."""
    return make_plan(client, PLATES)


def make_plan(client: httpx.Client, rules: dict[str, Any], length_m: float = 300.0) -> dict[str, Any]:
    number = next(PLACES)
    alignment = send_road(client, road(20.0, 40.0 + number * 0.02, length_m), name=f"r{number}").json()
    return created(client, "/v1/plans", name=f"p{number}", alignment_id=alignment["id"], rules=rules)


@pytest.fixture
def waiting(server: LiveServer, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Ids of the proofs that were queued and wait until a test runs them."""
    queued: list[str] = []

    class Held:
        def submit(self, job_id: str, agency_id: str, kind: JobKind) -> None:
            queued.append(job_id)

    monkeypatch.setattr(server.app.state.use_cases.proofs, "_queue", Held())
    return queued


class Watched:
    """Decoder processes that count the tasks of each kind, and do something before a unit is handed over."""

    def __init__(self, processes: Any, before: Callable[[int], None] = lambda _count: None) -> None:
        self._processes, self._before = processes, before
        self.units = 0

    def submit(self, task: Any, *arguments: Any, wait_s: float = 0.0) -> Any:
        if task is prove_unit:
            self._before(self.units)
            self.units += 1
        return self._processes.submit(task, *arguments, wait_s=wait_s)

    def run(self, task: Any, *arguments: Any, wait_s: float = 0.0) -> Any:
        return self.submit(task, *arguments, wait_s=wait_s).result()


def prove_plan(client: httpx.Client, plan: dict[str, Any], **more: str) -> httpx.Response:
    return client.post(f"/v1/plans/{plan['id']}/proof", json=TERMS, headers=FIRST | more)


def test_a_checked_plan_is_proved_and_its_report_is_the_same_for_the_same_seed(
    server: LiveServer, client: httpx.Client, plan: dict[str, Any]
) -> None:
    url = f"/v1/plans/{plan['id']}"
    folder = server.app.state.use_cases.proofs._blobs._folder / "proofs"
    before = len(list(folder.rglob("*/*")))
    assert (plan["status"], plan["proof"]) == ("checked", None)
    refused(client.get(f"{url}/proof"), 404, field="plan_id")
    refused(client.get(f"{url}/files/proof.csv"), 404)
    refused(client.post(f"{url}/proof", json=TERMS), 428)
    queued = prove_plan(client, plan, **{"Idempotency-Key": "once"})
    assert queued.status_code == 202, queued.text
    assert queued.json()["kind"] == "proof"
    assert queued.json()["subject_id"] == plan["id"]
    job = finished(client, queued.headers["Location"])
    assert (job["state"], job["error"]) == ("done", None)
    assert (job["done"], job["total"], job["progress"]) == (3, 3, 1.0)
    assert job["result"] == {"plan_version": 1, "outdated": False, "passed": True, "weak": 0, "wrong": 0}
    proved = client.get(url).json()
    assert (proved["status"], proved["version"]) == ("proved", 2)
    assert proved["proof"]["job_id"] == job["id"]
    assert proved["proof"]["terms"]["drives"] == 3
    assert proved["proof"]["rates"][0]["passes"] == 3
    report = client.get(f"{url}/proof").json()
    assert report["rates"] == proved["proof"]["rates"]
    assert report["plan"] == plan["name"]
    assert report["complete"]
    table = client.get(f"{url}/files/proof.csv")
    assert table.headers["content-type"].startswith("text/csv")
    assert len(table.text.splitlines()) == 1 + len(report["markers"])
    assert client.get(f"{url}/files/proof.json").json() == report
    replayed = prove_plan(client, plan, **{"Idempotency-Key": "once"})
    assert (replayed.status_code, replayed.headers["Idempotency-Replayed"]) == (202, "true")
    assert replayed.json() == queued.json()
    refused(client.post(f"{url}/proof", json={}, headers=FIRST | {"Idempotency-Key": "once"}), 409)
    refused(prove_plan(client, plan), 412)
    again = finished(client, client.post(f"{url}/proof", json=TERMS, headers={"If-Match": "*"}).headers["Location"])
    assert again["result"]["plan_version"] == 2
    assert client.get(f"{url}/proof").json() == report
    assert client.get(url).json()["status"] == "proved"
    jobs = client.get("/v1/jobs", params={"subject_id": plan["id"]}).json()["items"]
    assert [one["id"] for one in jobs] == [again["id"], job["id"]]
    assert len(list(folder.rglob("*/*"))) == before + 2, "the files of the earlier proof are gone"
    changed = client.patch(url, json={"rules": PLATES}, headers={"If-Match": '"3"'}).json()
    assert len(list(folder.rglob("*/*"))) == before
    assert (changed["status"], changed["proof"]) == ("checked", None)
    refused(client.get(f"{url}/proof"), 404)


def test_uploads_are_decoded_while_a_proof_runs(client: httpx.Client, plan: dict[str, Any]) -> None:
    long = TERMS | {"drives": 200}
    location = client.post(f"/v1/plans/{plan['id']}/proof", json=long, headers=FIRST).headers["Location"]
    wait_until(lambda: client.get(location).json()["done"], "the first unit")
    frame = {"content": png(corner_frame()), "headers": {"Content-Type": "image/png"}}
    for _ in range(2):
        assert client.post("/v1/decodes", **frame).status_code == 201
        job = client.get(location).json()
        assert (job["state"], job["total"]) == ("running", 200)
    client.post(f"/v1/jobs/{location.rpartition('/')[2]}/cancel")
    assert finished(client, location)["state"] == "cancelled"


def test_an_interrupted_proof_does_not_drive_finished_units_again(
    server: LiveServer,
    client: httpx.Client,
    plan: dict[str, Any],
    waiting: list[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    job = prove_plan(client, plan).json()
    proofs, jobs = server.app.state.use_cases.proofs, server.app.state.use_cases.jobs
    processes = proofs._processes

    def stop_after_one(count: int) -> None:
        if count == 1:
            raise Unavailable("the server stops")

    for _ in range(2):
        monkeypatch.setattr(proofs, "_processes", Watched(processes, stop_after_one))
        with pytest.raises(Unavailable):
            jobs.run_job(job["id"])
    between = client.get(f"/v1/jobs/{job['id']}").json()
    assert (between["state"], between["done"], between["attempts"]) == ("queued", 2, 0)
    refused(prove_plan(client, plan), 409, field="plan_id")
    assert client.get(f"/v1/plans/{plan['id']}").json()["status"] == "checked"
    rest = Watched(processes)
    monkeypatch.setattr(proofs, "_processes", rest)
    jobs.run_job(job["id"])
    assert rest.units == 1
    monkeypatch.undo()
    interrupted = client.get(f"/v1/plans/{plan['id']}/proof").json()
    whole = client.post(f"/v1/plans/{plan['id']}/proof", json=TERMS, headers={"If-Match": "*"})
    assert finished(client, whole.headers["Location"])["state"] == "done"
    assert client.get(f"/v1/plans/{plan['id']}/proof").json() == interrupted


def test_a_proof_goes_on_after_a_restart_of_the_server(
    tmp_path: Path, new_database_url: Callable[[Path], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    url = new_database_url(tmp_path)
    settings = Settings(
        data_dir=tmp_path / "var", database_url=url, admin_key=ADMIN_KEY, decode_workers=1, warm_decoders=False,
        **UNLIMITED,
    )  # fmt: skip
    with LiveServer(create_app(settings)) as first, first.client() as client:
        plan = make_plan(client, PLATES)
        proofs = first.app.state.use_cases.proofs

        def stop(count: int) -> None:
            if count == 2:
                first.app.state.use_cases.proofs._processes._processes.close()  # as the server does when it stops

        proofs._processes = Watched(proofs._processes, stop)
        location = prove_plan(client, plan).headers["Location"]
        wait_until(lambda: client.get(location).json()["done"] == 2, "two units")
    app = create_app(settings)
    app.state.use_cases.proofs._processes = rest = Watched(app.state.use_cases.proofs._processes)
    with LiveServer(app) as second, second.client() as client:
        job = finished(client, location)
        assert (job["state"], job["done"], rest.units) == ("done", 3, 1)
        assert client.get(f"/v1/plans/{plan['id']}").json()["status"] == "proved"


def test_a_cancelled_proof_stops_and_leaves_the_plan(
    server: LiveServer,
    client: httpx.Client,
    plan: dict[str, Any],
    waiting: list[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    queued = prove_plan(client, plan).json()
    with server.agency("provers of others") as other:
        refused(other.post(f"/v1/jobs/{queued['id']}/cancel"), 404)
    assert client.post(f"/v1/jobs/{queued['id']}/cancel").json()["state"] == "cancelled"
    server.app.state.use_cases.jobs.run_job(queued["id"])
    job = prove_plan(client, plan).json()
    proofs = server.app.state.use_cases.proofs

    def cancel(count: int) -> None:
        if count == 1:
            assert client.post(f"/v1/jobs/{job['id']}/cancel").json()["state"] == "running"

    watched = Watched(proofs._processes, cancel)
    monkeypatch.setattr(proofs, "_processes", watched)
    server.app.state.use_cases.jobs.run_job(job["id"])
    ended = client.get(f"/v1/jobs/{job['id']}").json()
    assert (ended["state"], ended["result"], ended["cancel_requested"]) == ("cancelled", None, True)
    assert watched.units < 4
    assert client.get(f"/v1/plans/{plan['id']}").json() == plan
    assert client.post(f"/v1/jobs/{job['id']}/cancel").json()["state"] == "cancelled"
    assert client.get(f"/v1/jobs/{job['id']}").json() == ended
    by_state = client.get("/v1/jobs", params={"state": "cancelled"}).json()["items"]
    assert [one["id"] for one in by_state] == [job["id"], queued["id"]]


def test_a_plan_that_was_changed_meanwhile_is_not_proved(
    server: LiveServer,
    client: httpx.Client,
    plan: dict[str, Any],
    waiting: list[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    url = f"/v1/plans/{plan['id']}"
    job = prove_plan(client, plan).json()
    proofs = server.app.state.use_cases.proofs

    def change(count: int) -> None:
        if count == 1:
            closer = {"version": 1, "plates": {"spacing_m": 50}}
            assert client.patch(url, json={"rules": closer}, headers=FIRST).status_code == 200

    monkeypatch.setattr(proofs, "_processes", Watched(proofs._processes, change))
    server.app.state.use_cases.jobs.run_job(job["id"])
    ended = client.get(f"/v1/jobs/{job['id']}").json()
    assert (ended["state"], ended["result"]["outdated"], ended["result"]["plan_version"]) == ("done", True, 1)
    changed = client.get(url).json()
    assert (changed["status"], changed["proof"], changed["version"]) == ("checked", None, 2)
    refused(client.get(f"{url}/proof"), 404)


def test_a_new_name_in_the_meantime_does_not_matter_and_an_approval_stays(
    server: LiveServer, client: httpx.Client, plan: dict[str, Any], waiting: list[str]
) -> None:
    url = f"/v1/plans/{plan['id']}"
    job = prove_plan(client, plan).json()
    client.patch(url, json={"name": f"{plan['name']} renamed"}, headers=FIRST)
    server.app.state.use_cases.jobs.run_job(job["id"])
    proved = client.get(url).json()
    assert (proved["status"], proved["version"]) == ("proved", 3)
    job = client.post(f"{url}/proof", json=TERMS, headers={"If-Match": '"3"'}).json()
    with server.agency(_agency_of(server, client)) as colleague:
        assert colleague.post(f"{url}/approve", headers={"If-Match": '"3"'}).status_code == 200
    server.app.state.use_cases.jobs.run_job(job["id"])
    approved = client.get(url).json()
    assert (approved["status"], approved["proof"]["job_id"]) == ("approved", job["id"])
    history = client.get(f"{url}/versions").json()["items"]
    assert [one["plan"]["status"] for one in history] == ["checked", "checked", "proved", "approved", "approved"]


def _agency_of(server: LiveServer, client: httpx.Client) -> str:
    caller = server.app.state.use_cases.access.authenticate(client.headers["authorization"].split()[1])
    with server.app.state.database.read() as connection:
        name: str = connection.execute(sa.select(agencies.c.name).where(agencies.c.id == caller.agency_id)).scalar_one()
    return name


@pytest.mark.parametrize("wrong", [0, 1])
def test_a_draft_stays_a_draft_and_a_wrong_reading_takes_the_proof_back(
    server: LiveServer,
    client: httpx.Client,
    waiting: list[str],
    monkeypatch: pytest.MonkeyPatch,
    wrong: int,
) -> None:
    blurred = {"cameras": [{"name": "slow", "exposure_s": 0.1, "frames_per_s": 1.0}]} if not wrong else {}
    plan = make_plan(client, PLATES | blurred)
    url = f"/v1/plans/{plan['id']}"
    assert plan["status"] == ("checked" if wrong else "draft")
    proofs = server.app.state.use_cases.proofs
    processes = proofs._processes

    class Misreading:
        def submit(self, task: Any, *arguments: Any, wait_s: float = 0.0) -> Any:
            return processes.submit(task, *arguments, wait_s=wait_s)

        def run(self, task: Any, *arguments: Any, wait_s: float = 0.0) -> Any:
            if task is write_proof and wrong:
                _document, _terms, results = arguments
                results[0]["wrong"].append({"marker": 1, "text": "0000000000ab"})
            return self.submit(task, *arguments, wait_s=wait_s).result()

    for version, misread in ((1, False), (2, True)):
        monkeypatch.setattr(proofs, "_processes", Misreading() if misread else processes)
        job = client.post(f"{url}/proof", json=TERMS, headers={"If-Match": f'"{version}"'}).json()
        server.app.state.use_cases.jobs.run_job(job["id"])
        proved = client.get(url).json()
        if not wrong:
            assert proved["status"] == "draft"
            assert proved["proof"]["weak"] == len(proved["proof"]["weak_markers"]) > 0
        else:
            assert proved["status"] == ("checked" if misread else "proved")
            assert (proved["proof"]["passed"], proved["proof"]["wrong"]) == (not misread, int(misread))
    report = client.get(f"{url}/proof").json()
    assert len(report["wrong"]) == wrong


@pytest.mark.parametrize(
    ("terms", "status", "field"),
    [
        ('{"drives": 0}', 422, "drives"),
        ('{"drives": true}', 422, "drives"),
        ('{"lost_share": NaN}', 400, "body.lost_share"),
        ('{"lost_share": 1e999}', 400, "body.lost_share"),
        ('{"conditions": ["fog"]}', 422, "conditions"),
        ('{"conditions": []}', 422, "conditions"),
        ('{"cameras": []}', 422, "cameras"),
        ('{"cameras": ["none such"]}', 422, "cameras"),
        ('{"speed": 1}', 422, "speed"),
        ('{"seed": -1}', 422, "seed"),
        ('{"weak_below": 0}', 422, "weak_below"),
    ],
)
def test_bad_terms_are_refused_and_no_job_is_queued(
    client: httpx.Client, plan: dict[str, Any], terms: str, status: int, field: str
) -> None:
    headers = FIRST | {"Content-Type": "application/json"}
    refused(client.post(f"/v1/plans/{plan['id']}/proof", content=terms, headers=headers), status, field=field)
    assert client.get("/v1/jobs").json()["items"] == []


def test_too_many_units_and_nothing_to_drive_are_refused(client: httpx.Client, plan: dict[str, Any]) -> None:
    many = {"drives": prove.MAX_UNITS, "max_markers_per_drive": 1000}
    job = client.post(f"/v1/plans/{plan['id']}/proof", json=many, headers=FIRST)
    assert job.status_code == 202, job.text
    client.post(f"/v1/jobs/{job.json()['id']}/cancel")
    closer = make_plan(client, {"version": 1, "plates": {"spacing_m": 20}})
    problem = refused(client.post(f"/v1/plans/{closer['id']}/proof", json=many, headers=FIRST), 422, field="drives")
    assert str(prove.MAX_UNITS) in problem["limit"]
    lone = make_plan(
        client, {"version": 1, "cerpm": {"sides": "left", "straight": 4.0, "max_path_error_m": None}}, 60.0
    )
    assert 0 < lone["counts"]["cerpm"] < 4
    refused(client.post(f"/v1/plans/{lone['id']}/proof", json={}, headers=FIRST), 422, field="plan")
