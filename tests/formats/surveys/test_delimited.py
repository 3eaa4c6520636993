"""Delimited text as programs write it: encodings, decimal signs, lines before the rows, columns by position."""

from __future__ import annotations

import time
from contextlib import suppress
from typing import Any

import pytest
import shapely
from pyproj import Transformer

from app.errors import InvalidParameter, UnreadableUpload, WaymarkError
from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.read import read_survey
from app.formats.surveys.table import SurveyTable

UTM = {"crs": "EPSG:25832", "vertical_datum": "EPSG:7837"}
E, N, H = [456789.12, 456799.12, 456809.12], [5427345.67, 5427346.67, 5427347.67], [112.5, 112.6, 112.7]


def _read(data: str | bytes, **declared: Any) -> SurveyTable:
    content = data if isinstance(data, bytes) else data.encode()
    return read_survey(content, ImportDeclaration(**{**UTM, **declared}))


def _check(read: SurveyTable) -> dict[str, str]:
    """Check that the three points were read; what was detected."""
    assert not read.faults.counts, read.faults.shown(9)
    assert read.first.tolist() == E
    assert read.second.tolist() == N
    assert read.height is not None
    assert read.height.tolist() == H
    return {one.what: one.value for one in read.detected}


def _text(header: str, row: str) -> str:
    lines = [
        row.format(k=k, e=f"{e:.2f}", n=f"{n:.2f}", h=f"{h:.1f}", ec=f"{e:.2f}".replace(".", ","),
                   nc=f"{n:.2f}".replace(".", ","), hc=f"{h:.1f}".replace(".", ","), eg=f"{e:,.2f}", ng=f"{n:,.2f}")
        for k, (e, n, h) in enumerate(zip(E, N, H, strict=True), 1)
    ]  # fmt: skip
    return "\n".join([*header.split("\n"), *lines] if header else lines) + "\n"


NAMED = _text("Punkt;Rechtswert;Hochwert;Höhe;Bemerkung", "P{k};{ec};{nc};{hc};Straße")


@pytest.mark.parametrize(
    ("encoding", "reported"),
    [
        ("utf-8", "utf-8"), ("utf-8-sig", "utf-8"), ("cp1252", "cp1252"), ("utf-16", "utf-16"),
        ("utf-16-le", "utf-16-le"), ("utf-16-be", "utf-16-be"),
    ],
)  # fmt: skip
def test_encodings(encoding: str, reported: str) -> None:
    read = _read(NAMED.encode(encoding))
    assert _check(read)["encoding"] == reported
    assert list(read.texts["description"]) == ["Straße"] * 3


def test_a_declared_encoding_is_used() -> None:
    read = _read(NAMED.encode("cp850"), encoding="cp850")
    assert "encoding" not in _check(read)
    assert list(read.texts["description"]) == ["Straße"] * 3
    with pytest.raises(UnreadableUpload, match="not text in utf-8"):
        _read(NAMED.encode("cp850"), encoding="utf-8")


@pytest.mark.parametrize(
    ("text", "delimiter", "decimal"),
    [
        (_text("P,E,N,H", '{k},"{ec}","{nc}","{hc}"'), ",", ","),
        (_text("P;E;N;H", "{k};{ec};{nc};{hc}"), ";", ","),
        (_text("P|E|N|H", "{k}|{e}|{n}|{h}"), "|", "."),
        (_text("P E N H", "{k}   {ec} {nc}  {hc}"), "blanks", ","),
        (_text("P\tE\tN\tH", "{k}\t{ec}\t{nc}\t{hc}"), "tab", ","),
        (_text("P,E,N,H", '{k},"{eg}","{ng}",{h}'), ",", ".,"),
        (_text("P,E,N,H", "{k},{e},{n},{h},,"), ",", "."),
    ],
)
def test_delimiters_and_decimal_signs(text: str, delimiter: str, decimal: str) -> None:
    found = _check(_read(text))
    assert found["delimiter"] == delimiter
    assert found["decimal sign"][0] == decimal[0]
    assert ("groups" in found["decimal sign"]) == (len(decimal) > 1)


@pytest.mark.parametrize(
    ("header", "first"),
    [
        ('# exported by a total station\n# 5" pipe\nP,E,N,H', "line 4"),
        ("Job: B10 east\nDate,2025-06-01\n\nP,E,N,H", "line 5"),
        ("#P,E,N,H", None),
        ("// P, E, N, H\n# end of the header", "line 3"),
        ("P,E,N,H\n,[m],[m],[m]", "line 3"),
        ("Point ID,Easting (m),Northing (m),Elevation (m)", None),
    ],
)
def test_lines_before_the_rows(header: str, first: str | None) -> None:
    found = _check(_read(_text(header, "{k},{e},{n},{h}")))
    assert found.get("first row") == first
    assert found["column of easting"]


