"""What a planner sees before a plan is made, over HTTP: the road along its lanes, the schema of rules, previews."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import httpx
import pytest
from jsonschema import Draft202012Validator

from app.services.plans import making
from tests.api.plans.test_plans import road, send_road
from tests.http import created, refused

pytestmark = pytest.mark.both_databases

PLACES = itertools.count(1)
RULES: dict[str, Any] = {
    "version": 1, "plates": {"spacing_m": 100}, "lines": {},
    "costs": {"currency": "EUR", "items": [{"item": "plate", "per": "plate", "price": 120.0}]},
}  # fmt: skip


@pytest.fixture
def alignment(client: httpx.Client) -> dict[str, Any]:
    """A straight road with a stop line."""
    number = next(PLACES)
    document: dict[str, Any] = send_road(client, road(34.0, 40.0 + number * 0.02), name=f"road {number}").json()
    return document


@pytest.mark.slow
def test_a_road_is_drawn_along_its_lanes(client: httpx.Client, alignment: dict[str, Any]) -> None:
    url = f"/v1/alignments/{alignment['id']}/profile"
    profile = client.get(url, params={"samples": 41}).json()
    [lane] = profile["lanes"]
    assert (lane["name"], lane["left_style"], lane["right_style"]) == ("1", "dashed", "solid")
    along = ("chainage_m", "station_m", "curvature_per_m", "grade", "design_speed_kmh", "lon_deg", "lat_deg")
    assert {len(lane[name]) for name in along} == {41}
    assert lane["chainage_m"] == pytest.approx([20.0 * k for k in range(41)], abs=0.51)
    assert lane["chainage_m"][-1] == pytest.approx(lane["length_m"], abs=1e-3)
    assert lane["station_m"] == pytest.approx(lane["chainage_m"], abs=0.01)
    assert max(map(abs, lane["curvature_per_m"])) < 1e-4
    assert lane["design_speed_kmh"][0] == 70.0
    assert lane["line"][0] == pytest.approx([lane["lon_deg"][0], lane["lat_deg"][0]])
    [event] = profile["events"]
    assert (event["kind"], event["lane"]) == ("stop_line", "1")
    assert event["lon_deg"] == pytest.approx(lane["lon_deg"][-2], abs=1e-5)
    refused(client.get(url, params={"samples": 1}), 422)


def test_the_greatest_curvature_of_a_short_bend_is_kept(client: httpx.Client) -> None:
    number = next(PLACES)
    bent = {"type": "LineString", "coordinates": [[35.0, 40.0 + number * 0.02], [35.005, 40.0 + number * 0.02],
                                                  [35.01, 40.001 + number * 0.02]]}  # fmt: skip
    name = f"bend {number}"
    axis = created(client, "/v1/roads", name=name, geometry=bent, calibration=[{"measure_m": 5000, "vertex": 0}])
    lanes = {"forward": 1, "backward": 1, "width_m": 3.5, "speed_limit_kmh": 30}
    made = created(client, "/v1/alignments", name=name, road_id=axis["id"], lanes=lanes)
    url = f"/v1/alignments/{made['id']}/profile"
    fine, coarse = (client.get(url, params={"samples": samples}).json()["lanes"] for samples in (5000, 7))
    for lane, same in zip(fine, coarse, strict=True):
        sharpest = max(lane["curvature_per_m"], key=abs)
        assert abs(sharpest) > 1e-3
        assert max(same["curvature_per_m"], key=abs) == sharpest
    ahead, back = coarse
    assert max(ahead["curvature_per_m"], key=abs) > 0 > max(back["curvature_per_m"], key=abs)  # left, then right
    assert ahead["station_m"][0] == pytest.approx(5000, abs=1)
    assert back["station_m"][0] > back["station_m"][-1]


def test_the_schema_of_rules_describes_those_that_are_taken(client: httpx.Client) -> None:
    response = client.get("/v1/plan-rules/schema")
    assert response.headers["content-type"] == "application/schema+json"
    validator = Draft202012Validator(response.json())
    assert validator.is_valid(RULES)
    assert not validator.is_valid(RULES | {"plates": {"spacing_m": 1}})


def test_rules_of_a_file_are_read_and_checked(client: httpx.Client) -> None:
    def read(text: str) -> httpx.Response:
        return client.post("/v1/plan-rules", json={"text": text})

    examples = sorted(Path("docs/plans").glob("rules-*.yaml"))
    assert len(examples) >= 3
    for path in examples:
        rules = read(path.read_text()).json()["rules"]
        assert read(json.dumps(rules)).json()["rules"] == rules
        assert rules["version"] == 1
    assert read("version: 1\nplates: {spacing_m: 50}").json() == {
        "rules": {"version": 1, "plates": {"spacing_m": 50.0}}
    }
    refused(read("version: 1\nplates: {spacing_m: 1}"), 422, field="plates.spacing_m")
    refused(read("version: 1\nplatse: {}"), 422, field="platse")
    assert "line 2" in refused(read("version: 1\n- plates"), 422, field="rules")["detail"]
    refused(read("a: &x 1\nb: *x"), 422, field="rules")
    refused(read("[" * 5000), 422, field="rules")
    refused(read(""), 422, field="rules")
    refused(read("x" * 50_001), 422, field="text")
    half: dict[str, Any] = {"content": rb'{"text": "\ud83d"}', "headers": {"Content-Type": "application/json"}}
    refused(client.post("/v1/plan-rules", **half), 400, field="body.text")


def test_a_preview_is_the_plan_that_is_made_then_and_nothing_is_stored(
    client: httpx.Client, alignment: dict[str, Any]
) -> None:
    wanted = {"alignment_id": alignment["id"], "rules": RULES}
    preview = client.post("/v1/plan-previews", json=wanted).json()
    assert client.get("/v1/plans").json()["items"] == []
    plan = created(client, "/v1/plans", name=f"plan {next(PLACES)}", **wanted)
    same = ("counts", "verdict", "findings", "cost", "cost_complete", "currency", "left_out")
    assert {name: preview[name] for name in same} == {name: plan[name] for name in same}
    placed = client.get(f"/v1/plans/{plan['id']}/files/plan.json").json()["markers"]
    assert len(preview["markers"]) == len(placed) == sum(plan["counts"].values())
    for one, other in zip(preview["markers"], placed, strict=True):
        assert (one["number"], one["family"], one["lane"]) == (other["number"], other["family"], other["lane"])
        assert one["chainage_m"] == pytest.approx(other["chainage_m"], abs=1e-3)
    paged: list[Any] = []
    url: str | None = "/v1/plan-previews?limit=3"
    while url:
        response = client.post(url, json=wanted)
        page = response.json()
        assert {name: page[name] for name in same} == {name: plan[name] for name in same}
        assert len(page["markers"]) <= 3
        paged += page["markers"]
        url = response.links["next"]["url"] if "next" in response.links else None
    assert paged == preview["markers"]
    assert len(paged) > 6
    assert client.post("/v1/plan-previews?after=10000", json=wanted).json()["markers"] == []
    refused(client.post("/v1/plan-previews?limit=10001", json=wanted), 422)
    closer = {**RULES, "plates": {"spacing_m": 50}}
    again = client.post("/v1/plan-previews", json=wanted | {"rules": closer}).json()
    assert again["cost"] > preview["cost"]


def test_previews_that_cannot_be_are_refused_at_their_field(
    client: httpx.Client, alignment: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def ask(**rules: Any) -> httpx.Response:
        return client.post(
            "/v1/plan-previews", json={"alignment_id": alignment["id"], "rules": {"version": 1, **rules}}
        )

    refused(ask(plates={"spacing_m": 1}), 422, field="plates.spacing_m")
    refused(ask(plates={}, road={"lanes": ["7"]}), 422, field="road.lanes")
    refused(ask(), 422)
    monkeypatch.setattr("app.services.plans.making.IMMEDIATE_LANES_M", 250.0)
    assert making.IMMEDIATE_LANES_M == 250.0
    assert "km of lanes" in refused(ask(plates={}), 422, field="alignment_id")["limit"]
