"""Alignments and plans as features: lanes as lines, planned markers as points."""

from __future__ import annotations

import itertools
import json
import os
import subprocess
from typing import Any

import httpx
import pytest
from pyproj import Geod

from app.services.access.access import Scope
from app.services.plans.tasks import _parts
from tests.api.ogc.test_features import MERCATOR, get, ids
from tests.api.plans.test_plans import road, send_road
from tests.conftest import LiveServer
from tests.http import WITHIN_S, created, refused
from tests.machine import require_tool
from tests.registry.test_tiles import read_tile

pytestmark = pytest.mark.both_databases

GEOD = Geod(ellps="WGS84")
LANES, PLANS = "/ogc/collections/alignments/items", "/ogc/collections/plans/items"
PLACES = itertools.count(1)
NAME = 'Ring "east" \\ <b> Zürich\u2028'
RULES: dict[str, Any] = {"version": 1, "plates": {"spacing_m": 100}, "lines": {}}


@pytest.fixture
def start() -> tuple[float, float]:
    """Where the road of a test begins."""
    return 11.0, 46.0 + next(PLACES) * 0.02


def make(client: httpx.Client, start: tuple[float, float], name: str = NAME, **rules: Any) -> dict[str, Any]:
    """A plan on 300 m of road to the east."""
    response = send_road(client, road(*start, length_m=300.0), name=name)
    assert response.status_code == 201, response.text
    body = {"name": name, "alignment_id": response.json()["id"], "rules": RULES | rules}
    return created(client, "/v1/plans", **body)


@pytest.mark.slow
def test_planned_markers_are_points_with_their_plan(client: httpx.Client, start: tuple[float, float]) -> None:
    plan = make(client, start)
    document = client.get(f"/v1/plans/{plan['id']}/files/plan.json").json()["markers"]
    page = get(client, PLANS)
    assert page["numberMatched"] == page["numberReturned"] == len(document)
    for feature, marker in zip(page["features"], document, strict=True):
        properties = feature["properties"]
        assert feature["id"] == f"{plan['id']}.{marker['number']:07d}"
        assert feature["geometry"] == {"type": "Point", "coordinates": [marker["lon_deg"], marker["lat_deg"]]}
        for name in ("number", "family", "code", "lane", "purpose"):
            assert properties[name] == marker[name], name
        for name in ("chainage_m", "station_m", "offset_m", "heading_deg"):
            assert properties[name] == pytest.approx(marker[name], abs=1e-4), name
        assert (properties["plan_id"], properties["plan"]) == (plan["id"], NAME)
        assert properties["status"] == plan["status"]
    schema = get(client, "/ogc/collections/plans/geojson-schema")["properties"]["properties"]["properties"]
    assert list(schema) == list(page["features"][0]["properties"])
    one = get(client, f"{PLANS}/{page['features'][7]['id']}")
    assert one["properties"] == page["features"][7]["properties"]
    assert client.get(f"{PLANS}/{plan['id']}").status_code == 404
    assert client.get(f"{PLANS}/{plan['id']}.9999999").status_code == 404
    assert [link["href"] for link in get(client, "/ogc/collections/plans")["links"] if "tilesets" in link["rel"]]


def test_plans_are_filtered_paged_and_counted(client: httpx.Client, start: tuple[float, float]) -> None:
    first = make(client, start, "first")
    second = make(client, (start[0] + 0.1, start[1]), "second", lines=None)
    everything = ids(get(client, PLANS))
    assert len(everything) == sum(first["counts"].values()) + sum(second["counts"].values())
    found, url = [], f"{PLANS}?limit=20"
    while url:
        page = client.get(url).json()
        found += ids(page)
        url = next((link["href"] for link in page["links"] if link["rel"] == "next"), "")
    assert found == everything
    count = first["counts"]["plate"] + second["counts"]["plate"]
    assert get(client, PLANS, family="plate", resultType="hits")["numberMatched"] == count
    assert get(client, PLANS, plan_id=second["id"], limit=1)["numberMatched"] == second["counts"]["plate"]
    assert len(ids(get(client, PLANS, plan="second", number=2))) == 1
    assert len(ids(get(client, PLANS, filter="plan = 'first' AND chainage_m > 150 AND side IS NULL"))) == 1
    assert len(ids(get(client, PLANS, status="checked"))) == len(everything)
    assert ids(get(client, PLANS, filter="status <> 'checked'")) == []
    box = f"{start[0] + 0.09},{start[1] - 0.01},{start[0] + 0.2},{start[1] + 0.01}"
    assert {i.partition(".")[0] for i in ids(get(client, PLANS, bbox=box))} == {second["id"]}
    assert ids(get(client, PLANS, datetime="../2020-01-01T00:00:00Z")) == []
    x, y = get(client, PLANS, crs=MERCATOR, limit=1)["features"][0]["geometry"]["coordinates"]
    assert (x, y) == pytest.approx((1_224_500, 5_800_000), abs=60_000)
    extent = get(client, "/ogc/collections/plans")["extent"]["spatial"]["bbox"][0]
    assert extent[:2] == pytest.approx(start, abs=0.01)
    refused(client.get(PLANS, params={"number": "x"}), 400, field="number")
    refused(client.get(PLANS, params={"road": "A7"}), 400, field="road")
    refused(client.post(PLANS, json={"type": "Feature"}), 422, field="collectionId")