def test_names_beyond_the_cells_of_the_rows_are_none() -> None:
    """Some programs write the project and the date behind the names."""
    found = _check(_read(_text("P,E,N,H,D,PROJECT1,2020-07-21 12:00", "{k},{e},{n},{h},nail")))
    assert found["header"] == "5 names"


@pytest.mark.parametrize(
    ("row", "layout"),
    [
        ("{k},{n},{e},{h},FND IB", "pnezd"),
        ("{k},{e},{n},{h},FND IB", "penzd"),
        ("A-{k} {n} {e} {h} FND IB", "pnezd"),
        ("{n},{e},{h},FND IB", "nezd"),
        ("{e};{n};{h};FND IB", "enzd"),
        ('"{k}","{nc}","{ec}","{hc}","FND IB"', "pnezd"),
    ],
)
def test_columns_by_position(row: str, layout: str) -> None:
    read = _read(_text("", row))
    assert _check(read)["layout"] == layout
    assert list(read.texts["description"]) == ["FND IB"] * 3
    declared = _read(_text("Project 7\nexported", row), layout=layout)
    assert "layout" not in _check(declared)
    assert list(declared.texts["description"]) == ["FND IB"] * 3


def test_columns_by_position_without_heights() -> None:
    read = _read(_text("", "{k},{e},{n},nail"))
    assert read.height is None
    assert (read.first.tolist(), list(read.texts["description"])) == (E, ["nail"] * 3)
    assert (_read(_text("", "{k},{e},{n}")).first.tolist()) == E


def test_columns_by_position_need_evidence() -> None:
    degrees = "1,8.41,49.01,112.1\n2,8.42,49.02,112.2\n"
    with pytest.raises(InvalidParameter, match="lie in the area of use of EPSG:4326 as pnezd and as penzd"):
        _read(degrees, crs="EPSG:4326")
    read = _read(degrees, crs="EPSG:4326", area_deg=(8.0, 48.0, 9.0, 50.0))
    assert (read.first.tolist(), read.second.tolist()) == ([8.41, 8.42], [49.01, 49.02])
    with pytest.raises(UnreadableUpload, match="with no order of the columns"):
        _read("1,1.5,2.5,3\n2,2.5,3.5,4\n")
    with pytest.raises(UnreadableUpload, match="no CRS is declared"):
        _read(degrees, crs=None)


@pytest.mark.parametrize("zone", ["EPSG:25832", "EPSG:32632"])
def test_eastings_that_begin_with_the_zone(zone: str) -> None:
    read = _read(_text("P,E,N,H", "{k},32{e},{n},{h}"), crs=zone)
    assert read.first == pytest.approx(E, abs=1e-6)
    assert {one.what: one.value for one in read.detected}["zone in the eastings"] == "32"
    assert read.written is not None
    assert read.written[0] == pytest.approx([32e6 + e for e in E], abs=1e-6)
    with pytest.raises(InvalidParameter, match="begin with the number of zone 33"):
        _read(_text("P,E,N,H", "{k},33{e},{n},{h}"), crs=zone)


def test_eastings_of_a_crs_that_contains_the_zone_stay() -> None:
    read = _read(_text("P,E,N,H", "{k},32{e},{n},{h}"), crs="EPSG:4647")  # ETRS89 / UTM zone 32N (zE-N)
    assert read.first.tolist() == [32e6 + e for e in E]
    assert read.written is None


def test_a_second_pair_of_coordinates_is_a_check() -> None:
    back = Transformer.from_crs("EPSG:25832", "EPSG:4326", always_xy=True)
    lon = [back.transform(456730.93, 5427200.0 + k) for k in range(10)]
    lines = [f"{k},456730.93,{5427200.0 + k},{x:.7f},{y:.7f}" for k, (x, y) in enumerate(lon)]
    text = "\n".join(["P,E,N,Longitude,Latitude", *lines])
    assert not _read(text).faults.counts
    assert _read(text).first[0] == 456730.93
    wrong = text.replace(lines[9], f"9,456730.93,5427209.0,{lon[9][0] + 0.001:.7f},{lon[9][1]:.7f}")
    assert [(f.row, f.code) for f in _read(wrong).faults.shown(9)] == [(10, "coordinates_disagree")]
    shifted = _read(text, crs="EPSG:23032")  # ED50: the other datum is some 130 m away
    assert [(f.row, f.code) for f in shifted.faults.shown(9)] == [(None, "coordinates_disagree")]
    degrees = _read(text, crs="EPSG:4326")
    assert degrees.first[0] == pytest.approx(lon[0][0], abs=1e-7)


