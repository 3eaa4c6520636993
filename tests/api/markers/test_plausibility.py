"""Warnings about a single marker's position: those of surveys, in the response, or as a refusal."""

from __future__ import annotations

from typing import Any

import httpx
import pytest

pytestmark = pytest.mark.both_databases

HERE = {"lon_deg": 8.4164, "lat_deg": 49.0051}
FRAME = {"realization": "ITRF2020", "epoch": 2026.4, "horizontal_rmse_m": 0.02}
WRONG: list[tuple[dict[str, Any], str, str]] = [
    ({"lon_deg": 49.0052, "lat_deg": 8.4165}, "swapped_axes", "position"),
    ({"height_m": 36_090.0}, "height_out_of_range", "position.height_m"),
    ({"horizontal_rmse_m": 12.0}, "coarse_accuracy", "position.horizontal_rmse_m"),
]


def _body(k: int, **position: Any) -> dict[str, Any]:
    here = {"lon_deg": HERE["lon_deg"] + k * 2e-4, "lat_deg": HERE["lat_deg"]}
    return {"code": {"scheme": "id"}, "position": here | FRAME | position}


@pytest.fixture
def registered(client: httpx.Client) -> dict[str, Any]:
    """A marker without warnings, though nothing is registered near it."""
    answer = client.post("/v1/markers", json=_body(0))
    assert (answer.status_code, "position_warnings" in answer.json()) == (201, False)
    marker: dict[str, Any] = answer.json()
    return marker


@pytest.mark.parametrize(("position", "code", "field"), WRONG)
def test_a_single_marker_gets_the_warnings_of_imports(
    client: httpx.Client, registered: dict[str, Any], position: dict[str, Any], code: str, field: str
) -> None:
    refused = client.post("/v1/markers", json=_body(1, **position), params={"warnings": "refuse"})
    answer = client.post("/v1/markers", json=_body(1, **position))
    assert answer.status_code == 201, answer.text
    [warning] = answer.json()["position_warnings"]
    assert (warning["code"], warning["field"]) == (code, field)
    assert warning["message"]
    assert warning["proposal"]
    assert refused.status_code == 422
    assert (refused.json()["field"], refused.json()["cure"]) == (field, warning["proposal"])
    assert "position_warnings" not in client.get(f"/v1/markers/{answer.json()['id']}").json()


def test_a_change_warns_of_the_new_position_and_not_of_itself(client: httpx.Client, registered: dict[str, Any]) -> None:
    path, headers = f"/v1/markers/{registered['id']}", {"If-Match": '"1"'}
    wrong = {"position": HERE | FRAME | {"height_m": 36_090.0}}
    refused = client.patch(path, json=wrong, headers=headers, params={"warnings": "refuse"})
    assert (refused.status_code, refused.json()["field"]) == (422, "position.height_m")
    moved = {"position": HERE | FRAME | {"lat_deg": HERE["lat_deg"] + 1e-7}}
    answer = client.patch(path, json=moved, headers=headers, params={"warnings": "refuse"})
    assert (answer.status_code, "position_warnings" in answer.json()) == (200, False)


def test_bulk_items_have_warnings_of_their_own(client: httpx.Client, registered: dict[str, Any]) -> None:
    items = [{"create": _body(k, **position)} for k, position in enumerate([{}] + [wrong for wrong, _, _ in WRONG], 3)]
    stored = client.post("/v1/markers/bulk", json={"items": items, "dry_run": True}).json()
    codes = [[warning["code"] for warning in item["warnings"]] for item in stored["results"]]
    assert codes == [[], ["swapped_axes"], ["height_out_of_range"], ["coarse_accuracy"]]
    refused = client.post("/v1/markers/bulk", json={"items": items, "mode": "good", "warnings": "refuse"})
    assert refused.status_code == 200, refused.text
    assert [item["status"] for item in refused.json()["results"]] == [201, 422, 422, 422]


def test_edits_of_features_name_the_warnings_in_a_header(client: httpx.Client, registered: dict[str, Any]) -> None:
    where = "/ogc/collections/markers/items"
    point = {"type": "Point", "coordinates": [49.0052, 8.4165]}
    properties = {"family": "cerpm", "side": "left", **FRAME}
    feature = {"type": "Feature", "geometry": point, "properties": properties}
    made = client.post(where, json=feature)
    assert (made.status_code, made.headers.get("Waymark-Warnings")) == (201, "swapped_axes")
    assert client.post(where, json=feature, headers={"Waymark-Warnings": "refuse"}).status_code == 422
    good = {**feature, "geometry": {"type": "Point", "coordinates": [8.4170, 49.0051]}}
    assert "Waymark-Warnings" not in client.post(where, json=good).headers


def test_projected_coordinates_are_read_in_other_zones(client: httpx.Client, registered: dict[str, Any]) -> None:
    position = {"crs": "EPSG:32631", "easting_m": 457_300.0, "northing_m": 5_428_000.0, **FRAME}
    answer = client.post("/v1/markers", json={"code": {"scheme": "id"}, "position": position})
    assert answer.status_code == 201, answer.text
    [warning] = answer.json()["position_warnings"]
    assert warning["code"] == "wrong_zone"
    assert "EPSG:32632" in warning["proposal"]


def test_an_unknown_vertical_datum_is_refused(client: httpx.Client) -> None:
    answer = client.post("/v1/markers", json=_body(0, height_m=160.0, vertical_datum="banana"))
    assert (answer.status_code, answer.json()["field"]) == (422, "position.vertical_datum")
    assert "EPSG:5703" in answer.json()["cure"]
    known = client.post("/v1/markers", json=_body(0, height_m=160.0, vertical_datum="DHHN2016"))
    assert known.json()["position"]["vertical_datum"] == "EPSG:7837"