def test_other_rules_and_names_change_the_features(client: httpx.Client, start: tuple[float, float]) -> None:
    plan = make(client, start)
    url = f"/v1/plans/{plan['id']}"
    client.patch(url, json={"name": "renamed"}, headers={"If-Match": '"1"'})
    assert {f["properties"]["plan"] for f in get(client, PLANS)["features"]} == {"renamed"}
    rules = {"version": 1, "plates": {"spacing_m": 50}}
    assert client.patch(url, json={"rules": rules}, headers={"If-Match": '"2"'}).status_code == 200
    assert [f["properties"]["family"] for f in get(client, PLANS)["features"]] == ["plate"] * 6


def test_the_status_follows_the_plan_and_its_markers(server: LiveServer, start: tuple[float, float]) -> None:
    with server.agency("ogc builders") as author, server.agency("ogc builders") as other:
        plan = make(author, start, lines=None)
        url = f"/v1/plans/{plan['id']}"
        assert other.post(f"{url}/approve", headers={"If-Match": '"1"'}).status_code == 200
        assert len(ids(get(author, PLANS, status="approved"))) == 3
        assert author.post(f"{url}/commit", headers={"If-Match": '"2"'}).status_code == 201
        markers = author.get("/v1/markers").json()["items"]
        for status, seen in (("planned", "committed"), ("built", "built"), ("surveyed", "surveyed")):
            for marker in markers:
                author.patch(f"/v1/markers/{marker['id']}", json={"status": status}, headers={"If-Match": "*"})
            page = get(author, PLANS)
            assert {f["properties"]["status"] for f in page["features"]} == {seen}
            assert ids(get(author, PLANS, status=seen)) == ids(page)
            assert ids(get(author, PLANS, filter=f"status <> '{seen}'")) == []


def test_tiles_of_plans(client: httpx.Client, start: tuple[float, float]) -> None:
    plan = make(client, start)
    column = int((start[0] + 180.0) / 360.0 * 2**10)
    tiles = "/ogc/collections/plans/tiles/WebMercatorQuad"
    rows = [client.get(f"{tiles}/10/{row}/{column}") for row in range(340, 380)]
    (tile,) = [response for response in rows if response.status_code == 200]
    layer, points = read_tile(tile.content)
    assert layer == "plans"
    assert len(points) == sum(plan["counts"].values())
    assert {properties["plan"] for properties, _ in points} == {NAME}
    assert {properties["status"] for properties, _ in points} == {plan["status"]}
    assert sorted(properties["number"] for properties, _ in points) == list(range(1, len(points) + 1))


def test_lanes_are_lines_with_their_figures(client: httpx.Client, start: tuple[float, float]) -> None:
    document = json.loads(road(*start, length_m=300.0))
    curve = [list(start)]
    for k in range(60):  # an arc of 100 m radius
        lon, lat, _ = GEOD.fwd(*curve[-1], 90.0 - 2.0 * k, 100.0 * 2.0 * 3.14159265 / 180.0)
        curve.append([lon, lat])
    bend = {"lane": "bend", "road": "B 3", "width_m": 3.0, "speed_limit_kmh": 50, "right_style": "solid"}
    feature = {"type": "Feature", "properties": bend, "geometry": {"type": "LineString", "coordinates": curve}}
    document["features"].append(feature)
    alignment = send_road(client, json.dumps(document).encode(), name="two lanes").json()
    page = get(client, LANES)
    assert [f["properties"]["lane"] for f in page["features"]] == ["1", "bend"]
    lane = page["features"][1]
    assert lane["id"] == f"{alignment['id']}.00002"
    properties = lane["properties"]
    assert (properties["alignment"], properties["alignment_id"]) == ("two lanes", alignment["id"])
    assert (properties["road"], properties["right_style"]) == ("B 3", "solid")
    assert (properties["min_width_m"], properties["max_speed_kmh"]) == (3.0, pytest.approx(50.0))
    assert properties["min_radius_m"] == pytest.approx(100.0, rel=0.1)
    assert properties["max_curvature_per_m"] == pytest.approx(0.01, rel=0.1)
    assert properties["localization_grade"] == "m"
    assert GEOD.line_length(*zip(*lane["geometry"]["coordinates"], strict=True)) == pytest.approx(209.4, abs=0.5)
    schema = get(client, "/ogc/collections/alignments/geojson-schema")["properties"]
    assert list(schema["properties"]["properties"]) == list(properties)
    assert schema["geometry"]["$ref"].endswith("LineString.json")
    assert get(client, f"{LANES}/{lane['id']}")["properties"] == properties
    assert ids(get(client, LANES, limit=1, after=page["features"][0]["id"])) == [lane["id"]]
    assert ids(get(client, LANES, lane="bend")) == [lane["id"]]
    assert ids(get(client, LANES, filter="min_radius_m < 200 OR max_speed_kmh > 60")) == ids(page)
    assert ids(get(client, LANES, filter="min_radius_m < 200")) == [lane["id"]]
    inside = f"{start[0] + 0.001},{start[1] - 0.0001},{start[0] + 0.0011},{start[1] + 0.0001}"
    assert ids(get(client, LANES, bbox=inside)) == [page["features"][0]["id"]]
    beside = f"{start[0]},{start[1] + 0.0005},{start[0] + 0.0002},{start[1] + 0.001}"
    assert ids(get(client, LANES, bbox=beside)) == [], "within the box around the bend, and not on it"
    assert get(client, LANES, resultType="hits")["numberMatched"] == 2
    assert ids(get(client, LANES, datetime="../2020-01-01T00:00:00Z")) == []
    assert get(client, "/ogc/collections/alignments")["extent"]["spatial"]["bbox"][0][:2] == pytest.approx(
        start, abs=0.01
    )
    assert client.get("/ogc/collections/alignments/tiles").status_code == 404


