"""Searches over HTTP: boxes, polygons, circles, the nearest, roads, and corridors along a line."""

from __future__ import annotations

import json
from typing import Any

import httpx
import pytest
from pyproj import Geod

from tests.conftest import LiveServer
from tests.http import refused

pytestmark = pytest.mark.both_databases

GEOD = Geod(ellps="WGS84")
SOME_ID = "019cb624-0000-7000-8000-00000000aaaa"


def _cerpm(lon_deg: float, lat_deg: float, **more: Any) -> dict[str, Any]:
    return {"family": "cerpm", "position": {"lon_deg": lon_deg, "lat_deg": lat_deg}, **more}


def _register(client: httpx.Client, *bodies: dict[str, Any]) -> list[str]:
    ids = []
    for body in bodies:
        answer = client.post("/v1/markers", json=body)
        assert answer.status_code == 201, answer.text
        ids.append(answer.json()["id"])
    return ids


def _found(answer: httpx.Response) -> list[str]:
    assert answer.status_code == 200, answer.text
    return [item["id"] for item in answer.json()["items"]]


@pytest.mark.slow
def test_boxes_span_the_antimeridian_when_their_west_is_above_their_east(client: httpx.Client) -> None:
    west, east, _other = _register(client, _cerpm(179.99, -16.5), _cerpm(-179.99, -16.5), _cerpm(0, -16.5))
    assert _found(client.get("/v1/markers?bbox=179.9,-17,-179.9,-16")) == [west, east]
    assert _found(client.post("/v1/markers/search", json={"bbox": [179.9, -17, -179.9, -16]})) == [west, east]
    assert _found(client.get("/v1/markers?bbox=-179.995,-17,179.9,-16")) == [east, _other]
    problem = refused(client.get("/v1/markers?bbox=8,50,9,49"), 422, field="bbox")
    assert "south" in problem["detail"]


def test_the_nearest_come_in_the_order_of_their_geodesic_distance(client: httpx.Client) -> None:
    spots = [GEOD.fwd(179.9999, -16.5, azimuth, metres)[:2] for azimuth, metres in [(80, 300), (260, 20), (90, 40)]]
    far, near, over = _register(client, *(_cerpm(*spot) for spot in spots))
    answer = client.get("/v1/markers?near=179.9999,-16.5&nearest=2")
    assert _found(answer) == [near, over]
    assert [item["distance_m"] for item in answer.json()["items"]] == pytest.approx([20, 40], abs=1e-6)
    assert "link" not in answer.headers
    assert _found(client.get("/v1/markers?near=179.9999,-16.5&nearest=9&radius_m=30")) == [near]
    body = {"near": {"lon_deg": 179.9999, "lat_deg": -16.5}, "nearest": 5}
    assert _found(client.post("/v1/markers/search", json=body)) == [near, over, far]
    assert _found(client.post("/v1/markers/search", json={**body, "family": "plate"})) == []
    assert _found(client.get("/v1/markers?near=0,90&nearest=1")) == [far]


def test_a_circle_is_paged_in_the_order_of_ids(client: httpx.Client) -> None:
    ids = _register(client, *(_cerpm(*GEOD.fwd(8.4, 49.0, 90, metres)[:2]) for metres in (150, 50, 100, 250)))
    answer = client.get("/v1/markers?near=8.4,49&radius_m=200&limit=2")
    assert _found(answer) == ids[:2]
    assert [item["distance_m"] for item in answer.json()["items"]] == pytest.approx([150, 50], abs=1e-6)
    rest = client.get(answer.links["next"]["url"])
    assert _found(rest) == [ids[2]]
    assert "next" not in rest.links
    assert _found(client.get("/v1/markers?near=8.4,49,200")) == ids[:3]


def test_polygons_with_holes_and_several(client: httpx.Client) -> None:
    inside, hole, island, _out = _register(
        client, _cerpm(10.1, 50.1), _cerpm(10.5, 50.5), _cerpm(12.05, 50.02), _cerpm(12.5, 50.5)
    )
    square = [[10, 50], [11, 50], [11, 51], [10, 51], [10, 50]]
    missing = [[10.4, 50.4], [10.4, 50.6], [10.6, 50.6], [10.6, 50.4], [10.4, 50.4]]
    small = [[12, 50], [12.1, 50], [12.1, 50.1], [12, 50]]
    polygon = {"type": "Polygon", "coordinates": [square, missing]}
    assert _found(client.post("/v1/markers/search", json={"polygon": polygon})) == [inside]
    several = {"type": "MultiPolygon", "coordinates": [[square], [small]]}
    assert _found(client.post("/v1/markers/search", json={"polygon": several})) == [inside, hole, island]
    wkt = "POLYGON((10 50, 11 50, 11 51, 10 51, 10 50))"
    assert _found(client.get("/v1/markers", params={"polygon": wkt})) == [inside, hole]
    first = client.post("/v1/markers/search?limit=2", json={"polygon": several})
    assert _found(client.post(first.links["next"]["url"], json={"polygon": several})) == [island]


