"""Columns get their roles by their names and values; a role can be switched off."""

from __future__ import annotations

from typing import Any

import pytest

from app.errors import InvalidParameter
from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.read import read_survey
from app.formats.surveys.roles import CodeForm
from app.formats.surveys.table import SurveyTable

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
