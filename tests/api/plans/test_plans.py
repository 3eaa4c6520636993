"""The life of a plan over HTTP: from a road to planned markers, and what was built beside them."""

from __future__ import annotations

import itertools
import json
import math
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any
from xml.etree import ElementTree

import httpx
import pytest
from pyproj import CRS, Geod, Transformer

from tests.conftest import LiveServer
from tests.http import WITHIN_S, created, refused

pytestmark = pytest.mark.both_databases

GEOD = Geod(ellps="WGS84")
PLACES = itertools.count(1)
RULES: dict[str, Any] = {
    "version": 1,
    "plates": {"spacing_m": 100},
    "lines": {},
    "tags": {"magnets": 4},
    "cerpm": {"straight": 2.0, "max_path_error_m": 0.05},
    "costs": {"currency": "EUR", "items": [{"item": "plate", "per": "plate", "price": 120.0}]},
}


def road(lon_deg: float, lat_deg: float, length_m: float = 800.0) -> bytes:
    """A straight lane to the east with a stop line at its end, as GeoJSON."""
    points = [(lon_deg, lat_deg)]
    for at in range(20, int(length_m) + 1, 20):
        lon, lat, _ = GEOD.fwd(lon_deg, lat_deg, 90.0, at)
        points.append((lon, lat))
    lane = {
        "type": "Feature",
        "properties": {
            "lane": "1", "width_m": 3.5, "speed_limit_kmh": 70, "left_style": "dashed", "right_style": "solid",
        },
        "geometry": {"type": "LineString", "coordinates": points},
    }  # fmt: skip
    stop = {
        "type": "Feature",
        "properties": {"kind": "stop_line"},
        "geometry": {"type": "Point", "coordinates": points[-2]},
    }
    return json.dumps({"type": "FeatureCollection", "features": [lane, stop]}).encode()


def without_speed(data: bytes) -> bytes:
    """The road with no speed limit."""
    document = json.loads(data)
    for feature in document["features"]:
        feature["properties"].pop("speed_limit_kmh", None)
    return json.dumps(document).encode()


def send_road(client: httpx.Client, data: bytes, **declared: Any) -> httpx.Response:
    declared.setdefault("name", f"road {next(PLACES)}")
    parts = {"file": ("road.geojson", data, "application/geo+json"), "declaration": (None, json.dumps(declared))}
    return client.post("/v1/alignments", files=parts, timeout=300)


@pytest.fixture
def alignment(client: httpx.Client) -> dict[str, Any]:
    """A road of the test's agency."""
    step = next(PLACES)
    response = send_road(client, road(8.0, 47.0 + step * 0.02))
    assert response.status_code == 201, response.text
    document: dict[str, Any] = response.json()
    return document


@pytest.fixture
def agency() -> str:
    """Name of an agency that only this test uses."""
    return f"planners {next(PLACES)}"


@pytest.fixture
def client(server: LiveServer, agency: str) -> Iterator[httpx.Client]:
    """The author of plans."""
    with server.agency(agency) as author:
        yield author


@pytest.fixture
def other_planner(server: LiveServer, agency: str) -> Iterator[httpx.Client]:
    """The holder of another key of the same agency."""
    with server.agency(agency) as colleague:
        yield colleague


def make_plan(client: httpx.Client, alignment: dict[str, Any], **more: Any) -> dict[str, Any]:
    client.timeout = httpx.Timeout(300)
    rules = RULES | more
    return created(client, "/v1/plans", name=f"plan {next(PLACES)}", alignment_id=alignment["id"], rules=rules)


@pytest.mark.slow
def test_a_road_is_stored_with_its_lanes(client: httpx.Client, alignment: dict[str, Any]) -> None:
    assert client.get(f"/v1/alignments/{alignment['id']}").json() == alignment
    [lane] = alignment["lanes"]
    assert lane["length_m"] == pytest.approx(800.0, abs=0.01)
    assert lane["design_speed_kmh"] == pytest.approx([70.0, 70.0])
    assert alignment["events"][0]["kind"] == "stop_line"
    assert alignment in client.get("/v1/alignments").json()["items"]
    assert json.loads(client.get(f"/v1/alignments/{alignment['id']}/source").content)["features"]