def test_degrees_minutes_and_seconds() -> None:
    text = """Name,Latitude,Longitude
P1,"49°00'18.00000""N","8°24'36.54000""E"
P2,"49°00'18.36000""N","8°24'37.08000""W"
"""
    read = _read(text, crs="EPSG:4326")
    assert read.first == pytest.approx([8.41015, -8.4103], abs=1e-12)  # 8 + 24/60 + 36.54/3600; 8 + 24/60 + 37.08/3600
    assert read.second == pytest.approx([49.005, 49.0051], abs=1e-12)
    assert {one.what: one.value for one in read.detected}["degrees"] == "degrees, minutes, seconds"
    for wrong in ('8°24\'36""O', '8°24\'36""N', '8°64\'36""E', "8.41"):  # O: Ost or Ouest
        found = _read(text + f'P3,"49°00\'18.0""N","{wrong}"\n', crs="EPSG:4326")
        assert [(fault.row, fault.code) for fault in found.faults.shown(9)] == [(3, "not_a_number")]


def test_columns_that_were_not_read_are_reported() -> None:
    found = _check(_read(_text("Punkt-Nr.;Ost;Nord;Höhe (m ü. NN);Punktart;Datum", "{k};{e};{n};{h};Nagel;1.6.2025")))
    assert found["columns without a role"] == "Punktart, Datum"
    assert found["column of height"] == "Höhe (m ü. NN)"


def test_columns_by_position_have_no_names() -> None:
    found = _check(_read(_text("", "{k},{e},{n},{h},nail")))
    assert not [what for what in found if what.startswith("column")]


@pytest.mark.parametrize(
    "cell",
    [
        "POINT Z (456789.12 5427345.67 112.5)",
        "SRID=25832;POINT(456789.12 5427345.67 112.5)",
        "MULTIPOINT Z ((456789.12 5427345.67 112.5))",
        "WKB",
    ],
)
def test_columns_of_wkt_and_wkb(cell: str) -> None:
    if cell == "WKB":  # as PostGIS writes it
        point = shapely.set_srid(shapely.Point(456789.12, 5427345.67, 112.5), 25832)
        cell = shapely.to_wkb(point, hex=True, include_srid=True)
    read = _read(f'id;wkt_geom\n1;"{cell}"\n2;"{cell}"\n')
    assert (read.first[0], read.second[0]) == (456789.12, 5427345.67)
    assert read.height is not None
    assert read.height[1] == 112.5
    assert list(read.texts["point"]) == ["1", "2"]


def test_heights_that_are_all_zero_are_unknown() -> None:
    read = _read("P,E,N,H\n1,456789.12,5427345.67,0.00\n2,456799.12,5427345.67,0\n", vertical_datum=None)
    assert read.height is None
    assert read.faults.counts == {"zero_heights": 1}


def test_a_quoted_text_may_span_lines_that_begin_like_comments() -> None:
    read = _read('P,E,N,D\n1,456789.12,5427345.67,"nail\n# in the kerb"\n2,456799.12,5427345.67,x\n')
    assert list(read.texts["description"]) == ["nail\n# in the kerb", "x"]


@pytest.mark.parametrize("cell", ["1" + " " * 9000 + "x", "(" * 9000, "°" + " " * 9000, "," * 9000])
@pytest.mark.parametrize("place", ["name", "value", "header-less"])
def test_long_cells_cost_no_more_than_their_size(cell: str, place: str) -> None:
    """Patterns with several optional parts would take quadratic time: minutes for these files."""
    quoted = f'"{cell}"'
    rows = [f"{k},{e},{n},{quoted}" for k, (e, n) in enumerate(zip(E, N, strict=True))] * 20
    text = {
        "name": "\n".join([f"P,E,N,{quoted}", *(row.replace(quoted, "1.0") for row in rows)]),
        "value": "\n".join(["P,E,N,H", *rows]),
        "header-less": "\n".join([",".join([quoted] * 4)] * 40 + rows),
    }[place]
    start = time.process_time()
    with suppress(WaymarkError):
        _read(text)
    assert time.process_time() - start < 5.0  # processor time; 0.1 s measured
