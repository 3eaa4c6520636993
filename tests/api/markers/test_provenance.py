"""Where positions come from: kept, carried by exports, and put into the figures of the standards."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import orjson
import pytest

from app.markers.reading import MarkerRow, horizontal_rmse_m
from app.registry.column_types import row_of
from app.services.access.access import Scope
from app.services.markers.plausibility import accuracy_document
from app.settings import Settings
from tests.conftest import LiveServer, Place
from tests.geodesy.test_geodesy import GRID, ntv2
from tests.http import created

pytestmark = pytest.mark.both_databases

SHA256 = "0123456789abcdef" * 4
SURVEY = {
    "height_m": 5.2,
    "horizontal_rmse_m": 0.02,
    "vertical_rmse_m": 0.03,
    "survey_method": "GNSS RTK",
    "check_points": 24,
    "surveyor": "A. Muster",
    "instrument": "receiver 7, pole 2 m",
    "survey_file_sha256": SHA256,
}
KEPT = ("survey_method", "check_points", "surveyor", "instrument", "survey_file_sha256")


def test_a_survey_is_kept_and_replaced_as_a_whole(client: httpx.Client, place: Place) -> None:
    spot = place()
    marker = created(client, "/v1/markers", position=spot | SURVEY, status="surveyed")
    assert {name: marker["position"][name] for name in SURVEY} == SURVEY
    assert marker["position"]["transform_accuracy_m"] == pytest.approx(2.0, abs=0.3)  # no realization, no epoch
    path = f"/v1/markers/{marker['id']}"
    again = {"position": spot | {"horizontal_rmse_m": 0.1, "surveyor": "B. Muster"}}
    changed = client.patch(path, json=again, headers={"If-Match": '"1"'}).json()
    assert [changed["position"][name] for name in KEPT] == [None, None, "B. Muster", None, None]
    first = client.get(f"{path}/versions/1").json()["marker"]
    assert {name: first["position"][name] for name in SURVEY} == SURVEY


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("check_points", -1),
        ("check_points", 10**24),
        ("check_points", 1.5),
        ("surveyor", ""),
        ("surveyor", "x" * 201),
        ("instrument", "a\u0000b"),
        ("survey_file_sha256", "A" * 64),
        ("survey_file_sha256", "a" * 63),
    ],
)
def test_what_is_no_survey_is_refused(client: httpx.Client, place: Place, field: str, value: Any) -> None:
    response = client.post("/v1/markers", json={"position": place() | {field: value}})
    assert response.status_code in (400, 422)
    assert response.json()["field"].split(".")[-1] == field or response.status_code == 400


def test_a_lane_of_magnets_has_a_survey_too(client: httpx.Client) -> None:
    lane = {
        "geometry": {"type": "LineString", "coordinates": [[8.0, 50.0], [8.001, 50.0]]},
        **{name: value for name, value in SURVEY.items() if name != "vertical_rmse_m"},
    }
    body = {"family": "magnet", "lane": lane, "tag": {"code": "SNS_4_0.1_10-30", "chainage_m": 5}}
    marker = created(client, "/v1/markers", **body)
    assert {name: marker["position"][name] for name in KEPT} == {name: SURVEY[name] for name in KEPT}


@pytest.mark.slow
def test_imports_set_it_and_exports_carry_it(client: httpx.Client, place: Place) -> None:
    spot = place()
    file = f"lon,lat\n{spot['lon_deg']},{spot['lat_deg']}\n".encode()
    survey = {name: SURVEY[name] for name in ("horizontal_rmse_m", "survey_method", "check_points", "surveyor")}
    declared = {"crs": "EPSG:4326", "epoch": 2025.0, "status": "surveyed", "survey": survey | {"instrument": "rover"}}
    response = client.post(
        "/v1/imports", files={"file": ("s.csv", file)}, data={"declaration": orjson.dumps(declared).decode()}
    )
    report = response.json()
    assert report["outcome"] == "stored", response.text
    assert report["accuracy"]["nssda"]["horizontal_95_m"] == 0.0346
    marker = client.get("/v1/markers").json()["items"][0]
    assert marker["position"]["survey_file_sha256"] == report["file_sha256"]
    assert marker["position"]["instrument"] == "rover"
    (row,) = csv.DictReader(io.StringIO(client.get("/v1/exports/csv").text))
    assert (row["surveyor"], row["check_points"], row["instrument"]) == ("A. Muster", "24", "rover")
    assert (row["survey_file_sha256"], row["crs"]) == (report["file_sha256"], "EPSG:4326")
    (feature,) = client.get("/v1/exports/geojson").json()["features"]
    assert feature["properties"]["check_points"] == 24


def test_accuracy_of_a_marker(client: httpx.Client, place: Place) -> None:
    marker = created(client, "/v1/markers", position=place() | SURVEY, status="surveyed")
    found = client.get(f"/v1/markers/{marker['id']}/accuracy").json()
    assert (found["nssda"]["horizontal_95_m"], found["nssda"]["vertical_95_m"]) == (0.0346, 0.0588)
    assert found["nssda"]["is_tested"]
    assert found["nssda"]["statement"].startswith("Tested 0.035 meters horizontal accuracy at 95% confidence level")
    assert "FGDC-STD-007.3" in found["nssda"]["source"]
    assert (found["asprs_2014"]["horizontal_class_cm"], found["asprs_2014"]["vertical_class_cm"]) == (1.5, 3.0)
    assert found["asprs_2014"]["is_tested"]
    assert (found["asprs_2023"]["horizontal_class_cm"], found["asprs_2023"]["is_tested"]) == (2.0, False)
    assert client.get("/v1/markers/00000000-0000-7000-8000-000000000000/accuracy").status_code == 404


def test_accuracy_that_nobody_tested_says_so() -> None:
    few, none, nothing = (accuracy_document(*values) for values in ((0.1, None, 19), (0.1, 0.2, None), (None,) * 3))
    assert not few["nssda"]["is_tested"]
    assert few["nssda"]["statement"].startswith("Not tested to the standard (only 19 check points, 20 are needed)")
    assert "no check points are stated" in none["nssda"]["statement"]
    assert nothing["nssda"]["statement"] is None
    assert nothing["asprs_2023"]["horizontal_class_cm"] is None


def test_accuracy_of_the_standards_own_rows() -> None:
    """Table of common classes of ASPRS 2014: RMSE_x 0.63 cm, RMSE_r 0.9 cm, 95 % 1.5 cm; 10.0, 14.1, 24.5 cm."""
    for class_cm, radial_cm, sure_cm in ((0.63, 0.9, 1.5), (10.0, 14.1, 24.5)):
        found = accuracy_document(radial_cm / 100, None, 20)
        assert found["asprs_2014"]["horizontal_class_cm"] == pytest.approx(class_cm, abs=0.1)
        assert found["nssda"]["horizontal_95_m"] * 100 == pytest.approx(sure_cm, abs=0.11)


def test_the_bound_of_a_transformation_makes_a_position_worse() -> None:
    exact = row_of(MarkerRow, {"horizontal_rmse_m": 0.03, "transform_accuracy_m": 0.04})
    assert horizontal_rmse_m(exact) == pytest.approx(0.05)
    assert horizontal_rmse_m(exact._replace(transform_accuracy_m=None)) == 0.03
    assert horizontal_rmse_m(exact._replace(horizontal_rmse_m=None)) is None


@pytest.mark.slow
def test_a_folder_of_grids_reaches_the_server(
    serve: Callable[[Settings], LiveServer], settings: Settings, tmp_path: Path
) -> None:
    (tmp_path / GRID).write_bytes(ntv2(-38.0, -30.0, 145.0, 155.0))
    position = {"lon_deg": 151.2, "lat_deg": -33.9, "crs": "EPSG:4283", "epoch": 2020.0, "horizontal_rmse_m": 0.02}
    grades = []
    for folder in (tmp_path, None):
        server = serve(
            settings.model_copy(update={"proj_grids_dir": folder, "data_dir": tmp_path / f"{folder is None}"})
        )
        with server.agency("with grids", Scope.PLANNER) as client:
            marker = created(client, "/v1/markers", position=position)
            grades.append(marker["position"]["localization_grade"])
            client.patch(f"/v1/markers/{marker['id']}", json={"status": "retired"}, headers={"If-Match": "*"})
        server.__exit__()
    assert grades == ["cm", "unfit"]


def test_a_folder_of_grids_has_to_be_there(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="is not a folder"):
        Settings(proj_grids_dir=tmp_path / "nothing")