def test_bad_roads_are_refused_and_nothing_is_stored(client: httpx.Client) -> None:
    refused(send_road(client, b"{}", name="nothing"), 422, field="file")
    refused(send_road(client, road(5.0, 47.0), name="two", crs="EPSG:4326", origin=[5.0, 47.0]), 422)
    refused(client.post("/v1/alignments", json={}), 422)
    refused(client.post("/v1/alignments", content=b"{}", headers={"Content-Type": "text/plain"}), 415)
    assert client.get("/v1/alignments").json()["items"] == []


def test_exchanged_coordinates_are_noticed_beside_registered_markers(client: httpx.Client) -> None:
    created(client, "/v1/markers", position={"lon_deg": 11.0, "lat_deg": 46.0}, heading_deg=90)
    right = json.loads(road(11.0, 46.0))
    wrong = json.loads(json.dumps(right))
    for feature in wrong["features"]:
        points = feature["geometry"]["coordinates"]
        feature["geometry"]["coordinates"] = [p[::-1] for p in points] if isinstance(points[0], list) else points[::-1]
    warnings = send_road(client, json.dumps(wrong).encode()).json()["warnings"]
    assert "some are near it if longitude and latitude are exchanged" in warnings[0]
    assert send_road(client, json.dumps(right).encode()).json()["warnings"] == []


def test_feet_of_a_road_are_those_of_its_crs_unless_declared(client: httpx.Client) -> None:
    """`foot` in a state plane file; the line begins 0.6 m farther north-east in US survey feet."""
    text = (
        '<LandXML xmlns="http://www.landxml.org/schema/LandXML-1.2"><Units><Imperial linearUnit="foot"/></Units>'
        '<CoordinateSystem epsgCode="6539"/><Alignments><Alignment name="A"><CoordGeom><Line><Start>200000 986000'
        "</Start><End>200000 986300</End></Line></CoordGeom></Alignment></Alignments></LandXML>"
    )
    west = {}
    for unit in (None, "ft-us", "ft-intl"):
        declared = {} if unit is None else {"unit": unit}
        document = send_road(client, text.encode(), **declared).json()
        west[unit] = document["extent_deg"][0]
        assert any("read as ft-us" in warning for warning in document["warnings"]) == (unit is None)
    assert west[None] == west["ft-us"] == pytest.approx(-73.9936932, abs=1e-7)
    assert west["ft-intl"] == pytest.approx(-73.9937003, abs=1e-7)


@pytest.mark.slow
def test_a_plan_is_made_checked_approved_and_committed(
    client: httpx.Client, alignment: dict[str, Any], other_planner: httpx.Client
) -> None:
    plan = make_plan(client, alignment)
    assert plan["status"] == "checked", [f for f in plan["findings"] if f["verdict"] == "fail"]
    assert plan["counts"].keys() == {"plate", "magnet", "cerpm"}
    assert plan["cost"] == 120.0 * plan["counts"]["plate"]
    assert not plan["cost_complete"]
    url = f"/v1/plans/{plan['id']}"
    head = {"If-Match": '"1"'}
    refused(client.post(f"{url}/commit", headers=head), 409, field="status")
    refused(client.post(f"{url}/approve", headers=head), 409, field="approver")
    refused(other_planner.post(f"{url}/approve"), 428)
    approved = other_planner.post(f"{url}/approve", headers=head).json()
    assert approved["status"] == "approved"
    assert approved["approver"]
    refused(other_planner.post(f"{url}/approve", headers={"If-Match": '"2"'}), 409, field="status")
    refused(client.post(f"{url}/commit", headers=head), 412)
    key = {"Idempotency-Key": "commit"}
    response = client.post(f"{url}/commit", headers={"If-Match": '"2"'} | key)
    assert response.status_code == 201, response.text
    committed = response.json()
    assert committed["status"] == "committed"
    assert committed["uncommitted"] == 0
    again = client.post(f"{url}/commit", headers={"If-Match": '"2"'} | key)
    assert again.json() == committed
    markers = client.get("/v1/markers", params={"limit": 1000}).json()["items"]
    assert len(markers) == committed["markers"]
    assert {marker["status"] for marker in markers} == {"planned"}
    by_family = {family: [m for m in markers if m["family"] == family] for family in plan["counts"]}
    assert len(by_family["plate"]) == plan["counts"]["plate"]
    assert len(by_family["cerpm"]) == plan["counts"]["cerpm"]
    holes = [client.get(f"/v1/markers/{m['id']}").json()["magnets"] for m in by_family["magnet"]]
    planned = client.get(f"{url}/files/plan.json").json()["markers"]
    magnets = [m for m in planned if m["family"] == "magnet"]
    assert sum(len(found) for found in holes) == sum(len(m["detail"].get("magnets", [1])) for m in magnets)
    [entry] = [e for e in client.get(f"{url}/versions").json()["items"] if e["plan"]["status"] == "committed"]
    assert entry["version"] == 3
    refused(client.patch(url, json={"name": "late"}, headers={"If-Match": '"3"'}), 409, field="status")


