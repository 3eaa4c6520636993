"""Magnet markers in /v1/markers and their layouts, over real HTTP."""

from __future__ import annotations

import csv
import io
import itertools
import json
import re
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest
from pyproj import Geod, Transformer

from app.services.access.access import Scope
from tests.conftest import LiveServer
from tests.http import created, refused

pytestmark = pytest.mark.both_databases

ROOT = Path(__file__).resolve().parents[3]
GEOD = Geod(ellps="WGS84")
Lane = Callable[..., dict[str, Any]]
_LANES = itertools.count()


@pytest.fixture
def lane() -> Lane:
    """Straight lanes of 300 m heading east, far from each other."""

    def new_lane(**members: Any) -> dict[str, Any]:
        lon, lat = -60.0 + next(_LANES) * 0.5, -10.0
        end_lon, end_lat, _ = GEOD.fwd(lon, lat, 90.0, 300.0)
        return {"geometry": {"type": "LineString", "coordinates": [[lon, lat], [end_lon, end_lat]]}, **members}

    return new_lane


def _tag(lane: dict[str, Any], chainage_m: float = 50.0, code: str = "SNS_4_0.1_10-30", **tag: Any) -> dict[str, Any]:
    return {"family": "magnet", "lane": lane, "tag": {"code": code, "chainage_m": chainage_m, **tag}}


def _line(lane: dict[str, Any], style: str = "solid", **line: Any) -> dict[str, Any]:
    return {"family": "magnet", "lane": lane, "line": {"style": style, **line}}


def _distance_m(a: dict[str, Any], b: dict[str, Any]) -> float:
    return float(GEOD.inv(a["lon_deg"], a["lat_deg"], b["lon_deg"], b["lat_deg"])[2])


# --- register -----------------------------------------------------------------------------------------------------


def test_a_tag_on_a_lane_becomes_magnets(client: httpx.Client, lane: Lane) -> None:
    given = lane(horizontal_rmse_m=0.02, realization="ITRF2014", survey_method="GNSS RTK")
    response = client.post("/v1/markers", json=_tag(given, 50.0) | {"road": "A1"})
    marker = response.json()
    assert response.status_code == 201, response.text
    assert response.headers["location"] == f"/v1/markers/{marker['id']}"
    assert response.headers["etag"] == '"1"'
    assert (marker["family"], marker["status"], marker["road"]) == ("magnet", "planned", "A1")
    code = marker["code"]
    assert (code["scheme"], code["text"]) == ("information-tag", "SNS_4_0.1_10-30")
    assert (code["gaps_m"], code["ratios"], code["meaning"]) == ([1.0, 3.0], [3.0], None)
    magnets = marker["magnets"]
    assert [magnet["polarity"] for magnet in magnets] == ["S", "N", "S"]
    assert [magnet["north_pole"] for magnet in magnets] == ["backward", "forward", "backward"]
    assert [magnet["phi_deg"] for magnet in magnets] == [0, 0, 0]
    assert not re.search(r"-0\.0(?!\d)", response.text)
    assert [_distance_m(magnets[0], magnet) for magnet in magnets] == pytest.approx([0, 1, 4], abs=1e-4)
    start = dict(zip(("lon_deg", "lat_deg"), given["geometry"]["coordinates"][0], strict=True))
    assert _distance_m(start, marker["position"]) == pytest.approx(50.0, abs=1e-3)
    assert _distance_m(magnets[0], marker["position"]) < 1e-4
    assert marker["heading_deg"] == pytest.approx(90.0, abs=0.01)
    position = marker["position"]
    assert (position["horizontal_rmse_m"], position["realization"]) == (0.02, "ITRF2014")
    assert position["localization_grade"] == "dm"
    assert (position["original"]["chainage_m"], position["original"]["survey_method"]) == (50.0, "GNSS RTK")
    assert marker["lane"]["geometry"] == given["geometry"]
    assert client.get(response.headers["location"]).json() == marker


