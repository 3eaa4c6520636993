"""Columns get their roles by their names and values; a role can be switched off."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import shapely

from app.errors import InvalidParameter
from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.read import read_survey
from app.formats.surveys.roles import CodeForm
from app.formats.surveys.table import SurveyTable
from app.geodesy.systems import system_of_wkt

NUMBERS = CodeForm("[1-9][0-9]{0,9}", True, "numbers of CERPMs")
DEGREES = {"crs": "EPSG:4326", "family": "cerpm"}


def _read(text: str, code_form: CodeForm | None = NUMBERS, **declared: Any) -> SurveyTable:
    return read_survey(text.encode(), ImportDeclaration(**{**DEGREES, **declared}), code_form)


def _rows(header: str, *cells: str) -> str:
    return "\n".join([f"lon,lat,{header}", *(f"8.{k}1,49.01,{text}" for k, text in enumerate(cells))])


def test_a_surveys_own_codes_and_statuses_are_no_roles() -> None:
    read = _read(_rows("Code,Status", "EOP,FIXED", "EOP,FLOAT", "CL,FIXED"))
    assert set(read.texts) == set()
    assert read.faults.counts == {"role_without_evidence": 2}
    messages = [fault.message for fault in read.faults.shown(9)]
    assert messages == [
        "the column 'Code' was not read as code: 0 of 3 values are numbers of CERPMs, 'EOP' is not",
        "the column 'Status' was not read as status: 0 of 3 values are one of planned, built, surveyed, active, "
        "suspect, retired, 'FIXED' is not",
    ]
    assert not read.faults.refuses_file


def test_codes_that_repeat_are_none_of_markers_that_each_have_their_own() -> None:
    read = _read(_rows("Code", *["101"] * 5, "102"))
    assert "code" not in read.texts
    assert "only 2 different ones" in read.faults.shown(1)[0].message
    assert "code" in _read(_rows("Code", *["101"] * 5), NUMBERS._replace(differ=False)).texts


def test_values_that_fit_make_the_role_and_the_evidence_is_reported() -> None:
    read = _read(_rows("Number,Status", "1,built", "2,planned", "x,built"))
    assert list(read.texts["code"]) == ["1", "2", "x"]  # the third becomes a fault of its row
    assert list(read.texts["status"]) == ["built", "planned", "built"]
    found = {one.what: (one.value, one.evidence) for one in read.detected}
    assert found["column of code"] == ("Number", "its name; 2 of 3 values are numbers of CERPMs")
    assert found["column of lon_deg"] == ("lon", "its name")


def test_a_column_with_codes_is_preferred_to_one_that_is_only_named_so() -> None:
    read = _read(_rows("Code,Number", "EOP,7", "CL,8", "EOP,9"))
    assert list(read.texts["code"]) == ["7", "8", "9"]
    assert not read.faults.counts


@pytest.mark.parametrize("off", [None, ""])
def test_a_role_can_be_switched_off(off: str | None) -> None:
    text = _rows("Code,Status", "1,built", "2,built")
    read = _read(text, columns={"code": off, "status": off})
    assert set(read.texts) == set()
    assert not read.faults.counts
    assert set(_read(text).texts) == {"code", "status"}


def test_a_declared_column_needs_no_evidence() -> None:
    assert list(_read(_rows("Label", "EOP", "CL"), columns={"code": "Label"}).texts["code"]) == ["EOP", "CL"]
    with pytest.raises(InvalidParameter, match="no column 'nothing'"):
        _read(_rows("Label", "EOP", "CL"), columns={"code": "nothing"})


@pytest.mark.parametrize(
    "header",
    [
        "Punktnr;Rechtswert [m];Hochwert [m];Höhe [m]",
        "Point Name;Easting (m);Northing (m);Elevation (m)",
        "No.;E;N;H",
        "PUNTO;ESTE;NORTE;COTA",
        "point_id;X_COORD;Y_COORD;Z_COORD",
        "Name;Grid Easting;Grid Northing;Orthometric height",
    ],
)
def test_names_of_other_programs_and_languages(header: str) -> None:
    text = f"{header}\nA1;456789.123;5427345.678;112.5\nA2;456799.123;5427345.678;112.6\n"
    read = _read(text, crs="EPSG:25832", vertical_datum="EPSG:7837")
    assert list(read.texts["point"]) == ["A1", "A2"]
    assert (read.first[0], read.second[0]) == (456789.123, 5427345.678)
    assert read.height is not None
    assert read.height.tolist() == [112.5, 112.6]


def test_of_two_heights_the_one_above_the_declared_datum_is_read() -> None:
    text = _rows("Elevation,Ellipsoidal height", "112.5,160.5", "112.6,160.6")
    for datum, expected in (("ellipsoid", 160.5), ("EPSG:7837", 112.5)):
        height = _read(text, vertical_datum=datum).height
        assert height is not None
        assert height[0] == expected


@pytest.mark.parametrize("name", ["Station", "measure_m", "Chainage [m]", "km"])
def test_measures_as_kilometres_and_metres(name: str) -> None:
    read = _read(_rows(name, "12+345.67", "12+346", "-0+001.5"))
    assert read.numbers["measure_m"].tolist() == [12345.67, 12346.0, -1.5]
    assert "point" not in read.texts
    assert not read.faults.counts


def test_what_is_no_measure() -> None:
    points = _read(_rows("Station", "101", "102", "P7"))
    assert list(points.texts["point"]) == ["101", "102", "P7"]
    assert "measure_m" not in points.numbers
    assert "measure_m" not in _read(_rows("km", "12.3", "12.4")).numbers, "kilometres of a road, or of an odometer"
    assert _read(_rows("chainage_m", "12.3", "12.4")).numbers["measure_m"].tolist() == [12.3, 12.4]
    read = _read(_rows("Station", "12+345.67", "123+45.6", "12+346"))
    assert read.faults.counts == {"station_of_100_ft": 1}
    assert np.isnan(read.numbers["measure_m"][1])


# The X of these systems is the northing; their false origins make both orders lie in their areas of use.
@pytest.mark.parametrize("crs", ["EPSG:2180", "EPSG:6677"])
def test_columns_x_and_y_that_can_be_read_in_both_orders_are_refused(crs: str) -> None:
    north = {"EPSG:2180": (480_000.0, 640_000.0), "EPSG:6677": (-30_000.0, -8_000.0)}[crs]
    rows = "\n".join(["X;Y", *(f"{north[0] + k};{north[1] + k}" for k in range(5))])
    with pytest.raises(InvalidParameter, match="in both orders") as caught:
        _read(rows, crs=crs)
    assert caught.value.cure is not None
    assert 'declare columns {"easting": "Y", "northing": "X"}' in caught.value.cure
    read = _read(rows, crs=crs, columns={"easting": "Y", "northing": "X"})
    assert (read.first[0], read.second[0]) == north[::-1]
    assert _read(rows.replace("X;Y", "E;N"), crs=crs).first[0] == north[0]


def test_columns_x_and_y_of_which_one_order_lies_in_the_area_are_read() -> None:
    rows = "X;Y\n3400000;5600000\n3400010;5600010"  # EPSG:31467 has X to the north, and the file GIS order
    assert _read(rows, crs="EPSG:31467").first[0] == 3_400_000
    in_poland = "X;Y\n480000;640000\n480010;640010"
    assert _read(in_poland, crs="EPSG:2180", area_deg=(18.0, 53.0, 20.0, 54.9)).first[0] == 480_000


@pytest.mark.parametrize(
    ("name", "cells", "refused"),
    [
        ("EPSG", ["25832", "25833"], True),
        ("datum", ["NAD83", "NAD27"], True),
        ("Datum", ["12.05.2024", "13.05.2024"], False),  # German for a date
        ("Zone", ["32U", "33U"], True),
        ("zone", ["north", "south"], False),
        ("epsg", ["4326", "4326"], False),
    ],
)
def test_rows_in_several_systems_are_refused(name: str, cells: list[str], refused: bool) -> None:
    rows = _rows(name, *cells)
    if not refused:
        assert _read(rows).rows == 2
        return
    with pytest.raises(InvalidParameter, match="the rows are in several systems"):
        _read(rows)
    assert _read(rows, columns={"description": name}).rows == 2


def test_geometries_with_several_srids_are_refused() -> None:
    rows = "id,geom\n1,SRID=25832;POINT(440000 5430000)\n2,SRID=25833;POINT(440010 5430000)"
    with pytest.raises(InvalidParameter, match="several SRIDs: 25832, 25833"):
        read_survey(rows.encode(), ImportDeclaration(), None)
    points = [shapely.set_srid(shapely.Point(440_000, 5_430_000), srid) for srid in (25832, 25833)]
    hexes = [shapely.to_wkb(point, hex=True, include_srid=True) for point in points]
    hex_rows = f"id,geom\n1,{hexes[0]}\n2,{hexes[1]}"
    with pytest.raises(InvalidParameter, match="several SRIDs: 25832, 25833"):
        read_survey(hex_rows.encode(), ImportDeclaration(), None)
    assert read_survey(rows.replace("25833", "25832").encode(), ImportDeclaration(), None).crs == "EPSG:25832"


@pytest.mark.parametrize(
    ("datum", "spheroid", "code"),
    [
        ("D_WGS_1984", '"WGS_1984",6378137.0,298.257223563', "EPSG:4326"),
        ("D_ETRS_1989", '"GRS_1980",6378137.0,298.257222101', "EPSG:4258"),
        ("D_North_American_1983", '"GRS_1980",6378137.0,298.257222101', "EPSG:4269"),
    ],
)
def test_a_county_grid_has_the_geographic_system_of_its_datum(datum: str, spheroid: str, code: str) -> None:
    wkt = (
        f'PROJCS["County",GEOGCS["GCS",DATUM["{datum}",SPHEROID[{spheroid}]],PRIMEM["Greenwich",0.0],'
        'UNIT["Degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],PARAMETER["False_Easting",170000.0],'
        'PARAMETER["False_Northing",50000.0],PARAMETER["Central_Meridian",-90.5],PARAMETER["Scale_Factor",1.0000339],'
        'PARAMETER["Latitude_Of_Origin",45.0],UNIT["Meter",1.0]]'
    )
    assert system_of_wkt(wkt)[1] == code