def test_of_two_that_commit_a_plan_at_once_one_does(
    client: httpx.Client, alignment: dict[str, Any], other_planner: httpx.Client
) -> None:
    plan = make_plan(client, alignment)
    url = f"/v1/plans/{plan['id']}"
    other_planner.post(f"{url}/approve", headers={"If-Match": '"1"'})
    other_planner.timeout = client.timeout
    both = threading.Barrier(2)

    def commit(who: httpx.Client, version: str) -> httpx.Response:
        both.wait(WITHIN_S)
        return who.post(f"{url}/commit", headers={"If-Match": version})

    with ThreadPoolExecutor(2) as pool:
        started = [pool.submit(commit, client, '"2"'), pool.submit(commit, other_planner, "*")]
        done = sorted((one.result() for one in started), key=lambda response: response.status_code)
    assert done[0].status_code == 201, done[0].text
    assert done[1].status_code in (409, 412), done[1].text  # by the plan's state, or by its version
    assert done[1].json()["cure"]
    committed = done[0].json()
    assert (committed["status"], committed["uncommitted"]) == ("committed", 0)
    markers = client.get("/v1/markers", params={"limit": 1000}).json()["items"]
    assert len(markers) == committed["markers"]
    assert len(client.get(f"{url}/versions").json()["items"]) == 3


def test_other_rules_place_it_again_and_take_the_approval_back(
    client: httpx.Client, alignment: dict[str, Any], other_planner: httpx.Client
) -> None:
    plan = make_plan(client, alignment)
    url = f"/v1/plans/{plan['id']}"
    other_planner.post(f"{url}/approve", headers={"If-Match": '"1"'})
    rules = {"version": 1, "plates": {"spacing_m": 50}}
    changed = client.patch(url, json={"rules": rules, "reason": "closer"}, headers={"If-Match": '"2"'}).json()
    assert changed["status"] == "checked"
    assert changed["approver"] is None
    assert changed["counts"] == {"plate": 16}
    assert [v["version"] for v in client.get(f"{url}/versions").json()["items"]] == [1, 2, 3]