def test_a_line_of_magnets(client: httpx.Client, lane: Lane) -> None:
    marker = created(client, "/v1/markers", **_line(lane(), "dashed", from_m=10, to_m=110, spacing_m=6))
    assert marker["code"] == {"scheme": "line-tag", "text": "S_90", "tuple": "{S, 90°}", "style": "dashed"}
    magnets = marker["magnets"]
    assert len(magnets) == 18  # 100 m in 17 steps of at most 6 m
    assert {(m["polarity"], m["phi_deg"], m["north_pole"]) for m in magnets} == {("S", 90, "down")}
    steps = [_distance_m(a, b) for a, b in itertools.pairwise(magnets)]
    assert steps == pytest.approx([100 / 17] * 17, abs=1e-3)
    assert next(check for check in marker["checks"] if check["name"] == "line-spacing")["figure"] < 6.0
    assert marker["bill"]["total_usd"] == 18.0  # one dollar each: METRO section 8.1
    paint = next(row for row in marker["bill"]["alternatives"] if "paint" in row["item"])
    assert (paint["quantity"], paint["low_usd"], paint["high_usd"]) == (100.0, 21.0, 770.0)


def test_the_offset_is_to_the_left(client: httpx.Client, lane: Lane) -> None:
    given = lane()
    middle, left = (created(client, "/v1/markers", **_tag(given, 20.0, offset_m=offset)) for offset in (0.0, 2.0))
    assert left["position"]["lat_deg"] > middle["position"]["lat_deg"]
    assert _distance_m(middle["position"], left["position"]) == pytest.approx(2.0, abs=1e-3)


def test_a_meaning_finds_its_code(client: httpx.Client, server: LiveServer, lane: Lane) -> None:
    book = {"name": "b", "design": {"magnets": 3, "length_m": 4, "segment_m": 0.1}}
    meaning = {"kind": "bend-right", "value": 125}
    book = client.post("/v1/codebooks", json=book | {"meanings": [meaning]}).json()
    tag = {"codebook_id": book["id"], "meaning": meaning, "chainage_m": 10}
    body = {"family": "magnet", "lane": lane(), "tag": tag}
    marker = created(client, "/v1/markers", **body)
    assert marker["code"]["text"] == book["entries"][0]["code"]
    assert marker["code"]["codebook_id"] == book["id"]
    assert marker["code"]["meaning"] == {
        "kind": "bend-right",
        "value": 125.0,
        "unit": "deg",
        "text": "bend right 125 deg",
    }
    named = created(client, "/v1/markers", **_tag(lane(), code=marker["code"]["text"], codebook_id=book["id"]))
    assert named["code"]["meaning"] == marker["code"]["meaning"]
    other = client.post("/v1/markers", json=_tag(lane(), code="SNS_4_0.1_10-30", codebook_id=book["id"]))
    refused(other, 422, "code-mismatch", field="tag.code")
    unknown = body | {"lane": lane(), "tag": tag | {"meaning": {"kind": "arrow", "value": "left"}}}
    assert (
        "arrow left"
        in refused(client.post("/v1/markers", json=unknown), 422, "invalid-parameter", field="tag.meaning")["detail"]
    )
    with server.agency("a stranger to the book") as stranger:
        refused(stranger.post("/v1/markers", json=body | {"lane": lane()}), 404, "not-found")


def test_projected_lanes_follow_the_rules_of_plates(client: httpx.Client) -> None:
    points = [[500_000.0, 4_000_000.0], [500_200.0, 4_000_000.0]]
    marker = created(client, "/v1/markers", **_tag({"points_m": points, "crs": "EPSG:32633"}))
    lon, lat = Transformer.from_crs("EPSG:32633", "EPSG:4326", always_xy=True).transform(*points[0])
    assert marker["lane"]["geometry"]["coordinates"][0] == pytest.approx([lon, lat], abs=1e-9)
    assert marker["lane"]["given"] == points
    assert marker["position"]["crs"] == "EPSG:32633"
    assert marker["position"]["transform_accuracy_m"] == pytest.approx(2.0, abs=0.05)
    # the scale of UTM on its central meridian is 0.9996: distances in the road are not those on the map
    assert marker["lane"]["length_m"] == pytest.approx(200 / 0.9996, abs=0.01)
    nad83 = {"type": "LineString", "coordinates": [[-84.5, 42.7], [-84.498, 42.7]]}
    approximate = created(client, "/v1/markers", **_tag({"geometry": nad83, "crs": "EPSG:6318"}))["position"]
    assert approximate["epoch"] == 2020.0
    assert "state the epoch" in approximate["transform_note"]
    nad83["coordinates"] = [[-84.6, 42.7], [-84.598, 42.7]]
    exact = created(client, "/v1/markers", **_tag({"geometry": nad83, "crs": "EPSG:6318", "epoch": 2025.0}))
    assert exact["position"]["transform_accuracy_m"] == 0.0
    assert exact["lane"]["given"] == nad83["coordinates"]
    assert exact["lane"]["geometry"]["coordinates"][0][0] == pytest.approx(-84.6000110, abs=2e-6)


