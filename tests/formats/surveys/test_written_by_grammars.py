"""Tables and GeoJSON that grammars of `benchmarks.fuzz` wrote and that were once refused, or read in a wrong unit."""

from __future__ import annotations

import json
from codecs import BOM_UTF8
from typing import Any

import pytest

from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.read import read_survey
from app.formats.surveys.table import SurveyTable


def read(text: str | bytes, **declared: Any) -> SurveyTable:
    data = text.encode() if isinstance(text, str) else text
    return read_survey(data, ImportDeclaration(family="cerpm", crs="EPSG:25832", **declared))


@pytest.mark.parametrize(
    "text",
    [
        # decimal commas between blanks, also with groups of digits, above blank lines
        "Z PtID E N\n163,25 P1 551946,3989 7060053,4359\n161,71 P2 551962,1212 7060064,1738\n\n\n\n\n",
        "Z pt E N\n163,25 P1 551'946,3989 7'060'053,4359\n161,71 P2 551'962,1212 7'060'064,1738\n",
        # another delimiter in quoted texts of all rows, and texts of several lines
        'PtID,E,N,Z,Desc\nP1,551946.3989,7060053.4359,163.25,"a; b"\nP2,551962.1212,7060064.1738,161.71,"c; d"\n',
        "PtID|E|N|Z|Desc\nP1|551946,3989|7060053,4359|163,25|\"a\nb, c\"\nP2|551962,1212|7060064,1738|161,71|\"d\n"
        'e, f"\n',
        '"PtID"\t"E"\t"N"\t"Z"\t"Desc"\n"P1"\t"551946,3989"\t"7060053,4359"\t"163,25"\t"a, b; c"\n'
        '"P2"\t"551962,1212"\t"7060064,1738"\t"161,71"\t"the ""old"" one"\n',
    ],
)  # fmt: skip
def test_delimiters(text: str) -> None:
    table = read(text, vertical_datum="ellipsoid")
    assert (table.first.tolist(), table.second.tolist()) == ([551946.3989, 551962.1212], [7060053.4359, 7060064.1738])
    assert table.height is not None
    assert table.height.tolist() == [163.25, 161.71]
    assert not table.faults.counts


def test_quotes_of_seconds_are_no_quoted_cells() -> None:
    lines = ["id|lon|lat|note", "1|8°24'59,1\"E|49°00'18,2\"N|a, b", "2|8°24'59,2\"E|49°00'18,3\"N|c, d"]
    table = read_survey("\n".join(lines).encode(), ImportDeclaration(family="cerpm", crs="EPSG:4326"))
    assert table.first.tolist() == pytest.approx([8 + 24 / 60 + 59.1 / 3600, 8 + 24 / 60 + 59.2 / 3600], abs=1e-12)
    assert not table.faults.counts


@pytest.mark.parametrize("name", ["E (mm)", "E [ft]", "E_ft", "E (usft)", "E (US survey foot)", "E [ift]"])
def test_a_unit_in_the_name_that_is_not_the_one_that_is_used(name: str) -> None:
    table = read(f"pt,{name},N\n1,457000.1,5428000.2\n2,457010.1,5428010.2\n")
    assert table.faults.counts["unit_in_header"] == 1
    assert table.faults.refuses_file
    assert not read(f"pt,{name.split(' ')[0].split('_')[0]} (m),N [metres]\n1,457000.1,5428000.2\n").faults.counts


def test_a_row_of_units_that_are_not_those_that_are_used() -> None:
    """Before, the row was left out and the heights were read in metres."""
    rows = "1,457000.1,5428000.2,300\n2,457010.1,5428010.2,301\n"
    table = read(f"pt,E,N,Z\n,m,m,ft\n{rows}", vertical_datum="ellipsoid")
    assert [(fault.field, fault.code) for fault in table.faults.shown(9)] == [("height", "unit_in_header")]
    assert table.faults.refuses_file
    declared = read(f"pt,E,N,Z\n,m,m,ft\n{rows}", vertical_datum="ellipsoid", height_unit="ft-intl")
    assert not declared.faults.counts
    assert read(f"pt,E,N,Z\n,m,m,m\n{rows}", vertical_datum="ellipsoid").height_unit == "m"


def test_geojson_with_a_byte_order_mark() -> None:
    point = {"type": "Feature", "properties": {}, "geometry": {"type": "Point", "coordinates": [457000.0, 5428000.0]}}
    data = json.dumps({"type": "FeatureCollection", "features": [point]}).encode()
    assert read(BOM_UTF8 + data).first.tolist() == read(data).first.tolist() == [457000.0]
