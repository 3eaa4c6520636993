"""/v1/markers over real HTTP: registering, reading, listing and changing plates."""

from __future__ import annotations

import itertools
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import pytest

from app.markers.plate import PlateCode, PlateScheme
from app.services.access.access import Scope
from tests.conftest import LiveServer, Place
from tests.http import created, refused

pytestmark = pytest.mark.both_databases


PLAIN, ROBUST = {"scheme": "position"}, {"scheme": "position-robust"}

# --- register -----------------------------------------------------------------------------------------------------


def test_a_position_alone_makes_a_plate_with_a_registry_number(client: httpx.Client, place: Place) -> None:
    marker = created(client, "/v1/markers", position=place())
    assert marker["code"]["scheme"] == "id"
    assert PlateCode(marker["code"]["digits"], PlateScheme.ID).registry_number == marker["code"]["registry_number"]
    assert marker["code"]["digits_match_position"] is None
    assert marker["geometry"] == {"n": 8, "unit_mm": 35.0, "gap_mm": 5.0, "thickness_mm": 20.0, "side_mm": 325.0}


def test_a_robust_position_is_carried_on_a_plate_of_the_same_size(client: httpx.Client, place: Place) -> None:
    spot = place()
    marker = created(client, "/v1/markers", position=spot, code=ROBUST)
    assert marker["geometry"] == {"n": 10, "unit_mm": 27.0, "gap_mm": 5.0, "thickness_mm": 20.0, "side_mm": 325.0}
    assert marker["code"]["scheme"] == "position-robust"
    assert marker["code"]["digits_match_position"] is True
    decimals = PlateCode(marker["code"]["digits"], PlateScheme.POSITION_ROBUST, 10).decimals
    assert decimals == tuple(f"{abs(spot[name]):.6f}".split(".")[1] for name in ("lon_deg", "lat_deg"))
    same = {"position": spot, "code": ROBUST | {"digits": marker["code"]["digits"]}}
    refused(client.post("/v1/markers", json=same), 409, "code-taken")
    path = f"/v1/markers/{marker['id']}"
    moved = client.patch(path, json={"position": place()}, headers={"If-Match": '"1"'}).json()
    assert moved["code"]["digits"] != marker["code"]["digits"]
    assert moved["code"]["digits_match_position"] is True


@pytest.mark.parametrize("geometry", [{"n": 8}, {"n": 8, "unit_mm": 27}])
def test_a_robust_position_needs_ten_units(client: httpx.Client, place: Place, geometry: dict[str, Any]) -> None:
    body = {"position": place(), "code": ROBUST, "geometry": geometry}
    problem = refused(client.post("/v1/markers", json=body), 422, field="geometry.n")
    assert problem["limit"] == "10 or 12"


def test_a_plain_position_plate(client: httpx.Client, place: Place) -> None:
    spot = {"lon_deg": -0.1275004, "lat_deg": place()["lat_deg"]}
    response = client.post("/v1/markers", json={"position": spot, "code": PLAIN})
    marker = response.json()
    assert response.status_code == 201
    assert response.headers["location"] == f"/v1/markers/{marker['id']}"
    assert response.headers["etag"] == '"1"'
    assert marker["code"]["scheme"] == "position"
    assert marker["code"]["digits"] == "127500" + f"{spot['lat_deg']:.6f}".split(".")[1]
    assert marker["code"]["digits_match_position"] is True
    assert marker["geometry"] == {"n": 8, "unit_mm": 35.0, "gap_mm": 5.0, "thickness_mm": 20.0, "side_mm": 325.0}
    assert marker["position"]["localization_grade"] == "unfit"
    assert "state horizontal_rmse_m" in marker["position"]["transform_note"]
    assert marker["position"]["original"] == spot
    assert client.get(response.headers["location"]).json() == marker


def test_a_scheme_without_a_check_has_a_warning(client: httpx.Client, place: Place) -> None:
    marker = created(client, "/v1/markers", position=place(), code=PLAIN)
    [warning] = marker["code_warnings"]
    assert (warning["field"], warning["code"]) == ("code.scheme", "scheme-without-check")
    assert "position-robust" in warning["proposal"]
    assert client.get(f"/v1/markers/{marker['id']}").json()["code_warnings"] == [warning]
    for code in (ROBUST, {"scheme": "id"}, {"scheme": "position-check"}):
        assert created(client, "/v1/markers", position=place(), code=code)["code_warnings"] == []
    bulk = {"items": [{"create": {"position": place(), "code": PLAIN}}], "dry_run": True}
    [item] = client.post("/v1/markers/bulk", json=bulk).json()["results"]
    assert item["warnings"] == [warning]