def test_a_line_across_the_antimeridian_is_two() -> None:
    west, east = _parts([[179.8, 1.0], [179.9, 1.0], [-179.9, 3.0], [-179.8, 3.0]])
    assert west == [[179.8, 1.0], [179.9, 1.0], [180.0, pytest.approx(2.0)]]
    assert east == [[-180.0, pytest.approx(2.0)], [-179.9, 3.0], [-179.8, 3.0]]
    assert list(_parts([[1.0, 1.0], [2.0, 1.0]])) == [[[1.0, 1.0], [2.0, 1.0]]]
    back = list(_parts([[-179.9, 3.0], [179.9, 1.0]]))
    assert back == [[[-179.9, 3.0], [-180.0, pytest.approx(2.0)]], [[180.0, pytest.approx(2.0)], [179.9, 1.0]]]


def test_other_agencies_and_vehicles_see_none(
    server: LiveServer, client: httpx.Client, start: tuple[float, float]
) -> None:
    make(client, start)
    lane, marker = ids(get(client, LANES))[0], ids(get(client, PLANS))[0]
    with server.agency("ogc strangers", Scope.VIEWER) as stranger:
        assert ids(get(stranger, LANES)) == ids(get(stranger, PLANS)) == []
        assert "extent" not in get(stranger, "/ogc/collections/plans")
        for url in (f"{LANES}/{lane}", f"{PLANS}/{marker}"):
            assert stranger.get(url).status_code == 404
    with server.agency("ogc strangers", Scope.VEHICLE) as vehicle:
        assert vehicle.get(PLANS).status_code == 403


@pytest.fixture
def planner_key(server: LiveServer, start: tuple[float, float]) -> str:
    """The key of an agency with one plan."""
    key = str(server.app.state.use_cases.access.create_key(f"gdal plans {start[1]}", Scope.PLANNER, label="gdal"))
    with server.client(key) as client:
        make(client, start, "for GDAL")
    return key


def _ogrinfo(url: str, key: str, layer: str, *arguments: str) -> str:
    environment = {**os.environ, "GDAL_HTTP_HEADERS": f"Authorization: Bearer {key}"}
    command = [require_tool("ogrinfo"), "-ro", *arguments, f"OAPIF:{url}/ogc", layer]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=WITHIN_S, check=False)
    assert done.returncode == 0, done.stderr
    assert "ERROR" not in done.stderr, done.stderr
    return done.stdout + done.stderr


def test_ogrinfo_reads_plans_and_alignments(server: LiveServer, planner_key: str) -> None:
    summary = _ogrinfo(server.url, planner_key, "plans", "-so")
    for field in ("number: Integer", "code: String", "station_m: Real", "status: String", "plan_id: String"):
        assert field in summary
    assert "Geometry: Point" in summary
    assert _ogrinfo(server.url, planner_key, "plans", "-al", "-where", "family = 'plate'").count("OGRFeature(") == 3
    told = _ogrinfo(server.url, planner_key, "plans", "-al", "-where", "chainage_m >= 200", "--debug", "on")
    assert "filter=chainage_m%20%3E%3D%20200" in told
    lanes = _ogrinfo(server.url, planner_key, "alignments", "-al")
    assert lanes.count("OGRFeature(") == 1
    assert "Geometry: Line String" in lanes
    for field in ("min_radius_m: Real", "max_speed_kmh (Real) = 70", "lane (String) = 1"):
        assert field in lanes
