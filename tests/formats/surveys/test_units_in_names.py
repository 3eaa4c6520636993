"""Units in the names of columns, and in a row below them, that differ from the units that are used are refused."""

from __future__ import annotations

from typing import Any

import pytest

from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.read import read_survey
from app.formats.surveys.roles import split_unit
from app.formats.surveys.table import SurveyTable


def _grid(header: str, *rows: str, **declared: Any) -> SurveyTable:
    declaration = ImportDeclaration(**{"crs": "EPSG:25832", "vertical_datum": "ellipsoid", **declared})
    return read_survey("\n".join([header, *rows]).encode(), declaration)


def _faults(table: SurveyTable) -> list[tuple[str, str]]:
    return [(fault.field, fault.code) for fault in table.faults.shown(9)]


NAMES = {
    "Elevation (sUSft)": "ft-us", "Height ft": "ft", "Elevation feet": "ft", "Height-ft": "ft", "Height.ft": "ft",
    "Height/ft": "ft", "Height, ft": "ft", "Height {ft}": "ft", "Elevation <ft>": "ft", "Elevation (ft, NAVD88)": "ft",
    "Elevation (NAVD88, ft)": "ft", "Elevation (NAVD88 ft)": "ft", "Elevation (U.S. Survey Feet)": "ft-us",
    "Elevation (Survey Feet)": "ft-us", "Elevation (International Feet)": "ft-intl", "Elevation (Int. ft)": "ft-intl",
    "Elevation (feet US)": "ft-us", "Height US ft": "ft-us", "Elev (ft.)": "ft", "Elevation (ft above MSL)": "ft",
    "Elevation (yd)": "yd", "Elevation (in)": "in", "Elevation (dm)": "dm", "Height in feet": "ft", "elev_mm": "mm",
    "HeightFt": "ft", "Höhe [m]": "m", "Height (m above MSL)": "m", "Height": None, "Height (NAVD88)": None,
}  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_the_unit_of_heights(name: str) -> None:
    stem, unit = split_unit(name)
    assert (stem in ("height", "elevation", "elev", "hohe"), unit) == (True, NAMES[name])
    table = _grid(f"pt;E;N;{name}", "1;457000.1;5428000.2;300")
    assert table.height is not None
    assert _faults(table) == ([] if unit in (None, "m") else [("height", "unit_in_header")])
    if unit in ("ft-us", "ft-intl", "ft"):
        declared = _grid(f"pt;E;N;{name}", "1;457000.1;5428000.2;300", height_unit=unit if unit != "ft" else "ft-us")
        assert not declared.faults.counts


@pytest.mark.parametrize("name", ["Easting ft", "easting_yd", "E (ft)", "X [us survey feet]"])
def test_the_unit_of_eastings(name: str) -> None:
    assert _faults(_grid(f"pt;{name};N", "1;457000.1;5428000.2")) == [("easting", "unit_in_header")]


@pytest.mark.parametrize(
    "name",
    ["pt_in", "Point", "Punkt-Nr.", "X_COORD", "Grid Easting", "Chain (m)", "north", "km", "Ordinal in", "left", "min"],
)
def test_names_that_only_resemble_units(name: str) -> None:
    _stem, unit = split_unit(name)
    assert unit == {"pt_in": "in", "Ordinal in": "in", "Chain (m)": "m", "km": "km"}.get(name)


@pytest.mark.parametrize("names", ["lat_gon;lon_gon", "Latitude [grad];lon", "Latitude (DD.MMSSss);lon", "lat_rad;lon"])
def test_longitudes_and_latitudes_in_other_units_than_degrees(names: str) -> None:
    table = _grid(names, "49.0018;8.2459", crs="EPSG:4326")
    assert {code for _field, code in _faults(table)} == {"unit_in_header"}
    assert table.faults.refuses_file
    row_of_units = _grid("lat;lon\ngon;gon", "54.4456;9.1667", crs="EPSG:4326")
    assert _faults(row_of_units) == [("lon_deg", "unit_in_header"), ("lat_deg", "unit_in_header")]


@pytest.mark.parametrize("name", ["lat_deg", "Latitude (°)", "Latitude (decimal degrees)", "lat_dd", "Latitude [deg]"])
def test_latitudes_in_degrees(name: str) -> None:
    assert not _grid(f"{name};lon", "49.0018;8.2459", crs="EPSG:4326").faults.counts
    signs = "Latitude (DD°MM'SS.ss);lon", "49°00'18.2″;8°24'59.1″"
    assert not _grid(*signs, crs="EPSG:4326").faults.counts
    assert not _grid("lat_dms;lon_dms", "49°00'18.2\"N;8°24'59.1\"E", crs="EPSG:4326").faults.counts


@pytest.mark.parametrize(
    ("role", "name", "cell"),
    [
        ("measure_m", "Station_km", "12.345"),
        ("measure_m", "km", "12.345"),
        ("measure_m", "Station (ft)", "1234.5"),
        ("heading_deg", "Azimuth (gon)", "100"),
        ("offset_m", "Offset (ft)", "1.5"),
        ("horizontal_rmse_m", "HRMS (ft)", "0.1"),
    ],
)
def test_units_of_other_measures(role: str, name: str, cell: str) -> None:
    table = _grid(f"E;N;{name}", f"457000.1;5428000.2;{cell}", columns={role: name})
    assert _faults(table) == [(role, "unit_in_header")]
    assert table.faults.shown(1)[0].changes == ((f"columns.{role}", None),)
    assert not _grid(f"E;N;{name}", f"457000.1;5428000.2;{cell}", columns={role: None}).faults.counts


def test_kilometres_in_a_row_of_units_and_stations() -> None:
    row = "457000.1;5428000.2;12.345"
    assert _faults(_grid("E;N;Station", "m;m;km", row, columns={"measure_m": "Station"})) == [
        ("measure_m", "unit_in_header")
    ]
    assert _faults(_grid("E;N;Station (ft)", row)) == [("measure_m", "unit_in_header")]
    table = _grid("E;N;Station_km", "457000.1;5428000.2;12+345.6")
    assert table.numbers["measure_m"].tolist() == [12345.6]
    assert not table.faults.counts