def test_provenance_is_kept(client: httpx.Client, place: Place) -> None:
    position = place() | {
        "height_m": 5.21,
        "crs": "EPSG:7912",
        "realization": "ITRF2014",
        "epoch": 2025.4,
        "vertical_datum": "EPSG:3855",
        "horizontal_rmse_m": 0.012,
        "vertical_rmse_m": 0.02,
        "survey_method": "GNSS RTK – zwei Messungen",
    }
    placement = {"heading_deg": 78.5, "heading_rmse_deg": 0.1, "road": "A1", "measure_m": 1200.5, "offset_m": -1.75}
    marker = created(client, "/v1/markers", position=position, status="surveyed", **placement)
    assert {name: marker["position"][name] for name in position} == position
    assert {name: marker[name] for name in placement} == placement
    assert marker["position"]["original"] == position


@pytest.mark.parametrize("checks", [1, 2])
def test_check_digits_are_the_sum_of_the_others(client: httpx.Client, place: Place, checks: int) -> None:
    code = {"scheme": "position-check", "check_digits": checks}
    digits = created(client, "/v1/markers", position=place(), code=code)["code"]["digits"]
    assert len(digits) == 12
    assert int(digits[-checks:]) == sum(map(int, digits[:-checks])) % 10**checks


def test_id_plates_get_numbers_that_cannot_look_like_positions(client: httpx.Client, place: Place) -> None:
    codes = [created(client, "/v1/markers", position=place(), code={"scheme": "id"})["code"] for _ in range(20)]
    assert len({code["registry_number"] for code in codes}) == 20
    for code in codes:
        assert sum(digit in "ABCDEF" for digit in code["digits"]) >= 3
        assert int(code["digits"][:8], 16) == code["registry_number"]


def test_a_registry_number_names_one_plate(client: httpx.Client, server: LiveServer, place: Place) -> None:
    marker = created(client, "/v1/markers", position=place(), code={"scheme": "id", "registry_number": 0xDEADBEEF})
    assert marker["code"]["digits"].startswith("DEADBEEF")
    body = {"position": place(), "code": {"scheme": "id", "registry_number": 0xDEADBEEF}}
    own = refused(client.post("/v1/markers", json=body), 409, "code-taken")
    assert marker["id"] in own["detail"]
    with server.agency("a stranger to the number") as stranger:
        other = refused(stranger.post("/v1/markers", json=body), 409, "code-taken")
    assert marker["id"] not in str(other)


@pytest.mark.parametrize(("n", "digits"), [(10, 21), (12, 32)])
def test_larger_plates(client: httpx.Client, place: Place, n: int, digits: int) -> None:
    geometry = {"n": n, "unit_mm": 25, "gap_mm": 4}
    assert len(created(client, "/v1/markers", position=place(), geometry=geometry)["code"]["digits"]) == digits
    code = created(client, "/v1/markers", position=place(), geometry=geometry, code={"scheme": "id"})["code"]
    assert len(code["digits"]) == digits
    assert code["registry_number"] < 2 ** {10: 48, 12: 64}[n]


def test_digits_that_do_not_fit_the_position(client: httpx.Client) -> None:
    code: dict[str, Any] = PLAIN | {"digits": "023792168411"}
    body = {"position": {"lon_deg": 114.179203, "lat_deg": 22.304161}, "code": code}
    problem = refused(client.post("/v1/markers", json=body), 422, "code-mismatch")
    assert problem["field"] == "code.digits"
    assert "023792168411" in problem["detail"]
    assert "179203304161" in problem["detail"]
    assert "114.179203, 22.304161" in problem["detail"]
    assert "allow_mismatched_digits" in problem["cure"]
    assert client.get("/v1/markers").json()["items"] == []
    code["allow_mismatched_digits"] = True
    marker = created(client, "/v1/markers", **body)
    assert marker["code"]["digits"] == "023792168411"
    assert marker["code"]["digits_match_position"] is False


