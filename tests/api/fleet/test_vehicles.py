"""/v1/vehicles over real HTTP, on both databases."""

from __future__ import annotations

from typing import Any

import httpx
import pytest

from app.services.access.access import Scope
from tests.conftest import LiveServer
from tests.http import created, refused

pytestmark = pytest.mark.both_databases

CAMERA = {
    "width_px": 1920, "height_px": 1080, "fx_px": 1371.0, "fy_px": 1372.0, "cx_px": 959.5, "cy_px": 539.5,
    "distortion": [-0.1, 0.01, 0.0, 0.0], "height_m": 1.4, "depression_deg": 10.0, "readout_s": 0.02,
}  # fmt: skip
PROFILE: dict[str, Any] = {
    "camera": CAMERA,
    "trace": {"axes": "FRD", "unit": "uT", "bar": {"forward_m": 0.4}, "rate_hz": 350.0},
    "packets": {
        "receiver": {"sensitivity_dbm": -129.0, "antenna_height_m": 1.6},
        "poses": {"forward_m": 0.9, "left_m": 0.1, "accuracy_m": 0.5},
    },
}


def _new_vehicle(client: httpx.Client, **body: Any) -> dict[str, Any]:
    return created(client, "/v1/vehicles", **{"name": "BUS-7", "profile": PROFILE} | body)


@pytest.mark.slow
def test_a_vehicle_is_added_read_changed_and_retired(client: httpx.Client) -> None:
    answer = client.post("/v1/vehicles", json={"name": "BUS-7", "note": "yellow", "profile": PROFILE})
    vehicle = answer.json()
    assert answer.status_code == 201, answer.text
    path = answer.headers["location"]
    assert answer.headers["etag"] == '"1"'
    assert path == f"/v1/vehicles/{vehicle['id']}"
    assert vehicle["profile"] == PROFILE
    assert (vehicle["status"], vehicle["uploads"], vehicle["driven_km"], vehicle["keys"]) == ("active", 0, 0.0, [])
    assert client.get(path).json() == vehicle
    patch = {"profile": {"trace": {"axes": "FLU", "unit": "nT"}, "packets": None}, "reason": "new bar"}
    changed = client.patch(path, json=patch, headers={"If-Match": '"1"'})
    assert changed.status_code == 200, changed.text
    assert changed.headers["etag"] == '"2"'
    assert changed.json()["profile"] == {"camera": CAMERA, "trace": {"axes": "FLU", "unit": "nT"}}
    assert changed.json()["note"] == "yellow"
    assert client.delete(path, headers={"If-Match": '"2"'}).status_code == 204
    assert client.get(path).json()["status"] == "retired"
    assert client.delete(path, headers={"If-Match": "*"}).status_code == 204
    history = client.get(f"{path}/versions").json()["items"]
    assert [(entry["version"], entry["why"]) for entry in history] == [(1, None), (2, "new bar"), (3, "retired")]
    assert history[0]["vehicle"]["profile"] == PROFILE
    first = client.get(f"{path}/versions", params={"limit": 1})
    assert "after=1" in first.headers["link"]


def test_a_change_needs_the_version_that_it_is_based_on(client: httpx.Client) -> None:
    path = f"/v1/vehicles/{_new_vehicle(client)['id']}"
    for method in ("PATCH", "DELETE"):
        body = {"json": {"note": "x"}} if method == "PATCH" else {}
        refused(client.request(method, path, **body), 428, "version-required", field="If-Match")  # type: ignore[arg-type]
        stale = client.request(method, path, headers={"If-Match": '"9"'}, **body)  # type: ignore[arg-type]
        refused(stale, 412, "stale-version", field="If-Match")
    assert client.get(path).json()["version"] == 1


def test_pages_follow_one_another(client: httpx.Client) -> None:
    made = [_new_vehicle(client, name=f"car {k}")["id"] for k in range(5)]
    seen, url = [], "/v1/vehicles?limit=2"
    while url:
        page = client.get(url)
        seen += [vehicle["id"] for vehicle in page.json()["items"]]
        url = page.headers["link"].partition("<")[2].partition(">")[0] if "link" in page.headers else ""
    assert seen == made
    client.delete(f"/v1/vehicles/{made[0]}", headers={"If-Match": "*"})
    assert len(client.get("/v1/vehicles", params={"status": "active"}).json()["items"]) == 4
    for limit in (0, 10**9):
        assert client.get("/v1/vehicles", params={"limit": limit}).status_code == 422


def test_a_name_is_given_once_in_an_agency(client: httpx.Client, server: LiveServer) -> None:
    vehicle = _new_vehicle(client)
    refused(client.post("/v1/vehicles", json={"name": "BUS-7"}), 409, "conflict", field="name")
    other = _new_vehicle(client, name="BUS-8")
    renamed = client.patch(f"/v1/vehicles/{other['id']}", json={"name": "BUS-7"}, headers={"If-Match": "*"})
    refused(renamed, 409, "conflict", field="name")
    with server.agency("another fleet") as stranger:
        unknown = "019cb624-0000-7000-8000-00000000aaaa"
        theirs = stranger.get(f"/v1/vehicles/{vehicle['id']}")
        nobodys = stranger.get(f"/v1/vehicles/{unknown}")
        assert theirs.status_code == nobodys.status_code == 404
        assert theirs.json()["detail"] == nobodys.json()["detail"].replace(unknown, vehicle["id"])
        change = stranger.patch(f"/v1/vehicles/{vehicle['id']}", json={"note": "mine"}, headers={"If-Match": "*"})
        refused(change, 404, "not-found")
        assert stranger.get("/v1/vehicles").json() == {"items": []}


