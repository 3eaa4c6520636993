"""Many markers in one request: results by row, all or nothing, versions, and repeated requests."""

from __future__ import annotations

import json
from typing import Any

import httpx
import pytest

from app.services.access.access import Scope
from app.services.markers.markers import Markers, Step
from tests.conftest import LiveServer, Place
from tests.http import refused

pytestmark = pytest.mark.both_databases


def _bulk(client: httpx.Client, *items: Any, headers: dict[str, str] | None = None, **more: Any) -> httpx.Response:
    return client.post("/v1/markers/bulk", json={"items": list(items), **more}, headers=headers)


def _create(place: Place, **more: Any) -> dict[str, Any]:
    return {"create": {"position": place(), **more}}


def _markers(client: httpx.Client) -> dict[str, dict[str, Any]]:
    return {item["id"]: item for item in client.get("/v1/markers?limit=1000").json()["items"]}


@pytest.mark.slow
def test_markers_of_several_families_are_registered_and_changed_together(client: httpx.Client, place: Place) -> None:
    first = client.post("/v1/markers", json={"position": place()}).json()
    change = {"id": first["id"], "version": 1, "change": {"status": "retired", "reason": "resurfaced"}}
    answer = _bulk(client, _create(place), _create(place, family="cerpm"), {"update": change})
    assert answer.status_code == 200, answer.text
    report = answer.json()
    assert (report["outcome"], report["created"], report["updated"], report["refused"]) == ("stored", 2, 1, 0)
    assert [result["status"] for result in report["results"]] == [201, 201, 200]
    stored = _markers(client)
    assert [stored[result["id"]]["version"] for result in report["results"]] == [1, 1, 2]
    assert [stored[result["id"]]["family"] for result in report["results"]] == ["plate", "cerpm", "plate"]
    assert client.get(f"/v1/markers/{first['id']}/versions").json()["items"][1]["why"] == "resurfaced"


def _mixed(client: httpx.Client, place: Place) -> list[Any]:
    """Good items at 0, 4 and 6; every other has a fault of its own kind."""
    taken = client.post("/v1/markers", json={"position": place(), "code": {"scheme": "position"}}).json()
    spot = {name: taken["position"][name] for name in ("lon_deg", "lat_deg")}
    known = {"id": taken["id"], "change": {"heading_deg": 5.0}}
    return [
        _create(place),
        {"create": {"position": {"lon_deg": 8, "lat_deg": 91}}},
        {"create": {"position": spot, "code": {"scheme": "position"}}},
        {"create": {"position": place(), "colour": "red"}},
        {"update": {**known, "version": 1}},
        {"update": {**known, "version": 1}},
        _create(place, family="cerpm"),
        {"update": {**known, "version": 1, "id": "019cb624-0000-7000-8000-00000000aaaa"}},
        {"update": {**known, "version": 0}},
        {},
        [],
        {"create": {"position": place(), "family": "bollard"}},
        {"update": {**known, "version": 2, "change": {}}},
    ]


STATUSES = [201, 422, 409, 422, 200, 412, 201, 404, 422, 422, 422, 422, 422]
FIELDS = {
    1: "items.1.create.position.lat_deg",
    2: "items.2.create.position",
    3: "items.3.create.colour",
    5: "items.5.update.version",
    7: "items.7.update.id",
    8: "items.8.update.version",
    9: "items.9.create",
    10: "items.10",
    11: "items.11.create.family",
    12: "items.12.update.change.body",
}


def test_all_or_nothing_names_every_fault_and_stores_nothing(client: httpx.Client, place: Place) -> None:
    items = _mixed(client, place)
    before = _markers(client)
    answer = _bulk(client, *items)
    assert answer.status_code == 422
    problem = answer.json()
    assert problem["type"] == "urn:waymark:problem:bulk-refused"
    report = problem["report"]
    assert report["outcome"] == "refused"
    assert [result["status"] for result in report["results"]] == STATUSES
    for index, field in FIELDS.items():
        assert report["results"][index]["problem"]["field"] == field
        assert report["results"][index]["problem"]["detail"]
    assert report["results"][0]["id"] is None
    assert _markers(client) == before


def test_the_good_ones_are_accepted(client: httpx.Client, place: Place) -> None:
    items = _mixed(client, place)
    report = _bulk(client, *items, mode="good").json()
    assert (report["outcome"], report["created"], report["updated"], report["refused"]) == ("stored", 2, 1, 10)
    assert [result["status"] for result in report["results"]] == STATUSES
    stored = _markers(client)
    assert len(stored) == 3
    assert {report["results"][k]["id"] for k in (0, 4, 6)} == set(stored)
    assert stored[report["results"][4]["id"]]["heading_deg"] == 5.0
    assert _bulk(client, *items[1:4], mode="good").status_code == 422