def test_digits_that_fit_are_accepted(client: httpx.Client) -> None:
    marker = created(
        client, "/v1/markers", position={"lon_deg": 14.5, "lat_deg": -22.25}, code=PLAIN | {"digits": "500000250000"}
    )
    assert marker["code"]["digits_match_position"] is True


@pytest.mark.parametrize(
    ("lon", "lat", "digits"),
    [
        (10.9999996, 45.25, "000000250000"),
        (-0.0000004, 0.25, "000000250000"),
        (180.0, -16.5, "000000500000"),
        (-179.9999999, 16.75, "000000750000"),
        (-70.123456, -89.9999999, "123456000000"),
    ],
)
def test_rounding_at_whole_degrees(client: httpx.Client, lon: float, lat: float, digits: str) -> None:
    position = {"lon_deg": lon, "lat_deg": lat}
    assert created(client, "/v1/markers", position=position, code=PLAIN)["code"]["digits"] == digits


def test_the_same_position_twice_is_a_conflict(client: httpx.Client, server: LiveServer, place: Place) -> None:
    spot = place()
    body = {"position": spot, "code": PLAIN}
    first = created(client, "/v1/markers", **body)
    problem = refused(client.post("/v1/markers", json=body), 409, "code-taken")
    assert first["id"] in problem["detail"]
    assert problem["limit"] == "no two plates with the same digits within 1000 m"
    with server.agency("a stranger at the same place") as stranger:
        secret = refused(stranger.post("/v1/markers", json=body), 409, "code-taken")
    assert first["id"] not in str(secret)
    assert "another agency" in secret["detail"]
    client.patch(f"/v1/markers/{first['id']}", json={"status": "retired"}, headers={"If-Match": '"1"'})
    created(client, "/v1/markers", **body)
    back = client.patch(f"/v1/markers/{first['id']}", json={"status": "active"}, headers={"If-Match": '"2"'})
    refused(back, 409, "code-taken")


def test_mirrored_positions_across_the_equator_are_a_conflict(client: httpx.Client) -> None:
    created(client, "/v1/markers", position={"lon_deg": 31.234567, "lat_deg": 0.000321}, code=PLAIN)
    mirrored = {"position": {"lon_deg": 31.234567, "lat_deg": -0.000321}, "code": PLAIN}
    refused(client.post("/v1/markers", json=mirrored), 409, "code-taken")
    created(client, "/v1/markers", position={"lon_deg": 31.234567, "lat_deg": -1.000321}, code=PLAIN)


def test_given_digits_are_kept_apart_by_twenty_kilometres(client: httpx.Client) -> None:
    code = PLAIN | {"digits": "111122223333", "allow_mismatched_digits": True}
    created(client, "/v1/markers", position={"lon_deg": 60.0, "lat_deg": 40.0}, code=code)
    near = {"position": {"lon_deg": 60.2, "lat_deg": 40.0}, "code": code}
    problem = refused(client.post("/v1/markers", json=near), 409, "code-taken")
    assert "20000 m" in problem["limit"]
    assert problem["field"] == "code.digits"
    created(client, "/v1/markers", position={"lon_deg": 60.25, "lat_deg": 40.0}, code=code)


def test_derived_digits_keep_clear_of_given_ones(client: httpx.Client) -> None:
    code = PLAIN | {"digits": "123456654321", "allow_mismatched_digits": True}
    created(client, "/v1/markers", position={"lon_deg": 61.2, "lat_deg": 41.7}, code=code)
    derived = {"position": {"lon_deg": 61.123456, "lat_deg": 41.654321}, "code": PLAIN}
    refused(client.post("/v1/markers", json=derived), 409, "code-taken")
    created(client, "/v1/markers", position={"lon_deg": 62.123456, "lat_deg": 41.654321}, code=PLAIN)


def test_of_many_requests_for_one_place_one_wins(client: httpx.Client, place: Place) -> None:
    body = {"position": place(), "code": PLAIN}
    with ThreadPoolExecutor(8) as threads:
        answers = list(threads.map(lambda _: client.post("/v1/markers", json=body).status_code, range(16)))
    assert sorted(answers) == [201] + [409] * 15
    key = {"Idempotency-Key": "many"}
    body = {"position": place()}
    with ThreadPoolExecutor(8) as threads:
        repeated = list(threads.map(lambda _: client.post("/v1/markers", json=body, headers=key), range(16)))
    assert {(answer.status_code, answer.json()["id"]) for answer in repeated} == {(201, repeated[0].json()["id"])}


