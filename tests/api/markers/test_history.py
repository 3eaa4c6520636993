"""Nothing is overwritten: versions with their kinds, single versions, and the registry as it was at a time."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from typing import Any

import httpx
import pytest

from app.registry import history
from app.services.access.access import Scope
from tests.conftest import LiveServer, Place
from tests.http import created

pytestmark = pytest.mark.both_databases

NOBODY = "00000000-0000-7000-8000-000000000000"


def _now() -> str:
    """A time that is after everything done before and before everything done later."""
    began = _next_tick(datetime.now(UTC))
    _next_tick(began)
    return began.isoformat()


def _next_tick(after: datetime) -> datetime:
    while (now := datetime.now(UTC)) <= after:
        pass
    return now


def _patch(client: httpx.Client, marker: dict[str, Any], **body: Any) -> dict[str, Any]:
    etag = {"If-Match": f'"{marker["version"]}"'}
    response = client.patch(f"/v1/markers/{marker['id']}", json=body, headers=etag)
    assert response.status_code == 200, response.text
    return dict(response.json())


def _kinds(client: httpx.Client, marker: dict[str, Any]) -> list[str]:
    return [entry["kind"] for entry in client.get(f"/v1/markers/{marker['id']}/versions").json()["items"]]


def test_kinds_follow_from_what_changes(client: httpx.Client, place: Place) -> None:
    spot = place()
    marker = created(client, "/v1/markers", position=spot)
    marker = _patch(client, marker, road="A 7")
    marker = _patch(client, marker, status="built")
    marker = _patch(client, marker, status="surveyed", position=spot | {"horizontal_rmse_m": 0.02})
    marker = _patch(client, marker, position=spot | {"horizontal_rmse_m": 0.01})
    marker = _patch(client, marker, status="suspect", reason="hit by a plough")
    assert _kinds(client, marker) == ["as-planned", "as-planned", "change", "as-built", "resurvey", "change"]
    assert _kinds(client, created(client, "/v1/markers", position=place(), status="surveyed")) == ["as-built"]


def test_a_kind_can_be_asked_for(client: httpx.Client, place: Place) -> None:
    spot = place()
    marker = created(client, "/v1/markers", position=spot, status="surveyed", kind="resurvey")
    marker = _patch(client, marker, position=spot, kind="correction", reason="wrong antenna height")
    marker = _patch(client, marker, road="A 8", kind="correction")
    marker = _patch(client, marker, position=spot, kind="as-built")
    assert _kinds(client, marker) == ["resurvey", "correction", "correction", "as-built"]


@pytest.mark.parametrize(
    ("change", "limit"),
    [
        ({"status": "active", "kind": "resurvey"}, "change or correction"),
        ({"road": "A 9", "kind": "as-planned"}, "change or correction"),
        ({"status": "planned", "kind": "as-built"}, "as-planned or correction"),
    ],
)
def test_a_kind_that_does_not_fit_is_refused(
    client: httpx.Client, place: Place, change: dict[str, Any], limit: str
) -> None:
    marker = created(client, "/v1/markers", position=place(), status="surveyed")
    response = client.patch(f"/v1/markers/{marker['id']}", json=change, headers={"If-Match": '"1"'})
    assert (response.status_code, response.json()["field"], response.json()["limit"]) == (422, "kind", limit)
    assert _kinds(client, marker) == ["as-built"]
    first = client.post("/v1/markers", json={"position": place(), "kind": "as-built"})
    assert (first.status_code, first.json()["limit"]) == (422, "as-planned")
    unknown = client.post("/v1/markers", json={"position": place(), "kind": "whatever"})
    assert unknown.status_code == 422


def test_every_version_can_be_read_by_its_number(client: httpx.Client, place: Place) -> None:
    first = created(client, "/v1/markers", position=place(), reason="plan 7")
    second = _patch(client, first, status="built", reason="truck 4")
    path = f"/v1/markers/{first['id']}/versions"
    assert [client.get(f"{path}/{n}").json() for n in (1, 2)] == client.get(path).json()["items"]
    assert client.get(f"{path}/1").json()["marker"] == first
    assert client.get(f"{path}/2").json()["marker"] == second
    assert client.get(f"{path}/2").json()["why"] == "truck 4"
    for number, status in (("3", 404), ("0", 422), ("x", 422), (str(2**31), 422), ("9" * 24, 422)):
        assert client.get(f"{path}/{number}").status_code == status


FILTERS: list[dict[str, Any]] = [
    {},
    {"status": "surveyed"},
    {"status": "planned"},
    {"road": "A 7"},
    {"road": "A 7", "from_m": 5.0, "to_m": 25.0},
    {"family": "plate"},
    {"family": "cerpm"},
    {"bbox": "-0.6,-0.5,0.55,0.5"},
    {"polygon": "POLYGON((-0.5 -0.5,0.5 -0.5,0.5 0.5,-0.5 -0.5))"},
    {"near": "0,0,30000"},
]


def _list(client: httpx.Client, **parameters: Any) -> list[dict[str, Any]]:
    page = client.get("/v1/markers", params=parameters)
    assert page.status_code == 200, page.text
    items = page.json()["items"]
    while "next" in page.links:
        page = client.get(page.links["next"]["url"])
        items += page.json()["items"]
    return list(items)


@pytest.mark.slow
@pytest.mark.parametrize("chunk", [1, 500])
def test_the_registry_as_it_was_is_what_was_listed_then(
    client: httpx.Client, monkeypatch: pytest.MonkeyPatch, chunk: int
) -> None:
    monkeypatch.setattr(history, "_CHUNK", chunk)
    monkeypatch.setattr(history, "MAX_REBUILT", 3 if chunk == 1 else 20_000)

    def spot(k: int) -> dict[str, Any]:
        return {"lon_deg": -0.75 + k / 8, "lat_deg": (-1) ** k * k / 20 + chunk / 1e5}

    began = _now()
    made = [created(client, "/v1/markers", position=spot(k), road="A 7", measure_m=float(k * 10)) for k in range(4)]
    made += [created(client, "/v1/markers", family="cerpm", position=spot(k)) for k in range(4, 6)]
    times = [_now()]
    listed = [[_list(client, **f) for f in FILTERS]]
    made[1] = _patch(client, made[1], status="surveyed", position=spot(9))
    made[2] = _patch(client, made[2], road="A 8", measure_m=None)
    made[4] = _patch(client, made[4], status="retired")
    made.append(created(client, "/v1/markers", position=spot(7), status="surveyed", road="A 7", measure_m=15))
    times.append(_now())
    listed.append([_list(client, **f) for f in FILTERS])
    made[1] = _patch(client, made[1], status="active", road="A 7", measure_m=24.5)
    made[6] = _patch(client, made[6], position=spot(12))
    made[0] = _patch(client, made[0], position=spot(11), status="surveyed")
    times.append(_now())
    listed.append([_list(client, **f) for f in FILTERS])
    assert len({len(lists[0]) for lists in listed}) == 2
    for at, lists in zip(times, listed, strict=True):
        for filtered, expected in zip(FILTERS, lists, strict=True):
            for limit in (1, 3, 100):
                assert _list(client, **filtered, as_of=at, limit=limit) == expected, (filtered, limit)
    assert _list(client, as_of=began) == []
    assert _list(client, as_of="2999-01-01T00:00:00Z") == listed[-1][0]


@pytest.mark.parametrize(
    "wrong",
    ["", "now", "2026-03-04", "2026-03-04T05:06:07", "0000-01-01T00:00:00Z", "2026-13-01T00:00:00Z", "1e400",
     "0001-01-01T00:00:00+14:00", "9999-12-31T23:59:59-01:00", "2026-03-04T05:06:07.1234567Z", "x" * 41],
)  # fmt: skip
def test_times_that_are_none_are_refused(client: httpx.Client, wrong: str) -> None:
    response = client.get("/v1/markers", params={"as_of": wrong})
    assert response.status_code == 422
    assert response.json()["field"] == "as_of"
    assert client.get("/v1/markers", params={"as_of": "2026-03-04t05:06:07.5+02:00"}).status_code == 200


def test_the_nearest_of_another_time_are_not_offered(client: httpx.Client) -> None:
    asked = {"as_of": "2026-03-04T05:06:07Z", "near": "7,50", "nearest": 3}
    response = client.get("/v1/markers", params=asked)
    assert (response.status_code, response.json()["field"]) == (422, "as_of")


WITHOUT_VERSION = {
    "PUT /v1/vehicles/{vehicle_id}/keys/{key_id}": "links, which are there or not",
    "DELETE /v1/vehicles/{vehicle_id}/keys/{key_id}": "links, which are there or not",
    "DELETE /v1/keys/{key_id}": "keys only end",
    "DELETE /v1/damage-reports/{report_id}/contact": "an address is there or not",
    "DELETE /v1/damage-reports/{report_id}/photo": "a photo is there or not",
    "DELETE /v1/drives/{drive_id}": "drives are jobs: a finished one does not change any more",
    "PATCH /v1/uploads/{upload_id}": "tus: Upload-Offset is what a part is based on",
    "DELETE /v1/uploads/{upload_id}": "tus: termination",
    "DELETE /v1/webhooks/{webhook_id}": "webhooks are not changed, only enabled and removed",
}


@pytest.mark.slow
def test_every_route_that_changes_something_asks_for_its_version(server: LiveServer, client: httpx.Client) -> None:
    """428 without If-Match; a route that is new has to answer it, or say above why not."""
    paths = client.get("/openapi.json").json()["paths"]
    changing = {f"{method.upper()} {path}" for path, operations in paths.items() for method in operations}
    changing = {route for route in changing if route.split()[0] in ("PATCH", "PUT", "DELETE") and "/v1/" in route}
    assert set(WITHOUT_VERSION) <= changing
    bodies: dict[str, Any] = {  # a body that is refused is refused first
        "/v1/vehicles/{vehicle_id}/calibration": {"calibration_id": NOBODY},
        "/v1/plans/{plan_id}": {"name": "q"},
        "/v1/public-page": {"fields": [], "damage_reports": False},
        "/v1/roads/{road_id}": {"calibration": []},
    }
    with server.agency("changes", Scope.ADMIN) as admin:
        for route in sorted(changing - set(WITHOUT_VERSION)):
            method, path = route.split()
            where = re.sub(r"{[a-z_]+}", NOBODY, path)
            body = bodies.get(path, {"reason": "why", "status": "retired"})
            response = admin.request(method, where, **({} if method == "DELETE" else {"json": body}))
            assert response.status_code == 428, (route, response.text)
            assert response.json()["field"] == "If-Match"
    marker = created(client, "/v1/markers", position={"lon_deg": -3.25, "lat_deg": 3.5})
    path = f"/v1/markers/{marker['id']}"
    assert client.patch(path, json={"status": "built"}, headers={"If-Match": '"2"'}).status_code == 412
    assert client.patch(path, json={"status": "built"}, headers={"If-Match": '"1"'}).status_code == 200
    assert client.patch(path, json={"status": "active"}, headers={"If-Match": '"1"'}).status_code == 412