SQUARE = [[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]]


@pytest.mark.parametrize(
    ("rings", "word"),
    [
        ([[[0, 0], [1, 1], [1, 0], [0, 1], [0, 0]]], "Self-intersection"),
        ([[[0, 0], [1, 0], [1, 1], [0, 1]]], "closed"),
        ([[[0, 0], [1, 0], [1, 91], [0, 0]]], "lat_deg"),
        ([[[-179, 0], [179, 0], [179, 1], [-179, 0]]], "half a turn"),
        ([SQUARE, [[5, 5], [6, 5], [6, 6], [5, 5]]], "Hole"),
        ([[[k / 6000, 0] for k in range(6000)] + [[1 - k / 6000, 1] for k in range(6000)] + [[0, 0]]], "12001"),
        ([[[0, 0], [0, 0], [0, 0], [0, 0]]], "not simple"),
    ],
)
def test_polygons_that_are_none_are_refused(client: httpx.Client, rings: list[Any], word: str) -> None:
    polygon = {"type": "Polygon", "coordinates": rings}
    field = "polygon.lat_deg" if word == "lat_deg" else "polygon"
    assert word in refused(client.post("/v1/markers/search", json={"polygon": polygon}), 422, field=field)["detail"]


@pytest.mark.parametrize(
    "wkt", ["POINT(1 2)", "POLYGON((0 0, 1", "x", "POLYGON EMPTY", "POLYGON((0 0, 1 nan, 1 1, 0 0))", "{}"]
)
def test_text_that_is_no_polygon_is_refused(client: httpx.Client, wkt: str) -> None:
    refused(client.get("/v1/markers", params={"polygon": wkt}), 422, field="polygon")


def test_roads_and_measures(client: httpx.Client) -> None:
    ids = _register(
        client,
        *(_cerpm(8.4, 49.0 + k / 1000, road="A 5", measure_m=k * 100.0) for k in range(4)),
        _cerpm(8.4, 49.1, road="A 6", measure_m=150.0),
    )
    assert _found(client.get("/v1/markers", params={"road": "A 5"})) == ids[:4]
    assert _found(client.get("/v1/markers", params={"road": "A 5", "from_m": 100, "to_m": 200})) == ids[1:3]
    body = {"road": "A 5", "from_m": 250}
    assert _found(client.post("/v1/markers/search", json=body)) == [ids[3]]
    refused(client.get("/v1/markers?from_m=3"), 422, field="road")


def test_code_status_and_family_narrow_together(client: httpx.Client) -> None:
    first, second = _register(client, _cerpm(8.4, 49, number=4711), _cerpm(8.4, 49.001, status="active"))
    assert _found(client.get("/v1/markers?code=4711&family=cerpm")) == [first]
    assert _found(client.get("/v1/markers?status=active&near=8.4,49,500")) == [second]
    assert _found(client.get("/v1/markers?code=4711&status=active")) == []


# --- along a line -------------------------------------------------------------------------------------------------


def _along(client: httpx.Client, line: list[Any], corridor_m: float, query: str = "", **more: Any) -> httpx.Response:
    body = {"along": {"geometry": {"type": "LineString", "coordinates": line}, "corridor_m": corridor_m}, **more}
    return client.post(f"/v1/markers/search{query}", json=body)