def test_of_many_changes_to_one_version_one_wins(client: httpx.Client, place: Place) -> None:
    path = f"/v1/markers/{created(client, '/v1/markers', position=place())['id']}"
    with ThreadPoolExecutor(8) as threads:
        answers = list(
            threads.map(
                lambda n: client.patch(path, json={"road": f"R{n}"}, headers={"If-Match": '"1"'}).status_code, range(16)
            )
        )
    assert sorted(answers) == [200] + [412] * 15
    assert client.get(path).json()["version"] == 2


def test_an_idempotent_request_is_stored_once(client: httpx.Client, server: LiveServer, place: Place) -> None:
    body = {"position": place(), "code": {"scheme": "id"}}
    headers = {"Idempotency-Key": "8e03978e-40d5-43dd-bc93-6894a57f9324"}
    first = client.post("/v1/markers", json=body, headers=headers)
    second = client.post("/v1/markers", json=body, headers=headers)
    assert (first.status_code, second.status_code) == (201, 201)
    assert first.content == second.content
    assert "idempotency-replayed" not in first.headers
    assert second.headers["idempotency-replayed"] == "true"
    assert len(client.get("/v1/markers").json()["items"]) == 1
    other = client.post("/v1/markers", json=body | {"road": "B"}, headers=headers)
    refused(other, 409, "idempotency-conflict")
    with server.agency("another agency with the same key") as stranger:
        assert stranger.post("/v1/markers", json=body, headers=headers).json()["id"] != first.json()["id"]


def test_an_idempotency_key_belongs_to_the_holder_of_the_key(server: LiveServer, place: Place) -> None:
    name, body = "agency of several holders", {"position": place(), "code": {"scheme": "id"}}
    headers = {"Idempotency-Key": "the same"}
    with server.agency(name, Scope.ADMIN) as admin, server.agency(name, Scope.PLANNER) as planner:
        first = admin.post("/v1/markers", json=body, headers=headers)
        other = planner.post("/v1/markers", json=body, headers=headers)
        assert (first.status_code, other.status_code) == (201, 201)
        assert other.json()["id"] != first.json()["id"]
        assert planner.post("/v1/markers", json={**body, "road": "B"}, headers=headers).status_code == 409
        mine = next(key for key in admin.get("/v1/keys").json()["items"] if key["scope"] == "admin")
        rotated = admin.post(f"/v1/keys/{mine['id']}/rotate", json={})
        with server.client(rotated.json()["key"]) as successor:
            again = successor.post("/v1/markers", json=body, headers=headers)
        assert again.headers["idempotency-replayed"] == "true"
        assert again.content == first.content
        assert len(admin.get("/v1/markers").json()["items"]) == 2


def test_a_refused_request_may_be_corrected_under_the_same_key(client: httpx.Client, place: Place) -> None:
    headers = {"Idempotency-Key": "k1"}
    assert client.post("/v1/markers", json={"position": {}}, headers=headers).status_code == 422
    assert client.post("/v1/markers", json={"position": place()}, headers=headers).status_code == 201


# --- positions in other systems -----------------------------------------------------------------------------------


def test_nad83_is_transformed_and_kept_as_it_came(client: httpx.Client) -> None:
    given = {"lon_deg": -84.5123456, "lat_deg": 42.7, "crs": "EPSG:6318", "horizontal_rmse_m": 0.02}
    position = created(client, "/v1/markers", position=given)["position"]
    assert (position["localization_grade"], position["epoch"]) == ("cm", 2020.0)
    assert "state the epoch" in position["transform_note"]
    assert position["original"] == given


def test_nad83_with_an_epoch_is_transformed(client: httpx.Client) -> None:
    given = {"lon_deg": -84.5, "lat_deg": 42.75, "crs": "urn:ogc:def:crs:EPSG::6318", "epoch": 2025.0}
    marker = created(client, "/v1/markers", position=given, code=PLAIN)
    assert (marker["position"]["transform_accuracy_m"], marker["position"]["realization"]) == (0.0, "ITRF2014")
    assert 84.500010 < -marker["position"]["lon_deg"] < 84.500012
    assert marker["code"]["digits"].startswith("500011")