def test_files_of_a_plan(client: httpx.Client, alignment: dict[str, Any]) -> None:
    plan = make_plan(client, alignment)
    url = f"/v1/plans/{plan['id']}/files"
    assert client.get(f"{url}/bill.csv").text.count("plate")
    document = client.get(f"{url}/plan.json").json()
    assert len(document["markers"]) == sum(plan["counts"].values())
    assert client.get(f"{url}/plan.geojson").json()["features"]
    assert "stakeout-pnezd.csv" in refused(client.get(f"{url}/plan.exe"), 404, field="name")["limit"]
    metres, feet = (
        client.get(f"{url}/stakeout-pnezd.csv", params={"crs": "EPSG:32632", "unit": u}) for u in ("m", "ft-intl")
    )
    first, in_feet = (float(text.text.splitlines()[-1].split(",")[1]) for text in (metres, feet))
    assert first == pytest.approx(in_feet * 0.3048, abs=1e-3)
    refused(client.get(f"{url}/stakeout-pnezd.csv", params={"crs": "EPSG:1"}), 422)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("crs", "realization", "other", "apart_m"),
    [("EPSG:25832", "ETRF2000", "ETRF2014", 0.07), ("EPSG:6539", "NAD83(2011)", None, 0.0)],
)
def test_stakeout_and_exports_lie_on_the_axis_that_was_sent(
    client: httpx.Client,
    other_planner: httpx.Client,
    crs: str,
    realization: str,
    other: str | None,
    apart_m: float,
) -> None:
    """A straight axis along the grid, in its own system, realization and epoch, comes back to a millimetre."""
    unit_m, start = (1.0, (458_000.0, 5_428_000.0)) if crs == "EPSG:25832" else (1200 / 3937, (990_000.0, 200_000.0))
    lane = {
        "type": "Feature",
        "properties": {"lane": "1", "width_m": 3.5, "speed_limit_kmh": 70},
        "geometry": {
            "type": "LineString",
            "coordinates": [(start[0] + k * 20.0 / unit_m, start[1] + k * 6.0 / unit_m) for k in range(21)],
        },
    }
    data = json.dumps({"type": "FeatureCollection", "features": [lane]}).encode()
    alignment = send_road(client, data, crs=crs, realization=realization, epoch=2026.4).json()
    plan = make_plan(client, alignment, lines=None, tags=None, cerpm=None)
    url = f"/v1/plans/{plan['id']}"

    def staked(**asked: Any) -> dict[str, tuple[float, float]]:
        lines = client.get(f"{url}/files/stakeout-pnezd.csv", params=asked).text.splitlines()
        return {line.split(",")[0]: (float(line.split(",")[2]), float(line.split(",")[1])) for line in lines}

    def away_m(at: tuple[float, float]) -> float:
        east, north = (value * unit_m for value in (at[0] - start[0], at[1] - start[1]))
        return (6.0 * east - 20.0 * north) / math.hypot(6.0, 20.0)

    points = staked()
    assert len(points) == plan["counts"]["plate"]
    assert max(abs(away_m(at)) for at in points.values()) < 0.001
    if other is not None:
        elsewhere = staked(realization=other)
        apart = [math.dist(points[name], elsewhere[name]) for name in points]
        assert apart == pytest.approx([apart_m] * len(apart), abs=0.02)
        refused(client.get(f"{url}/files/stakeout-pnezd.csv", params={"realization": "GDA2020"}), 422)
    assert other_planner.post(f"{url}/approve", headers={"If-Match": '"1"'}).status_code == 200
    assert client.post(f"{url}/commit", headers={"If-Match": '"2"'}).status_code == 201
    document = ElementTree.fromstring(client.get("/v1/exports/landxml").content)
    space = "{http://www.landxml.org/schema/LandXML-1.2}"
    system = document.find(f"{space}CoordinateSystem")
    assert system is not None
    assert system.attrib["epsgCode"] == crs.removeprefix("EPSG:")
    assert realization in system.attrib["desc"]
    exported = sorted((float(e), float(n)) for n, e in (str(p.text).split() for p in document.iter(f"{space}CgPoint")))
    assert exported == [pytest.approx(at, abs=2e-4) for at in sorted(points.values())]
    offsets = itertools.cycle([(1.5, -0.7), (-0.4, 1.2), (0.003, 0.8), (-1.1, -1.6)])  # [m] along the grid
    pairs = zip(points.items(), offsets, strict=False)
    built = {name: (e + de / unit_m, n + dn / unit_m) for (name, (e, n)), (de, dn) in pairs}
    rows = "".join(f"{name},{n:.5f},{e:.5f},,built\n" for name, (e, n) in built.items())
    declaration = {
        "layout": "pnezd", "crs": crs, "realization": realization, "epoch": 2026.4, "compare": True,
        "match": "nearest", "tolerance_m": 5.0, "dry_run": True,
    }  # fmt: skip
    form = {"declaration": json.dumps(declaration)}
    answer = client.post("/v1/imports", files={"file": ("as-built.csv", rows.encode())}, data=form)
    assert answer.status_code == 200, answer.text
    residuals = answer.json()["comparison"]["residuals"]
    assert len(residuals) == len(points)
    degrees = Transformer.from_crs(crs, CRS(crs).geodetic_crs, always_xy=True)
    for residual, name in zip(residuals, points, strict=True):
        azimuth_deg, _, length_m = Geod(ellps="GRS80").inv(
            *degrees.transform(*points[name]), *degrees.transform(*built[name])
        )
        expected = length_m * math.sin(math.radians(azimuth_deg)), length_m * math.cos(math.radians(azimuth_deg))
        assert (residual["east_m"], residual["north_m"]) == pytest.approx(expected, abs=1e-3)


