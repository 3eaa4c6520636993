"""Surveys over HTTP: every format in, reports, all or nothing, as built against the plan, and what is refused."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import httpx
import pyproj
import pytest

from app.main import create_app
from app.markers.plate import PlateCode, PlateScheme
from app.settings import Settings
from tests.api.surveys import survey_files
from tests.api.surveys.survey_files import LAT, LON, STEP
from tests.conftest import ADMIN_KEY, LiveServer
from tests.http import finished

DEGREES = {"crs": "EPSG:4326", "family": "cerpm", "columns": {"code": "number"}, "area_deg": [8.4, 48.9, 8.5, 49.1]}


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveServer]:
    """A server that the tests of this module share."""
    folder = tmp_path_factory.mktemp("server")
    settings = Settings(
        data_dir=folder / "var", admin_key=ADMIN_KEY, warm_decoders=False, decode_workers=1, max_import_bytes=2**24
    )
    with LiveServer(create_app(settings)) as running:
        yield running


def _csv(rows: int = 8, **changes: str) -> bytes:
    lines = [f"{k},{LON + k * STEP:.9f},{LAT + k % 3 * 1e-8:.9f}" for k in range(1, rows + 1)]
    for row, line in changes.items():
        lines[int(row.removeprefix("row")) - 1] = line
    return "\n".join(["number,lon,lat", *lines]).encode()


def _send(client: httpx.Client, data: bytes, declaration: dict[str, Any], **headers: str) -> httpx.Response:
    form = {"file": ("survey", data), "declaration": ("", json.dumps(declaration), "application/json")}
    return client.post("/v1/imports", files=form, headers=headers)


def _markers(client: httpx.Client) -> list[dict[str, Any]]:
    return client.get("/v1/markers", params={"limit": 1000}).json()["items"]


@pytest.mark.slow
def test_a_dry_run_stores_nothing_and_says_what_would_be(client: httpx.Client) -> None:
    answer = _send(client, _csv(), {**DEGREES, "dry_run": True})
    assert answer.status_code == 200
    report = answer.json()
    assert (report["outcome"], report["rows"], report["good_rows"], report["stored"]) == ("checked", 8, 8, 0)
    assert report["extent_deg"] == pytest.approx([LON + STEP, LAT, LON + 8 * STEP, LAT], abs=1e-7)
    assert _markers(client) == []


def test_an_import_keeps_where_each_marker_comes_from(client: httpx.Client) -> None:
    survey = {"surveyor": "A. Muster", "instrument": "R12i", "horizontal_rmse_m": 0.015, "check_points": 20}
    answer = _send(client, _csv(), {**DEGREES, "survey": survey, "side": "left", "status": "built", "road": "B 10"})
    assert answer.status_code == 201, answer.text
    first = _markers(client)[0]
    assert first["position"]["original"]["survey"] == {
        **survey, "file_sha256": answer.json()["file_sha256"], "format": "csv", "row": 1,
    }  # fmt: skip
    assert first["position"]["horizontal_rmse_m"] == 0.015
    assert (first["status"], first["road"], first["side"], first["code"]["number"]) == ("built", "B 10", "left", 1)
    versions = client.get(f"/v1/markers/{first['id']}/versions").json()["items"]
    assert len(versions) == 1
    assert versions[0]["marker"] == first
    near = client.get("/v1/markers", params={"near": f"{LON + STEP},{LAT},2"}).json()["items"]
    assert [marker["id"] for marker in near] == [first["id"]]


def test_all_or_nothing_and_accept_the_good(client: httpx.Client) -> None:
    data = _csv(row3="3,8.4,abc", row5="2,8.417,49.0052")
    answer = _send(client, data, DEGREES)
    assert answer.status_code == 422
    problem = answer.json()
    assert problem["type"] == "urn:waymark:problem:import-refused"
    assert [(f["row"], f["code"]) for f in problem["report"]["faults"] if f["severity"] == "refused"] == [
        (3, "not_a_number")
    ]
    assert _markers(client) == []
    stored = _send(client, data, {**DEGREES, "mode": "good"})
    assert stored.status_code == 201
    assert stored.json()["stored"] == 6
    assert {f["row"]: f["code"] for f in stored.json()["faults"] if f["severity"] == "refused"} == {
        3: "not_a_number", 5: "duplicate_code",
    }  # fmt: skip
    assert sorted(marker["code"]["number"] for marker in _markers(client)) == [1, 2, 4, 6, 7, 8]


def test_codes_that_are_taken_are_named(client: httpx.Client) -> None:
    assert _send(client, _csv(), DEGREES).status_code == 201
    again = _send(client, _csv(2), {**DEGREES, "dry_run": True, "duplicates": "store"}).json()
    assert again["counts"]["code_taken"] == 2
    assert again["good_rows"] == 0


def test_a_repeated_request_gets_the_first_answer(client: httpx.Client) -> None:
    key = {"Idempotency-Key": "once"}
    first = _send(client, _csv(), DEGREES, **key)
    again = _send(client, _csv(), DEGREES, **key)
    assert again.headers["Idempotency-Replayed"] == "true"
    assert again.json() == first.json()
    assert len(_markers(client)) == 8


def test_plates_get_registry_numbers_where_no_scheme_is_declared(client: httpx.Client) -> None:
    declared = {"crs": "EPSG:4326", "columns": {"point": "number"}, "area_deg": DEGREES["area_deg"]}
    assert _send(client, _csv(), declared).status_code == 201
    codes = [PlateCode(one["code"]["digits"], PlateScheme.ID) for one in _markers(client)]
    assert len({code.registry_number for code in codes}) == 8


def test_plates_get_the_digits_of_their_places(client: httpx.Client) -> None:
    declared = {"crs": "EPSG:4326", "columns": {"point": "number"}, "area_deg": DEGREES["area_deg"]}
    assert _send(client, _csv(), {**declared, "scheme": "position"}).status_code == 201
    plate = _markers(client)[0]
    assert plate["code"]["digits"] == "416562005100"
    assert plate["position"]["original"]["point"] == "1"
    robust = _send(client, _csv(), {**declared, "scheme": "position-robust", "duplicates": "store"})
    assert robust.status_code == 201, robust.text
    stored = next(one for one in _markers(client) if one["code"]["scheme"] == "position-robust")
    assert stored["geometry"]["n"] == 10
    assert PlateCode(stored["code"]["digits"], PlateScheme.POSITION_ROBUST, 10).decimals == ("416562", "005100")
    ids = _send(
        client,
        _csv(),
        {**declared, "scheme": "id", "columns": {"code": "number"}, "geometry": {"n": 10}, "duplicates": "store"},
    )
    assert ids.status_code == 201, ids.text
    assert {p["code"]["registry_number"] for p in _markers(client) if p["code"]["scheme"] == "id"} == set(range(1, 9))


def test_as_built_is_compared_with_the_plan_and_makes_new_versions(client: httpx.Client) -> None:
    assert _send(client, _csv(), DEGREES).status_code == 201
    north = 0.04 / 111_195
    lines = [f"{k},{LON + k * STEP:.9f},{LAT + k % 3 * 1e-8 + north:.9f}" for k in range(1, 9)]
    data = "\n".join(["number,lon,lat", *lines]).encode()
    declared = {**DEGREES, "compare": True, "tolerance_m": 0.03}
    report = _send(client, data, {**declared, "dry_run": True}).json()
    assert report["comparison"]["matched"] == 8
    assert report["comparison"]["shift_north_m"] == pytest.approx(0.04, abs=0.002)
    assert report["counts"] == {"residual": 8, "systematic_shift": 1}
    assert _send(client, data, declared).status_code == 201
    marker = _markers(client)[0]
    assert (marker["version"], marker["status"]) == (2, "surveyed")
    assert marker["position"]["lat_deg"] == pytest.approx(LAT + 1e-8 + north, abs=1e-9)
    old = client.get(f"/v1/markers/{marker['id']}/versions").json()["items"][0]["marker"]
    assert old["position"]["lat_deg"] == pytest.approx(LAT + 1e-8, abs=1e-9)


def test_a_comparison_names_the_family_that_it_looked_for(client: httpx.Client) -> None:
    report = _send(client, _csv(), {**DEGREES, "compare": True, "match": "nearest", "dry_run": True}).json()
    fault = next(fault for fault in report["faults"] if fault["code"] == "no_marker")
    assert fault["message"] == "no registered cerpm belongs to the row"
    assert "declare its family" in fault["proposal"]


def test_the_residuals_are_drawn(client: httpx.Client) -> None:
    assert _send(client, _csv(), DEGREES).status_code == 201
    lines = [f"{k},{LON + k * STEP:.9f},{LAT + k % 3 * 1e-8 + (2e-6 if k == 5 else 2e-7):.9f}" for k in range(1, 9)]
    data = "\n".join(["number,lon,lat", *lines]).encode()
    declared = {**DEGREES, "compare": True, "tolerance_m": 0.1, "dry_run": True}
    drawn = _send(client, data, declared).json()["comparison"]["map_svg"]
    root = ElementTree.fromstring(drawn)
    strokes = [path.get("stroke") for path in root.iter("{http://www.w3.org/2000/svg}path")]
    assert (strokes.count("#2b6cb0"), strokes.count("#c53030")) == (7, 1)
    texts = " ".join(text.text or "" for text in root.iter("{http://www.w3.org/2000/svg}text"))
    assert "Residuals of 8 markers" in texts
    assert "row 5: 222 mm" in texts
    assert "map: " in texts
    assert "arrows: " in texts
    assert " N" in texts


def test_warnings_can_keep_a_survey_out(client: httpx.Client) -> None:
    off = _csv(20, row9=f"9,{LON + 9 * STEP:.9f},{LAT + 1e-4:.9f}")
    near = {**DEGREES, "dry_run": True}
    faults = _send(client, off, near).json()["faults"]
    warned = {fault["row"] for fault in faults if fault["row"] is not None}
    assert 9 in warned
    assert {fault["severity"] for fault in faults} == {"warning"}
    strict = {**DEGREES, "warnings": "refuse"}
    refused = _send(client, off, strict)
    assert refused.status_code == 422
    assert refused.json()["report"]["warnings"] == "refuse"
    assert _markers(client) == []
    good = _send(client, off, {**strict, "mode": "good"})
    assert (good.status_code, good.json()["stored"], good.json()["good_rows"]) == (
        201,
        20 - len(warned),
        20 - len(warned),
    )
    assert [m["code"]["number"] for m in _markers(client)] == [k for k in range(1, 21) if k not in warned]
    # a sound survey of a new road passes; one that nothing can be held against does not
    for k, status in ((0, 422), (1, 201)):  # beside those that are there, and 4 km from them
        moved = _csv().replace(f"{LAT:.4f}".encode(), f"{LAT + 0.04 * k:.4f}".encode()).replace(b"\n", b"\n10", 8)
        assert _send(client, moved, strict).status_code == status
    nowhere = {name: value for name, value in strict.items() if name != "area_deg"}
    far = _csv().replace(b"8.4", b"9.4").replace(b"\n", b"\n20", 8)
    answer = _send(client, far, nowhere)
    assert answer.status_code == 422
    assert "place_unchecked" in answer.json()["report"]["counts"]
    assert _send(client, _csv(), {**DEGREES, "warnings": "shout"}).status_code == 422


def test_swapped_axes_are_refused_with_the_cure(client: httpx.Client) -> None:
    report = _send(client, _csv().replace(b"lon,lat", b"lat,lon"), {**DEGREES, "dry_run": True}).json()
    whole = next(fault for fault in report["faults"] if fault["row"] is None)
    assert whole["code"] == "swapped_axes"
    assert "swap" in whole["proposal"]


# --- every format -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "kind", ["csv", "geojson", "gpkg", "shapefile", "kml", "kmz", "gpx", "landxml", "jobxml", "dxf", "gsi"]
)
def test_every_format_gives_the_same_markers(client: httpx.Client, kind: str, tmp_path: Path) -> None:
    declared = {"family": "cerpm", "vertical_datum": "ellipsoid", "columns": {"code": "number"}}
    data, more = {
        "csv": lambda: (survey_files.pnezd(), {"layout": "pnezd", "crs": "EPSG:32632", "columns": {"code": "point"}}),
        "geojson": lambda: (survey_files.geojson(), {}),
        "gpkg": lambda: (survey_files.layer(tmp_path, "GPKG", "survey.gpkg").read_bytes(), {}),
        "shapefile": lambda: (survey_files.shapefile(tmp_path), {}),
        "kml": lambda: (survey_files.kml(), {"columns": {"code": "point"}}),
        "kmz": lambda: (survey_files.kmz(), {"columns": {"code": "point"}}),
        "gpx": lambda: (survey_files.gpx(), {"columns": {"code": "point"}}),
        "jobxml": lambda: (survey_files.jobxml(), {"crs": "EPSG:32632", "columns": {"code": "point"}}),
        "gsi": lambda: (survey_files.gsi(), {"crs": "EPSG:32632", "columns": {"code": "point"}}),
        "landxml": lambda: (survey_files.landxml(), {"columns": {"code": "point"}}),
        "dxf": lambda: (survey_files.dxf(), {"crs": "EPSG:32632"}),
    }[kind]()
    answer = _send(client, data, {**declared, **more})
    assert answer.status_code == 201, answer.text
    assert answer.json()["format"] == kind
    found = [
        (str(m["code"]["number"]), m["position"]["lon_deg"], m["position"]["lat_deg"], m["position"]["height_m"])
        for m in _markers(client)
    ]
    for (number, *place), (name, *true) in zip(sorted(found), survey_files.POINTS, strict=True):
        assert number == name
        assert place[:2] == pytest.approx(true[:2], abs=2e-9)
        assert place[2] == pytest.approx(true[2], abs=1e-6)


def _at_county(client: httpx.Client, tmp_path: Path, base: str, datum: str, **declared: object) -> httpx.Response:
    prj = survey_files.COUNTY_GRID.format(base=base, datum=datum)
    data = survey_files.county_shapefile(tmp_path, [(500000.0, 10000.0), (500328.0, 10000.0)], prj)
    members = {"family": "cerpm", "columns": {"code": "number"}, "realization": "NAD83(2011)", "epoch": 2010.0}
    return _send(client, data, {**members, **declared})


def test_a_grid_without_an_epsg_code_is_read_by_its_own_definition(client: httpx.Client, tmp_path: Path) -> None:
    answer = _at_county(client, tmp_path, "GCS_NAD_1983_2011", "D_NAD_1983_2011")
    assert answer.status_code == 201, answer.text
    assert {d["value"] for d in answer.json()["detected"] if d["what"] == "crs"} == {"EPSG:6318"}
    found = sorted(_markers(client), key=lambda marker: marker["code"]["number"])
    definition = (
        "+proj=tmerc +lat_0=44 +lon_0=-93.1 +k=1.00003 +x_0=152400.3048006096 +y_0=0 +ellps=GRS80 +units=us-ft +no_defs"
    )
    for marker, feet in zip(found, [(500000.0, 10000.0), (500328.0, 10000.0)], strict=True):
        lon_deg, lat_deg = pyproj.Proj(definition)(*feet, inverse=True)
        original = marker["position"]["original"]
        assert (original["crs"], original["realization"]) == ("EPSG:6318", "NAD83(2011)")
        assert (original["lon_deg"], original["lat_deg"]) == pytest.approx((lon_deg, lat_deg), abs=2e-10)


def test_a_grid_on_an_unknown_datum_is_refused_by_its_name(client: httpx.Client, tmp_path: Path) -> None:
    problem = _at_county(client, tmp_path, "GCS_Our_Own", "D_Our_Own", dry_run=True)
    assert problem.status_code == 422
    assert "'County_Grid_Feet'" in problem.json()["detail"]
    assert "no EPSG code" in problem.json()["detail"]


def test_heights_of_a_grid_in_feet_need_a_unit(client: httpx.Client, tmp_path: Path) -> None:
    prj = survey_files.COUNTY_GRID.format(base="GCS_NAD_1983_2011", datum="D_NAD_1983_2011")
    data = survey_files.county_shapefile(tmp_path, [(500000.0, 10000.0, 830.0), (500328.0, 10000.0, 831.0)], prj)
    problem = _send(client, data, {"family": "cerpm", "columns": {"code": "number"}, "vertical_datum": "EPSG:5703"})
    assert problem.status_code == 422
    assert problem.json()["field"] == "declaration.height_unit"


# --- bad input --------------------------------------------------------------------------------------------------------

BOMB = b'<?xml version="1.0"?><!DOCTYPE k [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;">]><kml>&b;</kml>'


def _bad_zip(name: str, content: bytes) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(f"{name}.shp", content)
        archive.writestr(f"{name}.shx", content[:200])
        archive.writestr(f"{name}.dbf", content[:200])
    return packed.getvalue()


@pytest.mark.parametrize(
    ("data", "declared", "field"),
    [
        (BOMB, {}, "file"),
        (b"<kml><Document></kml>", {}, "file"),
        (b"<kml>" + b"<a>" * 5000 + b"</a>" * 5000 + b"</kml>", {}, "file"),
        (b"SQLite format 3\x00" + b"\x00" * 1000, {}, "file"),
        (b"PK\x03\x04 no archive", {}, "file"),
        (lambda: _bad_zip("survey", b"\x00" * 200), {}, "file"),
        (lambda: _bad_zip("../../etc/passwd", b"\x00\x00\x27\x0a" + b"\xff" * 300), {}, "file"),
        (lambda: _bad_zip("bomb", b"\x00\x00\x27\x0a" + b"\x00" * 600 * 2**20), {}, "file"),
        (b'{"type": "FeatureCollection", "features": ' + b"[" * 100_000, {}, "file"),
        (b'{"type": "Point"}', {}, "file"),
        (b"0\nSECTION\n2\nHEADER\n9\n", {"crs": "EPSG:32632"}, "file"),
        (b"number,lon,lat\n1,8,49\x00\n", {}, "file"),
        (b"number,lon,lat\n1,8,\x81\n", {}, "file"),
        (b"number,lon,lon\n1,8,49\n", {}, "file"),
        (b'number,lon,lat\n1,8,"49\n', {}, "file"),
        (b"number,lon,lat\n", {}, "file"),
        (b"number,a,b\n1,8,49\n", {}, "declaration.columns"),
        (b"1,8,49\n2,8,49\n", {}, "file"),
        (b"\x00\x01\x02\x03", {}, "file"),
        (_csv(), {"crs": "EPSG:25832"}, "declaration.crs"),
        (_csv(), {"crs": "+proj=longlat +datum=WGS84"}, "declaration.crs"),
        (b"number,lon,lat,height\n1,8.42,49,5\n", {}, "declaration.vertical_datum"),
        (_csv(), {"columns": {"code": "none"}}, "declaration.columns.code"),
        (_csv(), {"columns": {"nonsense": "lon"}}, "declaration.columns"),
        (_csv(), {"family": "magnet"}, "declaration.family"),
        (_csv(), {"unit": "feet"}, "declaration.unit"),
        (_csv(), {"area_deg": [8, 49, 7, 50]}, "declaration.area_deg"),
        (_csv(), {"epoch": 1e99}, "declaration.epoch"),
        (_csv(), {"nothing": 1}, "declaration.nothing"),
        (b"", {}, "file"),
    ],
)  # fmt: skip
def test_bad_input_is_a_problem_with_field_limit_and_cure(
    client: httpx.Client, data: bytes | Callable[[], bytes], declared: dict[str, Any], field: str
) -> None:
    content = data if isinstance(data, bytes) else data()
    answer = _send(client, content, {**DEGREES, "columns": {}, **declared})
    assert 400 <= answer.status_code < 500, answer.text
    problem = answer.json()
    assert problem["field"] == field, problem
    assert problem["limit"]
    assert problem["cure"]
    assert _markers(client) == []


def test_a_geopackage_with_a_view_is_refused(client: httpx.Client, tmp_path: Path) -> None:
    import sqlite3

    path = survey_files.layer(tmp_path, "GPKG", "survey.gpkg")
    with sqlite3.connect(path) as connection:
        connection.execute("CREATE VIEW endless AS SELECT 1")
    connection.close()
    answer = _send(client, path.read_bytes(), {"family": "cerpm", "vertical_datum": "ellipsoid"})
    assert answer.status_code == 422
    assert "view" in answer.json()["detail"]


def test_a_viewer_cannot_import_and_a_large_file_is_refused_unread(server: LiveServer, client: httpx.Client) -> None:
    from app.services.access.access import Scope

    with server.agency("viewers", Scope.VIEWER) as viewer:
        assert _send(viewer, _csv(), DEGREES).status_code == 403
    assert _send(client, b"x" * 2**25, DEGREES).status_code == 413


def _finished(client: httpx.Client, answer: httpx.Response) -> dict[str, Any]:
    """A queued import when it is done."""
    assert answer.status_code == 202, answer.text
    assert answer.json()["state"] == "queued"
    return finished(client, answer.headers["location"])


def test_an_import_can_be_a_job(server: LiveServer, client: httpx.Client) -> None:
    later = {"Prefer": "respond-async", "Idempotency-Key": "once"}
    job = _finished(client, _send(client, _csv(), DEGREES, **later))
    assert (job["state"], job["progress"], job["error"], job["result"]["stored"]) == ("done", 1.0, None, 8)
    again = _send(client, _csv(), DEGREES, **later)
    assert (again.status_code, again.json()["id"]) == (202, job["id"])
    assert again.headers["idempotency-replayed"] == "true"
    assert len(_markers(client)) == 8
    versions = client.get(f"/v1/markers/{_markers(client)[0]['id']}/versions").json()["items"]
    assert [version["who"] for version in versions] == [versions[0]["who"]]
    refused = _finished(client, _send(client, _csv(), DEGREES, Prefer="respond-async"))
    assert (refused["state"], refused["result"]["outcome"]) == ("done", "refused")
    assert refused["result"]["counts"]["file_already_imported"] == 1
    failed = _finished(client, _send(client, b"\x00\x01", DEGREES, Prefer="respond-async"))
    assert (failed["state"], failed["result"]) == ("failed", None)
    assert failed["error"]["field"] == "file"
    assert client.get("/v1/decodes").json()["items"] == []
    assert client.get(f"/v1/decodes/{job['id']}").status_code == 404
    with server.agency("imports of another") as other:
        assert other.get(f"/v1/jobs/{job['id']}").status_code == 404


@pytest.mark.slow
def test_a_large_file_becomes_a_job_and_runs_once(server: LiveServer, client: httpx.Client) -> None:
    blank = b"\n" * (8 * 2**20)  # empty lines count for nothing but bytes
    job = _finished(client, _send(client, _csv(20) + blank, DEGREES))
    assert job["result"]["stored"] == 20
    jobs = server.app.state.use_cases.jobs
    jobs.run_job(job["id"])  # once more, as after a crash
    assert client.get(f"/v1/jobs/{job['id']}").json() == job
    assert len(_markers(client)) == 20


def test_form_parts_are_checked(client: httpx.Client) -> None:
    assert client.post("/v1/imports", content=b"x").status_code == 415
    assert client.post("/v1/imports", files={"other": ("a", b"b")}).status_code == 400
    assert client.post("/v1/imports", data={"declaration": "{}"}, files={"x": ("", b"")}).status_code == 400
    twice = [("file", ("a", b"b")), ("file", ("a", b"b"))]
    assert client.post("/v1/imports", files=twice).status_code == 400


def test_rows_on_a_registered_road_get_its_measures_and_keep_them_right_when_they_are_surveyed(
    client: httpx.Client,
) -> None:
    line = {"type": "LineString", "coordinates": [[LON, LAT], [LON + 10 * STEP, LAT]]}
    road = {"name": "K 1", "geometry": line, "calibration": [{"measure_m": 500, "vertex": 0}]}
    length_m = client.post("/v1/roads", json=road).json()["length_m"]
    assert _send(client, _csv(), {**DEGREES, "road": "K 1"}).status_code == 201

    def measures() -> list[float]:
        return [m["measure_m"] for m in sorted(_markers(client), key=lambda m: m["code"]["number"])]

    expected = [500 + length_m * k / 10 for k in range(1, 9)]
    assert measures() == pytest.approx(expected, abs=1e-3)
    moved = "\n".join(["number,lon,lat", *(f"{k},{LON + (k + 0.01) * STEP:.9f},{LAT:.9f}" for k in range(1, 9))])
    built = {**DEGREES, "compare": True, "tolerance_m": 5.0, "status": "surveyed"}
    assert _send(client, moved.encode(), built).status_code == 201
    assert measures() == pytest.approx([m + length_m / 1000 for m in expected], abs=1e-3)


def test_stations_of_a_survey_are_compared_with_the_registered_road(client: httpx.Client) -> None:
    """At 1 km stations go on from 12+300 after 12+600: 12+400 is twice on the road, and both are right."""
    line = {"type": "LineString", "coordinates": [[LON, LAT], [LON + 0.02, LAT]]}
    points = [{"measure_m": 11_600, "vertex": 0}, {"measure_m": 12_600, "ahead_m": 12_300, "chainage_m": 1000}]
    road = client.post("/v1/roads", json={"name": "K 2", "geometry": line, "calibration": points}).json()
    references = [{"measure_m": measure_m, "offset_m": 0.0} for measure_m in (11_700, 12_400)]
    placed = client.post(f"/v1/roads/{road['id']}/position", json={"references": references}).json()["items"]
    (first,), (before, after) = (item["places"] for item in placed)
    spots = [(first, "11+700.00"), (before, "12+400.00"), (after, "12+400.02"), (after, "11+700.00")]
    lines = [f"{k},{p['lon_deg']:.9f},{p['lat_deg'] + k * 1e-5:.9f},{s}" for k, (p, s) in enumerate(spots, 1)]
    data = "\n".join(["number,lon,lat,station", *lines]).encode()
    report = _send(client, data, {**DEGREES, "road": "K 2"}).json()
    (fault,) = [fault for fault in report["faults"] if fault["code"] == "measure_disagrees"]
    assert (fault["row"], fault["severity"]) == (4, "warning")
    assert "the measure is 11+700.00, the position lies at 12+400.00" in fault["message"]
    listed = client.get(f"/v1/roads/{road['id']}/markers").json()["items"]
    assert [m["measure_m"] for m in listed] == [11_700.0, 11_700.0, 12_400.0, 12_400.02]
    assert [m["code"]["number"] for m in listed[2:]] == [2, 3]


def test_rows_that_are_left_out_are_neither_checked_nor_stored(client: httpx.Client) -> None:
    data = _csv(row3="3,8.4,abc", row5="2,8.417,49.0052")
    dry = _send(client, data, {**DEGREES, "dry_run": True, "list_rows": 100}).json()
    assert [(row["row"], row["state"]) for row in dry["listed"]][2:5] == [(3, "refused"), (4, "good"), (5, "refused")]
    left = {**DEGREES, "leave_out": [3, 5, 999]}
    dry = _send(client, data, {**left, "dry_run": True, "list_rows": 100}).json()
    assert (dry["good_rows"], dry["refused_rows"], dry["left_out_rows"]) == (6, 0, 2)
    assert "not_a_number" not in dry["counts"]
    listed = {row["row"]: row for row in dry["listed"]}
    assert [row for row in listed if listed[row]["state"] == "left-out"] == [3, 5]
    assert listed[3]["lon_deg"] is None
    assert listed[1] == {
        "row": 1, "state": "good", "point": None, "code": "1", "lon_deg": pytest.approx(LON + STEP, abs=1e-8),
        "lat_deg": pytest.approx(LAT, abs=1e-6), "height_m": None,
    }  # fmt: skip
    stored = _send(client, data, left)
    assert stored.status_code == 201, stored.text
    assert stored.json()["listed"] == []
    assert sorted(marker["code"]["number"] for marker in _markers(client)) == [1, 2, 4, 6, 7, 8]


def test_most_rows_can_be_left_out(client: httpx.Client) -> None:
    report = _send(client, _csv(), {**DEGREES, "leave_out": [1, 2, 3, 4, 5, 6], "dry_run": True}).json()
    assert (report["good_rows"], report["left_out_rows"]) == (2, 6)
    nothing = _send(client, _csv(), {**DEGREES, "leave_out": list(range(1, 9))})
    assert nothing.status_code == 422


def test_a_correction_of_the_declaration_can_be_merged_into_it(client: httpx.Client) -> None:
    data = _csv().replace(b"number,lon,lat", b"number,lat,lon")  # the header is wrong
    report = _send(client, data, {**DEGREES, "dry_run": True}).json()
    (fault,) = [fault for fault in report["faults"] if fault["row"] is None and fault["severity"] == "refused"]
    assert fault["code"] == "swapped_axes"
    assert fault["changes"] == {"columns": {"lon_deg": "lat", "lat_deg": "lon"}}
    corrected = {**DEGREES, "columns": {**DEGREES["columns"], **fault["changes"]["columns"]}}
    report = _send(client, data, {**corrected, "dry_run": True}).json()
    assert report["good_rows"] == 8


def test_accuracies_in_millimetres_are_corrected(client: httpx.Client) -> None:
    survey = {"horizontal_rmse_m": 15.0, "surveyor": "A. Muster"}
    report = _send(client, _csv(), {**DEGREES, "survey": survey, "dry_run": True}).json()
    (fault,) = [fault for fault in report["faults"] if fault["code"] == "coarse_accuracy"]
    assert fault["changes"] == {"survey": {"horizontal_rmse_m": 0.015}}


def test_listed_rows_of_a_long_survey_are_spread_over_it(client: httpx.Client) -> None:
    report = _send(client, _csv(60, row30="30,8.4,abc"), {**DEGREES, "dry_run": True, "list_rows": 10}).json()
    rows = [row["row"] for row in report["listed"]]
    assert rows == sorted(set(rows))
    assert {1, 30, 60} <= set(rows)
    assert len(rows) <= 10


@pytest.mark.parametrize("wrong", [{"leave_out": [0]}, {"leave_out": [1.5]}, {"list_rows": 2001}, {"list_rows": -1}])
def test_bad_lists_of_rows_are_refused(client: httpx.Client, wrong: dict[str, Any]) -> None:
    answer = _send(client, _csv(), {**DEGREES, **wrong})
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["field"].startswith(f"declaration.{next(iter(wrong))}")
