"""CERPMs in the registry, over HTTP."""

from __future__ import annotations

from typing import Any

import httpx
import pytest

from tests.conftest import LiveServer, Place

pytestmark = pytest.mark.both_databases


def cerpm(place: dict[str, Any], **more: Any) -> dict[str, Any]:
    """A marker to register."""
    return {"family": "cerpm", "position": {**place, "horizontal_rmse_m": 0.02, "height_m": 20.0}, **more}


@pytest.mark.slow
def test_a_marker_is_registered_read_listed_and_found_by_its_number(client: httpx.Client, place: Place) -> None:
    at = place()
    limit = {"value": 25, "unit": "mph"}
    made = client.post("/v1/markers", json=cerpm(at, side="left", speed_limit=limit, status="surveyed"))
    assert made.status_code == 201, made.text
    marker = made.json()
    assert (marker["code"]["number"], marker["side"], marker["speed_limit"]) == (1, "left", limit)
    assert marker["radio"]["spreading_factor"] == 7
    assert client.get(made.headers["location"]).json() == marker
    assert client.get("/v1/markers", params={"family": "cerpm", "code": "1"}).json()["items"] == [marker]


def test_numbers_are_given_in_order_and_never_twice(client: httpx.Client, place: Place) -> None:
    first = client.post("/v1/markers", json=cerpm(place(), number=41)).json()
    assert client.post("/v1/markers", json=cerpm(place())).json()["code"]["number"] == 42
    taken = client.post("/v1/markers", json=cerpm(place(), number=41))
    assert taken.status_code == 409
    assert taken.json()["field"] == "number"
    assert first["id"] in taken.text
    retired = client.patch(f"/v1/markers/{first['id']}", json={"status": "retired"}, headers={"If-Match": "*"})
    assert retired.status_code == 200
    assert client.post("/v1/markers", json=cerpm(place(), number=41)).status_code == 409


def test_another_agency_has_numbers_of_its_own(server: LiveServer, client: httpx.Client, place: Place) -> None:
    assert client.post("/v1/markers", json=cerpm(place(), number=7)).status_code == 201
    with server.agency("an agency with the same number") as other:
        made = other.post("/v1/markers", json=cerpm(place(), number=7))
        assert made.status_code == 201
        assert client.get(f"/v1/markers/{made.json()['id']}").status_code == 404


def test_what_is_said_can_be_changed(client: httpx.Client, place: Place) -> None:
    made = client.post(
        "/v1/markers",
        json=cerpm(place(), side="left", line="northbound 1 left", speed_limit={"value": 25, "unit": "mph"}),
    ).json()
    path, new_limit = f"/v1/markers/{made['id']}", {"value": 30, "unit": "km/h"}
    patch = {"speed_limit": new_limit, "side": "right", "radio": {"interval_s": 5.0}, "dev_eui": "00A1B2C3D4E5F607"}
    changed = client.patch(path, json=patch, headers={"If-Match": '"1"'})
    assert changed.status_code == 200, changed.text
    assert changed.json()["speed_limit"] == new_limit
    assert changed.json()["side"] == "right"
    assert changed.json()["radio"]["interval_s"] == 5.0
    assert changed.json()["dev_eui"] == "00a1b2c3d4e5f607"
    assert (made["line"], changed.json()["line"]) == ("northbound 1 left", "northbound 1 left")
    assert changed.json()["code"] == made["code"]
    cleared = client.patch(path, json={"speed_limit": None}, headers={"If-Match": '"2"'})
    assert cleared.json()["speed_limit"] is None
    history = client.get(f"{path}/versions").json()["items"]
    assert [entry["marker"]["side"] for entry in history] == ["left", "right", "right"]


def test_a_plate_has_no_speed_limit_to_change(client: httpx.Client, place: Place) -> None:
    plate = client.post("/v1/markers", json={"position": place()}).json()
    patch = {"speed_limit": {"value": 30}}
    refused = client.patch(f"/v1/markers/{plate['id']}", json=patch, headers={"If-Match": "*"})
    assert refused.status_code == 422
    assert refused.json()["field"] == "speed_limit"


@pytest.mark.parametrize(
    ("more", "field"),
    [
        ({"number": 0}, "number"),
        ({"number": 2**32}, "number"),
        ({"number": "7"}, "number"),
        ({"side": "middle"}, "side"),
        ({"speed_limit": {"value": 0}}, "speed_limit.value"),
        ({"speed_limit": {"value": 256}}, "speed_limit.value"),
        ({"speed_limit": {"value": 30, "unit": "knots"}}, "speed_limit.unit"),
        ({"radio": {"spreading_factor": 13}}, "radio.spreading_factor"),
        ({"radio": {"bandwidth_hz": 200_000}}, "radio.bandwidth_hz"),
        ({"radio": {"interval_s": 0}}, "radio.interval_s"),
        ({"dev_eui": "12"}, "dev_eui"),
        ({"line": ""}, "line"),
        ({"position": {"lon_deg": 500.0, "lat_deg": 2.0}}, "position.lon_deg"),
        ({"position": {"lon_deg": 5.0, "lat_deg": 2.0, "height_m": 9000.0}}, "position.height_m"),
    ],
)
def test_what_does_not_fit_is_refused_with_its_field(
    client: httpx.Client, place: Place, more: dict[str, Any], field: str
) -> None:
    refused = client.post("/v1/markers", json={**cerpm(place()), **more})
    assert refused.status_code == 422, refused.text
    assert refused.json()["field"].endswith(field)
    assert refused.json()["limit"]
    assert client.get("/v1/markers", params={"family": "cerpm"}).json()["items"] == []


def test_an_unknown_member_of_the_radio_is_refused_with_the_nearest_known_one(
    client: httpx.Client, place: Place
) -> None:
    refused = client.post("/v1/markers", json=cerpm(place(), radio={"spreding_factor": 7}))
    assert (refused.status_code, refused.json()["field"]) == (422, "radio.spreding_factor")
    assert "did you mean spreading_factor?" in refused.json()["cure"]