def test_a_road_with_its_own_stations_has_them_everywhere(client: httpx.Client, other_planner: httpx.Client) -> None:
    """An axis of 800 m from station 1+000; at 1+300 stations go on from 1+100, and at the new 1+400 from 2+000."""
    text = (
        '<LandXML xmlns="http://www.landxml.org/schema/LandXML-1.2"><Units><Metric linearUnit="meter"/></Units>'
        '<CoordinateSystem epsgCode="25832"/><Alignments><Alignment name="CL" staStart="1000"><CoordGeom><Line><Start>'
        "5428000 458000</Start><End>5428000 458800</End></Line></CoordGeom>"
        '<StaEquation staInternal="1300" staBack="1300" staAhead="1100"/>'
        '<StaEquation staInternal="1600" staBack="1400" staAhead="2000"/></Alignment></Alignments></LandXML>'
    )

    def shown(along_m: float) -> float:
        return along_m + (1000 if along_m < 300 else 800 if along_m < 600 else 1400)

    alignment = send_road(client, text.encode(), name="B 10, section 3").json()
    rules = {"plates": {"spacing_m": 50}, "road": {"design_speed_kmh": 70, "lane_width_m": 3.5}, "cerpm": {}}
    plan = make_plan(client, alignment, lines=None, tags=None, **rules)
    url = f"/v1/plans/{plan['id']}"
    planned = {marker["number"]: marker for marker in client.get(f"{url}/files/plan.json").json()["markers"]}
    length_m = alignment["lanes"][0]["length_m"]  # on the ellipsoid; stations are distances of the grid
    for marker in planned.values():
        assert marker["station_m"] == pytest.approx(shown(marker["chainage_m"] * 800 / length_m), abs=0.001)
    stations = {n: f"{int(m['station_m'] // 1000)}+{m['station_m'] % 1000:06.2f}" for n, m in planned.items()}
    features = client.get(f"{url}/files/plan.geojson").json()["features"]
    assert {f["id"]: f["properties"]["station"] for f in features if f["properties"]["kind"] == "marker"} == stations
    staked = client.get(f"{url}/files/stakeout-pnezd.csv").text
    assert all(f"STA {station}" in staked for station in stations.values())
    served = client.get("/ogc/collections/plans/items", params={"limit": 1000}).json()["features"]
    assert {f["properties"]["number"]: round(f["properties"]["station_m"], 3) for f in served} == {
        number: round(marker["station_m"], 3) for number, marker in planned.items()
    }
    found = [finding for finding in plan["findings"] if finding["station_m"] is not None]
    assert found
    assert {round(finding["station_m"], 4) for finding in found} <= {round(m["station_m"], 4) for m in planned.values()}
    assert any(f["station_m"] >= 2000 or f["station_m"] < 1400 for f in found)
    assert other_planner.post(f"{url}/approve", headers={"If-Match": '"1"'}).status_code == 200
    assert client.post(f"{url}/commit", headers={"If-Match": '"2"'}).status_code == 201
    markers = client.get("/v1/markers", params={"limit": 1000, "family": "plate"}).json()["items"]
    assert {marker["road"] for marker in markers} == {"B 10, section 3"}
    plates = sorted(round(m["station_m"], 3) for m in planned.values() if m["family"] == "plate")
    assert sorted(round(marker["measure_m"], 3) for marker in markers) == plates
    twice = client.get(
        "/v1/markers", params={"family": "plate", "road": "B 10, section 3", "from_m": 1100, "to_m": 1300}
    ).json()["items"]
    wanted = [m for m in planned.values() if m["family"] == "plate" and 1100 <= m["station_m"] <= 1300]
    assert len(twice) == len(wanted)
    assert {m["chainage_m"] < 300 for m in wanted} == {True, False}, "before the equation and after it"
    none = client.get("/v1/markers", params={"road": "B 10, section 3", "from_m": 1410, "to_m": 1990}).json()["items"]
    assert none == []
    line = {"type": "LineString", "coordinates": [[458_000, 5_428_000], [458_800, 5_428_000]]}
    points = [
        {"measure_m": 1000, "vertex": 0},
        {"measure_m": 1300, "ahead_m": 1100, "chainage_m": 300 * length_m / 800},
        {"measure_m": 1400, "ahead_m": 2000, "chainage_m": 600 * length_m / 800},
        {"measure_m": 2200, "vertex": 1},
    ]
    registered = created(
        client, "/v1/roads", name="B 10, section 3", crs="EPSG:25832", geometry=line, calibration=points
    )
    assert registered["markers"]["left"] == 0
    assert registered["markers"]["largest_change_m"] < 0.1


