"""Roads over HTTP: registering, measures and positions there and back, recalibration with the markers that follow."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import httpx
import pytest
from pyproj import Geod, Transformer

from tests.conftest import LiveServer
from tests.http import refused

pytestmark = pytest.mark.both_databases

GEOD = Geod(ellps="WGS84")
LANES = sorted((Path(__file__).parents[3] / "benchmarks/cerpm/routes").glob("*.geojson"))
Line = list[list[float]]
_STARTS = itertools.count(1)


def _line(*steps: tuple[float, float], start: tuple[float, float] | None = None) -> Line:
    """A line of (heading_deg, length_m) steps."""
    points = [list(start or (8.0 + next(_STARTS) * 0.11 % 20, 49.0))]
    for heading_deg, length_m in steps:
        points.append(list(GEOD.fwd(*points[-1], heading_deg, length_m)[:2]))
    return points


def _ahead(place: list[float], metres: float) -> tuple[float, float]:
    """A place north of another one."""
    lon, lat, _ = GEOD.fwd(*place, 0, metres)
    return float(lon), float(lat)


def _along(line: Line, metres: float, left_m: float = 0.0) -> list[float]:
    """A place along the first edge of a line."""
    heading = GEOD.inv(*line[0], *line[1])[0]
    lon, lat, back = GEOD.fwd(*line[0], heading, metres)
    return list(GEOD.fwd(lon, lat, back + 180 - 90, left_m)[:2])


def _road(client: httpx.Client, name: str, line: Line, **more: Any) -> dict[str, Any]:
    body = {"name": name, "geometry": {"type": "LineString", "coordinates": line}, **more}
    answer = client.post("/v1/roads", json=body)
    assert answer.status_code == 201, answer.text
    return dict(answer.json())


def _patch(client: httpx.Client, road: dict[str, Any], **body: Any) -> httpx.Response:
    return client.patch(f"/v1/roads/{road['id']}", json=body, headers={"If-Match": f'"{road["version"]}"'})


def _marker(client: httpx.Client, spot: list[float], **more: Any) -> dict[str, Any]:
    body = {"family": "cerpm", "position": {"lon_deg": spot[0], "lat_deg": spot[1]}, **more}
    answer = client.post("/v1/markers", json=body)
    assert answer.status_code == 201, answer.text
    return dict(answer.json())


def test_a_road_is_kept_as_it_came(client: httpx.Client) -> None:
    line = _line((10, 500), (20, 700))
    answer = client.post("/v1/roads", json={"name": "B 10", "geometry": {"type": "LineString", "coordinates": line}})
    road = answer.json()
    assert answer.headers["location"] == f"/v1/roads/{road['id']}"
    assert answer.headers["etag"] == '"1"'
    assert (road["length_m"], road["from_m"], road["to_m"]) == (pytest.approx(1200), 0, pytest.approx(1200))
    assert road["geometry"] == {"type": "LineString", "coordinates": line}
    assert road["localization_grade"] == "m"
    assert "state the realization" in road["transform_note"]
    stored = client.get(f"/v1/roads/{road['id']}")
    assert stored.json() | {"markers": road["markers"]} == road
    listed = client.get("/v1/roads?name=B 10").json()["items"]
    assert [item["id"] for item in listed] == [road["id"]]
    assert "geometry" not in listed[0]
    refused(client.post("/v1/roads", json={"name": "B 10", "geometry": road["geometry"]}), 409, field="name")


@pytest.mark.parametrize("path", LANES, ids=lambda path: path.stem)
def test_real_lanes_there_and_back(client: httpx.Client, path: Path) -> None:
    features = json.loads(path.read_text())["features"]
    line = next(f["geometry"]["coordinates"] for f in features if f["geometry"]["type"] == "LineString")
    last = len(line) - 1
    road = _road(client, path.stem, line, calibration=[{"measure_m": 7_000, "vertex": 0}])
    road = _patch(
        client,
        road,
        calibration=[{"measure_m": 7_000, "vertex": 0}, {"measure_m": 7_000 + road["length_m"] * 1.02, "vertex": last}],
    ).json()
    span = road["to_m"] - road["from_m"]
    references = [{"measure_m": 7_000 + span * (k + 0.5) / 100, "offset_m": (k % 7 - 3) * 0.9} for k in range(100)]
    placed = client.post(f"/v1/roads/{road['id']}/position", json={"references": references}).json()["items"]
    positions = [[item["places"][0]["lon_deg"], item["places"][0]["lat_deg"]] for item in placed]
    located = client.post(f"/v1/roads/{road['id']}/locate", json={"positions": positions}).json()["items"]
    for reference, place, item in zip(references, placed, located, strict=True):
        if place["places"][0]["exact"]:
            assert min(
                abs(foot["measure_m"] - reference["measure_m"]) + abs(foot["offset_m"] - reference["offset_m"])
                for foot in item["feet"]
            ) == pytest.approx(0, abs=1e-5)


def test_one_position_and_one_reference(client: httpx.Client) -> None:
    line = _line((90, 3_000))
    road = _road(client, "A 1", line, calibration=[{"measure_m": 12_000, "vertex": 0}])
    lon, lat = _along(line, 700, 3.5)
    found = client.get(f"/v1/roads/{road['id']}/locate", params={"lon": lon, "lat": lat}).json()
    assert (found["road"], found["version"], found["ambiguous"]) == ("A 1", 1, False)
    (foot,) = found["feet"]
    assert (foot["measure_m"], foot["offset_m"]) == (pytest.approx(12_700, abs=1e-6), pytest.approx(3.5, abs=1e-6))
    assert foot["heading_deg"] == pytest.approx(90, abs=0.05)
    query = {"measure_m": 12_700, "offset_m": 3.5}
    (place,) = client.get(f"/v1/roads/{road['id']}/position", params=query).json()["places"]
    assert GEOD.inv(place["lon_deg"], place["lat_deg"], lon, lat)[2] < 1e-6
    away = client.get(f"/v1/roads/{road['id']}/locate", params={"lon": lon, "lat": lat + 0.1}).json()
    assert (away["feet"], away["ambiguous"]) == ([], False)
    problem = refused(client.get(f"/v1/roads/{road['id']}/position?measure_m=11999"), 422, field="measure_m")
    assert "12000" in problem["limit"]
    many = client.post(f"/v1/roads/{road['id']}/position", json={"references": [{"measure_m": 11_999}]}).json()
    assert many["items"] == [{"ambiguous": False, "places": []}]


def test_geometry_in_a_projected_system_keeps_its_lengths_and_says_how_good_it_is(client: httpx.Client) -> None:
    to_utm = Transformer.from_crs(4326, 32632, always_xy=True)
    line = _line((45, 800), (60, 900), start=(9.0, 48.0))
    utm = [list(to_utm.transform(*point)) for point in line]
    road = _road(client, "UTM", utm, crs="EPSG:32632", calibration=[{"measure_m": 100, "position": utm[1]}])
    assert road["crs"] == "EPSG:32632"
    assert road["length_m"] == pytest.approx(1700, abs=1e-3)
    assert road["from_m"] == pytest.approx(-700, abs=1e-3)
    assert road["localization_grade"] == "m"
    assert "state the realization" in road["transform_note"]
    nad83 = _road(client, "NAD83", _line((0, 500), start=(-85.0, 42.0)), crs="EPSG:4269")
    assert nad83["localization_grade"] == "unfit"
    assert nad83["transform_note"]


def test_a_hairpin_is_reported(client: httpx.Client) -> None:
    line = _line((0, 300), (90, 9), (180, 300))
    road = _road(client, "pass", line)
    lon, lat = _along(line, 120, -4.4)
    found = client.get(f"/v1/roads/{road['id']}/locate", params={"lon": lon, "lat": lat}).json()
    assert found["ambiguous"]
    measures = [foot["measure_m"] for foot in found["feet"]]
    assert measures == [pytest.approx(120, abs=0.01), pytest.approx(489, abs=0.01)]


def test_equations_of_stationing(client: httpx.Client) -> None:
    line = _line((0, 1_000), (0, 1_000))
    calibration = [{"measure_m": 0, "vertex": 0}, {"measure_m": 1_000, "ahead_m": 900, "vertex": 1}]
    road = _road(client, "equation", line, calibration=calibration)
    assert [(round(s["from_m"]), round(s["to_m"])) for s in road["sections"]] == [(0, 1_000), (900, 1_900)]
    twice = client.get(f"/v1/roads/{road['id']}/position?measure_m=950").json()
    assert twice["ambiguous"]
    assert [place["section"] for place in twice["places"]] == [0, 1]
    calibration[1]["ahead_m"] = 1_100
    road = _patch(client, road, calibration=calibration).json()
    refused(client.get(f"/v1/roads/{road['id']}/position?measure_m=1050"), 422, field="measure_m")


def test_parts_and_gaps(client: httpx.Client) -> None:
    first = _line((0, 500))
    second = _line((0, 500), start=_ahead(first[-1], 200))
    geometry = {"type": "MultiLineString", "coordinates": [first, second]}
    calibration = [{"measure_m": 0, "vertex": 0}, {"measure_m": 700, "part": 1, "vertex": 0}]
    road = client.post("/v1/roads", json={"name": "gap", "geometry": geometry, "calibration": calibration}).json()
    assert road["geometry"] == geometry
    refused(client.get(f"/v1/roads/{road['id']}/position?measure_m=600"), 422, field="measure_m")
    (place,) = client.get(f"/v1/roads/{road['id']}/position?measure_m=700").json()["places"]
    assert GEOD.inv(place["lon_deg"], place["lat_deg"], *second[0])[2] < 1e-6


def test_known_measures_are_sent_back_as_they_were_answered(client: httpx.Client) -> None:
    first = _line((0, 500), (10, 300))
    second = _line((0, 500), start=_ahead(first[-1], 200))
    known = [
        {"measure_m": 0, "vertex": 0},
        {"measure_m": 260, "ahead_m": 300, "chainage_m": 250.5},
        {"measure_m": 550, "vertex": 1},
        {"measure_m": 1200, "part": 1, "chainage_m": 900},
    ]
    geometry = {"type": "MultiLineString", "coordinates": [first, second]}
    road = client.post("/v1/roads", json={"name": "there and back", "geometry": geometry, "calibration": known}).json()
    assert [point["vertex"] for point in road["calibration"]] == [0, None, 1, None]
    assert [point["chainage_m"] for point in road["calibration"]] == pytest.approx([0, 250.5, 500, 900], abs=1e-3)
    given = [{**point, "chainage_m": None} if point["vertex"] is not None else point for point in road["calibration"]]
    again = _patch(client, road, calibration=given).json()
    assert again["calibration"] == road["calibration"]
    assert again["sections"] == road["sections"]


def test_a_new_calibration_is_in_the_realization_of_the_road(client: httpx.Client) -> None:
    """Positions of posts on a road in NAD83(CORS96) were half a metre off when they were sent again."""
    geometry = {"type": "LineString", "coordinates": [[500_000, 4_500_000], [500_600, 4_500_100], [500_900, 4_500_800]]}
    known = [
        {"measure_m": 0, "position": [500_100.0, 4_500_016.7]},
        {"measure_m": 900, "position": [500_750.0, 4_500_450.0]},
    ]
    body = {"name": "I 80", "crs": "EPSG:26918", "realization": "NAD83(CORS96)", "epoch": 2002.0, "geometry": geometry}
    road = client.post("/v1/roads", json={**body, "calibration": known}).json()
    again = _patch(client, road, calibration=known).json()
    for one, other in zip(road["calibration"], again["calibration"], strict=True):
        assert other["chainage_m"] == pytest.approx(one["chainage_m"], abs=1e-6)


# --- markers ------------------------------------------------------------------------------------------------------


def test_markers_on_a_road_get_their_measures_and_keep_their_places(client: httpx.Client) -> None:
    line = _line((30, 2_000))
    spots = [_along(line, 100 * (k + 1), 2.0 * (-1) ** k) for k in range(5)]
    markers = [_marker(client, spot, road="A 8") for spot in spots]
    assert all(marker["measure_m"] is None for marker in markers)
    far = _marker(client, _along(line, 500, 400), road="A 8", measure_m=5.0)
    beyond = _marker(client, _along(line, -7), road="A 8")
    other = _marker(client, _along(line, 600), road="A 9", measure_m=1.0)
    road = _road(client, "A 8", line, calibration=[{"measure_m": 50_000, "vertex": 0}])
    assert (road["markers"]["measured"], road["markers"]["left"]) == (5, 2)
    why = {item["marker_id"]: item["why"] for item in road["markers"]["left_out"]}
    assert "100 m" in why[far["id"]]
    assert "7.00 m beyond" in why[beyond["id"]]
    for k, before in enumerate(markers):
        now = client.get(f"/v1/markers/{before['id']}").json()
        assert now["measure_m"] == pytest.approx(50_000 + 100 * (k + 1), abs=1e-6)
        assert now["offset_m"] == pytest.approx(2.0 * (-1) ** k, abs=1e-6)
        assert now["position"] == before["position"]
        assert now["version"] == 2
        history = client.get(f"/v1/markers/{before['id']}/versions").json()["items"]
        assert history[1]["why"] == "measured on version 1 of road A 8"
    assert client.get(f"/v1/markers/{far['id']}").json()["measure_m"] == 5.0
    assert client.get(f"/v1/markers/{other['id']}").json()["version"] == 1
    ids = [marker["id"] for marker in markers]
    url = f"/v1/roads/{road['id']}/markers"
    assert [m["id"] for m in client.get(f"{url}?from_m=50150&to_m=50450").json()["items"]] == ids[1:4]
    assert [m["id"] for m in client.get(f"{url}?from_m=50000&min_offset_m=0").json()["items"]] == ids[::2]
    page = client.get(f"{url}?from_m=50000&limit=2")
    rest = client.get(page.links["next"]["url"])
    assert [m["id"] for answer in (page, rest) for m in answer.json()["items"]] == ids[:4]


def test_markers_where_measures_repeat_are_listed_along_the_road(client: httpx.Client) -> None:
    """Measures go on at 300 m after 500 m: each one between occurs twice, 200 m apart, and none from 900 m on."""
    line = _line((0, 1_000))
    spots = [_along(line, along_m, 2.0) for along_m in (100, 350, 450, 550, 650, 900)]
    markers = [_marker(client, spot, road="B 3") for spot in spots]
    points = [{"measure_m": 0, "vertex": 0}, {"measure_m": 500, "ahead_m": 300, "chainage_m": 500}]
    road = _road(client, "B 3", line, calibration=points)
    ids = [marker["id"] for marker in markers]
    url = f"/v1/roads/{road['id']}/markers"
    listed = client.get(url).json()["items"]
    assert [m["id"] for m in listed] == ids
    assert [round(m["measure_m"]) for m in listed] == [100, 350, 450, 350, 450, 700]
    assert [m["id"] for m in client.get(f"{url}?from_m=340&to_m=460").json()["items"]] == ids[1:5]
    assert [m["id"] for m in client.get(f"{url}?from_m=340&to_m=460&section=1").json()["items"]] == ids[3:5]
    assert [m["id"] for m in client.get(f"{url}?section=0").json()["items"]] == ids[:3]
    found, address = [], f"{url}?limit=2"
    while address:
        page = client.get(address)
        found += [m["id"] for m in page.json()["items"]]
        address = page.links["next"]["url"] if "next" in page.links else ""
    assert found == ids
    refused = client.get(f"{url}?section=2")
    assert (refused.status_code, refused.json()["limit"]) == (422, "0 to 1")
    assert client.get(f"{url}?after=1,2").status_code == 422


def test_measures_follow_a_recalibration(client: httpx.Client) -> None:
    line = _line((200, 4_000))
    road = _road(client, "A 61", line)
    marker = _marker(client, _along(line, 1_000, -3.5), road="A 61")
    assert (marker["measure_m"], marker["offset_m"]) == (pytest.approx(1_000), pytest.approx(-3.5))
    calibration = [{"measure_m": 20_000, "vertex": 0}, {"measure_m": 24_400, "vertex": 1}]
    checked = _patch(client, road, calibration=calibration, dry_run=True)
    assert checked.json()["markers"]["largest_change_m"] == pytest.approx(20_100)
    assert client.get(f"/v1/markers/{marker['id']}").json() == marker
    assert client.get(f"/v1/roads/{road['id']}").json()["version"] == 1
    answer = _patch(client, road, calibration=calibration, reason="new posts")
    assert answer.headers["etag"] == '"2"'
    assert answer.json()["markers"]["measured"] == 1
    now = client.get(f"/v1/markers/{marker['id']}").json()
    assert now["measure_m"] == pytest.approx(21_100, abs=1e-6)
    assert now["position"] == marker["position"]
    assert now["offset_m"] == pytest.approx(-3.5)
    found = client.get(
        f"/v1/roads/{road['id']}/position", params={"measure_m": now["measure_m"], "offset_m": now["offset_m"]}
    ).json()["places"][0]
    spot = now["position"]
    assert GEOD.inv(found["lon_deg"], found["lat_deg"], spot["lon_deg"], spot["lat_deg"])[2] < 1e-6
    why = client.get(f"/v1/markers/{marker['id']}/versions").json()["items"][-1]["why"]
    assert why == "measured on version 2 of road A 61: new posts"
    before = {"measure_m": marker["measure_m"], "offset_m": -3.5, "version": 1}
    old = client.get(f"/v1/roads/{road['id']}/position", params=before).json()
    assert old["version"] == 1
    assert (
        GEOD.inv(old["places"][0]["lon_deg"], old["places"][0]["lat_deg"], spot["lon_deg"], spot["lat_deg"])[2] < 1e-6
    )
    again = _patch(client, answer.json(), calibration=calibration).json()["markers"]
    assert (again["measured"], again["unchanged"]) == (0, 1)
    versions = client.get(f"/v1/roads/{road['id']}/versions").json()["items"]
    assert [item["version"] for item in versions] == [1, 2, 3]
    assert versions[1]["why"] == "new posts"


def test_a_marker_in_a_hairpin_stays_on_its_leg(client: httpx.Client) -> None:
    line = _line((0, 300), (90, 9), (180, 300))
    spot = _along(line, 120, -4.5)
    up = _marker(client, spot, road="pass", measure_m=121.0)
    down = _marker(client, spot, road="pass", measure_m=480.0)
    unsaid = _marker(client, spot, road="pass")
    road = _road(client, "pass", line)
    assert [item["marker_id"] for item in road["markers"]["left_out"]] == [unsaid["id"]]
    for _ in range(2):
        shift = road["from_m"]
        for marker, leg_m in ((up, 120), (down, 489)):
            measure_m = client.get(f"/v1/markers/{marker['id']}").json()["measure_m"]
            assert measure_m == pytest.approx(leg_m + shift, abs=0.01)
        road = _patch(client, road, calibration=[{"measure_m": 5_000, "vertex": 0}]).json()


def test_a_marker_that_moves_takes_its_measure_along(client: httpx.Client) -> None:
    line = _line((60, 1_500))
    _road(client, "L 1", line)
    marker = _marker(client, _along(line, 100), road="L 1")
    moved = _along(line, 250, 1.0)

    def change(version: int, **body: Any) -> dict[str, Any]:
        answer = client.patch(f"/v1/markers/{marker['id']}", json=body, headers={"If-Match": f'"{version}"'})
        assert answer.status_code == 200, answer.text
        return dict(answer.json())

    now = change(1, position={"lon_deg": moved[0], "lat_deg": moved[1]})
    assert (now["measure_m"], now["offset_m"]) == (pytest.approx(250, abs=1e-6), pytest.approx(1, abs=1e-6))
    assert change(2, measure_m=3.0)["measure_m"] == 3.0
    assert change(3, status="built")["measure_m"] == 3.0
    assert change(4, road="another", measure_m=None)["measure_m"] is None
    assert change(5, road="L 1")["measure_m"] == pytest.approx(250, abs=1e-6)
    away = change(6, position={"lon_deg": moved[0], "lat_deg": moved[1] + 0.01})
    assert (away["measure_m"], away["offset_m"]) == (None, None)


def test_changes_name_the_version_that_they_are_based_on(client: httpx.Client) -> None:
    line = _line((60, 1_500))
    road = _road(client, "L 2", line, calibration=[{"measure_m": 5, "vertex": 0}])
    body = {"calibration": []}
    assert client.patch(f"/v1/roads/{road['id']}", json=body).status_code == 428
    answer = client.patch(f"/v1/roads/{road['id']}", json=body, headers={"If-Match": '"7"'})
    assert answer.status_code == 412
    geometry = {"type": "LineString", "coordinates": _line((50, 900))}
    refused(_patch(client, road, geometry=geometry), 422, field="calibration")
    changed = _patch(client, road, geometry=geometry, calibration=[]).json()
    assert (changed["from_m"], changed["version"]) == (0, 2)
    refused(_patch(client, changed, reason="no reason"), 422, field="body")


def test_a_repeated_request_gets_the_first_answer(client: httpx.Client) -> None:
    body = {"name": "K 7", "geometry": {"type": "LineString", "coordinates": _line((0, 100))}}
    answers = [client.post("/v1/roads", json=body, headers={"Idempotency-Key": "road"}) for _ in range(2)]
    assert [answer.status_code for answer in answers] == [201, 201]
    assert answers[0].json() == answers[1].json()
    assert answers[1].headers["idempotency-replayed"] == "true"
    dry = client.post("/v1/roads", json={**body, "name": "K 8", "dry_run": True})
    assert (dry.status_code, dry.json()["id"]) == (200, None)
    assert client.get("/v1/roads?name=K 8").json()["items"] == []


SHORT = [[8.0, 49.0], [8.001, 49.0]]


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"geometry": {"type": "LineString", "coordinates": [[8, 49], [8, 49]]}}, "geometry.coordinates[0]"),
        ({"geometry": {"type": "LineString", "coordinates": [[8, 49], [49, 8]]}}, "geometry.coordinates[0]"),
        ({"geometry": {"type": "LineString", "coordinates": [[8, 49], [8, 99]]}}, "geometry.coordinates"),
        ({"geometry": {"type": "LineString", "coordinates": [[8, 49]]}}, "geometry.LineString.coordinates"),
        ({"geometry": {"type": "Point", "coordinates": [8, 49]}}, "geometry"),
        ({"crs": "EPSG:99999"}, "crs"),
        ({"crs": "EPSG:25832"}, "geometry.coordinates"),
        ({"name": ""}, "name"),
        ({"name": "x" * 201}, "name"),
        ({"calibration": [{"measure_m": 0}]}, "calibration.0"),
        ({"calibration": [{"measure_m": 0, "vertex": 2}]}, "calibration.0.vertex"),
        ({"calibration": [{"measure_m": 0, "vertex": 0, "part": 1}]}, "calibration.0.vertex"),
        ({"calibration": [{"measure_m": 0, "vertex": 0, "chainage_m": 0}]}, "calibration.0"),
        ({"calibration": [{"measure_m": 0, "chainage_m": 1e7}]}, "calibration.0.chainage_m"),
        ({"calibration": [{"measure_m": 0, "chainage_m": -1}]}, "calibration.0.chainage_m"),
        ({"calibration": [{"measure_m": 0, "chainage_m": 0, "part": 1}]}, "calibration.0.chainage_m"),
        ({"calibration": [{"measure_m": 0, "position": [9.0, 49.0]}]}, "calibration.0.position"),
        ({"calibration": [{"measure_m": 0, "vertex": 0}, {"measure_m": -50, "vertex": 1}]}, "calibration"),
        ({"calibration": [{"measure_m": 0, "vertex": 0}, {"measure_m": 0.07, "vertex": 1}]}, "calibration"),
        ({"calibration": [{"measure_m": 1e9, "vertex": 0}]}, "calibration.0.measure_m"),
        ({"epoch": 1}, "epoch"),
    ],
)
def test_roads_that_cannot_be_are_refused(client: httpx.Client, changes: dict[str, Any], field: str) -> None:
    body = {"name": "refused", "geometry": {"type": "LineString", "coordinates": SHORT}, **changes}
    refused(client.post("/v1/roads", json=body), 422, field=field)
    assert client.get("/v1/roads?name=refused").json()["items"] == []


@pytest.mark.parametrize(
    ("path", "field"),
    [
        ("locate?lon=nan&lat=49", "lon"),
        ("locate?lon=8&lat=99", "position.lat_deg"),
        ("locate?lon=8&lat=49&max_offset_m=0", "max_offset_m"),
        ("locate?lon=8&lat=49&max_offset_m=1e9", "max_offset_m"),
        ("locate?lon=8", "lat"),
        ("position?measure_m=inf", "measure_m"),
        ("position?measure_m=1&offset_m=1e9", "offset_m"),
        ("position", "measure_m"),
        ("markers?after=x", "after"),
        ("markers?from_m=nan", "from_m"),
        ("markers?limit=0", "limit"),
        ("versions?limit=1000000000", "limit"),
    ],
)
def test_queries_that_cannot_be_are_refused(client: httpx.Client, path: str, field: str) -> None:
    road = _road(client, "a", SHORT)
    refused(client.get(f"/v1/roads/{road['id']}/{path}"), 422, field=field)
    assert client.get(f"/v1/roads/{road['id']}/locate?lon=8&lat=49&version=9").status_code == 404


def test_nobody_sees_anothers_roads(client: httpx.Client, server: LiveServer) -> None:
    road = _road(client, "mine", SHORT)
    with server.agency("somebody with roads") as other:
        assert other.get("/v1/roads").json()["items"] == []
        assert other.get(f"/v1/roads/{road['id']}").status_code == 404
        assert _road(other, "mine", SHORT)["version"] == 1
