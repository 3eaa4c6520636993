"""Editing features as QGIS does: OPTIONS, POST, PATCH, DELETE."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import httpx
import pytest

from app.services.access.access import Scope
from tests.api.ogc.test_features import ITEMS, MERCATOR, get, ids
from tests.conftest import LiveServer

pytestmark = pytest.mark.both_databases

SEND = {"Content-Type": "application/geo+json"}


def _feature(lon: float, lat: float, **properties: Any) -> dict[str, Any]:
    return {"type": "Feature", "geometry": {"type": "Point", "coordinates": [lon, lat]}, "properties": properties}


def _post_feature(client: httpx.Client, feature: dict[str, Any], **headers: str) -> str:
    response = client.post(ITEMS, json=feature, headers={**SEND, **headers})
    assert response.status_code == 201, response.text
    assert client.get(response.headers["location"]).status_code == 200
    return response.headers["location"].rsplit("/", 1)[1]


def test_options_say_what_the_key_may_do(server: LiveServer, client: httpx.Client) -> None:
    assert "POST" in client.options(ITEMS).headers["allow"]
    assert {"PUT", "PATCH", "DELETE"} <= set(client.options(f"{ITEMS}/x").headers["allow"].split(", "))
    assert "POST" not in client.options("/ogc/collections/marker_lines/items").headers["allow"]
    with server.agency("edit lookers", Scope.VIEWER) as reader:
        assert "POST" not in reader.options(ITEMS).headers["allow"]
        assert reader.post(ITEMS, json=_feature(1, 2), headers=SEND).status_code == 403


def test_a_marker_is_registered_changed_moved_and_deleted(client: httpx.Client) -> None:
    marker = _post_feature(client, _feature(31.5, 41.5, road="A7", epoch=2025.5, version=None))
    headers = {"Content-Type": "application/merge-patch+json"}
    change = {"properties": {"status": "surveyed", "survey_method": "RTK", "family": "plate"}}
    assert client.patch(f"{ITEMS}/{marker}", json=change, headers=headers).status_code == 204
    feature = get(client, f"{ITEMS}/{marker}")
    assert feature["properties"]["status"] == "surveyed"
    assert (feature["properties"]["survey_method"], feature["properties"]["epoch"]) == ("RTK", 2025.5)
    assert feature["geometry"]["coordinates"] == [31.5, 41.5]
    move = {"geometry": {"type": "Point", "coordinates": [31.6, 41.6, 7.5]}}
    assert client.patch(f"{ITEMS}/{marker}", json=move, headers=headers).status_code == 204
    feature = get(client, f"{ITEMS}/{marker}")
    assert feature["geometry"]["coordinates"] == [31.6, 41.6, 7.5]
    assert feature["properties"]["survey_method"] is None  # what was said of the old place is not said of the new one
    assert client.delete(f"{ITEMS}/{marker}").status_code == 204
    assert client.get(f"{ITEMS}/{marker}").status_code == 404
    assert marker in ids(get(client, "/ogc/collections/retired_markers/items"))
    assert len(client.get(f"/v1/markers/{marker}/versions").json()["items"]) == 4


@pytest.mark.parametrize("method", ["PUT", "PATCH", "DELETE"])
def test_an_outdated_if_match_is_refused(
    client: httpx.Client, method: str, place: Callable[[], dict[str, Any]]
) -> None:
    """Without If-Match these routes change any version, because GIS clients send none (docs/ogc.md)."""
    at = place()
    marker = _post_feature(client, _feature(at["lon_deg"], at["lat_deg"], road="A7"))
    url = f"{ITEMS}/{marker}"
    first = client.get(url)
    etag = first.headers["etag"]
    assert client.patch(url, json={"properties": {"road": "B9"}}, headers=SEND).status_code == 204
    after = client.get(url)

    def edit(if_match: str, **properties: Any) -> httpx.Response:
        whole = {} if method == "PATCH" else first.json()
        body = None if method == "DELETE" else {**whole, "properties": properties}
        return client.request(method, url, json=body, headers={**SEND, "If-Match": if_match})

    for properties in ({}, {"road": "C1"}):
        refused = edit(etag, **properties)
        assert (refused.status_code, refused.json()["field"]) == (412, "If-Match")
        assert client.get(url).json() == after.json()
    assert edit("yesterday").status_code == 422
    assert edit(after.headers["etag"], road="C1").status_code == 204
    assert edit("*", road="C2").status_code == (404 if method == "DELETE" else 204)


def test_a_put_replaces_what_a_marker_need_not_have(client: httpx.Client) -> None:
    survey = {"epoch": 2025.5, "survey_method": "RTK", "horizontal_rmse_m": 0.01, "check_points": 24, "surveyor": "Å"}
    marker = _post_feature(client, _feature(32.5, 42.5, road="A7", measure_m=5.0, status="surveyed", **survey))
    url = f"{ITEMS}/{marker}"
    original = client.get(f"/v1/markers/{marker}").json()["position"]["original"]
    whole = get(client, url)
    same = {name: whole[name] for name in ("type", "id", "geometry", "properties")}
    assert client.put(url, json=same, headers=SEND).status_code == 204
    assert client.get(f"/v1/markers/{marker}").json()["position"]["original"] == original
    slim = _feature(32.5, 42.5, road="A8", **survey)
    assert client.put(url, json=slim, headers=SEND).status_code == 204
    properties = get(client, url)["properties"]
    assert (properties["road"], properties["measure_m"], properties["status"]) == ("A8", None, "surveyed")
    assert (properties["survey_method"], properties["code"]) == ("RTK", whole["properties"]["code"])
    assert client.put(url, json=_feature(32.6, 42.5), headers=SEND).status_code == 204
    moved = get(client, url)
    assert moved["geometry"]["coordinates"] == [32.6, 42.5]
    assert (moved["properties"]["survey_method"], moved["properties"]["road"]) == (None, None)
    refused = client.put(url, json=_feature(32.6, 42.5, code="0" * 12), headers=SEND)
    assert refused.status_code == 422
    nowhere = client.put(url, json={"type": "Feature", "geometry": None, "properties": {}}, headers=SEND)
    assert (nowhere.status_code, nowhere.json()["errors"][0]["field"]) == (422, "geometry")
    assert client.put(f"{ITEMS}/{'0' * 8}-0000-7000-8000-{'0' * 12}", json=slim, headers=SEND).status_code == 404


def test_a_cerpm_in_web_mercator(client: httpx.Client) -> None:
    feature = _feature(556597.4539663679, 5621521.486192066, family="cerpm", code="17", side="left")
    marker = _post_feature(client, feature, **{"Content-Crs": f"<{MERCATOR}>"})
    stored = get(client, f"{ITEMS}/{marker}")
    assert stored["geometry"]["coordinates"] == pytest.approx([5.0, 45.0], abs=1e-9)
    assert (stored["properties"]["code"], stored["properties"]["side"]) == ("17", "left")


BAD = {
    "magnet": (_feature(1, 2, family="magnet"), 422),
    "another family": (_feature(1, 2, family="balise"), 422),
    "unknown property": (_feature(1, 2, colour="red"), 422),
    "off the earth": (_feature(181, 2), 422),
    "huge": (_feature(1e300, 2), 422),
    "text": (_feature("1", 2), 422),  # type: ignore[arg-type]
    "no geometry": ({"type": "Feature", "geometry": None, "properties": {}}, 422),
    "a collection": ({"type": "FeatureCollection", "features": []}, 422),
    "a list": ([], 422),
    "bad number": (_feature(1, 2, family="cerpm", code="9" * 24), 422),
    "bad status": (_feature(1, 2, status="lost"), 422),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_features_are_refused(client: httpx.Client, name: str) -> None:
    body, status = BAD[name]
    response = client.post(ITEMS, json=body, headers=SEND)
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    assert ids(get(client)) == []


def test_bad_bodies_are_refused(client: httpx.Client) -> None:
    for raw in (b"{", b'{"type": NaN}', b'{"type": "\\ud800"}', b'{"type": "a\\u0000"}', b"[" * 5000, b'{"a":1,"a":2}'):
        assert client.post(ITEMS, content=raw, headers=SEND).status_code == 400, raw[:20]
    assert client.post(ITEMS, content=b"{}", headers={"Content-Type": "text/plain"}).status_code == 415


def test_one_agency_never_changes_anothers(server: LiveServer, client: httpx.Client) -> None:
    marker = _post_feature(client, _feature(33.5, 41.5))
    with server.agency("strangers to edits") as stranger:
        change = {"properties": {"status": "active"}}
        assert stranger.patch(f"{ITEMS}/{marker}", json=change, headers=SEND).status_code == 404
        assert stranger.delete(f"{ITEMS}/{marker}").status_code == 404
    assert get(client, f"{ITEMS}/{marker}")["properties"]["status"] == "planned"
    assert client.patch(f"{ITEMS}/{marker}", json={"properties": {"code": "1"}}, headers=SEND).status_code == 422