def test_an_idempotent_request_is_stored_once(client: httpx.Client, lane: Lane) -> None:
    body, headers = _tag(lane()), {"Idempotency-Key": "m1"}
    first, second = (client.post("/v1/markers", json=body, headers=headers) for _ in range(2))
    assert (first.status_code, second.status_code) == (201, 201)
    assert first.json() == second.json()
    assert second.headers["idempotency-replayed"] == "true"
    refused(client.post("/v1/markers", json=_tag(lane()), headers=headers), 409, "idempotency-conflict")


# --- checks -------------------------------------------------------------------------------------------------------


def _checks(marker: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {check["name"]: check for check in marker["checks"]}


def test_soft_limits_are_warnings(client: httpx.Client, lane: Lane) -> None:
    site = {
        "design_speed_m_s": 13.4, "stop_line_chainage_m": 100.0, "vehicles": ["sedan", "heavy truck"],
        "readable_clearance_m": 0.3,
    }  # fmt: skip
    marker = created(client, "/v1/markers", **_tag(lane(), 50.0) | {"site": site})
    checks = _checks(marker)
    reaction = checks["reaction-distance"]
    assert reaction["figure"] == pytest.approx(46.0, abs=1e-3)  # 100 - 50 - 4
    assert reaction["limit"] == pytest.approx(13.4 * 2.5 + 13.4**2 / 6.8, abs=1e-3)
    assert "AASHTO" in reaction["source"]
    assert not reaction["passed"]
    assert checks["clearance-sedan"]["passed"]
    truck = checks["clearance-heavy-truck"]
    assert truck["figure"] == pytest.approx(0.372 + 1.645 * 0.02786 - 0.005, abs=1e-3)
    assert not marker["passed"]
    assert marker["warnings"] == ["reaction-distance", "clearance-heavy-truck"]


def test_magnets_that_stand_too_near_are_refused(client: httpx.Client, lane: Lane) -> None:
    problem = refused(
        client.post("/v1/markers", json=_tag(lane(), code="SNS_4_0.1_4-36")), 422, "invalid-parameter", field="tag.code"
    )
    for part in ("0.400 m", "0.5 m", "METRO figure 17a"):
        assert part in problem["detail"]
    near = client.post("/v1/markers", json=_line(lane(), to_m=20, spacing_m=0.3))
    refused(near, 422, "invalid-parameter", field="line.spacing_m")
    assert client.get("/v1/markers").json()["items"] == []


def test_magnets_too_far_apart_along_a_line_are_refused(client: httpx.Client, lane: Lane) -> None:
    answer = client.post("/v1/markers", json=_line(lane(), to_m=140, spacing_m=7))
    problem = refused(answer, 422, "invalid-parameter", field="line.spacing_m")
    assert problem["limit"] == "<= 6 m"
    assert "METRO section 6.3" in problem["detail"]


def test_layouts_that_overlap_are_a_conflict(client: httpx.Client, server: LiveServer, lane: Lane) -> None:
    given = lane()
    first = created(client, "/v1/markers", **_tag(given, 50.0))
    overlapping = _tag(given, 53.6)  # its first magnet 0.4 m before the last of the other
    problem = refused(client.post("/v1/markers", json=overlapping), 409, "conflict")
    assert first["id"] in problem["detail"]
    assert "0.400 m" in problem["detail"]
    assert "METRO figure 17a" in problem["limit"]
    with server.agency("a stranger on the same lane") as stranger:
        secret = refused(stranger.post("/v1/markers", json=overlapping), 409, "conflict")
        assert first["id"] not in str(secret)
        assert "another agency" in secret["detail"]
        near = _checks(created(stranger, "/v1/markers", **_tag(given, 54.6)))["neighbour-tag"]
        assert near["figure"] == pytest.approx(0.6, abs=1e-3)
        assert (near["passed"], near["note"]) == (False, "nearest is a marker of another agency")
    path = f"/v1/markers/{first['id']}"
    assert client.patch(path, json={"status": "retired"}, headers={"If-Match": '"1"'}).status_code == 200
    second = created(client, "/v1/markers", **_tag(given, 49.0))
    back = client.patch(path, json={"status": "active"}, headers={"If-Match": '"2"'})
    assert second["id"] in refused(back, 409, "conflict")["detail"]
    created(client, "/v1/markers", **_tag(given, 80.0))  # the same code again: tags of one meaning repeat


def test_a_line_keeps_clear_of_what_lies_along_it(client: httpx.Client, lane: Lane) -> None:
    given = lane()
    created(client, "/v1/markers", **_line(given, from_m=0, to_m=240))
    for chainage_m in (1.8, 121.8, 235.8):  # far from the line's own position, too
        refused(client.post("/v1/markers", json=_tag(given, chainage_m)), 409, "conflict")
    beside = created(client, "/v1/markers", **_tag(given, 120.5, offset_m=1.0))
    check = _checks(beside)["neighbour-magnet"]
    assert (check["figure"], check["passed"]) == (pytest.approx(1.25**0.5, abs=1e-3), True)
    assert "neighbour-magnet" not in _checks(created(client, "/v1/markers", **_tag(given, 121.0, offset_m=-1.8)))


def test_a_long_line_looks_for_others_along_all_of_it(client: httpx.Client, lane: Lane) -> None:
    given = lane()
    tag = created(client, "/v1/markers", **_tag(given, 235.8))
    problem = refused(client.post("/v1/markers", json=_line(given, from_m=0, to_m=240)), 409, "conflict")
    assert tag["id"] in problem["detail"]
    assert "0.200 m" in problem["detail"]


def test_of_many_requests_for_one_place_one_wins(client: httpx.Client, lane: Lane) -> None:
    body = _tag(lane())
    with ThreadPoolExecutor(8) as threads:
        answers = list(threads.map(lambda _: client.post("/v1/markers", json=body).status_code, range(12)))
    assert sorted(answers) == [201] + [409] * 11


def test_the_depth_of_magnets_counts_in_their_checks(client: httpx.Client, lane: Lane) -> None:
    flush, deep = (
        client.post("/v1/markers", json=_tag(lane()) | {"installation": {"hole_depth_mm": depth}}).json()
        for depth in (30, 300)
    )
    assert (flush["depth_m"], deep["depth_m"]) == (pytest.approx(0.025), pytest.approx(0.295))
    figures = [{check["name"]: check["figure"] for check in marker["checks"]} for marker in (flush, deep)]
    assert figures[1]["clearance-utility"] - figures[0]["clearance-utility"] == pytest.approx(0.27)
    assert "clearance-utility" in deep["warnings"]
    assert "clearance-utility" not in flush["warnings"]


def test_magnets_on_the_surface_have_shells_and_no_holes(client: httpx.Client, lane: Lane) -> None:
    fixed = {"mounting": "surface", "shell_height_mm": 12.0}
    marker = client.post("/v1/markers", json=_line(lane(), to_m=60) | {"installation": fixed}).json()
    assert marker["installation"] == fixed | {"hole_diameter_mm": None, "hole_depth_mm": None}
    assert marker["depth_m"] == -0.005
    assert [row["item"] for row in marker["bill"]["materials"]] == ["magnet", "protective shell"]
    assert [row["item"] for row in marker["bill"]["without_price"]] == ["bed of epoxy adhesive"]
    rows = list(csv.DictReader(io.StringIO(client.get(f"/v1/markers/{marker['id']}/layout.csv").text)))
    assert {(row["mounting"], row["depth_m"], row["height_mm"]) for row in rows} == {("surface", "-0.0050", "12")}
    sheet = client.get(f"/v1/markers/{marker['id']}/layout.geojson").json()
    assert sheet["waymark"]["installation"] == marker["installation"]
    again = _line(lane(), to_m=60) | {"installation": marker["installation"]}
    assert client.post("/v1/markers", json=again).json()["installation"] == marker["installation"]


# --- bad input ----------------------------------------------------------------------------------------------------

_TAG = {"code": "SNS_4_0.1_10-30", "chainage_m": 10}


@pytest.mark.parametrize(
    ("change", "slug", "field"),
    [
        ({"tag": None}, "invalid-parameter", "tag"),
        ({"line": {"style": "solid"}}, "invalid-parameter", "tag"),
        ({"tag": {"code": "SNS_4_0.1_10-30"}}, "invalid-parameter", "tag.chainage_m"),
        ({"tag": {"chainage_m": 10}}, "invalid-parameter", "tag"),
        ({"tag": _TAG | {"meaning": {"kind": "arrow", "value": "left"}}}, "invalid-parameter", "tag"),
        ({"tag": _TAG | {"code": "N_90"}}, "invalid-parameter", "tag.code"),
        ({"tag": _TAG | {"code": "SNS"}}, "code-mismatch", "tag.code"),
        ({"tag": _TAG | {"code": "SNS_4_0.1_10-31"}}, "code-mismatch", "tag.code"),
        ({"tag": _TAG | {"code": "SNS_40_0.1_10-390"}}, "invalid-parameter", "tag.length_m"),
        ({"tag": _TAG | {"code": "SNS_4_0.3_10-30"}}, "invalid-parameter", "tag.length_m"),
        ({"tag": _TAG | {"chainage_m": -1}}, "invalid-parameter", "tag.chainage_m"),
        ({"tag": _TAG | {"chainage_m": 298}}, "invalid-parameter", "tag.chainage_m"),
        ({"tag": _TAG | {"offset_m": 51}}, "invalid-parameter", "tag.offset_m"),
        ({"tag": None, "line": {"style": "dotted"}}, "invalid-parameter", "line.style"),
        ({"tag": None, "line": {"style": "solid", "spacing_m": 0}}, "invalid-parameter", "line.spacing_m"),
        ({"tag": None, "line": {"style": "solid", "spacing_m": -6}}, "invalid-parameter", "line.spacing_m"),
        ({"tag": None, "line": {"style": "solid", "spacing_m": 0.01}}, "invalid-parameter", "line.to_m"),
        ({"tag": None, "line": {"style": "solid", "spacing_m": 1e-300}}, "invalid-parameter", "line.to_m"),
        ({"tag": None, "line": {"style": "solid", "from_m": 9, "to_m": 9}}, "invalid-parameter", "line.to_m"),
        ({"tag": None, "line": {"style": "solid", "to_m": 400}}, "invalid-parameter", "line.to_m"),
        ({"site": {"design_speed_m_s": 100}}, "invalid-parameter", "site.design_speed_m_s"),
        ({"site": {"stop_line_chainage_m": 100}}, "invalid-parameter", "site.design_speed_m_s"),
        ({"site": {"vehicles": ["tank"]}}, "invalid-parameter", "site.vehicles"),
        ({"site": {"readable_clearance_m": 2}}, "invalid-parameter", "site.readable_clearance_m"),
        ({"site": {"wheel_circumference_m": [2.3, 1.8]}}, "invalid-parameter", "site.wheel_circumference_m"),
        ({"installation": {"hole_depth_mm": 5}}, "invalid-parameter", "installation.hole_depth_mm"),
        ({"installation": {"mounting": "glued"}}, "invalid-parameter", "installation.mounting"),
        (
            {"installation": {"mounting": "surface", "hole_depth_mm": 30}},
            "invalid-parameter",
            "installation.hole_depth_mm",
        ),
        ({"heading_deg": 10}, "invalid-parameter", "heading_deg"),
        ({"lane": {}}, "invalid-parameter", "lane"),
        ({"lane": {"points_m": [[0, 0], [1, 1]]}}, "invalid-parameter", "lane.points_m.0"),
        ({"lane": {"points_m": [[0, 0]], "crs": "EPSG:32633"}}, "invalid-parameter", "lane.points_m"),
        ({"family": "beacon"}, "invalid-parameter", "family"),
    ],
)
def test_bad_input_is_named(client: httpx.Client, lane: Lane, change: dict[str, Any], slug: str, field: str) -> None:
    body = {name: value for name, value in ({**_tag(lane()), **change}).items() if value is not None}
    refused(client.post("/v1/markers", json=body), 422, slug, field=field)


@pytest.mark.parametrize(
    ("coordinates", "crs", "slug", "field"),
    [
        ([[0, 0], [0, 91]], None, "invalid-parameter", "lane.geometry.coordinates.1"),
        ([[0, 0], [0]], None, "invalid-parameter", "lane.geometry.coordinates.1"),
        ([[0, 0], ["a", 0]], None, "invalid-parameter", "lane.geometry.coordinates.1.0"),
        ([[0, 0], [0, 0]], None, "invalid-parameter", "lane"),
        ([[0, 0], [0, 1]], None, "invalid-parameter", "lane"),
        ([[0, 0], [0, 0.001]], "EPSG:1", "reference-system", "lane.crs"),
        ([[0, 0], [0, 0.001]], "EPSG:2326", "invalid-parameter", "lane.geometry.coordinates.0"),
    ],
)
def test_a_bad_lane_is_named(
    client: httpx.Client, coordinates: list[list[Any]], crs: str | None, slug: str, field: str
) -> None:
    lane = {"geometry": {"type": "LineString", "coordinates": coordinates}}
    refused(client.post("/v1/markers", json=_tag(lane | ({"crs": crs} if crs else {}))), 422, slug, field=field)


def test_a_lane_of_too_many_points(client: httpx.Client) -> None:
    points = [[0.0, 0.00001 * number] for number in range(2001)]
    problem = refused(
        client.post("/v1/markers", json=_tag({"geometry": {"type": "LineString", "coordinates": points}})),
        422,
        "invalid-parameter",
        field="lane.geometry.coordinates",
    )
    assert "2000" in problem["limit"]


# --- list and change ----------------------------------------------------------------------------------------------


def test_lists_hold_both_families(client: httpx.Client, place: Callable[[], dict[str, Any]], lane: Lane) -> None:
    plate = client.post("/v1/markers", json={"position": place()}).json()
    given = lane()
    magnets = created(client, "/v1/markers", **_tag(given))
    line = created(client, "/v1/markers", **_line(given, "solid", from_m=100, to_m=130))

    def found(query: str) -> list[dict[str, Any]]:
        response = client.get(f"/v1/markers?{query}")
        assert response.status_code == 200, response.text
        return list(response.json()["items"])

    assert [item["id"] for item in found("")] == sorted([plate["id"], magnets["id"], line["id"]])
    assert found("family=plate") == [plate]
    assert {item["id"] for item in found("family=magnet")} == {magnets["id"], line["id"]}
    assert [item["id"] for item in found("code=SNS_4_0.1_10-30")] == [magnets["id"]]
    assert [item["id"] for item in found("code=N_90")] == [line["id"]]
    lon, lat = magnets["position"]["lon_deg"], magnets["position"]["lat_deg"]
    (item,) = found(f"near={lon},{lat},1&family=magnet")
    left_out = {"length_m", "lane", "site", "magnets", "passed", "checks", "warnings", "bill"}
    assert set(magnets) - set(item) == left_out
    assert {**item, "distance_m": None} == {"distance_m": None} | {
        name: value for name, value in magnets.items() if name not in left_out
    }
    refused(client.get("/v1/markers?family=beacon"), 422, "invalid-parameter", field="family")


def test_status_changes_and_history(client: httpx.Client, lane: Lane) -> None:
    marker = created(client, "/v1/markers", **_tag(lane()) | {"reason": "plan 7"})
    path = f"/v1/markers/{marker['id']}"
    refused(client.patch(path, json={"status": "built"}), 428, "version-required")
    built = client.patch(path, json={"status": "built", "reason": "drilled"}, headers={"If-Match": '"1"'})
    assert built.json() == marker | {"status": "built", "version": 2, "updated_at": built.json()["updated_at"]}
    refused(client.patch(path, json={"status": "active"}, headers={"If-Match": '"1"'}), 412, "stale-version")
    history = client.get(f"{path}/versions").json()["items"]
    assert [(entry["version"], entry["why"]) for entry in history] == [(1, "plan 7"), (2, "drilled")]
    assert history[0]["marker"]["code"] == marker["code"]
    assert client.get(path, headers={"If-None-Match": '"2"'}).status_code == 304


@pytest.mark.parametrize("offset_m", [0.0, 1.75])
def test_a_survey_moves_the_whole_tag(client: httpx.Client, offset_m: float) -> None:
    bend = [[-100.0 + 0.0001 * k, 40.0 + 0.0000004 * k**3] for k in range(12)]
    given = {"geometry": {"type": "LineString", "coordinates": bend}, "crs": "EPSG:4326"}
    marker = created(client, "/v1/markers", **_tag(given, 40.0, offset_m=offset_m))
    path, planned = f"/v1/markers/{marker['id']}", marker["position"]
    lon, lat, _ = GEOD.fwd(planned["lon_deg"], planned["lat_deg"], 30.0, 0.05)
    survey = {"lon_deg": lon, "lat_deg": lat, "horizontal_rmse_m": 0.01, "survey_method": "total station"}
    changed = client.patch(path, json={"position": survey, "status": "surveyed"}, headers={"If-Match": '"1"'})
    assert changed.status_code == 200, changed.text
    moved = changed.json()
    assert (moved["position"]["lon_deg"], moved["position"]["lat_deg"]) == (lon, lat)
    assert moved["position"]["original"] == survey
    assert _distance_m(moved["magnets"][0], moved["position"]) < 1e-4
    for before, after in zip(marker["magnets"], moved["magnets"], strict=True):
        assert _distance_m(before, after) == pytest.approx(0.05, abs=0.01)
    assert [_distance_m(moved["magnets"][0], m) for m in moved["magnets"]] == pytest.approx([0, 1, 4], abs=1e-4)
    far = {"position": {"lon_deg": lon + 0.001, "lat_deg": lat}}
    refused(client.patch(path, json=far, headers={"If-Match": "*"}), 422, "invalid-parameter", field="position")
    turned = client.patch(path, json={"heading_deg": 3}, headers={"If-Match": "*"})
    refused(turned, 422, "invalid-parameter", field="heading_deg")


def test_a_surveyed_tag_is_looked_for_where_it_was_found(client: httpx.Client, lane: Lane) -> None:
    given = lane()
    marker = created(client, "/v1/markers", **_tag(given, 50.0))
    other = created(client, "/v1/markers", **_tag(given, 54.6))
    at = marker["position"]
    lon, lat, _ = GEOD.fwd(at["lon_deg"], at["lat_deg"], 90.0, 0.3)
    path = f"/v1/markers/{marker['id']}"
    nearer = client.patch(path, json={"position": {"lon_deg": lon, "lat_deg": lat}}, headers={"If-Match": '"1"'})
    assert other["id"] in refused(nearer, 409, "conflict")["detail"]
    lon, lat, _ = GEOD.fwd(at["lon_deg"], at["lat_deg"], 270.0, 0.3)
    away = client.patch(path, json={"position": {"lon_deg": lon, "lat_deg": lat}}, headers={"If-Match": '"1"'})
    assert away.status_code == 200, away.text
    refused(client.post("/v1/markers", json=_tag(given, 45.3)), 409, "conflict")


def test_a_line_has_no_single_place(client: httpx.Client, lane: Lane) -> None:
    marker = created(client, "/v1/markers", **_line(lane(), to_m=60))
    position = {name: marker["position"][name] for name in ("lon_deg", "lat_deg")}
    answer = client.patch(f"/v1/markers/{marker['id']}", json={"position": position}, headers={"If-Match": "*"})
    refused(answer, 422, "invalid-parameter", field="position")


def test_agencies_never_see_each_others_magnets(client: httpx.Client, server: LiveServer, lane: Lane) -> None:
    marker = created(client, "/v1/markers", **_tag(lane()))
    with server.agency("a nosy stranger to magnets") as stranger:
        for path in ("", "/layout.pdf", "/layout.csv", "/layout.geojson"):
            refused(stranger.get(f"/v1/markers/{marker['id']}{path}"), 404, "not-found")
    with server.agency("readers of magnets", Scope.VIEWER) as reader:
        refused(reader.post("/v1/markers", json=_tag(lane())), 403, "not-allowed")


# --- layouts ------------------------------------------------------------------------------------------------------


def test_layouts_hold_the_same_magnets(client: httpx.Client, lane: Lane) -> None:
    marker = created(client, "/v1/markers", **_tag(lane()))
    path = f"/v1/markers/{marker['id']}/layout"
    document = client.get(f"{path}.geojson")
    assert document.headers["content-type"] == "application/geo+json"
    assert document.json()["waymark"]["checks"] == marker["checks"]
    points = [feature["geometry"]["coordinates"] for feature in document.json()["features"]]
    assert points == [[magnet["lon_deg"], magnet["lat_deg"]] for magnet in marker["magnets"]]
    table = client.get(f"{path}.csv")
    assert table.headers["content-type"] == "text/csv; charset=utf-8"
    rows = list(csv.DictReader(io.StringIO(table.text)))
    assert [(float(r["lon_deg"]), float(r["lat_deg"]), r["polarity"]) for r in rows] == [
        (m["lon_deg"], m["lat_deg"], m["polarity"]) for m in marker["magnets"]
    ]
    sheet = client.get(f"{path}.pdf")
    assert sheet.headers["content-type"] == "application/pdf"
    assert sheet.content.startswith(b"%PDF-")
    assert sheet.headers["content-disposition"] == f'inline; filename="{marker["id"]}-r1.pdf"'
    refused(client.get(f"{path}.dxf"), 422, "invalid-parameter")


@pytest.mark.parametrize("form", ["pdf", "csv", "geojson"])
def test_a_layout_that_still_holds_saves_the_body(client: httpx.Client, lane: Lane, form: str) -> None:
    marker = created(client, "/v1/markers", **_tag(lane()))
    path = f"/v1/markers/{marker['id']}/layout.{form}"
    first = client.get(path)
    assert first.headers["cache-control"] == "private, no-cache"
    etag = {"If-None-Match": first.headers["etag"]}
    again = client.get(path, headers=etag)
    assert (again.status_code, again.content) == (304, b"")
    assert client.get(path).content == first.content
    client.patch(f"/v1/markers/{marker['id']}", json={"status": "built"}, headers={"If-Match": '"1"'})
    changed = client.get(path, headers=etag)
    assert changed.status_code == 200
    assert changed.headers["content-disposition"].endswith(f'-r2.{form}"')


def test_plates_have_no_layout_and_magnets_no_artwork(
    client: httpx.Client, place: Callable[[], dict[str, Any]], lane: Lane
) -> None:
    plate = client.post("/v1/markers", json={"position": place()}).json()
    refused(client.get(f"/v1/markers/{plate['id']}/layout.pdf"), 404, "not-found")
    magnets = created(client, "/v1/markers", **_tag(lane()))
    refused(client.get(f"/v1/markers/{magnets['id']}/artwork.svg"), 404, "not-found")


# --- OpenAPI ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_documented_examples_and_members(client: httpx.Client) -> None:
    schemas = client.get("/openapi.json").json()["components"]["schemas"]
    examples = schemas["MagnetIn"]["examples"]
    assert [example for example in schemas["NewMarkerIn"]["examples"] if example.get("family") == "magnet"] == examples
    tag, line = (created(client, "/v1/markers", **example) for example in examples)
    for made in (tag, line):
        assert set(made) == set(schemas["MagnetDetailDocument"]["required"])
        for part, schema in (("lane", "LaneDocument"), ("bill", "BillDocument")):
            assert set(made[part]) == set(schemas[schema]["properties"])
        assert set(made["magnets"][0]) == set(schemas["HoleDocument"]["properties"])
        assert set(made["checks"][0]) == set(schemas["Check"]["properties"])
    assert set(tag["code"]) == set(schemas["InformationTagDocument"]["properties"])
    assert set(line["code"]) == set(schemas["LineTagDocument"]["properties"])
    assert set(line["layout"]) == set(schemas["LinePlace"]["properties"])
    for item in client.get("/v1/markers").json()["items"]:
        assert set(item) == set(schemas["MagnetDocument"]["required"])


def test_the_guide_is_accepted(fresh_server: LiveServer) -> None:
    blocks = re.findall(r"```json\n(.*?)```", (ROOT / "docs/magnets.md").read_text(), re.S)
    book, *markers = (json.loads(block) for block in blocks)
    assert len(markers) == 2
    with fresh_server.client() as client:
        answer = client.post("/v1/codebooks", json=book)
        assert answer.status_code == 201, answer.text
        for marker in markers:
            created(client, "/v1/markers", **marker)