@pytest.mark.parametrize(
    ("rules", "field"),
    [
        ({"version": 1}, None),
        ({"version": 1, "plates": {"spacing": 10}}, "plates.spacing"),
        ({"version": 1, "plates": {"spacing_m": -1}}, "plates.spacing_m"),
        ({"version": 1, "plates": {}, "road": {"lanes": ["7"]}}, "road.lanes"),
        ({"version": 1, "tags": {"codebook": "none such"}}, "rules.tags.codebook"),
    ],
)
def test_bad_rules_are_refused_and_no_plan_is_stored(
    client: httpx.Client, alignment: dict[str, Any], rules: dict[str, Any], field: str | None
) -> None:
    body = {"name": "bad", "alignment_id": alignment["id"], "rules": rules}
    refused(client.post("/v1/plans", json=body, timeout=300), 422, field=field)
    assert client.get("/v1/plans").json()["items"] == []


def test_as_built_residuals_are_those_of_the_survey(
    client: httpx.Client, alignment: dict[str, Any], other_planner: httpx.Client
) -> None:
    plan = make_plan(client, alignment, lines=None, tags=None, cerpm=None)
    url = f"/v1/plans/{plan['id']}"
    assert client.get(f"{url}/as-built").json()["markers"] == []
    other_planner.post(f"{url}/approve", headers={"If-Match": '"1"'})
    assert client.post(f"{url}/commit", headers={"If-Match": '"2"'}).status_code == 201
    markers = client.get("/v1/markers").json()["items"]
    for marker, (along, across) in zip(markers[:2], [(0.03, 0.0), (0.0, 0.20)], strict=True):
        lon, lat = marker["position"]["lon_deg"], marker["position"]["lat_deg"]
        lon, lat, _ = GEOD.fwd(lon, lat, 90.0, along)
        lon, lat, _ = GEOD.fwd(lon, lat, 0.0, across)
        change = {"status": "surveyed", "position": {"lon_deg": lon, "lat_deg": lat, "horizontal_rmse_m": 0.01}}
        response = client.patch(f"/v1/markers/{marker['id']}", json=change, headers={"If-Match": '"1"'})
        assert response.status_code == 200, response.text
    built = client.get(f"{url}/as-built").json()
    assert (built["surveyed"], built["not_surveyed"], built["out_of_tolerance"]) == (2, len(markers) - 2, 1)
    far, near = built["markers"]
    assert far["across_m"] == pytest.approx(0.20, abs=1e-3)
    assert near["along_m"] == pytest.approx(0.03, abs=1e-3)
    assert near["in_tolerance"]


def test_plans_of_another_agency_are_not_found(
    server: LiveServer, client: httpx.Client, alignment: dict[str, Any]
) -> None:
    plan = make_plan(client, alignment)
    with server.agency("a stranger to plans") as stranger:
        refused(stranger.get(f"/v1/plans/{plan['id']}"), 404)
        refused(stranger.get(f"/v1/alignments/{alignment['id']}"), 404)
        body = {"name": "mine", "alignment_id": alignment["id"], "rules": RULES}
        refused(stranger.post("/v1/plans", json=body), 404)


def test_a_road_without_speeds_is_stored_and_the_rules_of_a_plan_give_them(client: httpx.Client) -> None:
    alignment = send_road(client, without_speed(road(9.0, 47.0 + next(PLACES) * 0.02))).json()
    assert alignment["lanes"][0]["design_speed_kmh"] is None
    for name in ("map.osm", "map.xodr"):
        drawn = client.get(f"/v1/alignments/{alignment['id']}/{name}")
        assert drawn.status_code == 200, drawn.text
        assert "nan" not in drawn.text
    wanted = {"name": f"plan {next(PLACES)}", "alignment_id": alignment["id"], "rules": {"version": 1, "plates": {}}}
    problem = refused(client.post("/v1/plans", json=wanted), 422)
    assert problem["field"] == "road.design_speed_kmh"
    wanted["rules"] = {"version": 1, "plates": {}, "road": {"design_speed_kmh": 60}}
    assert created(client, "/v1/plans", **wanted)["counts"]["plate"] > 0