def test_a_repeated_request_adds_one_vehicle(client: httpx.Client) -> None:
    key = {"Idempotency-Key": "one"}
    first = client.post("/v1/vehicles", json={"name": "A"}, headers=key)
    again = client.post("/v1/vehicles", json={"name": "A"}, headers=key)
    assert again.json() == first.json()
    assert again.headers["idempotency-replayed"] == "true"
    assert len(client.get("/v1/vehicles").json()["items"]) == 1


def _without(camera: dict[str, Any], *names: str) -> dict[str, Any]:
    return {name: value for name, value in camera.items() if name not in names}


@pytest.mark.parametrize(
    ("profile", "field"),
    [
        ({"camera": _without(CAMERA, "fx_px")}, "profile.camera.fx_px"),
        ({"camera": _without(CAMERA, "width_px")}, "profile.camera.width_px"),
        ({"camera": CAMERA | {"horizontal_fov_deg": 70.0}}, "profile.camera.fx_px"),
        ({"camera": CAMERA | {"height_m": 0.0}}, "profile.camera.height_m"),
        ({"camera": CAMERA | {"distortion": [0.1] * 3}}, "profile.camera.distortion"),
        ({"camera": CAMERA | {"readout_s": -1}}, "profile.camera.readout_s"),
        ({"camera": CAMERA | {"colour": "red"}}, "profile.camera.colour"),
        ({"thermal_range": [1.0, 2.0]}, "profile.thermal_range"),
        ({"trace": {"reach_m": 1e9}}, "profile.trace.reach_m"),
        ({"trace": {"bar": {"sensors": [{"position_m": [0, 0, 0]}] * 3}}}, "profile.trace.bar.positions_m"),
        ({"packets": {"receiver": {"antenna_height_m": 0}}}, "profile.packets.receiver.antenna_height_m"),
        ({"packets": {"poses": {"forward_m": 1e6}}}, "profile.packets.poses.forward_m"),
        ({"coarse_position": {}}, "profile.coarse_position"),
        ([], "profile"),
    ],
)
def test_a_profile_that_cannot_be_used_is_refused(client: httpx.Client, profile: Any, field: str) -> None:
    refused(client.post("/v1/vehicles", json={"name": "A", "profile": profile}), 422, "invalid-parameter", field=field)
    vehicle = _new_vehicle(client, profile={})
    patch = client.patch(f"/v1/vehicles/{vehicle['id']}", json={"profile": profile}, headers={"If-Match": '"1"'})
    refused(patch, 422, "invalid-parameter", field=field)


@pytest.mark.parametrize(
    ("body", "field"),
    [
        ('{"name": ""}', "name"),
        ('{"name": " A"}', "name"),
        ('{"name": "a\\u0007b"}', "name"),
        ('{"name": "019cb624-0000-7000-8000-00000000aaaa"}', "name"),
        (f'{{"name": "{"x" * 81}"}}', "name"),
        ('{"profile": {}}', "name"),
        ('{"name": "A", "profile": {"camera": {"height_m": NaN}}}', "body.profile.camera.height_m"),
        ('{"name": "A", "profile": {"camera": {"width_px": 123456789012345678901234}}}', "body"),
        ('{"name": "\\ud800"}', "body.name"),
        ('{"name": "A\\u0000"}', "body.name"),
        ('{"name": "A", "name": "B"}', "name"),
        ('{"name": "A", "profile": ' + '{"trace":' * 60 + "{}" + "}" * 60 + "}", None),
        ("[]", "body"),
    ],
)
def test_a_bad_body_is_a_problem(client: httpx.Client, body: str, field: str | None) -> None:
    answer = client.post("/v1/vehicles", content=body, headers={"Content-Type": "application/json"})
    assert answer.status_code in (400, 422), answer.text
    if field is not None:
        assert answer.json()["field"] == field, answer.text
    assert client.get("/v1/vehicles").json() == {"items": []}


def test_keys_speak_for_one_vehicle(server: LiveServer) -> None:
    with server.agency("keys of a fleet", Scope.ADMIN) as admin:
        vehicle, other = _new_vehicle(admin, name="A"), _new_vehicle(admin, name="B")
        access = server.app.state.use_cases.access
        caller = access.authenticate(access.create_key("keys of a fleet", Scope.VEHICLE, "on board"))
        path = f"/v1/vehicles/{vehicle['id']}/keys/{caller.key_id}"
        for _ in range(2):  # a second time changes nothing
            linked = admin.put(path)
            assert linked.status_code == 200, linked.text
            [key] = linked.json()["keys"]
            assert (key["label"], key["scope"]) == ("on board", "vehicle")
        assert admin.get("/v1/vehicles").json()["items"][0]["keys"] == [key]
        refused(admin.put(f"/v1/vehicles/{other['id']}/keys/{caller.key_id}"), 409, "conflict", field="key_id")
        refused(admin.put(f"/v1/vehicles/{other['id']}/keys/none"), 404, "not-found", field="key_id")
        refused(admin.delete(f"/v1/vehicles/{other['id']}/keys/{caller.key_id}"), 404, "not-found", field="key_id")
        with server.agency("a third fleet", Scope.ADMIN) as stranger:
            own = _new_vehicle(stranger, name="A")
            refused(stranger.put(f"/v1/vehicles/{own['id']}/keys/{caller.key_id}"), 404, "not-found", field="key_id")
            refused(stranger.put(path), 404, "not-found", field="vehicle_id")
        assert admin.delete(path).status_code == 204
        assert admin.get(f"/v1/vehicles/{vehicle['id']}").json()["keys"] == []
        refused(admin.delete(path), 404, "not-found")