def test_projected_coordinates(client: httpx.Client) -> None:
    given = {"easting_m": 836694.05, "northing_m": 819069.8, "crs": "EPSG:2326"}
    position = created(client, "/v1/markers", position=given)["position"]
    assert position["localization_grade"] == "unfit"
    assert position["lon_deg"] == pytest.approx(114.18, abs=0.01)
    assert position["original"] == given
    known = {"easting_m": 500000.0, "northing_m": 4_000_000.0, "crs": "EPSG:32633", "horizontal_rmse_m": 0.01}
    frame = {"realization": "ITRF2020", "epoch": 2026.4}
    assert created(client, "/v1/markers", position=known | frame)["position"]["localization_grade"] == "cm"


# --- read and list ------------------------------------------------------------------------------------------------


def test_agencies_never_see_each_others_markers(client: httpx.Client, server: LiveServer, place: Place) -> None:
    marker = created(client, "/v1/markers", position=place())
    path = f"/v1/markers/{marker['id']}"
    with server.agency("a nosy stranger") as stranger:
        assert stranger.get("/v1/markers").json() == {"items": []}
        missing = refused(stranger.get("/v1/markers/01a1fb99-93e6-79ab-93c1-fe6e95603cab"), 404, "not-found")
        hidden = refused(stranger.get(path), 404, "not-found")
        assert hidden["title"] == missing["title"]
        refused(stranger.get(f"{path}/versions"), 404, "not-found")
        refused(stranger.patch(path, json={"status": "retired"}, headers={"If-Match": "*"}), 404, "not-found")
    assert client.get(path).json() == marker


def test_pages_follow_the_link_to_the_end(client: httpx.Client, place: Place) -> None:
    made = [created(client, "/v1/markers", position=place())["id"] for _ in range(7)]
    url: str | None = "/v1/markers?limit=3&status=planned"
    pages = []
    while url:
        response = client.get(url)
        pages.append([marker["id"] for marker in response.json()["items"]])
        url = response.links.get("next", {}).get("url")
    assert [len(page) for page in pages] == [3, 3, 1]
    assert list(itertools.chain(*pages)) == sorted(made)


def test_a_last_page_that_is_full_has_no_link(client: httpx.Client, place: Place) -> None:
    for _ in range(2):
        created(client, "/v1/markers", position=place())
    assert client.get("/v1/markers?limit=2").links == {}


def test_filters(client: httpx.Client) -> None:
    here = created(client, "/v1/markers", position={"lon_deg": 115.0, "lat_deg": -31.0}, status="active")
    near = created(client, "/v1/markers", position={"lon_deg": 115.001, "lat_deg": -31.0})
    far = created(client, "/v1/markers", position={"lon_deg": 116.5, "lat_deg": -31.0})

    def found(query: str) -> set[str]:
        response = client.get(f"/v1/markers?{query}")
        assert response.status_code == 200, response.text
        return {marker["id"] for marker in response.json()["items"]}

    assert found("") == {here["id"], near["id"], far["id"]}
    assert found("near=115,-31,90") == {here["id"]}
    assert found("near=115,-31,100") == {here["id"], near["id"]}
    assert found("bbox=114.9,-31.1,115.1,-30.9") == {here["id"], near["id"]}
    assert found("bbox=114.9,-31.1,115.1,-30.9&status=active") == {here["id"]}
    assert found("status=retired") == set()
    assert found(f"code={far['code']['digits']}") == {far["id"]}


def test_a_box_over_the_antimeridian(client: httpx.Client) -> None:
    east = created(client, "/v1/markers", position={"lon_deg": 179.95, "lat_deg": -17.5})
    west = created(client, "/v1/markers", position={"lon_deg": -179.9, "lat_deg": -17.5})
    for query in ("bbox=179.9,-18,-179.8,-17", "near=180,-17.5,20000"):
        items = client.get(f"/v1/markers?{query}").json()["items"]
        assert {marker["id"] for marker in items} == {east["id"], west["id"]}


