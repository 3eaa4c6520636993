"""Stored uploads are decoded again, compared reading by reading, and become current when a person accepts it."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import sqlalchemy as sa

from app.demo.cerpms import build_lane
from app.errors import UnreadableUpload
from app.main import create_app
from app.registry.decodes import decodes, observations
from app.registry.engines import across_agencies
from app.registry.jobs import jobs as jobs_table
from app.registry.reprocessings import reprocessed_decodes
from app.services import reprocessing as module
from app.services.access.access import Scope
from app.services.reprocessing import compare_results
from app.settings import Settings
from tests.api.decodes.conftest import near, post_frame
from tests.api.decodes.test_packets import decoded, drive, packed
from tests.conftest import ADMIN_KEY, UNLIMITED, LiveServer
from tests.formats.pictures import png
from tests.http import created, refused, wait_until
from tests.jobs import standin

pytestmark = pytest.mark.both_databases
OLD = "waymark 0.1.9 plate/1"


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory, new_database_url: Callable[[Path], str]) -> Iterator[LiveServer]:
    """A server whose decoder reads all plates nearby, that the tests of this module share."""
    folder = tmp_path_factory.mktemp("reprocessing") / "var"
    url = new_database_url(folder)
    settings = Settings(data_dir=folder, database_url=url, admin_key=ADMIN_KEY, decode_workers=1, **UNLIMITED)
    with LiveServer(create_app(settings, decode=standin.decode)) as running:
        yield running


@pytest.fixture
def admin(server: LiveServer, request: pytest.FixtureRequest) -> Iterator[httpx.Client]:
    with server.agency(f"admins of {request.node.name}", Scope.ADMIN) as client:
        yield client


def upload(client: httpx.Client, place: dict[str, Any]) -> dict[str, Any]:
    """A decoded frame with one plate."""
    plate = created(client, "/v1/markers", position=place)
    answer = post_frame(client, png(standin.frame_that(standin.OBEY)), near(plate))
    assert answer.status_code == 201, answer.text
    decode: dict[str, Any] = answer.json()
    assert [reading["digits"] for reading in decode["readings"]] == [plate["code"]["digits"]]
    return decode


def rewrite(server: LiveServer, decode: dict[str, Any], change: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """Make the stored result that of an older decoder."""
    with across_agencies(), server.app.state.database.write() as connection:
        own = decodes.c.id == decode["id"]
        result = connection.execute(sa.select(decodes.c.result).where(own)).scalar_one()
        result["decoder"] = OLD
        change(result)
        connection.execute(sa.update(decodes).where(own).values(result=result, decoder=OLD))
    return dict(result)


def ended(client: httpx.Client, answer: httpx.Response) -> dict[str, Any]:
    assert answer.status_code == 202, answer.text
    path = answer.headers["location"]

    def found() -> dict[str, Any] | None:
        document = client.get(path).json()
        return document if document["state"] != "running" else None

    return wait_until(found, "the reprocessing")


@pytest.mark.slow
def test_what_changed_is_reported_and_becomes_current_when_approved(
    server: LiveServer, admin: httpx.Client, place: Callable[[], dict[str, Any]]
) -> None:
    gained, lost, changed, same = (upload(admin, place()) for _ in range(4))
    rewrite(server, gained, lambda result: result["readings"].clear())
    rewrite(server, lost, lambda result: result["readings"].append({**result["readings"][0], "digits": "9" * 12}))

    def misread(result: dict[str, Any]) -> None:
        result["readings"][0]["digits"] = "1" * 12

    old = rewrite(server, changed, misread)
    rewrite(server, same, lambda result: None)
    with across_agencies(), server.app.state.database.read() as connection:
        seen = connection.execute(sa.select(sa.func.count()).select_from(observations)).scalar_one()
    run = ended(admin, admin.post("/v1/reprocessings", json={"older_than": "0.2", "kinds": ["frame"]}))
    assert (run["state"], run["done"], run["total"], run["shards"]) == ("ready", 4, 4, {"done": 1})
    assert run["summary"] == {"gained": 1, "lost": 1, "changed": 1, "same": 2, "failed": 0}
    report = {item["decode_id"]: item for item in admin.get(run["links"]["report"]).json()["items"]}
    assert set(report) == {gained["id"], lost["id"], changed["id"]}
    (one,) = report[changed["id"]]["changes"]
    digits = changed["readings"][0]["digits"]
    assert (one["change"], one["frame"], one["code_before"], one["code"]) == ("changed", 0, "1" * 12, digits)
    assert report[gained["id"]]["decoder_before"] == OLD
    lines = list(csv.DictReader(io.StringIO(admin.get(run["links"]["csv"]).text)))
    assert sorted(line["change"] for line in lines) == ["changed", "gained", "lost"]
    # nothing has changed yet
    assert admin.get(f"/v1/decodes/{changed['id']}").json()["readings"] == old["readings"]
    assert admin.get(f"/v1/decodes/{changed['id']}/versions").json() == {"items": []}
    approved = admin.post(f"{run['links']['self']}/approve")
    assert approved.json()["state"] == "approved", approved.text
    now = admin.get(f"/v1/decodes/{changed['id']}").json()
    assert (now["readings"][0]["digits"], now["decoder"]) == (digits, changed["decoder"])
    (version,) = admin.get(f"/v1/decodes/{changed['id']}/versions").json()["items"]
    assert (version["decoder"], version["result"]) == (OLD, old)
    with across_agencies(), server.app.state.database.read() as connection:
        assert connection.execute(sa.select(sa.func.count()).select_from(observations)).scalar_one() == seen
    refused(admin.post(f"{run['links']['self']}/approve"), 409, "conflict")
    again = admin.post("/v1/reprocessings", json={"older_than": "0.2"})
    refused(again, 422, "invalid-parameter")  # none is older any more
    with server.agency("strangers", Scope.ADMIN) as stranger:
        refused(stranger.get(run["links"]["csv"]), 404, "not-found")
        refused(stranger.post(f"{run['links']['self']}/approve"), 404, "not-found")


def test_criteria_choose_the_uploads(
    server: LiveServer, admin: httpx.Client, place: Callable[[], dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server.app.state.use_cases.reprocessings._queue, "submit", lambda *_: None)
    first, second = place(), place()
    decode, other = upload(admin, first), upload(admin, second)
    rewrite(server, other, lambda result: None)
    lon, lat = first["lon_deg"], first["lat_deg"]
    at = decode["created_at"]
    for criteria, count in (
        ({}, 2), ({"decoder": OLD}, 1), ({"older_than": "0.1.9"}, 0), ({"older_than": "0.1.10"}, 1),
        ({"bbox": [lon - 0.01, lat - 0.01, lon + 0.01, lat + 0.01]}, 1), ({"kinds": ["trace"]}, 0),
        ({"since": other["created_at"]}, 1), ({"until": at}, 0), ({"until": other["created_at"]}, 1),
        ({"vehicle_id": decode["id"]}, 0),
    ):  # fmt: skip
        answer = admin.post("/v1/reprocessings", json=criteria)
        if count:
            assert answer.json()["total"] == count, criteria
            assert answer.json()["state"] == "running"
            admin.post(f"{answer.json()['links']['self']}/cancel")
        else:
            refused(answer, 422, "invalid-parameter")
    refused(admin.post("/v1/reprocessings", json={"older_than": "new"}), 422, field="older_than")


def test_a_shard_goes_on_where_it_was_killed_and_can_be_cancelled(
    server: LiveServer, admin: httpx.Client, place: Callable[[], dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    state = server.app.state
    monkeypatch.setattr(state.use_cases.reprocessings._queue, "submit", lambda *_: None)
    monkeypatch.setattr(module, "SHARD", 2)
    uploads = [upload(admin, place()) for _ in range(3)]
    run = admin.post("/v1/reprocessings", json={}).json()
    assert run["shards"] == {"queued": 2}
    decode_again, asked = state.use_cases.decodes.decode_again, []

    class Killed(BaseException):
        pass

    def killed_at_the_second(agency_id: str, decode_id: str) -> Any:
        asked.append(decode_id)
        if len(asked) == 2:
            raise Killed
        if decode_id == uploads[2]["id"]:
            raise UnreadableUpload("it is not what it was")
        return decode_again(agency_id, decode_id)

    monkeypatch.setattr(state.use_cases.decodes, "decode_again", killed_at_the_second)
    jobs = [job["id"] for job in admin.get("/v1/jobs?kind=reprocess").json()["items"]][::-1]
    with pytest.raises(Killed):
        state.use_cases.jobs.run_job(jobs[0])
    assert admin.get(run["links"]["self"]).json()["done"] == 1
    with across_agencies(), state.database.write() as connection:  # the lease of the process that was killed ends
        connection.execute(sa.update(jobs_table).values(lease_until=None).where(jobs_table.c.id == jobs[0]))
    state.use_cases.jobs.run_job(jobs[0])
    assert asked == [uploads[0]["id"], uploads[1]["id"], uploads[1]["id"]]
    assert admin.get(f"/v1/jobs/{jobs[0]}").json()["links"]["result"] == run["links"]["self"]
    refused(admin.post(f"{run['links']['self']}/approve"), 409, "conflict")
    state.use_cases.jobs.run_job(jobs[1])
    run = admin.get(run["links"]["self"]).json()
    assert (run["state"], run["summary"]["failed"], run["summary"]["same"]) == ("ready", 1, 2)
    (failed,) = admin.get(run["links"]["report"]).json()["items"]
    assert (failed["decode_id"], failed["error"]["detail"]) == (uploads[2]["id"], "it is not what it was")
    other = admin.post("/v1/reprocessings", json={}).json()
    assert admin.post(f"{other['links']['self']}/cancel").json()["state"] == "cancelled"
    refused(admin.post(f"{other['links']['self']}/approve"), 409, "conflict")


@pytest.mark.slow
def test_packets_are_no_repetitions_of_themselves(server: LiveServer, admin: httpx.Client) -> None:
    built = build_lane(admin, np.random.default_rng(2702))
    first, hour = drive(built, 2703)
    decodes = [decoded(admin, packed(first))]
    later, _hour = drive(built, 2704, hour=hour + 1)  # later transmissions do not make it an old one
    newest = {packet.payload[:16]: packet.payload for packet in later.packets if packet.payload}
    untimed = "".join(f"{payload.hex()}\n" for payload in newest.values())
    decodes.append(decoded(admin, untimed.encode(), name="packets.txt"))
    assert decoded(admin, untimed.encode(), name="packets.txt")["report"]["verdicts"]["authentic"] == 0
    run = ended(admin, admin.post("/v1/reprocessings", json={"kinds": ["packets"]}))
    same = sum(len(decode["markers"]) for decode in decodes)
    assert run["summary"] == {"gained": 0, "lost": 0, "changed": 0, "same": same, "failed": 0}
    for decode, sent in zip(decodes, (len(first.packets), len(newest)), strict=True):
        own = reprocessed_decodes.c.decode_id == decode["id"]
        with across_agencies(), server.app.state.database.read() as connection:
            result = connection.execute(sa.select(reprocessed_decodes.c.result).where(own)).scalar_one()
        assert result["report"]["verdicts"] == decode["report"]["verdicts"]
        assert result["report"]["verdicts"]["authentic"] == sent


def test_readings_are_compared_by_place_and_code() -> None:
    fix = {"lon_deg": 8.0, "lat_deg": 50.0}
    plate = {"family": "plate", "frame": 1, "outcome": "read", "digits": "12", "confidence": 0.9, "fix": fix}
    moved = {**plate, "fix": {"lon_deg": 8.0, "lat_deg": 50.0 + 1 / 111_229}}
    tag = {"tag": "NS", "start_s": 1.0, "end_s": 2.0, "confidence": 0.8, "fix": None}
    before = {"readings": [plate], "tags": [tag], "markers": [{"number": 4, "lon_deg": None, "lat_deg": None}]}
    assert compare_results(before, before) == ([], 3)
    changes, same = compare_results({"readings": [plate]}, {"readings": [moved]})
    assert same == 0
    assert changes[0]["moved_m"] == pytest.approx(1.0, abs=0.01)
    unsure = {**plate, "outcome": "unsure"}
    assert compare_results({"readings": [plate]}, {"readings": [unsure]}).changes[0]["change"] == "lost"
    doubtful = {**plate, "confidence": 0.5}
    assert compare_results({"readings": [plate]}, {"readings": [doubtful]}).changes[0]["confidence"] == 0.5
    later = {**tag, "start_s": 9.0, "end_s": 10.0}
    kinds = [change["change"] for change in compare_results({"tags": [tag]}, {"tags": [later]}).changes]
    assert kinds == ["lost", "gained"]
    other = {**tag, "tag": "SN", "start_s": 1.2}
    (change,) = compare_results({"tags": [tag]}, {"tags": [other]}).changes
    assert (change["change"], change["code_before"], change["code"]) == ("changed", "NS", "SN")
