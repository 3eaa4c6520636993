"""What becomes of a committed plan: its markers are built and surveyed, and the checks are computed again."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import httpx
import pytest
from pyproj import Geod

from app.services.access.access import Scope
from tests.api.plans.test_plans import road, send_road
from tests.conftest import LiveServer
from tests.http import created, refused

pytestmark = [pytest.mark.slow, pytest.mark.both_databases]

GEOD = Geod(ellps="WGS84")
PLACES = itertools.count(1)
RULES: dict[str, Any] = {
    "version": 1,
    "plates": {"spacing_m": 100},
    "cerpm": {"straight": 2.0, "max_path_error_m": 0.05},
}


@pytest.fixture
def clients(server: LiveServer) -> Iterator[tuple[httpx.Client, httpx.Client]]:
    """Two planners of an agency."""
    name = f"builders {next(PLACES)}"
    with server.agency(name) as author, server.agency(name) as other:
        yield author, other


def committed(author: httpx.Client, other: httpx.Client, rules: dict[str, Any] = RULES) -> dict[str, Any]:
    """A committed plan of 200 m of road, with the markers that it became."""
    number = next(PLACES)
    alignment = send_road(author, road(10.0, 44.0 + number * 0.02, length_m=200.0)).json()
    plan = created(author, "/v1/plans", name=f"plan {number}", alignment_id=alignment["id"], rules=rules)
    assert plan["status"] == "checked", [f for f in plan["findings"] if f["verdict"] == "fail"]
    url = f"/v1/plans/{plan['id']}"
    assert other.post(f"{url}/approve", headers={"If-Match": '"1"'}).status_code == 200
    assert author.post(f"{url}/commit", headers={"If-Match": '"2"'}).status_code == 201
    return plan


def change(client: httpx.Client, marker: dict[str, Any], **changes: Any) -> None:
    response = client.patch(f"/v1/markers/{marker['id']}", json=changes, headers={"If-Match": "*"})
    assert response.status_code == 200, response.text


def listed(client: httpx.Client, status: str) -> list[str]:
    return [plan["name"] for plan in client.get("/v1/plans", params={"status": status}).json()["items"]]


def test_a_plan_is_built_and_surveyed_when_all_its_markers_are(clients: tuple[httpx.Client, httpx.Client]) -> None:
    author, other = clients
    plan, second = committed(author, other), committed(author, other)
    url = f"/v1/plans/{plan['id']}"
    west, south, east, north = author.get(f"/v1/alignments/{plan['alignment_id']}").json()["extent_deg"]
    box = f"{west - 0.001},{south - 0.001},{east + 0.001},{north + 0.001}"
    markers = author.get("/v1/markers", params={"bbox": box, "limit": 1000}).json()["items"]
    assert len(markers) == sum(plan["counts"].values())
    first = author.get(url)
    assert first.json()["status"] == "committed"
    for marker in markers[:-1]:
        change(author, marker, status="built")
    assert listed(author, "committed") == [plan["name"], second["name"]]
    assert listed(author, "built") == []
    change(author, markers[-1], status="built")
    seen = author.get(url, headers={"If-None-Match": first.headers["etag"]})
    assert (seen.status_code, seen.json()["status"]) == (200, "built")
    assert (listed(author, "committed"), listed(author, "built")) == ([second["name"]], [plan["name"]])
    change(author, markers[0], status="retired")
    for status, marker in zip(itertools.cycle(["surveyed", "active", "suspect"]), markers[2:], strict=False):
        change(author, marker, status=status)
    assert author.get(url).json()["status"] == "built"
    change(author, markers[1], status="surveyed")
    assert author.get(url).json()["status"] == "surveyed"
    assert (listed(author, "built"), listed(author, "surveyed")) == ([], [plan["name"]])
    assert {p["status"] for p in author.get("/v1/plans").json()["items"]} == {"committed", "surveyed"}
    refused(author.patch(url, json={"name": "late"}, headers={"If-Match": '"3"'}), 409, field="status")
    refused(other.post(f"{url}/approve", headers={"If-Match": '"3"'}), 409, field="status")
    refused(author.post(f"{url}/commit", headers={"If-Match": '"3"'}), 409, field="status")
    change(author, markers[5], status="planned")  # found to be missing
    assert author.get(url).json()["status"] == "committed"


def test_a_survey_changes_the_checks(server: LiveServer, clients: tuple[httpx.Client, httpx.Client]) -> None:
    author, other = clients
    plan = committed(author, other)
    url = f"/v1/plans/{plan['id']}/as-built"
    assert author.get(url).json()["checks"] == []
    cerpms = author.get("/v1/markers", params={"family": "cerpm"}).json()["items"]
    lon_deg = sorted(marker["position"]["lon_deg"] for marker in cerpms)[len(cerpms) // 2]
    pair = [marker for marker in cerpms if abs(marker["position"]["lon_deg"] - lon_deg) < 1e-5]
    assert len(pair) == 2
    for marker in pair:
        lon, lat = marker["position"]["lon_deg"], marker["position"]["lat_deg"]
        lon, lat, _ = GEOD.fwd(lon, lat, 0.0, 0.25)
        change(author, marker, status="surveyed", position={"lon_deg": lon, "lat_deg": lat, "horizontal_rmse_m": 0.01})
    with server.agency("onlookers of the built", Scope.VIEWER) as stranger:
        refused(stranger.get(url), 404)
    compared = author.get(url).json()
    assert compared["surveyed"] == 2
    checks = {check["name"]: check for check in compared["checks"]}
    assert [check["planned"] for check in checks.values() if check["planned"]] == plan["findings"]
    path = checks["path-error"]
    assert path["planned"]["verdict"] == "ok"
    assert (path["built"]["verdict"], path["verdict_changed"]) == ("fail", True)
    assert path["built"]["figure"] == pytest.approx(0.25, abs=0.02)
    assert [check["name"] for check in compared["checks"] if check["verdict_changed"]] == ["path-error"]
    assert checks["overlaps"]["built"]["figure"] == 0
    assert checks.get("existing-markers", {"built": {"figure": 0}})["built"]["figure"] == 0, "its own markers"


def test_variants_stand_side_by_side_with_their_figures(clients: tuple[httpx.Client, httpx.Client]) -> None:
    author, _ = clients
    alignment = send_road(author, road(10.0, 44.0 + next(PLACES) * 0.02, length_m=200.0)).json()
    variants = []
    for spacing in (50, 100):
        rules = {"version": 1, "plates": {"spacing_m": spacing}}
        variants.append(
            created(author, "/v1/plans", name=f"every {spacing} m", alignment_id=alignment["id"], rules=rules)
        )
    items = author.get("/v1/plans", params={"alignment_id": alignment["id"]}).json()["items"]
    assert [item["counts"]["plate"] for item in items] == [4, 2]
    for item, plan in zip(items, variants, strict=True):
        figures = [(check["name"], check["figure"], check["verdict"]) for check in item["checks"]]
        assert figures == [(f["name"], f["figure"], f["verdict"]) for f in plan["findings"]]
        assert (item["lane_length_m"], item["left_out_count"]) == (plan["lane_length_m"], 0)