def test_an_etag_that_still_holds_saves_the_body(client: httpx.Client, place: Place) -> None:
    path = f"/v1/markers/{created(client, '/v1/markers', position=place())['id']}"
    response = client.get(path, headers={"If-None-Match": '"1"'})
    assert (response.status_code, response.content) == (304, b"")
    assert client.get(path, headers={"If-None-Match": '"2"'}).status_code == 200


# --- change -------------------------------------------------------------------------------------------------------


def test_a_change_needs_the_version_it_is_based_on(client: httpx.Client, place: Place) -> None:
    path = f"/v1/markers/{created(client, '/v1/markers', position=place())['id']}"
    refused(client.patch(path, json={"status": "built"}), 428, "version-required")
    for broken in ("1", 'W/"1"', '"x"', '"1', '""'):
        refused(client.patch(path, json={"status": "built"}, headers={"If-Match": broken}), 422, "invalid-parameter")
    changed = client.patch(path, json={"status": "built", "reason": "installed"}, headers={"If-Match": '"1"'})
    assert changed.status_code == 200
    assert changed.headers["etag"] == '"2"'
    problem = refused(client.patch(path, json={"status": "active"}, headers={"If-Match": '"1"'}), 412, "stale-version")
    assert problem["limit"] == '"2"'
    assert client.get(path).json() == changed.json()
    assert client.patch(path, json={"status": "active"}, headers={"If-Match": "*"}).json()["version"] == 3


def test_the_history_holds_every_version(client: httpx.Client, place: Place) -> None:
    marker = created(client, "/v1/markers", position=place(), reason="plan 7")
    path = f"/v1/markers/{marker['id']}"
    moved = place()
    client.patch(path, json={"status": "built"}, headers={"If-Match": '"1"'})
    last = client.patch(path, json={"position": moved, "reason": "as built"}, headers={"If-Match": '"2"'}).json()
    history = client.get(f"{path}/versions").json()["items"]
    assert [entry["version"] for entry in history] == [1, 2, 3]
    assert [entry["why"] for entry in history] == ["plan 7", None, "as built"]
    assert all(entry["who"].startswith("agency") for entry in history)
    assert history[0]["marker"] == marker
    assert history[2]["marker"] == last
    page = client.get(f"{path}/versions?limit=2")
    assert [entry["version"] for entry in client.get(page.links["next"]["url"]).json()["items"]] == [3]


def test_planned_digits_follow_the_position_built_ones_stay(client: httpx.Client, place: Place) -> None:
    marker = created(client, "/v1/markers", position=place(), code=PLAIN)
    path = f"/v1/markers/{marker['id']}"
    replanned = client.patch(path, json={"position": place()}, headers={"If-Match": '"1"'}).json()
    assert replanned["code"]["digits"] != marker["code"]["digits"]
    assert replanned["code"]["digits_match_position"] is True
    client.patch(path, json={"status": "built"}, headers={"If-Match": '"2"'})
    surveyed = {"lon_deg": replanned["position"]["lon_deg"] + 3e-6, "lat_deg": replanned["position"]["lat_deg"]}
    resurveyed = client.patch(path, json={"position": surveyed}, headers={"If-Match": '"3"'}).json()
    assert resurveyed["code"]["digits"] == replanned["code"]["digits"]
    assert resurveyed["code"]["digits_match_position"] is False
    assert resurveyed["position"]["original"] == surveyed


def test_members_left_out_stay_and_null_clears(client: httpx.Client, place: Place) -> None:
    marker = created(client, "/v1/markers", position=place(), road="A1", heading_deg=10.0)
    path = f"/v1/markers/{marker['id']}"
    changed = client.patch(path, json={"road": None}, headers={"If-Match": '"1"'}).json()
    assert (changed["road"], changed["heading_deg"], changed["code"]) == (None, 10.0, marker["code"])
    assert changed["position"] == marker["position"]


def test_a_read_key_reads_only(server: LiveServer, place: Place) -> None:
    with server.agency("readers", Scope.VIEWER) as reader:
        assert reader.get("/v1/markers").status_code == 200
        problem = refused(reader.post("/v1/markers", json={"position": place()}), 403, "not-allowed")
        assert "viewer" in problem["detail"]
        assert "planner" in problem["limit"]