def test_markers_along_a_line_in_its_order_with_offsets(client: httpx.Client) -> None:
    start = (179.99, 60.0)
    end = GEOD.fwd(*start, 90, 5_000)[:2]
    assert end[0] < 0
    spots = []
    for metres, offset in [(4_000, 3.0), (100, -3.0), (2_500, 9.0), (2_000, 30.0)]:
        lon, lat, back = GEOD.fwd(*start, 90, metres)
        spots.append(GEOD.fwd(lon, lat, back + 180 - 90, offset)[:2])
    last, first, middle, _wide = _register(client, *(_cerpm(*spot) for spot in spots))
    beyond = GEOD.fwd(*end, GEOD.inv(*end, *start)[0] + 180, 5)[:2]
    _register(client, _cerpm(*beyond))
    answer = _along(client, [start, end], 20)
    assert _found(answer) == [first, middle, last]
    along = [item["along"] for item in answer.json()["items"]]
    assert [a["distance_m"] for a in along] == pytest.approx([100, 2_500, 4_000], abs=1e-6)
    assert [a["offset_m"] for a in along] == pytest.approx([-3, 9, 3], abs=1e-6)
    assert not any(a["ambiguous"] for a in along)
    assert _found(_along(client, [end, start], 20)) == [last, middle, first]
    pages = [_along(client, [start, end], 20, "?limit=1")]
    while "next" in pages[-1].links:
        after = pages[-1].links["next"]["url"].rpartition("?")[2]
        pages.append(_along(client, [start, end], 20, f"?{after}"))
    assert [marker_id for page in pages for marker_id in _found(page)] == [first, middle, last]
    assert _found(_along(client, [start, end], 20, family="plate")) == []


@pytest.mark.parametrize(
    ("line", "corridor_m", "field"),
    [
        ([[0, 0], [0, 0]], 5, "along.geometry"),
        ([[0, 0], [1, 0]], 5, "along.geometry"),
        ([[0, 0], [0, 99]], 5, "along.geometry.lat_deg"),
        ([[0, 0], [0.01, 0]], 0, "along.corridor_m"),
        ([[0, 0]], 5, "along.geometry.coordinates"),
    ],
)
def test_lines_that_are_none_are_refused(client: httpx.Client, line: list[Any], corridor_m: float, field: str) -> None:
    refused(_along(client, line, corridor_m), 422, field=field)


@pytest.mark.parametrize(
    ("query", "field"),
    [
        ("near=8,49", "near"),
        ("nearest=3", "near"),
        ("radius_m=3", "near"),
        ("near=8,49,5&radius_m=5", "near"),
        ("near=8,49,5,6&nearest=1", "near"),
        ("near=nan,49,5", "near.lon_deg"),
        ("near=8,inf,5", "near.lat_deg"),
        ("near=8,49,nan", "near"),
        ("near=8,49&radius_m=nan", "radius_m"),
        ("near=8,49&radius_m=1e9", "radius_m"),
        ("near=8,49&nearest=0", "nearest"),
        ("near=8,49&nearest=1000000000", "nearest"),
        ("near=8,49&nearest=123456789012345678901234", "nearest"),
        ("near=8,49&nearest=1&after=019cb624-0000-7000-8000-00000000aaaa", "after"),
        ("bbox=1,2,3", "bbox"),
        ("bbox=1,2,3,nan", "bbox.lat_deg"),
        ("road=x&from_m=inf", "from_m"),
        ("road=%00", "road"),
        ("limit=0", "limit"),
        ("limit=1000000000", "limit"),
    ],
)
def test_queries_that_cannot_be_are_refused(client: httpx.Client, query: str, field: str) -> None:
    refused(client.get(f"/v1/markers?{query}"), 422, field=field)


@pytest.mark.parametrize("after", ["x", "1,2", f"nan,{SOME_ID}", f"1e999,{SOME_ID}"])
def test_cursors_of_other_searches_are_refused(client: httpx.Client, after: str) -> None:
    refused(_along(client, [[0, 0], [0.01, 0]], 5, f"?after={after}"), 422, field="after")
    refused(client.post(f"/v1/markers/search?after={after}", json={}), 422, field="after")


@pytest.mark.parametrize("body", ['{"bbox": [1, 2, 3, 1e999]}', '{"road": "\\ud800"}', '{"near": ' + "[" * 5000])
def test_bodies_that_cannot_be_read_are_refused(client: httpx.Client, body: str) -> None:
    answer = client.post("/v1/markers/search", content=body, headers={"Content-Type": "application/json"})
    assert answer.status_code == 400
    assert json.loads(answer.text)["cure"]


def test_nobody_finds_anothers_markers(client: httpx.Client, server: LiveServer) -> None:
    _register(client, _cerpm(8.4, 49))
    with server.agency("somebody who searches") as other:
        assert _found(other.get("/v1/markers?near=8.4,49&nearest=5")) == []
        assert _found(_along(other, [[8.39, 49], [8.41, 49]], 50)) == []
        polygon = {"type": "Polygon", "coordinates": [[[8, 48], [9, 48], [9, 50], [8, 48]]]}
        assert _found(other.post("/v1/markers/search", json={"polygon": polygon})) == []
