"""Columns beside the coordinates that state their hemisphere, their CRS or their zone."""

from __future__ import annotations

from typing import Any

import pytest

from app.errors import InvalidParameter
from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.read import read_survey
from app.formats.surveys.table import SurveyTable


def _read(*lines: str, crs: str | None = "EPSG:4326", **declared: Any) -> SurveyTable:
    return read_survey("\n".join(lines).encode(), ImportDeclaration(crs=crs, **declared))


@pytest.mark.parametrize(
    "header",
    [
        "lat,N/S,lon,E/W",
        "lat,NS,lon,EW",
        "Latitude,LatRef,Longitude,LonRef",
        "lat,lat_dir,lon,lon_dir",
        "Latitude,Latitude Hemisphere,Longitude,Longitude Hemisphere",
        "lat,dir,lon,dir2",
        "lat,hemisphere_ns,lon,hemisphere_ew",
    ],
)
def test_hemispheres_are_signs(header: str) -> None:
    table = _read(header, "33.5,S,70.6,W", "33.6,south,70.7,w")
    assert (table.first.tolist(), table.second.tolist()) == ([-70.6, -70.7], [-33.5, -33.6])
    assert len([found for found in table.detected if found.what == "hemisphere"]) == 2
    signed = _read(header, "-33.5,S,-70.6,W", "0,N,70.7,E")
    assert (signed.first.tolist(), signed.second.tolist()) == ([-70.6, 70.7], [-33.5, 0.0])
    assert not signed.faults.counts


@pytest.mark.parametrize(
    "row", ["33.5,S,70.6,O", "33.5,S,70.6,", "-33.5,N,70.6,W", "33.5,E,70.6,W", "33.5,-,70.6,W", "33.5,S,70.6,SW"]
)
def test_hemispheres_that_are_not_clear_are_refused(row: str) -> None:
    with pytest.raises(InvalidParameter) as caught:
        _read("lat,lat_dir,lon,lon_dir", "33.4,S,70.5,W", row)
    assert caught.value.field in ("columns.lat_deg", "columns.lon_deg")
    with pytest.raises(InvalidParameter):
        _read("lat,lon,Hemisphere", "33.5,70.6,SW")


def test_directions_of_traffic_and_texts_are_no_hemispheres() -> None:
    assert _read("lat,lon,direction", "49.0,8.4,W").first.tolist() == [8.4]
    assert _read("lat,lon,lat_ref", "49.0,8.4,base 1").first.tolist() == [8.4]
    assert _read("lat,lon,E/W", "49.0,8.4,W", columns={"description": "E/W"}).first.tolist() == [8.4]


GRID = "457000.1,5428000.2"


@pytest.mark.parametrize(("name", "cell"), [("epsg", "25833"), ("crs", "EPSG:25833"), ("zone", "33U"), ("Zone", "33")])
def test_a_column_that_contradicts_the_declared_crs(name: str, cell: str) -> None:
    rows = f"E,N,{name}", f"{GRID},{cell}", f"{GRID},{cell}"
    with pytest.raises(InvalidParameter, match="33") as caught:
        _read(*rows, crs="EPSG:25832")
    assert caught.value.field == "crs"
    assert _read(*rows, crs="EPSG:25833").rows == 2
    assert _read(*rows, crs="EPSG:25832", columns={"description": name}).rows == 2


def test_a_column_with_one_code_states_the_crs() -> None:
    table = _read("E,N,epsg", f"{GRID},25833", f"{GRID},25833", crs=None)
    assert table.crs == "EPSG:25833"
    assert [found.value for found in table.detected if found.what == "crs"] == ["EPSG:25833"]
    with pytest.raises(InvalidParameter, match="zone 32 in all rows, EPSG:25833 has zone 33"):
        _read("E,N,epsg,zone", f"{GRID},25833,32", crs=None)
    with pytest.raises(InvalidParameter, match="no CRS that is known here"):
        _read("E,N,epsg", f"{GRID},99999", crs=None)
    with pytest.raises(InvalidParameter, match="in both orders"):
        _read("X,Y,epsg", "480000,640000,2180", "480010,640010,2180", crs=None)


def test_the_crs_of_an_export_of_the_registry_is_that_of_the_original_survey() -> None:
    header = "lon_deg,lat_deg,crs,survey_file_sha256,localization_grade"
    table = _read(header, "8.4,49.0,EPSG:25832,,lane", "8.5,49.0,EPSG:25833,,lane")
    assert table.first.tolist() == [8.4, 8.5]
    assert table.crs == "EPSG:4326"


@pytest.mark.parametrize("header", ["lat,Longitude (W)", "Latitude (°S),lon", "Latitude [deg S],lon"])
def test_a_hemisphere_in_the_name(header: str) -> None:
    """Before, longitudes west were stored as east."""
    table = _read(header, "33.5,70.6")
    assert table.faults.counts == {"hemisphere_letter": 1}
    assert table.faults.refuses_file
    assert not _read(header, "-33.5,-70.6").faults.counts
