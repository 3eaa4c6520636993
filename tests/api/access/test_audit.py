"""/v1/audit and `waymark audit verify`: what changed the registry, page by page, and checked from outside."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator

import httpx
import pytest
import sqlalchemy as sa
from typer.testing import CliRunner

from app.cli import cli
from app.registry.engines import EVERY_AGENCY, set_whose
from app.services.access.access import Scope
from app.settings import Settings
from tests.conftest import LiveServer, Place

pytestmark = pytest.mark.both_databases


@pytest.fixture
def admin(server: LiveServer) -> Iterator[httpx.Client]:
    with server.agency("audited", Scope.ADMIN) as client:
        yield client


@pytest.mark.slow
def test_each_change_is_an_entry(admin: httpx.Client, place: Place) -> None:
    before = admin.get("/v1/audit").json()
    marker = admin.post("/v1/markers", json={"position": place()}).json()
    path = f"/v1/markers/{marker['id']}"
    admin.patch(path, json={"status": "built"}, headers={"If-Match": '"1"'})
    admin.patch(path, json={"status": "built"}, headers={"If-Match": '"1"'})  # stale: no entry
    log = admin.get("/v1/audit", params={"after": before["head"]["number"] if before["head"] else 0}).json()
    one, two = log["items"]
    assert [(e["action"], e["subject"], e["versions"]) for e in (one, two)] == [
        ("marker.registered", marker["id"], 1),
        ("marker.changed", marker["id"], 1),
    ]
    assert two["previous_hash"] == one["hash"]
    assert two["who"].startswith("audited")
    assert two["key_id"]
    assert log["head"] == {"number": two["number"], "hash": two["hash"]}
    versions = admin.get(f"{path}/versions").json()["items"]
    assert [v["audit_number"] for v in versions] == [one["number"], two["number"]]


def test_the_log_comes_in_pages(admin: httpx.Client, place: Place) -> None:
    for _ in range(3):
        assert admin.post("/v1/markers", json={"position": place()}).status_code == 201
    page = admin.get("/v1/audit", params={"limit": 1})
    numbers = [page.json()["items"][0]["number"]]
    while "next" in page.links:
        page = admin.get(page.links["next"]["url"])
        numbers += [entry["number"] for entry in page.json()["items"]]
    assert numbers == list(range(1, page.json()["head"]["number"] + 1))


@pytest.mark.slow
@pytest.mark.parametrize(
    "wrong", ["limit=0", "limit=1000000000", "after=-1", "after=1e400", "after=123456789012345678901234"]
)
def test_bad_pages_are_refused(admin: httpx.Client, wrong: str) -> None:
    response = admin.get(f"/v1/audit?{wrong}")
    assert response.status_code == 422
    assert response.json()["type"].startswith("urn:waymark:problem:")


def test_one_agency_sees_its_own_log_only(server: LiveServer, admin: httpx.Client, place: Place) -> None:
    admin.post("/v1/markers", json={"position": place()})
    with server.agency("another that is audited", Scope.ADMIN) as other:
        known = {entry["hash"] for entry in admin.get("/v1/audit").json()["items"]}
        assert not known & {entry["hash"] for entry in other.get("/v1/audit").json()["items"]}


def test_only_admins_read_it(server: LiveServer) -> None:
    with server.agency("audited", Scope.PLANNER) as planner:
        assert planner.get("/v1/audit").status_code == 403


@pytest.mark.slow
def test_verify_beside_a_running_server(
    serve: Callable[[Settings], LiveServer], settings: Settings, place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    server = serve(settings)
    monkeypatch.setenv("WAYMARK_DATABASE_URL", settings.resolved_database_url)
    with server.agency("checked", Scope.ADMIN) as admin:
        marker_id = admin.post("/v1/markers", json={"position": place()}).json()["id"]
        head = admin.get("/v1/audit").json()["head"]
        kept = f"{head['number']}:{head['hash']}"
        good = CliRunner().invoke(cli, ["audit", "verify"])
        assert good.exit_code == 0, good.output
        assert f"head {kept}" in good.output
        assert CliRunner().invoke(cli, ["audit", "verify", "checked", "--expect-head", kept]).exit_code == 0
        other = f"{head['number'] + 1}:{head['hash']}"
        cut = CliRunner().invoke(cli, ["audit", "verify", "checked", "--expect-head", other])
        assert cut.exit_code == 1
        assert "its end was cut off" in cut.output
        heads = settings.data_dir / "heads.json"
        for since in ("", f" after entry {head['number']}"):
            last = CliRunner().invoke(cli, ["audit", "verify", "checked", "--heads", str(heads)])
            assert f"versions{since}, head {kept}" in last.output, last.output
            assert json.loads(heads.read_text()) == {"checked": kept}
    engine = sa.create_engine(settings.resolved_database_url)
    with engine.begin() as connection:
        if connection.dialect.name == "postgresql":
            set_whose(connection, EVERY_AGENCY)
        connection.execute(sa.text("UPDATE marker_versions SET who = 'x' WHERE marker_id = :id"), {"id": marker_id})
    engine.dispose()
    bad = CliRunner().invoke(cli, ["audit", "verify"])
    assert bad.exit_code == 1
    assert f"checked: version 1 of marker {marker_id}: changed" in bad.output


def test_other_changes_are_entries_too(server: LiveServer, admin: httpx.Client) -> None:
    after = admin.get("/v1/audit").json()["head"]["number"]
    server.agency("audited", Scope.VIEWER).close()
    design = {"magnets": 3, "length_m": 4, "segment_m": 0.1}
    meaning = {"kind": "arrow", "value": "straight"}
    book = admin.post("/v1/codebooks", json={"name": f"book {after}", "design": design, "meanings": []}).json()
    admin.post(f"/v1/codebooks/{book['id']}/entries", json={"meanings": [meaning]})
    vehicle = admin.post("/v1/vehicles", json={"name": f"van {after}", "profile": {}}).json()
    items = admin.get("/v1/audit", params={"after": after}).json()["items"]
    assert [entry["action"] for entry in items] == [
        "key.created",
        "codebook.made",
        "codebook.extended",
        "vehicle.added",
    ]
    assert items[0]["detail"]["scope"] == "viewer"
    assert items[0]["who"] == "the server's operator"
    assert [entry["subject"] for entry in items[1:]] == [book["id"], book["id"], vehicle["id"]]
    assert items[1]["detail"]["sha256"] != items[2]["detail"]["sha256"]
    assert all(entry["versions"] == 0 for entry in items)


def test_handing_out_keys_of_markers_is_an_entry(admin: httpx.Client, place: Place) -> None:
    body = {"family": "cerpm", "position": place(), "side": "left"}
    marker_id = admin.post("/v1/markers", json=body).json()["id"]
    for with_keys in (True, False):
        response = admin.post("/v1/programs", json={"marker_ids": [marker_id], "with_keys": with_keys})
        assert response.status_code == 200, response.text
    items = admin.get("/v1/audit", params={"limit": 1000}).json()["items"]
    assert [entry["action"] for entry in items].count("marker-keys.handed-out") == 1
    assert [entry["action"] for entry in items].count("agency-key.made") == 1


def test_entries_are_filtered_and_the_newest_can_come_first(server: LiveServer, place: Place) -> None:
    with server.agency("filtered log", Scope.ADMIN) as admin:
        marker = admin.post("/v1/markers", json={"position": place()}).json()
        other = admin.post("/v1/markers", json={"position": place()}).json()
        admin.patch(f"/v1/markers/{marker['id']}", json={"status": "built"}, headers={"If-Match": '"1"'})

        def numbers(**wanted: str) -> list[int]:
            answer = admin.get("/v1/audit", params=wanted)
            assert answer.status_code == 200, answer.text
            return [entry["number"] for entry in answer.json()["items"]]

        everything = admin.get("/v1/audit").json()["items"]
        known = {entry["number"]: entry for entry in everything}
        assert numbers(order="newest") == [entry["number"] for entry in reversed(everything)]
        found = numbers(action="marker.registered")
        assert [known[number]["subject"] for number in found] == [marker["id"], other["id"]]
        assert numbers(action="marker.*", order="newest") == sorted((n for n in known if n >= found[0]), reverse=True)
        assert numbers(action="marker_*") == []
        assert len(numbers(subject=marker["id"])) == 2
        who = everything[-1]["who"]
        assert numbers(who=who)[-1] == everything[-1]["number"]
        assert numbers(who="nobody") == []
        at = everything[-1]["at"]
        assert numbers(since=at)[-1] == everything[-1]["number"]
        assert everything[-1]["number"] not in numbers(until=at)


def test_the_newest_entries_come_in_pages(server: LiveServer, place: Place) -> None:
    with server.agency("newest first", Scope.ADMIN) as admin:
        for _ in range(3):
            assert admin.post("/v1/markers", json={"position": place()}).status_code == 201
        page = admin.get("/v1/audit", params={"limit": 1, "order": "newest", "action": "marker.registered"})
        numbers = [page.json()["items"][0]["number"]]
        while "next" in page.links:
            page = admin.get(page.links["next"]["url"])
            numbers += [entry["number"] for entry in page.json()["items"]]
        assert len(numbers) == 3
        assert numbers == sorted(numbers, reverse=True)


@pytest.mark.parametrize(
    "wrong", ["order=sideways", "since=yesterday", "until=2026-01-01T00:00:00", "after=-1", "who=%00"]
)
def test_bad_filters_are_refused(admin: httpx.Client, wrong: str) -> None:
    response = admin.get(f"/v1/audit?{wrong}")
    assert response.status_code == 422
    assert response.json()["type"].startswith("urn:waymark:problem:")
