"""The work list over HTTP: filters, files, decisions with their history, and other agencies."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from typing import Any

import httpx
import pytest

from app.health import Fault
from app.main import create_app
from app.registry.webhooks import list_events
from app.services.access.access import Scope
from app.settings import Settings
from tests.api.health.items import add_test_item, drive_shifted_stretch
from tests.conftest import ADMIN_KEY, UNLIMITED, LiveServer
from tests.jobs import standin

pytestmark = pytest.mark.both_databases


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory, new_database_url: Any) -> Iterator[LiveServer]:
    folder = tmp_path_factory.mktemp("maintenance") / "var"
    url = new_database_url(folder)
    settings = Settings(data_dir=folder, database_url=url, admin_key=ADMIN_KEY, decode_workers=1, **UNLIMITED)
    with LiveServer(create_app(settings, decode=standin.decode)) as running:
        yield running


@pytest.fixture(scope="module")
def owner(server: LiveServer) -> Iterator[httpx.Client]:
    with server.agency("maintainers", Scope.ADMIN) as client:
        yield client


def _agency_id(server: LiveServer, client: httpx.Client) -> str:
    key = client.headers["authorization"].split()[1]
    return str(server.app.state.use_cases.access.authenticate(key).agency_id)


def _plate(client: httpx.Client, lon_deg: float, **more: Any) -> dict[str, Any]:
    body = {"position": {"lon_deg": lon_deg, "lat_deg": 47.0}, "status": "active", **more}
    answer = client.post("/v1/markers", json=body)
    assert answer.status_code == 201, answer.text
    document: dict[str, Any] = answer.json()
    return document


def _item(server: LiveServer, client: httpx.Client, marker_id: str, fault: Fault = Fault.MOVED) -> str:
    agency_id = _agency_id(server, client)
    with server.app.state.database.write() as connection:
        return add_test_item(connection, agency_id, marker_id, fault)


def test_the_list_has_what_is_suspected_with_its_evidence(server: LiveServer, owner: httpx.Client) -> None:
    marker = _plate(owner, 8.0, road="A1", measure_m=120.0)
    item_id = _item(server, owner, marker["id"])
    item = owner.get(f"/v1/maintenance/{item_id}").json()
    assert (item["what"], item["status"], item["marker_id"]) == ("moved", "open", marker["id"])
    assert (item["road"], item["measure_m"], item["code"]) == ("A1", 120.0, marker["code"]["digits"])
    assert item["evidence"]["offset_m"] == pytest.approx(1.5)
    assert item["evidence"]["false_alarm_probability"] < 1e-6
    assert item["evidence"]["limit"] < item["ratio"]
    assert owner.get(f"/v1/markers/{marker['id']}").json()["status"] == "active"
    assert owner.get("/v1/maintenance", params={"road": "A1"}).json()["items"] == [item]
    _item(server, owner, marker["id"])  # more evidence: the same item
    assert len(owner.get("/v1/maintenance", params={"road": "A1"}).json()["items"]) == 1


def test_filters_pages_and_files_agree(server: LiveServer, owner: httpx.Client) -> None:
    faults = (Fault.MISSING, Fault.FADING, Fault.MOVED)
    ids = [_item(server, owner, _plate(owner, 9.0 + k / 100, road="B2")["id"], fault) for k, fault in enumerate(faults)]
    road = {"road": "B2"}
    everything = owner.get("/v1/maintenance", params=road).json()["items"]
    assert [item["what"] for item in everything] == ["moved", "missing", "fading"]  # the most urgent first
    assert {item["id"] for item in everything} == set(ids)
    pages, url = [], "/v1/maintenance?road=B2&limit=1"
    while url:
        answer = owner.get(url)
        pages += answer.json()["items"]
        url = answer.links.get("next", {}).get("url", "")
    assert pages == everything
    for query, expected in (
        ({"what": "fading"}, 1), ({"family": "magnet"}, 0), ({"status": "approved"}, 0), ({"status": "open"}, 3),
        ({"bbox": "9.005,46,9.015,48"}, 1), ({"min_priority": everything[1]["priority"]}, 2),
        ({"marker_id": everything[0]["marker_id"]}, 1),
    ):  # fmt: skip
        assert len(owner.get("/v1/maintenance", params={**road, **query}).json()["items"]) == expected, query
    features = owner.get("/v1/maintenance.geojson", params=road).json()["features"]
    assert [feature["id"] for feature in features] == [item["id"] for item in everything]
    assert features[0]["geometry"]["coordinates"] == [everything[0]["lon_deg"], everything[0]["lat_deg"]]
    rows = list(csv.DictReader(io.StringIO(owner.get("/v1/maintenance.csv", params=road).text)))
    assert [row["id"] for row in rows] == [item["id"] for item in everything]
    shown = owner.get("/ogc/collections/maintenance/items", params=road).json()["features"]
    assert {feature["id"] for feature in shown} == set(ids)
    assert shown[0]["properties"]["status"] == "open"
    near = owner.get("/ogc/collections/maintenance/items", params={"bbox": "9.005,46,9.015,48"}).json()["features"]
    assert [feature["properties"]["what"] for feature in near] == ["fading"]
    for bad in ({"what": "tired"}, {"min_priority": "2"}, {"after": "x"}, {"rode": "B2"}):
        assert owner.get("/v1/maintenance", params=bad).status_code in (400, 422)


@pytest.mark.parametrize(
    ("outcome", "status"), [("suspect", "suspect"), ("retired", "retired"), ("resurvey", "suspect"), ("none", "active")]
)
def test_approving_changes_the_marker_with_its_history(
    server: LiveServer, owner: httpx.Client, outcome: str, status: str
) -> None:
    marker = _plate(owner, 10.0 + sum(map(ord, outcome)) / 10_000)
    item_id = _item(server, owner, marker["id"])
    body = {"outcome": outcome, "note": "seen by the patrol"}
    if status != "active":
        stale = owner.post(f"/v1/maintenance/{item_id}/approve", json=body, headers={"If-Match": '"7"'})
        assert stale.status_code == 412
        assert owner.get(f"/v1/maintenance/{item_id}").json()["status"] == "open"
    answer = owner.post(f"/v1/maintenance/{item_id}/approve", json=body, headers={"If-Match": '"1"'})
    assert answer.status_code == 200, answer.text
    decided = answer.json()
    assert (decided["status"], decided["outcome"], decided["note"]) == ("approved", outcome, "seen by the patrol")
    changed = owner.get(f"/v1/markers/{marker['id']}").json()
    assert changed["status"] == status
    versions = owner.get(f"/v1/markers/{marker['id']}/versions").json()["items"]
    assert len(versions) == (1 if status == "active" else 2)
    if status != "active":
        assert "moved" in versions[-1]["why"]
    again = owner.post(f"/v1/maintenance/{item_id}/reject", json={"reason": "no"})
    assert again.status_code == 409
    actions = [entry["action"] for entry in owner.get("/v1/audit").json()["items"] if entry["subject"] == item_id]
    assert actions == ["maintenance.approved"]


def test_dismissing_needs_a_reason_and_stays_in_the_list(server: LiveServer, owner: httpx.Client) -> None:
    marker = _plate(owner, 11.0)
    item_id = _item(server, owner, marker["id"])
    assert owner.post(f"/v1/maintenance/{item_id}/reject", json={}).status_code == 422
    answer = owner.post(f"/v1/maintenance/{item_id}/reject", json={"reason": "surveyed again, stands right"})
    assert answer.json()["status"] == "rejected"
    found = owner.get("/v1/maintenance", params={"marker_id": marker["id"], "status": "rejected"}).json()["items"]
    assert found[0]["note"] == "surveyed again, stands right"
    assert owner.get(f"/v1/markers/{marker['id']}").json()["status"] == "active"
    assert _item(server, owner, marker["id"]) != item_id  # new evidence is a new item


def test_items_are_events(server: LiveServer, owner: httpx.Client) -> None:
    marker = _plate(owner, 12.0)
    item_id = _item(server, owner, marker["id"])
    owner.post(f"/v1/maintenance/{item_id}/approve", json={"outcome": "none"})
    with server.app.state.database.read() as connection:
        events = list_events(connection, _agency_id(server, owner), limit=1000)
    own = [event for event in events if event.subject_id == item_id]
    assert [event.kind for event in own] == ["maintenance.opened", "maintenance.decided"]
    assert own[0].detail is not None
    assert own[0].detail["what"] == "moved"
    assert "vehicle" not in str(own[0].detail)


def test_a_planned_or_retired_marker_is_no_suspect(server: LiveServer, owner: httpx.Client) -> None:
    for number, status in enumerate(("planned", "retired")):
        marker = _plate(owner, 13.0 + number / 100, status=status)
        with pytest.raises(IndexError):
            _item(server, owner, marker["id"])


def test_other_agencies_and_viewers(server: LiveServer, owner: httpx.Client) -> None:
    item_id = _item(server, owner, _plate(owner, 14.0)["id"])
    with server.agency("others", Scope.ADMIN) as stranger:
        assert stranger.get("/v1/maintenance").json() == {"items": []}
        assert stranger.get(f"/v1/maintenance/{item_id}").status_code == 404
        assert stranger.post(f"/v1/maintenance/{item_id}/approve", json={"outcome": "none"}).status_code == 404
        assert stranger.get("/ogc/collections/maintenance/items").json()["features"] == []
    with server.agency("others again", Scope.VIEWER) as viewer:
        assert viewer.get("/v1/maintenance").status_code == 200
        assert viewer.post(f"/v1/maintenance/{item_id}/approve", json={"outcome": "none"}).status_code == 403


def test_a_marker_without_passes_has_no_ratios(owner: httpx.Client) -> None:
    marker = _plate(owner, 15.0)
    health = owner.get(f"/v1/markers/{marker['id']}/health").json()
    assert (health["passes"], health["ratios"], health["last_at"]) == (0, {}, None)
    assert health["limits"]["missing"] == pytest.approx(13.122, abs=0.001)
    assert health["limits"]["moved"] == pytest.approx(8.517, abs=0.001)


def test_a_stretch_whose_markers_are_all_shifted_is_an_item_without_a_marker(
    server: LiveServer, owner: httpx.Client
) -> None:
    def drive(vehicles: range) -> list[dict[str, Any]]:
        with server.app.state.database.write() as connection:
            for number in vehicles:
                drive_shifted_stretch(connection, _agency_id(server, owner), f"v{number}", north_m=1.0)
        items: list[dict[str, Any]] = owner.get("/v1/maintenance?road=S7&status=open").json()["items"]
        return items

    assert drive(range(2)) == []
    (item,) = drive(range(2, 6))
    assert (item["what"], item["marker_id"], item["family"]) == ("shifted", None, "cerpm")
    assert (item["road"], item["measure_m"], item["vehicles"]) == ("S7", 1500.0, 6)
    evidence = item["evidence"]
    assert evidence["offset_north_m"] == pytest.approx(1.0, abs=0.2)
    assert evidence["offset_sigma_north_m"] < 0.3 < 5.0 < evidence["offset_sigma_east_m"]
    assert "Check the datum" in evidence["check"]
    assert "Only one direction" in evidence["check"]
    assert 1 < len(evidence["uploads"]) <= 5
    path = f"/v1/maintenance/{item['id']}/approve"
    assert owner.post(path, json={"outcome": "suspect"}).status_code == 409
    assert owner.post(path, json={"outcome": "none"}).status_code == 200
    assert drive(range(6, 8)) == []  # the test starts again
    assert len(drive(range(8, 12))) == 1