def test_a_dry_run_says_the_same_and_stores_nothing(client: httpx.Client, place: Place) -> None:
    items = _mixed(client, place)
    before = _markers(client)
    answer = _bulk(client, *items, dry_run=True, headers={"Idempotency-Key": "dry"})
    assert answer.status_code == 200
    assert answer.json()["outcome"] == "checked"
    assert [result["status"] for result in answer.json()["results"]] == STATUSES
    assert _markers(client) == before
    assert "idempotency-replayed" not in _bulk(client, *items, dry_run=True, headers={"Idempotency-Key": "dry"}).headers


def test_the_same_code_twice_in_one_request_is_taken_the_second_time(client: httpx.Client, place: Place) -> None:
    spot = place()
    item = {"create": {"position": spot, "code": {"scheme": "position"}}}
    report = _bulk(client, item, item, mode="good").json()
    assert [result["status"] for result in report["results"]] == [201, 409]
    assert report["results"][1]["problem"]["type"] == "urn:waymark:problem:code-taken"


def test_a_repeated_request_gets_the_first_answer(client: httpx.Client, place: Place) -> None:
    item, headers = _create(place), {"Idempotency-Key": "bulk 1"}
    first = _bulk(client, item, headers=headers)
    again = _bulk(client, item, headers=headers)
    assert again.json() == first.json()
    assert again.headers["idempotency-replayed"] == "true"
    assert len(_markers(client)) == 1
    other = _bulk(client, _create(place), headers=headers)
    assert other.status_code == 409
    assert other.json()["type"] == "urn:waymark:problem:idempotency-conflict"


@pytest.mark.parametrize(
    ("body", "field"),
    [
        ({"items": []}, "items"),
        ({"items": [{}] * 1001}, "items"),
        ({"items": {}}, "items"),
        ({"items": [{}], "mode": "some"}, "mode"),
        ({"items": [{}], "dry_run": 1}, "dry_run"),
        ({}, "items"),
    ],
)
def test_requests_that_cannot_be_are_refused(client: httpx.Client, body: dict[str, Any], field: str) -> None:
    answer = client.post("/v1/markers/bulk", json=body)
    assert answer.status_code == 422
    assert (answer.json()["field"], answer.json()["type"]) == (field, "urn:waymark:problem:invalid-parameter")


@pytest.mark.slow
def test_a_thousand_items_fit(client: httpx.Client) -> None:
    items = [
        {"create": {"family": "cerpm", "position": {"lon_deg": 8 + k / 1e4, "lat_deg": 49.0}}} for k in range(1000)
    ]
    assert len(json.dumps({"items": items})) < 2**20
    report = _bulk(client, *items).json()
    assert (report["outcome"], report["created"]) == ("stored", 1000)


def test_surveyors_change_but_do_not_register(server: LiveServer, place: Place) -> None:
    name = "an agency with surveyors"
    with server.agency(name) as planner, server.agency(name, Scope.SURVEYOR) as surveyor:
        marker = planner.post("/v1/markers", json={"position": place()}).json()
        update = {"update": {"id": marker["id"], "version": 1, "change": {"status": "built"}}}
        assert _bulk(surveyor, update).json()["updated"] == 1
        assert _bulk(surveyor, _create(place)).status_code == 403
        with server.agency("a stranger to bulk") as stranger:
            result = _bulk(stranger, update, mode="good").json()["report"]["results"][0]
            assert result["status"] == 404


def test_more_magnets_than_a_request_takes_are_refused_before_any_is_placed(
    client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    def place(self: Markers, *_: object) -> Step:
        pytest.fail("a line was placed")

    monkeypatch.setattr(Markers, "prepare_new", place)
    lane = {"geometry": {"type": "LineString", "coordinates": [[8.0, 40.0], [8.05, 40.0]]}}
    line = {"family": "magnet", "lane": lane, "line": {"style": "solid", "spacing_m": 6.0}}
    projected = {**line, "lane": {"crs": "EPSG:25832", "points_m": [[456000, 5427000], [456000, 5431500]]}}
    problem = refused(_bulk(client, *[{"create": line}] * 7, *[{"create": projected}] * 7), 422, field="items")
    assert problem["limit"] == "10000 in one request"
    counted = int(problem["detail"].split()[4])
    assert counted == pytest.approx(7 * 4270 / 6 + 7 * 4500 / 6, rel=0.01)
